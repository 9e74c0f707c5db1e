"""What is flown when there is no plan: come to rest, then stay. No solver, no neighbours, no way to fail."""

from __future__ import annotations

import numpy as np

from swarmctl.control.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import NO_TIMES, Array, Plan, PlanStatus

_DAMPING_1_S = 4.0
_STIFFNESS_1_S2 = 4.0
_ACCEL_MAX_M_S2 = 3.0
_TILT_RATE_1_S = 2.5  # of (u_x, u_y): a faster turn would saturate rotors and be lost


def rest_plan(start: Start, at_ned_m: Array | None, disturbance_ned_m_s2: Array, dt_us: int, steps: int) -> Plan:
    """Brake, and when `at_ned_m` (3,) is given also return to it, as a damped spring with bounded acceleration.

    The path is the motion this law gives the double integrator, so that peers can keep clear of it.
    """
    dt_s = dt_us * 1e-6
    pos, vel = np.empty((steps + 1, 3)), np.empty((steps + 1, 3))
    virtual = np.empty((steps, 3))
    pos[0], vel[0], tilt = start.pos_ned_m, start.vel_ned_m_s, start.virtual[:2]
    for k in range(steps):
        wanted = -_DAMPING_1_S * vel[k]
        if at_ned_m is not None:
            wanted = wanted + _STIFFNESS_1_S2 * (at_ned_m - pos[k])
        accel = np.clip(wanted, -_ACCEL_MAX_M_S2, _ACCEL_MAX_M_S2)
        lift = np.array([0.0, 0.0, GRAVITY_M_S2]) + disturbance_ned_m_s2 - accel  # thrust vector over mass, up is +
        slew = _TILT_RATE_1_S * dt_s
        u = np.clip(lift[:2] / float(np.sqrt(lift @ lift)), tilt - slew, tilt + slew)
        thrust = float(lift[2]) / float(np.sqrt(1.0 - u @ u))  # carries the weight at the tilt that is flown
        virtual[k], tilt = (u[0], u[1], thrust), u
        accel[:2] = disturbance_ned_m_s2[:2] - thrust * u
        pos[k + 1] = pos[k] + dt_s * vel[k] + 0.5 * dt_s * dt_s * accel
        vel[k + 1] = vel[k] + dt_s * accel
    return Plan(PlanStatus.NONE, start.t_us, dt_us, pos, vel, virtual, NO_TIMES, 0, 0.0, 0.0, 0.0)
