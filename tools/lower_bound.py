"""Theoretical lower bounds of the errors on the thesis' trajectories: optimal control of its own model.

    pip install 'swarmctl[bounds]'
    python tools/lower_bound.py

They are the `least` figures of `swarmctl reproduce`. The model is a point mass under thrust, tilt following its
setpoint with the attitude loop's lag, no drag, the bounds of Table 10; from the origin at rest, and with the
reference's velocity. Mean distance, MSE x and MSE z are minimised one at a time over the first 1.8 s (after that the
error can be held at zero) and related to the whole flight.
"""

from __future__ import annotations

import sys

import casadi as ca
import numpy as np

STEP_S = 0.02
STEPS = 90
LAG_S = 0.053  # of the attitude loop: inertia over kD of the thesis' swarm gains
GRAVITY_M_S2 = 9.81
TRAJECTORIES = {"slow": (0.15, -0.1, 125.66), "fast": (0.5, -1.0, 37.7)}  # rad/s, m/s, s


def least(what: str, speed: str, matched: bool, thrust_min_n: float) -> float:
    """Return the lower bound of the mean distance [m] ("mean") or MSE [m2] ("x", "z") of one trajectory."""
    omega, climb, duration_s = TRAJECTORIES[speed]
    t_s = np.arange(STEPS) * STEP_S
    reference = np.stack([0.5 * np.cos(omega * t_s), 0.5 * np.sin(omega * t_s), -1.0 + climb * t_s], axis=1)
    problem = ca.Opti()
    inputs = problem.variable(3, STEPS)  # u_x, u_y, thrust over mass
    pos, tilt, cost = ca.MX.zeros(3), ca.MX.zeros(2), 0
    vel = ca.MX([0.0, 0.5 * omega, climb] if matched else [0.0, 0.0, 0.0])
    before = ca.MX([0.0, 0.0, GRAVITY_M_S2])
    for k in range(STEPS):
        error = pos - reference[k]
        cost += {"mean": ca.sqrt(ca.sumsqr(error) + 1e-6), "x": error[0] ** 2, "z": error[2] ** 2}[what]
        problem.subject_to(problem.bounded([-0.05, -0.06, -10.0], inputs[:, k] - before, [0.05, 0.06, 10.0]))
        problem.subject_to(problem.bounded([-0.18, -0.2, thrust_min_n], inputs[:, k], [0.18, 0.2, 20.0]))
        before = inputs[:, k]
        tilt += (1.0 - np.exp(-STEP_S / LAG_S)) * (inputs[:2, k] - tilt)
        down = ca.sqrt(1.0 - ca.sumsqr(tilt))
        accel = ca.vertcat(0.0, 0.0, GRAVITY_M_S2) - inputs[2, k] * ca.vertcat(tilt, down)
        pos, vel = pos + STEP_S * vel + 0.5 * STEP_S**2 * accel, vel + STEP_S * accel
    problem.minimize(cost * 100.0 / duration_s)
    problem.set_initial(inputs[2, :], GRAVITY_M_S2)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 800})
    return float(problem.solve().value(cost)) * STEP_S / duration_s


def main() -> int:
    print(f"{'':30}{'mean [m]':>10}{'MSE x [m2]':>12}{'MSE z [m2]':>12}")
    for speed in TRAJECTORIES:
        for matched in (False, True):
            for thrust_min_n in (0.0, -20.0):
                start = "matched start" if matched else "from rest"
                values = [least(what, speed, matched, thrust_min_n) for what in ("mean", "x", "z")]
                name = f"{speed}, {start}, f >= {thrust_min_n:g} N"
                print(f"{name:30}{values[0]:10.5f}{values[1]:12.5f}{values[2]:12.5f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
