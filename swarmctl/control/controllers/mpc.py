"""The thesis' MPC of a single vehicle, which keeps clear of nothing."""

from __future__ import annotations

from dataclasses import replace

from swarmctl.control.controllers.kind import ControllerKind
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.mpc.swarm_mpc import SwarmMpc
from swarmctl.core.types import Plan


class SingleMpc(SwarmMpc):
    """Plans as if there were no keep-outs."""

    def __init__(self, params: MpcParams, setup: ControllerSetup) -> None:
        super().__init__(params, replace(setup, max_keep_outs=0))

    def plan(self, problem: Problem) -> Plan:
        return super().plan(replace(problem, keep_outs=()))


MPC = ControllerKind(name="mpc", section="mpc", params=MpcParams, make=SingleMpc, keeps_clear=False)
