"""One MPC for all three axes (thesis 5.2: "mitigate the perceived bias towards the z axis"), with distances in space.

The same axes, weights and bounds as `swarmctl.control.mpc.swarm_mpc`, but z, x and y are one problem, so that an agent
may pass above or below what it must keep clear of. The products f u_x and f u_y are linearised by solving twice, the
second time with the thrust f that the first has planned. The path that is certified and shared is, in the plane, the
motion under the products themselves. Its height is that under the tilt of the start, as in the thesis (3.11): who
levels from 0.2 is 0.05 m higher after 0.8 s, who tilts to it 0.02 m lower, and who levels from 0.5 is 0.4 m higher.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from swarmctl.control.mpc.attempts import first_guess, planned_clear
from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, AxesSolution, HalfSpaces, Penalties, faces_along
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.condensed_qp.sized_mpc import SizedMpc
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.judgement import judged
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.frames import GRAVITY_NED_M_S2
from swarmctl.core.types import Array, Plan

# Factor on the solver's tolerance. Increments of z are ten times larger and set the scale of the cost, by which OSQP
# measures dual residuals: with 0.1 x-y never comes to rest (0.44 m/s about its goal for ever), with 0.01 within 8 mm.
_TOLERANCE_01 = 0.01
_MIN_THRUST_M_S2 = 1.0  # without thrust, tilt would have no effect in the model


class JointMpc:
    """Plans x, y and z in one problem with half-spaces, and certifies the result over true distances."""

    def __init__(self, params: MpcParams, setup: ControllerSetup) -> None:
        self._params, self._setup, vehicle = params, setup, setup.vehicle
        self.dt_us = round(params.dt_s * 1e6)
        self.steps = self.longest = params.horizon_xy
        eps, eps_relative = _TOLERANCE_01 * params.qp.eps, _TOLERANCE_01 * params.qp.eps_relative

        def joint(room: int) -> CondensedMpc:
            return CondensedMpc(
                (*params.horizontal(vehicle), params.vertical(vehicle)),
                params.horizon_of_xy(vehicle),
                room,
                setup.separation.relax_01,
                penalties=Penalties(),
                qp=params.qp.model_copy(update={"eps": eps, "eps_relative": eps_relative}),
                stopwatch_ns=setup.stopwatch_ns,
                faces=faces_along(setup.volume, slice(0, 3)),
            )

        self._mpc = SizedMpc(joint, setup.max_keep_outs)

    def plan(self, problem: Problem) -> Plan:
        """Solve one step of distributed MPC. Infeasibility is a status, never an exception."""
        guess = first_guess(problem, self._params.dt_s, self.steps)
        plan = partial(self._plan, problem)
        return planned_clear(problem, guess, plan, axes=3, dt_s=self._params.dt_s, setup=self._setup)

    def reset(self) -> None:
        """Keep all: only a warm start outlasts a tick."""
        return

    def _plan(self, problem: Problem, spaces: HalfSpaces | None, spaces_us: float) -> Plan:
        start, steps, ahead = problem.start, self.steps, self._mpc.prediction
        acting = _joined(start.tilt, start.virtual_control[2]), _joined(start.tilt_rate_1_s, 0.0)
        drift_m_s2 = problem.disturbance_ned_m_s2 + GRAVITY_NED_M_S2
        solve = partial(self._solve, problem, spaces, acting, drift_m_s2)
        first = solve(np.full(steps, max(_MIN_THRUST_M_S2, float(start.virtual_control[2]))))
        found = solve(first.u[:, 2])
        found = replace(found, solve_us=first.solve_us + found.solve_us, iterations=first.iterations + found.iterations)
        along = _joined(ahead.realised(found.u, *acting)[:, :2], start.cos_tilt)  # (steps, 3)
        motion = np.empty((2, steps + 1, 3))
        motion[0, 0], motion[1, 0] = start.pos_ned_m, start.vel_ned_m_s
        motion[:, 1:] = ahead.motion(start.pos_ned_m, start.vel_ned_m_s, drift_m_s2 - found.u[:, 2:] * along)
        first_row, stopwatch_ns = ahead.first_row(), self._setup.stopwatch_ns
        return judged(
            problem,
            motion[0],
            motion[1],
            found.u,
            solutions=(found,),
            from_step=first_row,
            dt_us=self.dt_us,
            spaces_us=spaces_us,
            stopwatch_ns=stopwatch_ns,
            volume=self._setup.volume,
        )

    def _solve(
        self,
        problem: Problem,
        spaces: HalfSpaces | None,
        acting: tuple[Array, Array],
        drift_m_s2: Array,
        thrust_m_s2: Array,
    ) -> AxesSolution:
        """Solve the problem in which the products of tilt and thrust are linearised at a thrust.

        Args:
            problem, spaces: of this step.
            acting: inputs (3,) realised at the start, and their rates (3,).
            drift_m_s2: acceleration (3,) NED without thrust.
            thrust_m_s2: (steps,).
        """
        steps, start, reference = self.steps, problem.start, problem.reference
        realised, realised_1_s = acting
        gain_m_s2 = np.empty((steps, 3))
        gain_m_s2[:, :2], gain_m_s2[:, 2] = -thrust_m_s2[:, None], -start.cos_tilt
        asked = AxesProblem(
            pos_m=start.pos_ned_m,
            vel_m_s=start.vel_ned_m_s,
            u_prev=start.virtual_control,
            gain_m_s2=gain_m_s2,
            drift_m_s2=drift_m_s2,
            ref_pos_m=reference.pos_ned_m[1 : steps + 1],
            ref_vel_m_s=reference.vel_ned_m_s[1 : steps + 1],
            realised=realised,
            realised_1_s=realised_1_s,
        )
        return self._mpc.solve(asked, spaces)


def _joined(xy: Array, z: float) -> Array:
    """Return (..., 3) of x and y (..., 2), and the same z for all; `np.append` takes longer."""
    found = np.empty((*xy.shape[:-1], 3))
    found[..., :2], found[..., 2] = xy, z
    return found
