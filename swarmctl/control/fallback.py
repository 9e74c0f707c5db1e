"""The plan flown when planning fails: brake to rest, then hold. It needs neither solver nor neighbours."""

from __future__ import annotations

import numpy as np

from swarmctl.control.lag import Lag
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_NED_M_S2
from swarmctl.core.types import Array, Plan, PlanStatus

_DAMPING_1_S = 4.0  # the last 0.75 m/s die out in 0.25 s, without oscillation by a lag of up to half as much
_DAMPING_RAD = 0.5  # damping times lag: more would oscillate
_ACCEL_MAX_M_S2 = 3.0  # a tilt of 17 degrees; what peers expect by default (`separation.brake_m_s2`)
_LEAST_COS_TILT = 0.3  # what thrust is raised for: it is finite whatever tilt the plan begins with
_TILT_RATE_1_S = 2.5  # of (u_x, u_y): faster attitude changes would saturate rotors


def brake_and_hold_plan(
    start: Start,
    at_ned_m: Array | None,
    disturbance_ned_m_s2: Array,
    lag: Lag | None,
    *,
    drag_1_s: float,
    dt_us: int,
    steps: int,
) -> Plan:
    """Brake, or return to `at_ned_m` (3,) if given, like a critically damped spring of bounded acceleration.

    The path is the motion that this law gives a vehicle with that lag and drag, so that peers can keep clear of it.
    """
    dt_s = dt_us * 1e-6
    damping = _DAMPING_1_S if lag is None else min(_DAMPING_1_S, _DAMPING_RAD / lag.ramp_delay_s)
    stiffness = 0.25 * damping * damping
    pos, vel = np.empty((steps + 1, 3)), np.empty((steps + 1, 3))
    virtual_control = np.empty((steps, 3))
    pos[0], vel[0], commanded = start.pos_ned_m, start.vel_ned_m_s, start.virtual_control[:2]
    tilt, rate = start.tilt, start.tilt_rate_1_s
    for k in range(steps):
        wanted = -damping * vel[k]
        if at_ned_m is not None:
            wanted = wanted + stiffness * (at_ned_m - pos[k])
        accel = np.clip(wanted, -_ACCEL_MAX_M_S2, _ACCEL_MAX_M_S2)
        pushed = disturbance_ned_m_s2 - drag_1_s * vel[k]
        thrust_vector = GRAVITY_NED_M_S2 + pushed - accel  # thrust vector over mass, up positive
        slew = _TILT_RATE_1_S * dt_s
        u = np.clip(
            thrust_vector[:2] / float(np.sqrt(thrust_vector @ thrust_vector)), commanded - slew, commanded + slew
        )
        cos_tilt = float(np.sqrt(max(_LEAST_COS_TILT**2, 1.0 - float(u @ u))))
        thrust = float(thrust_vector[2]) / cos_tilt  # supports the weight at the commanded tilt
        virtual_control[k], commanded = (u[0], u[1], thrust), u
        acts = u
        if lag is not None:
            ends = [lag.advance(float(tilt[i]), float(rate[i]), float(u[i]), dt_s) for i in (0, 1)]
            tilt, rate = np.array([end[0] for end in ends]), np.array([end[1] for end in ends])
            acts = np.array([ends[0][2], ends[1][2]]) / dt_s
        accel[:2] = pushed[:2] - thrust * acts
        pos[k + 1] = pos[k] + dt_s * vel[k] + 0.5 * dt_s * dt_s * accel
        vel[k + 1] = vel[k] + dt_s * accel
    return Plan(
        status=PlanStatus.NONE,
        t0_us=start.t_us,
        dt_us=dt_us,
        pos_ned_m=pos,
        vel_ned_m_s=vel,
        virtual_control=virtual_control,
    )
