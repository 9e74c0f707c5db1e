"""The thesis' distributed MPC: z, then x-y, with half-spaces around peers and obstacles."""

from __future__ import annotations

from swarmctl.control.controllers.kind import ControllerKind
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.swarm_mpc import SwarmMpc

DMPC = ControllerKind(name="dmpc", section="mpc", params=MpcParams, make=SwarmMpc)
