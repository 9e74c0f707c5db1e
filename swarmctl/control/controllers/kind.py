"""What a controller is to the agent, and what the module of one declares about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.params import Params
from swarmctl.core.types import Plan

P = TypeVar("P", bound=Params)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerKind(Generic[P]):
    """Declares a controller that a configuration can choose, once in its module of this package."""

    name: str  # value of `controller.kind`
    section: str  # name of the section of the configuration with its parameters, which several may share
    params: type[P]
    make: Callable[[P, ControllerSetup], Controller]
    plans: bool = True  # false: `u_max` does not bound it, and it flies out of a flight volume
    keeps_clear: bool = True  # false: of peers and obstacles; only the safety filter does
    follows_reference: bool = True  # false: another one flies to the start and to the landing place
