"""Configuration of a whole run: one frozen tree.

Parameter classes live beside the code that uses them; this module composes them. `swarmctl.config` reads such a tree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from swarmctl.agent.setup import AgentParams
from swarmctl.bus.network.hosts import HostParams
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
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.controllers.discovery import ControllerParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.kind import Place
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.ordered_sums import dot
from swarmctl.core.params import FARTHEST_M, Params
from swarmctl.mavlink.geofence import GeofenceParams
from swarmctl.simulator_config import EVERY_VEHICLE, OriginParams, SimulatorConfig, SimulatorParams
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules, RunMode


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

    def model_key(self, agent: int) -> str:
        """Return the key of the section that `model_of` reads."""
        return f"vehicles.{agent}.model" if self.vehicles and self.vehicles[agent].model else "vehicle_model"

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
