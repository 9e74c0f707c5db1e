"""Maps `Health` to `Mode` by one table whose first matching row applies, and to what becomes of the mission by another.

Pure; all state is passed in.

After a plan that must not be flown the modes are, in order: replay the shifted last certified plan while it is recent
and has inputs left, brake, hold, land. While the vehicle's state is stale or the estimate lost (STATE_STALE) nothing is
sent, so the vehicle does what its autopilot's own failsafe is set to by `agent.autopilot_params`
(`swarmctl/agent/setup.py`): it lands.

The mode is how this tick is flown. What wears out slowly leaves time for more: the second table escalates, from a
warning to the way back to a landing in place, under the agent's own plan.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pydantic import Field

from swarmctl.core.params import Params
from swarmctl.core.types import FlightMode, Health, Mode, Phase, PlanStatus

_NEVER_S = 60.0  # long after any autopilot has landed by itself
_ANY_US = 1 << 62  # of patience: a landing waits for room as long as it may


class FailsafeParams(Params):
    """Time limits and thresholds of the failsafe."""

    state_max_age_s: float = Field(0.2, gt=0, le=5)  # an older vehicle state is stale
    replay_s: float = Field(0.4, ge=0, le=5)  # longest replay of the last certified plan, which ends with it
    hold_s: float = Field(5.0, ge=0, le=600)  # longest hold without a plan; then land
    rest_speed_m_s: float = Field(0.2, gt=0, le=5)  # a faster vehicle brakes before it holds
    battery_warn_01: float = Field(0.3, ge=0, le=1)  # an alert below this charge; 0, as in the next two: never
    battery_rtl_01: float = Field(0.2, ge=0, le=1)  # back to the start below this charge, and nothing is armed
    battery_land_01: float = Field(0.1, ge=0, le=1)  # landing in place below this charge
    link_warn_01: float = Field(0.2, ge=0, le=1)  # an alert while its state is stale for more of the time
    link_rtl_01: float = Field(1.0, ge=0, le=1)  # back to the start; 1, as in the next one: never
    link_land_01: float = Field(1.0, ge=0, le=1)  # landing in place
    dead_reckoning_warn_s: float = Field(0.5, ge=0, le=_NEVER_S)  # an alert, after the newest fix of GPS; 60: never
    dead_reckoning_land_s: float = Field(1.5, ge=0, le=_NEVER_S)  # landing in place, not yet blindly
    window_s: float = Field(5.0, gt=0, le=60)  # charge counts as its highest in this time, the link as its share of it

    def problems(self) -> Iterator[str]:
        """Yield thresholds that do not escalate."""
        for watched in _WATCHED:
            limits = watched.limits(self)
            order = [watched.sign * limit for limit in limits if limit != watched.never]
            if order != sorted(order):
                keys = watched.keys
                given = [getattr(self, key) for key in keys]
                yield (
                    f"agent.failsafe: {', '.join(keys)} = {given}: do not escalate; put them in this order of severity"
                )

    def acts(self, name: str) -> list[str]:
        """Return in words what the agent does, and from where on, as far as what is called `name` wears out."""
        (row,) = (each for each in _WATCHED if each.name == name)
        limits = zip(_ESCALATION, row.limits(self), strict=True)
        return [f"{_SAID[response]} at {limit:.0%}" for response, limit in limits if limit != row.never]


@dataclass(frozen=True, slots=True)
class FailsafeDecision:
    """The mode of a tick and the reason for it."""

    mode: Mode
    reason: str


class Response(enum.IntEnum):
    """What becomes of the mission, in increasing order."""

    NONE = 0
    WARN = 1
    RTL = 2
    LAND = 3


@dataclass(frozen=True, slots=True)
class Escalation:
    """The response to what wears out, the reason for it, and after how long a landing no longer waits for room."""

    response: Response
    reason: str
    patience_us: int = _ANY_US


NOTHING_WORN = Escalation(Response.NONE, "")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Watched:
    """A row of the table of escalation: what is measured, and from where on it asks for each response."""

    name: str
    measure: Callable[[Health], float]  # negative if unknown
    limits: Callable[[FailsafeParams], tuple[float, float, float]]  # of WARN, RTL and LAND
    sign: float  # 1 where more is worse, -1 where less is
    never: float  # limit that switches a response off
    said: str  # with a format for its value times `scale`
    scale: float = 100.0
    unit: str = "01"  # of its keys
    patience_us: int = _ANY_US

    @property
    def keys(self) -> list[str]:
        """Return the names of its limits, which need not be of all responses."""
        names = [f"{self.name}_{response.name.lower()}_{self.unit}" for response in _ESCALATION]
        return [name for name in names if name in FailsafeParams.model_fields]


_SAID = {Response.WARN: "warns", Response.RTL: "returns", Response.LAND: "lands"}
_ESCALATION = (Response.WARN, Response.RTL, Response.LAND)
_WATCHED = (
    _Watched(
        name="battery",
        measure=lambda health: health.battery_01,
        limits=lambda p: (p.battery_warn_01, p.battery_rtl_01, p.battery_land_01),
        sign=-1.0,
        never=0.0,
        said="battery at {:.0f} %",
    ),
    _Watched(
        name="link",
        measure=lambda health: health.link_lost_01,
        limits=lambda p: (p.link_warn_01, p.link_rtl_01, p.link_land_01),
        sign=1.0,
        never=1.0,
        said="no state of the vehicle in {:.0f} % of the time",
    ),
    _Watched(
        name="dead_reckoning",
        measure=lambda health: health.dead_reckoning_s,
        limits=lambda p: (p.dead_reckoning_warn_s, _NEVER_S, p.dead_reckoning_land_s),
        sign=1.0,
        never=_NEVER_S,
        said="no GPS for {:.1f} s, and an estimate that gets worse",
        scale=1.0,
        unit="s",
        patience_us=2_000_000,  # to brake; room can't be made by positions that get worse
    ),
)


def escalate(health: Health, params: FailsafeParams) -> Escalation:
    """Return the strongest response that any row of the table asks for; of equal ones the first."""
    found = NOTHING_WORN
    for watched in _WATCHED:
        value = watched.measure(health)
        if value < 0.0:
            continue
        for response, limit in zip(_ESCALATION, watched.limits(params), strict=True):
            due = limit != watched.never and watched.sign * (value - limit) > 0.0
            if due and response > found.response:
                found = Escalation(response, watched.said.format(watched.scale * value), watched.patience_us)
    return found


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
    has_input = 0 <= h.last_good_plan_age_us < h.last_good_plan_lasts_us
    return h.plan_status is not PlanStatus.OK and has_input and h.last_good_plan_age_us <= p.replay_s * 1e6


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
