"""Publishes an agent's trajectory messages, and passes on what peers lack of each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

from swarmctl.bus import topics
from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.commitment_messages import encode_trajectory_message
from swarmctl.bus.peers.trajectories import PeerTrajectories
from swarmctl.bus.relay import missed_by_peers
from swarmctl.control.commit.protocol import acknowledgements
from swarmctl.control.commit.reach import FarPeers
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, Proposal, Reach, TrajectoryMessage

_NOWHERE = Reach(speed_m_s=0.0, stretch_m=0.0)
_ANSWERS_US = 35_000  # acknowledgements alone wait for others so long
_HEARD_US = 75_000  # how often it is said what was heard
_HALVED_US = 250_000  # at most between messages to all, so that a lease lasts longer than one of them that is lost
_UNTOLD_M = 0.2  # by which the stretch may grow before all are told


class CommitmentPublisher:
    """Applies rule 5 of `swarmctl.control.commit.protocol`.

    Where nobody is far, each tick has a message that says everything. Otherwise most messages are for those that are
    not: they say nothing that concerns the others, and seldom what was heard. Some go to all, and say everything.

    Args:
        agent, boot_id: identity in the messages.
        bus: carries them.
        peers: what was heard.
        far_peers: told what has been published.
        rate_hz: tick rate of every agent.
        far_hz: rate of messages to all; 0: all hear every message.
    """

    def __init__(
        self,
        agent: int,
        boot_id: int,
        bus: Bus,
        peers: PeerTrajectories,
        far_peers: FarPeers,
        *,
        rate_hz: float,
        far_hz: float,
    ) -> None:
        self._agent, self._boot_id, self._bus, self._peers, self._far_peers = agent, boot_id, bus, peers, far_peers
        self._period_us = round(1e6 / rate_hz)
        self._far_us = round(1e6 / far_hz) if far_hz else 0
        self._seq, self._due_us, self._sent_us, self._heard_us = 0, 0, 0, 0
        self._half = 0  # of those that are far, by number, which the last message to all has mentioned
        self._news: tuple[object, ...] = (None, None)  # what the last message said that those who hear all wait for
        self._told_reach, self._told_exclusions = _NOWHERE, Exclusions()  # as all know
        self._last_heard: dict[int, tuple[int, int]] = {}  # of those that are promised to be excluded, until then
        self._asked = 0  # number of the newest proposal that all have been asked to acknowledge

    def publish(
        self,
        utc_us: int,
        *,
        is_committed: bool,
        committed: Trajectory,
        proposal: Proposal | None,
        tube_m: float,
        exclusions: Exclusions,
        reach: Reach,
        refused: Set[int],
    ) -> None:
        """Publish one message.

        Args:
            utc_us: now.
            is_committed, committed, proposal, tube_m, exclusions, reach: see `TrajectoryMessage`.
            refused: peers that get no acknowledgement.
        """
        for_all = self._is_for_all(utc_us, reach, exclusions, proposal)
        news = (committed, proposal, is_committed, round(tube_m, 2))
        is_new = news[0] is not self._news[0] or news[1] is not self._news[1] or news[2:] != self._news[2:]
        if not (for_all or is_new or utc_us >= self._sent_us + _ANSWERS_US):
            return
        newest = self._peers.newest
        unheard = self._peers.far_from & reach.far
        attentive = [agent for agent in newest if agent not in unheard]
        asking = {agent: newest[agent] for agent in attentive}
        if for_all:
            asking |= {
                agent: message
                for agent, message in newest.items()
                if message.proposal is not None and message.proposal.asks_far
            }
        acknowledged = acknowledgements(asking, refused)
        if not (for_all or is_committed or acknowledged):
            return  # who waits on the ground has nothing to say to anybody in particular
        self._seq += 1
        message = TrajectoryMessage(
            agent=self._agent,
            boot_id=self._boot_id,
            seq=self._seq,
            sent_utc_us=utc_us,
            is_committed=is_committed,
            committed=committed,
            tube_m=tube_m,
            proposal=proposal,
            acknowledged=acknowledged,
            exclusions=exclusions,
            heard=self._frozen(self._heard(utc_us, attentive, reach, for_all=for_all), exclusions.promised),
            reach=reach,
        )
        payload = encode_trajectory_message(message)
        self._sent_us, self._news = utc_us, news
        self._far_peers.published(reach, utc_us, for_all=for_all)
        if for_all and self._far_us:
            self._bus.publish(topics.FAR_TRAJECTORY, payload)
        self._bus.publish(topics.TRAJECTORY, payload)

    def _heard(
        self, utc_us: int, attentive: Sequence[int], reach: Reach, *, for_all: bool
    ) -> Mapping[int, tuple[int, int]]:
        """Return what the message says about what was heard: half of the far in turns, or all if messages are few."""
        if not self._far_us:
            return self._peers.heard(attentive)
        if not for_all and utc_us < self._heard_us + _HEARD_US:
            return {}
        self._heard_us = utc_us
        if for_all:
            self._half = 1 - self._half
            is_rare = self._far_us > _HALVED_US
            far = [a for a in self._peers.newest if a in reach.far and (is_rare or a % 2 == self._half)]
            attentive = list({*attentive, *far})
        return self._peers.heard(attentive)

    def _frozen(self, heard: Mapping[int, tuple[int, int]], promised: Set[int]) -> Mapping[int, tuple[int, int]]:
        """Return the same, but nothing later of who is promised to be excluded: its lease has to end."""
        if not self._far_us:
            return heard  # nobody is far: there are no leases
        late = {agent: self._last_heard.setdefault(agent, heard[agent]) for agent in promised & heard.keys()}
        return {**heard, **late} if late else heard

    def relay(self, utc_us: int) -> None:
        """Pass on what peers lack of each other."""
        peers = self._peers
        missed = missed_by_peers(
            self._agent,
            peers.newest,
            peers.telling,
            peers.received_utc_us,
            utc_us,
            peer_count=peers.peer_count,
            period_us=self._period_us,
            far_us=self._far_us,
            lacked_us=peers.lacked_us,
        )
        self._bus.relay(missed)

    def _is_for_all(self, utc_us: int, reach: Reach, exclusions: Exclusions, proposal: Proposal | None) -> bool:
        """Return whether all hear this message: it is time, or it differs in what they have to know at once."""
        if not self._far_us:
            return True
        number = proposal.number if proposal is not None and proposal.asks_far else 0
        known = self._told_reach
        is_known = reach.speed_m_s <= known.speed_m_s and reach.stretch_m <= known.stretch_m + _UNTOLD_M
        is_known = is_known and exclusions == self._told_exclusions and number <= self._asked
        if is_known and utc_us < self._due_us:
            return False
        self._told_reach, self._told_exclusions, self._asked = reach, exclusions, max(number, self._asked)
        self._due_us = utc_us + self._far_us
        return True
