"""No control at all, as a baseline."""

from __future__ import annotations

import numpy as np

from swarmctl.control.controllers.kind import ControllerKind
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.types import Plan, PlanStatus


class OpenLoop:
    """Commands zero input (thesis 1.6): level attitude and no thrust, whatever the state."""

    def __init__(self, params: MpcParams, _: ControllerSetup) -> None:
        self.dt_us, self.steps = round(params.dt_s * 1e6), params.horizon_xy
        self.longest = self.steps

    def plan(self, problem: Problem) -> Plan:
        start = problem.start
        pos, vel = start.at_constant_velocity(self.steps, self.dt_us * 1e-6)
        return Plan(
            status=PlanStatus.OK,
            t0_us=start.t_us,
            dt_us=self.dt_us,
            pos_ned_m=pos,
            vel_ned_m_s=vel,
            virtual_control=np.zeros((self.steps, 3)),
        )

    def reset(self) -> None:
        return


OPEN_LOOP = ControllerKind(
    name="open_loop",
    section="mpc",
    params=MpcParams,
    make=OpenLoop,
    plans=False,
    keeps_clear=False,
    follows_reference=False,
)
