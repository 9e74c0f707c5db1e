"""What travels over the bus: one table of topics, and the layout of every message.

Paths are a little-endian struct header and float32 points, ticks are `core.records` rows, the rest is msgspec JSON.
A bus hands out nothing longer than its topic allows. Decoders bound-check and return None for anything that does not
fit; they never raise.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np

from swarmctl.core.types import MAX_RADIUS_M, FlightMode, Mode, Obstacle, Phase, PredictedPath


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream of an agent (or of the operator) on the bus."""

    name: str
    ring: int  # newest samples kept per sender; more than one, so that a forged one does not push out the true one
    max_bytes: int  # longer ones are handed out as `TOO_LONG`
    reliable: bool


PATH = Topic("path", ring=4, max_bytes=4096, reliable=False)
STATUS = Topic("status", ring=4, max_bytes=16_384, reliable=False)
TICK = Topic("tick", ring=256, max_bytes=4096, reliable=False)
COMMAND = Topic("command", ring=64, max_bytes=1024, reliable=True)
OBSTACLES = Topic("obstacles", ring=4, max_bytes=65_536, reliable=True)
INTENT = Topic("intent", ring=4, max_bytes=131_072, reliable=False)  # the newest says all, a lost one is made good
TOPICS = (PATH, STATUS, TICK, COMMAND, OBSTACLES, INTENT)

TOO_LONG = b""  # instead of a message that nobody will look into; no decoder takes it

OPERATOR = "operator"  # the sender name of launch and of the operator verbs

PATH_VERSION = 1
MAX_POINTS = 250
_PATH_HEADER = struct.Struct("<2sBBIIIqifBB2x")  # magic ver flags agent boot seq t0 dt radius n hdr_len
_MAGIC = b"SP"
_Message = TypeVar("_Message")

MAX_OBSTACLES = 64  # measured: 20 us each in every tick that sees it, of 20 ms; 6000 took 130 ms
MAX_OBSTACLE_M = 10_000.0  # of every length and coordinate
MAX_VERSION_STEP = 64  # changes of the list that may be missed; a version out of reach would shut out all later ones
Length = Annotated[float, msgspec.Meta(gt=0.0, le=MAX_OBSTACLE_M)]
Coordinate = Annotated[float, msgspec.Meta(ge=-MAX_OBSTACLE_M, le=MAX_OBSTACLE_M)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]


def encode_path(path: PredictedPath) -> bytes:
    """Bytes of a predicted path."""
    points = np.ascontiguousarray(path.pos_ned_m, dtype="<f4")
    header = _PATH_HEADER.pack(
        _MAGIC,
        PATH_VERSION,
        0,
        path.agent,
        path.boot_id,
        path.seq,
        path.t0_utc_us,
        path.dt_us,
        path.radius_m,
        len(points),
        _PATH_HEADER.size,
    )
    return header + points.tobytes()


def decode_path(payload: bytes) -> PredictedPath | None:
    """Path of a payload; None unless magic, version, lengths and every number are good."""
    if len(payload) < _PATH_HEADER.size:
        return None
    magic, version, _, agent, boot_id, seq, t0_utc_us, dt_us, radius_m, count, header_len = _PATH_HEADER.unpack_from(
        payload
    )
    if magic != _MAGIC or version != PATH_VERSION or header_len < _PATH_HEADER.size:
        return None
    if not 2 <= count <= MAX_POINTS or dt_us <= 0 or len(payload) != header_len + 12 * count:
        return None
    points = np.frombuffer(payload, "<f4", 3 * count, header_len).reshape(count, 3).astype(np.float64)
    if not (np.isfinite(points).all() and math.isfinite(radius_m) and 0.0 <= radius_m <= MAX_RADIUS_M):
        return None
    return PredictedPath(agent, boot_id, seq, t0_utc_us, dt_us, radius_m, points)


class StatusMessage(msgspec.Struct, frozen=True):
    """What an agent says of itself five times a second; peers read `phase` and `ready_utc_us`, people the rest."""

    agent: Count
    boot_id: Count
    sysid: int
    phase: Annotated[int, msgspec.Meta(ge=0, le=int(max(Phase)))]
    mode: Annotated[int, msgspec.Meta(ge=0, le=int(max(Mode)))]
    flight_mode: Annotated[int, msgspec.Meta(ge=0, le=int(max(FlightMode)))]
    armed: bool
    landed: int
    ready_utc_us: Count  # when it reached its start position, 0 before
    outcome: str  # "" while flying, "completed", or why the mission failed
    position_error_m: float
    separation_m: float  # to the nearest peer now
    tick_p99_ms: float
    ticks: Count
    deadline_misses: int
    plan_staleness_ms: float
    solver_failed: int
    active_alert: str  # newest thing an operator should know, "" when all is well
    promises: bool = False  # it flies only what it has promised, see `control.commit`
    utc_us: Count = 0  # when it was said, by the agent's clock


class CommandMessage(msgspec.Struct, frozen=True):
    """What an operator asks of one agent or of all (`agent` -1)."""

    verb: Literal["hold", "resume", "land", "rtl"]
    agent: int
    utc_us: Count  # when it was asked for, by the clock of those asked


class ObstacleMessage(msgspec.Struct, frozen=True):
    """One obstacle, a sphere or a column of any height, shared NED [m]."""

    center_ned_m: tuple[Coordinate, Coordinate, Coordinate]
    radius_m: Length
    keep_out_m: Length
    visibility_m: Length
    vel_ned_m_s: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    column: bool = False

    def obstacle(self) -> Obstacle:
        """As plans see it."""
        center, vel = np.array(self.center_ned_m), np.array(self.vel_ned_m_s)
        return Obstacle(center, self.radius_m, self.keep_out_m, self.visibility_m, vel, self.column)


class ObstaclesMessage(msgspec.Struct, frozen=True):
    """The whole list of obstacles; a higher `version` replaces a lower one."""

    version: Count
    obstacles: Annotated[tuple[ObstacleMessage, ...], msgspec.Meta(max_length=MAX_OBSTACLES)]

    def replaces(self, version: int | None) -> bool:
        """Whether it is newer than the known version (None: none is known), and may be the next or one soon after."""
        return version is None or 0 < self.version - version <= MAX_VERSION_STEP


def first_obstacles(items: Iterable[Mapping[str, Any]]) -> ObstaclesMessage:
    """Version 1 of the list: items as configured."""
    return ObstaclesMessage(1, tuple(ObstacleMessage(**item) for item in items))


def encode_message(message: msgspec.Struct) -> bytes:
    """Bytes of a control-plane message."""
    return msgspec.json.encode(message)


def decode_status(payload: bytes) -> StatusMessage | None:
    return _decode(payload, _STATUS_DECODER)


def decode_command(payload: bytes) -> CommandMessage | None:
    return _decode(payload, _COMMAND_DECODER)


def decode_obstacles(payload: bytes) -> ObstaclesMessage | None:
    return _decode(payload, _OBSTACLES_DECODER)


_STATUS_DECODER = msgspec.json.Decoder(StatusMessage)
_COMMAND_DECODER = msgspec.json.Decoder(CommandMessage)
_OBSTACLES_DECODER = msgspec.json.Decoder(ObstaclesMessage)


def _decode(payload: bytes, decoder: msgspec.json.Decoder[_Message]) -> _Message | None:
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
