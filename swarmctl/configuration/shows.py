"""Reads the drone show that a configuration names, a `.skyc` file of Skybrush, into its tree beside the file's name.

It is a ZIP archive with `show.json`, which holds the trajectory of every drone or refers to another JSON file of the
archive (`$ref`). Lights, yaw, cameras and music are not read. What is said about points of a trajectory is checked
later (`swarmctl/control/reference/kinds/skybrush.py`); this module checks the form.
"""

from __future__ import annotations

import io
import json
import posixpath
import zipfile
import zlib
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote

from swarmctl.core.json_safe import finite
from swarmctl.core.text import printable
from swarmctl.files import read_file

_MAX_BYTES = 50_000_000  # of the archive, and of each file in it that is read
_MAX_POINTS = 20_000  # of all drones: the resolved configuration holds them as text
_MAX_SHOWN = 80
_SHOW = "show.json"
_VERSION = 1  # of shows and trajectories


def read_show(tree: dict[str, Any], folder: Path) -> list[str]:
    """Fill in `mission.skybrush.trajectories` from `mission.skybrush.file`, unless they are there; returns problems.

    Args:
        tree: a configuration, whose form is checked later.
        folder: folder that a relative name is relative to.
    """
    mission = tree.get("mission")
    section = mission.get("skybrush") if isinstance(mission, dict) else None
    name = section.get("file") if isinstance(section, dict) else None
    if not isinstance(section, dict) or not isinstance(name, str) or not name or "trajectories" in section:
        return []
    show = _Show(folder / name)
    section["trajectories"] = show.trajectories()
    return [f"mission.skybrush.file: {printable(name, _MAX_SHOWN)}: {problem}" for problem in show.problems]


class _Show:
    """Reads one file.

    Attributes:
        problems: all that is wrong with it.
    """

    def __init__(self, path: Path) -> None:
        self.problems: list[str] = []
        self._archive: zipfile.ZipFile | None = None
        try:
            self._archive = zipfile.ZipFile(io.BytesIO(read_file(path, _MAX_BYTES, follow=True)))
        except FileNotFoundError:
            self.problems.append(f"no such file ({path}); names are relative to the configuration's folder")
        except OSError as error:
            self.problems.append(f"can't be read: {error.strerror}")
        except (zipfile.BadZipFile, NotImplementedError, ValueError):  # what a damaged directory may raise
            self.problems.append("is no ZIP archive, as .skyc files are")

    def trajectories(self) -> list[dict[str, Any]]:
        """Return the trajectory of every drone as the configuration holds it; problems are noted."""
        show = self._member(_SHOW) if self._archive is not None else None
        if show is None:
            return []
        self._check_version(_SHOW, show)
        swarm = show.get("swarm") if isinstance(show, dict) else None
        drones = self._followed(swarm, _SHOW)[0]
        drones = drones.get("drones") if isinstance(drones, dict) else None
        if not isinstance(drones, list) or not drones:
            self.problems.append("show.json: swarm.drones: missing; a list with every drone")
            return []
        found = [self._trajectory(number, drone) for number, drone in enumerate(drones)]
        count = sum(len(trajectory["points"]) for trajectory in found)
        if count > _MAX_POINTS:
            self.problems.append(f"{count} points; at most {_MAX_POINTS} of all drones are flown")
        return found if not self.problems else []

    def _trajectory(self, number: int, drone: Any) -> dict[str, Any]:
        who, nothing = f"drone {number}", {"takeoff_s": 0.0, "points": list[list[float]]()}
        drone, place = self._followed(drone, _SHOW)
        settings, place = self._followed(drone.get("settings") if isinstance(drone, dict) else None, place)
        trajectory = settings.get("trajectory") if isinstance(settings, dict) else None
        trajectory, _ = self._followed(trajectory, place)
        if not isinstance(trajectory, dict):
            self.problems.append(f"{who}: settings.trajectory: missing")
            return nothing
        self._check_version(f"{who}: trajectory", trajectory)
        takeoff_s, listed = finite(trajectory.get("takeoffTime") or 0.0), trajectory.get("points")
        if takeoff_s is None or takeoff_s < 0.0:
            self.problems.append(f"{who}: takeoffTime = {_shown(trajectory['takeoffTime'])}: a time from 0 s on")
        if not isinstance(listed, list) or not listed:
            self.problems.append(f"{who}: points: missing; a list of [time, [x, y, z], [control points]]")
            return nothing
        rows = [_row(point) for point in listed]
        wrong = [i for i, row in enumerate(rows) if row is None]
        form = "allowed: [time, [x, y, z], [[x, y, z], ...]] of finite numbers"
        self.problems += [f"{who}: point {i}: {_shown(listed[i])}; {form}" for i in wrong]
        return {"takeoff_s": takeoff_s or 0.0, "points": [row for row in rows if row is not None]}

    def _check_version(self, what: str, holder: Any) -> None:
        version = holder.get("version") if isinstance(holder, dict) else None
        if version != _VERSION:
            self.problems.append(f"{what}: version {_shown(version)}; {_VERSION} is read")

    def _followed(self, value: Any, base: str) -> tuple[Any, str]:
        """Return what a value refers to, or itself; and the file that its own references are relative to."""
        reference = value.get("$ref") if isinstance(value, dict) else None
        if not isinstance(reference, str):
            return value, base
        plain = unquote(reference.removeprefix("zip:")).removesuffix("#")
        name = posixpath.normpath(posixpath.join(posixpath.dirname(base), plain)).lstrip("/")
        if "#" in plain or ":" in plain or name.startswith(".."):
            self.problems.append(f"$ref {_shown(reference)}: only whole files of the archive are read")
            return None, base
        return self._member(name), name

    def _member(self, name: str) -> Any:
        """Return the JSON of a file in the archive, of bounded size whatever its header says."""
        assert self._archive is not None
        try:
            with self._archive.open(name) as file:
                content = file.read(_MAX_BYTES + 1)
            if len(content) > _MAX_BYTES:
                raise ValueError(f"is longer than {_MAX_BYTES} bytes")
            return json.loads(content, parse_constant=_refused)
        except KeyError:
            self.problems.append(f"{printable(name, _MAX_SHOWN)}: is not in the archive")
        except RecursionError:
            self.problems.append(f"{printable(name, _MAX_SHOWN)}: nested too deeply")
        except (ValueError, RuntimeError, NotImplementedError, EOFError, OSError, zipfile.BadZipFile) as error:
            self.problems.append(f"{printable(name, _MAX_SHOWN)}: {printable(str(error), _MAX_SHOWN)}")
        except zlib.error as error:
            self.problems.append(f"{printable(name, _MAX_SHOWN)}: damaged: {error}")
        return None


def _row(point: Any) -> list[float] | None:
    """Return time, place and control points of one point in a row; None if it is none."""
    if not isinstance(point, list) or len(point) not in (2, 3):
        return None
    time, place, *rest = point
    controls = rest[0] if rest and rest[0] is not None else []
    if not isinstance(controls, list) or not all(isinstance(v, list) and len(v) == 3 for v in [place, *controls]):
        return None
    numbers = [finite(value) for value in [time, *place, *(value for control in controls for value in control)]]
    found = [number for number in numbers if number is not None]
    return found if len(found) == len(numbers) else None


def _refused(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")


def _shown(value: Any) -> str:
    return printable(repr(value), _MAX_SHOWN)
