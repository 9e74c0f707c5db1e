"""Parameters of one agent, its place in the swarm and the model of its vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import Field

from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.control.collision.barrier import BarrierParams
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.controllers.discovery import ControllerParams
from swarmctl.control.estimation.disturbance import DisturbanceParams
from swarmctl.control.estimation.state_filter import StateFilterParams
from swarmctl.control.failsafe.decision import FailsafeParams
from swarmctl.control.failsafe.overload import OverloadParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.reference.deadlock_params import DeadlockParams
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.params import Params
from swarmctl.core.types import Array
from swarmctl.mavlink.geofence import Geofence


class AgentParams(Params):
    """Parameters of an agent that belong neither to the controller nor to the vehicle model."""

    rate_hz: float = Field(50.0, ge=10, le=200)  # rate of ticks, and so of setpoints
    realtime: bool = True  # launch schedules what flies before other programs, if it may
    pinned: bool = False  # launch binds each process of agents to one processor, in turns from the last one on
    connect_timeout_s: float = Field(15.0, gt=0, le=600)  # longest wait for the first heartbeat and position
    path_sharing: PathSharingParams = PathSharingParams()
    state_machine: StateMachineParams = StateMachineParams()
    failsafe: FailsafeParams = FailsafeParams()
    overload: OverloadParams = OverloadParams()
    disturbance: DisturbanceParams = DisturbanceParams()
    state_filter: StateFilterParams = StateFilterParams()
    barrier: BarrierParams = BarrierParams()
    commit: CommitParams = CommitParams()
    deadlock: DeadlockParams = DeadlockParams()
    autopilot_params: dict[str, int | float] = Field(  # PX4: land 0.5 s after setpoints stop, before it has drifted far
        {"COM_OBL_RC_ACT": 4, "COM_OF_LOSS_T": 0.5}
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentSetup:
    """Everything one agent needs before it starts."""

    agent: int
    boot_id: int
    sysid: int
    vouchers: Mapping[str, frozenset[int]]  # agents of which each sender may say that they have ended
    code: str  # that it flies, as those of its peers have to; "" where all are on one computer
    quorum: int  # agents on the bus, this one included, by which a silent one that is not on it counts as dead
    params: AgentParams
    mission: MissionParams
    starts_ned_m: Array  # (agents, 3)
    controller: ControllerParams
    separation: SeparationParams
    vehicle_model: VehicleModelParams
    max_obstacles: int
    volume: FlightVolume | None  # to stay in
    fence: Geofence | None  # in which autopilots keep their vehicles; None: no fence
    drift_m: float  # by a gust of `separation.gust_m_s`
    has_ground: bool  # to land on: a simulator that begins in the air has none
    originals: Mapping[str, int | float]  # of parameters that an ended agent has changed, whose vehicle this one lands

    @property
    def peers(self) -> list[int]:
        """Indices of the other agents."""
        return [i for i in range(len(self.starts_ned_m)) if i != self.agent]

    @property
    def max_keep_outs(self) -> int:
        """Largest number of neighbours and obstacles that get constraint rows in one MPC problem."""
        return min(len(self.peers), self.separation.max_neighbours) + self.max_obstacles
