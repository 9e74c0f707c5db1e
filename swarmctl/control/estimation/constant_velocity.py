"""Prediction of a vehicle that its autopilot or a pilot flies: constant velocity, or braking where it comes to rest."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.trajectory import braking_displacement, interpolated
from swarmctl.core.types import Array, FlightMode, Plan, VehicleState

CREEP_M_S = 0.5  # a slower vehicle in hold is taken to rest: estimates of hovering ones wander as fast
_ENTERS_US = 1_000_000  # time in hold for which it is taken to brake, whatever its speed does
_WINDOW_US = 400_000  # over which speeds are compared after that
_LEAST_COS = 0.5  # of a tilt that is kept
_BRAKES_M_S = 0.2  # by which the speed of one that brakes falls in that time; PX4 brakes at 3 m/s2


def predict_constant_velocity(state: VehicleState, ahead_s: Array, brake_m_s2: float, *, stops: bool) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after a state.

    The velocity is continued, or reduced at `brake_m_s2` where the vehicle `stops`.
    """
    if stops:
        speed = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
        t_s = np.minimum(ahead_s, speed / brake_m_s2)
        ahead_s = t_s - 0.5 * brake_m_s2 * t_s * t_s / max(speed, 1e-6)  # time to travel as far at the present speed
    return np.asarray(state.pos_ned_m + ahead_s[:, None] * state.vel_ned_m_s)


def predict_without_setpoints(
    state: VehicleState, ahead_s: Array, *, keeps_s: float, coasts_s: float, brake_m_s2: float
) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after the last state before a vehicle hears nothing more.

    Its autopilot keeps the attitude for `keeps_s`, which accelerates it in the plane, levels and coasts on until
    `coasts_s`, and then brakes and lands.
    """
    tilt_ned = body_z_ned(state.q_nb)
    accel_ned_m_s2 = np.append(-GRAVITY_M_S2 / max(_LEAST_COS, tilt_ned[2]) * tilt_ned[:2], 0.0)
    motion = (state.pos_ned_m, state.vel_ned_m_s, accel_ned_m_s2)
    return _kept(motion, ahead_s, keeps_s=keeps_s, coasts_s=coasts_s, brake_m_s2=brake_m_s2)


def predict_after_setpoints(
    plan: Plan, last_us: int, ahead_s: Array, *, keeps_s: float, coasts_s: float, brake_m_s2: float
) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after the last setpoint of a plan has acted, at `last_us`.

    As `predict_without_setpoints`, of a vehicle that has followed the plan until then.
    """
    last = len(plan.pos_ned_m) - 1
    step = max(0.0, (last_us - plan.t0_us) / plan.dt_us)
    pos, vel = (interpolated(points, np.array([step]), last)[0] for points in (plan.pos_ned_m, plan.vel_ned_m_s))
    begun = min(int(step), last - 1)
    accel_ned_m_s2 = (plan.vel_ned_m_s[begun + 1] - plan.vel_ned_m_s[begun]) / (plan.dt_us * 1e-6)
    accel_ned_m_s2[2] = 0.0
    motion = (pos, vel, accel_ned_m_s2)
    return _kept(motion, ahead_s, keeps_s=keeps_s, coasts_s=coasts_s, brake_m_s2=brake_m_s2)


def _kept(
    motion: tuple[Array, Array, Array], ahead_s: Array, *, keeps_s: float, coasts_s: float, brake_m_s2: float
) -> Array:
    """Continue a position, velocity and acceleration, all (3,) NED: keep the acceleration, coast, and brake."""
    pos_ned_m, vel_ned_m_s, accel_ned_m_s2 = motion
    keeps_s = min(keeps_s, coasts_s)
    kept_s, later_s = np.minimum(ahead_s, keeps_s)[:, None], np.maximum(ahead_s - keeps_s, 0.0)
    coasting_ned_m_s = vel_ned_m_s + keeps_s * accel_ned_m_s2
    coasted_s = np.minimum(later_s, coasts_s - keeps_s)[:, None]
    braked_ned_m = braking_displacement(coasting_ned_m_s, ahead_s - coasts_s, brake_m_s2)
    kept_ned_m = kept_s * vel_ned_m_s + 0.5 * kept_s**2 * accel_ned_m_s2
    return np.asarray(pos_ned_m + kept_ned_m + coasted_s * coasting_ned_m_s + braked_ned_m)


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
        t_us, speed_m_s = state.t_us, math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
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
