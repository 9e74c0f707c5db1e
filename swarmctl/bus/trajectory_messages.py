"""Messages of `swarmctl.control.commit.protocol`: bytes of one intent, and the newest good one of every peer.

Layout, little-endian: a header; the committed trajectory; a proposal, if any; acknowledgements (agent, number). A
trajectory is t0, step, count, then positions and velocities as float32.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np

from swarmctl.bus.peers import MAX_LEAD_US, agent_name
from swarmctl.bus.refusals import FUTURE, IDENTITY, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.bus.senders import Attendance, ReceivedMessage, SenderVerifier
from swarmctl.bus.topics import TRAJECTORY
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Proposal, TrajectoryMessage
from swarmctl.core.types import Array

TRAJECTORY_VERSION = 2
MAX_POINTS = 2000
MAX_STEP_US = 500_000
MAX_BEGIN_US = 10_000_000  # from now: what begins later is of another clock
MAX_ACKNOWLEDGED = 256
_MAGIC = b"SI"
_HEADER = struct.Struct("<2sBBIIIqH2x")  # magic version flags agent boot seq said acknowledgements
_PROPOSES, _IS_COMMITTED = 1, 2
_PROPOSAL = struct.Struct("<Qq")  # number, time it was made
_TRAJECTORY = struct.Struct("<qiH2x")
_ACKNOWLEDGEMENT = struct.Struct("<IQ")

Memory = dict[bytes, Trajectory]  # trajectories by their bytes


def encode_trajectory_message(message: TrajectoryMessage) -> bytes:
    """Bytes of one message."""
    parts = [
        _HEADER.pack(
            _MAGIC,
            TRAJECTORY_VERSION,
            _PROPOSES * (message.proposal is not None) | _IS_COMMITTED * message.is_committed,
            message.agent,
            message.boot_id,
            message.seq,
            message.sent_utc_us,
            len(message.acknowledged),
        ),
        _encode_trajectory(message.committed),
    ]
    if message.proposal is not None:
        parts.append(_PROPOSAL.pack(message.proposal.number, message.proposal.made_utc_us))
        parts.append(_encode_trajectory(message.proposal.trajectory))
    parts += [_ACKNOWLEDGEMENT.pack(agent, number) for agent, number in sorted(message.acknowledged.items())]
    return b"".join(parts)


def decode_trajectory_message(payload: bytes, memory: Memory | None = None) -> TrajectoryMessage | None:
    """The message; None unless magic, version, lengths and every number are good.

    `memory` holds the trajectories of the message before: one that is said again is the same object again.
    """
    try:
        magic, version, flags, agent, boot_id, seq, sent_utc_us, count = _HEADER.unpack_from(payload)
        if magic != _MAGIC or version != TRAJECTORY_VERSION or flags > 3 or count > MAX_ACKNOWLEDGED:
            return None
        known, said = memory or {}, Memory()
        committed, at = _decode_trajectory(payload, _HEADER.size, known, said)
        proposal = None
        if flags & _PROPOSES:
            number, made_utc_us = _PROPOSAL.unpack_from(payload, at)
            trajectory, at = _decode_trajectory(payload, at + _PROPOSAL.size, known, said)
            proposal = Proposal(number, made_utc_us, agent, trajectory)
        if len(payload) != at + count * _ACKNOWLEDGEMENT.size:
            return None
        acknowledged = dict(_ACKNOWLEDGEMENT.iter_unpack(payload[at:]))
        if memory is not None:
            memory.clear()
            memory.update(said)
        return TrajectoryMessage(
            agent, boot_id, seq, sent_utc_us, bool(flags & _IS_COMMITTED), committed, proposal, acknowledged
        )
    except (struct.error, ValueError):
        return None


def _encode_trajectory(trajectory: Trajectory) -> bytes:
    points = np.hstack([trajectory.pos_ned_m, trajectory.vel_ned_m_s]).astype("<f4")
    return _TRAJECTORY.pack(trajectory.t0_utc_us, trajectory.dt_us, len(points)) + points.tobytes()


def _decode_trajectory(payload: bytes, at: int, known: Memory, said: Memory) -> tuple[Trajectory, int]:
    """The trajectory that begins there, and where it ends.

    Raises:
        ValueError, struct.error: it is none.
    """
    t0_utc_us, dt_us, count = _TRAJECTORY.unpack_from(payload, at)
    end = at + _TRAJECTORY.size + 24 * count
    body = payload[at:end]
    if body in known:
        said[body] = known[body]
        return said[body], end
    at += _TRAJECTORY.size
    if not 2 <= count <= MAX_POINTS or not 0 < dt_us <= MAX_STEP_US or len(payload) < at + 24 * count:
        raise ValueError("no trajectory")
    points: Array = np.frombuffer(payload, "<f4", 6 * count, at).reshape(count, 6).astype(np.float64)
    if not np.isfinite(points).all():
        raise ValueError("not finite")
    said[body] = Trajectory(t0_utc_us, dt_us, points[:, :3].copy(), points[:, 3:].copy())
    return said[body], end


class PeerTrajectories:
    """Newest good message of every peer, whatever its age: nothing is newer than what it says.

    Args:
        peers: agent numbers that are listened to, without the own one.
        rate_hz, refusals, attendance: see `SenderVerifier`.
    """

    def __init__(self, peers: Iterable[int], rate_hz: float, refusals: Refusals, attendance: Attendance) -> None:
        names = {agent: agent_name(agent) for agent in peers}
        self._verifiers = {
            a: SenderVerifier(name, TRAJECTORY.name, rate_hz, refusals, attendance) for a, name in names.items()
        }
        self._refusals = refusals
        self._memory: dict[str, Memory] = {}
        self.newest: dict[int, TrajectoryMessage] = {}

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Judge one message; `sender` is the name the bus vouches for, `utc_us` now."""
        memory = dict(self._memory.get(sender, {}))
        message = decode_trajectory_message(payload, memory)
        if message is None or (reason := self._refusal(sender, message, utc_us)):
            self._refusals.add(sender, TRAJECTORY.name, MALFORMED if message is None else reason, utc_us)
            return
        said = ReceivedMessage(message.boot_id, message.seq, min(message.sent_utc_us, utc_us + MAX_LEAD_US), payload)
        if self._verifiers[message.agent].accepts(said, utc_us):
            self.newest[message.agent], self._memory[sender] = message, memory

    def acknowledgements(self) -> dict[int, int]:
        """Number of the proposal that each peer is known to make now."""
        return {agent: i.proposal.number for agent, i in self.newest.items() if i.proposal is not None}

    def _refusal(self, sender: str, message: TrajectoryMessage, utc_us: int) -> str:
        if sender != agent_name(message.agent):
            return IDENTITY
        if message.agent not in self._verifiers:
            return UNKNOWN_PEER
        begins_us = max(trajectory.t0_utc_us for trajectory in message.trajectories)
        return FUTURE if begins_us > utc_us + MAX_BEGIN_US else ""
