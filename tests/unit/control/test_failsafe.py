"""Tests of every row of the failsafe table, its limits, and the precedence of rows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from swarmctl.control.failsafe.decision import FailsafeParams, decide
from swarmctl.core.types import FlightMode, Health, Mode, Phase, PlanStatus

PARAMS = FailsafeParams()  # state 0.2 s, replay 0.4 s, hold 5 s, rest 0.2 m/s
GOOD = Health(
    state_age_us=20_000,
    armed=True,
    mode=FlightMode.EXTERNAL,
    autopilot_failsafe=False,
    plan_status=PlanStatus.OK,
    last_good_plan_age_us=0,
    last_good_plan_lasts_us=800_000,
    planless_us=0,
    speed_m_s=1.0,
    phase=Phase.TRACK,
    had_control=True,
    battery_01=1.0,
    link_lost_01=0.0,
    dead_reckoning_s=0.0,
    pilot_override=False,
)
BAD_PLANS = [s for s in PlanStatus if s is not PlanStatus.OK]


def mode_of(**changes: Any) -> Mode:
    return decide(replace(GOOD, **changes), PARAMS).mode


def test_a_good_plan_is_tracked_and_primed_before_the_autopilot_follows() -> None:
    assert mode_of() is Mode.TRACKING
    assert mode_of(had_control=False) is Mode.PRIMING
    assert mode_of(had_control=False, mode=FlightMode.HOLD) is Mode.PRIMING


@pytest.mark.parametrize(
    ("age_us", "mode"),
    [(-1, Mode.STATE_STALE), (0, Mode.TRACKING), (200_000, Mode.TRACKING), (200_001, Mode.STATE_STALE)],
)
def test_own_state_older_than_200_ms_sends_nothing(age_us: int, mode: Mode) -> None:
    assert mode_of(state_age_us=age_us) is mode


@pytest.mark.parametrize("phase", list(Phase))
def test_the_autopilot_flies_outside_the_mission(phase: Phase) -> None:
    ours = phase in (Phase.GOTO_START, Phase.READY, Phase.TRACK, Phase.GOTO_LAND)
    assert mode_of(phase=phase) is (Mode.TRACKING if ours else Mode.IDLE)


@pytest.mark.parametrize("mode", [m for m in FlightMode if m is not FlightMode.EXTERNAL])
def test_leaving_offboard_is_a_pilot_override(mode: FlightMode) -> None:
    assert mode_of(mode=mode) is Mode.PILOT_OVERRIDE


@pytest.mark.parametrize("change", [{"armed": False}, {"autopilot_failsafe": True}])
def test_disarming_and_the_autopilots_failsafe_are_an_override(change: dict[str, Any]) -> None:
    assert mode_of(**change) is Mode.PILOT_OVERRIDE
    assert mode_of(had_control=False, **change) is Mode.PRIMING


@pytest.mark.parametrize("status", BAD_PLANS)
def test_the_ladder_after_a_bad_plan(status: PlanStatus) -> None:
    bad: dict[str, Any] = {"plan_status": status}
    assert mode_of(**bad, last_good_plan_age_us=0) is Mode.REPLAY
    assert mode_of(**bad, last_good_plan_age_us=400_000) is Mode.REPLAY
    assert mode_of(**bad, last_good_plan_age_us=400_001) is Mode.BRAKE
    assert mode_of(**bad, last_good_plan_age_us=-1) is Mode.BRAKE
    old: dict[str, Any] = {**bad, "last_good_plan_age_us": 1_000_000}
    assert mode_of(**old, speed_m_s=0.201) is Mode.BRAKE
    assert mode_of(**old, speed_m_s=0.2) is Mode.HOLD
    assert mode_of(**old, speed_m_s=0.0, planless_us=5_400_000) is Mode.HOLD
    assert mode_of(**old, speed_m_s=0.0, planless_us=5_400_001) is Mode.LAND
    assert mode_of(**old, speed_m_s=9.0, planless_us=5_400_001) is Mode.LAND


def test_a_plan_that_begins_one_delay_ahead_is_recent() -> None:
    assert mode_of(plan_status=PlanStatus.RESIDUAL, last_good_plan_age_us=60_000) is Mode.REPLAY


@pytest.mark.parametrize("status", BAD_PLANS)
@pytest.mark.parametrize("lasts_us", [200_000, 400_000, 800_000])
def test_a_replay_ends_with_its_plan_however_long_it_may_last(status: PlanStatus, lasts_us: int) -> None:
    bad: dict[str, Any] = {"plan_status": status, "last_good_plan_lasts_us": lasts_us}
    long = FailsafeParams(replay_s=5.0)
    for age_us, mode in ((lasts_us - 1, Mode.REPLAY), (lasts_us, Mode.BRAKE), (4_900_000, Mode.BRAKE)):
        assert decide(replace(GOOD, **bad, last_good_plan_age_us=age_us), long).mode is mode


@pytest.mark.parametrize("status", BAD_PLANS)
def test_a_bad_plan_is_never_flown_whoever_has_control(status: PlanStatus) -> None:
    for had_control in (True, False):
        for age_us in (-1, 0, 10**9):
            for planless_us in (0, 10**9):
                flown = mode_of(
                    had_control=had_control, plan_status=status, last_good_plan_age_us=age_us, planless_us=planless_us
                )
                assert flown not in (Mode.TRACKING, Mode.PRIMING)


@pytest.mark.parametrize(
    ("changes", "mode"),
    [
        # a stale state before idle, override and plans
        ({"state_age_us": -1, "phase": Phase.STANDBY}, Mode.STATE_STALE),
        ({"state_age_us": 300_000, "mode": FlightMode.MANUAL}, Mode.STATE_STALE),
        ({"state_age_us": 300_000, "plan_status": PlanStatus.NONE}, Mode.STATE_STALE),
        # an override lasts through every phase; a stale state comes first
        ({"pilot_override": True, "had_control": False}, Mode.PILOT_OVERRIDE),
        ({"pilot_override": True, "had_control": False, "phase": Phase.LAND}, Mode.PILOT_OVERRIDE),
        (
            {"pilot_override": True, "had_control": False, "plan_status": PlanStatus.NONE, "planless_us": 10**9},
            Mode.PILOT_OVERRIDE,
        ),
        ({"pilot_override": True, "state_age_us": 300_000}, Mode.STATE_STALE),
        # idle before override: landing by the autopilot is no take-over
        ({"phase": Phase.LAND, "mode": FlightMode.LAND}, Mode.IDLE),
        ({"phase": Phase.DONE, "armed": False}, Mode.IDLE),
        # override before everything about plans
        ({"armed": False, "plan_status": PlanStatus.SOLVER_FAILED}, Mode.PILOT_OVERRIDE),
        ({"mode": FlightMode.RTL, "plan_status": PlanStatus.NONE, "planless_us": 10**9}, Mode.PILOT_OVERRIDE),
        # a recent certified plan before landing, landing before braking
        ({"plan_status": PlanStatus.NONE, "last_good_plan_age_us": 0, "planless_us": 10**9}, Mode.REPLAY),
        ({"plan_status": PlanStatus.NONE, "last_good_plan_age_us": -1, "planless_us": 10**9}, Mode.LAND),
    ],
)
def test_order_of_precedence(changes: dict[str, Any], mode: Mode) -> None:
    assert mode_of(**changes) is mode


def test_every_decision_has_a_reason() -> None:
    reasons = {
        decide(replace(GOOD, **change), PARAMS).reason
        for change in (
            {},
            {"state_age_us": -1},
            {"phase": Phase.ARM},
            {"pilot_override": True},
            {"armed": False},
            {"plan_status": PlanStatus.NONE},
            {"plan_status": PlanStatus.NONE, "last_good_plan_age_us": -1},
            {"plan_status": PlanStatus.NONE, "last_good_plan_age_us": -1, "speed_m_s": 0.0},
            {"plan_status": PlanStatus.NONE, "last_good_plan_age_us": -1, "planless_us": 10**9},
        )
    }
    assert len(reasons) == 9
    assert all(reasons)
