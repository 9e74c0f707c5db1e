"""How a vehicle moves that gets no setpoint any more: its autopilot keeps the attitude, may coast, and brakes to rest.

Autopilots begin to brake late, and brake softly. True ways to rest of a PX4 1.18 (MPC_ACC_HOR = 3 m/s2) in LAND were
0.3, 1.5 and 2.8 m from 0.8, 2.1 and 3.4 m/s, of an ArduCopter 4.6.3 0.5, 1.2 and 4.1 m from 1.0, 1.9 and 4.0 m/s. Here
they are 0.3, 1.5 and 3.4, 0.4, 1.2 and 4.5 m; braking at once at 3 m/s2 gives 0.1, 0.7 and 1.9, 0.2, 0.6 and 2.6 m. In
hold they need longer, ArduCopter most: 3.1 m from 2.0 m/s in BRAKE.

Two things matter more than how they brake, in 100 stops from lines and circles at 0.8 to 4 m/s. A vehicle has the
attitude of its last setpoint only its lag later: it turns on until then. And some of a tilt is needed against the drag:
at 2 m/s a PX4's simulated quadrotor tilts as for 2 m/s2, and does not accelerate. With both, predictions 0.8 and 1.2 s
ahead are off by 0.11 m (rms) without setpoints, and by 0.35 m in hold; without, by 0.23 and 0.56 m.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swarmctl.core.types import Array

BRAKE_M_S2 = 2.2  # on average, until it rests
HOLD_BRAKE_M_S2 = 1.5
ANSWER_S = 0.25  # in which an acceleration becomes another one, but for 1/e of it
_LEVEL, _VERTICAL = slice(0, 2), slice(2, 3)
_NO_DRAG_1_S = 1e-3  # less is none
_AT_REST_M_S = 1e-6  # a slower velocity has no direction
_SEEN_AFTER_S = 0.05  # that a setpoint is missing: PX4 looks for it every 0.1 s


def without_setpoints_ned_m(
    pos_ned_m: Array,
    vel_ned_m_s: Array,
    accel_ned_m_s2: Array,
    ahead_s: Array,
    *,
    keeps_s: float,
    coasts_s: float,
    brake_m_s2: float = BRAKE_M_S2,
    drag_1_s: float = 0.0,
) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after a vehicle has got its last setpoint.

    Args:
        pos_ned_m, vel_ned_m_s, accel_ned_m_s2: (3,) its motion at that time.
        ahead_s: (N,) times.
        keeps_s: so long its autopilot keeps the attitude, and thus the acceleration but for the drag.
        coasts_s: from then until this time it flies level; the same value where it brakes at once.
        brake_m_s2: braking; more than autopilots do is taken for what they do.
        drag_1_s: linear drag over mass, in still air; not while it brakes, which has been measured with it.
    """
    coasts_s, keeps_s = coasts_s + _SEEN_AFTER_S, min(keeps_s, coasts_s) + _SEEN_AFTER_S
    brake_m_s2 = min(brake_m_s2, BRAKE_M_S2)
    found = np.empty((len(ahead_s), 3))
    for axes, until_s in ((_LEVEL, coasts_s), (_VERTICAL, keeps_s)):
        limits = {"keeps_s": keeps_s, "coasts_s": until_s, "brake_m_s2": brake_m_s2, "drag_1_s": drag_1_s}
        found[:, axes] = pos_ned_m[axes] + _way(vel_ned_m_s[axes], accel_ned_m_s2[axes], ahead_s, **limits)
    return found


def _way(
    vel_m_s: Array,
    accel_m_s2: Array,
    ahead_s: Array,
    *,
    keeps_s: float,
    coasts_s: float,
    brake_m_s2: float,
    drag_1_s: float,
) -> Array:
    """Return displacements (N, M) [m] along M axes, of a motion (M,); see `without_setpoints_ned_m`."""
    kept_s, later_s = np.minimum(ahead_s, keeps_s)[:, None], np.maximum(ahead_s - keeps_s, 0.0)
    way = kept_s * vel_m_s + _way_s2(kept_s, drag_1_s) * accel_m_s2
    vel = vel_m_s + _slowed_s(keeps_s, drag_1_s) * accel_m_s2
    accel = math.exp(-drag_1_s * keeps_s) * accel_m_s2
    level_s = coasts_s - keeps_s
    if level_s > 0.0:
        settled, level = vel + ANSWER_S * accel, np.minimum(later_s, level_s)[:, None]
        way += _slowed_s(level, drag_1_s) * settled + ANSWER_S**2 * np.expm1(-level / ANSWER_S) * accel
        left, settled = math.exp(-level_s / ANSWER_S) * accel, math.exp(-drag_1_s * level_s) * settled
        vel, accel = settled - ANSWER_S * left, left - drag_1_s * settled
        later_s = np.maximum(later_s - level_s, 0.0)
    return np.asarray(way + settling_displacement(vel, accel, later_s, brake_m_s2=brake_m_s2))


def _slowed_s(t_s: Any, drag_1_s: float) -> Any:
    """Return the time in which as much is gained without drag as in `t_s` with it: of speed, or of way."""
    return t_s if drag_1_s < _NO_DRAG_1_S else -np.expm1(-drag_1_s * t_s) / drag_1_s


def _way_s2(t_s: Array, drag_1_s: float) -> Array:
    """Return the way in `t_s` over the acceleration that it begins with, which is lost with the speed that it gives."""
    if drag_1_s < _NO_DRAG_1_S:
        return 0.5 * t_s**2
    return np.asarray((t_s - _slowed_s(t_s, drag_1_s)) / drag_1_s)


def settling_displacement(vel_ned_m_s: Array, accel_ned_m_s2: Array, t_s: Array, *, brake_m_s2: float) -> Array:
    """Return displacements (N, M) [m] at `t_s` (N,) after the autopilot has taken over, until the vehicle rests.

    Its acceleration approaches exponentially, as its attitude does, a deceleration against the velocity that it will
    have by then; 0: it flies on level.

    Args:
        vel_ned_m_s, accel_ned_m_s2: its motion along M axes when the autopilot takes over, (M,).
        t_s: (N,) times, >= 0.
        brake_m_s2: the deceleration.
    """
    settled = vel_ned_m_s + ANSWER_S * accel_ned_m_s2  # but for the braking meanwhile
    speed = math.sqrt(float(settled @ settled))
    goal = settled * (-brake_m_s2 / speed) if speed >= _AT_REST_M_S else np.zeros_like(settled)
    if brake_m_s2 > 0.0:
        t_s = np.minimum(t_s, ANSWER_S + speed / brake_m_s2)
    t = t_s[:, None]
    lagging_s = ANSWER_S * (t + ANSWER_S * np.expm1(-t / ANSWER_S))  # s2: of an acceleration that goes
    return np.asarray(t * vel_ned_m_s + lagging_s * accel_ned_m_s2 + (0.5 * t * t - lagging_s) * goal)
