"""What every autopilot commands, and the interfaces of it and of its MAVLink side, as `SitlWorld` uses them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sitl.plant.sensors import Estimate
from sitl.plant.vehicle import Array
from swarmctl.core.types import FlightMode, Landed
from swarmctl.mavlink.transport import Transport


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Command to one vehicle's attitude loop: attitude or body rates, and collective thrust.

    Attributes:
        q_nb: (4,) wxyz, unit length.
        thrust_01: share of full thrust.
        rate_frd_rad_s: rates to fly instead of the attitude; NaN: that axis is uncontrolled.
        feed_frd_rad_s: feed-forward added to the rates of the attitude loop.
        stopped: motors do not turn though armed.
        loose: no torque at all.
    """

    q_nb: Array
    thrust_01: float
    rate_frd_rad_s: tuple[float, float, float] | None = None
    feed_frd_rad_s: tuple[float, float, float] | None = None
    stopped: bool = False
    loose: bool = False


IDLE = Command(q_nb=np.array([1.0, 0.0, 0.0, 0.0]), thrust_01=0.0, loose=True)


class ParameterTable(Protocol):
    """Parameters by name, independent of their MAVLink encoding."""

    def real(self, name: str) -> float:
        """Return a parameter as a real number."""

    def integer(self, name: str) -> int:
        """Return an integer parameter."""

    def assign(self, name: str, value: float) -> None:
        """Set a parameter in this process, without MAVLink."""


class Commander(Protocol):
    """Modes, arming and navigation of one vehicle."""

    @property
    def armed(self) -> bool:
        """Whether the motors may turn."""

    @property
    def landed(self) -> Landed:
        """The MAV_LANDED_STATE of the vehicle."""

    @property
    def output(self) -> Command:
        """Attitude and thrust to fly; the object `IDLE` while motors rest."""

    @property
    def released(self) -> bool:
        """Whether the clamp of an air start has been opened."""

    @property
    def refused(self) -> Counter[str]:
        """Number of unused setpoints, by reason."""

    @property
    def parameters(self) -> ParameterTable:
        """The parameters of the autopilot."""

    def flight_mode(self) -> FlightMode:
        """Return the flight mode, independent of the dialect."""

    def tick(self, estimate: Estimate, now_us: int, dt_s: float) -> None:
        """Run one step of the autopilot; `now_us` is time since boot."""


class MavlinkInterface(Protocol):
    """The MAVLink interface of one vehicle on one link."""

    @property
    def transport(self) -> Transport:
        """Return the link to the client."""

    @property
    def ignored(self) -> Counter[str]:
        """Number of unused frames, by reason."""

    def receive(self, now_us: int, transport_now_us: int) -> None:
        """Handle everything that has arrived; `now_us` is time since boot."""

    def send_due(self, now_us: int) -> None:
        """Send the messages that are due."""

    def reboot(self, now_us: int) -> None:
        """Restart the autopilot as after power-up; `now_us` is on the clock of the simulation."""
