"""Builders of the nouns that many tests need: a test states what it is about, and the rest is an ordinary case.

A new field of a noun has its ordinary value here, so that no other test changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.situation import DesiredReference, Situation
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.problem import Start
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, Proposal, TrajectoryMessage
from swarmctl.core.types import Array, FlightMode, Landed, Mode, Phase, PredictedPath, VehicleState

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)
HOVERING = np.array([0.0, 0.0, 9.81])  # u_x, u_y, thrust over mass
NOBODY: Mapping[int, int] = {}


def controller_setup(
    *,
    vehicle: VehicleModelParams | None = None,
    separation: SeparationParams | None = None,
    agent: int = 0,
    max_keep_outs: int = 2,
    stopwatch_ns: Callable[[], int] = lambda: 0,
    volume: FlightVolume | None = None,
) -> ControllerSetup:
    """Return what a controller of the first agent is told: the defaults, and a stopwatch that stands still."""
    return ControllerSetup(
        vehicle=vehicle or VehicleModelParams(),
        separation=separation or SeparationParams(),
        agent=agent,
        max_keep_outs=max_keep_outs,
        stopwatch_ns=stopwatch_ns,
        volume=volume,
    )


def vehicle_state(
    *,
    t_us: int = 0,
    pos_ned_m: Array = STILL,
    vel_ned_m_s: Array = STILL,
    q_nb: Array = LEVEL,
    rate_frd_rad_s: Array = STILL,
    armed: bool = True,
    mode: FlightMode = FlightMode.EXTERNAL,
    landed: Landed = Landed.IN_AIR,
    failsafe: bool = False,
) -> VehicleState:
    """Return the state of a vehicle: at rest at the origin, level, flying by setpoints."""
    return VehicleState(
        t_us=t_us,
        pos_ned_m=pos_ned_m,
        vel_ned_m_s=vel_ned_m_s,
        q_nb=q_nb,
        rate_frd_rad_s=rate_frd_rad_s,
        armed=armed,
        mode=mode,
        landed=landed,
        failsafe=failsafe,
    )


def status_message(
    *,
    agent: int = 0,
    phase: int = Phase.TRACK,
    position_error_m: float = 0.1,
    separation_m: float = 1.0,
    deadline_misses: int = 0,
    active_alert: str = "",
    alert_age_s: float = -1.0,
    held: bool = False,
    control: str = "TRACKING",
    altitude_m: float = 5.0,
    utc_us: int = 0,
) -> StatusMessage:
    """Return the status of an agent that tracks its mission, or is in another phase; one that is done has landed."""
    is_done = phase == Phase.DONE
    return StatusMessage(
        agent=agent,
        boot_id=1,
        sysid=agent + 1,
        phase=phase,
        mode=Mode.TRACKING,
        flight_mode=FlightMode.LAND if is_done else FlightMode.EXTERNAL,
        armed=not is_done,
        landed=Landed.ON_GROUND if is_done else Landed.IN_AIR,
        held=held,
        control=control,
        altitude_m=altitude_m,
        ground_speed_m_s=1.5,
        battery_01=0.75,
        pos_accuracy_m=0.25,
        gps_fix=3,
        satellites=10,
        link_age_ms=8.5,
        ready_utc_us=0,
        mission_t_s=12.3,
        ends_in_s=25.4,
        outcome="",
        position_error_m=position_error_m,
        separation_m=separation_m,
        tick_p99_ms=2.0,
        ticks=100,
        deadline_misses=deadline_misses,
        plan_staleness_ms=20.0,
        solver_failed=0,
        active_alert=active_alert,
        alert_age_s=alert_age_s,
        uses_commitments=False,
        utc_us=utc_us,
    )


def predicted_path(
    *,
    pos_ned_m: Array,
    agent: int = 1,
    boot_id: int = 1,
    seq: int = 1,
    t0_utc_us: int = 0,
    dt_us: int = 100_000,
    margin_m: float = 0.0,
) -> PredictedPath:
    """Return the path of peer 1 through points (N+1, 3), 0.1 s apart, with no margin of its own."""
    return PredictedPath(
        agent=agent,
        boot_id=boot_id,
        seq=seq,
        t0_utc_us=t0_utc_us,
        dt_us=dt_us,
        margin_m=margin_m,
        pos_ned_m=pos_ned_m,
    )


def keep_out(
    *,
    pos_ned_m: Array,
    radius_m: float = 0.9,
    hard_min_distance_m: float = 0.8,
    any_height: bool = False,
    priority_id: int = 1,
    downwash: float = 1.0,
) -> KeepOut:
    """Return a keep-out at points (Hp+1, 3): peer 1, by the distances of the default configuration."""
    return KeepOut(
        pos_ned_m=pos_ned_m,
        radius_m=radius_m,
        hard_min_distance_m=hard_min_distance_m,
        any_height=any_height,
        priority_id=priority_id,
        downwash=downwash,
    )


def start(
    *,
    pos_ned_m: Array,
    t_us: int = 0,
    vel_ned_m_s: Array = STILL,
    cos_tilt: float = 1.0,
    virtual_control: Array = HOVERING,
) -> Start:
    """Return the initial state of a plan: at rest, level, hovering."""
    return Start(
        t_us=t_us,
        pos_ned_m=pos_ned_m,
        vel_ned_m_s=vel_ned_m_s,
        cos_tilt=cos_tilt,
        virtual_control=virtual_control,
    )


def situation(
    *,
    desired: DesiredReference,
    utc_us: int = 0,
    begin_us: int = 0,
    peers: Mapping[int, TrajectoryMessage] | None = None,
    others: Sequence[KeepOut] = (),
    disturbance_ned_m_s2: Array = STILL,
) -> Situation:
    """Return the inputs of a plan in calm air, among nobody."""
    return Situation(
        utc_us=utc_us,
        begin_us=begin_us,
        desired=desired,
        peers=peers or {},
        others=others,
        disturbance_ned_m_s2=disturbance_ned_m_s2,
    )


def trajectory_message(
    *,
    committed: Trajectory,
    agent: int = 1,
    boot_id: int = 1,
    seq: int = 1,
    sent_utc_us: int = 0,
    is_committed: bool = True,
    tube_m: float = 0.0,
    proposal: Proposal | None = None,
    acknowledged: Mapping[int, int] = NOBODY,
    exclusions: Exclusions | None = None,
    heard: Mapping[int, tuple[int, int]] | None = None,
) -> TrajectoryMessage:
    """Return the message of peer 1, which proposes nothing and has acknowledged nobody."""
    return TrajectoryMessage(
        agent=agent,
        boot_id=boot_id,
        seq=seq,
        sent_utc_us=sent_utc_us,
        is_committed=is_committed,
        committed=committed,
        tube_m=tube_m,
        proposal=proposal,
        acknowledged=acknowledged,
        exclusions=exclusions or Exclusions(),
        heard=heard or {},
    )
