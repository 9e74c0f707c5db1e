"""Configuration of a whole run: one frozen tree, read from TOML. An invalid one is refused with all its problems.

Parameter classes live beside the code that uses them. This module composes them, checks constraints between sections,
and writes the resolved copy. It opens no sockets and starts nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import Field

from swarmctl.agent.setup import AgentParams
from swarmctl.bus.json_messages import MAX_OBSTACLES
from swarmctl.bus.network.hosts import HostParams, host_problems, roster_of
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.config_problems import validated
from swarmctl.config_shows import read_show
from swarmctl.config_source import override, read_tree, set_value
from swarmctl.config_tables import read_tables
from swarmctl.control.collision.separation import SeparationParams, radius_problem
from swarmctl.control.controllers.discovery import ControllerParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.feasibility import FlightLimits, infeasible
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.own import OwnError
from swarmctl.core.params import Params, Vec3
from swarmctl.errors import ConfigError
from swarmctl.mavlink.geofence import GeofenceParams, is_inside
from swarmctl.mavlink.parameter_names import parameter_problems
from swarmctl.mavlink.transport import Endpoint, parse_url
from swarmctl.own_modules import locate, make_importable, own_problems
from swarmctl.signing_keys import key_problems, locate_identities, locate_keys
from swarmctl.simulator_config import EVERY_VEHICLE, MAX_VEHICLES, OriginParams, SimulatorConfig, SimulatorParams
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules

MAX_AGENTS = MAX_VEHICLES
NO_VALUES: Mapping[str, Any] = MappingProxyType({})
_PAIRS_SHOWN = 3
_RENAMED = {  # keys of versions before 0.2
    "agent.commit.bias_rad": "agent.commit.right_of_way_rad",
    "agent.commit.share_01": "agent.commit.tilt_fraction_01",
    "agent.detour": "agent.deadlock",
    "agent.sequence": "agent.state_machine",
    "limits.late_ticks_01": "limits.deadline_misses_01",
    "mission.goto.standoff": "mission.goto.goal_assignment",
    "separation.bias_obstacle_rad": "separation.right_of_way_obstacle_rad",
    "separation.bias_rad": "separation.right_of_way_rad",
}


class SwarmParams(OriginParams):
    """Size of the swarm and origin of its frame."""

    agents: int = Field(3, ge=1, le=MAX_AGENTS)  # overridden by --agents


class StartParams(Params):
    """Positions at which agents wait for the mission to begin: a line, or `positions_ned_m` if given."""

    positions_ned_m: tuple[Vec3, ...] = Field((), strict=False)  # one for each agent
    center_ned_m: Vec3 = (0.0, 0.0, 0.0)  # centre of the line
    direction_ned: Vec3 = (1.0, 0.0, 0.0)  # direction of the line, of any length
    spacing_m: float = Field(1.0, gt=0, le=100)  # distance of neighbours on the line


class VehicleParams(Params):
    """Address of one autopilot and, optionally, a model of its vehicle."""

    sysid: int = Field(ge=1, le=255)  # MAVLink system id, different for each vehicle
    url: str  # udpin://, udpout://, tcp:// or serial://
    model: VehicleModelParams | None = None  # replaces the whole section vehicle_model for this vehicle


class MavlinkParams(Params):
    """Parameters of the MAVLink links to the vehicles."""

    signing_keys: tuple[str, ...] = Field((), strict=False)  # key file of each vehicle in turn; none: nothing is signed
    forward: Annotated[tuple[str, ...], Field(strict=False, max_length=4)] = ()  # udpout:// of ground stations
    forward_commands: bool = False  # whether these may command the vehicles; otherwise they may read only


class SitlParams(SimulatorParams):
    """The built-in simulator that launch starts; disabled to fly other vehicles."""

    enabled: bool = True
    ground_z_m: float = Field(2.0, ge=-1000, le=1000)  # height of the ground below the shared origin, NED z
    link_latency_ms: float = Field(0.0, ge=0, le=1000)  # lockstep only


class BusParams(Params):
    """Parameters of the Zenoh bus, and the seeded faults of the lockstep bus."""

    identities: str = ""  # folder written by swarmctl keys init; needed by swarmctl host and station only
    relay: bool = False  # hosts pass on what others say; else each is heard on its own links alone
    lease_ms: int = Field(1500, ge=500, le=10000)  # silence after which Zenoh closes a link
    delay_ms: float = Field(0.0, ge=0, le=5000)  # lockstep only, on top of one tick
    loss_01: float = Field(0.0, ge=0, le=1)  # lockstep only
    burst_01: float = Field(0.0, ge=0, le=0.99)  # lockstep only, fraction of time in which a link loses everything
    burst_s: float = Field(2.0, ge=0.01, le=600)  # lockstep only, mean length of such a bad period
    jitter_ms: float = Field(0.0, ge=0, le=5000)  # lockstep only, largest extra delay; messages overtake each other


class TelemetryParams(Params):
    """Parameters of the viewer, the one process that uses rerun."""

    enabled: bool = True
    port: int = Field(9877, ge=1, le=65535)  # loopback, not the default of rerun; the next free one if taken
    rate_hz: float = Field(10.0, gt=0, le=50)  # updates of the view per agent


class LimitParams(Params):
    """Limits beyond which the referee counts a violation."""

    min_separation_m: float = Field(0.85, ge=0, le=100)  # distance of two centres, of true states where there are any
    obstacle_margin_m: float = Field(0.05, ge=0, le=10)  # allowed intrusion into keep_out_m
    deadline_misses_01: float = Field(0.2, ge=0, le=1)  # largest fraction of deadlines missed


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
    def drift_m(self) -> float:
        """Return how far a gust of `separation.gust_m_s` blows the vehicle that it blows farthest."""
        accel_m_s2 = self.controller.mpc.accel_max_m_s2
        models = [self.vehicle_model, *(vehicle.model for vehicle in self.vehicles if vehicle.model is not None)]
        return max(model.drift_m(self.separation.gust_m_s, accel_m_s2) for model in models)

    def starts_ned_m(self) -> tuple[tuple[float, float, float], ...]:
        """Return the start position of every agent, shared NED [m]."""
        if self.start.positions_ned_m:
            return self.start.positions_ned_m[: self.swarm.agents]
        norm = math.sqrt(sum(c * c for c in self.start.direction_ned))
        unit = tuple(c / norm for c in self.start.direction_ned)
        offsets = [(i - (self.swarm.agents - 1) / 2) * self.start.spacing_m for i in range(self.swarm.agents)]
        x, y, z = self.start.center_ned_m
        return tuple((x + o * unit[0], y + o * unit[1], z + o * unit[2]) for o in offsets)

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

    def rules(self, mode: Literal["realtime", "lockstep"] = "realtime") -> Rules:
        """Return the rules by which the referee judges this run."""
        return Rules(
            agents=self.swarm.agents,
            required_separation_m=self.limits.min_separation_m,
            obstacles=tuple(JudgedObstacle(number=i, obstacle=o) for i, o in enumerate(self.obstacles)),
            obstacle_margin_m=self.limits.obstacle_margin_m,
            deadline_misses_01=self.limits.deadline_misses_01,
            mode=mode,
            duration_s=self.mission.duration_s,
            downwash=self.separation.downwash,
            volume=self.volume.flight_volume(),
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
    tree = read_tree(path)
    problems = [p for item in overrides for p in override(tree, item)]
    problems += [p for key, value in values.items() for p in set_value(tree, key, value)]
    folder = Path.cwd() if path is None else path.parent
    problems = problems or read_tables(tree, folder) + read_show(tree, folder)
    if problems:
        raise ConfigError(source, problems)
    locate(tree, folder)
    locate_keys(tree, folder)
    locate_identities(tree, folder)
    config = validated(Config, tree, source, _RENAMED)
    make_importable(config.own_folder)
    problems = list(own_problems(config.mission, config.controller, config.vehicle_model, config.separation))
    problems = problems or list(_whole(config, only_agents)) or list(_infeasible(config))
    if problems:
        raise ConfigError(source, problems)
    return config


def load_mission(config: Config, path: Path) -> MissionParams:
    """Read a file that holds `[mission]` alone, and check it for a swarm that flies already.

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
    if problems := list(changed.mission.problems(config.swarm.agents)) or list(_infeasible(changed)):
        raise ConfigError(source, problems)
    return changed.mission


def load_recorded(folder: Path) -> Config:
    """Read the resolved configuration in a run folder, which may be somebody else's.

    Nothing that it names is read or imported, and whether it can be flown is not judged: it was.

    Raises:
        ConfigError: it is no run folder, a key is unknown, or a value has not its type or range.
    """
    from swarmctl.telemetry.recording.run_files import CONFIG, read_text, refuse_no_folder  # no agent needs it

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
    """Return the resolved configuration as TOML, which `load` reads back to the same tree."""
    return tomli_w.dumps(config.model_dump(exclude_none=True))


def _whole(config: Config, only_agents: Collection[int] | None) -> Iterator[str]:
    """Yield problems between keys and sections, and of files."""
    agents = config.swarm.agents
    listed = len(config.start.positions_ned_m)
    if listed and listed < agents:
        yield f"start.positions_ned_m: {listed} positions for swarm.agents = {agents}; list one for each agent"
    if not listed and not any(config.start.direction_ned):
        yield "start.direction_ned = (0, 0, 0): give the line of start positions a direction"
    elif not (listed and listed < agents):
        yield from _starts_apart(config)
        yield from config.geofence.problems(config.starts_ned_m())
        yield from _volume_problems(config)
        try:
            config.simulator()
        except ConfigError as error:
            yield from (f"sitl.{problem}" for problem in error.problems)
    yield from _vehicle_problems(config)
    yield from host_problems(config.hosts, agents)
    yield from _simulated_host_problems(config)
    yield from _forward_problems(config)
    yield from key_problems(config.mavlink.signing_keys, agents, only_agents)
    if len(config.obstacles) > MAX_OBSTACLES:
        yield f"obstacles: {len(config.obstacles)} are listed, agents keep {MAX_OBSTACLES} at most"
    yield from parameter_problems(config.agent.autopilot_params)
    yield from config.agent.failsafe.problems()
    if config.sitl.speed != 1.0:
        yield (
            f"sitl.speed = {config.sitl.speed}: agents fly on wall time and can't follow; leave it at 1. Faster than "
            "real time: swarmctl simulate, or python -m sitl --speed with clients of your own"
        )
    yield from config.mission.problems(agents)
    if config.controller.is_own and not config.agent.barrier.enabled:
        yield "agent.barrier.enabled = false: an own controller flies behind the safety filter only; set it to true"
    if config.controller.is_own and config.separation.mode == "guaranteed":
        yield (
            f"controller.kind = {config.controller.kind!r} with separation.mode = 'guaranteed': commitments are tracked"
            " by built-in controllers; set separation.mode = 'best_effort'"
        )
    if agents > 1 and (problem := radius_problem(config.separation, 0.0, config.drift_m)):
        yield problem
    if config.separation.gust_m_s and not config.vehicle_model.drag_1_s:
        yield (
            f"separation.gust_m_s = {config.separation.gust_m_s:g}: what a gust does to a vehicle follows from its "
            "drag; set vehicle_model.drag_1_s (swarmctl check --identify measures it)"
        )
    if config.separation.radius_m < config.limits.min_separation_m:
        yield (
            f"limits.min_separation_m = {config.limits.min_separation_m}: larger than separation.radius_m = "
            f"{config.separation.radius_m}; agents would be judged by more than they keep. Lower it or raise the radius"
        )


def _volume_problems(config: Config) -> Iterator[str]:
    """Yield what does not go with the flight volume."""
    corners, fence = config.volume.corners_ne_m, config.geofence.corners_ne_m
    yield from config.volume.problems(config.starts_ned_m(), config.separation.tracking_m + config.drift_m)
    if corners and not (config.controller.keeps_volume or config.separation.mode == "guaranteed"):
        yield (
            f"controller.kind = {config.controller.kind!r} with a volume: it does not plan, and would fly out of it; "
            "use dmpc, dmpc3 or mpc"
        )
    beyond = [list(corner) for corner in corners if fence and not is_inside(corner, fence)]
    if beyond:
        yield f"volume.corners_ne_m: {beyond} are outside of geofence.corners_ne_m; move the corners or the fence"


def _infeasible(config: Config) -> Iterator[str]:
    """Yield why the references of a configuration without other problems can't be flown."""
    separation = config.separation
    limits = FlightLimits(
        duration_s=config.mission.duration_s,
        apart_m=separation.radius_m,
        downwash=separation.downwash,
        ground_z_m=config.sitl.ground_z_m if config.sitl.enabled else None,
        volume=config.volume.flight_volume(),
    )
    try:
        references = config.mission.references(np.array(config.starts_ned_m()), separation.budget.planned_m)
    except OwnError as error:
        yield f"mission.kind = {config.mission.kind!r}: {error}"
        return
    yield from infeasible(references, [config.model_of(i) for i in range(len(references))], limits)


def _starts_apart(config: Config) -> Iterator[str]:
    starts = config.starts_ned_m()
    pairs = ((math.dist(a, b), i, j) for (i, a), (j, b) in itertools.combinations(enumerate(starts), 2))
    close = sorted(pair for pair in pairs if pair[0] < config.separation.radius_m)
    for distance_m, i, j in close[:_PAIRS_SHOWN]:
        yield (
            f"start: agents {i} and {j} would wait {distance_m:.2f} m apart; separation.radius_m is "
            f"{config.separation.radius_m}. Raise start.spacing_m or move them"
        )
    if len(close) > _PAIRS_SHOWN:
        yield f"start: {len(close) - _PAIRS_SHOWN} more pairs of agents would wait too close together"
    if config.sitl.enabled and config.sitl.start == "ground":
        for i, start in enumerate(starts):
            if start[2] > config.sitl.ground_z_m - 0.5:
                yield (
                    f"start: agent {i} waits at z = {start[2]} m, less than 0.5 m above the ground at "
                    f"sitl.ground_z_m = {config.sitl.ground_z_m} (NED, down is positive)"
                )


def _vehicle_problems(config: Config) -> Iterator[str]:
    agents = config.swarm.agents
    if not config.vehicles:
        if not config.sitl.enabled:
            yield "vehicles: empty while sitl.enabled = false; list one [[vehicles]] with sysid and url for each agent"
        return
    if config.sitl.enabled:
        yield (
            "vehicles: listed while sitl.enabled = true; set sitl.enabled = false to fly them, "
            "or remove them to fly the built-in simulator"
        )
    if len(config.vehicles) < agents:
        yield f"vehicles: {len(config.vehicles)} listed for swarm.agents = {agents}; list one for each agent"
    seen_sysids: dict[int, int] = {}
    links: list[Endpoint | None] = []
    for i, vehicle in enumerate(config.vehicles):
        try:
            link = parse_url(vehicle.url)
        except ValueError as error:
            yield f"vehicles.{i}.url = {error}"
            link = None
        rivals = [k for k, other in enumerate(links) if link and other and _same_place(link, other)]
        links.append(link)
        if rivals:
            yield (
                f"vehicles.{i}.url = {vehicle.url!r}: same port as vehicles.{rivals[0]}; "
                "every vehicle needs a link of its own"
            )
        if vehicle.sysid in seen_sysids:
            yield (
                f"vehicles.{i}.sysid = {vehicle.sysid}: same as vehicles.{seen_sysids[vehicle.sysid]}; "
                "give every autopilot its own MAV_SYS_ID"
            )
        seen_sysids.setdefault(vehicle.sysid, i)


def _forward_problems(config: Config) -> Iterator[str]:
    for i, url in enumerate(config.mavlink.forward):
        try:
            if parse_url(url).scheme != "udpout":
                raise ValueError(f"{url!r}: only udpout://HOST:PORT is forwarded to")
        except ValueError as error:
            yield f"mavlink.forward.{i} = {error}"


def _simulated_host_problems(config: Config) -> Iterator[str]:
    for i, host in enumerate(config.hosts if config.sitl.enabled else ()):
        if list(host.agents) != list(range(host.agents[0], host.agents[0] + len(host.agents))):
            yield (
                f"hosts.{i}.agents = {list(host.agents)}: a host simulates vehicles that follow one another; "
                "list numbers without gaps"
            )


def _same_place(a: Endpoint, b: Endpoint) -> bool:
    """Return whether two links share a serial device, a local port or a remote address."""
    if a.scheme != b.scheme:
        return False
    if a.scheme == "serial":
        return a.where == b.where
    if a.scheme == "udpin" and "0.0.0.0" in (a.where, b.where):
        return a.number == b.number
    return (a.where, a.number) == (b.where, b.number)
