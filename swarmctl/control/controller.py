"""The controllers that a configuration can choose from, behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np

from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.joint_mpc import JointMpc
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.mpc.swarm_mpc import MpcParams, SwarmMpc
from swarmctl.control.pid import PidController, PidParams
from swarmctl.core.params import Params
from swarmctl.core.types import NO_TIMES, Plan, PlanStatus


class ControllerParams(Params):
    """Selects the controller and holds the parameters of each."""

    kind: Literal["dmpc", "dmpc3", "mpc", "pid", "open_loop"] = "dmpc"
    mpc: MpcParams = MpcParams()  # for dmpc, dmpc3 (all axes in one problem) and mpc (without keep-outs)
    pid: PidParams = PidParams()


class Controller(Protocol):
    """Plans one tick; failure is a value, `Plan.status`."""

    @property
    def dt_us(self) -> int:
        """Return the time between plan points [us]."""

    @property
    def steps(self) -> int:
        """Return the number of steps of a plan, N."""

    @property
    def longest(self) -> int:
        """Return the number of steps of reference that a problem has to hold."""

    def plan(self, problem: Problem) -> Plan:
        """Return a plan from `problem.start` on. Never raises for a problem without a solution."""

    def reset(self) -> None:
        """Forget the past, after a handover."""


class _Mpc:
    """Adapts both kinds of MPC, which keep nothing between ticks but their warm start."""

    def __init__(self, mpc: SwarmMpc | JointMpc, alone: bool) -> None:
        self._mpc, self._alone = mpc, alone
        self.dt_us, self.steps, self.longest = mpc.dt_us, mpc.steps, mpc.longest

    def plan(self, problem: Problem) -> Plan:
        return self._mpc.plan(replace(problem, keep_outs=()) if self._alone else problem)

    def reset(self) -> None:
        return


class _Pid:
    """Adapts the PID cascade."""

    def __init__(self, params: PidParams) -> None:
        self._pid = PidController(params)
        self.dt_us, self.steps, self.longest = self._pid.dt_us, self._pid.steps, self._pid.steps

    def plan(self, problem: Problem) -> Plan:
        return self._pid.plan(problem)

    def reset(self) -> None:
        self._pid.reset()


class _OpenLoop:
    """Commands zero input (thesis 1.6): level attitude and no thrust, whatever the state."""

    def __init__(self, params: MpcParams) -> None:
        self.dt_us, self.steps = round(params.dt_s * 1e6), params.horizon_xy
        self.longest = self.steps

    def plan(self, problem: Problem) -> Plan:
        start = problem.start
        t_s = np.arange(self.steps + 1)[:, None] * (self.dt_us * 1e-6)
        pos = start.pos_ned_m + t_s * start.vel_ned_m_s
        vel = np.tile(start.vel_ned_m_s, (self.steps + 1, 1))
        nothing = np.zeros((self.steps, 3))
        return Plan(
            status=PlanStatus.OK,
            t0_us=start.t_us,
            dt_us=self.dt_us,
            pos_ned_m=pos,
            vel_ned_m_s=vel,
            virtual_control=nothing,
            times=NO_TIMES,
            iterations=0,
            slack_m=0.0,
            residual_m=0.0,
            terminal_gap_m=0.0,
        )

    def reset(self) -> None:
        return


def make_controller(
    params: ControllerParams,
    vehicle: VehicleModelParams,
    separation: SeparationParams,
    agent: int,
    max_keep_outs: int,
    stopwatch_ns: Callable[[], int],
) -> Controller:
    """Return the controller that a configuration asks for, with rows for `max_keep_outs` keep-outs at once."""
    if params.kind == "pid":
        return _Pid(params.pid)
    if params.kind == "open_loop":
        return _OpenLoop(params.mpc)
    if params.kind == "dmpc3":
        return _Mpc(JointMpc(params.mpc, vehicle, separation, agent, max_keep_outs, stopwatch_ns), False)
    alone = params.kind == "mpc"
    return _Mpc(SwarmMpc(params.mpc, vehicle, separation, agent, 0 if alone else max_keep_outs, stopwatch_ns), alone)
