"""One vehicle's interface over a pipe, and the messages that carry its state."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.clock import SimClock
from swarmctl.core.types import GeoOrigin
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.mavlink.vehicle.autopilot import Autopilot

SHARED = GeoOrigin(47.397742, 8.545594, 489.4)
LEVEL = (1.0, 0.0, 0.0, 0.0)
PX4_OFFBOARD, PX4_HOLD, PX4_LAND = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24
PX4_TAKEOFF = 4 << 16 | 2 << 24


class Bench:
    """An `Autopilot` and the vehicle's end of its link."""

    def __init__(self, sysid: int = 1) -> None:
        self.clock = SimClock()
        ours, self.vehicle = pipe_pair(self.clock.now_us)
        self.own_codec = Codec(sysid, 191)
        self.frames: list[bytes] = []
        self.pilot = Autopilot(ours, self.own_codec, sysid, SHARED, on_frame=self.frames.append)
        self.codec = Codec(sysid, 1)

    def say(self, message: Any, codec: Codec | None = None) -> None:
        self.vehicle.send((codec or self.codec).encode(message))

    def heartbeat(self, custom_mode: int = PX4_OFFBOARD, autopilot: int = 12, base: int = 128, status: int = 4) -> None:
        self.say(dialect.MAVLink_heartbeat_message(2, autopilot, base, custom_mode, status, 3))

    def origin(self, lat_deg: float, lon_deg: float, alt_m: float) -> None:
        lat, lon, alt = round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3)
        self.say(dialect.MAVLink_gps_global_origin_message(lat, lon, alt))

    def ready(self) -> Bench:
        self.heartbeat()
        self.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
        return self

    def poll(self) -> Any:
        return self.pilot.poll(self.clock.now_us())


def odometry(
    stamp_us: int = 1_000_000,
    pos: tuple[float, ...] = (0.0, 0.0, 0.0),
    vel: tuple[float, ...] = (0.0, 0.0, 0.0),
    q: tuple[float, ...] = LEVEL,
    rate: tuple[float, ...] = (0.0, 0.0, 0.0),
    child: int = 1,
) -> Any:
    nothing = [math.nan] * 21
    return dialect.MAVLink_odometry_message(stamp_us, 1, child, *pos, list(q), *vel, *rate, nothing, nothing, 0, 2, 90)
