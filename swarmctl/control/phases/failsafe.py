"""Maps `Health` to `Mode` by one table whose first matching row applies. Pure; all state is passed in.

After a plan that must not be flown the modes are, in order: replay the shifted last certified plan while it is recent,
brake, hold, land. While the vehicle's state is stale or the estimate lost (STATE_STALE) nothing is sent, so the vehicle
does what its autopilot's own failsafe is set to by `agent.autopilot_params` (`swarmctl/agent/setup.py`): it lands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pydantic import Field

from swarmctl.core.params import Params
from swarmctl.core.types import FlightMode, Health, Mode, Phase, PlanStatus


class FailsafeParams(Params):
    """Time limits and thresholds of the failsafe."""

    state_max_age_s: float = Field(0.2, gt=0, le=5)  # an older vehicle state is stale
    replay_s: float = Field(0.4, ge=0, le=5)  # longest replay of the last certified plan
    hold_s: float = Field(5.0, ge=0, le=600)  # longest hold without a plan; then land
    rest_speed_m_s: float = Field(0.2, gt=0, le=5)  # a faster vehicle brakes before it holds


@dataclass(frozen=True, slots=True)
class FailsafeDecision:
    """The mode of a tick and the reason for it."""

    mode: Mode
    reason: str


_FLYING = (Phase.GOTO_START, Phase.READY, Phase.TRACK, Phase.GOTO_LAND)


def decide(health: Health, params: FailsafeParams) -> FailsafeDecision:
    """Return the mode of this tick: that of the first row of the table that applies to `health`."""
    for applies, mode, reason in _TABLE:
        if applies(health, params):
            return FailsafeDecision(mode, reason)
    return FailsafeDecision(Mode.TRACKING, "plan certified")


def _state_stale(h: Health, p: FailsafeParams) -> bool:
    return h.state_age_us < 0 or h.state_age_us > p.state_max_age_s * 1e6


def _autopilot_flies(h: Health, _: FailsafeParams) -> bool:
    return h.phase not in _FLYING


def _overridden(h: Health, _: FailsafeParams) -> bool:
    return h.pilot_override


def _taken_over(h: Health, _: FailsafeParams) -> bool:
    return h.had_control and (h.mode is not FlightMode.EXTERNAL or not h.armed or h.autopilot_failsafe)


def _plan_is_young(h: Health, p: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK and 0 <= h.last_good_plan_age_us <= p.replay_s * 1e6


def _moving(h: Health, p: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK and h.speed_m_s > p.rest_speed_m_s


def _planless_too_long(h: Health, p: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK and h.planless_us > (p.replay_s + p.hold_s) * 1e6


def _planless(h: Health, _: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK


def _not_in_control(h: Health, _: FailsafeParams) -> bool:
    return not h.had_control


_Row = tuple[Callable[[Health, FailsafeParams], bool], Mode, str]
_TABLE: tuple[_Row, ...] = (
    (_state_stale, Mode.STATE_STALE, "own state too old"),
    (_overridden, Mode.PILOT_OVERRIDE, "pilot or autopilot flies until an operator resumes"),
    (_autopilot_flies, Mode.IDLE, "autopilot flies"),
    (_taken_over, Mode.PILOT_OVERRIDE, "pilot or autopilot took over"),
    (_plan_is_young, Mode.REPLAY, "no new plan: last certified one"),
    (_planless_too_long, Mode.LAND, "no plan for too long"),
    (_moving, Mode.BRAKE, "no plan: braking"),
    (_planless, Mode.HOLD, "no plan: holding"),
    (_not_in_control, Mode.PRIMING, "waiting for the autopilot to follow"),
)
