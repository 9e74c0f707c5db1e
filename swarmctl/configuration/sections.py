"""Sections of a configuration that belong to no part of the bridge; `config.py` composes them with the others."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from swarmctl.bus.bus import DEFAULT_LEASE_MS
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.params import Params, Vec3
from swarmctl.simulator_config import MAX_VEHICLES, OriginParams, SimulatorParams

MAX_AGENTS = MAX_VEHICLES


class SwarmParams(OriginParams):
    """Size of the swarm and origin of its frame."""

    agents: int = Field(3, ge=1, le=MAX_AGENTS)  # overridden by --agents
    agents_per_process: int = Field(1, ge=1, le=MAX_AGENTS)  # at most; more than 1 only with the built-in simulator


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

    enabled: bool = True  # false: fly the vehicles listed in [[vehicles]]
    link_latency_ms: float = Field(0.0, ge=0, le=1000)  # lockstep only, of MAVLink frames in each direction


class BusParams(Params):
    """Parameters of the Zenoh bus, and the seeded faults of the lockstep bus."""

    identities: str = ""  # folder written by swarmctl keys init; needed by swarmctl host and station only
    relay: bool = False  # hosts pass on what others say; else each is heard on its own links alone
    lease_ms: int = Field(DEFAULT_LEASE_MS, ge=500, le=10000)  # silence after which a link is closed
    delay_ms: float = Field(0.0, ge=0, le=5000)  # lockstep only, of each message, on top of one tick
    loss_01: float = Field(0.0, ge=0, le=1)  # lockstep only, fraction of messages that are lost
    burst_01: float = Field(0.0, ge=0, le=0.99)  # lockstep only, fraction of time in which a link loses everything
    burst_s: float = Field(2.0, ge=0.01, le=600)  # lockstep only, mean length of such a bad period
    jitter_ms: float = Field(0.0, ge=0, le=5000)  # lockstep only, largest extra delay; messages overtake each other


class TelemetryParams(Params):
    """Parameters of the viewer, the one process that uses rerun."""

    enabled: bool = True  # false: no view, and no telemetry.rrd of a launch
    port: int = Field(9877, ge=1, le=65535)  # loopback, not the default of rerun; the next free one if taken
    rate_hz: float = Field(10.0, gt=0, le=50)  # updates of the view per agent
    history_mb: int = Field(32, ge=1, le=65536)  # for who opens the view late: three agents fill 20 MB a minute


class LimitParams(Params):
    """Limits beyond which the referee counts a violation."""

    min_separation_m: float = Field(0.85, ge=0, le=100)  # distance of two centres, of true states where there are any
    obstacle_margin_m: float = Field(0.05, ge=0, le=10)  # allowed intrusion into keep_out_m, never into radius_m
    deadline_misses_01: float = Field(0.2, ge=0, le=1)  # largest fraction of deadlines missed, also by one agent
