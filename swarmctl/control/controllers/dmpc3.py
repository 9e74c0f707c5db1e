"""The distributed MPC with all three axes in one problem."""

from __future__ import annotations

from swarmctl.control.controllers.kind import ControllerKind
from swarmctl.control.mpc.joint_mpc import JointMpc
from swarmctl.control.mpc.mpc_params import MpcParams

DMPC3 = ControllerKind(name="dmpc3", section="mpc", params=MpcParams, make=JointMpc)
