"""How a tick is flown: the mode of each combination of state, control and plan, and the plan that is flown in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swarmctl.agent import assembly
from swarmctl.agent.components import make_state_machine
from swarmctl.agent.flying.mode_selector import ModeSelector
from swarmctl.agent.tick_results import PlanningResult
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.config import load
from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.core.types import Array, FlightMode, Mode, Phase, Plan, PlanStatus, VehicleState
from tests import builders

MS, SECOND = 1_000, 1_000_000
TICK_US = 20 * MS
DT_US, STEPS, DELAY_US = 100 * MS, 10, 30 * MS
HERE = np.array([1.0, 2.0, -3.0])
AHEAD_M = 0.6  # what a second of braking from 2 m/s needs
BAD = (PlanStatus.SOLVER_FAILED, PlanStatus.RESIDUAL, PlanStatus.NOT_CERTIFIED, PlanStatus.NONE)
FLOWN_PHASES = (Phase.GOTO_START, Phase.READY, Phase.TRACK, Phase.GOTO_LAND)
OTHER_PHASES = tuple(phase for phase in Phase if phase not in FLOWN_PHASES)


class Bench:
    """One selector, its vehicle and its clock: by default it tracks the mission, and each of its plans is good."""

    def __init__(self, *overrides: str) -> None:
        setup = assembly._setup_of(load(None, ["swarm.agents=1", *overrides]), 0, 1, {})
        self.mission = make_state_machine(setup).mission
        self.mission.phase, self.mission.had_control = Phase.TRACK, True
        self.alerts, self.told = Alerts(), list[dict[str, Any]]()
        grid = cast(Any, SimpleNamespace(dt_us=DT_US, steps=STEPS))
        self.selector = ModeSelector(
            setup,
            grid,
            DELAY_US,
            self.mission,
            alerts=self.alerts,
            note=lambda name, **fields: self.told.append({"event": name, **fields}),
        )
        self.now_us = 10 * SECOND
        self.state: VehicleState | None = builders.vehicle_state(pos_ned_m=HERE)
        self.age_us = 0
        self.battery_01: float | None = None
        self.dead_reckoning_s = 0.0
        self.keep_outs: list[KeepOut] = []
        self.plan: Plan | None = None

    def tick(self, status: PlanStatus | None = PlanStatus.OK, **changes: Any) -> Plan | None:
        """Fly a tick whose plan has a status, None for no plan; return the plan that is flown."""
        self.now_us += TICK_US
        state = None if self.state is None else replace(self.state, t_us=self.now_us - self.age_us)
        start = None
        if state is not None and self.selector.is_fresh(self.now_us, state):
            pos, vel = state.pos_ned_m, state.vel_ned_m_s
            start = builders.start(t_us=self.now_us + DELAY_US, pos_ned_m=pos, vel_ned_m_s=vel)
        self.plan = None if status is None else self.made(status, **changes)
        planning = PlanningResult(start=start, plan=self.plan, reference=None, keep_outs=self.keep_outs)
        still = np.zeros(3)
        self.selector.update(
            self.now_us,
            state,
            planning,
            disturbance_ned_m_s2=still,
            battery_01=self.battery_01,
            dead_reckoning_s=self.dead_reckoning_s,
        )
        return self.selector.flown(state, planning, still)

    def ticks(self, seconds: float, status: PlanStatus | None = PlanStatus.OK) -> None:
        for _ in range(round(seconds * SECOND / TICK_US)):
            self.tick(status)

    def made(self, status: PlanStatus, pos_ned_m: Array | None = None) -> Plan:
        """Return a plan that rests where the vehicle is, or goes somewhere else."""
        pos = np.tile(HERE, (STEPS + 1, 1)) if pos_ned_m is None else pos_ned_m
        level = np.tile([0.0, 0.0, 9.81], (STEPS, 1))
        return Plan(
            status=status,
            t0_us=self.now_us + DELAY_US,
            dt_us=DT_US,
            pos_ned_m=pos,
            vel_ned_m_s=np.zeros((STEPS + 1, 3)),
            virtual_control=level,
        )

    def fly(self, **fields: Any) -> None:
        assert self.state is not None
        self.state = replace(self.state, **fields)

    @property
    def mode(self) -> Mode:
        return self.selector.mode


# -- who may send: without a plan that is flown, nothing is sent ------------------------------------------------------


def forget_state(bench: Bench) -> None:
    bench.state = None


def lose_state(bench: Bench) -> None:
    bench.age_us = 201 * MS


def leave_offboard(bench: Bench) -> None:
    bench.fly(mode=FlightMode.MANUAL)


def hold(bench: Bench) -> None:
    bench.fly(mode=FlightMode.HOLD)


def disarm(bench: Bench) -> None:
    bench.fly(armed=False)


def begin_failsafe(bench: Bench) -> None:
    bench.fly(failsafe=True)


def override(bench: Bench) -> None:
    bench.mission.pilot_override = True


@pytest.mark.parametrize("phase", FLOWN_PHASES)
@pytest.mark.parametrize(
    ("happens", "mode"),
    [
        (forget_state, Mode.STATE_STALE),
        (lose_state, Mode.STATE_STALE),
        (leave_offboard, Mode.PILOT_OVERRIDE),
        (hold, Mode.PILOT_OVERRIDE),
        (disarm, Mode.PILOT_OVERRIDE),
        (begin_failsafe, Mode.PILOT_OVERRIDE),
        (override, Mode.PILOT_OVERRIDE),
    ],
)
@pytest.mark.parametrize("status", [PlanStatus.OK, *BAD, None])
def test_who_has_lost_its_vehicle_flies_nothing_however_good_its_plan(
    phase: Phase, happens: Callable[[Bench], None], mode: Mode, status: PlanStatus | None
) -> None:
    bench = Bench()
    bench.mission.phase = phase
    assert bench.tick() is bench.plan
    happens(bench)
    assert bench.tick(status) is None
    assert bench.mode is mode


@pytest.mark.parametrize("phase", OTHER_PHASES)
@pytest.mark.parametrize("status", [PlanStatus.OK, *BAD])
def test_outside_of_the_flown_phases_the_autopilot_flies(phase: Phase, status: PlanStatus) -> None:
    bench = Bench()
    bench.tick()
    bench.mission.phase = phase
    assert bench.tick(status) is None
    assert bench.mode is Mode.IDLE


@pytest.mark.parametrize("phase", FLOWN_PHASES)
@pytest.mark.parametrize("flight_mode", [FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.MANUAL])
def test_before_the_autopilot_follows_the_plan_is_streamed_to_it(phase: Phase, flight_mode: FlightMode) -> None:
    bench = Bench()
    bench.mission.phase, bench.mission.had_control = phase, False
    bench.fly(mode=flight_mode)
    assert bench.tick() is bench.plan
    assert bench.mode is Mode.PRIMING


@pytest.mark.parametrize(("age_ms", "mode"), [(0, Mode.TRACKING), (200, Mode.TRACKING), (201, Mode.STATE_STALE)])
def test_a_state_is_flown_from_until_it_is_stale(age_ms: int, mode: Mode) -> None:
    bench = Bench()
    bench.age_us = age_ms * MS
    flown = bench.tick()
    assert bench.mode is mode
    assert (flown is not None) is (mode is Mode.TRACKING)


def test_a_state_that_comes_back_is_flown_from_again() -> None:
    bench = Bench()
    bench.tick()
    bench.age_us = 300 * MS
    bench.ticks(3.0, None)
    bench.age_us = 0
    assert bench.tick() is bench.plan
    assert bench.mode is Mode.TRACKING


# -- the ladder of a plan that must not be flown ----------------------------------------------------------------------


@pytest.mark.parametrize("status", BAD)
def test_no_plan_is_replayed_past_its_end_where_its_last_input_would_be_held(status: PlanStatus) -> None:
    bench = Bench("agent.failsafe.replay_s=5")
    bench.fly(vel_ned_m_s=np.array([2.0, 0.0, 0.0]))
    good = bench.tick()
    assert good is not None
    for _ in range(200):
        flown = bench.tick(status)
        assert (flown is good) is (bench.now_us + DELAY_US < good.t0_us + STEPS * DT_US)
    assert bench.mode is Mode.BRAKE


@pytest.mark.parametrize("status", BAD)
@pytest.mark.parametrize(("speed_m_s", "then"), [(0.5, Mode.BRAKE), (0.1, Mode.HOLD)])
def test_without_a_plan_the_last_good_one_is_flown_then_it_brakes_holds_and_is_landed(
    status: PlanStatus, speed_m_s: float, then: Mode
) -> None:
    bench = Bench()
    bench.fly(vel_ned_m_s=np.array([speed_m_s, 0.0, 0.0]))
    bench.tick()
    good, since_us = bench.plan, bench.now_us
    modes = {}
    for _ in range(round(7.0 * SECOND / TICK_US)):
        flown = bench.tick(status)
        modes[(bench.now_us - since_us) // MS] = bench.mode
        assert flown is not bench.plan, "what was refused"
        if bench.mode is Mode.REPLAY:
            assert flown is good
        elif bench.mode is Mode.LAND:
            assert flown is None
        else:
            assert flown is not None
            assert flown.t0_us == bench.now_us + DELAY_US
    assert {mode for at_ms, mode in modes.items() if at_ms <= 400} == {Mode.REPLAY}
    assert {mode for at_ms, mode in modes.items() if 400 < at_ms <= 5400} == {then}
    assert {mode for at_ms, mode in modes.items() if at_ms > 5400} == {Mode.LAND}
    assert bench.tick() is bench.plan, "a good plan is flown at once"
    assert bench.mode is Mode.TRACKING


def test_the_age_of_a_replayed_plan_is_that_of_what_acts() -> None:
    """It began when its first setpoint acted, so one that was made from an older state is older in the same tick."""
    bench = Bench("agent.failsafe.replay_s=0.1")
    bench.tick()
    assert bench.plan is not None
    bench.selector._plan_buffer.plan = replace(bench.plan, t0_us=bench.now_us - 70 * MS)
    bench.tick(PlanStatus.SOLVER_FAILED)
    assert bench.mode.name == "HOLD", "20 + 70 + 30 ms"
    bench.selector._plan_buffer.plan = replace(bench.plan, t0_us=bench.now_us - 50 * MS)
    bench.tick(PlanStatus.SOLVER_FAILED)
    assert bench.mode.name == "REPLAY", "20 + 50 + 30 ms"


def test_who_never_had_a_plan_has_nothing_to_replay() -> None:
    bench = Bench()
    assert bench.tick(PlanStatus.SOLVER_FAILED) is not None
    assert bench.mode is Mode.HOLD


def test_time_in_which_no_plan_was_needed_is_not_time_without_one() -> None:
    """A pilot flew for a minute: the first plan after that may fail without a landing."""
    bench = Bench()
    bench.tick()
    bench.ticks(60.0, None)
    bench.tick(PlanStatus.SOLVER_FAILED)
    assert bench.mode is Mode.HOLD


def test_it_brakes_from_the_motion_it_has_and_holds_where_it_has_come_to_rest() -> None:
    bench = Bench()
    bench.fly(vel_ned_m_s=np.array([2.0, 0.0, 0.0]))
    flown = bench.tick(PlanStatus.SOLVER_FAILED)
    assert bench.mode.name == "BRAKE"
    assert flown is not None
    assert flown.virtual_control[0, 0] > 0.05, "tilted back, against north"
    assert flown.pos_ned_m[-1, 0] - HERE[0] > AHEAD_M, "what peers are told: it comes to rest ahead, not here"
    bench.fly(vel_ned_m_s=np.zeros(3))
    bench.tick(PlanStatus.SOLVER_FAILED)
    assert bench.mode.name == "HOLD"
    bench.fly(pos_ned_m=HERE + np.array([0.5, 0.0, 0.0]))
    flown = bench.tick(PlanStatus.SOLVER_FAILED)
    assert flown is not None
    assert flown.virtual_control[0, 0] > 0.05, "blown north of where it holds, it goes back"
    bench.tick()
    bench.ticks(0.5, PlanStatus.SOLVER_FAILED)
    flown = bench.tick(PlanStatus.SOLVER_FAILED)
    assert bench.mode.name == "HOLD"
    assert flown is not None
    assert np.abs(flown.virtual_control[0, :2]).max() < 1e-9, "a later hold is where it is then"


@pytest.mark.parametrize(
    ("mode", "gust_m_s", "flies_it"),
    [("best_effort", 0.0, False), ("best_effort", 3.0, True), ("guaranteed", 0.0, False)],
)
def test_a_refused_plan_is_flown_only_where_gusts_blow_vehicles_together(
    mode: str, gust_m_s: float, flies_it: bool
) -> None:
    bench = Bench(f"separation.mode='{mode}'", f"separation.gust_m_s={gust_m_s}", "vehicle_model.drag_1_s=0.3")
    here = np.tile(HERE, (STEPS + 1, 1))
    bench.keep_outs = [builders.keep_out(pos_ned_m=here)]  # braking stays in it, the plan keeps off
    flown = bench.tick(PlanStatus.NOT_CERTIFIED, pos_ned_m=here - np.array([0.9, 0.0, 0.0]))
    assert (flown is bench.plan) is flies_it
    assert bench.mode is (Mode.REPLAY if flies_it else Mode.HOLD)


def test_what_is_kept_is_what_the_next_plan_is_linearised_around() -> None:
    bench = Bench()
    assert bench.selector.guess_ned_m(bench.now_us) is None
    bench.tick()
    guess = bench.selector.guess_ned_m(bench.now_us + DELAY_US)
    assert guess is not None
    assert guess.shape == (STEPS + 1, 3)
    assert np.allclose(guess, HERE)
    assert bench.selector.guess_ned_m(bench.now_us + DELAY_US + STEPS * DT_US) is None, "it has ended"


def test_what_begins_nowhere_is_not_flown() -> None:
    """A tick without a predicted state has nothing to brake from, whatever its mode."""
    bench = Bench()
    bench.tick()
    state = builders.vehicle_state(t_us=bench.now_us + 5 * SECOND, pos_ned_m=HERE)
    nothing, still = PlanningResult(start=None, plan=None, reference=None, keep_outs=[]), np.zeros(3)
    bench.selector.update(state.t_us, state, nothing, disturbance_ned_m_s2=still, battery_01=None, dead_reckoning_s=0.0)
    assert bench.mode is Mode.HOLD
    assert bench.selector.flown(state, nothing, still) is None


# -- what wears out ---------------------------------------------------------------------------------------------------


def worn_battery(bench: Bench) -> None:
    bench.battery_01 = 0.05


def worn_link(bench: Bench) -> None:
    bench.age_us = 300 * MS


def worn_positions(bench: Bench) -> None:
    bench.dead_reckoning_s = 2.0


@pytest.mark.parametrize(
    ("wears", "response", "reason"),
    [
        (worn_battery, "LAND", "battery at 5 %"),
        (worn_link, "LAND", "no state of the vehicle in"),
        (worn_positions, "LAND", "no GPS for 2.0 s"),
    ],
)
def test_what_wears_out_is_noted_once_and_said_as_long_as_it_lasts(
    wears: Callable[[Bench], None], response: str, reason: str
) -> None:
    bench = Bench("agent.failsafe.window_s=1", "agent.failsafe.link_land_01=0.5", "agent.failsafe.link_warn_01=0.5")
    bench.ticks(2.0)
    assert bench.told == []
    wears(bench)
    bench.ticks(3.0)
    assert [(row["event"], row["response"]) for row in bench.told] == [("escalation", response)]
    assert bench.told[0]["reason"].startswith(reason)
    assert bench.selector.escalation.response.name == response
    alert = bench.alerts.newest(bench.now_us)
    assert alert is not None
    assert alert.text.startswith(reason)


def test_a_mission_that_is_done_raises_no_alert_of_what_is_worn() -> None:
    bench = Bench()
    bench.mission.phase, bench.battery_01 = Phase.DONE, 0.05
    bench.ticks(1.0)
    assert bench.alerts.newest(bench.now_us) is None
