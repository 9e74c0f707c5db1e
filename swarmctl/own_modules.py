"""Makes modules of the user importable, and refuses own missions and controllers that can't be flown.

A configuration names its own ones, "package.module:Class", and this module says where they are: in the folder of the
configuration's file, behind all that is installed. The resolved configuration holds that folder, so that the processes
of a launch find the same modules.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from swarmctl.configuration.problems import problems_of
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.controllers.discovery import ControllerParams, make_controller
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.discovery.own import OwnError
from swarmctl.core.params import Params

OWN_FOLDER = "own_folder"  # key of a configuration


def locate(tree: dict[str, Any], folder: Path) -> None:
    """Fill in the folder of own modules, if `tree` names any: its own value and `folder`, joined.

    Args:
        tree: a configuration, whose form is checked later.
        folder: that of its file, or the current one.
    """
    given = tree.get(OWN_FOLDER, "")
    kinds = [section.get("kind") for name in ("mission", "controller") if isinstance(section := tree.get(name), dict)]
    if isinstance(given, str) and (given or any(isinstance(kind, str) and ":" in kind for kind in kinds)):
        tree[OWN_FOLDER] = str((folder / given).resolve())


def make_importable(folder: str) -> None:
    """Let this process import from a folder; "" for none."""
    if folder and folder not in sys.path:
        sys.path.append(folder)


def own_problems(
    mission: MissionParams, controller: ControllerParams, vehicle: VehicleModelParams, separation: SeparationParams
) -> Iterator[str]:
    """Yield why own missions and controllers can't be had, made, or take their parameters."""
    if mission.is_own:
        yield from _problems("mission", mission.kind, mission.flown, mission.own_params)
    if controller.is_own:

        def make() -> object:
            stopwatch_ns = time.perf_counter_ns
            setup = ControllerSetup(
                vehicle=vehicle, separation=separation, agent=0, max_keep_outs=1, stopwatch_ns=stopwatch_ns
            )
            return make_controller(controller, setup)

        yield from _problems("controller", controller.kind, make, controller.own_params)


def _problems(section: str, name: str, make: Callable[[], object], params: Callable[[], type[Params]]) -> Iterator[str]:
    try:
        make()
    except OwnError as error:
        where = ". Modules are looked for in the configuration's folder (own_folder)" if error.not_found else ""
        yield f"{section}.kind = {name!r}: {error}{where}"
    except ValidationError as error:
        yield from problems_of(error, params(), f"{section}.own")
