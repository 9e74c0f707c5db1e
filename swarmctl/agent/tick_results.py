"""What the parts of a tick hand on: the result of planning, and what was sent to the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.mpc.problem import Start
from swarmctl.core.types import Array, AttitudeSetpoint, Mode, Plan, Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningResult:
    """Result of the planning part of a tick; what may be is None while the own state is stale."""

    start: Start | None
    plan: Plan | None  # also None while the autopilot flies
    reference: Reference | None  # the mission's reference now, one point
    keep_outs: list[KeepOut]
    followed_z_m: float | None = None  # down coordinate now of what is followed, in a hold too


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlOutput:
    """Output of a tick: mode, flown plan and setpoint sent."""

    mode: Mode
    flown: Plan | None
    setpoint: AttitudeSetpoint | None
    setpoint_accel_ned_m_s2: Array | None  # (3,) that the setpoint asks for
    safety_filter_acted: bool = False
