"""Guaranteed separation: an agent flies only trajectories that every other participant has acknowledged.

Every agent follows a *committed* trajectory, which ends at rest. To fly on, it makes a *proposal*: a trajectory that
leaves the committed one a little later, keeps its distance to everything its peers are known to have committed to or
to propose, and ends at rest again. It commits to the proposal only when every participant has acknowledged it. Each
agent sends all of this in one message a tick (committed trajectory, proposal, acknowledgements), and only the newest
message counts. Who has it passes it on to those that lack it (`swarmctl.bus.relay`): for what follows, such a message
has only been under way for longer. In wide swarms agents that are far from each other do without acknowledgements, by
rules of their own (`swarmctl.control.commit.reach`).

Each tick applies these rules in this order:

1. Receive the newest message of every peer.
2. Withdraw the own proposal if it comes too close to a peer's committed trajectory, or to a peer's proposal that is
   *earlier* (by time of proposal, then agent number; both are in the messages, so both sides order them alike).
3. Commit if all participants have acknowledged the proposal; withdraw it once the time has passed at which it leaves
   the committed trajectory.
4. Without a proposal, make one that is clear of everything known: peers' committed trajectories and their proposals.
5. Publish the committed trajectory, the proposal, and the number of the proposal received from each peer.

*No two agents are ever committed to trajectories that come closer than the hard minimum distance.* Proof: let A commit
to a and, not earlier, B to b. A has received a message of B that acknowledges a. If b was proposed before B sent it,
the message carries b, as proposal or as committed: were b earlier, A would have withdrawn a (rule 2); were it later,
B, which knew a when it sent that message, would have withdrawn b. If b was proposed after it, B knew a and kept clear
of it (rule 4), for B forgets a only when A publishes that it has withdrawn it, or when B is started again: then b needs
an acknowledgement of A, which carries a. So a and b do not conflict. Nothing is assumed of delay, loss, order or
duplication: without messages no acknowledgement arrives, and every agent comes to rest where its committed trajectory
ends. This replaces the delay check of RMADER (Kondo et al. 2023), whose guarantee ends where a message is later than
the check.

The proof is checked: `tools/explore_protocol.py` drives this code, with symbols in place of trajectories, through every
order and fate of messages among three agents. Of two that meet and propose once, with the third to answer, that is all
there is: 2195 states, after at most 12 ticks of agents. With proposals of all three, again and again, exclusions and
interrupted agents it is the first 100 000 states of each scope, 4 to 10 ticks. No two commitments conflict; without
any one of the rules two do. The figures are in docs/safety_case.md.

The proof rests on these assumptions, each of which is watched in flight:

- Clocks are known to within an error, which is measured: offsets of peers' clocks are taken from these messages and
  corrected (`swarmctl.bus.peers.clocks`), and the error that is left, a round trip at most, goes with every trajectory
  received. From one that is flown at speed v by a clock known to e, rules 2 and 4 keep v e more, and so does the safety
  filter (`Trajectory.spread_m`): of each pair of trajectories that the proof speaks of, one agent has checked the other
  one's, with room for all that it does not know of the other's clock. Beyond `agent.commit.clock_error_max_s` of a peer
  that is not far nothing new is proposed.
- Vehicles stay in their tubes: each may miss what it is committed to by half of the committed distance beyond touching
  bodies, what its estimator has lost of its accuracy included. `swarmctl.control.commit.tube` watches it; the event
  `tracking_violation` reports who leaves its tube, and `commitments` at the end the worst error of the flight. A
  vehicle that lags does not chase its commitment: it is flown later along the same places (`Commitments.wait_for`), and
  proposes from there. To the proof a proposal is any trajectory, whatever it leaves; until that is committed, the
  vehicle is outside the tube that its peers had been told of, and they keep clear of it as of one that does not take
  part.
- Commitments are kept. A commitment changes without acknowledgement only where a vehicle first commits at speed, where
  it is blown far from its tube, and by `evade`, before something that does not take part: around it, to a stop, or
  above it. So it does, but only to what conflicts with nothing known, before where the vehicle of a peer may be that is
  silent while most are heard. Two that evade at once may conflict. An agent that finds a peer's commitment in conflict
  with its own (`conflicting_peers`), or a peer outside its tube, keeps clear of that peer as of one that does not take
  part.
- In a swarm of two nobody can tell which of the two is cut off, so who meets the vehicle of a silent peer stops along
  its own places (`stop_before`), if all of these are apart from all places of what the peer is known to have committed
  to or to propose, whenever it passes them. This needs no acknowledgement: what the peer commits to later it has
  proposed before, and this agent has acknowledged, so it is known; or the peer knows of the stop. If it stops likewise,
  it does so within those places. The agent with the lower number may also leave its own places for others that are as
  far apart from those of the peer: the peer does not leave its own. With more than two it would not do: a majority that
  has never heard of the stop may exclude the agent, and rely on its going on.
- Every agent takes part. A vehicle that does not (a pilot flies it, its agent has died) is a keep-out of the
  best-effort kind. A silent peer stays a participant; when one is left out is in `swarmctl.control.commit.membership`:
  it takes evidence or a majority. The events `membership` and `operator` say who was, and on whose word.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.situation import Situation
from swarmctl.core.quantile import quantile
from swarmctl.core.trajectory import Trajectory, by_exact_clock, delayed, resting
from swarmctl.core.trajectory_message import Proposal, TrajectoryMessage
from swarmctl.core.types import Array

_LATENCIES = 50  # remembered, of the newest commitments
_QUANTILE_01 = 0.9
_LEAD_FACTOR = 1.2  # the lead is this many times that quantile of the time acknowledgements take
_EVASION_DELAY_S = 0.2  # braking this much after the lead must still be clear, otherwise the agent evades
_TICK_S = 0.04  # sending and receiving take at least this long
_NO_LAG_M_S = 0.1  # a slower trajectory is not waited on: it is at rest soon


@dataclass(slots=True, kw_only=True)
class CommitCounts:
    """Counts proposals by what became of them, since the start of the agent."""

    proposed: int = 0
    committed: int = 0
    withdrawn: int = 0
    expired: int = 0
    unplanned: int = 0
    evasive: int = 0  # committed trajectory replaced without acknowledgement


class Planner(Protocol):
    """Makes and compares trajectories for the protocol, as `TrajectoryPlanner` does.

    Two trajectories that do not conflict from some time on conflict at no later time either.
    """

    dt_us: int

    def proposal(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """Return a trajectory that leaves `committed` at `now.begin_us`, clear of everything known; None if none is."""

    def conflicts(self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory]) -> bool:
        """Tell whether a trajectory comes too close to any of `known` between `utc_us` and when all are at rest."""

    def is_clear(self, trajectory: Trajectory, now: Situation) -> bool:
        """Tell whether a trajectory keeps the hard minimum distance to every keep-out in `now.others`."""

    def stopping_from(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> Trajectory:
        """Return the trajectory that brakes straight ahead from a position (3,) and velocity (3,)."""

    def stopping_candidate(self, committed: Trajectory, brake_us: int, utc_us: int) -> Trajectory:
        """Return the committed trajectory from `utc_us` on, left for straight braking at `brake_us`."""

    def evasive_trajectory(self, committed: Trajectory, now: Situation, *, apart: bool = False) -> Trajectory | None:
        """Return a trajectory that keeps more distance to everything known than `committed`; None if none is found.

        With `apart` it passes no place that anybody known may pass, at whatever time.
        """

    def may_halt_later(self, committed: Trajectory, now: Situation) -> bool:
        """Tell whether there is time to wait before a stop along the own places."""

    def halting(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """Return `committed`, stopped along its own places, which others do not pass; None if that gains nothing."""


class Commitments:
    """Applies rules 2 to 4 for one agent; `swarmctl.agent.planning.coordination` receives and publishes the messages.

    Args:
        agent: own number.
        params: times of proposals.
        planner: makes and compares the trajectories.
    """

    def __init__(self, agent: int, params: CommitParams, planner: Planner) -> None:
        self._agent, self._params, self._planner = agent, params, planner
        self._latencies_s: deque[float] = deque(maxlen=_LATENCIES)
        self._lead_s = params.lead_min_s
        self._number, self._next_us = 0, 0
        self._late_us, self._proposed_late_us = 0, 0  # of the vehicle on what is committed, now and when it proposed
        self._cleared: dict[int, Trajectory] = {}  # by identity: known not to conflict with the own proposal
        self._compatible: dict[int, Trajectory] = {}  # by identity: known not to conflict with `_compatible_with`
        self._compatible_with: Trajectory | None = None
        self.committed: Trajectory | None = None
        self.proposal: Proposal | None = None
        self.counts = CommitCounts()

    def begin(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> None:
        """Commit to braking to rest from a position (3,) [m] and velocity (3,) [m/s], where the agent takes control."""
        self._replace(self._planner.stopping_from(pos_ned_m, vel_ned_m_s, utc_us))

    def restart(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> None:
        """Commit anew to braking to rest, without acknowledgement, from where the commitment was lost (see `tube`)."""
        self.begin(pos_ned_m, vel_ned_m_s, utc_us)
        self.counts.evasive += 1

    def end(self, pos_ned_m: Array | None, utc_us: int) -> None:
        """Drop the proposal while a pilot or the autopilot flies, and commit to rest at the position (3,), if known."""
        self.proposal = None
        if pos_ned_m is not None:
            self._replace(resting(pos_ned_m, utc_us, self._planner.dt_us))

    def wait_for(self, pos_ned_m: Array, utc_us: int, since_us: int, allowed_m: float) -> None:
        """Hold back what is flown while it is more than `allowed_m` ahead of the vehicle at (3,), at most to a stand.

        Args:
            pos_ned_m, utc_us: where the vehicle was, and when.
            since_us: time since the last call, of which some may be lost.
            allowed_m: how far behind it may be.
        """
        assert self.flown is not None
        place, vel = map(np.array, self.flown.at(utc_us))
        speed_m_s = float(np.linalg.norm(vel))
        if speed_m_s < _NO_LAG_M_S:
            return
        behind_m = float((place - pos_ned_m) @ vel) / speed_m_s
        if behind_m > allowed_m:
            self._late_us += min(since_us, round(1e6 * (behind_m - allowed_m) / speed_m_s))

    def update(self, utc_us: int, peers: Mapping[int, TrajectoryMessage], required: Set[int]) -> None:
        """Apply rules 2 and 3 to the own proposal.

        Args:
            utc_us: now.
            peers: newest message of each peer, lost ones included: their vehicles may have flown on for a while.
            required: participants other than this agent, whose acknowledgement is required.
        """
        mine = self.proposal
        if mine is None:
            return
        if utc_us > mine.made_utc_us + self.lead_us:
            self.proposal = None
            self.counts.expired += 1
            self._set_lead(2.0 * self._lead_s)
            return
        known = [message.committed for message in peers.values() if message.is_committed]
        proposals = [message.proposal for message in peers.values() if message.proposal is not None]
        known += [proposal.trajectory for proposal in proposals if proposal.order < mine.order]
        new = [trajectory for trajectory in known if id(trajectory) not in self._cleared]
        if self._planner.conflicts(mine.trajectory, utc_us, new):
            self.proposal = None
            self.counts.withdrawn += 1
            return
        self._cleared.update((id(trajectory), trajectory) for trajectory in new)
        if all(agent in peers and peers[agent].acknowledged.get(self._agent) == mine.number for agent in required):
            self.committed, self.proposal = mine.trajectory, None
            self._compatible, self._compatible_with = self._cleared, mine.trajectory
            self._late_us -= self._proposed_late_us
            self.counts.committed += 1
            self._latencies_s.append((utc_us - mine.made_utc_us) * 1e-6)
            self._set_lead(_LEAD_FACTOR * quantile(self._latencies_s, _QUANTILE_01) + _TICK_S)

    def conflicting_peers(self, utc_us: int, peers: Mapping[int, TrajectoryMessage]) -> set[int]:
        """Return peers whose committed trajectory conflicts with the own one, because one of the two had to evade.

        The error of clocks is left aside: who has committed last has left room for it, by what was known then.
        """
        if self.committed is None:
            return set()
        commitments = {agent: message.committed for agent, message in peers.items() if message.is_committed}
        if self._compatible_with is not self.committed:
            self._compatible, self._compatible_with = {}, self.committed
        new = [t for t in commitments.values() if id(t) not in self._compatible]
        if new and not self._planner.conflicts(self.committed, utc_us, list(map(by_exact_clock, new))):
            told = {id(t) for message in peers.values() for t in message.trajectories}
            self._compatible = {key: t for key, t in self._compatible.items() if key in told}  # the others are past
            self._compatible.update((id(t), t) for t in new)
            new = []
        unsure = {agent: t for agent, t in commitments.items() if any(t is other for other in new)}
        return {a for a, t in unsure.items() if self._planner.conflicts(self.committed, utc_us, [by_exact_clock(t)])}

    def evade(self, now: Situation) -> None:
        """Replace the committed trajectory without acknowledgement, where waiting for one would be too late.

        It is replaced only when it hits a keep-out and so does braking `_EVASION_DELAY_S` after the lead.
        """
        flown = self.flown
        if flown is None or not now.others or self._planner.is_clear(flown, now) or self._may_wait(flown, now):
            return
        self._change_to(self._planner.evasive_trajectory(flown, now))

    def evade_doubted(self, now: Situation, doubted: KeepOuts) -> None:
        """Evade vehicles whose agents are silent, which may as well fly as they have committed to.

        So nothing is evaded to that conflicts with anything known.

        Args:
            now: as for `evade`.
            doubted: keep-outs of those vehicles.
        """
        flown, now = self.flown, replace(now, others=KeepOuts([*now.others, *doubted]))
        if flown is None or self._planner.is_clear(flown, now) or self._may_wait(flown, now):
            return
        found = self._planner.evasive_trajectory(flown, now)
        if found is not None and not self._planner.conflicts(found, now.utc_us, now.followed):
            self._change_to(found)

    def stop_before(self, now: Situation, doubted: KeepOuts, *, leaves: bool) -> None:
        """Stop along the own places before vehicles whose agents are silent, or leave these; see the proof.

        Args:
            now: as for `evade`; its peers are all that may be flying as they have committed to.
            doubted: keep-outs of those vehicles.
            leaves: whether the own places may be left where no stop is clear; of two agents one may.
        """
        flown, now = self.flown, replace(now, others=KeepOuts([*now.others, *doubted]))
        if flown is None or self._planner.is_clear(flown, now) or self._planner.may_halt_later(flown, now):
            return
        found = self._planner.halting(flown, now)
        if leaves and (found is None or not self._planner.is_clear(found, now)):
            found = self._planner.evasive_trajectory(flown, now, apart=True) or found
        self._change_to(found)

    def _change_to(self, found: Trajectory | None) -> None:
        """Replace the committed trajectory without acknowledgement, and count that; None: nothing was found."""
        if found is not None:
            self._replace(found)
            self.counts.evasive += 1

    def _may_wait(self, flown: Trajectory, now: Situation) -> bool:
        """Tell whether braking `_EVASION_DELAY_S` after the lead is still clear of all keep-outs."""
        later_us = now.utc_us + self.lead_us + round(_EVASION_DELAY_S * 1e6)
        return self._planner.is_clear(self._planner.stopping_candidate(flown, later_us, now.utc_us), now)

    def is_due(self, utc_us: int) -> bool:
        """Tell whether there is no proposal and `period_s` has passed since the last attempt."""
        return self.proposal is None and self.committed is not None and utc_us >= self._next_us

    def propose(self, now: Situation) -> None:
        """Apply rule 4; call it when it `is_due`.

        Args:
            now: a plan that begins `lead_us` from now; peers as given to `update`.
        """
        assert self.flown is not None
        self._next_us = now.utc_us + round(self._params.period_s * 1e6)
        trajectory = self._planner.proposal(self.flown, now)
        if trajectory is None:
            self.counts.unplanned += 1
            return
        self._number = max(self._number + 1, now.utc_us)  # above all numbers used before a restart
        self.proposal = Proposal(number=self._number, made_utc_us=now.utc_us, agent=self._agent, trajectory=trajectory)
        self._cleared = {id(known): known for known in now.followed}
        self._proposed_late_us = self._late_us
        self.counts.proposed += 1

    def keep_clear_of(self, peers: Mapping[int, TrajectoryMessage], utc_us: int) -> None:
        """Apply rule 4 to peers that were left out of the plan: withdraw a proposal that is not clear of them, too."""
        if self.proposal is None or not peers:
            return
        known = [trajectory for message in peers.values() for trajectory in message.followed]
        if self._planner.conflicts(self.proposal.trajectory, utc_us, known):
            self.proposal = None
            self.counts.withdrawn += 1
        else:
            self._cleared.update((id(trajectory), trajectory) for trajectory in known)

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Return the committed trajectory, and the proposed one if there is one; none before the first."""
        proposed = () if self.proposal is None else (self.proposal.trajectory,)
        return proposed if self.committed is None else (self.committed, *proposed)

    def late_m(self, utc_us: int) -> float:
        """Return how far what is flown is behind what is committed [m]."""
        if self.committed is None or not self._late_us:
            return 0.0
        return math.dist(self.committed.at(utc_us)[0], self.committed.at(utc_us - self._late_us)[0])

    @property
    def flown(self) -> Trajectory | None:
        """Return what the vehicle is flown along: what is committed, later by as much as has been waited for it."""
        return None if self.committed is None else delayed(self.committed, self._late_us)

    @property
    def lead_us(self) -> int:
        """Return the time between making a proposal and leaving the committed trajectory for it [us]."""
        return round(self._lead_s * 1e6)

    def _replace(self, committed: Trajectory) -> None:
        self.committed, self.proposal = committed, None
        self._late_us = 0

    def _set_lead(self, lead_s: float) -> None:
        self._lead_s = max(self._params.lead_min_s, min(self._params.lead_max_s, lead_s))


def acknowledgements(peers: Mapping[int, TrajectoryMessage], without: Set[int]) -> dict[int, int]:
    """Return what rule 5 publishes: the number of the proposal in each peer's newest message, but of those `without`.

    Args:
        peers: newest message of each peer, as given to `Commitments.update` before.
        without: peers that take no part any more, or are promised to be excluded.
    """
    return {
        agent: message.proposal.number
        for agent, message in peers.items()
        if message.proposal is not None and agent not in without
    }
