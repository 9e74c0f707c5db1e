"""Configuration of a whole run: one frozen tree, read from TOML. An invalid one is refused with all its problems.

Parameter classes live beside the code that uses them. This module composes them, has constraints between
sections checked (`configuration.constraints`), and writes the resolved copy. It opens no sockets and starts nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tomli_w
from pydantic import Field

from swarmctl.agent.setup import AgentParams
from swarmctl.bus.messages.json_messages import MAX_OBSTACLES
from swarmctl.bus.network.hosts import HostParams, host_problems, roster_of
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.configuration.constraints import (
    address_problems,
    braking_problems,
    forward_problems,
    obstacle_problems,
    own_controller_problems,
    path_sharing_problems,
    separation_problems,
    simulated_host_problems,
    speed_problems,
    starts_apart,
    tick_problems,
    vehicle_problems,
    volume_problems,
)
from swarmctl.configuration.obstacles import read_obstacles
from swarmctl.configuration.problems import validated
from swarmctl.configuration.sections import (
    BusParams,
    LimitParams,
    MavlinkParams,
    SitlParams,
    StartParams,
    SwarmParams,
    TelemetryParams,
    VehicleParams,
)
from swarmctl.configuration.shows import read_show
from swarmctl.configuration.source import override, read_tree, set_value
from swarmctl.configuration.tables import read_tables
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.controllers.discovery import ControllerParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.feasibility import FlightLimits, infeasible
from swarmctl.control.reference.kind import Place
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.discovery.own import OwnError
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.ordered_sums import dot
from swarmctl.core.params import FARTHEST_M, Params
from swarmctl.errors import ConfigError
from swarmctl.mavlink.geofence import GeofenceParams
from swarmctl.mavlink.parameter_names import parameter_problems
from swarmctl.own_modules import locate, make_importable, own_problems
from swarmctl.signing_keys import key_problems, locate_identities, locate_keys
from swarmctl.simulator_config import EVERY_VEHICLE, OriginParams, SimulatorConfig, SimulatorParams
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules, RunMode

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


class Config(Params):
    """Configuration of a whole run."""

    name: str = Field("swarm", pattern=r"^[A-Za-z0-9_-]{1,40}$")  # part of the run folder's name
    seed: int = Field(1, ge=0, le=2**31 - 1)  # seeds every random stream
    own_folder: str = ""  # of own modules; filled in, by default with the folder of this file
    swarm: SwarmParams = SwarmParams()
    start: StartParams = StartParams()
    mission: MissionParams = MissionParams()
    controller: ControllerParams = ControllerParams()
    separation: SeparationParams = SeparationParams()
    vehicle_model: VehicleModelParams = VehicleModelParams()
    agent: AgentParams = AgentParams()
    vehicles: tuple[VehicleParams, ...] = Field((), strict=False)
    hosts: tuple[HostParams, ...] = Field((), strict=False)
    volume: VolumeParams = VolumeParams()
    mavlink: MavlinkParams = MavlinkParams()
    geofence: GeofenceParams = GeofenceParams()
    sitl: SitlParams = SitlParams()
    bus: BusParams = BusParams()
    telemetry: TelemetryParams = TelemetryParams()
    obstacles: tuple[Obstacle, ...] = Field((), strict=False)
    limits: LimitParams = LimitParams()

    @property
    def vehicle_models(self) -> list[VehicleModelParams]:
        """Return the models of all vehicles: the common one, and those of vehicles that have their own."""
        return [self.vehicle_model, *(vehicle.model for vehicle in self.vehicles if vehicle.model is not None)]

    @property
    def drift_m(self) -> float:
        """Return how far a gust of `separation.gust_m_s` blows the vehicle that it blows farthest."""
        gust_m_s, mpc = self.separation.gust_m_s, self.controller.mpc
        return max(mpc.drift_m(gust_m_s, model) for model in self.vehicle_models)

    def starts_ned_m(self) -> tuple[tuple[float, float, float], ...]:
        """Return the start position of every agent, shared NED [m]."""
        if self.start.positions_ned_m:
            return self.start.positions_ned_m[: self.swarm.agents]
        norm = math.sqrt(dot(self.start.direction_ned, self.start.direction_ned))
        unit = tuple(c / norm for c in self.start.direction_ned)
        offsets = [(i - (self.swarm.agents - 1) / 2) * self.start.spacing_m for i in range(self.swarm.agents)]
        x, y, z = self.start.center_ned_m
        return tuple((x + o * unit[0], y + o * unit[1], z + o * unit[2]) for o in offsets)

    @property
    def has_references(self) -> bool:
        """Tell whether every agent has a start, and the mission's keys go together, so that references are known."""
        listed, line = self.start.positions_ned_m, self.start.direction_ned
        has_starts = len(listed) >= self.swarm.agents if listed else dot(line, line) > 0.0
        near = has_starts and all(abs(c) <= FARTHEST_M for start in self.starts_ned_m() for c in start)
        return near and not any(self.mission.problems(self.swarm.agents))

    def goals_ned_m(self) -> tuple[tuple[float, ...] | None, ...]:
        """Return where the mission takes every agent, shared NED [m]; None where it is flown for its way.

        Nothing of a mission of somebody else's code is known, as it is not run here, nor of one that can't be flown.
        """
        agents = self.swarm.agents
        if self.mission.is_own or not self.has_references:
            return (None,) * agents
        starts_ned_m = np.array(self.starts_ned_m())
        flown, apart_m = self.mission.flown(), self.separation.budget.planned_m
        places = (Place(starts_ned_m=starts_ned_m, agent=agent, apart_m=apart_m) for agent in range(agents))
        return tuple(None if goal is None else tuple(goal.pos_ned_m.tolist()) for goal in map(flown.goal, places))

    def sysids(self) -> tuple[int, ...]:
        """Return the MAVLink system id of every agent's vehicle."""
        if self.vehicles:
            return tuple(v.sysid for v in self.vehicles[: self.swarm.agents])
        return tuple(i + 1 for i in range(self.swarm.agents))

    def model_of(self, agent: int) -> VehicleModelParams:
        """Return the vehicle model of one agent."""
        own = self.vehicles[agent].model if self.vehicles else None
        return own or self.vehicle_model

    def simulator(self, agents: Sequence[int] = ()) -> SimulatorConfig:
        """Return what the simulator of this run is told.

        Args:
            agents: numbers, one after the other, of those whose vehicles are simulated; none given: all.

        Raises:
            ConfigError: it can't be simulated.
        """
        first, count = (agents[0], len(agents)) if agents else (0, self.swarm.agents)
        own = slice(first, first + count)
        spawns_ned_m = self.starts_ned_m()[own]
        if self.sitl.start == "ground":
            spawns_ned_m = tuple((x, y, self.sitl.ground_z_m) for x, y, _ in spawns_ned_m)
        keys = {key: getattr(self.sitl, key) for key in SimulatorParams.model_fields}
        keys |= {key: getattr(self.swarm, key) for key in OriginParams.model_fields}
        keys |= {"vehicles": count, "spawn_ned_m": spawns_ned_m, "seed": self.seed}
        keys |= {"first_vehicle": first, "sysid_base": first + 1}
        signed = self.mavlink.signing_keys[own]
        keys |= {"signing_keys": signed if len(signed) == count else ()}  # too few are refused elsewhere
        if agents:  # of one computer; the others simulate theirs
            here = (EVERY_VEHICLE, *agents)
            keys |= {"faults": tuple(fault for fault in self.sitl.faults if fault.vehicle in here)}
        return validated(SimulatorConfig, keys, "sitl")

    @property
    def ground_z_m(self) -> float | None:
        """Return the down coordinate of the simulator's ground; None for real vehicles, whose ground is unknown."""
        return self.sitl.ground_z_m if self.sitl.enabled else None

    def rules(self, mode: RunMode = "realtime") -> Rules:
        """Return the rules by which the referee judges this run."""
        return Rules(
            agents=self.swarm.agents,
            required_separation_m=self.limits.min_separation_m,
            obstacles=tuple(JudgedObstacle(number=i, obstacle=o) for i, o in enumerate(self.obstacles)),
            obstacle_margin_m=self.limits.obstacle_margin_m,
            deadline_misses_01=self.limits.deadline_misses_01,
            solver_name=self.controller.mpc.qp.solver_name,
            solver_retry=self.controller.mpc.qp.retry_solver,
            mode=mode,
            duration_s=self.mission.duration_s,
            downwash=self.separation.downwash,
            volume=self.volume.flight_volume(),
            ground_z_m=self.ground_z_m,
            goals_ned_m=self.goals_ned_m(),
        )


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
    problems = [p for item in overrides for p in override(tree, item)]
    problems += [p for key, value in values.items() for p in set_value(tree, key, value)]
    problems = problems or read_tables(tree, folder) + read_show(tree, folder) + read_obstacles(tree, folder)
    if problems:
        raise ConfigError(source, problems)
    locate(tree, folder)
    locate_keys(tree, folder)
    locate_identities(tree, folder)
    try:
        config = validated(Config, tree, source, _RENAMED)
    except ConfigError as error:
        raise ConfigError(source, [*error.problems, *address_problems(tree)]) from error
    make_importable(config.own_folder)
    problems = list(own_problems(config.mission, config.controller, config.vehicle_model, config.separation))
    problems = problems or [*_whole(config, only_agents), *_infeasible(config)]
    if problems:
        raise ConfigError(source, problems)
    return config


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
    problems = [*mission.kind_problems(), *mission.problems(config.swarm.agents), *_infeasible(changed)]
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


def _whole(config: Config, only_agents: Collection[int] | None) -> Iterator[str]:
    """Yield problems between keys and sections, and of files."""
    agents, separation = config.swarm.agents, config.separation
    yield from _start_problems(config)
    yield from vehicle_problems(config.vehicles, agents, simulated=config.sitl.enabled, hosts=config.hosts)
    if config.swarm.agents_per_process > 1 and not config.sitl.enabled:
        shared = (
            f"swarm.agents_per_process = {config.swarm.agents_per_process}: allowed: 1 without the built-in simulator"
        )
        yield f"{shared}; one agent's failure must not be that of other real vehicles"
    yield from host_problems(config.hosts, agents)
    yield from simulated_host_problems(config.hosts if config.sitl.enabled else ())
    yield from forward_problems(config.mavlink.forward)
    yield from key_problems(config.mavlink.signing_keys, agents, only_agents)
    if len(config.obstacles) > MAX_OBSTACLES:
        yield f"obstacles: {len(config.obstacles)} are listed, agents keep {MAX_OBSTACLES} at most"
    yield from parameter_problems(config.agent.autopilot_params)
    yield from config.agent.failsafe.problems()
    yield from speed_problems(config.vehicle_models, config.agent.state_machine, config.agent.deadlock)
    yield from braking_problems(config.vehicle_models, config.agent, separation)
    if config.sitl.speed != 1.0:
        yield (
            f"sitl.speed = {config.sitl.speed}: agents fly on wall time and can't follow; leave it at 1. Faster than "
            "real time: swarmctl simulate, or python -m sitl --speed with clients of your own"
        )
    yield from config.mission.kind_problems()
    yield from config.mission.problems(agents)
    yield from own_controller_problems(config.controller, separation, config.agent.barrier)
    yield from tick_problems(config.controller, config.agent.rate_hz)
    yield from path_sharing_problems(config.agent.path_sharing, separation)
    drift_m = config.drift_m if agents > 1 else 0.0
    yield from separation_problems(separation, config.vehicle_model, config.limits, agents, drift_m)


def _start_problems(config: Config) -> Iterator[str]:
    agents, listed = config.swarm.agents, len(config.start.positions_ned_m)
    if listed and listed < agents:
        yield f"start.positions_ned_m: {listed} positions for swarm.agents = {agents}; list one for each agent"
    if not listed and not any(config.start.direction_ned):
        yield "start.direction_ned = (0, 0, 0): give the line of start positions a direction"
    elif not (listed and listed < agents):
        yield from starts_apart(config.starts_ned_m(), config.separation, config.sitl)
        from_ground = not config.sitl.enabled or config.sitl.start == "ground"
        numbered = dict(enumerate(config.obstacles))
        yield from obstacle_problems(numbered, config.starts_ned_m(), config.goals_ned_m(), from_ground=from_ground)
        yield from config.geofence.problems(config.starts_ned_m())
        yield from volume_problems(
            config.volume, config.geofence, config.controller, config.separation, config.starts_ned_m(), config.drift_m
        )
        try:
            config.simulator()
        except ConfigError as error:
            yield from (f"sitl.{problem}" for problem in error.problems)


def _infeasible(config: Config) -> Iterator[str]:
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
