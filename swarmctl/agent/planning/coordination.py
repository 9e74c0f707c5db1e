"""An agent's part in guaranteed separation: receives peers' messages, runs `control.commit`, publishes its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import asdict, replace

import numpy as np

from swarmctl.agent.planning.commitment_publisher import CommitmentPublisher
from swarmctl.agent.planning.commitment_tracking import CommitmentTracking
from swarmctl.agent.planning.non_participants import NonParticipants, most_are_heard
from swarmctl.agent.planning.unanswered_proposals import UnansweredProposals
from swarmctl.agent.sensing.deviations import Deviations
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.peers.trajectories import PeerTrajectories
from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.membership import Membership
from swarmctl.control.commit.protocol import CommitCounts, Commitments
from swarmctl.control.commit.reach import FarPeers
from swarmctl.control.commit.situation import DesiredReference, Situation
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.commit.tube import Grip
from swarmctl.core.trajectory import Times, Trajectory
from swarmctl.core.trajectory_message import Proposal, TrajectoryMessage
from swarmctl.core.types import Array, Phase, VehicleState

_SUSPECT_US = 5_000_000  # without a message, after which a peer is suspected: bursts of loss end sooner
_SILENT_PERIODS, _SILENT_US = 4, 160_000  # so many messages have not come, at the least
_FAR_PERIODS = 2.5  # likewise of a peer of which this agent hears only what it tells those that are far
_GAP_US = 1_000_000  # without a fresh state, after which nothing is committed any more
_FASTER_01 = 1.1  # of the speed at which somebody else flies the vehicle, which may grow until the next message
_SAME_M = 1e-3  # tubes that differ by less are equal: messages round
_CUT_OFF_US = 20_000_000  # at rest without the acknowledgements required, after which the agent lands where it is


class Coordination:
    """Connects the protocol of one agent to the bus, the world model and the events.

    Args:
        agent, boot_id: identity in the own messages.
        peers: numbers of the other agents.
        params: those of `planner`, for its vehicle.
        planner: makes and compares trajectories.
        separation: distances to keep.
        world_model: paths, statuses and presence of peers, and obstacles.
        bus: is drained by `receive`.
        utc_us: the own clock, by which messages arrive.
        rate_hz: tick rate of every agent.
        far_peers: chooses the peers whose acknowledgements can be done without.
        far_hz: how often those are told; 0: nobody is far.
        note: is told `conflicting_commitment` when a peer's committed trajectory comes too close to the own one;
            `membership` when the peers that are suspected, promised to be excluded, or excluded change; `commitments`
            with all counts when the autopilot or a pilot takes over; and what `CommitmentTracking` tells.

    Attributes:
        committed_peers: by agent number, the trajectories that each peer within reach may follow, if it is relied on. A
            silent peer is, too: it rests where its last commitment ends, also when a majority has excluded it.
        lost_peer_keep_outs: keep-outs at the ends of lost peers' committed trajectories.
        cut_off: why the agent has to land where it is: it waits for peers in vain, or they have excluded it; or "".
        alert: what keeps it from committing to anything new, or nearly; or "".
    """

    def __init__(
        self,
        *,
        agent: int,
        boot_id: int,
        peers: list[int],
        params: CommitParams,
        planner: TrajectoryPlanner,
        separation: SeparationParams,
        world_model: WorldModel,
        bus: Bus,
        utc_us: Callable[[], int],
        note: Callable[..., None],
        rate_hz: float,
        far_peers: FarPeers,
        far_hz: float,
    ) -> None:
        self._agent, self._bus, self._world_model, self._utc_us = agent, bus, world_model, utc_us
        self._commitments = Commitments(agent, params, planner)
        refusals, presence = world_model.refusals, world_model.presence
        self._peer_trajectories = PeerTrajectories(
            peers, rate_hz, refusals, presence, agent=agent, clocks=world_model.clocks
        )
        self._peers = frozenset(peers)
        self._note, self._separation = note, separation
        self._far_peers = far_peers
        self._publisher = CommitmentPublisher(
            agent, boot_id, bus, self._peer_trajectories, far_peers, rate_hz=rate_hz, far_hz=far_hz
        )
        self._spared: frozenset[int] = frozenset()  # peers whose acknowledgement of the proposal is not required
        self._hears = self._peers  # every message of these
        self._flown_by_others_m_s = 0.0  # speed at which a pilot or the autopilot flies the vehicle
        self._params = params
        self._non_participants = NonParticipants(world_model, separation, dt_us=planner.dt_us, steps=planner.steps)
        self._is_committed = False
        self._tube_m = separation.budget.tube_m
        self._tracking = CommitmentTracking(self._commitments, self._tube_m, note)
        self._entered_now, self._entered_ahead = Encounters(), Encounters()  # where a plan begins now, or ahead
        self._silent_us = max(_SILENT_US, round(_SILENT_PERIODS * 1e6 / rate_hz))
        self._far_silent_us = round(_FAR_PERIODS * 1e6 / far_hz) if far_hz else self._silent_us
        self._clock_error_max_us = 1e6 * params.clock_error_max_s
        self._membership, self._deviations = Membership(agent, peers), Deviations()
        self._unanswered = UnansweredProposals(agent)
        self._ended: frozenset[int] = frozenset()  # peers that take no part any more, by evidence
        self._membership_said: tuple[frozenset[int], ...] = (frozenset(),) * 3
        self._begun_us: int | None = None
        self._begun_without: frozenset[int] = frozenset()  # peers that had been excused when this agent began
        self._stepped_us = 0  # time of the newest tick in which the agent flew
        self._conflicting: set[int] = set()
        self.committed_peers: Mapping[int, Sequence[Trajectory]] = {}
        self.lost_peer_keep_outs: list[KeepOut] = []
        self.cut_off = self.alert = ""

    @property
    def counts(self) -> CommitCounts:
        """Return the counts of proposals so far."""
        return self._commitments.counts

    @property
    def worst_tracking_m(self) -> float:
        """Return how far the vehicle has been off what it had committed to, at most."""
        return self._tracking.worst_m

    def receive(self, utc_us: int) -> None:
        """Apply rule 1: take in every message that has arrived, and what it says about silent peers."""
        for topic in (topics.FAR_TRAJECTORY, topics.TRAJECTORY):
            messages, arrived_us = self._bus.receive(topic), self._utc_us()  # in this order: none came later
            for sender, payload in messages:
                self._peer_trajectories.offer(sender, payload, arrived_us)
        self._update_membership(utc_us)
        self._attend(utc_us)

    def _attend(self, utc_us: int) -> None:
        """Hear every message of the peers that are not far, and of those to which this agent is not."""
        own, newest = self._commitments.trajectories, self._peer_trajectories.newest
        if not own or not self._far_peers.update(own, newest, utc_us):
            return
        hears = self._far_peers.near | (newest.keys() - self._peer_trajectories.far_from)
        if hears != self._hears:
            self._hears = hears
            self._bus.hear(topics.TRAJECTORY, [agent_name(agent) for agent in sorted(hears)])

    def _update_membership(self, utc_us: int) -> None:
        peers, membership = self._peer_trajectories, self._membership
        self._ended = self._world_model.statuses.ended
        suspected = self._suspected(utc_us)
        # Before the flight; who is started again knows of nobody so.
        excused = self._world_model.statuses.excused if self._begun_us is None else self._begun_without
        came = self._peers - excused
        membership.update(suspected, peers.exclusions, self._ended, votes=peers.heard_before_flight >= came)
        said = (membership.exclusions.suspected, membership.exclusions.promised, membership.excluded)
        if said != self._membership_said:
            self._membership_said = said
            suspected_, promised, excluded = (sorted(agents) for agents in said)
            self._note("membership", suspected=suspected_, promised=promised, excluded=excluded)

    def _suspected(self, utc_us: int) -> set[int]:
        """Return the peers that have not been heard for long; before anybody flies nobody is, as all wait for all."""
        messages = self._peer_trajectories.newest.values()
        if self._begun_us is None and not any(message.is_committed for message in messages):
            return set()
        return self._peer_trajectories.silent(self._peers - self._ended, utc_us, _SUSPECT_US)

    def step(
        self,
        utc_us: int,
        state: VehicleState,
        phase: Phase,
        desired: DesiredReference,
        *,
        state_utc_us: int,
        disturbance_ned_m_s2: Array,
    ) -> None:
        """Apply rules 2 to 4 while this agent flies.

        Args:
            utc_us: now.
            state, phase: own vehicle and mission.
            desired: motion that the agent would follow if it were alone.
            state_utc_us: when the vehicle was in that state, by which it is compared with what it flies.
            disturbance_ned_m_s2: (3,) estimated acceleration by wind.
        """
        commitments = self._commitments
        if not self._is_committed:
            self._is_committed, self._flown_by_others_m_s = True, 0.0
            if self._begun_us is None:
                self._begun_without = self._world_model.statuses.excused
            self._begun_us = utc_us
            commitments.begin(state.pos_ned_m, state.vel_ned_m_s, state_utc_us)
        since_us, self._stepped_us = utc_us - self._stepped_us, utc_us
        self._tracking.watch(utc_us, since_us, state, state_utc_us)
        required, newest = self._required_peers(), self._peer_trajectories.newest
        known = self._near_messages()
        asked, near = required - self._still_spared(utc_us), self._far_peers.near
        self.cut_off = self._why_cut_off(utc_us, asked & near if commitments.proposal is None else asked)
        self._unanswered.update(commitments.proposal, asked, newest)
        if commitments.proposal is not None:
            compared = {agent: message for agent, message in newest.items() if agent not in self._spared}
            commitments.update(utc_us, compared, asked)
        relied_on = self._relied_on(utc_us, known, required)
        begin_us = utc_us + commitments.lead_us
        now = Situation(
            utc_us=utc_us,
            begin_us=utc_us,
            desired=self._tracking.paced(desired, begin_us),
            peers={agent: known[agent] for agent in relied_on},
            others=self._other_keep_outs(utc_us, state, phase, relied_on, self._entered_now),
            disturbance_ned_m_s2=disturbance_ned_m_s2,
        )
        commitments.evade(now)
        self._evade_silent(replace(now, peers=known), relied_on)
        unsure = {a for a in required & near if self._world_model.clocks.error_us(a) > self._clock_error_max_us}
        self.alert = self._why_slow(unsure, utc_us)
        if commitments.is_due(utc_us) and self._tracking.grip < Grip.STOPPED and not unsure:
            heard = (relied_on & required) - self._absent()
            others = self._other_keep_outs(begin_us, state, phase, heard, self._entered_ahead)
            commitments.propose(replace(now, begin_us=begin_us, peers=known, others=others))
            self._spare(utc_us)
            left_out = [agent for agent in newest if agent not in known and agent not in self._spared]
            commitments.keep_clear_of({agent: newest[agent] for agent in left_out}, utc_us)

    def _near_messages(self) -> Mapping[int, TrajectoryMessage]:
        """Return the newest messages of the peers that are not far, to which alone trajectories can come close."""
        newest, near = self._peer_trajectories.newest, self._far_peers.near
        if len(near) == len(self._peers):
            return newest
        return {agent: message for agent, message in newest.items() if agent in near}

    def _spare(self, utc_us: int) -> None:
        """Choose the peers whose acknowledgement of a new proposal is not required."""
        proposal, peers = self._commitments.proposal, self._peer_trajectories
        self._spared = frozenset()
        if proposal is not None:
            self._spared = self._far_peers.spared(
                proposal.trajectory, peers.newest, peers.confirmed_us, utc_us, self._membership.excluded
            )
            self._ask_far(proposal)

    def _still_spared(self, utc_us: int) -> frozenset[int]:
        """Return the peers whose acknowledgement of the proposal is not required, by what they have said since."""
        proposal, newest = self._commitments.proposal, self._peer_trajectories.newest
        if proposal is None:
            self._spared = frozenset()
        elif self._spared:
            self._spared = self._far_peers.still_spared(self._spared, proposal.trajectory, newest, utc_us)
            self._ask_far(proposal)
        return self._spared

    def _ask_far(self, proposal: Proposal) -> None:
        """Mark a proposal whose acknowledgement is required of a far peer."""
        if not proposal.asks_far and not self._required_peers() - self._far_peers.near <= self._spared:
            self._commitments.proposal = replace(proposal, asks_far=True)

    def _relied_on(self, utc_us: int, known: Mapping[int, TrajectoryMessage], required: Set[int]) -> Set[int]:
        """Return the peers whose commitments are relied on, and remember where lost ones end.

        Silence alone is no reason to doubt a commitment: a peer that is merely cut off relies on the own one. What its
        autopilot may do instead is kept clear of by what is newly planned, and by evasions that are clear of all
        commitments, too (see `step`).
        """
        conflicting = self._commitments.conflicting_peers(utc_us, known)
        if conflicting != self._conflicting:
            self._conflicting = conflicting
            self._note("conflicting_commitment", by=sorted(conflicting))
        deviating = self._deviations.deviating(self._world_model.paths.latest(), known, utc_us, self._tube_m)
        deviating |= {agent for agent, message in known.items() if message.tube_m > self._tube_m + _SAME_M}
        committed = {agent for agent, message in known.items() if message.is_committed}
        lost_peers = [agent for agent in known.keys() - required if agent in committed]
        ends = self._non_participants.ends
        self.lost_peer_keep_outs = [keep_out for agent in lost_peers for keep_out in ends(known[agent])]
        relied_on = (required | self._membership.excluded - self._ended) & committed - conflicting - deviating
        self.committed_peers = {a: known[a].followed for a in relied_on if self._world_model.paths.is_near(a)}
        return relied_on

    def wait(self, utc_us: int, state: VehicleState | None) -> None:
        """Keep what is committed while the state is stale for a moment; longer is `idle`.

        The vehicle flies on: to commit anew at speed after each gap would surprise peers. Whether it has stayed in its
        tube is seen with the next state.
        """
        if not self._is_committed or utc_us - self._stepped_us > _GAP_US:
            self.idle(utc_us, state)

    def idle(self, utc_us: int, state: VehicleState | None) -> None:
        """Commit nothing while a pilot or the autopilot flies; peers are still acknowledged."""
        if self._is_committed:
            self._is_committed = False
            self.committed_peers, self.lost_peer_keep_outs, self.cut_off, self.alert = {}, [], "", ""
            self._note("commitments", **asdict(self.counts), worst_tracking_m=self.worst_tracking_m)
        self._commitments.end(None if state is None else state.pos_ned_m, utc_us)
        speed_m_s = math.inf if state is None else float(np.linalg.norm(state.vel_ned_m_s))
        self._flown_by_others_m_s = _FASTER_01 * speed_m_s

    def sample_committed(self, t_utc_us: Times) -> tuple[Array, Array]:
        """Return the positions and velocities, (M, 3) NED each, to fly at times (M,)."""
        assert self._commitments.flown is not None
        return self._commitments.flown.sample(t_utc_us)

    def publish(self, utc_us: int, *, unsure_m: float, relays: bool) -> None:
        """Apply rule 5: publish the own message, once there is a committed trajectory.

        Args:
            utc_us: now.
            relays: pass on what peers lack of each other.
            unsure_m: by how much more the vehicle may be away from its estimate than distances leave room for. Peers
                keep it from its path already; they do so while it may be outside its tube.
        """
        commitments, exclusions = self._commitments, self._membership.exclusions
        committed, proposal = commitments.committed, commitments.proposal
        if committed is None:
            return
        self._publisher.publish(
            utc_us,
            is_committed=self._is_committed,
            committed=committed,
            proposal=proposal,
            tube_m=self._tracking.told_m(unsure_m),
            exclusions=exclusions,
            reach=self._far_peers.reach(
                commitments.trajectories,
                away_m=commitments.late_m(utc_us),
                speed_m_s=self._flown_by_others_m_s,
                stops_m=self._params.stop_m(self._flown_by_others_m_s),
            ),
            refused=self._ended | exclusions.promised,
        )
        if relays:
            self._publisher.relay(utc_us)

    @property
    def is_held(self) -> bool:
        """Return whether the vehicle is within the tube around what it has committed to."""
        return self._is_committed and self._tracking.grip is Grip.HELD

    @property
    def margin_m(self) -> float:
        """Return by how much the own tube is wider than distances leave room for."""
        return self._tracking.margin_m

    def _required_peers(self) -> frozenset[int]:
        """Return peers that fly by commitments and have to acknowledge what they are not spared.

        One that was excluded while this agent was far from it may have committed to something unseen. One without which
        the swarm began, and which has come since, may have no vehicle: until it says what it is committed to it can
        acknowledge nothing, nor commit to anything, for which it needs the acknowledgement of this agent.
        """
        excluded = self._membership.excluded - self._peer_trajectories.far_from
        absent = self._begun_without - self._peer_trajectories.newest.keys()
        return self._peers - excluded - absent - self._ended - self._world_model.statuses.uncommitted

    def _absent(self) -> set[int]:
        """Return peers whose liveliness token is not on the bus."""
        alive = self._bus.alive()
        return {agent for agent in self._peers if agent_name(agent) not in alive}

    def _why_slow(self, unsure: Set[int], utc_us: int) -> str:
        if self._tracking.grip > Grip.OUTSIDE:
            return f"blown off what it had committed to: {self._tracking.grip.name.lower()}"
        if unsure:
            return f"the clock of {_names(unsure)} is not known well enough"
        deaf = self._unanswered.by(utc_us) - self._peer_trajectories.silent(self._peers, utc_us, _SUSPECT_US)
        return f"{_names(deaf)} answers no proposal, and may take it for ended" if deaf else ""

    def _why_cut_off(self, utc_us: int, required: Set[int]) -> str:
        if self._tracking.grip is Grip.LOST:
            return "it can't hold what it commits to"
        if by := self._membership.excluded_by:
            return f"excluded by {_names(by)} after silence"
        begun_us = utc_us if self._begun_us is None else self._begun_us
        silence_us = self._peer_trajectories.silence_us
        silent = [a for a in required if min(silence_us(a, utc_us), utc_us - begun_us) > _CUT_OFF_US]
        return f"cut off from {_names(silent)}" if silent else ""

    def _other_keep_outs(
        self, t0_utc_us: int, state: VehicleState, phase: Phase, without: Set[int], encounters: Encounters
    ) -> KeepOuts:
        """Return keep-outs of obstacles and of peers but those in `without`, for a plan that begins at `t0_utc_us`."""
        assert self._commitments.flown is not None
        begin_ned_m = np.array(self._commitments.flown.at(t0_utc_us)[0])
        return self._non_participants.keep_outs(
            t0_utc_us, state.pos_ned_m, begin_ned_m, phase, without=without, encounters=encounters
        )

    def _evade_silent(self, now: Situation, relied_on: Set[int]) -> None:
        """Evade where vehicles of silent peers may be, or stop before the one of the only peer.

        Args:
            now: its peers are all that are near: nothing is evaded to what conflicts with the proposal of any.
            relied_on: those that fly as they have committed to.
        """
        everybody = self._peers - self._ended
        near = self._far_peers.near & everybody
        silent = self._peer_trajectories.silent(near, now.utc_us, self._silent_us)
        doubted = self._non_participants.without_setpoints(silent & relied_on, now.utc_us)
        if not doubted:
            return
        silent |= self._peer_trajectories.silent(everybody - near, now.utc_us, self._far_silent_us)
        if most_are_heard(silent, everybody):
            self._commitments.evade_doubted(now, doubted)
        elif not self._membership.may_be_excluded:
            self._commitments.stop_before(now, doubted, leaves=self._agent < min(self._peers))


def _names(agents: Iterable[int]) -> str:
    return ", ".join(map(agent_name, sorted(agents)))
