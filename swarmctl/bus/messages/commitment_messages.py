"""Trajectory messages of `swarmctl.control.commit.protocol`: their encoding, and the newest one of every peer.

The layout is little-endian: a header, the committed trajectory, a proposal if there is one, acknowledgements (agent,
number), what was heard (agent, stamp, arrival), and the numbers of agents that are suspected, then of those to be
excluded. A trajectory is t0, step and count, then positions and velocities as float32.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np

from swarmctl.bus.bus import agent_name
from swarmctl.bus.peer_clocks import PeerClocks
from swarmctl.bus.peers import MAX_LEAD_US, peer_verifiers
from swarmctl.bus.refusals import FUTURE, IDENTITY, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.bus.senders import Presence, ReceivedMessage
from swarmctl.bus.topics import TRAJECTORY
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, Proposal, TrajectoryMessage
from swarmctl.core.types import Array

TRAJECTORY_VERSION = 4
MAX_TUBE_M = 100.0
MAX_POINTS = 2000
MAX_STEP_US = 500_000
MAX_BEGIN_US = 10_000_000  # from now; a trajectory that begins later comes from another clock
MAX_CLOCK_ERROR_US = 10_000_000  # a clock known less well is known as badly; nothing is committed then
_BETTER_01 = 0.5  # share of the error of a clock at which trajectories are decoded anew
MAX_PEERS = 256  # of each kind: acknowledged, heard, suspected, promised
_MAGIC = b"SI"
_HEADER = struct.Struct("<2sBBIIIqfHHHH")  # magic version flags agent boot seq sent tube, counts of the four kinds
_HAS_PROPOSAL, _IS_COMMITTED = 1, 2
_PROPOSAL = struct.Struct("<Qq")  # number, time of proposal
_TRAJECTORY = struct.Struct("<qiH2x")
_ACKNOWLEDGEMENT = struct.Struct("<IQ")
_HEARD = struct.Struct("<Iqq")
_AGENT = struct.Struct("<I")

Memory = dict[bytes, Trajectory]  # decoded trajectories by their bytes


def encode_trajectory_message(message: TrajectoryMessage) -> bytes:
    """Encode one message."""
    parts = [
        _HEADER.pack(
            _MAGIC,
            TRAJECTORY_VERSION,
            _HAS_PROPOSAL * (message.proposal is not None) | _IS_COMMITTED * message.is_committed,
            message.agent,
            message.boot_id,
            message.seq,
            message.sent_utc_us,
            message.tube_m,
            len(message.acknowledged),
            len(message.heard),
            len(message.exclusions.suspected),
            len(message.exclusions.promised),
        ),
        _encode_trajectory(message.committed),
    ]
    if message.proposal is not None:
        parts.append(_PROPOSAL.pack(message.proposal.number, message.proposal.made_utc_us))
        parts.append(_encode_trajectory(message.proposal.trajectory))
    parts += [_ACKNOWLEDGEMENT.pack(agent, number) for agent, number in sorted(message.acknowledged.items())]
    parts += [_HEARD.pack(agent, *stamps) for agent, stamps in sorted(message.heard.items())]
    for agents in (message.exclusions.suspected, message.exclusions.promised):
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
    try:
        magic, version, flags, agent, boot_id, seq, sent_utc_us, tube_m, *counts = _HEADER.unpack_from(payload)
        if magic != _MAGIC or version != TRAJECTORY_VERSION or flags > 3 or max(counts) > MAX_PEERS:
            return None
        if not 0.0 <= tube_m <= MAX_TUBE_M:
            return None
        acknowledgements, heard, suspected, promised = counts
        known, sent = memory or {}, Memory()
        clock = (ahead_us, error_us)
        committed, at = _decode_trajectory(payload, _HEADER.size, known, sent, clock)
        proposal = None
        if flags & _HAS_PROPOSAL:
            number, made_utc_us = _PROPOSAL.unpack_from(payload, at)
            trajectory, at = _decode_trajectory(payload, at + _PROPOSAL.size, known, sent, clock)
            proposal = Proposal(number=number, made_utc_us=made_utc_us, agent=agent, trajectory=trajectory)
        heard_at = at + acknowledgements * _ACKNOWLEDGEMENT.size
        agents_at = heard_at + heard * _HEARD.size
        if len(payload) != agents_at + (suspected + promised) * _AGENT.size:
            return None
        acknowledged = dict(_ACKNOWLEDGEMENT.iter_unpack(payload[at:heard_at]))
        agents = [number for (number,) in _AGENT.iter_unpack(payload[agents_at:])]
        exclusions = Exclusions(suspected=frozenset(agents[:suspected]), promised=frozenset(agents[suspected:]))
        if memory is not None:
            memory.clear()
            memory.update(sent)
        return TrajectoryMessage(
            agent=agent,
            boot_id=boot_id,
            seq=seq,
            sent_utc_us=sent_utc_us,
            is_committed=bool(flags & _IS_COMMITTED),
            committed=committed,
            tube_m=tube_m,
            proposal=proposal,
            acknowledged=acknowledged,
            exclusions=exclusions,
            heard={a: (sent_, at_) for a, sent_, at_ in _HEARD.iter_unpack(payload[heard_at:agents_at])},
        )
    except (struct.error, ValueError):
        return None


def _encode_trajectory(trajectory: Trajectory) -> bytes:
    points = np.hstack([trajectory.pos_ned_m, trajectory.vel_ned_m_s]).astype("<f4")
    return _TRAJECTORY.pack(trajectory.t0_utc_us, trajectory.dt_us, len(points)) + points.tobytes()


def _decode_trajectory(
    payload: bytes, at: int, known: Memory, sent: Memory, clock: tuple[int, int]
) -> tuple[Trajectory, int]:
    """Return the trajectory encoded at offset `at`, and the offset of its end.

    Args:
        payload, at: bytes of a message.
        known, sent: trajectories of the previous message, and of this one.
        clock: how far the sender's is ahead, and the error of that [us].

    Raises:
        ValueError, struct.error: the bytes are no trajectory.
    """
    t0_utc_us, dt_us, count = _TRAJECTORY.unpack_from(payload, at)
    end = at + _TRAJECTORY.size + 24 * count
    body = payload[at:end]
    if body in known:
        sent[body] = known[body]
        return sent[body], end
    at += _TRAJECTORY.size
    if not 2 <= count <= MAX_POINTS or not 0 < dt_us <= MAX_STEP_US or len(payload) < at + 24 * count:
        raise ValueError("no trajectory")
    points: Array = np.frombuffer(payload, "<f4", 6 * count, at).reshape(count, 6).astype(np.float64)
    if not np.isfinite(points).all():
        raise ValueError("not finite")
    ahead_us, error_us = clock
    sent[body] = Trajectory(
        t0_utc_us=t0_utc_us - ahead_us,
        dt_us=dt_us,
        pos_ned_m=points[:, :3].copy(),
        vel_ned_m_s=points[:, 3:].copy(),
        clock_error_us=error_us,
    )
    return sent[body], end


class PeerTrajectories:
    """Keeps the newest valid message of every peer, whatever its age.

    Args:
        peers: numbers of the other agents.
        rate_hz, refusals, presence: see `SenderVerifier`.
        agent: own number, under which peers answer.
        clocks: measured on the messages, by which trajectories are converted to the own clock.
    """

    def __init__(
        self,
        peers: Iterable[int],
        rate_hz: float,
        refusals: Refusals,
        presence: Presence,
        *,
        agent: int,
        clocks: PeerClocks,
    ) -> None:
        self._verifiers = peer_verifiers(peers, TRAJECTORY, rate_hz, refusals, presence=presence)
        self._refusals, self._agent, self._clocks = refusals, agent, clocks
        self._numbers = {agent_name(agent): agent for agent in self._verifiers}
        self._memory: dict[str, Memory] = {}
        self._used_error_us: dict[str, int] = {}  # of the clock of each peer, since its trajectories were decoded anew
        self.newest: dict[int, TrajectoryMessage] = {}
        self.received_utc_us: dict[int, int] = {}  # when the newest message of each peer was accepted
        self.heard_before_flight: set[int] = set()  # peers that did not fly by commitments when first heard

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Check one message and keep it if it is accepted; the bus guarantees the name `sender`, `utc_us` is now."""
        number = self._numbers.get(sender, -1)
        memory, ahead_us = dict(self._memory.get(sender, {})), self._clocks.ahead_us(number)
        error_us = min(self._clocks.error_us(number), MAX_CLOCK_ERROR_US) if number in self._verifiers else 0
        message = decode_trajectory_message(payload, memory, ahead_us, error_us)
        if message is None or (reason := self._refusal(sender, message, utc_us)):
            self._refusals.add(sender, TRAJECTORY.name, MALFORMED if message is None else reason, utc_us)
            return
        sent = ReceivedMessage(message.boot_id, message.seq, min(message.sent_utc_us, utc_us + MAX_LEAD_US), payload)
        verifier = self._verifiers[message.agent]
        if verifier.is_past(sent):
            return  # a relay, or the sender itself, was slower than another way
        if verifier.accepts(sent, utc_us):
            if message.agent not in self.newest and not message.is_committed:
                self.heard_before_flight.add(message.agent)
            self.newest[message.agent], self._memory[sender] = message, memory
            self.received_utc_us[message.agent] = utc_us
            self._measure(message, utc_us)
            is_better = self._clocks.error_us(message.agent) < _BETTER_01 * self._used_error_us.get(sender, error_us)
            if self._clocks.ahead_us(message.agent) != ahead_us or is_better:
                self._memory[sender] = {}
                self._used_error_us.pop(sender, None)
            else:
                self._used_error_us.setdefault(sender, error_us)

    def heard(self) -> dict[int, tuple[int, int]]:
        """Return stamp and arrival of the newest message of each peer."""
        return {agent: (i.sent_utc_us, self.received_utc_us[agent]) for agent, i in self.newest.items()}

    def _measure(self, message: TrajectoryMessage, utc_us: int) -> None:
        self._clocks.received(message.agent, message.sent_utc_us, utc_us)
        if self._agent in message.heard:
            self._clocks.answered(message.agent, *message.heard[self._agent], utc_us)

    def _refusal(self, sender: str, message: TrajectoryMessage, utc_us: int) -> str:
        if sender != agent_name(message.agent):
            return IDENTITY
        if message.agent not in self._verifiers:
            return UNKNOWN_PEER
        begins_us = max(trajectory.t0_utc_us for trajectory in message.trajectories)
        return FUTURE if begins_us > utc_us + MAX_BEGIN_US else ""
