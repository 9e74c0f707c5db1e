"""The distributed MPC with all three axes in one problem."""

from __future__ import annotations

from swarmctl.control.controllers.kind import ControllerKind, ControllerSetup
from swarmctl.control.mpc.joint_mpc import JointMpc
from swarmctl.control.mpc.swarm_mpc import MpcParams


def _make(params: MpcParams, setup: ControllerSetup) -> JointMpc:
    return JointMpc(
        params,
        setup.vehicle,
        setup.separation,
        setup.agent,
        max_keep_outs=setup.max_keep_outs,
        stopwatch_ns=setup.stopwatch_ns,
        volume=setup.volume,
    )


DMPC3 = ControllerKind(name="dmpc3", section="mpc", params=MpcParams, make=_make)
