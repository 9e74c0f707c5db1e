"""Trajectory messages of `swarmctl.control.commit.protocol`: their encoding.

The layout is little-endian: a header, the committed trajectory, a proposal if there is one, acknowledgements (agent,
number), what was heard (agent, stamp, arrival), and the numbers of agents that are suspected, of those to be excluded,
and of those that are far. A trajectory is t0, step and count, then positions and velocities as float32.
"""

from __future__ import annotations

import math
import struct
from collections.abc import ItemsView, Iterator, Mapping
from functools import cached_property, lru_cache

import numpy as np

from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, Proposal, Reach, TrajectoryMessage
from swarmctl.core.types import MAX_SPEED_M_S, MAX_STEP_US, MIN_STEP_US, Array

TRAJECTORY_VERSION = 5
MAX_TUBE_M = 100.0
MAX_POINTS = 2000
MAX_PEERS = 256  # of each kind: acknowledged, heard, suspected, promised, far
_MAGIC = b"SI"
_HEADER = struct.Struct("<2sBBIIIqfffHHHHH")  # magic version flags agent boot seq sent tube reach, counts of the kinds
_HAS_PROPOSAL, _IS_COMMITTED, _ASKS_FAR = 1, 2, 4
_FLAGS = _HAS_PROPOSAL | _IS_COMMITTED | _ASKS_FAR
_PROPOSAL = struct.Struct("<Qq")  # number, time of proposal
_TRAJECTORY = struct.Struct("<qiH2x")
_POINT_BYTES = 24  # position and velocity
_ACKNOWLEDGEMENT = struct.Struct("<IQ")
_HEARD = struct.Struct("<Iqq")
_AGENT = struct.Struct("<I")
_REMEMBERED = 256  # messages: two of each of a hundred agents, which all hear within a tick

Memory = dict[bytes, Trajectory]  # decoded trajectories by their bytes


class HeardTimes(Mapping[int, tuple[int, int]]):
    """Reads what a message says was heard, where it is looked for: most of it is not.

    Args:
        encoded: as in the message.
    """

    def __init__(self, encoded: bytes) -> None:
        self._encoded = encoded

    @cached_property
    def oldest_us(self) -> int:
        """Return the earliest arrival of all; 0 if nobody was heard."""
        return min([arrival for _, _, arrival in _HEARD.iter_unpack(self._encoded)], default=0)

    def __getitem__(self, agent: int) -> tuple[int, int]:
        key = _AGENT.pack(agent)
        at = self._encoded.find(key)
        while at % _HEARD.size:  # also when it is not found: -1
            if at < 0:
                raise KeyError(agent)
            at = self._encoded.find(key, at + 1)
        _, stamp_us, arrival_us = _HEARD.unpack_from(self._encoded, at)
        return stamp_us, arrival_us

    def __iter__(self) -> Iterator[int]:
        return (agent for agent, _, _ in _HEARD.iter_unpack(self._encoded))

    def __len__(self) -> int:
        return len(self._encoded) // _HEARD.size

    def items(self) -> ItemsView[int, tuple[int, int]]:
        """Return all at once."""
        return {agent: (stamp, arrival) for agent, stamp, arrival in _HEARD.iter_unpack(self._encoded)}.items()


def encode_trajectory_message(message: TrajectoryMessage) -> bytes:
    """Encode one message."""
    parts = [
        _HEADER.pack(
            _MAGIC,
            TRAJECTORY_VERSION,
            _flags(message),
            message.agent,
            message.boot_id,
            message.seq,
            message.sent_utc_us,
            message.tube_m,
            message.reach.speed_m_s,
            message.reach.stretch_m,
            len(message.acknowledged),
            len(message.heard),
            len(message.exclusions.suspected),
            len(message.exclusions.promised),
            len(message.reach.far),
        ),
        _encode_trajectory(message.committed),
    ]
    if message.proposal is not None:
        parts.append(_PROPOSAL.pack(message.proposal.number, message.proposal.made_utc_us))
        parts.append(_encode_trajectory(message.proposal.trajectory))
    parts += [_ACKNOWLEDGEMENT.pack(agent, number) for agent, number in sorted(message.acknowledged.items())]
    parts += [_HEARD.pack(agent, *stamps) for agent, stamps in sorted(message.heard.items())]
    for agents in (message.exclusions.suspected, message.exclusions.promised, message.reach.far):
        parts += [_AGENT.pack(agent) for agent in sorted(agents)]
    return b"".join(parts)


def decode_trajectory_message(
    payload: bytes, memory: Memory | None = None, ahead_us: int = 0, error_us: int = 0
) -> TrajectoryMessage | None:
    """Decode one message; None unless magic, version, lengths and all numbers are valid.

    `memory` holds the trajectories of the previous message: a trajectory that is repeated becomes the same object, by
    which the protocol knows that it has checked it before. The sender's clock is `ahead_us` ahead of the own one, to
    which its trajectories are converted, give or take `error_us`; the memory must be of the same correction.
    """
    read = _read(payload)
    if read is None:
        return None
    by_sender, bodies = read
    known, own = memory or {}, Memory()
    for body, trajectory in zip(bodies, by_sender.trajectories, strict=True):
        repeated = known.get(body)
        own[body] = _by_own_clock(trajectory, ahead_us, error_us) if repeated is None else repeated
    if memory is not None:
        memory.clear()
        memory.update(own)
    proposal = by_sender.proposal
    if proposal is not None:
        proposal = Proposal(
            number=proposal.number,
            made_utc_us=proposal.made_utc_us,
            agent=proposal.agent,
            trajectory=own[bodies[-1]],
            asks_far=proposal.asks_far,
        )
    return TrajectoryMessage(
        agent=by_sender.agent,
        boot_id=by_sender.boot_id,
        seq=by_sender.seq,
        sent_utc_us=by_sender.sent_utc_us,
        is_committed=by_sender.is_committed,
        committed=own[bodies[0]],
        tube_m=by_sender.tube_m,
        proposal=proposal,
        acknowledged=by_sender.acknowledged,
        exclusions=by_sender.exclusions,
        heard=by_sender.heard,
        reach=by_sender.reach,
    )


def _by_own_clock(trajectory: Trajectory, ahead_us: int, error_us: int) -> Trajectory:
    return Trajectory(
        t0_utc_us=trajectory.t0_utc_us - ahead_us,
        dt_us=trajectory.dt_us,
        pos_ned_m=trajectory.pos_ned_m,
        vel_ned_m_s=trajectory.vel_ned_m_s,
        clock_error_us=error_us,
    )


@lru_cache(maxsize=_REMEMBERED)
def _read(payload: bytes) -> tuple[TrajectoryMessage, tuple[bytes, ...]] | None:
    """Return a message by its sender's clock, and the bytes of its trajectories; None if it is not valid.

    All agents of a process that hear it read it once.
    """
    try:
        magic, version, flags, agent, boot_id, seq, sent_utc_us, *numbers = _HEADER.unpack_from(payload)
        (tube_m, speed_m_s, stretch_m), counts = numbers[:3], numbers[3:]
        if magic != _MAGIC or version != TRAJECTORY_VERSION or flags > _FLAGS or max(counts) > MAX_PEERS:
            return None
        if not 0.0 <= tube_m <= MAX_TUBE_M or not speed_m_s >= 0.0 or not stretch_m >= 0.0:
            return None
        acknowledgements, heard, suspected, promised, far = counts
        body, at = _body(payload, _HEADER.size)
        bodies, committed, proposal = [body], _decode_trajectory(body), None
        if flags & _HAS_PROPOSAL:
            number, made_utc_us = _PROPOSAL.unpack_from(payload, at)
            body, at = _body(payload, at + _PROPOSAL.size)
            bodies.append(body)
            proposal = Proposal(
                number=number,
                made_utc_us=made_utc_us,
                agent=agent,
                trajectory=_decode_trajectory(body),
                asks_far=bool(flags & _ASKS_FAR),
            )
        heard_at = at + acknowledgements * _ACKNOWLEDGEMENT.size
        suspected_at = heard_at + heard * _HEARD.size
        promised_at = suspected_at + suspected * _AGENT.size
        far_at = promised_at + promised * _AGENT.size
        if len(payload) != far_at + far * _AGENT.size:
            return None
        message = TrajectoryMessage(
            agent=agent,
            boot_id=boot_id,
            seq=seq,
            sent_utc_us=sent_utc_us,
            is_committed=bool(flags & _IS_COMMITTED),
            committed=committed,
            tube_m=tube_m,
            proposal=proposal,
            acknowledged=dict(_ACKNOWLEDGEMENT.iter_unpack(payload[at:heard_at])),
            exclusions=Exclusions(
                suspected=_agents(payload[suspected_at:promised_at]), promised=_agents(payload[promised_at:far_at])
            ),
            heard=HeardTimes(payload[heard_at:suspected_at]),
            reach=Reach(far=_agents(payload[far_at:]), speed_m_s=speed_m_s, stretch_m=stretch_m),
        )
    except (struct.error, ValueError):
        return None
    return message, tuple(bodies)


@lru_cache(maxsize=1024)
def _agents(encoded: bytes) -> frozenset[int]:
    """Return the numbers of a list; most lists are those of the message before."""
    return frozenset(agent for (agent,) in _AGENT.iter_unpack(encoded))


def _flags(message: TrajectoryMessage) -> int:
    flags = _IS_COMMITTED * message.is_committed
    if message.proposal is not None:
        flags |= _HAS_PROPOSAL | _ASKS_FAR * message.proposal.asks_far
    return flags


def _encode_trajectory(trajectory: Trajectory) -> bytes:
    points = np.hstack([trajectory.pos_ned_m, trajectory.vel_ned_m_s]).astype("<f4")
    return _TRAJECTORY.pack(trajectory.t0_utc_us, trajectory.dt_us, len(points)) + points.tobytes()


def _body(payload: bytes, at: int) -> tuple[bytes, int]:
    """Return the bytes of the trajectory at offset `at`, and the offset of their end.

    Raises:
        struct.error: there is none.
    """
    _, _, count = _TRAJECTORY.unpack_from(payload, at)
    end = at + _TRAJECTORY.size + _POINT_BYTES * count
    return payload[at:end], end


@lru_cache(maxsize=_REMEMBERED)
def _decode_trajectory(body: bytes) -> Trajectory:
    """Return a trajectory by its sender's clock; messages repeat it until the next one.

    Raises:
        ValueError: the bytes are no trajectory, or one that no vehicle flies.
    """
    t0_utc_us, dt_us, count = _TRAJECTORY.unpack_from(body)
    is_whole = len(body) == _TRAJECTORY.size + _POINT_BYTES * count
    if not 2 <= count <= MAX_POINTS or not MIN_STEP_US <= dt_us <= MAX_STEP_US or not is_whole:
        raise ValueError("no trajectory")
    points: Array = np.frombuffer(body, "<f4", 6 * count, _TRAJECTORY.size).reshape(count, 6).astype(np.float64)
    if not math.isfinite(np.vdot(points, points)):  # squares can't overflow
        raise ValueError("not finite")
    pos_ned_m, vel_ned_m_s = points[:, :3].copy(), points[:, 3:].copy()
    farthest_m = 1e-6 * MAX_SPEED_M_S * dt_us
    if np.abs(vel_ned_m_s).max() > MAX_SPEED_M_S or np.abs(pos_ned_m[1:] - pos_ned_m[:-1]).max() > farthest_m:
        raise ValueError("too fast")
    pos_ned_m.flags.writeable = vel_ned_m_s.flags.writeable = False  # of all agents of a process
    return Trajectory(t0_utc_us=t0_utc_us, dt_us=dt_us, pos_ned_m=pos_ned_m, vel_ned_m_s=vel_ned_m_s)
