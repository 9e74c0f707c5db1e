"""Builds a tick's record in which every recorded number differs, so that swapped values are noticed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swarmctl.core.recorded.tick_record import TickRecord, TickTiming
from swarmctl.core.types import (
    AttitudeSetpoint,
    ControlMode,
    FlightMode,
    Mode,
    Phase,
    Plan,
    PlanStatus,
    Reference,
)
from tests import builders

STATE = builders.vehicle_state(
    t_us=8_999_999_995_501,
    pos_ned_m=np.array([1.1, -2.2, -3.3]),
    vel_ned_m_s=np.array([0.1, -0.2, 0.3]),
    q_nb=np.array([0.5, -0.5, 0.25, 0.75]),
)
PLAN = Plan(
    status=PlanStatus.NOT_CERTIFIED,
    t0_us=0,
    dt_us=100_000,
    pos_ned_m=np.arange(12.0).reshape(4, 3) - 2.5,
    vel_ned_m_s=np.zeros((4, 3)),
    virtual_control=np.zeros((3, 3)),
    iterations=1_500,
    slack_m=0.03125,
    residual_m=0.015625,
)
TIMING = TickTiming(
    sense_ms=0.5,
    setup_ms=0.25,
    commitment_ms=0.0,
    spaces_ms=0.0,
    solve_ms=1.25,
    certify_ms=0.5,
    barrier_ms=0.125,
    send_ms=0.125,
)


def tick_record(**changes: Any) -> TickRecord:
    """Return a record; `changes` replace fields."""
    fields: dict[str, Any] = {
        "t_us": 9_000_000_000_001,
        "utc_us": 1_700_000_000_000_002,
        "seq": 4_000_000_003,
        "mission_t_s": 21.5,
        "phase": Phase.TRACK,
        "mode": Mode.REPLAY,
        "control": ControlMode.GOTO,
        "flight_mode": FlightMode.EXTERNAL,
        "armed": True,
        "state": STATE,
        "reference": Reference(pos_ned_m=np.array([[7.0, 8.0, 9.0]]), vel_ned_m_s=np.zeros((1, 3)), yaw_rad=0.0),
        "plan": PLAN,
        "flown": PLAN,
        "setpoint": AttitudeSetpoint(np.array([1.0, 0.0, 0.125, 0.0]), 0.625, 0),
        "setpoint_accel_ned_m_s2": np.array([0.25, -0.5, 0.125]),
        "hover_thrust_01": 0.375,
        "disturbance_ned_m_s2": np.array([0.0625, -0.5, 2.0]),
        "nearest_peer_m": math.inf,
        "nearest_obstacle_m": 3.5,
        "plan_staleness_ms": 12.5,
        "peers": 513,
        "rejected": 70_000,
        "deadline_misses": 65_537,
        "safety_filter_acted": True,
        "battery_01": 0.875,
        "timing": TIMING,
    }
    return TickRecord(**(fields | changes))
