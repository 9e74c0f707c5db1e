"""A simulated world that a scripted MAVLink client flies, on a simulated clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.core.frames import quat_from_euler
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig

NAN = math.nan
LOITER, OFFBOARD = (1, 4, 3), (1, 6, 0)


class FlownWorld:
    """One client for each of `vehicles` vehicles.

    Args:
        vehicles: how many, 1 m apart.
        realism: of the world.
        params: further ones of `SimulatorConfig`.
    """

    def __init__(self, vehicles: int = 1, realism: dict[str, Any] | None = None, **params: Any) -> None:
        self.clock = SimClock()
        pairs = [pipe_pair(self.clock.now_us) for _ in range(vehicles)]
        self.clients = [client for client, _ in pairs]
        config = SimulatorConfig(vehicles=vehicles, **(realism or {}), **params)
        self.world = SitlWorld(config, [end for _, end in pairs])
        self._codec = Codec(255, 190)

    def step(self, seconds: float, every: Any = None) -> None:
        """Let time pass; `every` is called after each physics step."""
        period_us = round(1e6 / self.world.params.physics_hz)
        for _ in range(round(seconds * 1e6 / period_us)):
            self.clock.advance(period_us)
            self.world.step(self.clock.now_us())
            if every is not None:
                every()

    def send(self, vehicle: int, message: Any) -> None:
        """One message to one vehicle."""
        self.clients[vehicle].send(self._codec.encode(message))

    def command(self, vehicle: int, command: int, *params: float) -> None:
        """COMMAND_LONG; parameters not given are 0."""
        filled = (*params, *(0.0,) * (7 - len(params)))
        self.send(vehicle, mav.MAVLink_command_long_message(vehicle + 1, 1, command, 0, *filled))

    def setpoint(self, vehicle: int, euler_rad: Sequence[float], thrust_01: float) -> None:
        """SET_ATTITUDE_TARGET, type mask 7."""
        q_nb = quat_from_euler(*euler_rad).tolist()
        self.send(vehicle, mav.MAVLink_set_attitude_target_message(0, vehicle + 1, 1, 7, q_nb, 0, 0, 0, thrust_01))

    def take_off(self) -> None:
        """All vehicles, to where AUTO.TAKEOFF ends; then they loiter."""
        self.step(1.2)
        for i in range(len(self.clients)):
            self.command(i, mav.MAV_CMD_NAV_TAKEOFF, NAN, NAN, NAN, NAN, NAN, NAN, NAN)
            self.command(i, mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        self.step(10.0)
        assert float(self.world.plant.height_m.min()) > 2.0

    def fly_offboard(self, euler_rad: Sequence[float], thrust_01: float) -> None:
        """From loiter: one setpoint to be let into OFFBOARD, and one to be flown there."""
        for i in range(len(self.clients)):
            self.setpoint(i, euler_rad, thrust_01)
        self.step(0.02)
        for i in range(len(self.clients)):
            self.command(i, mav.MAV_CMD_DO_SET_MODE, *OFFBOARD)
        self.step(0.02)
        for i in range(len(self.clients)):
            self.setpoint(i, euler_rad, thrust_01)

    def received(self, vehicle: int) -> list[bytes]:
        """Frames that have reached a client."""
        return [
            frame for datagram in self.clients[vehicle].receive(self.clock.now_us()) for frame in frames(datagram.data)
        ]

    @property
    def pos_ned_m(self) -> Any:
        """True positions (N, 3) relative to each spawn."""
        return self.world.plant.pos_ned_m.T.copy()

    @property
    def tilt_deg(self) -> Any:
        """(N,) between the body's and the world's vertical."""
        return np.degrees(np.arccos(np.clip(self.world.plant.rotation[8], -1.0, 1.0)))
