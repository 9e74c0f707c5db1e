"""Half-spaces: the thesis' distance constraints (4.1), (4.2), linearised at the own previous prediction for the MPC."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts, stacked
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.mpc.condensed_qp.axes import HalfSpaces
from swarmctl.core.types import Array

_TINY_M = 1e-6  # nearer centres have no direction
_ABOVE_01 = 0.02  # level part of a normal (at most) between agents that are above each other
_SWING_M = 0.05  # approach that needs no more room: agents of a formation, kept apart for it, would swing the more


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
        to_goal = np.tile(goal_m - guess_ned_m[1:, :axes], (len(known), 1, 1))
        to_goal[known.obstacles] -= (others[:, -1:] - others[:, :1])[known.obstacles]  # as seen from a moving one
        angle_rad = _largest_turns(normal, to_goal, known.obstacles, stuck_01, params)
        normal = _with_right_of_way(normal, distance, needed, to_goal, angle_rad=angle_rad)
    if axes == 3:
        normal[:, :, 2] *= known.vertical_01  # back from scaled to true heights
    offset = np.einsum("skc,skc->sk", normal, others) + needed
    idle = (needed <= 0.0) | (distance > needed + params.gate_m)
    stop_s, moved_m = _stops(known, normal[:, -1], others, vel_m_s, dt_s=dt_s, stop_m_s2=params.stop_m_s2)
    stop_offset = offset[:, -1] + moved_m
    offset[idle] = -np.inf
    stop_offset[idle[:, -1]] = -np.inf
    return HalfSpaces(normal=normal, offset_m=offset, stop_s=stop_s, stop_offset_m=stop_offset)


def _stops(
    known: KeepOuts, last: Array, others: Array, vel_m_s: Array, *, dt_s: float, stop_m_s2: float
) -> tuple[Array, Array]:
    """Return (keep-outs,) how long braking towards each takes at the end, and how far it moves away meanwhile.

    Args:
        known: the keep-outs.
        last: (keep-outs, axes) normals at the last step.
        others: (keep-outs, Hp, axes) places of the keep-outs.
        vel_m_s: (axes,) own velocity at the first point.
        dt_s: time between points.
        stop_m_s2: see `SeparationParams`.
    """
    ends = (others[:, -1] - others[:, -2]) / dt_s  # (keep-outs, axes) velocity of each keep-out at the end
    closing = -np.einsum("sc,sc->s", last, vel_m_s - ends)
    stop_s = np.maximum(closing, 0.0) / (2.0 * stop_m_s2)
    squeezed = [i for i, k in enumerate(known) if k.downwash > 1.0 and not k.any_height]
    if squeezed:  # braking is scaled likewise
        stop_s[squeezed] /= np.maximum(np.linalg.norm(last[squeezed], axis=1), _TINY_M)
    return stop_s, stop_s * np.einsum("sc,sc->s", last, ends)


def _part_coincident(normal: Array, distance: Array, has_priority: Sequence[bool]) -> None:
    """Set normals (keep-outs, Hp, axes) where distances (keep-outs, Hp) have no direction: sideways, by priority."""
    sides = np.zeros((len(normal), 1, normal.shape[2]))
    sides[:, 0, 0] = np.where(has_priority, 1.0, -1.0)
    np.copyto(normal, sides, where=(distance < _TINY_M)[:, :, None])


def _largest_turns(
    normal: Array, to_goal: Array, obstacles: Sequence[int], stuck_01: float, params: SeparationParams
) -> Array:
    """Return the largest turn (keep-outs, Hp) of each normal: of obstacles away from the side that the agent is on.

    Args:
        normal: (keep-outs, Hp, axes) unit vectors from keep-outs to the guess.
        to_goal: (keep-outs, Hp, axes) from the guess to the goal.
        obstacles: indices of the keep-outs that are obstacles.
        stuck_01: how far the own plan is stuck.
        params: angles.
    """
    angle_rad = np.full(normal.shape[:2], params.right_of_way_rad * stuck_01)
    if obstacles:
        way, side = to_goal[obstacles], normal[obstacles]
        across = way[:, :, 0] * side[:, :, 1] - way[:, :, 1] * side[:, :, 0]  # > 0: on the left
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
    closing_m = np.maximum(now_m - np.sqrt(np.einsum("skc,skc->sk", apart, apart)) - _SWING_M, 0.0)
    closing_m[keep_outs.obstacles] = 0.0
    return np.asarray(np.minimum(params.approach_01 * closing_m, params.approach_max_m))


def _with_right_of_way(normal: Array, distance: Array, needed: Array, to_goal: Array, *, angle_rad: Array) -> Array:
    """Return normals (keep-outs, Hp, axes), turned where they point against the goal, so that head-on agents pass.

    Peers follow one right-of-way rule: each turns normals clockwise seen from above (as NED yaw), so that two that meet
    head-on both give way to the left. Obstacles are passed on the side the agent is on. `angle_rad` (keep-outs, Hp)
    is the largest turn: full for obstacles, for peers only when the own plan is stuck, because turned normals would
    also keep a swarm that shares one goal from closing in evenly. `to_goal` (keep-outs, Hp, axes) is what is left to
    fly with regard to the keep-out: one that moves towards an agent at its goal is passed as well, not fled from. Of
    two exactly above each other, for which there is no clockwise, the lower one gives way to the north.
    """
    if not angle_rad.any():
        return normal
    span = np.sqrt(np.einsum("skc,skc->sk", to_goal, to_goal))
    ahead = -np.einsum("skc,skc->sk", normal, to_goal) / np.maximum(span, _TINY_M)  # cosine: 1 is head-on
    weight = np.clip((ahead - 0.7) / 0.3, 0.0, 1.0) * (span > 0.75 * needed) * (distance < 2.0 * needed + 0.5)
    angle = angle_rad * weight
    c, s = np.cos(angle), np.sin(angle)
    turned = normal.copy()
    turned[:, :, 0] = c * normal[:, :, 0] - s * normal[:, :, 1]
    turned[:, :, 1] = s * normal[:, :, 0] + c * normal[:, :, 1]
    if normal.shape[2] == 3:
        above = np.hypot(normal[:, :, 0], normal[:, :, 1]) < _ABOVE_01
        turned[above, 0] += s[above] * normal[above, 2]
        turned[above, 2] *= c[above]
    return turned
