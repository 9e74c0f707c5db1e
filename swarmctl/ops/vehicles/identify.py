"""`swarmctl check --identify`: flies every vehicle through small steps and identifies its model.

Because it flies, it first runs the check and stops while anything is to fix. The flight is a launch with the mission
`identify`; any run folder with enough motion gives the same figures.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tomli_w

from swarmctl.bus.bus import agent_name
from swarmctl.config import Config
from swarmctl.control.estimation.identification import Figure, Identified, identify, longest_segment
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.kinds.identify import IdentifyParams
from swarmctl.errors import EXIT_MISSION, EXIT_OK, StartError
from swarmctl.ops.flight.launch import LaunchOptions, launch
from swarmctl.ops.vehicles.vehicle_check import CheckOptions, check
from swarmctl.wall_clock import utc_us

_UNITS = {
    "delay_s": "s",
    "attitude_rad_s": "rad/s",
    "attitude_damping": "",
    "drag_1_s": "1/s",
    "hover_thrust_01": "of full",
}


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """Options of the verb that are not part of the configuration."""

    check: CheckOptions
    write: Path | None = None  # file for the model table
    run_dir: Path | None = None


def check_and_identify(config: Config, options: IdentifyOptions) -> int:
    """Check all vehicles, fly them, print the identified models, and return the exit code.

    Raises:
        StartError: the vehicles or the simulator do not come up, or the table can't be written.
        ConfigError: the configuration can't be flown.
    """
    if options.write is not None and options.write.exists():
        raise StartError(f"{options.write}: exists already. Choose a new file with --write")
    if options.write is not None and not options.write.absolute().parent.is_dir():
        raise StartError(f"{options.write}: its folder does not exist. Choose another file with --write")
    code = check(config, replace(options.check, to_fly=True))
    if code != EXIT_OK:
        print("not flown: something is to fix first")
        return code
    steps = config.mission.section(IdentifyParams)
    print(
        f"flying now: up to the start, then {steps.duration_s:.0f} s of steps of {steps.step_m:g} m about it, and back "
        "down. Ctrl-C lands"
    )
    directory = _run_folder(options.run_dir)
    code = launch(identification(config), LaunchOptions(directory))
    if code != EXIT_OK:
        print("not identified: the flight did not go as asked")
        return code
    found = identified(directory, config.swarm.agents)
    models = {agent: result for agent, result in found.items() if isinstance(result, Identified)}
    for line in lines(found):
        print(line)
    text = table(config, models, time.strftime("%Y-%m-%d", time.gmtime()))
    print(f"\n{text}", end="")
    if options.write is not None:
        _write(options.write, text)
    return EXIT_OK if len(models) == config.swarm.agents else EXIT_MISSION


def identification(config: Config) -> Config:
    """Return the configuration of the identification flight."""
    mission = config.mission.model_copy(
        update={"kind": "identify", "duration_s": config.mission.section(IdentifyParams).duration_s, "yaw_rad": 0.0}
    )
    telemetry = config.telemetry.model_copy(update={"enabled": False})
    return Config.model_validate(
        {**config.model_dump(), "mission": mission.model_dump(), "telemetry": telemetry.model_dump()}
    )


def identified(directory: Path, agents: int) -> dict[int, Identified | str]:
    """Return the identified model of each agent of a run folder, or why there is none."""
    from swarmctl.telemetry.recording.run_files import load_run  # heavy

    run = load_run(directory)
    found: dict[int, Identified | str] = {}
    for agent in range(agents):
        flight = longest_segment(run.ticks[agent]) if agent in run.ticks else "nothing was recorded"
        found[agent] = flight if isinstance(flight, str) else identify(flight)
    return found


def lines(found: Mapping[int, Identified | str]) -> list[str]:
    """Return one line per figure for people, separated by tabs."""
    shown = ["vehicle\twhat\testimate\t95 % interval\tunit"]
    for agent, result in found.items():
        if isinstance(result, str):
            shown.append(f"{agent_name(agent)}\tnot identified: {result}")
            continue
        for name, unit in _UNITS.items():
            figure: Figure = getattr(result, name)
            shown.append(
                f"{agent_name(agent)}\t{name}\t{figure.value:.4g}\t{figure.low:.4g} to {figure.high:.4g}\t{unit}"
            )
    return shown


def table(config: Config, models: Mapping[int, Identified], date: str) -> str:
    """Return TOML for the configuration: a model per listed vehicle, or one for the built-in simulator (its first)."""
    text = [f"# swarmctl check --identify, {date}; behind each figure its 95 % interval"]
    for agent, found in models.items():
        if config.vehicles:
            vehicle = config.vehicles[agent]
            text += ["[[vehicles]]", f"sysid = {vehicle.sysid}", tomli_w.dumps({"url": vehicle.url}).rstrip(), ""]
        text += [f"[{'vehicles.model' if config.vehicles else 'vehicle_model'}]"]
        text += _model_lines(found, config.model_of(agent))
        if not config.vehicles:
            break
        text.append("")
    return "\n".join(text).rstrip("\n") + "\n"


def _model_lines(found: Identified, before: VehicleModelParams) -> Sequence[str]:
    shown = []
    for name, value in found.model(before).model_dump().items():
        figure = getattr(found, name, None)
        interval = "" if figure is None else f"  # {figure.low:.3g} to {figure.high:.3g}"
        shown.append(f"{tomli_w.dumps({name: value}).rstrip()}{interval}")
    return shown


def _run_folder(run_dir: Path | None) -> Path:
    from swarmctl.telemetry.recording.new_run_folder import create_run_folder  # heavy

    return create_run_folder(run_dir, "identify", utc_us(), advice="Go to another folder")


def _write(path: Path, text: str) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise StartError(f"{path}: can't be written: {error}. Choose another with --write") from error
