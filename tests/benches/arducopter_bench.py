"""One simulated ArduCopter on an in-memory link, and the client's end of it, on a simulated clock."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.arducopter.autopilot import ArduCopter
from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.core.frames import quat_from_euler
from swarmctl.core.types import Landed
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig

STABILIZE, ALT_HOLD, GUIDED, LOITER, RTL, LAND, BRAKE = 0, 2, 4, 5, 6, 9, 17
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
SPAWN_NED_M = (1.0, 2.0, 0.5)
THRUST = {"GUID_OPTIONS": 8.0}
_HURRY = {"WPNAV_SPEED_UP": 1000.0, "WPNAV_ACCEL_Z": 500.0, "PSC_POSZ_P": 2.0}


class Bench:
    """A vehicle with system id 1 and a client with ids 255/190 (SYSID_MYGCS).

    Args:
        ekf_ready_s: when it can be armed; the whole boot scales with it.
        parameters: set before it starts.
        gcs: it has a second link.
        sitl: other parameters of the simulation.
    """

    def __init__(
        self, ekf_ready_s: float = 0.1, parameters: dict[str, float] | None = None, gcs: bool = False, **sitl: Any
    ) -> None:
        self.clock = SimClock()
        vehicle_end, self.link = pipe_pair(self.clock.now_us)
        ground_end, self._gcs_link = pipe_pair(self.clock.now_us)
        settings = {"preset": "arducopter", "physics_hz": 250, **sitl}
        params = SimulatorConfig(
            vehicles=1,
            spawn_ned_m=[SPAWN_NED_M],
            ekf_ready_s=ekf_ready_s,
            autopilot_kind="arducopter",
            **settings,
        )
        self.world = SitlWorld(params, [vehicle_end], [ground_end] if gcs else [])
        pilot = self.world.autopilots[0]
        assert isinstance(pilot, ArduCopter)
        self.pilot = pilot
        for name, value in (parameters or {}).items():
            pilot.parameters.assign(name, value)
        self._mav = mav.MAVLink(None, srcSystem=255, srcComponent=190)
        self.step_us = round(1e6 / params.physics_hz)
        self.got: list[Any] = []

    @property
    def t_s(self) -> float:
        """Simulated time since boot."""
        return self.world.since_boot_us * 1e-6

    @property
    def height_m(self) -> float:
        return SPAWN_NED_M[2] - float(self.truth("pos_ned_m")[2])

    @property
    def climb_m_s(self) -> float:
        return -float(self.truth("vel_ned_m_s")[2])

    @property
    def roll_deg(self) -> float:
        return math.degrees(float(self.world.plant.euler_rad[0, 0]))

    @property
    def tilt_deg(self) -> float:
        return math.degrees(math.acos(min(1.0, float(self.world.plant.rotation[8, 0]))))

    def landed(self) -> Landed:
        return self.pilot.landed

    def truth(self, field: str) -> NDArray[np.float64]:
        return np.asarray(self.world.truth_rows()[0][field])

    def run(self, seconds: float, setpoint: dict[str, Any] | None = None, every_s: float = 0.02) -> list[Any]:
        """Messages received meanwhile; `setpoint` is sent again and again."""
        got: list[Any] = []
        every = max(1, round(every_s * 1e6 / self.step_us))
        for k in range(max(1, round(seconds * 1e6 / self.step_us))):
            if setpoint is not None and k % every == 0:
                self.setpoint(**setpoint)
            self.clock.advance(self.step_us)
            self.world.step(self.clock.now_us())
            for datagram in self.link.receive(self.clock.now_us()):
                got += [self._mav.decode(bytearray(frame)) for frame in frames(datagram.data)]
        self.got += got
        return got

    def ask(self, message: Any) -> list[Any]:
        """What comes within one step."""
        self.link.send(message.pack(self._mav))
        return self.run(1e-6 * self.step_us)

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> int | None:
        """Result of a COMMAND_LONG; None: no ack."""
        padded = [*params, *[0.0] * (7 - len(params))]
        got = self.ask(mav.MAVLink_command_long_message(*target, number, 0, *padded))
        return next((m.result for m in of("COMMAND_ACK", got) if m.command == number), None)

    def mode(self, number: int) -> int | None:
        return self.command(176, 1, number)

    def arm(self) -> int | None:
        return self.command(400, 1)

    def setpoint(
        self,
        roll_deg: float = 0.0,
        thrust: float = 0.5,
        mask: int = 7,
        q: list[float] | None = None,
        rates: tuple[float, float, float] = (0.0, 0.0, 0.0),
        target: tuple[int, int] = (1, 1),
    ) -> None:
        q = q if q is not None else [float(c) for c in quat_from_euler(math.radians(roll_deg), 0.0, 0.0)]
        message = mav.MAVLink_set_attitude_target_message(0, *target, mask, q, *rates, thrust)
        self.link.send(message.pack(self._mav))

    def texts(self) -> list[str]:
        """Every text so far."""
        return [m.text for m in of("STATUSTEXT", self.got)]

    def got_by_gcs(self) -> list[Any]:
        """What has arrived on the second link."""
        datagrams = self._gcs_link.receive(self.clock.now_us())
        return [self._mav.decode(bytearray(frame)) for d in datagrams for frame in frames(d.data)]

    def booted(self) -> Bench:
        """Run until it can be armed."""
        self.run(1e-6 * self.pilot.boot_times.armable_us + 0.02)
        return self

    def airborne(self, height_m: float = 5.0) -> Bench:
        """Boot, GUIDED, arm, NAV_TAKEOFF (in a hurry), and hang there."""
        self.booted()
        assert self.mode(GUIDED) == ACCEPTED
        assert self.arm() == ACCEPTED
        assert self.command(22, 0, 0, 0, 0, 0, 0, height_m) == ACCEPTED
        table = self.pilot.parameters
        before = {name: table.real(name) for name in _HURRY}
        for name, value in _HURRY.items():
            table.assign(name, value)
        self.run(2.5)
        while abs(self.height_m - height_m) > 0.05 or abs(self.climb_m_s) > 0.05:
            self.run(0.1)
            assert self.t_s < 60, "never arrived"
        for name, value in before.items():
            table.assign(name, value)
        return self


def of(kind: str, messages: list[Any]) -> list[Any]:
    return [m for m in messages if m.get_type() == kind]
