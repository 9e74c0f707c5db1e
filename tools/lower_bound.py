"""Theoretical lower bounds of the errors on the thesis' trajectories: optimal control of its own model.

    pip install '.[bounds]'
    python tools/lower_bound.py

They are the `least` figures of `swarmctl reproduce`. The model is a point mass under thrust, whose tilt follows its
setpoint under the attitude PIDs of chapter 3, step by step as they are sampled, without drag, within the bounds of
Table 10; from the origin at rest, and with the reference's velocity. Mean distance, MSE x and MSE z are minimised one
at a time over the first 1.8 s (after that the error can be held at zero) and related to the whole flight. The last
column is the least MSE x of those who also keep the published mean distance and MSE z.

The problem is not convex: what the solver finds is a minimum in its neighbourhood, not a proof.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from sitl.plant.airframes import PRESETS
from sitl.plant.attitude import THESIS_GAINS, THESIS_SAMPLE_S
from swarmctl.core.frames import GRAVITY_M_S2

STEPS = 90
SMOOTH_M2 = 1e-6  # keeps the distance differentiable at 0; what it adds at most is taken off again
TRAJECTORIES = {"slow": (0.15, -0.1, 125.66), "fast": (0.5, -1.0, 37.7)}  # rad/s, m/s, s
PUBLISHED = {"slow": (0.0043, 0.0024), "fast": (0.0145, 0.0081)}  # mean distance [m], MSE z [m2]
TILT_MAX, TILT_STEP = (0.18, 0.2), (0.05, 0.06)  # u_x, u_y


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One trajectory, start and least thrust."""

    speed: str
    matched: bool
    thrust_min_n: float

    @property
    def name(self) -> str:
        """Return what the table calls it."""
        start = "matched start" if self.matched else "from rest"
        return f"{self.speed}, {start}, f >= {self.thrust_min_n:g} N"


def least(what: str, case: Case, *, as_published: bool = False) -> float:
    """Return the lower bound of the mean distance [m] ("mean") or of an MSE [m2] ("x", "z").

    Args:
        what: figure to minimise.
        case: trajectory.
        as_published: mean distance and MSE z are no more than the published ones.
    """
    omega, climb, duration_s = TRAJECTORIES[case.speed]
    t_s = np.arange(STEPS) * THESIS_SAMPLE_S
    reference = np.stack([0.5 * np.cos(omega * t_s), 0.5 * np.sin(omega * t_s), -1.0 + climb * t_s], axis=1)
    problem, share = ca.Opti(), THESIS_SAMPLE_S / duration_s
    pos = _motion(problem, [0.0, 0.5 * omega, climb] if case.matched else [0.0, 0.0, 0.0], case.thrust_min_n)
    error = [pos[:, k] - reference[k] for k in range(STEPS)]
    figures = {
        "mean": share * sum(ca.sqrt(ca.sumsqr(e) + SMOOTH_M2) for e in error),
        "x": share * sum(e[0] ** 2 for e in error),
        "z": share * sum(e[2] ** 2 for e in error),
    }
    if as_published:
        mean_m, mse_z_m2 = PUBLISHED[case.speed]
        problem.subject_to(figures["mean"] <= mean_m)
        problem.subject_to(figures["z"] <= mse_z_m2)
    for k in range(STEPS):
        problem.set_initial(pos[:, k], reference[k] * min(1.0, k / 25))
    problem.minimize(figures[what] / share)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 3000, "tol": 1e-6})
    found = float(problem.solve().value(figures[what]))
    return found - (share * STEPS * SMOOTH_M2**0.5 if what == "mean" else 0.0)


def _motion(problem: Any, vel_ned_m_s: list[float], thrust_min_n: float) -> Any:
    """Add the motion from the origin under any allowed inputs; return the positions (3, STEPS + 1)."""
    dt_s = THESIS_SAMPLE_S
    inputs, thrust = problem.variable(2, STEPS), problem.variable(1, STEPS)  # u_x, u_y; thrust over mass
    pos, vel = problem.variable(3, STEPS + 1), problem.variable(3, STEPS + 1)
    tilt = _followed_tilt(problem, inputs)
    problem.subject_to(pos[:, 0] == 0.0)
    problem.subject_to(vel[:, 0] == ca.DM(vel_ned_m_s))
    problem.set_initial(thrust, GRAVITY_M_S2)
    for k in range(STEPS):
        held, lifted = (inputs[:, k - 1], thrust[k - 1]) if k else (ca.DM([0.0, 0.0]), GRAVITY_M_S2)
        for i in range(2):
            problem.subject_to(problem.bounded(-TILT_MAX[i], inputs[i, k], TILT_MAX[i]))
            problem.subject_to(problem.bounded(-TILT_STEP[i], inputs[i, k] - held[i], TILT_STEP[i]))
        problem.subject_to(problem.bounded(thrust_min_n, thrust[k], 20.0))
        problem.subject_to(problem.bounded(-10.0, thrust[k] - lifted, 10.0))
        mean_tilt = 0.5 * (tilt[:, k] + tilt[:, k + 1])
        down = 1.0 - 0.5 * ca.sumsqr(mean_tilt)
        accel = ca.vertcat(0.0, 0.0, GRAVITY_M_S2) + thrust[k] * ca.vertcat(mean_tilt, -down)
        problem.subject_to(vel[:, k + 1] == vel[:, k] + dt_s * accel)
        problem.subject_to(pos[:, k + 1] == pos[:, k] + dt_s * vel[:, k] + 0.5 * dt_s**2 * accel)
    return pos


def _followed_tilt(problem: Any, inputs: Any) -> Any:
    """Add the attitude PIDs that follow the inputs, kI aside; return the tilt (2, STEPS + 1), along x and y."""
    gains, inertia, dt_s = THESIS_GAINS["single"], PRESETS["thesis"].inertia_kg_m2, THESIS_SAMPLE_S
    tilt, rate = problem.variable(2, STEPS + 1), problem.variable(2, STEPS + 1)
    problem.subject_to(tilt[:, 0] == 0.0)
    problem.subject_to(rate[:, 0] == 0.0)
    for i, axis in enumerate((1, 0)):  # pitch moves it along x, roll along y
        before = 0.0
        for k in range(STEPS):
            error = inputs[i, k] - tilt[i, k]
            torque = gains.proportional[axis] * error + gains.derivative[axis] * (error - before) / dt_s
            problem.subject_to(rate[i, k + 1] == rate[i, k] + dt_s * torque / inertia[axis])
            problem.subject_to(tilt[i, k + 1] == tilt[i, k] + 0.5 * dt_s * (rate[i, k] + rate[i, k + 1]))
            before = error
    return tilt


def main() -> int:
    print(f"{'':30}{'mean [m]':>10}{'MSE x [m2]':>12}{'MSE z [m2]':>12}{'MSE x, others as published':>28}")
    for case in (
        Case(speed=s, matched=m, thrust_min_n=f) for s in TRAJECTORIES for m in (False, True) for f in (0, -20)
    ):
        values = [least(what, case) for what in ("mean", "x", "z")]
        try:
            beside = f"{least('x', case, as_published=True):28.5f}"
        except RuntimeError:  # ipopt: no solution
            beside = f"{'none found':>28}"
        print(f"{case.name:30}{values[0]:10.5f}{values[1]:12.5f}{values[2]:12.5f}{beside}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
