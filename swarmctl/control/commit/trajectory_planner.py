"""Plans in the space of trajectories: what an agent proposes to fly, and how it gets out of the way at once.

Each trajectory leaves what is committed, keeps clear of all that is known, and ends at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from swarmctl.control.collision.separation import KeepOut, SeparationParams, certify
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.mpc.swarm_mpc import AxisWeights, MpcParams, SwarmMpc
from swarmctl.control.reference.mission import brake_to_rest, quintic_to
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params
from swarmctl.core.trajectory import Trajectory, ending_at_rest, joined, places, stopping
from swarmctl.core.trajectory_message import Intent
from swarmctl.core.types import Array, Plan, PlanStatus, Reference, Sampled

_BRAKED_FROM_01 = (1.0, 0.75, 0.5, 0.3, 0.15)  # of the plan
_WORTH_M = 0.02  # by which a way out has to be better than what has been promised
_RISE_M_S, _RISE_M_S2 = 2.0, 2.0
_GATHER_M_S2 = 0.8  # of who sets out on a way
_TAIL_S = 2.0  # of braking, judged against who takes no part
_CLOSER_M = 0.001  # than now, of promises that are too close already
_SPARE_M = 0.01  # proposals keep more than promises need: between points they are judged by straight lines
_SLACK_01 = 1.0 / 3.0  # of what is kept beyond touching bodies plans may use up at most


class CommitParams(Params):
    """Planning in the space of trajectories; of `separation.mode = "guaranteed"`."""

    dt_s: float = Field(0.1, ge=0.05, le=0.5)
    horizon: int = Field(20, ge=5, le=60)  # steps, before the braking that every plan ends in
    moves: int = Field(8, ge=2, le=40)
    brake_m_s2: float = Field(1.5, ge=0.5, le=10)  # of that braking
    tilt_fraction_01: float = Field(0.8, gt=0, le=1)  # of the controller's tilt, for plans; the rest is for tracking
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


@dataclass(frozen=True, slots=True)
class Situation:
    """What a plan is made for.

    Args:
        utc_us: now.
        begin_us: when the plan begins.
        wish: what the agent would like.
        peers: who takes part: the newest message of each.
        others: who does not, and obstacles, as from `WorldModel.keep_outs`, from when the plan begins.
    """

    utc_us: int
    begin_us: int
    wish: Wish
    peers: Mapping[int, Intent]
    others: Sequence[KeepOut]

    @property
    def followed(self) -> list[Trajectory]:
        """All that peers may follow from now on."""
        return [trajectory for intent in self.peers.values() for trajectory in intent.followed]


class TrajectoryPlanner:
    """See the module.

    Args:
        agent: own number.
        params: planning.
        mpc: the controller's bounds and weights.
        separation: distances.
        max_keep_outs: how many neighbours and obstacles get rows.
        stopwatch_ns: see `CondensedMpc`.
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
        self._params, self._separation = params, separation
        keeping_right = separation.model_copy(update={"bias_rad": params.bias_rad, "stuck_m": params.stuck_m})
        self._mpc = SwarmMpc(
            _planning(mpc, params), VehicleModelParams(delay_s=0.0), keeping_right, agent, max_keep_outs, stopwatch_ns
        )
        self.dt_us = round(params.dt_s * 1e6)
        self.steps = self._mpc.steps + math.ceil(_TAIL_S / params.dt_s)  # of `Situation.others`: plan and braking

    def proposal(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """What leaves the committed one where plans begin, clear of everything known; None when nothing does."""
        found = self._clear(committed, self._planned(committed, now), now)
        if found is None and now.wish.is_way:
            speed_m_s = float(np.linalg.norm(committed.sample(np.array([now.begin_us]))[1]))
            slower = replace(now, wish=_gathering_speed(now.wish, speed_m_s))
            found = self._clear(committed, self._planned(committed, slower), slower)
        return found

    def way_out(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """What keeps clearer of everything known than the committed one; None when nothing does.

        Round everybody, straight to a stop, or over who can be flown over.
        """
        known = now.followed

        def margin_m(trajectory: Trajectory) -> float:
            return min(self._clearance_m(trajectory, now), self._margin_m(trajectory, now.utc_us, known))

        best, best_m = None, margin_m(committed) + _WORTH_M
        for candidate in self._ways_out(committed, now):
            if (found_m := margin_m(candidate)) > best_m:
                best, best_m = candidate, found_m
        return best

    def is_clear(self, trajectory: Trajectory, now: Situation) -> bool:
        """Of who takes no part, and obstacles."""
        return self._clearance_m(trajectory, now) >= 0.0

    def conflicts(self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory], spare_m: float = 0.0) -> bool:
        """Whether it comes too close to any of these from now until all are at rest."""
        return not self._margin_m(trajectory, utc_us, known, spare_m) >= 0.0

    def halted(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> Trajectory:
        """To rest from (3,) and (3,), straight ahead."""
        return stopping(pos_ned_m, vel_ned_m_s, utc_us, self.dt_us, self._params.brake_m_s2)

    def stopped(self, committed: Trajectory, brake_us: int, utc_us: int) -> Trajectory:
        """What is committed, braked from a time on, straight ahead."""
        pos, vel = committed.sample(np.array([brake_us]))
        return joined(committed, self.halted(pos[0], vel[0], brake_us), utc_us)

    def _ways_out(self, committed: Trajectory, now: Situation) -> Iterator[Trajectory]:
        plan = self._planned(committed, now)
        if plan is not None:
            yield ending_at_rest(now.begin_us, self.dt_us, plan.pos_ned_m, plan.vel_ned_m_s, self._params.brake_m_s2)
        yield self.stopped(committed, now.begin_us, now.utc_us)
        heights_m = [k.radius_m for k in now.others if not k.any_height]
        if heights_m:
            yield self._risen(committed, now.begin_us, max(heights_m) + _SPARE_M)

    def _risen(self, committed: Trajectory, begin_us: int, height_m: float) -> Trajectory:
        """What is committed, left upwards."""
        pos, vel = (found[0] for found in committed.sample(np.array([begin_us])))
        above = brake_to_rest(pos, vel, self._params.brake_m_s2).to_ned_m - [0.0, 0.0, height_m]
        trajectory = quintic_to(pos, vel, above, _RISE_M_S, _RISE_M_S2)
        ahead_s = self._params.dt_s * np.arange(
            math.ceil(trajectory.travel_s / self._params.dt_s) + 1, dtype=np.float64
        )
        return ending_at_rest(begin_us, self.dt_us, *trajectory.sample(ahead_s), self._params.brake_m_s2)

    def _planned(self, committed: Trajectory, now: Situation) -> Plan | None:
        steps = self._mpc.steps
        ahead_us = np.arange(steps + 1, dtype=np.float64) * self.dt_us
        pos, vel = committed.sample(now.begin_us + ahead_us)
        lift = np.array([0.0, 0.0, GRAVITY_M_S2]) - committed.acceleration(now.begin_us)
        size = float(np.sqrt(lift @ lift))
        start = Start(now.begin_us, pos[0], vel[0], 1.0, np.array([lift[0] / size, lift[1] / size, size]))
        wanted = Reference(*now.wish.reference(1e-6 * (ahead_us + (now.begin_us - now.utc_us))), 0.0)
        guess = wanted.pos_ned_m + (pos[0] - wanted.pos_ned_m[0]) if now.wish.is_way else pos
        agents = [intent.agent for intent in now.peers.values() for _ in intent.followed]
        keep_outs = self._keep_outs(now.followed, agents, now.begin_us, steps)
        kept = (*keep_outs, *(_begun(other, steps) for other in now.others))
        plan = self._mpc.plan(Problem(start, wanted, np.zeros(3), kept, guess))
        return None if plan.status is PlanStatus.SOLVER_FAILED else plan

    def _clear(self, committed: Trajectory, plan: Plan | None, now: Situation) -> Trajectory | None:
        """The plan, braked from as late as it then stays clear of everything known; None when it never does."""
        if plan is None:
            return None
        known = now.followed
        for share in _BRAKED_FROM_01:
            end = max(1, round(share * self._mpc.steps)) + 1
            braked = ending_at_rest(
                now.begin_us, self.dt_us, plan.pos_ned_m[:end], plan.vel_ned_m_s[:end], self._params.brake_m_s2
            )
            whole = joined(committed, braked, now.utc_us)
            if self.is_clear(whole, now) and not self.conflicts(whole, now.utc_us, known, _SPARE_M):
                return whole
        return None

    def _clearance_m(self, trajectory: Trajectory, now: Situation) -> float:
        times = now.begin_us + np.arange(self.steps + 1) * self.dt_us
        return certify(trajectory.sample(times)[0], now.others, 0)

    def _margin_m(
        self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory], spare_m: float = 0.0
    ) -> float:
        if not known:
            return math.inf
        end_us = max(trajectory.end_utc_us, *(other.end_utc_us for other in known))
        steps = max(1, -(-(end_us - utc_us) // self.dt_us))
        own = trajectory.sample(utc_us + np.arange(steps + 1) * self.dt_us)[0]
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
        where = places(trajectories, t0_utc_us + np.arange(steps + 1) * self.dt_us)
        return [
            KeepOut(points, p.planned_m, certified_m, False, agent, p.downwash)
            for points, agent in zip(where, agents, strict=True)
        ]


def following(mpc: MpcParams, params: CommitParams) -> MpcParams:
    """The controller that flies what is promised: a stiffer z, where wishes may be met softly and promises may not."""
    return mpc.model_copy(update={"z": params.follow_z})


def promised_m(params: SeparationParams) -> float:
    """Distance that no two committed trajectories come closer than."""
    slack_m = min(params.certify_slack_m, _SLACK_01 * max(0.0, params.radius_m - params.body_m))
    return params.radius_m - slack_m


def _gathering_speed(way: Wish, speed_m_s: float) -> Wish:
    """The same way, begun at an own speed.

    Rows keep plans outside obstacles where the way says they will be by then: of a way that begins faster than one is,
    the rows are those of the next corner, and plans cut this one.
    """
    way_m_s = float(np.linalg.norm(way.reference(np.zeros(1))[1]))
    if way_m_s <= speed_m_s:
        return way
    rate_1_s = _GATHER_M_S2 / way_m_s
    slow_01 = speed_m_s / way_m_s
    late_s = (1.0 - slow_01) / rate_1_s  # until the way's own speed is reached

    def reference(offsets_s: Array) -> tuple[Array, Array]:
        begun_s = np.minimum(offsets_s, late_s)
        at_s = (slow_01 + 0.5 * rate_1_s * begun_s) * begun_s + (offsets_s - begun_s)
        pos, vel = way.reference(at_s)
        return pos, vel * (slow_01 + rate_1_s * begun_s)[:, None]

    return Wish(reference, is_way=True)


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
            "u_max": params.tilt_fraction_01 * mpc.u_max,
            "thrust_min_m_s2": max(mpc.thrust_min_m_s2, 0.7 * GRAVITY_M_S2),
            "thrust_max_m_s2": min(mpc.thrust_max_m_s2, 1.3 * GRAVITY_M_S2),
            "terminal_z": "none",
            "terminal_xy": "none",
        }
    )
