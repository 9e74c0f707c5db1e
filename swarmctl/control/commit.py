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

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from swarmctl.control.mission import brake_to_rest, glide_to
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc import AxisWeights, MpcParams, SwarmMpc
from swarmctl.control.problem import Problem, Start
from swarmctl.control.separation import KeepOut, SeparationParams, certify
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.intent import Intent, Proposal
from swarmctl.core.params import Params
from swarmctl.core.trajectory import Trajectory, ending_at_rest, joined, places, resting, stopping
from swarmctl.core.types import Array, Plan, PlanStatus, Reference, Sampled

_LATENCIES = 50  # remembered
_PERCENTILE = 90.0
_LEAD_OVER = 1.2  # times that percentile of the time acknowledgements take
_BRAKED_FROM_01 = (1.0, 0.75, 0.5, 0.3, 0.15)  # of the plan
_WORTH_M = 0.02  # by which a way out has to be better than what has been promised
_RISE_M_S, _RISE_M_S2 = 2.0, 2.0
_TAIL_S = 2.0  # of braking, judged against who takes no part
_LATER_S = 0.2  # after the lead: the last moment to brake without asking
_CLOSER_M = 0.001  # than now, of promises that are too close already
_SPARE_M = 0.01  # proposals keep more than promises need: between points they are judged by straight lines
_SLACK_01 = 1.0 / 3.0  # of what is kept beyond touching bodies plans may use up at most
_TICK_S = 0.04  # sending and hearing, at least


class CommitParams(Params):
    """Planning in the space of trajectories; of `separation.mode = "guaranteed"`."""

    dt_s: float = Field(0.1, ge=0.05, le=0.5)
    horizon: int = Field(20, ge=5, le=60)  # steps, before the braking that every plan ends in
    moves: int = Field(8, ge=2, le=40)
    brake_m_s2: float = Field(1.5, ge=0.5, le=10)  # of that braking
    share_01: float = Field(0.8, gt=0, le=1)  # of the controller's tilt that plans may use; the rest is for tracking
    period_s: float = Field(0.1, ge=0, le=2)  # between two plans, at least
    lead_min_s: float = Field(0.06, ge=0.02, le=2)  # from proposing to flying it
    lead_max_s: float = Field(1.5, ge=0.1, le=5)
    bias_rad: float = Field(1.0, ge=0, le=1.2)  # as in `separation`, in its place: plans that end in stops lock sooner
    stuck_m: float = Field(1.0, gt=0, le=10)  # likewise: who meets turns while it still moves
    follow_z: AxisWeights = AxisWeights(q_pos=20.0, q_vel=0.5, r=0.05)  # of flying what is promised: to the centimetre


@dataclass(frozen=True, slots=True)
class Wish:
    """What an agent would follow if it were alone."""

    reference: Sampled
    is_way: bool = False  # it begins here and is clear of obstacles: look for plans near it, not near the last one


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
        agent: own number.
        params: planning.
        mpc: the controller's bounds and weights.
        separation: distances.
        slots: how many neighbours and obstacles get rows.
        stopwatch_ns: see `CondensedMpc`.
    """

    def __init__(
        self,
        agent: int,
        params: CommitParams,
        mpc: MpcParams,
        separation: SeparationParams,
        slots: int,
        stopwatch_ns: Callable[[], int],
    ) -> None:
        self._agent, self._params, self._separation = agent, params, separation
        self._dt_us = round(params.dt_s * 1e6)
        keeping_right = separation.model_copy(update={"bias_rad": params.bias_rad, "stuck_m": params.stuck_m})
        self._planner = SwarmMpc(
            _planning(mpc, params), VehicleModelParams(delay_s=0.0), keeping_right, agent, slots, stopwatch_ns
        )
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
        self.committed = stopping(pos_ned_m, vel_ned_m_s, utc_us, self._dt_us, self._params.brake_m_s2)
        self.proposal = None

    def end(self, pos_ned_m: Array | None, utc_us: int) -> None:
        """Somebody else flies, from (3,) if it is known where."""
        self.proposal = None
        if pos_ned_m is not None:
            self.committed = resting(pos_ned_m, utc_us, self._dt_us)

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
        if self._conflicts(mine.trajectory, utc_us, new):
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
        if new and not self._conflicts(self.committed, utc_us, new):
            self._compatible.update((id(t), t) for t in new)
            new = []
        unsure = {id(t) for t in new}
        return {a for a, t in promises.items() if id(t) in unsure and self._conflicts(self.committed, utc_us, [t])}

    def avoid(
        self,
        utc_us: int,
        wish: Wish,
        peers: Mapping[int, Intent],
        others: Sequence[KeepOut],
    ) -> None:
        """Change the own promise without asking, where waiting would be too late for those who take no part.

        Args:
            utc_us: now.
            wish: what it would like.
            peers: of those who take part.
            others: those who do not, and obstacles, from now on.
        """
        if self.committed is None or not others:
            return
        times = utc_us + np.arange(len(others[0].pos_ned_m)) * self._dt_us
        if certify(self.committed.sample(times)[0], others, 0) >= 0.0:
            return
        later_us = utc_us + self.lead_us + round(_LATER_S * 1e6)
        if certify(self._stopped(later_us, utc_us).sample(times)[0], others, 0) >= 0.0:
            return
        known = _followed(peers)

        def margin_m(trajectory: Trajectory) -> float:
            return min(certify(trajectory.sample(times)[0], others, 0), self._margin_m(trajectory, utc_us, known))

        best, best_m = self.committed, margin_m(self.committed) + _WORTH_M
        for candidate in self._ways_out(utc_us, wish, peers, others):
            if (found_m := margin_m(candidate)) > best_m:
                best, best_m = candidate, found_m
        if best is not self.committed:
            self.committed, self.proposal = best, None
            self.counts.evaded += 1

    def _ways_out(
        self,
        utc_us: int,
        wish: Wish,
        peers: Mapping[int, Intent],
        others: Sequence[KeepOut],
    ) -> Iterator[Trajectory]:
        """From now on: round everybody, straight to a stop, and over who can be flown over."""
        plan = self._planned(utc_us, utc_us, wish, peers, others)
        if plan is not None:
            yield ending_at_rest(utc_us, self._dt_us, plan.pos_ned_m, plan.vel_ned_m_s, self._params.brake_m_s2)
        yield self._stopped(utc_us, utc_us)
        heights_m = [k.radius_m for k in others if not k.any_height]
        if heights_m:
            yield self._risen(utc_us, max(heights_m) + _SPARE_M)

    def _stopped(self, brake_us: int, utc_us: int) -> Trajectory:
        """What is committed, braked from a time on, straight ahead."""
        assert self.committed is not None
        pos, vel = self.committed.sample(np.array([brake_us]))
        stop = stopping(pos[0], vel[0], brake_us, self._dt_us, self._params.brake_m_s2)
        return joined(self.committed, stop, utc_us)

    def _risen(self, utc_us: int, height_m: float) -> Trajectory:
        """What is committed, left upwards."""
        assert self.committed is not None
        pos, vel = (found[0] for found in self.committed.sample(np.array([utc_us])))
        above = brake_to_rest(pos, vel, self._params.brake_m_s2).to_ned_m - [0.0, 0.0, height_m]
        glide = glide_to(pos, vel, above, _RISE_M_S, _RISE_M_S2)
        ahead_s = self._params.dt_s * np.arange(math.ceil(glide.travel_s / self._params.dt_s) + 1, dtype=np.float64)
        return ending_at_rest(utc_us, self._dt_us, *glide.sample(ahead_s), self._params.brake_m_s2)

    def is_due(self, utc_us: int) -> bool:
        """Whether there is no proposal and it is time for one."""
        return self.proposal is None and self.committed is not None and utc_us >= self._next_us

    def propose(
        self,
        utc_us: int,
        wish: Wish,
        peers: Mapping[int, Intent],
        others: Sequence[KeepOut],
    ) -> None:
        """Rule 4, when it `is_due`.

        Args:
            utc_us: now.
            wish: what it would like.
            peers: as of `hear`.
            others: as from `keep_outs`, from `lead_us` ahead on.
        """
        self._next_us = utc_us + round(self._params.period_s * 1e6)
        branch_us = utc_us + self.lead_us
        plan = self._planned(branch_us, utc_us, wish, peers, others)
        trajectory = None if plan is None else self._clear(plan, branch_us, utc_us, peers, others)
        if trajectory is None:
            self.counts.unplanned += 1
            return
        self._number = max(self._number + 1, utc_us)  # none of before a restart
        self.proposal = Proposal(self._number, utc_us, self._agent, trajectory)
        self._cleared = {id(known): known for known in _followed(peers)}
        self.counts.proposed += 1

    @property
    def lead_us(self) -> int:
        """From proposing to flying it [us]."""
        return round(self._lead_s * 1e6)

    @property
    def steps(self) -> int:
        """Of `keep_outs` that `avoid` and `propose` need: the plan and its braking."""
        return self._planner.steps + math.ceil(_TAIL_S / self._params.dt_s)

    @property
    def dt_us(self) -> int:
        return self._dt_us

    def _planned(
        self,
        branch_us: int,
        utc_us: int,
        wish: Wish,
        peers: Mapping[int, Intent],
        others: Sequence[KeepOut],
    ) -> Plan | None:
        assert self.committed is not None
        steps, dt_us = self._planner.steps, self._dt_us
        ahead_us = np.arange(steps + 1, dtype=np.float64) * dt_us
        pos, vel = self.committed.sample(branch_us + ahead_us)
        accel = self.committed.acceleration(branch_us)
        lift = np.array([0.0, 0.0, GRAVITY_M_S2]) - accel
        size = float(np.sqrt(lift @ lift))
        start = Start(branch_us, pos[0], vel[0], 1.0, np.array([lift[0] / size, lift[1] / size, size]))
        wanted = Reference(*wish.reference(1e-6 * (ahead_us + (branch_us - utc_us))), 0.0)
        guess = wanted.pos_ned_m + (pos[0] - wanted.pos_ned_m[0]) if wish.is_way else pos
        known = [(t, intent.agent) for intent in peers.values() for t in intent.followed]
        keep_outs = self._keep_outs([t for t, _ in known], [agent for _, agent in known], branch_us, steps)
        kept = (*keep_outs, *(_begun(other, steps) for other in others))
        plan = self._planner.plan(Problem(start, wanted, np.zeros(3), kept, guess))
        return None if plan.status is PlanStatus.SOLVER_FAILED else plan

    def _clear(
        self, plan: Plan, branch_us: int, utc_us: int, peers: Mapping[int, Intent], others: Sequence[KeepOut]
    ) -> Trajectory | None:
        """The plan, braked from as late as it then stays clear of everything known; None when it never does."""
        assert self.committed is not None
        known = _followed(peers)
        steps, dt_us, brake_m_s2 = self._planner.steps, self._dt_us, self._params.brake_m_s2
        ahead = branch_us + np.arange(self.steps + 1) * dt_us
        for share in _BRAKED_FROM_01:
            last = max(1, round(share * steps))
            braked = ending_at_rest(
                branch_us, dt_us, plan.pos_ned_m[: last + 1], plan.vel_ned_m_s[: last + 1], brake_m_s2
            )
            whole = joined(self.committed, braked, utc_us)
            if certify(whole.sample(ahead)[0], others, 0) >= 0.0 and not self._conflicts(
                whole, utc_us, known, _SPARE_M
            ):
                return whole
        return None

    def _conflicts(
        self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory], spare_m: float = 0.0
    ) -> bool:
        """Whether it comes too close to any of these from now until all are at rest."""
        return not self._margin_m(trajectory, utc_us, known, spare_m) >= 0.0

    def _margin_m(
        self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory], spare_m: float = 0.0
    ) -> float:
        if not known:
            return math.inf
        end_us = max(trajectory.end_utc_us, *(other.end_utc_us for other in known))
        steps = max(1, -(-(end_us - utc_us) // self._dt_us))
        own = trajectory.sample(utc_us + np.arange(steps + 1) * self._dt_us)[0]
        kept = self._keep_outs(known, [0] * len(known), utc_us, steps, spare_m)
        return certify(own, kept, 0, _CLOSER_M)

    def _keep_outs(
        self,
        trajectories: Sequence[Trajectory],
        agents: Sequence[int],
        t0_utc_us: int,
        steps: int,
        spare_m: float = 0.0,
    ) -> list[KeepOut]:
        if not trajectories:
            return []
        p = self._separation
        certified_m = promised_m(p) + spare_m
        where = places(trajectories, t0_utc_us + np.arange(steps + 1) * self._dt_us)
        return [
            KeepOut(points, p.planned_m, certified_m, False, agent, p.downwash)
            for points, agent in zip(where, agents, strict=True)
        ]

    def _set_lead(self, lead_s: float) -> None:
        self._lead_s = min(self._params.lead_max_s, max(self._params.lead_min_s, lead_s))


def following(mpc: MpcParams, params: CommitParams) -> MpcParams:
    """The controller that flies what is promised: a stiffer z, where wishes may be met softly and promises may not."""
    return mpc.model_copy(update={"z": params.follow_z})


def promised_m(params: SeparationParams) -> float:
    """Distance that no two committed trajectories come closer than."""
    slack_m = min(params.certify_slack_m, _SLACK_01 * max(0.0, params.radius_m - params.body_m))
    return params.radius_m - slack_m


def _followed(peers: Mapping[int, Intent]) -> list[Trajectory]:
    """All that peers may follow from now on."""
    return [trajectory for intent in peers.values() for trajectory in intent.followed]


def _begun(keep_out: KeepOut, steps: int) -> KeepOut:
    """Its first steps."""
    return replace(keep_out, pos_ned_m=keep_out.pos_ned_m[: steps + 1])


def _planning(mpc: MpcParams, params: CommitParams) -> MpcParams:
    """The controller's weights and bounds on the planner's grid."""
    return mpc.model_copy(
        update={
            "dt_s": params.dt_s,
            "discretisation": "zoh",
            "thrust_ahead": "held",
            "control_z": params.moves,
            "horizon_z": params.horizon,
            "control_xy": params.moves,
            "horizon_xy": params.horizon,
            "u_max": params.share_01 * mpc.u_max,
            "thrust_min_m_s2": max(mpc.thrust_min_m_s2, 0.7 * GRAVITY_M_S2),
            "thrust_max_m_s2": min(mpc.thrust_max_m_s2, 1.3 * GRAVITY_M_S2),
            "terminal_z": "none",
            "terminal_xy": "none",
        }
    )
