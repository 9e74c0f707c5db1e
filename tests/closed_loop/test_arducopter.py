"""Tests of the default circle on simulated ArduCopters: GUIDED, C-cast parameters, streams on request only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from sitl.arducopter.autopilot import ArduCopter
from sitl.lockstep import Lockstep
from swarmctl.agent.planning.non_participants import NonParticipants
from swarmctl.agent.sensing import world_model
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.collision.separation import without_setpoints
from swarmctl.core.types import FlightMode, Landed, Mode, Phase, PredictedPath
from tests.closed_loop.conftest import Flight, closer_than, fly_now, mission_t_s

CONFIG = "ardupilot_sitl.toml"


@pytest.fixture(scope="module")
def circle() -> Iterator[Flight]:
    """Fly three agents for 10 s, from the ground and back."""
    yield fly_now("mission.duration_s=10", config=CONFIG)


def pilots(lockstep: Lockstep) -> list[ArduCopter]:
    return [pilot for pilot in lockstep.world.autopilots if isinstance(pilot, ArduCopter)]


def test_whole_mission_is_flown_and_landed(circle: Flight) -> None:
    assert circle.problems == []
    last = circle.lockstep.truth[-3:]
    assert (last["landed"] == Landed.ON_GROUND).all() and not last["armed"].any()
    assert (last["flight_mode"] == FlightMode.LAND).all(), "landed by ArduCopter's LAND, which it stays in"
    starts = np.array(circle.config.starts_ned_m())
    assert np.linalg.norm((circle.pos_ned_m[-1] - starts)[:, :2], axis=1).max() < 0.3


def test_true_separation_is_kept_throughout(circle: Flight) -> None:
    assert circle.separation_m() >= 0.85


def test_the_circle_is_tracked_with_every_plan_good(circle: Flight) -> None:
    assert circle.summed_mean_error_m(after_s=5.0) <= 1.8, "theoretical lower bound: 1.56"
    for agent in range(3):
        assert circle.modes(agent, Phase.TRACK) == {Mode.TRACKING}


def test_setpoints_were_taken_as_thrust_and_all_accepted(circle: Flight) -> None:
    for agent, pilot in enumerate(pilots(circle.lockstep)):
        assert not pilot.refused
        assert pilot.parameters.integer("GUID_OPTIONS") == 0, "after the flight it is what it was"
        ticks, _ = circle.tracked(agent)
        assert float(np.median(ticks["setpoint_thrust_01"])) == pytest.approx(0.3645, abs=0.02)


def test_negative_control_without_the_option_nothing_is_armed() -> None:
    flight = fly_now("swarm.agents=1", "agent.autopilot_params.GUID_OPTIONS=0", config=CONFIG)
    (agent,) = flight.lockstep.agents
    assert agent is not None and "GUID_OPTIONS" in agent.outcome
    assert not flight.lockstep.truth["armed"].any()


# -- an agent that dies -----------------------------------------------------------------------------------------------


def test_the_vehicle_of_a_dead_agent_lands_and_the_other_keeps_clear() -> None:
    def is_down(running: Lockstep) -> bool:
        return running.agents[0] is None and running.world.truth_rows()[0]["landed"] == Landed.ON_GROUND

    died = {4.0: lambda running: running.kill(0)}
    flight = fly_now("swarm.agents=2", "mission.duration_s=10", config=CONFIG, at=died, until=is_down)
    assert pilots(flight.lockstep)[0].flight_mode() is FlightMode.LAND
    assert flight.lockstep.truth[-2]["landed"] == Landed.ON_GROUND
    assert flight.separation_m() >= 0.85


def test_negative_control_without_its_failsafe_it_would_never_be_armed() -> None:
    flight = fly_now("swarm.agents=1", "agent.autopilot_params.FS_GCS_ENABLE=0", config=CONFIG)
    (agent,) = flight.lockstep.agents
    assert agent is not None and "FS_GCS_ENABLE" in agent.outcome
    assert not flight.lockstep.truth["armed"].any()


# Committed to crossing each other's ways one after another.
CROSSING = (
    *("agent.rate_hz=25", "sitl.start=air", "swarm.agents=3", "separation.mode=guaranteed"),
    "start.positions_ned_m=[[2.5862,1.5048,-3],[-2.5752,1.4846,-3],[-0.0358,-3.002,-3]]",
    *("mission.kind=swap", "mission.swap.travel_s=6", "mission.duration_s=60"),
)
ENDS_AT_S, PASSED_S, TOUCH_M = 0.7, 4.2, 0.48
LITTLE_M_S2 = 7.5  # thrust over mass


def without_an_agent(
    seed: int = 0, *, at_s: float = ENDS_AT_S, is_frozen: bool = False, too_close_m: float = 0.0
) -> float:
    """Return how close vehicles come when an agent ends, of which the others are told; its own flies on for 2 s.

    Of one that is frozen nobody is told anything. The flight ends when two are too close.
    """
    too_close = closer_than(too_close_m)

    def end(running: Lockstep) -> None:
        if is_frozen:
            running.frozen.add(1)
        else:
            running.kill(1)

    flight = fly_now(
        *CROSSING,
        config=CONFIG,
        at={at_s: end},
        until=lambda running: mission_t_s(running) > PASSED_S or too_close(running),
        seed=seed,
    )
    return flight.separation_m()


@pytest.mark.parametrize("seed", [0, 1])
def test_others_keep_clear_of_one_whose_agent_has_ended_as_long_as_it_flies_on(seed: int) -> None:
    assert without_an_agent(seed) >= 0.85


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_one_that_is_expected_to_brake_as_soon_as_a_px4_is_hit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def as_a_px4(path: PredictedPath, *, lag_s: float, drag_1_s: float, **_: float) -> PredictedPath:
        return without_setpoints(path, lag_s=lag_s, drag_1_s=drag_1_s)

    monkeypatch.setattr(world_model, "without_setpoints", as_a_px4)
    assert without_an_agent(too_close_m=TOUCH_M) < TOUCH_M, "bodies touch"


@pytest.mark.parametrize("at_s", [0.5, 1.1])
@pytest.mark.usefixtures("configured_starts")
def test_others_keep_clear_of_one_whose_agent_is_silent_while_they_hear_each_other(
    monkeypatch: pytest.MonkeyPatch, at_s: float
) -> None:
    """Its host is lost, say. By what all have committed to, which it does not fly any more, bodies touch."""
    assert without_an_agent(at_s=at_s, is_frozen=True) >= 0.85
    monkeypatch.setattr(NonParticipants, "without_setpoints", lambda *_: KeepOuts())
    assert without_an_agent(at_s=at_s, is_frozen=True, too_close_m=TOUCH_M) < TOUCH_M, "negative control: bodies touch"


def falls_off_m(*, is_told: bool) -> float:
    """Return how far a vehicle is from where another expects it, 1.5 s after a last setpoint with little thrust."""

    def sink(running: Lockstep) -> None:
        agent = running.agents[1]
        assert agent is not None
        safety_filter = agent._setpoints._safety_filter
        safety_filter.keep_apart = lambda *_, **__: np.array([0.0, 0.0, LITTLE_M_S2])  # type: ignore[method-assign]

    begun, found = list[int](), list[float]()

    def is_late(running: Lockstep) -> bool:
        now_us, utc_us, watcher = running.clock.now_us(), running.clock.utc_us(), running.agents[0]
        if 1 not in running.frozen or watcher is None:
            return False
        begun.append(now_us)
        if now_us < begun[0] + 1_500_000:
            return False
        model = watcher._world_model
        (path,) = (path for path in model.paths.latest() if path.agent == 1)
        model.paths._newest[1] = path if is_told else replace(path, setpoint_accel_ned_m_s2=None)
        model.paths._near = None
        expected = model.ways_without_setpoints({1}, utc_us, 100_000, 1)[1][0]
        found.append(float(np.linalg.norm(running.world.truth_rows()["pos_ned_m"][1] - expected)))
        return True

    fly_now(*CROSSING, config=CONFIG, at={0.9: sink, 0.94: lambda running: running.frozen.add(1)}, until=is_late)
    return found[-1]


def test_it_is_known_how_far_a_vehicle_sinks_whose_last_setpoint_has_little_thrust() -> None:
    assert falls_off_m(is_told=True) < 0.3
    assert falls_off_m(is_told=False) > 1.0, "negative control: by its path it flies on level"
