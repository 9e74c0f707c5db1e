"""How the z plan of the thesis' MPC goes on behind its horizon, where that of the x-y plan is longer.

Peers and certificates need a path with a height at every step. As beyond the end of any path the vehicle brakes to
rest, here by inputs that it has.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, AxesSolution, Axis, Horizon


class VerticalStop:
    """Continues solutions of one axis, whose input acts at once, by braking.

    Args:
        axis: bounds of its input.
        horizon: of its solutions.
        brake_m_s2: deceleration, as far as the bounds have it.
    """

    def __init__(self, axis: Axis, horizon: Horizon, brake_m_s2: float) -> None:
        self._axis, self._dt_s, self._drag_1_s, self._brake_m_s2 = axis, horizon.dt_s, horizon.drag_1_s, brake_m_s2
        step = replace(horizon, prediction=1)
        self._of_velocity = [float(of[0]) for of in step.of_velocity_s()]
        self._of_accel = [float(of[0, 0]) for of in step.of_acceleration()]

    def behind(self, solution: AxesSolution, asked: AxesProblem, steps: int) -> AxesSolution:
        """Return a solution with so many steps more.

        Args:
            solution: of one axis.
            asked: what it solves, with the gain of its last step from there on.
            steps: to add.
        """
        pos_m, vel_m_s, u = (float(of[-1, 0]) for of in (solution.pos_m, solution.vel_m_s, solution.u))
        gain_m_s2, drift_m_s2 = float(asked.gain_m_s2[-1, 0]), float(asked.drift_m_s2[0])
        axis, rows = self._axis, list[tuple[float, float, float]]()
        for _ in range(steps):
            slowed_m_s2 = min(self._brake_m_s2, max(-self._brake_m_s2, vel_m_s / self._dt_s))
            wanted = (self._drag_1_s * vel_m_s - slowed_m_s2 - drift_m_s2) / gain_m_s2
            u = min(u + axis.du_max, max(u - axis.du_max, wanted))
            u = min(axis.u_max, max(axis.u_min, u))
            accel_m_s2 = drift_m_s2 + gain_m_s2 * u
            pos_m += self._of_velocity[0] * vel_m_s + self._of_accel[0] * accel_m_s2
            vel_m_s = self._of_velocity[1] * vel_m_s + self._of_accel[1] * accel_m_s2
            rows.append((pos_m, vel_m_s, u))
        added = np.array(rows)
        return replace(
            solution,
            pos_m=np.vstack([solution.pos_m, added[:, :1]]),
            vel_m_s=np.vstack([solution.vel_m_s, added[:, 1:2]]),
            u=np.vstack([solution.u, added[:, 2:]]),
        )
