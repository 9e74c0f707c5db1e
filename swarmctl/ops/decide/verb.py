"""`swarmctl replay --decide`: every agent of a run decides again, by its configuration or with keys set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.config import load, load_recorded
from swarmctl.core.recorded.received import ReceivedKind
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError
from swarmctl.ops.decide.again import Decisions, compare, decide_again, recorded_frames
from swarmctl.ops.decide.deliveries import Recording
from swarmctl.ops.running_launches import refuse_running
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.evaluation.tracks import flight_rows
from swarmctl.telemetry.recording.file_names import CONFIG, frames_file
from swarmctl.telemetry.recording.run_files import load_run, read_plans, read_received, read_summary, refuse_recorded

_SHOWN = 10  # differences of an agent, in text


def decisions_of_run(directory: Path, overrides: Sequence[str]) -> list[Decisions]:
    """Return what every agent of a run decides again beside what it has decided.

    Args:
        directory: run folder; own controllers that it names are imported and run.
        overrides: `key.sub=value` items, set in the configuration that was flown.

    Raises:
        ConfigError: it is no run folder, lacks what is needed, or an override is wrong.
        StartError: the run is not over: its files, read one after another, would end at different times.
    """
    flown = load_recorded(directory)  # refuses what is no run folder before anything of it is imported
    if read_summary(directory) is None:
        refuse_running(directory)
        refuse_recorded(directory)
    config = load(directory / CONFIG, overrides, only_agents=())  # nothing is sent, so nobody's signing key is needed
    run = load_run(directory)
    if config.swarm.agents != flown.swarm.agents:
        raise ConfigError("--set", [f"swarm.agents is that of the run, {flown.swarm.agents}"])
    run = replace(run, ticks=_recorded(run))
    if not run.ticks:
        raise ConfigError(str(directory), ["holds no ticks of an agent, so that there is nothing to decide again"])
    recording = Recording(
        run=run,
        plans={agent: read_plans(directory, agent) for agent in run.ticks},
        received={agent: read_received(directory, agent) for agent in run.ticks},
    )
    return [
        compare(rows, decide_again(directory, config, recording, agent), agent) for agent, rows in run.ticks.items()
    ]


def notes_of_run(directory: Path) -> list[str]:
    """Return what is not known of a run that is decided again, one line for each agent that it is not known of.

    Raises:
        ConfigError: it is no run folder, or a file of it can't be read.
    """
    run, agents = load_run(directory), load_recorded(directory).swarm.agents
    recorded, notes = _recorded(run), list[str]()
    for agent in range(agents):
        rows, name = recorded.get(agent), agent_name(agent)
        if rows is None:
            notes.append(f"{name}: no ticks were recorded; what it has said is not known to the others, nor compared")
            continue
        received = read_received(directory, agent)
        if not len(received):
            notes.append(f"{name}: an older recording, without what each tick received: it is guessed by stamps")
        elif lost := _lost_frames(received, len(recorded_frames(directory, agent))):
            notes.append(f"{name}: {frames_file(agent)} lacks {lost}: without them it decides otherwise")
        if len(flight_rows(rows[-1:])):
            phase = Phase(int(rows["phase"][-1])).name
            notes.append(f"{name}: its ticks end in {phase}; how others noticed is not replayed: they may differ")
    return notes


def _lost_frames(received: NDArray[np.void], there: int) -> str:
    """Return how many frames that ticks have received are not there; "" if all are."""
    frames = int(received["seq"][received["kind"] == ReceivedKind.FRAMES].sum())
    return f"{frames - there} of {frames} frames that its ticks received" if there < frames else ""


def _recorded(run: RunData) -> dict[int, NDArray[np.void]]:
    return {agent: rows for agent, rows in run.ticks.items() if len(rows)}


def lines_of(decisions: Decisions) -> list[str]:
    """Return what is said of an agent: a line of figures, and one for each stretch in which it decides otherwise."""
    tilt, thrust, found = decisions.tilt_rad, decisions.thrust_01, decisions.differences
    head = (
        f"agent-{decisions.agent}: {decisions.compared} ticks, {sum(each.ticks for each in found)} differ; "
        f"phase {decisions.phases_differ}, plan {decisions.plans_differ}; "
        f"attitude p50/p99/max {'/'.join(f'{math.degrees(tilt[key]):.2f}' for key in ('p50', 'p99', 'max'))} deg, "
        f"thrust {'/'.join(f'{thrust[key]:.3f}' for key in ('p50', 'p99', 'max'))}"
    )
    lines = [head]
    for each in found[:_SHOWN]:
        said = each.was if each.was == each.now else f"{each.was} -> {each.now}"
        lines.append(
            f"  {each.from_s:.2f} to {each.to_s:.2f} s, {each.ticks} ticks: {said}; "
            f"attitude up to {math.degrees(each.tilt_rad):.2f} deg, thrust {each.thrust_01:.3f}"
        )
    if len(found) > _SHOWN:
        lines.append(f"  and {len(found) - _SHOWN} more; all with --json")
    return lines
