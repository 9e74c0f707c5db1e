"""The controllers that a configuration can choose from: one for each that a module of this package declares.

A module is found by being there, so that a new controller is one new file with a `ControllerKind` (`kind.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from swarmctl.control import controllers
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.controllers.kind import Controller, ControllerKind, ControllerSetup
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.swarm_mpc import MpcParams
from swarmctl.core.declared import declared
from swarmctl.core.params import Params, with_sections

_KINDS: list[ControllerKind[Any]] = list(declared(controllers, ControllerKind))
# by name; those that follow a reference come first
CONTROLLERS = {kind.name: kind for kind in sorted(_KINDS, key=lambda kind: not kind.follows_reference)}
if TYPE_CHECKING:
    ControllerName = str
else:
    ControllerName = Literal[tuple(CONTROLLERS)]


@with_sections({kind.section: kind.params for kind in CONTROLLERS.values() if kind.section != "mpc"})
class ControllerParams(Params):
    """Selects the controller and holds the parameters of each."""

    kind: ControllerName = "dmpc"
    mpc: MpcParams = MpcParams()  # of all that plan; guaranteed separation plans with them under every controller

    @property
    def follows_reference(self) -> bool:
        """Tell whether the controller can fly to a place."""
        return CONTROLLERS[self.kind].follows_reference


def make_controller(
    params: ControllerParams,
    vehicle: VehicleModelParams,
    separation: SeparationParams,
    agent: int,
    *,
    max_keep_outs: int,
    stopwatch_ns: Callable[[], int],
) -> Controller:
    """Return the controller that a configuration asks for, with rows for `max_keep_outs` keep-outs at once."""
    kind = CONTROLLERS[params.kind]
    setup = ControllerSetup(
        vehicle=vehicle,
        separation=separation,
        agent=agent,
        max_keep_outs=max_keep_outs,
        stopwatch_ns=stopwatch_ns,
    )
    return kind.make(getattr(params, kind.section), setup)
