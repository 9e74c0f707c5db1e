"""What a `SitlWorld` needs of a vehicle's brain and of its MAVLink interface, whichever autopilot they imitate."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from sitl.plant.sensors import Estimate
from sitl.px4.navigator import Command
from swarmctl.core.types import FlightMode, Landed
from swarmctl.mavlink.transport import Transport


class ParameterTable(Protocol):
    """Parameters by name, whatever their encoding on the wire."""

    def real(self, name: str) -> float:
        """Value of a parameter as a number."""

    def integer(self, name: str) -> int:
        """Value of an integer parameter."""

    def assign(self, name: str, value: float) -> None:
        """Set a parameter in this process, without the wire."""


class Commander(Protocol):
    """Modes, arming and navigation of one vehicle."""

    @property
    def armed(self) -> bool:
        """Motors may turn."""

    @property
    def landed(self) -> Landed:
        """MAV_LANDED_STATE."""

    @property
    def output(self) -> Command:
        """Attitude and thrust to fly; the object `IDLE` when motors rest."""

    @property
    def released(self) -> bool:
        """An air start's clamp has been opened."""

    @property
    def refused(self) -> Counter[str]:
        """Setpoints not used, by reason."""

    @property
    def parameters(self) -> ParameterTable:
        """The autopilot's parameters."""

    def flight_mode(self) -> FlightMode:
        """What flies, independent of the dialect."""

    def tick(self, estimate: Estimate, now_us: int, dt_s: float) -> None:
        """One step of the autopilot; `now_us` is time since boot."""


class MavlinkInterface(Protocol):
    """One vehicle on one MAVLink link."""

    @property
    def transport(self) -> Transport:
        """The link."""

    @property
    def ignored(self) -> Counter[str]:
        """Frames not used, by reason."""

    def receive(self, now_us: int, transport_now_us: int) -> None:
        """Handle everything that has arrived; `now_us` is time since boot."""

    def send_due(self, now_us: int) -> None:
        """Send what is due."""
