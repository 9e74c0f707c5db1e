"""`swarmctl bundle`: one archive of a run for whoever is to find out what happened, with the vehicles' own logs.

It holds the run folder with its resolved configuration, versions of packages, and from every reachable vehicle that is
disarmed the list of its logs and the newest of them.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import signal
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from swarmctl import __version__
from swarmctl.bus.bus import agent_name
from swarmctl.check.parameters import unchangeable
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.check.scan.scanner import run_scans
from swarmctl.config import Config, load_recorded
from swarmctl.configuration.sections import MavlinkParams
from swarmctl.errors import StartError
from swarmctl.files import replaced
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.ops.vehicles.vehicle_links import open_links
from swarmctl.process_lifetime import StopRequest
from swarmctl.telemetry.recording.run_folder import refuse_as_output

if TYPE_CHECKING:
    from swarmctl.check.ground_services import GroundVehicle

_SIMULATED = "the built-in simulator keeps no logs"
_SIGNED = "it signs its link, and a bundle reads no key file that a run folder names; take its logs by a ground station"
_CONNECT_S, _LISTEN_S, _LONGER_S = 5.0, 1.0, 10.0
_PACKAGES = ("numpy", "scipy", "osqp", "pymavlink", "mavsdk", "eclipse-zenoh", "msgspec", "pyarrow", "rerun-sdk")


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleOptions:
    """What a bundle is made of, besides the run folder."""

    folder: Path
    output: Path | None = None  # archive to write; None: beside the run folder
    logs: int = 1  # number of logs to download from each vehicle, the newest first
    longest_s: float = 300.0  # time for each log


class Bundle(NamedTuple):
    """A written archive, and of which vehicles it holds no logs."""

    path: Path
    problems: Mapping[str, str]  # by agent, why; as in its `vehicles.json`


def bundle(options: BundleOptions) -> Bundle:
    """Write the archive. What can't be had from a vehicle is named in `vehicles.json`.

    Raises:
        ConfigError: it is no run folder, or the archive is a file that the run has recorded.
        StartError: the archive can't be written; nothing is downloaded where that is known before.
    """
    config, folder = load_recorded(options.folder), options.folder.resolve()
    output = options.output or folder.with_name(f"{folder.name}.zip")
    refuse_as_output(output, folder, ".zip")
    if not output.resolve().parent.is_dir():  # before logs are downloaded, which takes minutes
        raise StartError(f"{output}: its folder does not exist. Choose another with --output")
    ended_cleanly = StopRequest(signal.SIGTERM, signal.SIGHUP, raise_at=1)
    try:
        with ended_cleanly, tempfile.TemporaryDirectory(prefix="swarm-bundle-") as scratch:
            vehicles = _vehicles(config, options, Path(scratch))
            recorded = [p for p in sorted(folder.rglob("*")) if p.is_file() and not p.is_symlink()]
            with (
                replaced(output) as file,
                zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, strict_timestamps=False) as archive,  # before 1980
            ):
                archive.writestr("versions.json", _json(_versions()))
                archive.writestr("vehicles.json", _json(vehicles))
                for path in recorded:  # listed before the archive began, which may be among them
                    if path != output.resolve():
                        _add(archive, path, Path(folder.name) / path.relative_to(folder))
                for path in sorted(Path(scratch).iterdir()):
                    archive.write(path, Path("logs") / path.name)
    except OSError as error:
        raise StartError(
            f"{output}: can't be written: {error.strerror or error}. Choose another with --output"
        ) from error
    return Bundle(output, {agent: told["problem"] for agent, told in vehicles.items() if "problem" in told})


def _add(archive: zipfile.ZipFile, path: Path, name: Path) -> None:
    """Add a file of the run.

    Raises:
        StartError: it has vanished since the folder was listed.
        OSError: the archive can't be written.
    """
    try:
        archive.write(path, name)
    except FileNotFoundError as error:
        text = f"{path}: has vanished, as the run is being packed. Repeat the command once it is finished"
        raise StartError(text) from error
    except UnicodeEncodeError as error:
        raise StartError(f"{str(path)!a}: its name is not UTF-8, and can't be in an archive; rename it") from error


def lines_of(bundled: Bundle) -> list[str]:
    """Return the path of the archive, and a line for each reason why logs are missing."""
    agents: dict[str, list[str]] = {}
    for agent, why in bundled.problems.items():
        agents.setdefault(why, []).append(agent)
    return [str(bundled.path), *(f"no logs of {', '.join(names)}: {why}" for why, names in agents.items())]


def _vehicles(config: Config, options: BundleOptions, scratch: Path) -> dict[str, dict[str, Any]]:
    """Download into `scratch`, and return by agent what each vehicle stores, or why it is not known."""
    if why := _SIMULATED if config.sitl.enabled else _SIGNED if config.mavlink.signing_keys else "":
        return {agent_name(agent): {"problem": why} for agent in range(config.swarm.agents)}
    config = config.model_copy(update={"mavlink": MavlinkParams()})  # what a received folder names is not read
    with open_links(config, _CONNECT_S) as opened:
        scans = opened.scans(config, _LISTEN_S)
        run_scans(list(scans.values()), _CONNECT_S, _CONNECT_S + _LONGER_S, opened.ended)
        vehicles = opened.facts(config, scans)
        refused = {facts.agent: facts.unreachable or unchangeable(facts) for facts in vehicles}
        jobs = {
            facts.agent: partial(
                _job, options=options, stem=scratch / agent_name(facts.agent), suffix=_log_suffix(facts)
            )
            for facts in vehicles
            if not refused[facts.agent]
        }
        told: Mapping[int, dict[str, Any]] = {}
        if jobs:
            from swarmctl.check.ground_services import open_services  # heavy

            with open_services({agent: scans[agent] for agent in jobs}) as services:
                told = services.ask(jobs)
    unknown = {"problem": "it was not found again"}
    return {
        agent_name(agent): {"problem": problem} if problem else told.get(agent, unknown)
        for agent, problem in refused.items()
    }


def _log_suffix(facts: VehicleFacts) -> str:
    dialect = DIALECTS.get(facts.autopilot_number)
    return "" if dialect is None else dialect.log_suffix


def _job(vehicle: GroundVehicle, *, options: BundleOptions, stem: Path, suffix: str) -> dict[str, Any]:
    logs = vehicle.logs()
    if logs is None:
        return {"problem": "it tells no logs"}
    incomplete = {}
    for log in sorted(logs, key=lambda log: log.number, reverse=True)[: options.logs]:
        path = stem.with_name(f"{stem.name}-log-{log.number}{suffix}")
        if problem := vehicle.download(log, path, options.longest_s):
            incomplete[path.name] = problem
    return {"logs": [asdict(log) for log in logs], "incomplete": incomplete}


def _versions() -> dict[str, str]:
    found = {"swarmctl": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _json(tree: Mapping[str, Any]) -> str:
    return json.dumps(tree, indent=1) + "\n"
