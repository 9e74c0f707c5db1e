"""The thesis' distributed MPC for one vehicle of a swarm: z first, then x-y with the distance constraints (ch. 3, 4).

z'' = g - (f/m) c, with c = cos(phi) cos(theta) frozen at the current attitude (3.11); x'' = -(f/m) u_x and
y'' = -(f/m) u_y with the thrust that the z problem has just chosen (3.18), (3.24). Thrust over mass is the z input, so
the thesis' newtons for its 1 kg are m/s2 here. The z problem has no distance constraints. The disturbance estimate is
a constant drift of each axis. Of a flight volume the z problem has floor and ceiling, the x-y problem the sides.
"""

from __future__ import annotations

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
from swarmctl.control.mpc.vertical_stop import VerticalStop
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array, Plan


class SwarmMpc:
    """Plans with the z-MPC, then the x-y MPC with half-spaces, and certifies the result over true distances."""

    def __init__(self, params: MpcParams, setup: ControllerSetup) -> None:
        self._params, self._setup, vehicle = params, setup, setup.vehicle
        self.dt_us = round(params.dt_s * 1e6)
        self.steps = params.horizon_xy
        self.longest = max(params.horizon_xy, params.horizon_z)  # reference steps needed
        self._z = CondensedMpc(
            (params.vertical(vehicle),),
            params.horizon_of_z(vehicle),
            0,
            1.0,
            penalties=Penalties(),
            qp=params.qp,
            stopwatch_ns=setup.stopwatch_ns,
            faces=faces_along(setup.volume, slice(2, 3)),
        )

        def across(room: int) -> CondensedMpc:
            return CondensedMpc(
                params.horizontal(vehicle),
                params.horizon_of_xy(vehicle),
                room,
                setup.separation.relax_01,
                penalties=Penalties(),
                qp=params.qp,
                stopwatch_ns=setup.stopwatch_ns,
                faces=faces_along(setup.volume, slice(0, 2)),
            )

        self._xy = SizedMpc(across, setup.max_keep_outs)
        self._xy_alone = across(0)  # without keep-outs the problem is small and solved exactly
        self._newest: Array | None = None  # (2, Hc) increments of the newest plan
        self._before: Array | None = None  # of the one of the tick before
        self._first_row = self._xy.prediction.first_row()
        following = np.arange(self.steps)
        self._thrust_of = following if params.thrust_ahead == "planned" else 0 * following  # (steps,) of the z plan
        brake_m_s2 = setup.separation.brake_m_s2 if setup.volume is None else setup.volume.params.brake_z_m_s2
        self._stop = VerticalStop(params.vertical(vehicle), params.horizon_of_z(vehicle), brake_m_s2)

    def plan(self, problem: Problem) -> Plan:
        """Solve one step of distributed MPC. Infeasibility is a status, never an exception."""
        self._before = self._newest
        up = self._solve_z(problem)
        guess = first_guess(problem, self._params.dt_s, self.steps)
        guess[1:, 2] = up.pos_m[: self.steps, 0]
        plan = partial(self._plan, problem, up)
        return planned_clear(problem, guess, plan, axes=2, dt_s=self._params.dt_s, setup=self._setup)

    def reset(self) -> None:
        """Forget the newest plan; solvers keep their warm starts."""
        self._newest = None

    def _plan(self, problem: Problem, up: AxesSolution, spaces: HalfSpaces | None, spaces_us: float) -> Plan:
        start, steps = problem.start, self.steps
        asked = AxesProblem(
            pos_m=start.pos_ned_m[:2],
            vel_m_s=start.vel_ned_m_s[:2],
            u_prev=start.virtual_control[:2],
            gain_m_s2=self._gain_m_s2(up),
            drift_m_s2=problem.disturbance_ned_m_s2[:2],
            ref_pos_m=problem.reference.pos_ned_m[1 : steps + 1, :2],
            ref_vel_m_s=problem.reference.vel_ned_m_s[1 : steps + 1, :2],
            realised=start.tilt,
            realised_1_s=start.tilt_rate_1_s,
            before=None if spaces is None else self._before,
        )
        across = (self._xy_alone if spaces is None else self._xy).solve(asked, spaces)
        self._newest = across.increments if across.solved else None
        pos, vel, virtual_control = np.empty((steps + 1, 3)), np.zeros((steps + 1, 3)), np.empty((steps, 3))
        pos[0], vel[0] = start.pos_ned_m, start.vel_ned_m_s
        pos[1:, :2], vel[1:, :2], virtual_control[:, :2] = across.pos_m, across.vel_m_s, across.u
        pos[1:, 2:], vel[1:, 2:], virtual_control[:, 2:] = up.pos_m[:steps], up.vel_m_s[:steps], up.u[:steps]
        return judged(
            problem,
            pos,
            vel,
            virtual_control,
            solutions=(up, across),
            from_step=self._first_row,
            dt_us=self.dt_us,
            spaces_us=spaces_us,
            stopwatch_ns=self._setup.stopwatch_ns,
            volume=self._setup.volume,
        )

    def _solve_z(self, problem: Problem) -> AxesSolution:
        """Return the z plan, of at least as many steps as the x-y plan has."""
        steps, start, reference = self._params.horizon_z, problem.start, problem.reference
        asked = AxesProblem(
            pos_m=start.pos_ned_m[2:],
            vel_m_s=start.vel_ned_m_s[2:],
            u_prev=start.virtual_control[2:],
            gain_m_s2=np.full((steps, 1), -start.cos_tilt),
            drift_m_s2=GRAVITY_M_S2 + problem.disturbance_ned_m_s2[2:],
            ref_pos_m=reference.pos_ned_m[1 : steps + 1, 2:],
            ref_vel_m_s=reference.vel_ned_m_s[1 : steps + 1, 2:],
        )
        up = self._z.solve(asked)
        return up if steps >= self.steps else self._stop.behind(up, asked, self.steps - steps)

    def _gain_m_s2(self, up: AxesSolution) -> Array:
        """Return accelerations (steps, 2) of unit inputs of x and y, which thrust over mass makes."""
        return -up.u.take(self._thrust_of, axis=0).repeat(2, axis=1)
