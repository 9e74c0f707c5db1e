"""The controllers that a configuration can choose from: those that modules of this package declare, and own ones.

A module is found by being there, so that a new controller is one new file with a `ControllerKind` (`kind.py`). A
controller of somebody else is named "package.module:Class" or offered by an installed package as an entry point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from swarmctl.control import controllers
from swarmctl.control.controllers.guard import Guard
from swarmctl.control.controllers.kind import Controller, ControllerKind
from swarmctl.control.controllers.own import GROUP, OwnController
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.core.discovery.declared import declared
from swarmctl.core.discovery.own import BuiltInOrOwn, OwnError, in_words, own_class
from swarmctl.core.params import Params, with_sections

_KINDS: list[ControllerKind[Any]] = list(declared(controllers, ControllerKind))
# by name; those that follow a reference come first
CONTROLLERS = {kind.name: kind for kind in sorted(_KINDS, key=lambda kind: not kind.follows_reference)}
if TYPE_CHECKING:
    ControllerName = str
else:
    ControllerName = Annotated[str, BuiltInOrOwn(tuple(CONTROLLERS), GROUP)]
_FALLBACK = "dmpc"  # flies where an own controller doesn't


@with_sections({kind.section: kind.params for kind in CONTROLLERS.values() if kind.section != "mpc"})
class ControllerParams(Params):
    """Selects the controller and holds the parameters of each."""

    kind: ControllerName = "dmpc"  # an own one flies the mission, not transits and landings
    own: dict[str, Any] = Field({})  # parameters of an own controller
    mpc: MpcParams = MpcParams()  # of all that plan; guaranteed separation plans with them under every controller

    @property
    def follows_reference(self) -> bool:
        """Tell whether the controller flies to the start and to the landing place too."""
        return not self.is_own and CONTROLLERS[self.kind].follows_reference

    @property
    def keeps_clear(self) -> bool:
        """Tell whether plans of the controller keep clear of peers and obstacles; an own one's are certified to."""
        return self.is_own or CONTROLLERS[self.kind].keeps_clear

    @property
    def keeps_volume(self) -> bool:
        """Tell whether plans of the controller stay in a flight volume; an own one's are certified to."""
        return self.is_own or self.plans

    @property
    def plans(self) -> bool:
        """Tell whether the controller is one of ours that plan, with the parameters `mpc`."""
        return not self.is_own and CONTROLLERS[self.kind].plans

    @property
    def is_own(self) -> bool:
        """Tell whether the controller is somebody else's."""
        return self.kind not in CONTROLLERS

    def own_params(self) -> type[Params]:
        """Return the class of an own controller's parameters.

        Raises:
            OwnError: there is no such controller.
        """
        return _params_of(own_class(self.kind, GROUP, OwnController), self.kind)


def make_controller(params: ControllerParams, setup: ControllerSetup) -> Controller:
    """Return the controller that a configuration asks for."""
    if params.is_own:
        fallback = _built_in(_FALLBACK, params, setup)
        return Guard(params.kind, make_own(params, setup, fallback), fallback, setup)
    return _built_in(params.kind, params, setup)


def make_own(params: ControllerParams, setup: ControllerSetup, grid: Controller) -> OwnController:
    """Return the own controller that a configuration asks for, on the time grid of another.

    Raises:
        OwnError: there is none, or it can't be made.
        ValidationError: its parameters are wrong.
    """
    found: type[OwnController] = own_class(params.kind, GROUP, OwnController)
    own_params = _params_of(found, params.kind).model_validate(params.own)
    try:
        return found(own_params, setup, grid.dt_us * 1e-6, grid.steps)
    except (Exception, SystemExit) as error:  # whatever it does when it is made
        raise OwnError(f"{params.kind} can't be made: {in_words(error)}") from error


def _params_of(controller: type[OwnController], name: str) -> type[Params]:
    """Return the class of an own controller's parameters.

    Raises:
        OwnError: it is none of parameters.
    """
    found: object = controller.Params
    if not isinstance(found, type) or not issubclass(found, Params):
        raise OwnError(f"{name}: its Params is no class derived from {Params.__module__}.{Params.__name__}")
    return found


def _built_in(name: str, params: ControllerParams, setup: ControllerSetup) -> Controller:
    kind = CONTROLLERS[name]
    return kind.make(getattr(params, kind.section), setup)
