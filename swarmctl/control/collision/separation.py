"""Separation: aligns peers' paths in time, linearises distances for the MPC, certifies plans independently of the QP.

Peers' predictions are time-stamped; each is interpolated at the own prediction times, continued beyond its end by
braking to a stop, and given a margin that grows with age. A stale peer therefore turns into a keep-out where it was
last expected to stop. Half-spaces are the thesis' distance constraints (4.1), (4.2) linearised at the own previous
prediction.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from swarmctl.control.collision.budget import SeparationBudget
from swarmctl.control.mpc.axes import HalfSpaces
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params
from swarmctl.core.trajectory import Polylines, braking_displacement, braking_displacements, grid
from swarmctl.core.types import Array, PredictedPath

_TINY_M = 1e-6
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
    approach_01: float = Field(0.0, ge=0, le=1)  # plans keep this share more of what two are still to come closer
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


@dataclass(frozen=True, slots=True, kw_only=True)
class KeepOut:
    """Describes one thing to keep clear of, at the times of the own prediction."""

    pos_ned_m: Array  # (Hp+1, 3)
    radius_m: float  # constraint distance between centres
    hard_min_distance_m: float  # plans that come closer are refused
    any_height: bool  # a vertical cylinder instead of a sphere
    priority_id: int  # agent number, -1 an obstacle; decides the side when centres coincide
    downwash: float = 1.0  # ratio of height to width of the ellipsoid; 1 is a sphere
    key: int | None = None  # the same in all ticks; None: encounters with it are not remembered
    entered_m: float | None = None  # distance at which the present violation began; None: with this tick

    @property
    def vertical_01(self) -> float:
        """Return the factor on vertical distances."""
        return 0.0 if self.any_height else 1.0 / self.downwash

    def apart_m(self, pos_ned_m: Array) -> float:
        """Return the distance [m] of a position (3,) from its centre now, by which it is violated or not."""
        towards = pos_ned_m - self.pos_ned_m[0]
        return math.hypot(towards[0], towards[1], towards[2] * self.vertical_01)

    def distance_m(self, pos_ned_m: Array) -> float:
        """Return the distance [m] of a position (3,) from its centre now; in the plane when it holds at any height."""
        axes = 2 if self.any_height else 3
        return math.dist(self.pos_ned_m[0, :axes], pos_ned_m[:axes])


class KeepOuts(tuple[KeepOut, ...]):
    """Several keep-outs, and what is computed of all of them at once, stacked.

    Args:
        keep_outs: with equal numbers of positions.
        pos_ned_m: these positions, if they are stacked already.

    Attributes:
        pos_ned_m: (S, Hp+1, 3).
        radius_m, hard_min_distance_m, vertical_01: (S, 1).
        obstacles: indices of those that are no peers.
    """

    pos_ned_m: Array
    radius_m: Array
    hard_min_distance_m: Array
    vertical_01: Array
    obstacles: list[int]

    def __new__(cls, keep_outs: Iterable[KeepOut] = (), pos_ned_m: Array | None = None) -> KeepOuts:
        found = super().__new__(cls, keep_outs)
        if not found:
            return found
        if pos_ned_m is None:
            pos_ned_m = np.concatenate([k.pos_ned_m for k in found]).reshape(len(found), -1, 3)
        found.pos_ned_m = pos_ned_m
        numbers = np.array([(k.radius_m, k.hard_min_distance_m, k.vertical_01) for k in found])
        found.radius_m, found.hard_min_distance_m, found.vertical_01 = numbers[:, :1], numbers[:, 1:2], numbers[:, 2:]
        found.obstacles = [i for i, k in enumerate(found) if k.priority_id < 0]
        return found

    def apart(self, path_ned_m: Array) -> Array:
        """Return the way (S, Hp+1, 3) from each of them to a path (Hp+1, 3), heights as they count."""
        apart = path_ned_m - self.pos_ned_m
        apart[:, :, 2] *= self.vertical_01
        return apart


NO_KEEP_OUTS = KeepOuts()


def stacked(keep_outs: Iterable[KeepOut]) -> KeepOuts:
    """Return keep-outs as such, stacked if they are not yet."""
    return keep_outs if isinstance(keep_outs, KeepOuts) else KeepOuts(keep_outs)


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
    low = np.minimum(np.maximum(k.astype(np.int64), 0), last - 1)
    begins = points.take(low, axis=0)
    found: Array = points[1:].take(low, axis=0)
    found -= begins
    found *= (np.minimum(k, last) - low)[:, None]
    found += begins
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
) -> KeepOut:
    """Return the keep-out of one peer whose positions (steps+1, 3) from `t0_utc_us` on are known already.

    Otherwise as `keep_out_of_peer`; `budget` is that of `params`.
    """
    age_s = max(0.0, (t0_utc_us - path.t0_utc_us) * 1e-6)
    return KeepOut(
        pos_ned_m=points_ned_m,
        radius_m=budget.planned_peer_m(path.margin_m, budget.age_margin_m(age_s, parked)),
        hard_min_distance_m=budget.certified_peer_m(path.margin_m),
        any_height=landing or (age_s > params.lost_after_s and not parked),
        priority_id=path.agent,
        downwash=params.downwash,
        key=path.agent,
    )


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


def half_spaces(
    keep_outs: Sequence[KeepOut],
    guess_ned_m: Array,
    goal_m: Array,
    vel_m_s: Array,
    *,
    dt_s: float,
    own_priority_id: int,
    params: SeparationParams,
) -> HalfSpaces | None:
    """Linearise distance constraints for steps 1..Hp, in the plane or in space; None without keep-outs.

    Args:
        keep_outs: at most as many as `max_keep_outs` of the problem.
        guess_ned_m: (Hp+1, 3) own previous prediction at the same times.
        goal_m: (2,) or (3,) end of the reference: defines head-on, and the number of axes.
        vel_m_s: (2,) or (3,) own velocity at the first point.
        dt_s: time between points.
        own_priority_id: own agent id.
        params: right of way, gate and braking.

    In the plane, a height difference dz leaves `sqrt(R^2 - dz^2)` of a radius R to keep horizontally. A keep-out at any
    height is a vertical cylinder. A keep-out with downwash is an ellipsoid: a sphere after heights are scaled.
    """
    if not keep_outs:
        return None
    known, axes = stacked(keep_outs), len(goal_m)
    scaled, others = known.apart(guess_ned_m)[:, 1:], known.pos_ned_m[:, 1:, :axes]  # (keep-outs, Hp, .)
    kept_m = known.radius_m
    if params.approach_01:
        kept_m = kept_m + _approach_m(known, guess_ned_m[0], scaled, params)
    apart, needed2 = scaled[:, :, :axes], kept_m**2
    if axes == 2:
        needed2 = np.maximum(needed2 - scaled[:, :, 2] ** 2, 0.0)
    needed = np.sqrt(needed2)  # (keep-outs, Hp), in space perhaps (keep-outs, 1)
    distance = np.sqrt(np.einsum("skc,skc->sk", apart, apart))
    normal = apart / np.maximum(distance, _TINY_M)[:, :, None]
    if distance.min() < _TINY_M:
        _part_coincident(normal, distance, [own_priority_id > k.priority_id for k in known])
    moved = math.dist(guess_ned_m[-1, :axes], guess_ned_m[0, :axes])
    stuck_01 = min(1.0, max(0.0, 2.0 - moved / params.stuck_m))
    if stuck_01 or known.obstacles:
        to_goal = goal_m - guess_ned_m[1:, :axes]  # (Hp, axes)
        angle_rad = _largest_turns(normal, to_goal, known.obstacles, stuck_01, params)
        normal = _with_right_of_way(normal, distance, needed, to_goal, angle_rad=angle_rad)
    if axes == 3:
        normal[:, :, 2] *= known.vertical_01  # back from scaled to true heights
    offset = np.einsum("skc,skc->sk", normal, others) + needed
    idle = (needed <= 0.0) | (distance > needed + params.gate_m)
    last = normal[:, -1]  # (keep-outs, axes)
    ends = (others[:, -1] - others[:, -2]) / dt_s  # (keep-outs, axes) velocity of each keep-out at the end
    closing = -np.einsum("sc,sc->s", last, vel_m_s - ends)
    stop_s = np.maximum(closing, 0.0) / (2.0 * params.stop_m_s2)
    squeezed = [i for i, k in enumerate(known) if k.downwash > 1.0 and not k.any_height]
    if squeezed:  # braking is scaled likewise
        stop_s[squeezed] /= np.maximum(np.linalg.norm(last[squeezed], axis=1), _TINY_M)
    stop_offset = offset[:, -1] + stop_s * np.einsum("sc,sc->s", last, ends)
    offset[idle] = -np.inf
    stop_offset[idle[:, -1]] = -np.inf
    return HalfSpaces(normal=normal, offset_m=offset, stop_s=stop_s, stop_offset_m=stop_offset)


def _part_coincident(normal: Array, distance: Array, has_priority: Sequence[bool]) -> None:
    """Set normals (slots, Hp, axes) where distances (slots, Hp) have no direction: sideways, by priority."""
    sides = np.zeros((len(normal), 1, normal.shape[2]))
    sides[:, 0, 0] = np.where(has_priority, 1.0, -1.0)
    np.copyto(normal, sides, where=(distance < _TINY_M)[:, :, None])


def _largest_turns(
    normal: Array, to_goal: Array, obstacles: Sequence[int], stuck_01: float, params: SeparationParams
) -> Array:
    """Return the largest turn (slots, Hp) of each normal (slots, Hp, axes): of obstacles away from the side it is on.

    Args:
        normal: unit vectors from keep-outs to the guess.
        to_goal: (Hp, axes) from the guess to the goal.
        obstacles: slots of obstacles.
        stuck_01: how far the own plan is stuck.
        params: angles.
    """
    angle_rad = np.full(normal.shape[:2], params.right_of_way_rad * stuck_01)
    if obstacles:
        across = to_goal[:, 0] * normal[obstacles, :, 1] - to_goal[:, 1] * normal[obstacles, :, 0]  # > 0: on the left
        angle_rad[obstacles] = params.right_of_way_obstacle_rad * np.where(across > 0.0, -1.0, 1.0)
    return angle_rad


def _approach_m(keep_outs: KeepOuts, here_ned_m: Array, apart: Array, params: SeparationParams) -> Array:
    """Return the distance (keep-outs, Hp) kept beyond the constraint's from peers that come closer than they are now.

    Prediction errors grow with the relative motion still to be flown: tilt is answered with a few per cent less and
    accelerations bend the estimate. The margin shrinks on the way and is zero in a formation.

    Args:
        keep_outs: peers and obstacles.
        here_ned_m: (3,) own position at the first point.
        apart: (keep-outs, Hp, 3) from them to the guess, heights as they count.
        params: share and limit.
    """
    now_m = np.array([k.apart_m(here_ned_m) for k in keep_outs])[:, None]
    closing_m = np.maximum(now_m - np.sqrt(np.einsum("skc,skc->sk", apart, apart)), 0.0)
    closing_m[keep_outs.obstacles] = 0.0
    return np.asarray(np.minimum(params.approach_01 * closing_m, params.approach_max_m))


def _with_right_of_way(normal: Array, distance: Array, needed: Array, to_goal: Array, *, angle_rad: Array) -> Array:
    """Return normals (slots, Hp, axes), turned where they point against the goal, so that head-on agents pass.

    Peers follow one right-of-way rule: each turns normals clockwise seen from above (as NED yaw), so that two that meet
    head-on both give way to the left. Obstacles are passed on the side the agent is on. `angle_rad` (max_keep_outs, Hp)
    is the largest turn: full for obstacles, for peers only when the own plan is stuck, because turned normals would
    also keep a swarm that shares one goal from closing in evenly.
    """
    if not angle_rad.any():
        return normal
    span = np.sqrt(np.einsum("kc,kc->k", to_goal, to_goal))  # (Hp,)
    ahead = -np.einsum("skc,kc->sk", normal, to_goal) / np.maximum(span, _TINY_M)  # cosine: 1 is head-on
    weight = np.clip((ahead - 0.7) / 0.3, 0.0, 1.0) * (span > 0.75 * needed) * (distance < 2.0 * needed + 0.5)
    angle = angle_rad * weight
    c, s = np.cos(angle), np.sin(angle)
    turned = normal.copy()
    turned[:, :, 0] = c * normal[:, :, 0] - s * normal[:, :, 1]
    turned[:, :, 1] = s * normal[:, :, 0] + c * normal[:, :, 1]
    return turned


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
