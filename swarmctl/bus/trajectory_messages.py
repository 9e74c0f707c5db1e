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
from swarmctl.bus.senders import Attendance, Said, Speaker
from swarmctl.bus.topics import INTENT
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Intent, Proposal
from swarmctl.core.types import Array

INTENT_VERSION = 2
MAX_POINTS = 2000
MAX_STEP_US = 500_000
MAX_BEGIN_US = 10_000_000  # from now: what begins later is of another clock
MAX_ACKNOWLEDGED = 256
_MAGIC = b"SI"
_HEADER = struct.Struct("<2sBBIIIqH2x")  # magic version flags agent boot seq said acknowledgements
_PROPOSES, _PROMISED = 1, 2
_PROPOSAL = struct.Struct("<Qq")  # number, time it was made
_TRAJECTORY = struct.Struct("<qiH2x")
_HEARD = struct.Struct("<IQ")

Memory = dict[bytes, Trajectory]  # trajectories by their bytes


def encode_intent(intent: Intent) -> bytes:
    """Bytes of one message."""
    parts = [
        _HEADER.pack(
            _MAGIC,
            INTENT_VERSION,
            _PROPOSES * (intent.proposal is not None) | _PROMISED * intent.promised,
            intent.agent,
            intent.boot_id,
            intent.seq,
            intent.said_utc_us,
            len(intent.heard),
        ),
        _encode_trajectory(intent.committed),
    ]
    if intent.proposal is not None:
        parts.append(_PROPOSAL.pack(intent.proposal.number, intent.proposal.made_utc_us))
        parts.append(_encode_trajectory(intent.proposal.trajectory))
    parts += [_HEARD.pack(agent, number) for agent, number in sorted(intent.heard.items())]
    return b"".join(parts)


def decode_intent(payload: bytes, memory: Memory | None = None) -> Intent | None:
    """The message; None unless magic, version, lengths and every number are good.

    `memory` holds the trajectories of the message before: one that is said again is the same object again.
    """
    try:
        magic, version, flags, agent, boot_id, seq, said_utc_us, count = _HEADER.unpack_from(payload)
        if magic != _MAGIC or version != INTENT_VERSION or flags > 3 or count > MAX_ACKNOWLEDGED:
            return None
        known, said = memory or {}, Memory()
        committed, at = _decode_trajectory(payload, _HEADER.size, known, said)
        proposal = None
        if flags & _PROPOSES:
            number, made_utc_us = _PROPOSAL.unpack_from(payload, at)
            trajectory, at = _decode_trajectory(payload, at + _PROPOSAL.size, known, said)
            proposal = Proposal(number, made_utc_us, agent, trajectory)
        if len(payload) != at + count * _HEARD.size:
            return None
        heard = dict(_HEARD.iter_unpack(payload[at:]))
        if memory is not None:
            memory.clear()
            memory.update(said)
        return Intent(agent, boot_id, seq, said_utc_us, bool(flags & _PROMISED), committed, proposal, heard)
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


class PeerIntents:
    """Newest good intent of every peer, whatever its age: nothing is newer than what it says.

    Args:
        peers: agent numbers that are listened to, without the own one.
        rate_hz, refusals, attendance: see `Speaker`.
    """

    def __init__(self, peers: Iterable[int], rate_hz: float, refusals: Refusals, attendance: Attendance) -> None:
        names = {agent: agent_name(agent) for agent in peers}
        self._speakers = {a: Speaker(name, INTENT.name, rate_hz, refusals, attendance) for a, name in names.items()}
        self._refusals = refusals
        self._memory: dict[str, Memory] = {}
        self.newest: dict[int, Intent] = {}

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Judge one message; `sender` is the name the bus vouches for, `utc_us` now."""
        memory = dict(self._memory.get(sender, {}))
        intent = decode_intent(payload, memory)
        if intent is None or (reason := self._refusal(sender, intent, utc_us)):
            self._refusals.add(sender, INTENT.name, MALFORMED if intent is None else reason, utc_us)
            return
        said = Said(intent.boot_id, intent.seq, min(intent.said_utc_us, utc_us + MAX_LEAD_US), payload)
        if self._speakers[intent.agent].believes(said, utc_us):
            self.newest[intent.agent], self._memory[sender] = intent, memory

    def heard(self) -> dict[int, int]:
        """Number of the proposal that each peer is known to make now."""
        return {agent: i.proposal.number for agent, i in self.newest.items() if i.proposal is not None}

    def _refusal(self, sender: str, intent: Intent, utc_us: int) -> str:
        if sender != agent_name(intent.agent):
            return IDENTITY
        if intent.agent not in self._speakers:
            return UNKNOWN_PEER
        begins_us = max(trajectory.t0_utc_us for trajectory in intent.trajectories)
        return FUTURE if begins_us > utc_us + MAX_BEGIN_US else ""
