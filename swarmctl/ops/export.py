"""Writes a recorded run in the format of another program."""

from __future__ import annotations

import signal
from pathlib import Path

from swarmctl.config import load_recorded
from swarmctl.configuration.view import viewed_flight
from swarmctl.core.discovery.own import OwnError
from swarmctl.errors import ConfigError, StartError
from swarmctl.process_lifetime import StopRequest
from swarmctl.telemetry.export.mcap import RecordedFlight, write_mcap
from swarmctl.telemetry.recording.file_names import SUMMARY
from swarmctl.telemetry.recording.run_files import read_plans, read_text
from swarmctl.telemetry.recording.run_folder import read_judged, refuse_as_output


def export_mcap(directory: Path, output: Path | None) -> Path:
    """Write a finished run as MCAP, by default beside its folder, and return the file.

    Raises:
        ConfigError: it is no folder of a finished run, the file is one that the run has recorded, or its own mission
            can't be imported: nothing that a recorded configuration names is looked for beside it.
        StartError: the library for it is not installed, or the file can't be written.
    """
    config = load_recorded(directory)
    judged = read_judged(directory, config.rules())
    path = output or directory.resolve().with_name(f"{directory.resolve().name}.mcap")
    refuse_as_output(path, directory, ".mcap")
    try:
        flight = viewed_flight(config)
    except OwnError as error:
        raise ConfigError(str(directory), [f"{error}. Name the folder of that module in PYTHONPATH"]) from error
    recorded = RecordedFlight(
        run=judged.run,
        plans={agent: read_plans(directory, agent) for agent in judged.run.ticks},
        flight=flight,
        obstacles=judged.rules.obstacles,
        config_toml=judged.config_text,
        summary_json=read_text(directory / SUMMARY),
    )
    try:
        with StopRequest(signal.SIGTERM, signal.SIGHUP, raise_at=1):  # leaves nothing of a file that is not finished
            write_mcap(path, recorded)
    except OSError as error:
        problem = f"{path}: can't be written: {error.strerror or error}. Choose another with --output"
        raise StartError(problem) from error
    return path
