"""Tests of an obstacle on the path that is visible only from close (thesis 4.4)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent.sensing.known_obstacles import KnownObstacles
from swarmctl.bus.messages.json_messages import ListedObstacle
from swarmctl.config import load
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, Mode, Phase
from swarmctl.errors import ConfigError
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, evaluate
from tests.closed_loop.conftest import AT_100_HZ, FINE, Flight, Fly, fly_now

CONFIG, PUBLISHED = "improved_6_obstacle.toml", "thesis_6_obstacle.toml"


@cache
def with_published_weights() -> Flight:
    """Fly from the ground and back, past the obstacle twice."""
    return fly_now(FINE, config=PUBLISHED)


def clearance_m(flight: Flight) -> float:
    center = np.array(flight.config.obstacles[0].center_ned_m)
    return float(np.linalg.norm(flight.pos_ned_m - center, axis=2).min())


@pytest.mark.parametrize("seed", [0, 1])
def test_all_keep_clear_of_the_obstacle_and_of_each_other(fly: Fly, seed: int) -> None:
    """The worst of starts 1 to 3, shifted by a millimetre, are 1.763 m and 0.908 m."""
    past = fly(FINE, "sitl.start=air", config=CONFIG, until=Lockstep.mission_is_over, seed=seed)
    assert clearance_m(past) >= 1.75
    assert past.separation_m() >= 0.89
    for agent in range(3):
        assert not past.ticks(agent)["safety_filter_acted"].any(), "the safety filter is not needed for it"
        assert past.modes(agent, Phase.TRACK) == {Mode.TRACKING}


def check_published_weights(past: Flight) -> None:
    """Check that without a weight on velocity, where agents overshoot their keep-out of 1.75 m, none touches.

    The safety filter acts. The worst of 18 starts are 1.51 m, where 1.24 m is a touch, and 0.844 m of each other.
    """
    assert past.outcomes == {"completed"}
    assert clearance_m(past) >= 1.45
    assert past.separation_m() >= 0.84


def test_with_published_weights_all_stay_off_the_obstacle_and_land() -> None:
    past = with_published_weights()
    assert past.problems == []
    check_published_weights(past)


def test_with_published_weights_all_stay_off_the_obstacle_from_starts_a_millimetre_off(fly: Fly) -> None:
    check_published_weights(fly(FINE, "sitl.start=air", config=PUBLISHED, until=Lockstep.mission_is_over, seed=1))


def test_the_obstacle_is_known_only_within_the_visibility_distance() -> None:
    flight = with_published_weights()
    for agent in range(3):
        ticks = flight.ticks(agent)
        seen = np.isfinite(ticks["nearest_obstacle_m"])
        assert seen.any()
        distance = np.linalg.norm(ticks["pos_ned_m"] - np.array(flight.config.obstacles[0].center_ned_m), axis=1)
        assert distance[seen].max() < 3.0


def test_negative_control_unseen_it_is_hit(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    def is_hit(running: Lockstep) -> bool:
        center = np.array(running.config.obstacles[0].center_ned_m)
        apart_m = np.linalg.norm(running.world.truth_rows()["pos_ned_m"] - center, axis=1)
        return bool(apart_m.min() < running.config.obstacles[0].radius_m)

    monkeypatch.setattr(KnownObstacles, "visible", lambda *_: {})
    blind = fly("sitl.start=air", config=PUBLISHED, until=is_hit)  # after 4.4 s
    assert clearance_m(blind) < 1.0


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
@pytest.mark.parametrize("speed_m_s", [0.5, 1.0])
def test_a_column_that_comes_straight_at_a_hovering_agent_is_passed(speed_m_s: float, mode: str) -> None:
    """Fled from straight back, at 1 m/s it came to 0.53 m of who commits to come to rest."""
    hover = (AT_100_HZ, "mission.kind=hover", "mission.duration_s=30", "sitl.start=air", f"separation.mode={mode}")
    flight = Lockstep(load(None, ("swarm.agents=1", "start.positions_ned_m=[[0,0,-5]]", *hover)))
    while not flight.logs[0].rows or flight.logs[0].rows[-1]["phase"][0] != Phase.TRACK:
        flight.step()
    begun_us, away_m, least_m = flight.clock.now_us(), 6.5, np.inf  # out of sight
    column = Obstacle(
        center_ned_m=(away_m, 0.0, 0.0),
        column=True,
        radius_m=0.24,
        keep_out_m=1.0,
        visibility_m=6.0,
        vel_ned_m_s=(-speed_m_s, 0.0, 0.0),
    )
    flight.set_obstacles([column])
    while (since_s := (flight.clock.now_us() - begun_us) * 1e-6) < 1.5 * away_m / speed_m_s:
        flight.step()
        north_m, east_m, _ = flight.world.truth_rows()[0]["pos_ned_m"]
        least_m = min(least_m, float(np.hypot(north_m - away_m + since_s * speed_m_s, east_m)))
    assert least_m >= 0.9
    assert north_m > -1.5, "it is not driven along"
    assert not flight.logs[0].ticks["safety_filter_acted"].any()


PAST_A_BALL = (  # nine metres north, a ball half way
    "swarm.agents=1",
    "sitl.start=air",
    "start.positions_ned_m=[[0,0,-3]]",
    "mission.kind=goto",
    "mission.goto.goals_ned_m=[[9,0,-3]]",
    "mission.duration_s=8",
)
BALL = Obstacle(center_ned_m=(4.5, 0.4, -3.0), radius_m=1.75, keep_out_m=1.75, visibility_m=3.0)


def summary_past(ball: Obstacle, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Fly past a ball of any sizes, also such as no list of obstacles may have, and return the referee's summary."""
    at = ListedObstacle(number=0, since_utc_us=0, obstacle=ball)
    with monkeypatch.context() as patch:
        patch.setattr(KnownObstacles, "visible", lambda known, pos, utc_us: _seen(at, pos, utc_us))
        flight = fly_now(*PAST_A_BALL, until=Lockstep.mission_is_over)
    rules = replace(flight.config.rules("lockstep"), obstacles=(JudgedObstacle(number=0, obstacle=ball),))
    return evaluate(flight.lockstep.recorded(), rules, "completed")


def _seen(item: ListedObstacle, pos_ned_m: Array, utc_us: int) -> dict[int, Obstacle]:
    there = item.at(utc_us)
    return {item.number: there} if there.distance_m(pos_ned_m) < there.visibility_m else {}


def test_no_vehicle_enters_a_body_that_is_as_large_as_its_keep_out(monkeypatch: pytest.MonkeyPatch) -> None:
    summary = summary_past(BALL, monkeypatch)
    assert summary["outcome"] == "completed"
    assert summary["obstacles"]["min_clearance_m"] >= BALL.radius_m


def test_negative_control_a_body_larger_than_its_keep_out_is_entered_and_the_referee_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(ConfigError, match="less than radius_m = 3"):
        fly_now(*PAST_A_BALL, "obstacles=[{center_ned_m=[4.5,0.4,-3],radius_m=3}]")
    summary = summary_past(BALL.model_copy(update={"radius_m": 3.0}), monkeypatch)
    assert BALL.keep_out_m < summary["obstacles"]["min_clearance_m"] < 2.9, "more than 0.1 m inside of the body"
    assert summary["outcome"] == "failed"
    assert any("below 3 m between agent 0 and obstacle 0" in violation for violation in summary["violations"])
