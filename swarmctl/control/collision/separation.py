"""Separation: what plans keep clear of, with peers' paths aligned in time, and a certificate independent of the QP.

Peers' predictions are time-stamped; each is interpolated at the own prediction times, continued beyond its end by
braking to a stop, and given a margin that grows with age. A stale peer therefore turns into a keep-out where it was
last expected to stop. `half_spaces` makes constraints of the MPC from keep-outs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from swarmctl.control.collision.budget import SeparationBudget
from swarmctl.control.collision.keep_outs import KeepOut, stacked
from swarmctl.core.autopilot_stop import without_setpoints_ned_m
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params
from swarmctl.core.trajectory import Polylines, braking_displacement, braking_displacements, grid, interpolated
from swarmctl.core.types import Array, PredictedPath

_TINY_M = 1e-6
_KEEPS_S = 0.5  # COM_OF_LOSS_T, as agents set it
_STOPS_US = 2_500_000  # until then the way without setpoints is told, after which little is left of its speed
_MOST_M_S2 = 5.0  # of a kept acceleration: points are rounded, and second differences are sensitive to it
_APPROACH_TOLERANCE_M = 0.02  # approach allowed in a whole encounter with a keep-out that is violated already


class SeparationParams(Params):
    """Sets the distances that are kept and the margins for uncertainty."""

    mode: Literal["best_effort", "guaranteed"] = "best_effort"  # guaranteed: see `swarmctl.control.commit.protocol`
    radius_m: float = Field(0.9, gt=0, le=100)  # centre to centre, thesis 3 x 0.3
    body_m: float = Field(0.48, gt=0, le=100)  # centres of two vehicles that touch; thesis: twice its arm of 0.24 m
    tracking_m: float = Field(0.0, ge=0, le=10)  # tracking error: plans keep this much more
    gust_m_s: float = Field(0.0, ge=0, le=40)  # sudden change of wind that distances leave room for
    downwash: float = Field(1.0, ge=1, le=10)  # divides height differences among peers: 2 for x500-size rotors
    allow_small_radius: bool = False  # fly although radius_m is below what body, tracking and estimator need
    certify_slack_m: float = Field(0.1, ge=0, le=10)  # a plan closer than radius minus this is never flown
    age_accel_m_s2: float = Field(4.0, ge=0, le=50)  # margin a t^2 / 2 with the age of a path
    age_margin_max_m: float = Field(1.0, ge=0, le=50)  # largest such margin
    brake_m_s2: float = Field(3.0, gt=0, le=50)  # assumed braking of a peer beyond its prediction
    lost_after_s: float = Field(0.5, gt=0, le=60)  # a path this old is kept clear of at every height
    gate_m: float = Field(3.0, gt=0, le=1000)  # rows farther than this from being active are left out
    approach_01: float = Field(0.1, ge=0, le=1)  # plans keep this share more of what two are still to come closer
    approach_max_m: float = Field(0.15, ge=0, le=10)  # largest distance added by `approach_01`
    stop_m_s2: float = Field(1.0, gt=0, le=50)  # braking that plans leave room for beyond their horizon
    relax_01: float = Field(0.9, gt=0, le=1)  # share of the reachable displacement a row may ask for
    right_of_way_rad: float = Field(0.35, ge=0, le=1.2)  # largest turn of head-on normals among peers
    right_of_way_obstacle_rad: float = Field(0.35, ge=0, le=1.2)  # largest turn of head-on normals before obstacles
    stuck_m: float = Field(0.1, gt=0, le=10)  # a plan that moves less over its horizon is stuck
    max_neighbours: int = Field(8, ge=1, le=99)  # the nearest peers get rows
    max_obstacles: int = Field(6, ge=1, le=50)  # the nearest get rows; all visible ones are certified against

    @property
    def budget(self) -> SeparationBudget:
        """Return all distances that follow from these parameters."""
        return SeparationBudget(
            body_m=self.body_m,
            tracking_m=self.tracking_m,
            radius_m=self.radius_m,
            certify_slack_m=self.certify_slack_m,
            age_accel_m_s2=self.age_accel_m_s2,
            age_margin_max_m=self.age_margin_max_m,
        )


def radius_problem(params: SeparationParams, accuracy_m: float, drift_m: float) -> str:
    """Say why the radius is too small, and what to do; "" when it is large enough or allowed.

    Args:
        params: distances.
        accuracy_m: rms error of the estimator per horizontal axis.
        drift_m: how far a gust of `gust_m_s` blows a vehicle.
    """
    needed_m = params.budget.required_m(accuracy_m, drift_m)
    if params.allow_small_radius or params.radius_m >= needed_m:
        return ""
    if math.isinf(drift_m):
        return (
            f"separation.gust_m_s = {params.gust_m_s:g}: no radius suffices, as a vehicle cannot stand in such a wind. "
            "Lower it, or allow more tilt (controller.mpc.u_max, vehicle_model.tilt_max_rad) and thrust "
            "(controller.mpc.thrust_max_m_s2)"
        )
    gust = f" and gusts of {params.gust_m_s:g} m/s, each {drift_m:.2f} m," if drift_m else ""
    return (
        f"separation.radius_m = {params.radius_m:g}: body {params.body_m:g} m, tracking {params.tracking_m:g} m and an "
        f"estimator that is {accuracy_m:.2f} m off (rms){gust} need {needed_m:.2f} m. Raise it, give the autopilot a "
        "better position, or set separation.allow_small_radius = true"
    )


def align(path: PredictedPath, t0_utc_us: int, dt_us: int, steps: int, *, brake_m_s2: float) -> Array:
    """Return positions (steps+1, 3) of one peer at `t0_utc_us + k dt_us`; see `aligned`."""
    points, dt_s, last = path.pos_ned_m, path.dt_us * 1e-6, len(path.pos_ned_m) - 1
    since, pace = (t0_utc_us - path.t0_utc_us) / path.dt_us, dt_us / path.dt_us
    k = since + grid(steps) * pace  # (steps+1,) in points
    found = interpolated(points, k, last)
    if since + steps * pace > last:
        tail = max(0, math.floor((last - since) / pace))
        found[tail:] += braking_displacement((points[-1] - points[-2]) / dt_s, (k[tail:] - last) * dt_s, brake_m_s2)
    return found


def aligned(paths: Sequence[PredictedPath], t0_utc_us: int, dt_us: int, steps: int, *, brake_m_s2: float) -> Array:
    """Return positions (N, steps+1, 3) NED [m] of N peers at `t0_utc_us + k dt_us`.

    Paths are interpolated, then continued by braking to a stop. Times before the first point are extrapolated
    backwards along the first segment.
    """
    sinces = [(t0_utc_us - path.t0_utc_us) / path.dt_us for path in paths]  # in points, as all numbers of steps here
    paces = [dt_us / path.dt_us for path in paths]
    k = np.array(sinces)[:, None] + grid(steps) * np.array(paces)[:, None]  # (N, steps+1)
    known = Polylines([path.pos_ned_m for path in paths])
    found = known.at(k)
    ends = min((len(p.pos_ned_m) - 1 - s) / pace for p, s, pace in zip(paths, sinces, paces, strict=True))
    if ends <= steps:
        tail = max(0, math.floor(ends))  # from where on some path is continued
        steps_s = np.array([path.dt_us * 1e-6 for path in paths])[:, None]
        beyond_s = (k[:, tail:] - known.lasts) * steps_s
        found[:, tail:] += braking_displacements(known.last_legs() / steps_s, beyond_s, brake_m_s2)
    return found


def without_setpoints(
    path: PredictedPath,
    *,
    lag_s: float = 0.0,
    drag_1_s: float = 0.0,
    keeps_s: float | None = None,
    coasts_s: float | None = None,
) -> PredictedPath:
    """Return the path of a vehicle that has received no setpoint since it began to fly a path.

    Its autopilot keeps the last attitude and thrust for a while, so the acceleration goes on that the vehicle has when
    it has taken that attitude, instead of what was planned to follow: the one that its last setpoint asks for, if that
    is told, or the level one of the path. It may then fly on level. Where the returned path ends the autopilot brakes,
    as beyond the end of any path.

    Args:
        path: what was planned.
        lag_s: time in which the vehicle takes the attitude of a setpoint. It flies as planned meanwhile: a path that
            turns goes on to turn.
        drag_1_s: linear drag over mass.
        keeps_s: how long the autopilot keeps the attitude; None: as agents set a PX4.
        coasts_s: until when it flies on level then; None: it brakes at once.
    """
    dt_s = path.dt_us * 1e-6
    keeps_s = _KEEPS_S if keeps_s is None else keeps_s
    coasts_s = keeps_s if coasts_s is None else max(keeps_s, coasts_s)
    lag_steps = max(0, min(round(min(lag_s, keeps_s) / dt_s), len(path.pos_ned_m) - 3))
    first, second = path.pos_ned_m[lag_steps : lag_steps + 2]
    accel = _level_accel_ned_m_s2(path, lag_steps)
    vel = (second - first) / dt_s - 0.5 * dt_s * accel  # at the first point
    if path.setpoint_accel_ned_m_s2 is not None:
        accel = path.setpoint_accel_ned_m_s2 - drag_1_s * vel
    ahead_s, lagged_s = grid(max(1, round(_STOPS_US / path.dt_us) - lag_steps)) * dt_s, lag_steps * dt_s
    limits = {"keeps_s": keeps_s - lagged_s, "coasts_s": coasts_s - lagged_s, "drag_1_s": drag_1_s}
    pos = without_setpoints_ned_m(first, vel, accel, ahead_s, **limits)
    return replace(path, pos_ned_m=np.concatenate((path.pos_ned_m[:lag_steps], pos)) if lag_steps else pos)


def _level_accel_ned_m_s2(path: PredictedPath, step: int) -> Array:
    """Return the acceleration (3,) in the plane that was planned at a point, by the bend of the path there."""
    if len(path.pos_ned_m) < 3:
        return np.zeros(3)
    first, second, third = path.pos_ned_m[step : step + 3]
    bend, dt_s = third - 2.0 * second + first, path.dt_us * 1e-6
    bend[2] = 0.0
    most_m, size_m = _MOST_M_S2 * dt_s**2, math.hypot(bend[0], bend[1])
    bend *= most_m / max(size_m, most_m)
    return np.asarray(bend / dt_s**2)


def keep_out_of_peer(
    path: PredictedPath,
    t0_utc_us: int,
    dt_us: int,
    steps: int,
    *,
    params: SeparationParams,
    parked: bool = False,
    landing: bool = False,
) -> KeepOut:
    """Return the keep-out of one peer.

    Args:
        path: the peer's newest path.
        t0_utc_us, dt_us, steps: times of the own prediction.
        params: distance and margins.
        parked: whether the peer has landed, so that its margin does not grow with age.
        landing: whether either vehicle is about to descend, so that the keep-out holds at every height.
    """
    points = align(path, t0_utc_us, dt_us, steps, brake_m_s2=params.brake_m_s2)
    return keep_out_along(path, points, t0_utc_us, params, params.budget, parked=parked, landing=landing)


def keep_out_along(
    path: PredictedPath,
    points_ned_m: Array,
    t0_utc_us: int,
    params: SeparationParams,
    budget: SeparationBudget,
    *,
    parked: bool,
    landing: bool,
    here_ned_m: Array | None = None,
    way: int = 0,
) -> KeepOut:
    """Return the keep-out of one peer whose positions (steps+1, 3) from `t0_utc_us` on are known already.

    Otherwise as `keep_out_of_peer`; `budget` is that of `params`, `here_ned_m` (3,) the own position; None if unknown.
    Where a peer may take several ways, each has a keep-out, and `way` tells it from the others.

    Where a path is older than `lost_after_s`, its margin of age makes the radius no larger than the present distance:
    it keeps this agent from coming closer, and does not drive it away. The silent peer may hear this agent, and count
    on its shared path. Driven away from where the peer was expected, agents came to 0.66 m of where it was.
    """
    age_s = max(0.0, (t0_utc_us - path.t0_utc_us) * 1e-6)
    radius_m = budget.planned_peer_m(path.margin_m, budget.age_margin_m(age_s, parked))
    if here_ned_m is not None and age_s > params.lost_after_s:
        apart_m = math.dist(points_ned_m[0, :2], here_ned_m[:2])  # level, as is kept from a silent peer
        radius_m = not_driving_away_m(radius_m, apart_m, budget.planned_peer_m(path.margin_m, 0.0))
    return KeepOut(
        pos_ned_m=points_ned_m,
        radius_m=radius_m,
        hard_min_distance_m=budget.certified_peer_m(path.margin_m),
        any_height=landing or (age_s > params.lost_after_s and not parked),
        priority_id=path.agent,
        downwash=params.downwash,
        key=(path.agent, way),
    )


def keep_out_of_commitment(
    points_ned_m: Array,
    agent: int,
    params: SeparationParams,
    budget: SeparationBudget,
    *,
    spread_m: float = 0.0,
    spare_m: float = 0.0,
) -> KeepOut:
    """Return the keep-out of a peer on a trajectory that it has committed to.

    Args:
        points_ned_m: its positions (steps+1, 3) on the own time grid.
        agent: its number.
        params, budget: distances; `budget` is that of `params`.
        spread_m: how far off these points it may be because its clock is not known exactly.
        spare_m: added to the hard minimum distance.
    """
    return KeepOut(
        pos_ned_m=points_ned_m,
        radius_m=budget.planned_m + spread_m,
        hard_min_distance_m=budget.committed_m + spread_m + spare_m,
        any_height=False,
        priority_id=agent,
        downwash=params.downwash,
    )


def not_driving_away_m(wanted_m: float, apart_m: float, least_m: float) -> float:
    """Return a distance to keep from a silent peer that is no larger than the present one, but at least `least_m`."""
    return min(wanted_m, max(apart_m, least_m))


def keep_out_of_obstacle(
    obstacle: Obstacle, dt_us: int, steps: int, params: SeparationParams, *, number: int | None = None
) -> KeepOut:
    """Return the keep-out of a visible obstacle, predicted at constant velocity.

    Args:
        obstacle: as it is at the first point.
        dt_us, steps: time grid of the plan.
        params: distances.
        number: the same in all ticks; None: encounters with it are not remembered.
    """
    t_s = np.arange(steps + 1) * (dt_us * 1e-6)
    return KeepOut(
        pos_ned_m=obstacle.center_after(t_s[:, None]),
        radius_m=obstacle.keep_out_m,
        hard_min_distance_m=params.budget.certified_obstacle_m(obstacle.keep_out_m),
        any_height=obstacle.column,
        priority_id=-1,
        key=None if number is None else -1 - number,  # peers have the others
    )


def visible(obstacles: Sequence[Obstacle], pos_ned_m: Array) -> list[Obstacle]:
    """Return obstacles whose centre is closer than their visibility distance now (4.2, as corrected)."""
    return [o for o in obstacles if o.distance_m(pos_ned_m) < o.visibility_m]


def certify(
    path_ned_m: Array,
    keep_outs: Sequence[KeepOut],
    from_step: int,
    approach_m: float = _APPROACH_TOLERANCE_M,
) -> float:
    """Return the smallest margin [m] of a path to all keep-outs, over true distances between samples too.

    Args:
        path_ned_m: (Hp+1, 3) own plan.
        keep_outs: keep-outs at the same times.
        from_step: first step that the plan can still change.
        approach_m: how much closer than where it was entered a path may come to a keep-out that is violated already.

    Returns:
        The minimum over keep-outs of distance minus hard minimum distance. Where a keep-out is violated now already, a
        path has margin 0 that stays above where it was entered less `approach_m`, or comes no closer than it is now.
        Infinite without keep-outs.
    """
    if not keep_outs:
        return math.inf
    known = stacked(keep_outs)
    apart = known.apart(path_ned_m)
    begins = apart[:, :-1]
    step = apart[:, 1:] - begins
    length2 = np.maximum(np.einsum("mkc,mkc->mk", step, step), 1e-18)
    nearest = np.minimum(np.maximum(-np.einsum("mkc,mkc->mk", begins, step) / length2, 0.0), 1.0)
    step *= nearest[:, :, None]
    step += begins  # the point of each relative segment that is closest to the origin
    distance2_m2 = np.einsum("mkc,mkc->mk", step, step)  # (m, Hp)
    later2_m2 = distance2_m2[:, min(from_step, distance2_m2.shape[1] - 1) :].min(axis=1)
    now2_m2 = np.einsum("mc,mc->m", apart[:, 0], apart[:, 0])
    squares = zip(known, now2_m2.tolist(), later2_m2.tolist(), strict=True)
    margins_m = [_margin_m(k, math.sqrt(now2), math.sqrt(later2), approach_m) for k, now2, later2 in squares]
    return float(np.array(margins_m).min())  # NaN if any is


def _margin_m(keep_out: KeepOut, now_m: float, later_m: float, approach_m: float) -> float:
    """Return the margin of a path to one keep-out that is `now_m` away, and later at least `later_m`."""
    allowed_m = keep_out.hard_min_distance_m
    if now_m < allowed_m:
        entered_m = now_m if keep_out.entered_m is None else keep_out.entered_m
        if later_m >= min(now_m, entered_m - approach_m) - _TINY_M:
            return 0.0
    return later_m - allowed_m
