"""`swarmctl replay --decide`: every agent of a run decides again, by its configuration or with keys set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from swarmctl.config import load, load_recorded
from swarmctl.errors import ConfigError
from swarmctl.ops.decide.again import Decisions, compare, decide_again
from swarmctl.telemetry.recording.file_names import CONFIG
from swarmctl.telemetry.recording.run_files import load_run, read_plans

_SHOWN = 10  # differences of an agent, in text


def decisions_of_run(directory: Path, overrides: Sequence[str]) -> list[Decisions]:
    """Return what every agent of a run decides again beside what it has decided.

    Args:
        directory: run folder; own controllers that it names are imported and run.
        overrides: `key.sub=value` items, set in the configuration that was flown.

    Raises:
        ConfigError: it is no run folder, lacks what is needed, or an override is wrong.
    """
    flown = load_recorded(directory)  # refuses what is no run folder before anything of it is imported
    config = load(directory / CONFIG, overrides)
    run = load_run(directory)
    if config.swarm.agents != flown.swarm.agents:
        raise ConfigError("--set", [f"swarm.agents is that of the run, {flown.swarm.agents}"])
    if not run.ticks:
        raise ConfigError(str(directory), ["holds no ticks of an agent, so that there is nothing to decide again"])
    plans = {agent: read_plans(directory, agent) for agent in run.ticks}
    return [
        compare(rows, decide_again(directory, config, run, plans, agent), agent) for agent, rows in run.ticks.items()
    ]


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
