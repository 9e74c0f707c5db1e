"""Guaranteed separation: nothing is flown that has not been promised, nothing promised that somebody contradicts.

Every agent follows a *committed* trajectory, which ends at rest. To fly on it makes a *proposal*, which leaves the
committed trajectory a little later, keeps its distance to everything it knows its peers have committed to or propose,
and ends at rest again. It commits to the proposal only when every living peer has acknowledged it. All agents say all
of this in one message a tick, the newest of which is all that counts: committed, proposal, acknowledgements.

Rules, in this order in every tick:

1. Take in the newest message of every peer.
2. Withdraw the own proposal if it comes too close to what a peer has committed to, or to a peer's proposal that is
   *earlier* (by time of proposal, then agent number; both are in the messages, so both sides order them alike).
3. Commit if all living peers have acknowledged it; withdraw it once the moment has passed where it leaves the old one.
4. Without a proposal make one, clear of everything known, both of what peers have committed to and of what they
   propose.
5. Say what is committed, proposed, and which proposal of each peer has been taken in.

*No two agents are ever committed to trajectories that come closer than the certified distance.* Let A commit to a
and, not earlier, B to b. A has heard a message of B that acknowledges a. If b was proposed before B sent it, the
message carries b, as proposal or as committed: were b earlier, A would have withdrawn a (rule 2); were it later, B,
which knew a when it sent that message, would have withdrawn b. If b was proposed after it, B knew a and kept clear of
it (rule 4), for B forgets a only when A says it has withdrawn it. So a and b do not conflict. Nothing is assumed of
delay, loss, order or duplication: without messages no acknowledgement comes, and everybody comes to rest where the
committed trajectory ends. It replaces the waiting time of two-step commit (RMADER, Kondo et al. 2023), whose
guarantee ends where a message is late.

What it rests on, and how that is watched in flight:

- Agents mean the same time: a clock offset of e seconds costs v e metres. `separation.tracking_m` covers it; offsets
  of vehicles' clocks are measured, hosts are to be synchronised.
- They fly what they follow: half of what is promised beyond touching bodies may be missed by each. An event
  `off_promise` says who misses more, and `promises` at the end the worst of the flight.
- Promises are kept. A promise is changed without being asked for only where a vehicle begins to promise at speed, and
  by `avoid`, before something that takes no part: round it, to a stop, or above it. Whoever finds a peer's promise in
  contradiction to the own one (`broken`), or a peer beside its promise, keeps clear of it as of one that takes no part.
- Everybody takes part. Who does not (a pilot flies, an agent has died) is a keep-out of the best-effort kind, and a
  peer is dead only when its liveliness token is gone while the own one is there: who is off the bus commits nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass

import numpy as np

from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.trajectory_planner import CommitParams, Situation, TrajectoryPlanner
from swarmctl.control.mpc.swarm_mpc import MpcParams
from swarmctl.core.trajectory import Trajectory, resting
from swarmctl.core.trajectory_message import Intent, Proposal
from swarmctl.core.types import Array

_LATENCIES = 50  # remembered
_PERCENTILE = 90.0
_LEAD_OVER = 1.2  # times that percentile of the time acknowledgements take
_LATER_S = 0.2  # after the lead: the last moment to brake without asking
_TICK_S = 0.04  # sending and hearing, at least


@dataclass(slots=True)
class CommitCounts:
    """Since the start."""

    proposed: int = 0
    committed: int = 0
    withdrawn: int = 0
    expired: int = 0
    unplanned: int = 0
    evaded: int = 0  # changed at once, because of somebody who takes no part


class Commitments:
    """The five rules for one agent.

    Args:
        agent, params, mpc, separation, max_keep_outs, stopwatch_ns: see `TrajectoryPlanner`.
    """

    def __init__(
        self,
        agent: int,
        params: CommitParams,
        mpc: MpcParams,
        separation: SeparationParams,
        max_keep_outs: int,
        stopwatch_ns: Callable[[], int],
    ) -> None:
        self._agent, self._params = agent, params
        self._planner = TrajectoryPlanner(agent, params, mpc, separation, max_keep_outs, stopwatch_ns)
        self._latencies_s: deque[float] = deque(maxlen=_LATENCIES)
        self._lead_s = params.lead_min_s
        self._number, self._next_us = 0, 0
        self._cleared: dict[int, Trajectory] = {}  # by identity: what the own proposal is known to be clear of
        self._compatible: dict[int, Trajectory] = {}  # likewise, of what is committed
        self._compatible_with: Trajectory | None = None
        self.committed: Trajectory | None = None
        self.proposal: Proposal | None = None
        self.counts = CommitCounts()

    def begin(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> None:
        """Control has been taken: come to rest from here."""
        self.committed = self._planner.halted(pos_ned_m, vel_ned_m_s, utc_us)
        self.proposal = None

    def end(self, pos_ned_m: Array | None, utc_us: int) -> None:
        """Somebody else flies, from (3,) if it is known where."""
        self.proposal = None
        if pos_ned_m is not None:
            self.committed = resting(pos_ned_m, utc_us, self._planner.dt_us)

    def hear(self, utc_us: int, peers: Mapping[int, Intent], living: Set[int]) -> None:
        """Rules 2 and 3.

        Args:
            utc_us: now.
            peers: newest message of each, also of those who have died: they may have flown on for a while.
            living: peers whose acknowledgement counts.
        """
        mine = self.proposal
        if mine is None:
            return
        if utc_us > mine.made_utc_us + self.lead_us:
            self.proposal = None
            self.counts.expired += 1
            self._set_lead(2.0 * self._lead_s)
            return
        known = [intent.committed for intent in peers.values() if intent.promised]
        known += [i.proposal.trajectory for i in peers.values() if i.proposal and i.proposal.order < mine.order]
        new = [trajectory for trajectory in known if id(trajectory) not in self._cleared]
        if self._planner.conflicts(mine.trajectory, utc_us, new):
            self.proposal = None
            self.counts.withdrawn += 1
            return
        self._cleared.update((id(trajectory), trajectory) for trajectory in new)
        if all(agent in peers and peers[agent].heard.get(self._agent) == mine.number for agent in living):
            self.committed, self.proposal = mine.trajectory, None
            self.counts.committed += 1
            self._latencies_s.append((utc_us - mine.made_utc_us) * 1e-6)
            self._set_lead(_LEAD_OVER * float(np.percentile(self._latencies_s, _PERCENTILE)) + _TICK_S)

    def broken(self, utc_us: int, peers: Mapping[int, Intent]) -> set[int]:
        """Peers whose promise contradicts the own one: somebody had to change his without being asked for it."""
        if self.committed is None:
            return set()
        promises = {agent: intent.committed for agent, intent in peers.items() if intent.promised}
        if self._compatible_with is not self.committed:
            self._compatible, self._compatible_with = {}, self.committed
        new = [t for t in promises.values() if id(t) not in self._compatible]
        if new and not self._planner.conflicts(self.committed, utc_us, new):
            self._compatible.update((id(t), t) for t in new)
            new = []
        unsure = {agent: t for agent, t in promises.items() if any(t is other for other in new)}
        return {agent for agent, t in unsure.items() if self._planner.conflicts(self.committed, utc_us, [t])}

    def avoid(self, now: Situation) -> None:
        """Change the own promise without asking, where waiting would be too late for those who take no part.

        Args:
            now: a plan would begin at once.
        """
        if self.committed is None or not now.others or self._planner.is_clear(self.committed, now):
            return
        later_us = now.utc_us + self.lead_us + round(_LATER_S * 1e6)
        if self._planner.is_clear(self._planner.stopped(self.committed, later_us, now.utc_us), now):
            return
        way_out = self._planner.way_out(self.committed, now)
        if way_out is not None:
            self.committed, self.proposal = way_out, None
            self.counts.evaded += 1

    def is_due(self, utc_us: int) -> bool:
        """Whether there is no proposal and it is time for one."""
        return self.proposal is None and self.committed is not None and utc_us >= self._next_us

    def propose(self, now: Situation) -> None:
        """Rule 4, when it `is_due`.

        Args:
            now: a plan would begin `lead_us` from now; peers as of `hear`.
        """
        assert self.committed is not None
        self._next_us = now.utc_us + round(self._params.period_s * 1e6)
        trajectory = self._planner.proposal(self.committed, now)
        if trajectory is None:
            self.counts.unplanned += 1
            return
        self._number = max(self._number + 1, now.utc_us)  # none of before a restart
        self.proposal = Proposal(self._number, now.utc_us, self._agent, trajectory)
        self._cleared = {id(known): known for known in now.followed}
        self.counts.proposed += 1

    @property
    def lead_us(self) -> int:
        """From proposing to flying it [us]."""
        return round(self._lead_s * 1e6)

    @property
    def steps(self) -> int:
        """Of `Situation.others`."""
        return self._planner.steps

    @property
    def dt_us(self) -> int:
        return self._planner.dt_us

    def _set_lead(self, lead_s: float) -> None:
        self._lead_s = min(self._params.lead_max_s, max(self._params.lead_min_s, lead_s))
