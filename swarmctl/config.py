"""Configuration of a whole run: one frozen tree, read from TOML. An invalid one is refused with all its problems.

Parameter classes live beside the code that uses them. This module composes them, has constraints between
sections checked (`config_constraints`), and writes the resolved copy. It opens no sockets and starts nothing.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import Field

from swarmctl.agent.setup import AgentParams
from swarmctl.bus.network.hosts import HostParams, roster_of
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.config_constraints import constraint_problems, reference_problems
from swarmctl.config_problems import validated
from swarmctl.config_shows import read_show
from swarmctl.config_source import override, read_tree, set_value
from swarmctl.config_tables import read_tables
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.controllers.discovery import ControllerParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params, Vec3
from swarmctl.errors import ConfigError
from swarmctl.mavlink.geofence import GeofenceParams
from swarmctl.own_modules import locate, make_importable, own_problems
from swarmctl.signing_keys import locate_identities, locate_keys
from swarmctl.simulator_config import EVERY_VEHICLE, MAX_VEHICLES, OriginParams, SimulatorConfig, SimulatorParams
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules

MAX_AGENTS = MAX_VEHICLES
NO_VALUES: Mapping[str, Any] = MappingProxyType({})
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
            solver_name=self.controller.mpc.qp.solver,
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
    problems = problems or list(constraint_problems(config, only_agents)) or list(reference_problems(config))
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
    if problems := list(changed.mission.problems(config.swarm.agents)) or list(reference_problems(changed)):
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
