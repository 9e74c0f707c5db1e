"""The constraints between the sections of a configuration, each with the sections that it reads.

They are checked as far as those sections are right by themselves, so that a configuration is refused with all of its
problems at once, and none that only follows from another one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Set
from typing import NamedTuple

import numpy as np

from swarmctl.bus.messages.json_messages import MAX_OBSTACLES
from swarmctl.bus.network.hosts import host_problems
from swarmctl.configuration.constraints import (
    braking_problems,
    forward_problems,
    horizon_problems,
    obstacle_problems,
    own_controller_problems,
    path_sharing_problems,
    planned_braking_problems,
    separation_problems,
    shared_process_problems,
    simulated_host_problems,
    simulated_speed_problems,
    speed_problems,
    start_problems,
    starts_apart,
    tick_problems,
    vehicle_problems,
    volume_problems,
)
from swarmctl.configuration.tree import Config
from swarmctl.control.reference.feasibility import FlightLimits, infeasible
from swarmctl.core.discovery.own import OwnError
from swarmctl.errors import ConfigError
from swarmctl.mavlink.parameter_names import parameter_problems
from swarmctl.own_modules import own_problems
from swarmctl.signing_keys import key_problems

_SECTION = re.compile(r"(?:--set )?(\w+)")  # at the beginning of a problem
_STARTS = frozenset({"start", "swarm"})
_GOALS = _STARTS | {"mission", "separation"}
_DRIFT = frozenset({"separation", "controller", "vehicle_model", "vehicles"})


class Constraint(NamedTuple):
    """What has to hold between keys.

    Attributes:
        reads: the sections that it reads.
        problems: yields how a configuration breaks it.
    """

    reads: Set[str]
    problems: Callable[[Config], Iterable[str]]


def sections_of(problems: Iterable[str]) -> set[str]:
    """Return the first words of problems: the sections that they are about, where they are about one."""
    return {found[1] if (found := _SECTION.match(problem)) else "" for problem in problems}


def constraint_problems(config: Config, wrong: Collection[str], only_agents: Collection[int] | None) -> Iterator[str]:
    """Yield how a configuration breaks constraints between its sections, and what is wrong with files it names.

    Args:
        config: the configuration.
        wrong: its sections that are wrong by themselves, and stand at their defaults here.
        only_agents: the agents that are to run on this computer, which has their vehicles' signing keys; None: all.
    """
    unknown = set(wrong)
    if unknown & {"mission", "controller", "vehicle_model", "separation"}:  # own code can't be tried
        unknown |= {name for name in ("mission", "controller") if getattr(config, name).is_own}
    else:
        code = list(own_problems(config.mission, config.controller, config.vehicle_model, config.separation))
        unknown |= {"mission", "controller"} if code else set()
        yield from code
    for constraint in CONSTRAINTS:
        if not constraint.reads & unknown:
            yield from constraint.problems(config)
    if not {"mavlink", "swarm"} & unknown:
        yield from key_problems(config.mavlink.signing_keys, config.swarm.agents, only_agents)


def _starts_known(config: Config) -> Sequence[tuple[float, float, float]]:
    """Return the start positions, none where `start_problems` says what is wrong with them."""
    return () if any(start_problems(config.start, config.swarm.agents)) else config.starts_ned_m()


def _obstacle_problems(config: Config) -> Iterator[str]:
    starts_ned_m = _starts_known(config)
    if not starts_ned_m:
        return
    numbered, from_ground = dict(enumerate(config.obstacles)), not config.sitl.enabled or config.sitl.start == "ground"
    yield from obstacle_problems(numbered, starts_ned_m, config.goals_ned_m(), from_ground=from_ground)


def _volume_problems(config: Config) -> Iterator[str]:
    starts_ned_m = _starts_known(config)
    if not starts_ned_m:
        return
    yield from volume_problems(
        config.volume, config.geofence, config.controller, config.separation, starts_ned_m, config.drift_m
    )


def _separation_problems(config: Config) -> Iterator[str]:
    agents = config.swarm.agents
    drift_m = config.drift_m if agents > 1 else 0.0
    yield from separation_problems(config.separation, config.vehicle_model, config.limits, agents, drift_m)


def _too_many_obstacles(config: Config) -> Iterator[str]:
    if len(config.obstacles) > MAX_OBSTACLES:
        yield f"obstacles: {len(config.obstacles)} are listed, agents keep {MAX_OBSTACLES} at most"


def _simulator_problems(config: Config) -> Iterator[str]:
    if not _starts_known(config):
        return
    try:
        config.simulator()
    except ConfigError as error:
        yield from (f"sitl.{problem}" for problem in error.problems)


def infeasible_references(config: Config) -> Iterator[str]:
    """Yield why references can't be flown, as far as other problems let them be known."""
    if not config.has_references or 0 < len(config.vehicles) < config.swarm.agents:
        return
    separation = config.separation
    close = any(starts_apart(config.starts_ned_m(), separation, config.sitl))
    limits = FlightLimits(
        duration_s=config.mission.duration_s,
        apart_m=0.0 if close else separation.radius_m,  # what follows from starts is not said again
        downwash=separation.downwash,
        ground_z_m=config.ground_z_m,
        volume=None if any(config.volume.problems()) else config.volume.flight_volume(),
        fence=config.geofence.area(),
    )
    try:
        references = config.mission.references(np.array(config.starts_ned_m()), separation.budget.planned_m)
    except OwnError as error:
        yield f"mission.kind = {config.mission.kind!r}: {error}"
        return
    yield from infeasible(references, [config.model_of(i) for i in range(len(references))], limits)


CONSTRAINTS = (
    Constraint(_STARTS, lambda c: start_problems(c.start, c.swarm.agents)),
    Constraint(_STARTS | {"separation", "sitl"}, lambda c: starts_apart(_starts_known(c), c.separation, c.sitl)),
    Constraint(_GOALS | {"obstacles", "sitl"}, _obstacle_problems),
    Constraint(_STARTS | {"geofence"}, lambda c: c.geofence.problems(_starts_known(c))),
    Constraint(_STARTS | _DRIFT | {"volume", "geofence"}, _volume_problems),
    Constraint(_STARTS | {"seed", "mavlink", "sitl"}, _simulator_problems),
    Constraint(
        {"vehicles", "swarm", "sitl", "hosts"},
        lambda c: vehicle_problems(c.vehicles, c.swarm.agents, simulated=c.sitl.enabled, hosts=c.hosts),
    ),
    Constraint({"swarm", "sitl"}, lambda c: shared_process_problems(c.swarm, c.sitl)),
    Constraint({"hosts", "swarm"}, lambda c: host_problems(c.hosts, c.swarm.agents)),
    Constraint({"hosts", "sitl"}, lambda c: simulated_host_problems(c.hosts if c.sitl.enabled else ())),
    Constraint({"mavlink"}, lambda c: forward_problems(c.mavlink.forward)),
    Constraint({"obstacles"}, _too_many_obstacles),
    Constraint({"agent"}, lambda c: parameter_problems(c.agent.autopilot_params)),
    Constraint({"agent"}, lambda c: c.agent.failsafe.problems()),
    Constraint(
        {"vehicle_model", "vehicles", "agent"},
        lambda c: speed_problems(c.vehicle_models, c.agent.state_machine, c.agent.deadlock),
    ),
    Constraint(
        {"vehicle_model", "vehicles", "agent", "separation"},
        lambda c: braking_problems(c.vehicle_models, c.agent, c.separation),
    ),
    Constraint(
        {"vehicle_model", "vehicles", "agent", "separation", "controller", "volume"},
        lambda c: planned_braking_problems(c.vehicle_models, c.agent, c.separation, c.controller, c.volume),
    ),
    Constraint({"sitl"}, lambda c: simulated_speed_problems(c.sitl)),
    Constraint({"mission"}, lambda c: c.mission.kind_problems()),
    Constraint({"mission", "swarm"}, lambda c: c.mission.problems(c.swarm.agents)),
    Constraint(
        {"controller", "separation", "agent"},
        lambda c: own_controller_problems(c.controller, c.separation, c.agent.barrier),
    ),
    Constraint({"controller", "agent"}, lambda c: tick_problems(c.controller, c.agent.rate_hz)),
    Constraint(
        {"controller", "agent", "separation"}, lambda c: horizon_problems(c.controller, c.agent.commit, c.separation)
    ),
    Constraint({"agent", "separation"}, lambda c: path_sharing_problems(c.agent.path_sharing, c.separation)),
    Constraint(_DRIFT | {"swarm", "limits"}, _separation_problems),
    Constraint(_GOALS | {"vehicles", "vehicle_model", "sitl", "volume", "geofence"}, infeasible_references),
)
