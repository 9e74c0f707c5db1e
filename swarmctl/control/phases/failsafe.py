"""Health -> Mode: one table, first matching row wins. Pure; the only state is passed in.

The ladder after a bad plan: fly the shifted last certified plan while it is young -> brake -> hold -> land.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pydantic import Field

from swarmctl.core.params import Params
from swarmctl.core.types import FlightMode, Health, Mode, Phase, PlanStatus


class FailsafeParams(Params):
    """How long what is trusted."""

    state_max_age_s: float = Field(0.2, gt=0, le=5)
    replay_s: float = Field(0.4, ge=0, le=5)  # how long an old certified plan is flown
    hold_s: float = Field(5.0, ge=0, le=600)  # at rest without a plan, then land
    rest_speed_m_s: float = Field(0.2, gt=0, le=5)


@dataclass(frozen=True, slots=True)
class Judgement:
    """A mode and why."""

    mode: Mode
    reason: str


_FLYING = (Phase.GOTO_START, Phase.READY, Phase.TRACK, Phase.GOTO_LAND)


def judge(health: Health, params: FailsafeParams) -> Judgement:
    """Mode of this tick: that of the first row of the table that applies to `health`."""
    for applies, mode, reason in _TABLE:
        if applies(health, params):
            return Judgement(mode, reason)
    return Judgement(Mode.FOLLOW, "plan certified")


def _blind(h: Health, p: FailsafeParams) -> bool:
    return h.state_age_us < 0 or h.state_age_us > p.state_max_age_s * 1e6


def _not_ours(h: Health, _: FailsafeParams) -> bool:
    return h.phase not in _FLYING


def _yielded(h: Health, _: FailsafeParams) -> bool:
    return h.yielded


def _taken(h: Health, _: FailsafeParams) -> bool:
    return h.had_control and (h.mode is not FlightMode.EXTERNAL or not h.armed or h.autopilot_failsafe)


def _young(h: Health, p: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK and 0 <= h.last_good_plan_age_us <= p.replay_s * 1e6


def _moving(h: Health, p: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK and h.speed_m_s > p.rest_speed_m_s


def _stuck(h: Health, p: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK and h.planless_us > (p.replay_s + p.hold_s) * 1e6


def _planless(h: Health, _: FailsafeParams) -> bool:
    return h.plan_status is not PlanStatus.OK


def _waiting(h: Health, _: FailsafeParams) -> bool:
    return not h.had_control


_Row = tuple[Callable[[Health, FailsafeParams], bool], Mode, str]
_TABLE: tuple[_Row, ...] = (
    (_blind, Mode.BLIND, "own state too old"),
    (_yielded, Mode.YIELD, "pilot or autopilot flies until an operator resumes"),
    (_not_ours, Mode.IDLE, "autopilot flies"),
    (_taken, Mode.YIELD, "pilot or autopilot took over"),
    (_young, Mode.REPLAY, "no new plan: last certified one"),
    (_stuck, Mode.LAND, "no plan for too long"),
    (_moving, Mode.BRAKE, "no plan: braking"),
    (_planless, Mode.HOLD, "no plan: holding"),
    (_waiting, Mode.STREAM, "waiting for the autopilot to follow"),
)
