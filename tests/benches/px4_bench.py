"""One simulated PX4 on an in-memory link, and a ground station's link when asked for; the client's ends of them."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sitl.net.mavlink_values import Result
from sitl.px4.autopilot import Autopilot
from sitl.px4.link.endpoint import Endpoint
from sitl.px4.modes import Px4Mode
from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig

NAN = math.nan
LEVEL = [1.0, 0.0, 0.0, 0.0]
HOVER = 9.81 / 20.0
GROUND_STATION = 190
SPAWN_NED_M = (1.0, 2.0, 0.5)
COARSE: dict[str, Any] = {"physics_hz": 100}  # long flights, where only the autopilot's rate matters


class Bench:
    """One vehicle on a pipe, and the client's end of it.

    Attributes:
        received: frames received on the offboard link since `forget`, by message id.
        gcs_received: the same of the ground station's link.
    """

    def __init__(
        self,
        preset: Any = "thesis",
        wait_s: float = 0.2,
        ekf_ready_s: float = 0.1,
        *,
        gcs: bool = False,
        every_stream: bool = False,
        **params: Any,
    ) -> None:
        self.clock = SimClock()
        vehicle_end, self.link = pipe_pair(self.clock.now_us)
        vehicle_gcs_end, self.gcs_link = pipe_pair(self.clock.now_us)
        sitl = SimulatorConfig(vehicles=1, spawn_ned_m=[SPAWN_NED_M], preset=preset, ekf_ready_s=ekf_ready_s, **params)
        self.world = SitlWorld(sitl, [vehicle_end], [vehicle_gcs_end] if gcs else [])
        pilot, endpoint = self.world.autopilots[0], self.world.endpoints[0]
        assert isinstance(pilot, Autopilot)
        assert isinstance(endpoint, Endpoint)
        self.pilot, self.endpoint = pilot, endpoint
        self.hz = sitl.physics_hz
        self.codec, self.gcs_codec = Codec(1, 191), Codec(255, 190)
        self.received: defaultdict[int, list[bytes]] = defaultdict(list)
        self.gcs_received: defaultdict[int, list[bytes]] = defaultdict(list)
        for message in () if every_stream else (30, 31, 32, 33, 105):  # the busiest cost time
            self.endpoint.set_interval(message, -1)
        self.run(wait_s)

    @property
    def height_m(self) -> float:
        return 0.5 - float(self.world.truth_rows()[0]["pos_ned_m"][2])

    @property
    def speed_m_s(self) -> float:
        return float(np.linalg.norm(self.world.truth_rows()[0]["vel_ned_m_s"]))

    def run(self, seconds: float, stream_hz: float = 0.0, q: list[float] | None = None, thrust: float = HOVER) -> None:
        every = round(self.hz / stream_hz) if stream_hz else 0
        for k in range(max(1, round(seconds * self.hz))):
            if every and k % every == 0:
                self.setpoint(q=q, thrust=thrust)
            self.clock.advance(1_000_000 // self.hz)
            self.world.step(self.clock.now_us())
            for link, received in ((self.link, self.received), (self.gcs_link, self.gcs_received)):
                for datagram in link.receive(self.clock.now_us()):
                    for frame in frames(datagram.data):
                        received[message_id(frame)].append(frame)

    def forget(self) -> None:
        """Discard everything received so far."""
        self.received.clear()
        self.gcs_received.clear()

    def said(self, message: int, *, gcs: bool = False) -> list[Any]:
        """Messages of one kind since `forget`."""
        return [self.codec.decode(frame) for frame in (self.gcs_received if gcs else self.received)[message]]

    def send(self, message: Any, *, gcs: bool = False) -> None:
        if gcs:
            self.gcs_link.send(self.gcs_codec.encode(message))
        else:
            self.link.send(self.codec.encode(message))

    def setpoint(
        self,
        q: list[float] | None = None,
        thrust: float = HOVER,
        mask: int = 7,
        rates: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.send(mav.MAVLink_set_attitude_target_message(0, 1, 1, mask, q or LEVEL, *rates, thrust))

    def command(self, number: int, *params: float) -> int | None:
        """Result of a COMMAND_LONG, None when nothing was acknowledged within one step."""
        self.received[mav.MAVLINK_MSG_ID_COMMAND_ACK].clear()
        padded = [*params, *[0.0] * (7 - len(params))]
        self.send(mav.MAVLink_command_long_message(1, 1, number, 0, *padded))
        self.run(0.004)
        results = [m.result for m in self.said(mav.MAVLINK_MSG_ID_COMMAND_ACK) if m.command == number]
        return results[0] if results else None

    def arm(self) -> int | None:
        return self.command(400, 1)

    def mode(self, main: int, sub: int = 0) -> int | None:
        return self.command(176, 1, main, sub)

    def as_ground_station(self) -> Bench:
        """Act as a ground station from now on, which receives the reason of a refused mode."""
        self.codec = Codec(1, GROUND_STATION)
        return self

    def texts(self) -> list[str]:
        return [text for _, text in self.pilot.texts] + [t for _, _, t in self.endpoint._texts]

    def in_offboard(self, height_m: float = 0.0) -> Bench:
        """Armed in OFFBOARD at 50 Hz, above `height_m`."""
        self.setpoint()
        assert self.mode(6) == Result.ACCEPTED
        assert self.arm() == Result.ACCEPTED
        while self.height_m < height_m:
            self.run(0.02, 50, thrust=0.6)
        self.run(0.2, 50, thrust=HOVER if height_m else 0.3)
        return self


def taken_off(preset: Any = "thesis", **kwargs: Any) -> Bench:
    bench = Bench(preset, **COARSE, **kwargs)
    assert bench.command(22, *[NAN] * 7) == Result.ACCEPTED
    assert bench.arm() == Result.ACCEPTED
    bench.run(9.0)
    assert bench.pilot.mode == Px4Mode.AUTO_LOITER
    return bench
