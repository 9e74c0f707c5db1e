"""What every autopilot commands, what it is built for, and the interfaces of it and its MAVLink side to `SitlWorld`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sitl.boot import Boot
from sitl.net.mavlink_values import Severity
from sitl.net.signing import SigningRules
from sitl.plant.imu import Imu
from sitl.plant.sensors import Estimate, LocalOrigin
from sitl.plant.vehicle import Plant
from swarmctl.core.types import Array, FlightMode, Landed
from swarmctl.mavlink.transport import Transport
from swarmctl.simulator_config import SimulatorConfig


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

    @property
    def boot(self) -> Boot:
        """Its own clock and local frame."""

    def send_text(self, severity: Severity, text: str) -> None:
        """Queue a STATUSTEXT on every link."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedVehicle:
    """One vehicle of a world, as its autopilot is built for it.

    Attributes:
        number: its column in the plant.
        origin: of its local frame.
        since_boot_us: returns the time of the newest step, since the simulator's start.
        estimate: returns the estimate of that instant.
        sign: returns the links to its clients, with the signatures of the autopilot by these rules.
    """

    number: int
    params: SimulatorConfig
    origin: LocalOrigin
    plant: Plant
    imu: Imu
    since_boot_us: Callable[[], int]
    estimate: Callable[[], Estimate]
    sign: Callable[[Commander, SigningRules], Sequence[Transport]]

    @property
    def sysid(self) -> int:
        """Its MAVLink system id."""
        return self.params.sysid_base + self.number

    @property
    def step_us(self) -> int:
        """The physics step, the fastest message interval."""
        return round(self.plant.dt_s * 1e6)

    @property
    def ekf_ready_us(self) -> int:
        """When it can be armed, since its boot."""
        return round(self.params.ekf_ready_s * 1e6)

    @property
    def airborne(self) -> bool:
        """Whether it starts in the air."""
        return self.params.start == "air"
