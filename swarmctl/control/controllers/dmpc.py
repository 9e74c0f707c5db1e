"""The thesis' distributed MPC: z, then x-y, with half-spaces around peers and obstacles."""

from __future__ import annotations

from swarmctl.control.controllers.kind import ControllerKind, ControllerSetup
from swarmctl.control.mpc.swarm_mpc import MpcParams, SwarmMpc


def _make(params: MpcParams, setup: ControllerSetup) -> SwarmMpc:
    return SwarmMpc(
        params,
        setup.vehicle,
        setup.separation,
        setup.agent,
        max_keep_outs=setup.max_keep_outs,
        stopwatch_ns=setup.stopwatch_ns,
        volume=setup.volume,
    )


DMPC = ControllerKind(name="dmpc", section="mpc", params=MpcParams, make=_make)
