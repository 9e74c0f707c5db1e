"""Planning in the space of trajectories: proposals that peers can acknowledge, and evasive trajectories.

Each planned trajectory leaves the committed one, keeps clear of everything known, and ends at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from swarmctl.control.collision.keep_outs import NO_KEEP_OUTS, KeepOut, KeepOuts, lasting
from swarmctl.control.collision.separation import SeparationParams, certify, keep_out_of_commitment
from swarmctl.control.commit.commit_params import CommitParams, interpolation_margin_m, planning
from swarmctl.control.commit.halting import halted, places_apart_m
from swarmctl.control.commit.situation import Situation, with_run_up
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.mpc.swarm_mpc import SwarmMpc
from swarmctl.control.reference.approach import Approach
from swarmctl.control.reference.quintic import QuinticTrajectory, brake_to_rest, quintic_to
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.frames import GRAVITY_NED_M_S2
from swarmctl.core.trajectory import Trajectory, ending_at_rest, joined, positions_at, stopping
from swarmctl.core.types import Array, Plan, PlanStatus, Reference

_BRAKE_POINTS_01 = (1.0, 0.75, 0.5, 0.3, 0.15)  # shares of the plan after which braking is tried, latest first
_MIN_GAIN_M = 0.02  # clearance an evasive trajectory has to gain over the committed one
_LEAST_COS_TILT = 0.5  # at the start of a plan, as its bounds on tilt allow
_CLIMB_M_S, _CLIMB_M_S2 = 2.0, 2.0
_WAY_S, _WAY_M_S, _WAY_M_S2 = 1.0, 0.5, 0.5  # how far ahead on a path around something, and how fast it is gone to
_WAY_TURNS_RAD = (0.0, 0.3, -0.3, 0.6, -0.6)
_HALT_DELAY_S = 0.6  # a stop along the own places that begins so much later must still be clear, or one begins sooner
_HALTS_AFTER_S = (0.4, 0.2, 0.0)
_UNSURE_M = 0.3  # of where vehicles are after 2 s without setpoints, as measured
_BRAKING_TAIL_S = 2.0  # part of the final braking for which keep-outs are told; `lasting` predicts them beyond it
_OUTWARD_TOLERANCE_M = 0.01  # by which proposals of a vehicle outside of the flight volume may go farther out
_APPROACH_TOLERANCE_M = 0.001  # approach allowed to trajectories that are too close already


class TrajectoryPlanner:
    """Plans proposals and evasive trajectories of one agent with an MPC on a coarse grid.

    Args:
        agent: own number.
        params: parameters of planning.
        mpc: the controller's bounds and weights.
        vehicle: its drag and bounds. Lag and dead time are made up for by the follower, which looks ahead along the
            committed trajectory; that changes no faster than the controller's inputs may.
        separation: distances to keep.
        max_keep_outs: number of neighbours and obstacles that get rows in the MPC.
        stopwatch_ns: see `CondensedMpc`.
        volume: to stay in; None for none.
    """

    def __init__(
        self,
        agent: int,
        params: CommitParams,
        mpc: MpcParams,
        vehicle: VehicleModelParams,
        separation: SeparationParams,
        *,
        max_keep_outs: int,
        stopwatch_ns: Callable[[], int],
        volume: FlightVolume | None = None,
    ) -> None:
        self._volume, self._budget = volume, separation.budget
        self._params, self._separation = params, separation
        self._drag_1_s = vehicle.drag_1_s
        right_of_way = separation.model_copy(
            update={"right_of_way_rad": params.right_of_way_rad, "stuck_m": params.stuck_m}
        )
        bounded = planning(mpc, params, vehicle)
        self._hardest_m_s2 = bounded.accel_max_m_s2(vehicle)
        self._approach = Approach(bounded, vehicle, plans=True)
        self._interpolation_margin_m = interpolation_margin_m(mpc, params, vehicle)
        self._mpc = SwarmMpc(
            bounded,
            ControllerSetup(
                vehicle=vehicle.model_copy(update={"attitude_rad_s": 0.0}),
                separation=right_of_way,
                agent=agent,
                max_keep_outs=max_keep_outs,
                stopwatch_ns=stopwatch_ns,
                volume=volume,
            ),
        )
        self.dt_us = round(params.dt_s * 1e6)
        # grid of `Situation.others`: plan and final braking
        self.steps = self._mpc.steps + math.ceil(_BRAKING_TAIL_S / params.dt_s)

    def proposal(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """Return a trajectory that leaves `committed` at `now.begin_us`, clear of everything known; None if none is."""
        found = self._clear(committed, self._planned(committed, now), now)
        if found is None and now.desired.follows_path:
            speed_m_s = float(np.linalg.norm(committed.sample(np.array([now.begin_us]))[1]))
            slower = replace(now, desired=with_run_up(now.desired, speed_m_s))
            found = self._clear(committed, self._planned(committed, slower), slower)
        if found is None and now.desired.follows_path:
            checked = (self._checked(committed, way, now) for way in self._ways_along_path(committed, now))
            found = next((way for way in checked if way is not None), None)
        return found

    def evasive_trajectory(self, committed: Trajectory, now: Situation, *, apart: bool = False) -> Trajectory | None:
        """Return a trajectory that keeps more distance to everything known than `committed`; None when none is found.

        Candidates are the MPC's plan, a straight stop, and a climb over keep-outs that end at some height. One that
        leaves the flight volume is taken only where none that stays in it is clear; with `apart`, none that passes a
        place near one that anybody known may pass, at whatever time.
        """
        known = now.followed

        def margin_m(trajectory: Trajectory) -> float:
            return min(
                self._margin_to_keep_outs_m(trajectory, now),
                self._margin_to_trajectories_m(trajectory, now.utc_us, known),
            )

        least_m = margin_m(committed) + _MIN_GAIN_M
        best, best_order = None, (False, least_m)
        for candidate in self._evasive_candidates(committed, now):
            if apart and not self._is_apart(candidate, now.utc_us, now):
                continue
            found_m = margin_m(candidate)
            order = (found_m >= 0.0 and self._stays_in_volume(candidate, committed, now.utc_us), found_m)
            if found_m > least_m and order > best_order:
                best, best_order = candidate, order
        return best

    def is_clear(self, trajectory: Trajectory, now: Situation) -> bool:
        """Tell whether a trajectory keeps the hard minimum distance to every keep-out in `now.others`."""
        return self._margin_to_keep_outs_m(trajectory, now) >= 0.0

    def conflicts(self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory], spare_m: float = 0.0) -> bool:
        """Tell whether a trajectory comes too close to any of `known` between `utc_us` and when all are at rest."""
        return not self._margin_to_trajectories_m(trajectory, utc_us, known, spare_m) >= 0.0

    def may_halt_later(self, committed: Trajectory, now: Situation) -> bool:
        """Tell whether a stop along the own places that begins `_HALT_DELAY_S` later is still clear of keep-outs."""
        later = self._halting_candidates(committed, now, _HALT_DELAY_S)
        return any(self._margin_to_keep_outs_m(candidate, now) >= _UNSURE_M for candidate in later)

    def halting(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """Return `committed`, stopped along its own places, which others do not pass; None if that gains nothing.

        See `swarmctl.control.commit.halting`. The latest and softest is returned that is clear, or else the one that
        keeps most distance.
        """
        best, best_m = None, self._margin_to_keep_outs_m(committed, now) + _MIN_GAIN_M
        for after_s in _HALTS_AFTER_S:
            for candidate in self._halting_candidates(committed, now, after_s):
                found_m = self._margin_to_keep_outs_m(candidate, now)
                if found_m >= _UNSURE_M:
                    return candidate
                if found_m > best_m:
                    best, best_m = candidate, found_m
        return best

    def stopping_from(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> Trajectory:
        """Return the trajectory that brakes straight ahead from a position (3,) and velocity (3,).

        Where it would leave the flight volume it brakes harder than `CommitParams.brake_m_s2`, up to what plans may.
        """
        brake_m_s2 = self._params.brake_m_s2
        if self._volume is not None:
            needed_m_s2 = self._volume.braking_m_s2(pos_ned_m, vel_ned_m_s)
            brake_m_s2 = max(brake_m_s2, min(needed_m_s2, self._hardest_m_s2))
        return stopping(pos_ned_m, vel_ned_m_s, utc_us, self.dt_us, brake_m_s2=brake_m_s2)

    def stopping_candidate(self, committed: Trajectory, brake_us: int, utc_us: int) -> Trajectory:
        """Return the committed trajectory from `utc_us` on, left for straight braking at `brake_us`."""
        pos, vel = committed.sample(np.array([brake_us]))
        return joined(committed, self.stopping_from(pos[0], vel[0], brake_us), utc_us)

    def _evasive_candidates(self, committed: Trajectory, now: Situation) -> Iterator[Trajectory]:
        plan = self._planned(committed, now)
        if plan is not None:
            yield ending_at_rest(
                now.begin_us, self.dt_us, plan.pos_ned_m, plan.vel_ned_m_s, brake_m_s2=self._params.brake_m_s2
            )
        yield self.stopping_candidate(committed, now.begin_us, now.utc_us)
        passable = [k for k in now.others if not k.any_height]
        if passable:
            yield self._climbing_candidate(committed, now.begin_us, passable)

    def _halting_candidates(self, committed: Trajectory, now: Situation, after_s: float) -> Iterator[Trajectory]:
        """Yield stops along the committed trajectory that begin so much later and need no acknowledgement."""
        begin_us = now.utc_us + round(1e6 * after_s)
        for brake_m_s2 in (self._params.brake_m_s2, self._hardest_m_s2):
            found = halted(committed, begin_us, now.utc_us, self.dt_us, brake_m_s2)
            if found is not None and self._is_apart(found, begin_us, now):
                yield found

    def _is_apart(self, trajectory: Trajectory, begin_us: int, now: Situation) -> bool:
        """Tell whether all places of a trajectory from a time on are apart from all that peers may pass from now on."""
        apart_m = places_apart_m(trajectory, begin_us, now.followed, now.utc_us, self._separation.downwash)
        return apart_m >= self._budget.committed_m + self._interpolation_margin_m

    def _climbing_candidate(self, committed: Trajectory, begin_us: int, passable: Sequence[KeepOut]) -> Trajectory:
        """Return the committed trajectory, left at `begin_us` for a climb from where it would stop over keep-outs."""
        pos, vel = (found[0] for found in committed.sample(np.array([begin_us])))
        above = brake_to_rest(pos, vel, self._params.brake_m_s2).to_ned_m.copy()
        above[2] = _height_above(float(above[2]), passable, self._interpolation_margin_m)
        return self._on_grid(quintic_to(pos, vel, above, _CLIMB_M_S, accel_m_s2=_CLIMB_M_S2), begin_us)

    def _ways_along_path(self, committed: Trajectory, now: Situation) -> Iterator[Trajectory]:
        """Yield straight ways as the path around what blocks the agent begins, and on either side of that.

        Between two keep-outs the MPC trades the room to one for that to the other, and every plan is refused for it.
        """
        pos, vel = (found[0] for found in committed.sample(np.array([now.begin_us])))
        north_m, east_m, down_m = now.desired.reference(np.array([_WAY_S]))[0][0] - pos
        for turn_rad in _WAY_TURNS_RAD:
            c, s = math.cos(turn_rad), math.sin(turn_rad)
            ahead = pos + np.array([c * north_m - s * east_m, s * north_m + c * east_m, down_m])
            yield self._on_grid(quintic_to(pos, vel, ahead, _WAY_M_S, accel_m_s2=_WAY_M_S2), now.begin_us)

    def _on_grid(self, trajectory: QuinticTrajectory, begin_us: int) -> Trajectory:
        steps = math.ceil(trajectory.travel_s / self._params.dt_s)
        pos_m, vel_m_s = trajectory.sample(self._params.dt_s * np.arange(steps + 1, dtype=np.float64))
        return ending_at_rest(begin_us, self.dt_us, pos_m, vel_m_s, brake_m_s2=self._params.brake_m_s2)

    def _planned(self, committed: Trajectory, now: Situation) -> Plan | None:
        steps = self._mpc.steps
        ahead_us = np.arange(steps + 1, dtype=np.float64) * self.dt_us
        pos, vel = committed.sample(now.begin_us + ahead_us)
        virtual_control = self._virtual_control(committed, now)
        start = Start(
            t_us=now.begin_us,
            pos_ned_m=pos[0],
            vel_ned_m_s=vel[0],
            cos_tilt=max(_LEAST_COS_TILT, math.sqrt(1.0 - float(virtual_control[:2] @ virtual_control[:2]))),
            virtual_control=virtual_control,
        )
        wanted = self._wanted(now, ahead_us, pos[0], vel[0])
        guess = wanted.pos_ned_m + (pos[0] - wanted.pos_ned_m[0]) if now.desired.follows_path else pos
        agents = [message.agent for message in now.peers.values() for _ in message.followed]
        keep_outs = self._keep_outs(now.followed, agents, now.begin_us, steps)
        others = [_first_steps(other, steps) for other in now.others]
        kept = KeepOuts([*keep_outs, *others]) if others else keep_outs
        plan = self._mpc.plan(
            Problem(
                start=start,
                reference=wanted,
                disturbance_ned_m_s2=now.disturbance_ned_m_s2,
                keep_outs=kept,
                guess_ned_m=guess,
            )
        )
        return None if plan.status is PlanStatus.SOLVER_FAILED else plan

    def _wanted(self, now: Situation, ahead_us: Array, begin_ned_m: Array, begin_ned_m_s: Array) -> Reference:
        """Return the desired reference at times after the plan's begin, approached from there as fast as allowed."""
        motion = now.desired.reference(1e-6 * (ahead_us + (now.begin_us - now.utc_us)))
        if not now.desired.follows_path:
            motion = self._approach.reference(
                *motion, 1e-6 * ahead_us, own_ned_m=begin_ned_m, own_ned_m_s=begin_ned_m_s
            )
        return Reference(*motion, 0.0)

    def _virtual_control(self, committed: Trajectory, now: Situation) -> Array:
        """Return the virtual controls (3,) that fly the committed trajectory when the plan begins."""
        vel = committed.sample(np.array([now.begin_us]))[1][0]
        pushed = now.disturbance_ned_m_s2 - self._drag_1_s * vel
        thrust = GRAVITY_NED_M_S2 + pushed - committed.acceleration(now.begin_us)
        size = float(np.sqrt(thrust @ thrust))
        return np.array([thrust[0] / size, thrust[1] / size, size])

    def _clear(self, committed: Trajectory, plan: Plan | None, now: Situation) -> Trajectory | None:
        """Return the longest part of a plan that is clear of everything known when followed by braking, or None."""
        if plan is None:
            return None
        for share in _BRAKE_POINTS_01:
            end = max(1, round(share * self._mpc.steps)) + 1
            braked = ending_at_rest(
                now.begin_us,
                self.dt_us,
                plan.pos_ned_m[:end],
                plan.vel_ned_m_s[:end],
                brake_m_s2=self._params.brake_m_s2,
            )
            if (whole := self._checked(committed, braked, now)) is not None:
                return whole
        return None

    def _checked(self, committed: Trajectory, leaving: Trajectory, now: Situation) -> Trajectory | None:
        """Return the committed trajectory, left for another one, if that is clear of everything known, or None."""
        whole = joined(committed, leaving, now.utc_us)
        if not self._stays_in_volume(whole, committed, now.utc_us) or not self.is_clear(whole, now):
            return None
        return None if self.conflicts(whole, now.utc_us, now.followed, self._interpolation_margin_m) else whole

    def _stays_in_volume(self, trajectory: Trajectory, committed: Trajectory, utc_us: int) -> bool:
        """Tell whether a trajectory stays in the flight volume, or goes no farther out of it than `committed` does."""
        if self._volume is None:
            return True
        end_us = max(committed.end_utc_us, utc_us)
        present = committed.sample(np.append(np.arange(utc_us, end_us, self.dt_us), end_us))[0]
        normals, kept = self._volume.normals_ned.T, self._volume.certified_m
        allowed = np.minimum(0.0, (present @ normals - kept).min(axis=0) - _OUTWARD_TOLERANCE_M)
        return bool(((trajectory.pos_ned_m @ normals - kept).min(axis=0) >= allowed).all())

    def _margin_to_keep_outs_m(self, trajectory: Trajectory, now: Situation) -> float:
        """Return the smallest margin [m] of a trajectory to `now.others`, until it is at rest however fast it is."""
        beyond = max(0, -(-(trajectory.end_utc_us - now.begin_us) // self.dt_us) - self.steps)
        others = now.others
        if beyond and others:
            others = lasting(others, beyond, self.dt_us, self._separation.brake_m_s2)
        times = now.begin_us + np.arange(self.steps + beyond + 1) * self.dt_us
        return certify(trajectory.sample(times)[0], others, 0)

    def _margin_to_trajectories_m(
        self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory], spare_m: float = 0.0
    ) -> float:
        """Return the smallest margin [m] of a trajectory to those of `known`, from `utc_us` until all are at rest."""
        if not known:
            return math.inf
        end_us = max(trajectory.end_utc_us, *(other.end_utc_us for other in known))
        steps = max(1, -(-(end_us - utc_us) // self.dt_us))
        own = trajectory.sample(utc_us + np.arange(steps + 1) * self.dt_us)[0]
        kept = self._keep_outs(known, [0] * len(known), utc_us, steps, spare_m=spare_m)
        return certify(own, kept, 0, _APPROACH_TOLERANCE_M)

    def _keep_outs(
        self,
        trajectories: Sequence[Trajectory],
        agents: Sequence[int],
        t0_utc_us: int,
        steps: int,
        *,
        spare_m: float = 0.0,
    ) -> KeepOuts:
        if not trajectories:
            return NO_KEEP_OUTS
        separation, budget = self._separation, self._budget
        spreads_m = [trajectory.spread_m(t0_utc_us) for trajectory in trajectories]
        where = positions_at(trajectories, t0_utc_us + np.arange(steps + 1) * self.dt_us)
        found = [
            keep_out_of_commitment(points, agent, separation, budget, spread_m=spread_m, spare_m=spare_m)
            for points, agent, spread_m in zip(where, agents, spreads_m, strict=True)
        ]
        return KeepOuts(found, where)


def _height_above(z_ned_m: float, passable: Sequence[KeepOut], spare_m: float) -> float:
    """Return the height nearest above `z_ned_m`, NED [m], at which a vehicle passes over the keep-outs from there on.

    It climbs over those that are passed neither above nor below at its own height, and where that leads it to others,
    over these.
    """
    reaches = [(k.radius_m / k.vertical_01 + spare_m, k.pos_ned_m[:, 2]) for k in passable]
    bands = [(float(z_m.min()) - reach_m, float(z_m.max()) + reach_m) for reach_m, z_m in reaches]
    for top_m, bottom_m in sorted(bands, key=lambda band: band[1], reverse=True):
        if top_m < z_ned_m < bottom_m:
            z_ned_m = top_m
    return z_ned_m


def _first_steps(keep_out: KeepOut, steps: int) -> KeepOut:
    """Return the keep-out, cut to its first `steps`."""
    return replace(keep_out, pos_ned_m=keep_out.pos_ned_m[: steps + 1])
