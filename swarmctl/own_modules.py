"""Makes modules of the user importable, and refuses own missions and controllers that can't be flown.

A configuration names its own ones, "package.module:Class", and this module says where they are: in the folder of the
configuration's file, behind all that is installed. The resolved configuration holds that folder, so that the processes
of a launch find the same modules.
"""

from __future__ import annotations

import importlib
import os
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
OWN_KINDS = ("mission.kind", "controller.kind")  # keys that may name own ones
_SHIPPED = [Path(__file__).resolve().parents[1] / package for package in ("swarmctl", "sitl")]
_INSTALLED = "site-packages"  # folder of what is installed
_added: list[str] = []  # folders of own modules in `sys.path`, the one asked for last first
_imported_ns: dict[str, int] = {}  # when files of own modules had been changed, as they were imported


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
    """Let this process import from a folder; "" for none.

    Modules of the same names in the folder of another configuration, and those whose files have changed since they were
    imported, are imported anew: what is checked in a notebook is then what a flight, a process of its own, imports.
    """
    if not folder:
        return
    if folder in _added or folder not in sys.path:
        sys.path[:] = [place for place in sys.path if place not in _added]
        _added[:] = [folder, *(added for added in _added if added != folder)]
        sys.path.extend(_added)  # behind all that is installed
    importlib.invalidate_caches()  # a file may have been written just now
    known = list(_own_files(folder, *_added))
    if any(_is_hidden(name, file, folder) or _has_changed(file) for name, file in known):
        for name, file in known:  # they may import each other
            _imported_ns.pop(str(file), None)
            del sys.modules[name]


def own_sources(folder: str) -> list[Path]:
    """Return the files in the folder of own modules that this process has imported; "" for none."""
    return sorted({file for _, file in _own_files(folder)}) if folder else []


def _own_files(*folders: str) -> Iterator[tuple[str, Path]]:
    """Yield name and file of each module imported from folders, but for those that are installed there, or shipped."""
    inside, elsewhere = (tuple(f"{folder}{os.sep}" for folder in listed) for listed in (folders, _SHIPPED))
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if not isinstance(file, str) or not file.endswith(".py") or name == "__main__":
            continue
        if file.startswith(inside) and not file.startswith(elsewhere) and _INSTALLED not in file:
            yield name, Path(file)


def _is_hidden(name: str, file: Path, folder: str) -> bool:
    """Return whether a module is another folder's, and this one has one of that name."""
    return not file.is_relative_to(folder) and Path(folder, *name.split(".")).with_suffix(".py").is_file()


def _has_changed(file: Path) -> bool:
    """Return whether the file of a module has changed since that was imported."""
    return _imported_ns.get(str(file), _changed_ns(file)) != _changed_ns(file)


def _changed_ns(file: Path) -> int:
    """Return when a file was changed; 0 where it is gone."""
    return file.stat().st_mtime_ns if file.is_file() else 0


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
    for _, file in _own_files(*_added):
        _imported_ns.setdefault(str(file), _changed_ns(file))


def _problems(section: str, name: str, make: Callable[[], object], params: Callable[[], type[Params]]) -> Iterator[str]:
    try:
        make()
    except OwnError as error:
        where = ". Modules are looked for in the configuration's folder (own_folder)" if error.not_found else ""
        yield f"{section}.kind = {name!r}: {error}{where}"
    except ValidationError as error:
        yield from problems_of(error, params(), f"{section}.own")
