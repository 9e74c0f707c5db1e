"""Messages of `swarmctl.control.commit`: bytes of one intent, and the newest good one of every peer.

Layout, little-endian: a header; the committed trajectory; a proposal, if any; acknowledgements (agent, number). A
trajectory is t0, step, count, then positions and velocities as float32.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable

import numpy as np

from swarmctl.core.intent import Intent, Proposal
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.types import Array
from swarmctl.links.peers import agent_name

INTENT_VERSION = 1
MAX_POINTS = 2000
MAX_STEP_US = 500_000
RESTART_US = 5_000_000  # of silence, after which an earlier boot id is a restart under another clock
MAX_LEAD_US = 10_000_000  # what begins later is of another clock
MAX_ACKNOWLEDGED = 256
_MAGIC = b"SI"
_HEADER = struct.Struct("<2sBBIIIH2x")  # magic version flags agent boot seq acknowledgements
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
        magic, version, flags, agent, boot_id, seq, count = _HEADER.unpack_from(payload)
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
        return Intent(agent, boot_id, seq, bool(flags & _PROMISED), committed, proposal, heard)
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
    """

    def __init__(self, peers: Iterable[int]) -> None:
        self._expected = frozenset(peers)
        self._memory = {agent_name(agent): Memory() for agent in self._expected}
        self._heard_us: dict[int, int] = {}  # when the newest came
        self.newest: dict[int, Intent] = {}
        self.rejected: Counter[str] = Counter()

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Judge one message; `sender` is the name the bus vouches for, `utc_us` now."""
        intent = decode_intent(payload, self._memory.get(sender))
        if intent is None:
            self.rejected["malformed"] += 1
        elif sender != agent_name(intent.agent):
            self.rejected["identity"] += 1
        elif intent.agent not in self._expected:
            self.rejected["unknown_peer"] += 1
        elif not self._is_newer(intent, utc_us):
            self.rejected["replayed"] += 1
        elif any(trajectory.t0_utc_us > utc_us + MAX_LEAD_US for trajectory in intent.trajectories):
            self.rejected["future"] += 1
        else:
            self.newest[intent.agent], self._heard_us[intent.agent] = intent, utc_us

    def heard(self) -> dict[int, int]:
        """Number of the proposal that each peer is known to make now."""
        return {agent: i.proposal.number for agent, i in self.newest.items() if i.proposal is not None}

    def _is_newer(self, intent: Intent, utc_us: int) -> bool:
        known = self.newest.get(intent.agent)
        if known is None or intent.boot_id == known.boot_id:
            return known is None or intent.seq > known.seq
        silent_us = utc_us - self._heard_us[intent.agent]
        return intent.boot_id > known.boot_id or silent_us > RESTART_US  # boot ids are start times, but clocks err
