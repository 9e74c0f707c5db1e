"""The newest trajectory message of every peer, by which agents commit; `PeerPaths` are its twin in best effort."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Set
from itertools import takewhile

from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.commitment_messages import Memory, decode_trajectory_message
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.bus.peers.paths import MAX_LEAD_US, peer_verifiers
from swarmctl.bus.peers.senders import Presence, ReceivedMessage
from swarmctl.bus.refusals import FUTURE, IDENTITY, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.bus.topics import TRAJECTORY
from swarmctl.core.trajectory_message import Exclusions, TrajectoryMessage

MAX_BEGIN_US = 10_000_000  # from now; a trajectory that begins later comes from another clock
MAX_CLOCK_ERROR_US = 10_000_000  # a clock known less well is known as badly; nothing is committed then
_STAMPS = 64  # of messages of each peer that are kept; more than relays wait
_BETTER_01, _WORSE_01 = 0.5, 1.5  # shares of the error of a clock at which trajectories are decoded anew


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
        self._stamps_us: dict[int, deque[int]] = {}  # of the last messages of each peer, oldest first
        self.peer_count = len(self._verifiers)  # heard or not
        self.newest: dict[int, TrajectoryMessage] = {}
        self.telling: dict[int, TrajectoryMessage] = {}  # the newest of each peer that says what it has heard
        self.exclusions: dict[int, Exclusions] = {}  # of the newest message of each peer
        self.far_from: set[int] = set()  # peers to which this agent is far, by their newest message
        self.received_utc_us: dict[int, int] = {}  # when the newest message of each peer was accepted
        self.confirmed_us: dict[int, int] = {}  # stamp of the newest own message that each peer says to have heard
        self.heard_before_flight: set[int] = set()  # peers that did not fly by commitments when first heard

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Check one message and keep it if it is accepted; the bus guarantees the name `sender`, `utc_us` is now."""
        number = self._numbers.get(sender, -1)
        memory, ahead_us = dict(self._memory.get(sender, {})), self._clocks.ahead_us(number)
        error_us = self._clock_error_us(number) if number in self._verifiers else 0
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
            self.exclusions[message.agent] = message.exclusions
            (self.far_from.add if self._agent in message.reach.far else self.far_from.discard)(message.agent)
            if message.heard or message.agent not in self.telling:
                self.telling[message.agent] = message
            self.received_utc_us[message.agent] = utc_us
            self._stamps_us.setdefault(message.agent, deque(maxlen=_STAMPS)).append(message.sent_utc_us)
            self._measure(message, utc_us)
            share_01 = self._clock_error_us(message.agent) / max(1, self._used_error_us.get(sender, error_us))
            if self._clocks.ahead_us(message.agent) != ahead_us or not _BETTER_01 <= share_01 <= _WORSE_01:
                self._memory[sender] = {}
                self._used_error_us.pop(sender, None)
            else:
                self._used_error_us.setdefault(sender, error_us)

    def lacked_us(self, message: TrajectoryMessage, agent: int, stamp_us: int) -> int:
        """Return for how long the sender of a message had lacked, when it sent it, what a peer sent after a stamp.

        Both times are by the own clock. Of a peer's messages only the last ones are remembered: older ones count as if
        they had been sent with the oldest of those.

        Args:
            message: says what its sender has heard.
            agent: the peer, whose newest message is later than the stamp.
            stamp_us: of the newest message of the peer that the sender has heard.
        """
        later_us = takewhile(lambda stamp: stamp > stamp_us, reversed(self._stamps_us[agent]))  # the newest first
        *_, first_us = later_us
        said_us = message.sent_utc_us - self._clocks.ahead_us(message.agent)
        return said_us - (first_us - self._clocks.ahead_us(agent))

    def silence_us(self, agent: int, utc_us: int) -> int:
        """Return the time since the newest message of a peer; 0 for one that has never been heard."""
        return utc_us - self.received_utc_us.get(agent, utc_us)

    def silent(self, agents: Set[int], utc_us: int, longer_than_us: int) -> set[int]:
        """Return those of some peers that have been silent for longer than that."""
        if utc_us - min(self.received_utc_us.values(), default=utc_us) <= longer_than_us:
            return set()  # as nearly always
        return {agent for agent in agents if self.silence_us(agent, utc_us) > longer_than_us}

    def heard(self, peers: Iterable[int]) -> dict[int, tuple[int, int]]:
        """Return stamp and arrival of the newest message of some peers that were heard."""
        newest, received_us = self.newest, self.received_utc_us
        return {agent: (newest[agent].sent_utc_us, received_us[agent]) for agent in peers}

    def _measure(self, message: TrajectoryMessage, utc_us: int) -> None:
        self._clocks.received(message.agent, message.sent_utc_us, utc_us)
        if (times := message.heard.get(self._agent)) is not None:
            stamp_us, arrival_us = times
            self._clocks.answered(message.agent, stamp_us, arrival_us, utc_us)
            self.confirmed_us[message.agent] = max(stamp_us, self.confirmed_us.get(message.agent, 0))

    def _clock_error_us(self, agent: int) -> int:
        return min(self._clocks.error_us(agent), MAX_CLOCK_ERROR_US)

    def _refusal(self, sender: str, message: TrajectoryMessage, utc_us: int) -> str:
        if sender != agent_name(message.agent):
            return IDENTITY
        if message.agent not in self._verifiers:
            return UNKNOWN_PEER
        begins_us = message.committed.t0_utc_us
        if message.proposal is not None:
            begins_us = max(begins_us, message.proposal.trajectory.t0_utc_us)
        return FUTURE if begins_us > utc_us + MAX_BEGIN_US else ""
