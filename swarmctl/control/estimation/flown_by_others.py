"""Prediction of a vehicle that its autopilot or a pilot flies: straight on, braking to rest, or without setpoints."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from swarmctl.core.autopilot_stop import BRAKE_M_S2, HOLD_BRAKE_M_S2, settling_displacement, without_setpoints_ned_m
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.trajectory import interpolated
from swarmctl.core.types import Array, FlightMode, Plan, VehicleState

CREEP_M_S = 0.5  # a slower vehicle in hold is taken to rest: estimates of hovering ones wander as fast
STEERED_MARGIN_M = 0.3  # beside a vehicle that is steered: nobody knows where to
_ENTERS_US = 200_000  # time in hold for which it is taken to brake, whatever its speed does
_STEERED = (FlightMode.HOLD, FlightMode.MANUAL)
_STEERED_S = 0.4  # for which a tilt is kept there
_WINDOW_US = 400_000  # over which speeds are compared after that
_LEAST_COS = 0.5  # of a tilt that is kept
_BRAKES_M_S = 0.2  # by which the speed of one that brakes falls in that time


def predict_flown_by_others(
    state: VehicleState, ahead_s: Array, brake_m_s2: float, *, stops: bool, drag_1_s: float = 0.0
) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after a state.

    The velocity is reduced where the vehicle `stops`, as autopilots do but at `brake_m_s2` at most. Otherwise it is
    continued; where somebody steers, it changes as the tilt says first. The tilt of who hovers says what wind there is,
    and some of that of who flies is needed against the drag, `drag_1_s` over its mass in still air.
    """
    ahead_s = np.maximum(ahead_s, 0.0)
    if stops and math.hypot(*state.vel_ned_m_s[:2]) < CREEP_M_S:
        speed_m_s = _speed_m_s(state)
        t_s = np.minimum(ahead_s, speed_m_s / brake_m_s2)
        ahead_s = t_s - 0.5 * brake_m_s2 * t_s * t_s / max(speed_m_s, 1e-6)  # to travel as far at the present speed
    elif stops:
        brake_m_s2 = min(brake_m_s2, HOLD_BRAKE_M_S2 if state.mode is FlightMode.HOLD else BRAKE_M_S2)
        motion = (state.vel_ned_m_s, _level_accel_ned_m_s2(state, drag_1_s))
        return state.pos_ned_m + settling_displacement(*motion, ahead_s, brake_m_s2=brake_m_s2)
    pos = state.pos_ned_m + ahead_s[:, None] * state.vel_ned_m_s
    if not stops and is_steered(state):
        steered_s = np.minimum(ahead_s, _STEERED_S)
        pos += (steered_s * (ahead_s - 0.5 * steered_s))[:, None] * _level_accel_ned_m_s2(state, drag_1_s)
    return np.asarray(pos)


def is_steered(state: VehicleState) -> bool:
    """Return whether a pilot or a ground station may be steering the vehicle, unless it stops."""
    return state.mode in _STEERED and _speed_m_s(state) >= CREEP_M_S


def predict_without_setpoints(
    state: VehicleState, ahead_s: Array, *, keeps_s: float, coasts_s: float, brake_m_s2: float, drag_1_s: float = 0.0
) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after the last state before a vehicle hears nothing more.

    Its autopilot keeps the attitude for `keeps_s`, which accelerates it in the plane as far as the drag leaves,
    `drag_1_s` over its mass, levels and coasts on until `coasts_s`, and then brakes and lands.
    """
    limits = {"keeps_s": keeps_s, "coasts_s": coasts_s, "brake_m_s2": brake_m_s2, "drag_1_s": drag_1_s}
    accel_ned_m_s2 = _level_accel_ned_m_s2(state, drag_1_s)
    return without_setpoints_ned_m(state.pos_ned_m, state.vel_ned_m_s, accel_ned_m_s2, ahead_s, **limits)


def predict_after_setpoints(
    plan: Plan,
    last_us: int,
    ahead_s: Array,
    *,
    keeps_s: float,
    coasts_s: float,
    brake_m_s2: float,
    drag_1_s: float = 0.0,
    lag_s: float = 0.0,
) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after the last setpoint of a plan has acted, at `last_us`.

    As `predict_without_setpoints`, of a vehicle that follows the plan until it has the attitude of that setpoint,
    `lag_s` later.
    """
    last, lag_s = len(plan.pos_ned_m) - 1, min(lag_s, keeps_s)
    since_steps, step_s = (last_us - plan.t0_us) / plan.dt_us, plan.dt_us * 1e-6
    step = max(0.0, since_steps + lag_s / step_s)
    pos, vel = (interpolated(points, np.array([step]), last)[0] for points in (plan.pos_ned_m, plan.vel_ned_m_s))
    begun = min(int(step), last - 1)
    accel_ned_m_s2 = (plan.vel_ned_m_s[begun + 1] - plan.vel_ned_m_s[begun]) / step_s
    accel_ned_m_s2[2] = 0.0
    limits = {"keeps_s": keeps_s - lag_s, "coasts_s": max(0.0, coasts_s - lag_s)}
    limits |= {"brake_m_s2": brake_m_s2, "drag_1_s": drag_1_s}
    found = without_setpoints_ned_m(pos, vel, accel_ned_m_s2, np.maximum(ahead_s - lag_s, 0.0), **limits)
    follows = ahead_s < lag_s
    found[follows] = interpolated(plan.pos_ned_m, since_steps + ahead_s[follows] / step_s, last)
    return found


def _speed_m_s(state: VehicleState) -> float:
    return math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))


def _level_accel_ned_m_s2(state: VehicleState, drag_1_s: float) -> Array:
    """Return the acceleration (3,) in the plane that attitude and drag give to a vehicle that keeps its height."""
    tilt_ned = body_z_ned(state.q_nb)
    by_tilt = -GRAVITY_M_S2 / max(_LEAST_COS, tilt_ned[2]) * tilt_ned[:2]
    return np.append(by_tilt - drag_1_s * state.vel_ned_m_s[:2], 0.0)


class StopJudge:
    """Judges whether a vehicle that its agent does not fly comes to rest, from one state to the next.

    Autopilots brake in hold and land. But a ground station moves a vehicle in hold (DO_REPOSITION), and in some holds
    it follows its pilot's sticks (LOITER of ArduCopter): what does not brake there is not going to stop.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque()  # time and speed
        self._held_since_us: int | None = None

    def update(self, state: VehicleState) -> bool:
        """Take in the newest state; return whether the vehicle stops."""
        if state.mode is not FlightMode.HOLD:
            self.forget()
            return state.mode is FlightMode.LAND
        t_us, speed_m_s = state.t_us, _speed_m_s(state)
        self._held_since_us = t_us if self._held_since_us is None else self._held_since_us
        self._recent.append((t_us, speed_m_s))
        while t_us - self._recent[0][0] > _WINDOW_US:
            self._recent.popleft()
        brakes = speed_m_s < self._recent[0][1] - _BRAKES_M_S
        return speed_m_s < CREEP_M_S or brakes or t_us - self._held_since_us < _ENTERS_US

    def forget(self) -> None:
        """Begin anew: the agent flies the vehicle."""
        self._recent.clear()
        self._held_since_us = None
