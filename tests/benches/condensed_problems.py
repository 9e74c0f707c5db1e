"""Problems of one or two axes, and their solutions, for tests of the condensed MPC."""

from __future__ import annotations

import numpy as np

from swarmctl.control.mpc.condensed_qp.axes import Axis, Horizon, Penalties
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.core.types import Array

EXACT = QpParams(eps=1e-8, eps_relative=1e-8, max_iterations=20_000)
AXIS = Axis(
    q_pos=1.5, q_vel=0.5, r=0.01, u_min=-0.2, u_max=0.2, du_max=0.05, u_rest=0.0, gain_m_s2=9.81, terminal="none"
)
HORIZON = Horizon(control=6, prediction=40, dt_s=0.02, euler=False)
GAIN = -9.81


def mpc(
    *axes: Axis, horizon: Horizon = HORIZON, max_keep_outs: int = 0, relax_01: float = 1.0, qp: QpParams = EXACT
) -> CondensedMpc:
    return CondensedMpc(axes, horizon, max_keep_outs, relax_01, penalties=Penalties(), qp=qp, stopwatch_ns=lambda: 0)


def simulate(
    pos: float, vel: float, u: Array, gain: float | Array, drift: float, dt_s: float, euler: bool
) -> tuple[Array, Array]:
    """Double integrator under held inputs, step by step; nothing of the code's matrices."""
    positions, velocities = [], []
    for value, now in zip(u, np.broadcast_to(gain, len(u)), strict=True):
        accel = float(now) * float(value) + drift
        pos += dt_s * vel + (0.0 if euler else 0.5 * dt_s * dt_s * accel)
        vel += dt_s * accel
        positions.append(pos)
        velocities.append(vel)
    return np.array(positions), np.array(velocities)


def held(moves: Array, u_prev: float, steps: int) -> Array:
    """Inputs of increments: summed, and kept after the last."""
    padded = np.concatenate([moves, np.zeros(steps - len(moves))])
    return u_prev + np.cumsum(padded)
