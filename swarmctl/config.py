"""Configuration of a whole run, read from TOML and written. An invalid one is refused with all its problems.

Everybody but the checks themselves imports `Config` from here. No sockets are opened, and nothing is started.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence, Set
from pathlib import Path
from types import MappingProxyType
from typing import Any

import tomli_w

from swarmctl.bus.network.hosts import roster_of
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.configuration.constraint_table import constraint_problems, infeasible_references, sections_of
from swarmctl.configuration.constraints import address_problems, obstacle_problems
from swarmctl.configuration.obstacles import read_obstacles
from swarmctl.configuration.problems import validated
from swarmctl.configuration.shows import read_show
from swarmctl.configuration.source import filled_in, forget_other_files, override, read_tree, set_value
from swarmctl.configuration.tables import read_tables
from swarmctl.configuration.tree import Config
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.errors import ConfigError
from swarmctl.own_modules import locate, make_importable
from swarmctl.signing_keys import locate_identities, locate_keys

__all__ = ["NO_VALUES", "Config", "dump", "load", "load_mission", "load_recorded", "own_identity"]

NO_VALUES: Mapping[str, Any] = MappingProxyType({})
_NUMBERS = re.compile(r"\[\n((?: +[-+.\w]+,\n)+) *\]")  # an array of numbers as tomli_w writes it: one on each line
_RENAMED = {  # today's keys by former ones, which are refused with this as the hint
    "agent.commit.bias_rad": "agent.commit.right_of_way_rad",
    "agent.commit.share_01": "agent.commit.tilt_fraction_01",
    "agent.detour": "agent.deadlock",
    "agent.sequence": "agent.state_machine",
    "limits.late_ticks_01": "limits.deadline_misses_01",
    "mission.goto.standoff": "mission.goto.goal_assignment",
    "separation.bias_obstacle_rad": "separation.right_of_way_obstacle_rad",
    "separation.bias_rad": "separation.right_of_way_rad",
}


def load(
    path: Path | None,
    overrides: Sequence[str] = (),
    values: Mapping[str, Any] = NO_VALUES,
    *,
    only_agents: Collection[int] | None = None,
) -> Config:
    """Read, override and check a configuration.

    Args:
        path: a TOML file; None for the defaults.
        overrides: `key.sub=value` items, values in TOML syntax (bare words are strings); list items by index.
        values: values by dotted key, set after `overrides`.
        only_agents: the agents that are to run on this computer, which has their vehicles' signing keys; None: all.

    Raises:
        ConfigError: the configuration is invalid; lists all problems with key, value, allowed range and fix.
    """
    source = str(path) if path else "defaults"
    tree, folder = read_tree(path), Path.cwd() if path is None else path.parent
    read_obstacles(tree, folder)  # so that overrides may change one; what is wrong is said below
    was_filled_in = filled_in(tree)
    problems = [p for item in overrides for p in override(tree, item)]
    problems += [p for key, value in values.items() for p in set_value(tree, key, value)]
    forget_other_files(tree, was_filled_in)
    problems += read_tables(tree, folder) + read_show(tree, folder) + read_obstacles(tree, folder)
    locate(tree, folder)
    locate_keys(tree, folder)
    locate_identities(tree, folder)
    config, of_keys = _right_part(tree, sections_of(problems))
    problems += of_keys
    wrong = sections_of(problems)
    problems += address_problems(tree) if wrong else ()
    if config is not None:
        make_importable(config.own_folder)
        problems += constraint_problems(config, wrong, only_agents)
    if config is None or problems:
        raise ConfigError(source, list(dict.fromkeys(problems)))
    return config


def _right_part(tree: Mapping[str, Any], wrong: Set[str]) -> tuple[Config | None, Sequence[str]]:
    """Return the configuration of a plain tree, and what is wrong with keys of further sections.

    Args:
        tree: the plain tree.
        wrong: sections that are known to be wrong. Those, and the further ones, stand at their defaults.

    Returns:
        None for the configuration where a problem may be of any section, as that of an unknown one.
    """
    config: Config | None = None
    problems: Sequence[str] = ()
    try:
        config = validated(Config, _without(tree, wrong), "", _RENAMED)
    except ConfigError as error:
        problems = error.problems
    wrong = wrong | sections_of(problems)
    if not wrong <= Config.model_fields.keys():
        return None, problems
    return config or validated(Config, _without(tree, wrong), ""), problems


def _without(tree: Mapping[str, Any], sections: Set[str]) -> dict[str, Any]:
    return {name: section for name, section in tree.items() if name not in sections}


def load_mission(config: Config, path: Path, obstacles: Mapping[int, Obstacle] | None = None) -> MissionParams:
    """Read a file that holds `[mission]` alone, and check it for a swarm that flies already.

    Args:
        config: of the swarm.
        path: of the file.
        obstacles: those that are there now, by number; None: those of the configuration.

    Raises:
        ConfigError: it can't be flown; lists all problems.
    """
    source, tree = str(path), read_tree(path)
    if set(tree) != {"mission"}:
        others = ", ".join(sorted(set(tree) - {"mission"})) or "nothing"
        raise ConfigError(source, [f"holds {others}; a mission for a running launch is a file of [mission] alone"])
    if problems := read_tables(tree, path.parent) + read_show(tree, path.parent):
        raise ConfigError(source, problems)
    whole = config.model_dump(exclude_none=True) | tree
    changed = validated(Config, whole, source, _RENAMED)
    if changed.mission.is_own:
        own = "is somebody else's code, which is flown only by a launch that was started with it"
        raise ConfigError(source, [f"mission.kind = {changed.mission.kind!r}: {own}"])
    mission = changed.mission
    problems = [*mission.kind_problems(), *mission.problems(config.swarm.agents), *infeasible_references(changed)]
    there = dict(enumerate(changed.obstacles)) if obstacles is None else obstacles
    problems = problems or list(obstacle_problems(there, (), changed.goals_ned_m(), from_ground=False))
    if problems:
        raise ConfigError(source, problems)
    return mission


def load_recorded(folder: Path) -> Config:
    """Read the resolved configuration in a run folder, which may be somebody else's.

    Nothing that it names is read or imported, and whether it can be flown is not judged: it was.

    Raises:
        ConfigError: it is no run folder, a key is unknown, or a value has not its type or range.
    """
    from swarmctl.telemetry.recording.file_names import CONFIG  # no agent needs these
    from swarmctl.telemetry.recording.run_files import read_text, refuse_no_folder

    refuse_no_folder(folder)
    path = folder / CONFIG
    if not read_text(path):
        raise ConfigError(str(folder), [f"is no run folder: it holds no {CONFIG}"])
    return validated(Config, read_tree(path), str(path), _RENAMED)


def own_identity(config: Config, name: str) -> OwnIdentity:
    """Return the identity of one of the configuration's hosts, or the station's."""
    roster = roster_of(config.hosts, relay=config.bus.relay)
    return OwnIdentity(folder=config.bus.identities, name=name, roster=roster)


def dump(config: Config) -> str:
    """Return the resolved configuration as TOML, which `load` reads back to the same tree; vectors are on one line."""
    written = tomli_w.dumps(config.model_dump(exclude_none=True))
    return _NUMBERS.sub(lambda found: f"[{' '.join(found[1].split()).removesuffix(',')}]", written)
