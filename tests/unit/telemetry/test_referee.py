"""Tests of the referee on runs small enough to judge by hand; every claim fails when its rule is disabled."""

from __future__ import annotations

import inspect
import json
import math
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.studies.sweep.figures import FIGURES
from swarmctl.core.flight_volume import FlightVolume, VolumeParams
from swarmctl.core.json_safe import to_json
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import TICK_DTYPE, TRUTH_DTYPE
from swarmctl.core.types import Mode, Phase, PlanStatus
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules, RunData, evaluate
from swarmctl.telemetry.evaluation.run_counts import deadlock_counts
from swarmctl.telemetry.evaluation.tracks import merge_tracks, track_error, unseen_spans
from swarmctl.telemetry.recording.summary_file import decode_summary
from swarmctl.telemetry.report import run_report
from swarmctl.telemetry.report.run_report import summary_rows

UTC0_US = 1_780_000_000_000_000
START_US = 1_000_000  # monotonic time of mission start


def ticks(seconds: float, pos_ned_m: Any, first_s: float = 0.0, rate_hz: int = 50) -> NDArray[np.void]:
    """Return mission ticks of an agent whose reference stays at the origin; `pos_ned_m` (3,) or (T, 3)."""
    t_s = first_s + np.arange(round(seconds * rate_hz) + 1) / rate_hz
    rows = np.zeros(len(t_s), TICK_DTYPE)
    rows["t_us"] = START_US + np.round(t_s * 1e6).astype(np.int64)
    rows["utc_us"] = rows["t_us"] + UTC0_US
    rows["mission_t_s"] = t_s
    rows["phase"], rows["mode"], rows["armed"] = Phase.TRACK, Mode.TRACKING, 1
    rows["pos_ned_m"] = pos_ned_m
    rows["q_nb"][:, 0] = 1.0
    rows["iterations"], rows["solve_ms"], rows["tick_ms"], rows["plan_staleness_ms"] = 25, 2.0, 4.0, 30.0
    return rows


def truth(vehicle: int, t_s: Any, pos_ned_m: Any, armed: Any = 1) -> NDArray[np.void]:
    """Return true states at mission times `t_s`."""
    rows = np.zeros(len(t_s), TRUTH_DTYPE)
    rows["t_us"] = START_US + np.round(np.asarray(t_s) * 1e6).astype(np.int64)
    rows["vehicle"], rows["pos_ned_m"], rows["armed"] = vehicle, pos_ned_m, armed
    return rows


def run(by_agent: dict[int, NDArray[np.void]], *true: NDArray[np.void], events: Any = ()) -> RunData:
    return RunData(by_agent, np.concatenate([np.zeros(0, TRUTH_DTYPE), *true]), list(events))


APART = {0: ticks(20, (1.0, 0.0, 0.0)), 1: ticks(20, (0.0, 0.0, 2.0))}


def test_a_host_judges_the_distances_of_its_own_agents() -> None:
    rules, of_three = Rules(agents=3, required_separation_m=0.5), run(APART)
    (problem,) = evaluate(of_three, rules, "failed")["violations"][:1]
    assert "agent 2 can't be judged" in problem
    started = {"event": "started", "agents": [0, 1]}
    of_host = evaluate(run(APART, events=[started]), rules, "completed")
    assert (of_host["violations"], of_host["separation"]["min_pair"]) == ([], [0, 1])
    assert evaluate(run(APART, events=[{**started, "agents": []}]), rules, "failed")["violations"], "as the station's"


def test_who_was_flown_without_is_named_and_not_judged() -> None:
    without = {"event": "flown_without", "agents": [2]}
    summary = evaluate(run(APART, events=[without]), Rules(agents=3, required_separation_m=0.5), "completed")
    assert (summary["outcome"], summary["violations"], summary["without"]) == ("completed", [], [2])
    assert summary["separation"]["min_pair"] == [0, 1]


def test_summed_mean_tracking_error_is_the_sum_of_mean_distances() -> None:
    tracking = evaluate(run(APART), Rules(agents=2, required_separation_m=0.5), "completed")["tracking"]
    assert tracking["index_m"] == pytest.approx(1.0 + 2.0)
    assert tracking["agents"][0]["mse_m2"] == pytest.approx([1.0, 0.0, 0.0])
    assert tracking["agents"][1]["mean_distance_m"] == pytest.approx(2.0)
    assert tracking["agents"][1]["rmse_m"] == pytest.approx(2.0)
    assert [row["id"] for row in tracking["agents"]] == [0, 1]


def test_mean_and_rmse_of_a_changing_error() -> None:
    pos = np.zeros((101, 3))
    pos[:, 1] = np.where(np.arange(101) % 2 == 0, 3.0, 1.0)  # 51 times 3 m, 50 times 1 m
    row = evaluate(run({0: ticks(2, pos)}), Rules(agents=1, required_separation_m=0.5), "completed")["tracking"][
        "agents"
    ][0]
    assert row["mean_distance_m"] == pytest.approx((51 * 3 + 50) / 101)
    assert row["mse_m2"][1] == pytest.approx((51 * 9 + 50) / 101)
    assert row["rmse_m"] == pytest.approx(math.sqrt((51 * 9 + 50) / 101))


def test_summed_mean_tracking_error_counts_only_common_time() -> None:
    late = ticks(20, (2.0, 0.0, 0.0))
    late["pos_ned_m"][late["mission_t_s"] > 10.0] = (100.0, 0.0, 0.0)
    both = {0: late, 1: ticks(10, (0.0, 1.0, 0.0))}
    assert evaluate(run(both), Rules(agents=2, required_separation_m=0.5), "failed")["tracking"][
        "index_m"
    ] == pytest.approx(3.0)


def test_summed_mean_tracking_error_is_unknown_when_an_agent_never_tracked() -> None:
    assert (
        evaluate(run({0: APART[0]}), Rules(agents=2, required_separation_m=0.5), "failed")["tracking"]["index_m"]
        is None
    )


def test_steady_figures_leave_out_the_first_ten_seconds() -> None:
    rows = ticks(20, (5.0, 0.0, 0.0))
    rows["pos_ned_m"][rows["mission_t_s"] >= 10.0] = (0.1, 0.0, 0.0)
    tracking = evaluate(run({0: rows}), Rules(agents=1, required_separation_m=0.5), "completed")["tracking"]
    assert tracking["agents"][0]["steady_rmse_m"] == pytest.approx(0.1)
    assert tracking["index_after_10s_m"] == pytest.approx(0.1)
    assert (
        evaluate(run({0: ticks(5, (5.0, 0, 0))}), Rules(agents=1, required_separation_m=0.5), "completed")["tracking"][
            "index_after_10s_m"
        ]
        is None
    )


def test_truth_wins_over_reports_and_is_interpolated() -> None:
    t_s = np.arange(0, 10.01, 0.1)
    moving = np.column_stack([t_s, np.full_like(t_s, 0.25), 0 * t_s])  # 1 m/s north, 0.25 m east of the reference
    rows = ticks(10, (9.0, 9.0, 9.0))
    rows["ref_pos_ned_m"][:, 0] = rows["mission_t_s"]
    row = evaluate(run({0: rows}, truth(0, t_s, moving)), Rules(agents=1, required_separation_m=0.5), "completed")[
        "tracking"
    ]["agents"][0]
    assert row["mse_m2"] == pytest.approx([0.0, 0.0625, 0.0], abs=1e-9)


def closing(least_m: float) -> RunData:
    """Return ticks of two agents whose distance falls from 2 m to `least_m` at 5 s and grows again."""
    t_s = np.arange(0, 10.001, 0.01)
    gap = least_m + np.abs(t_s - 5.0) * (2.0 - least_m) / 5.0
    other = np.column_stack([gap, 0 * gap, 0 * gap])
    both = {0: ticks(10, (1.0, 0.0, 0.0)), 1: ticks(10, (0.0, 0.0, 2.0))}
    return run(both, truth(0, t_s, (0.0, 0.0, 0.0)), truth(1, t_s, other))


def test_separation_names_value_limit_pair_and_time() -> None:
    summary = evaluate(closing(0.61), Rules(agents=2, required_separation_m=0.85), "completed")
    assert summary["separation"]["min_m"] == pytest.approx(0.61)
    assert summary["separation"]["min_pair"] == [0, 1]
    assert summary["separation"]["min_at_s"] == pytest.approx(5.0)
    assert summary["violations"] == ["separation 0.610 m below 0.85 m between agents 0 and 1 at 5.0 s"]
    assert summary["outcome"] == "failed"


def test_separation_with_scaled_heights_is_reported_beside_the_true_one() -> None:
    t_s = np.arange(0, 5.001, 0.01)
    low, high = truth(0, t_s, (0.0, 0.0, 0.0)), truth(1, t_s, (0.3, 0.0, -1.6))
    found = evaluate(run(APART, low, high), Rules(agents=2, required_separation_m=0.85, downwash=2.0), "completed")[
        "separation"
    ]
    assert found["min_m"] == pytest.approx(math.hypot(0.3, 1.6))
    assert found["scaled_min_m"] == pytest.approx(math.hypot(0.3, 0.8))
    same = evaluate(run(APART, low, high), Rules(agents=2, required_separation_m=0.85), "completed")["separation"]
    assert same["scaled_min_m"] == pytest.approx(same["min_m"])


CROSSING_S = np.arange(0, 5.001, 0.02)
CROSSES = np.column_stack([6.0 * (CROSSING_S - 2.51), 0.0 * CROSSING_S, 0.0 * CROSSING_S])  # amid two instants


def test_vehicles_that_pass_between_two_instants_are_judged_where_they_are_nearest() -> None:
    other = -CROSSES + [0.0, 0.48, 0.0]
    crossing = run(APART, truth(0, CROSSING_S, CROSSES), truth(1, CROSSING_S, other))
    summary = evaluate(crossing, Rules(agents=2, required_separation_m=0.49, downwash=2.0), "completed")
    found = summary["separation"]
    assert (found["min_m"], found["scaled_min_m"]) == (pytest.approx(0.48, abs=1e-6), pytest.approx(0.48, abs=1e-6))
    assert found["min_at_s"] == pytest.approx(2.52)
    assert summary["outcome"] == "failed"


def test_nothing_is_known_between_instants_that_do_not_follow_each_other() -> None:
    around = np.abs(CROSSING_S - 2.51) > 0.1
    other = -CROSSES + [0.0, 0.48, 0.0]
    gap = run(APART, truth(0, CROSSING_S[around], CROSSES[around]), truth(1, CROSSING_S[around], other[around]))
    found = evaluate(gap, Rules(agents=2, required_separation_m=0.49), "completed")["separation"]
    assert found["min_m"] == pytest.approx(np.hypot(0.48, 12.0 * 0.11), abs=0.01)


def test_an_obstacle_that_is_passed_between_two_instants_is_judged_where_it_is_nearest() -> None:
    ball = Obstacle(center_ned_m=(0.0, 1.005, 0.0), radius_m=0.8, keep_out_m=1.006)
    rules = Rules(
        agents=1,
        required_separation_m=0.5,
        obstacles=(JudgedObstacle(number=0, obstacle=ball),),
        obstacle_margin_m=0.0,
    )
    summary = evaluate(run({0: ticks(5, (0, 0, 0))}, truth(0, CROSSING_S, CROSSES)), rules, "completed")
    assert summary["obstacles"]["min_clearance_m"] == pytest.approx(1.005, abs=1e-6)
    assert any("obstacle clearance 1.005 m" in text for text in summary["violations"])


@pytest.mark.parametrize(("least_m", "limit_m", "outcome"), [(0.86, 0.85, "completed"), (0.84, 0.85, "failed")])
def test_separation_decides_the_outcome(least_m: float, limit_m: float, outcome: str) -> None:
    assert evaluate(closing(least_m), Rules(agents=2, required_separation_m=limit_m), "completed")["outcome"] == outcome


def test_separation_counts_from_first_arming_to_the_very_end() -> None:
    t_s = np.arange(0, 3.001, 0.1)
    near = np.column_stack([np.where(t_s < 1.0, 0.1, 1.0), 0 * t_s, 0 * t_s])
    armed = (t_s >= 0.999).astype(int)
    waiting = ticks(3, (0, 0, 0))
    waiting["phase"], waiting["armed"] = Phase.STANDBY, 0
    touching_before = run({0: waiting, 1: waiting}, truth(0, t_s, (0, 0, 0), armed), truth(1, t_s, near, armed))
    assert evaluate(touching_before, Rules(agents=2, required_separation_m=0.5), "completed")["violations"] == []
    disarmed_after = run({}, truth(0, t_s, (0, 0, 0), t_s < 0.05), truth(1, t_s, near[::-1], 0))
    assert evaluate(disarmed_after, Rules(agents=2, required_separation_m=0.5), "completed")["separation"][
        "min_m"
    ] == pytest.approx(0.1)


def test_reports_of_two_hosts_are_joined_by_utc() -> None:
    first, second = ticks(10, (0.0, 0.0, 0.0)), ticks(10, (0.0, 0.0, 0.0))
    second["t_us"] += 77_000_000  # another host's monotonic clock
    second["utc_us"] += 7_000  # and ticks between the first one's
    second["pos_ned_m"][:, 0] = 1.0 + 0.01 * second["mission_t_s"]
    separation = evaluate(run({0: first, 1: second}), Rules(agents=2, required_separation_m=0.5), "completed")[
        "separation"
    ]
    assert separation["min_m"] == pytest.approx(1.0, abs=1e-3)


def test_positions_that_were_never_recorded_are_no_pass() -> None:
    summary = evaluate(run({0: APART[0]}), Rules(agents=2, required_separation_m=0.85), "completed")
    assert summary["separation"]["min_m"] is None
    assert summary["outcome"] == "failed"
    assert "can't be judged" in summary["violations"][0]


@pytest.mark.parametrize("outcome", ["interrupted", "failed"])
def test_who_ended_before_anybody_was_armed_has_no_distances_to_judge(outcome: str) -> None:
    waiting = ticks(3, (math.nan, 0.0, 0.0))
    waiting["phase"], waiting["armed"] = Phase.STANDBY, 0
    rules = Rules(agents=2, required_separation_m=0.5)
    for by_agent in ({}, {0: waiting}, {0: waiting, 1: waiting}):
        assert evaluate(run(by_agent), rules, outcome)["violations"] == []
    armed = ticks(3, (math.nan, 0.0, 0.0))
    assert "separation of agent 0 can't be judged" in evaluate(run({0: armed}), rules, outcome)["violations"][0]


@pytest.mark.parametrize(("margin_m", "violated"), [(0.05, True), (0.3, False)])
def test_obstacle_clearance_allows_its_margin_only(margin_m: float, violated: bool) -> None:
    rules = Rules(
        agents=1,
        required_separation_m=0.5,
        obstacles=(JudgedObstacle(number=0, obstacle=Obstacle(center_ned_m=(1.5, 0.0, 0.0))),),
        obstacle_margin_m=margin_m,
    )
    summary = evaluate(run({0: ticks(5, (0.0, 0.0, 0.0))}), rules, "completed")
    assert summary["obstacles"] == {"min_clearance_m": 1.5, "required_m": 1.75 - margin_m, "nearest_m": 1.5}
    assert (summary["outcome"] == "failed") == violated
    assert any("between agent 0 and obstacle 0" in text for text in summary["violations"]) == violated


def test_the_nearest_obstacle_need_not_be_the_one_with_the_least_margin() -> None:
    small = Obstacle(center_ned_m=(0.6, 0.0, 0.0), radius_m=0.2, keep_out_m=0.5)
    large = Obstacle(center_ned_m=(3.05, 0.0, 0.0), radius_m=1.0, keep_out_m=3.0, visibility_m=5.0)
    judged = tuple(JudgedObstacle(number=i, obstacle=obstacle) for i, obstacle in enumerate((small, large)))
    rules = Rules(agents=1, required_separation_m=0.5, obstacles=judged, obstacle_margin_m=0.0)
    summary = evaluate(run({0: ticks(5, (0.0, 0.0, 0.0))}), rules, "completed")
    found = {"min_clearance_m": pytest.approx(3.05), "required_m": 3.0, "nearest_m": pytest.approx(0.6)}
    assert summary["obstacles"] == found
    (clearance,) = (figure for figure in FIGURES if figure.name == "min_clearance_m")
    assert clearance.of(summary) == pytest.approx(0.6), "a sweep's smallest distance to a centre"


@pytest.mark.parametrize(("column", "clearance_m"), [(True, 1.5), (False, 2.5)])
def test_height_does_not_count_beside_a_column(column: bool, clearance_m: float) -> None:
    ball = Obstacle(center_ned_m=(1.5, 0.0, 2.0), column=column)
    rules = Rules(agents=1, required_separation_m=0.5, obstacles=(JudgedObstacle(number=0, obstacle=ball),))
    summary = evaluate(run({0: ticks(5, (0.0, 0.0, 0.0))}), rules, "completed")
    assert summary["obstacles"]["min_clearance_m"] == pytest.approx(clearance_m)
    assert (summary["outcome"] == "failed") == column


@pytest.mark.parametrize(("distance_m", "outcome"), [(0.97, "failed"), (1.01, "completed")])
def test_the_margin_of_a_keep_out_does_not_reach_into_the_body(distance_m: float, outcome: str) -> None:
    ball = Obstacle(center_ned_m=(distance_m, 0.0, 0.0), radius_m=1.0, keep_out_m=1.0)
    rules = Rules(agents=1, required_separation_m=0.5, obstacles=(JudgedObstacle(number=0, obstacle=ball),))
    summary = evaluate(run({0: ticks(5, (0.0, 0.0, 0.0))}), rules, "completed")
    assert summary["obstacles"]["required_m"] == 1.0
    assert summary["outcome"] == outcome


def test_moving_obstacle_is_met_where_it_is_at_the_time() -> None:
    ball = Obstacle(center_ned_m=(10.0, 0.0, 0.0), keep_out_m=1.0, vel_ned_m_s=(-1.0, 0.0, 0.0))
    rules = Rules(agents=1, required_separation_m=0.5, obstacles=(JudgedObstacle(number=0, obstacle=ball),))
    assert evaluate(run({0: ticks(5, (0, 0, 0))}), rules, "completed")["obstacles"]["min_clearance_m"] == pytest.approx(
        5.0
    )
    assert evaluate(run({0: ticks(9.5, (0, 0, 0))}), rules, "completed")["outcome"] == "failed"


def test_whoever_leaves_the_flight_volume_is_named_from_its_start_to_its_landing() -> None:
    corners = ((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0))
    volume = FlightVolume(VolumeParams(corners_ne_m=corners, floor_z_m=1.0, ceiling_z_m=-3.0))
    rules = Rules(agents=1, required_separation_m=0.5, volume=volume)
    rows = ticks(20, (0.0, 0.0, -1.0))
    rows["phase"][rows["mission_t_s"] < 5.0] = Phase.GOTO_START
    rows["phase"][rows["mission_t_s"] > 15.0] = Phase.LAND
    rows["pos_ned_m"][rows["phase"] != Phase.TRACK] = (0.0, 0.0, 2.0)  # below the floor, as every vehicle on the ground
    summary = evaluate(run({0: rows}), rules, "completed")
    assert summary["volume"] == {"least_inside_m": 2.0, "margin_m": 0.3}
    assert summary["violations"] == []
    rows["pos_ned_m"][rows["mission_t_s"] == 8.0] = (0.0, -2.25, -1.0)
    summary = evaluate(run({0: rows}), rules, "completed")
    assert summary["volume"]["least_inside_m"] == pytest.approx(-0.25)
    assert summary["outcome"] == "failed"
    assert "agent 0 0.250 m outside of the flight volume (side 0) at 8.0 s" in summary["violations"]
    alone = Rules(agents=1, required_separation_m=0.5)
    assert evaluate(run({0: rows}), alone, "completed")["volume"] is None


def test_obstacle_set_in_flight_counts_from_then_on() -> None:
    rows = ticks(10, (0.0, 0.0, 0.0))
    rows["pos_ned_m"][rows["mission_t_s"] >= 4.0] = (50.0, 0.0, 0.0)
    ball = Obstacle(center_ned_m=(0.0, 0.0, 0.0), keep_out_m=1.0)
    since_us = UTC0_US + START_US + 5_000_000
    judged = JudgedObstacle(number=3, obstacle=ball, since_utc_us=since_us)
    rules = Rules(agents=1, required_separation_m=0.5, obstacles=(judged,))
    assert evaluate(run({0: rows}), rules, "completed")["outcome"] == "completed"
    assert (
        evaluate(
            run({0: rows}),
            Rules(agents=1, required_separation_m=0.5, obstacles=(JudgedObstacle(number=0, obstacle=ball),)),
            "completed",
        )["outcome"]
        == "failed"
    )


def test_a_configured_obstacle_moves_from_the_first_tick_on_not_from_arming_or_the_mission() -> None:
    ball = Obstacle(center_ned_m=(12.0, 0.0, 0.0), keep_out_m=1.0, vel_ned_m_s=(-1.0, 0.0, 0.0))
    rows = ticks(9.5, (0.0, 0.0, 0.0))
    before = rows[:150].copy()  # 3 s on the ground
    before["t_us"], before["utc_us"] = before["t_us"] - 3_000_000, before["utc_us"] - 3_000_000
    before["mission_t_s"], before["armed"] = np.nan, 0
    rules = Rules(agents=1, required_separation_m=0.5, obstacles=(JudgedObstacle(number=0, obstacle=ball),))
    clearance = [
        evaluate(run({0: flown}), rules, "completed")["obstacles"]["min_clearance_m"]
        for flown in (rows, np.concatenate([before, rows]))
    ]
    assert clearance == pytest.approx([2.5, 0.0], abs=0.05)


def test_an_obstacle_that_was_removed_counts_until_then() -> None:
    ball = Obstacle(center_ned_m=(10.0, 0.0, 0.0), keep_out_m=1.0, vel_ned_m_s=(-1.0, 0.0, 0.0))
    rows = ticks(20, (0.0, 0.0, 0.0))
    began_us = UTC0_US + START_US
    for until_s, violated in ((8.0, False), (9.5, True), (15.0, True)):
        until_us = began_us + round(until_s * 1e6)
        judged = JudgedObstacle(number=7, obstacle=ball, since_utc_us=began_us, until_utc_us=until_us)
        summary = evaluate(run({0: rows}), Rules(agents=1, required_separation_m=0.5, obstacles=(judged,)), "completed")
        assert any("agent 0 and obstacle 7" in text for text in summary["violations"]) is violated, until_s


def test_timing_counts_flight_ticks_and_deadline_misses() -> None:
    rows = ticks(2, (0.0, 0.0, 0.0))  # 101 ticks
    rows["phase"][:10] = Phase.STANDBY
    rows["deadline_misses"] = 3 + np.clip(np.arange(101) - 40, 0, 30)  # 30 during the flight, one after the other
    rows["tick_ms"] = 4.0
    rows["tick_ms"][60] = 9.0
    rows["solve_ms"][70], rows["iterations"][70] = 99.0, 0  # nothing was solved in this tick
    summary = evaluate(
        run({0: rows}),
        Rules(agents=1, required_separation_m=0.5, deadline_misses_01=0.2),
        "completed",
        speed_factor=8.0,
    )
    timing = summary["timing"]
    assert (timing["ticks"], timing["late_ticks"], timing["speed_factor"]) == (91, 30, 8.0)
    assert timing["tick_ms"] == {"p50": 4.0, "p99": pytest.approx(4.5), "max": 9.0}
    assert timing["solve_ms"]["max"] == 2.0
    assert summary["violations"] == ["deadline misses 33.0% above 20.0% (30 of 91 due)"]
    assert (
        evaluate(run({0: rows}), Rules(agents=1, required_separation_m=0.5, deadline_misses_01=0.4), "completed")[
            "violations"
        ]
        == []
    )


def test_ticks_that_were_skipped_were_due() -> None:
    rows = ticks(2, (0.0, 0.0, 0.0))  # 101 ticks
    rows["deadline_misses"] = 3 * np.arange(101)  # each of them late, and two skipped before it
    summary = evaluate(run({0: rows}), Rules(agents=1, required_separation_m=0.5, deadline_misses_01=0.2), "completed")
    assert (summary["timing"]["ticks"], summary["timing"]["due_ticks"]) == (101, 301)
    assert summary["violations"] == ["deadline misses 99.7% above 20.0% (300 of 301 due)"]


def vanishing(heard: bool) -> RunData:
    """Agent 1 flies past the position of agent 0 at 5 s. Unless `heard`, agent 0 repeats its state of 5 s from then."""
    passing, seen = ticks(20, (0.0, 0.0, 0.0)), ticks(20, (0.0, 0.0, 0.0))
    t_s = passing["mission_t_s"]
    seen["pos_ned_m"][:, 0] = np.minimum(t_s, 20.0 if heard else 5.0)  # 1 m/s north
    seen["state_age_ms"] = 0.0 if heard else np.maximum(0.0, t_s - 5.0) * 1e3
    passing["pos_ned_m"] = np.column_stack([np.full_like(t_s, 5.0), 10.4 - t_s, 0 * t_s])  # 0.4 m beside it at 10 s
    passing["pos_ned_m"][:, 1] = np.maximum(passing["pos_ned_m"][:, 1], 0.4)
    return run({0: seen, 1: passing})


def test_a_vehicle_counts_as_unseen_from_its_last_known_position_to_the_next() -> None:
    """One tick after a stall of 0.36 s knows no position, and lasts no time itself."""
    stalled = np.delete(ticks(20, (0.0, 0.0, 0.0)), slice(500, 517))
    stalled["pos_ned_m"][500] = math.nan
    unseen = evaluate(run({0: stalled}), Rules(agents=1, required_separation_m=0.85), "failed")["violations"]
    assert "agent 0 did not know where its armed vehicle was for 0.4 s, from 10.0 s on" in unseen[0]


def test_ticks_that_are_missing_in_flight_hide_no_loss_of_separation() -> None:
    """Agent 1 flies through the place of agent 0 within 0.8 s, in which one of them has recorded nothing."""
    still, passing = ticks(20, (0.0, 0.0, 0.0)), ticks(20, (0.0, 0.0, 0.0))
    passing["pos_ned_m"][:, 0] = 4.0 * (passing["mission_t_s"] - 10.0)
    rules = Rules(agents=2, required_separation_m=0.85)
    seen = evaluate(run({0: still, 1: passing}), rules, "completed")
    assert seen["separation"]["min_m"] == pytest.approx(0.0)
    lost = np.delete(passing, slice(480, 520))
    (hidden,) = evaluate(run({0: still, 1: lost}), rules, "completed")["violations"]
    assert hidden.startswith("agent 1 did not know where its armed vehicle was for 0.8 s, from 9.6 s on")
    lost["armed"] = 0
    assert evaluate(run({0: still, 1: lost}), rules, "completed")["violations"] == [], "it stands"


@pytest.mark.parametrize(("missing", "age_ms", "is_hidden"), [(23, 0.0, False), (24, 0.0, False), (24, 60.0, True)])
def test_what_can_not_be_interpolated_is_unseen_and_nothing_else(missing: int, age_ms: float, is_hidden: bool) -> None:
    """A state of the last tick before the gap may be older than those after it."""
    rows = np.delete(ticks(20, (0.0, 0.0, 0.0)), slice(500, 500 + missing))
    rows["state_age_ms"][499] = age_ms
    tracks = merge_tracks({0: rows}, np.zeros(0, TRUTH_DTYPE), 1)
    assert np.isnan(tracks.pos_ned_m[:, 0]).any() == is_hidden
    assert bool(unseen_spans(rows, "utc_us")) is is_hidden


def test_states_too_far_apart_are_unseen_from_the_older_one_on() -> None:
    """Every state is younger than 0.5 s at its tick, and 0.52 s pass between two of them."""
    late = ticks(20, (0.0, 0.0, 0.0))
    late["state_age_ms"][500:526] = 20.0 * np.arange(26)
    unseen = evaluate(run({0: late}), Rules(agents=1, required_separation_m=0.85), "failed")["violations"]
    assert "agent 0 did not know where its armed vehicle was for 0.5 s, from 10.0 s on" in unseen[0]


def test_a_vanished_vehicle_is_named_and_not_judged_by_its_last_position() -> None:
    summary = evaluate(vanishing(heard=False), Rules(agents=2, required_separation_m=0.85), "failed")
    assert summary["separation"]["min_m"] == pytest.approx(5.4)  # at 5 s, the last that is known
    assert summary["violations"] == [
        "agent 0 did not know where its armed vehicle was for 14.5 s, from 5.5 s on: its separation can't be judged"
    ]
    assert evaluate(vanishing(heard=True), Rules(agents=2, required_separation_m=0.85), "failed")["separation"][
        "min_m"
    ] == pytest.approx(3.83, abs=0.02)


def test_a_reported_state_counts_at_its_own_time() -> None:
    delayed, still = ticks(10, (0.0, 0.0, 0.0)), ticks(10, (10.0, 0.0, 0.0))
    delayed["state_age_ms"] = 200.0
    delayed["pos_ned_m"][:, 0] = delayed["mission_t_s"] - 0.2  # 1 m/s north, reported 200 ms later
    pair = evaluate(run({0: delayed, 1: still}), Rules(agents=2, required_separation_m=0.1), "failed")["separation"]
    assert pair["min_m"] == pytest.approx(0.2, abs=0.03)
    assert pair["min_at_s"] == pytest.approx(9.8, abs=0.03)


@pytest.mark.parametrize(("age_ms", "error_m"), [(0.0, 0.05), (10.0, 0.0)])
def test_a_reported_state_is_compared_with_the_reference_of_its_own_time(age_ms: float, error_m: float) -> None:
    rows = ticks(20, (0.0, 0.0, 0.0))
    rows["ref_pos_ned_m"][:, 0] = 5.0 * rows["mission_t_s"]
    rows["pos_ned_m"][:, 0] = 5.0 * (rows["mission_t_s"] - 0.01)
    rows["state_age_ms"] = age_ms
    tracking = evaluate(run({0: rows}), Rules(agents=1, required_separation_m=0.5), "completed")["tracking"]
    assert tracking["index_after_10s_m"] == pytest.approx(error_m, abs=1e-4)


def test_clocks_of_different_years_have_no_common_instants() -> None:
    other = ticks(10, (5.0, 0.0, 0.0))
    other["utc_us"] -= UTC0_US
    summary = evaluate(
        run({0: ticks(10, (0.0, 0.0, 0.0)), 1: other}), Rules(agents=2, required_separation_m=0.5), "completed"
    )
    assert "can't be judged" in summary["violations"][0]


def test_solver_failures_count_while_the_agent_has_control() -> None:
    rows = ticks(2, (0.0, 0.0, 0.0))
    rows["plan_status"][:4] = [PlanStatus.SOLVER_FAILED, PlanStatus.RESIDUAL, PlanStatus.NOT_CERTIFIED, PlanStatus.NONE]
    rows["plan_status"][10], rows["mode"][10] = PlanStatus.SOLVER_FAILED, Mode.PILOT_OVERRIDE
    rows["residual_m"] = 1e-4
    rows["residual_m"][0] = 7.0  # refused, never flown
    rows["safety_filter_acted"][5:8] = 1
    solver = evaluate(run({0: rows}), Rules(agents=1, required_separation_m=0.5, solver_name="daqp"), "completed")[
        "solver"
    ]
    assert solver == {
        "name": "daqp",
        "retry": "osqp",
        "failed": 2,
        "not_certified": 1,
        "max_residual_m": pytest.approx(1e-4),
        "safety_filter_ticks": 3,
    }


def sent(messages: int, size: int) -> dict[str, dict[str, int]]:
    return {"path": {"messages": messages, "bytes": size}}


def test_refused_messages_are_summed_over_each_agents_last_summary() -> None:
    events = [
        {"source": "agent-0", "event": "bus_summary", "rejected": {"stale": 1}},
        {"source": "agent-0", "event": "bus_summary", "rejected": {"stale": 3, "identity": 1}, "sent": sent(2, 900)},
        {
            "source": "agent-1",
            "event": "bus_summary",
            "rejected": {"stale": 4},
            "sent": sent(1, 100) | {"far_path": {"messages": 2, "bytes": 30}, "tick": {"messages": 9, "bytes": 7000}},
        },
        {"source": "agent-1", "event": "other", "rejected": {"stale": 100}},
        {"source": "agent-0", "event": "link_summary", "refused": {"unsigned": 2}},
        {"source": "agent-1", "event": "link_summary", "refused": {"unsigned": 3, "old": 1}},
    ]
    comms = evaluate(run(APART, events=events), Rules(agents=2, required_separation_m=0.5), "completed")["comms"]
    assert comms["path_age_ms"] == {"p50": 30.0, "p99": 30.0}
    assert comms["rejected"] == {"identity": 1, "stale": 7}
    assert comms["sent"]["path"] == sent(3, 1000)["path"], "of all agents"
    assert comms["sent"]["tick"] == {"messages": 9, "bytes": 7000}
    assert comms["sent_by"] == {
        "agent-0": {"messages": 2, "bytes": 900, "path_bytes": 900},
        "agent-1": {"messages": 12, "bytes": 7130, "path_bytes": 130},
    }
    assert comms["refused_frames"] == {"old": 1, "unsigned": 5}


def refused(by: int, reason: str, count: int, sender: str = "agent-1", topic: str = "path") -> dict[str, Any]:
    return {
        "source": f"agent-{by}",
        "event": "refused",
        "sender": sender,
        "topic": topic,
        "reason": reason,
        "count": count,
    }


def test_forged_messages_are_a_violation_and_network_faults_are_not() -> None:
    network = [refused(0, "late", 4000), refused(0, "replayed", 900), refused(0, "unconfirmed", 70)]
    clumsy = [refused(0, "malformed", 50), refused(0, "stale_order", 3, "operator", "command")]
    summary = evaluate(run(APART, events=network + clumsy), Rules(agents=2, required_separation_m=0.5), "completed")
    assert (summary["outcome"], summary["violations"]) == ("completed", [])
    forged = [
        refused(0, "boot", 1),
        refused(2, "boot", 3),
        refused(0, "boot", 2),
        refused(0, "sequence", 1, topic="status"),
    ]
    summary = evaluate(
        run(APART, events=network + clumsy + forged), Rules(agents=2, required_separation_m=0.5), "completed"
    )
    assert summary["outcome"] == "failed"
    assert summary["violations"] == [
        "messages in the name of agent-1 were refused (path boot 5, status sequence 1) by agent-0, agent-2"
    ]


@pytest.mark.parametrize(
    ("topic", "reason", "few", "many"),
    [
        ("obstacles", "future", 5, 6),
        ("obstacles", "late", 5, 6),
        ("obstacles", "malformed", 5, 6),
        ("obstacles", "sequence", 0, 1),
        ("command", "sequence", 0, 1),
        ("ended", "identity", 0, 1),
    ],
)
def test_what_is_refused_of_an_operator_or_a_computer_is_a_violation_as_of_an_agent(
    topic: str, reason: str, few: int, many: int
) -> None:
    for sender in ("operator", "alpha"):
        for count, found in ((few, 0), (many, 1)):
            events = [refused(0, reason, count, sender, topic)]
            summary = evaluate(run(APART, events=events), Rules(agents=2, required_separation_m=0.5), "completed")
            told = f"messages in the name of {sender} were refused ({topic} {reason} {count}) by agent-0"
            assert summary["violations"] == [told] * found


def test_the_peer_unresponsive_for_longest_is_named() -> None:
    def row(by: int, agent: int, at_s: float, **fields: Any) -> dict[str, Any]:
        return {"source": f"agent-{by}", "event": "unresponsive", "agent": agent, "utc_us": round(at_s * 1e6), **fields}

    ended = [row(0, 1, 10.0, begins=True), row(0, 1, 12.0, begins=False, lasted_s=2.5)]
    comms = evaluate(run(APART, events=ended), Rules(agents=2, required_separation_m=0.5), "completed")["comms"]
    assert comms["unresponsive"] == {"count": 1, "longest_s": 2.5, "agent": 1, "by": "agent-0"}
    lasting = [row(1, 0, 11.0, begins=True), {"event": "state", "utc_us": 52_000_000}]
    comms = evaluate(run(APART, events=ended + lasting), Rules(agents=2, required_separation_m=0.5), "completed")[
        "comms"
    ]
    assert comms["unresponsive"] == {"count": 2, "longest_s": 41.0, "agent": 0, "by": "agent-1"}


def test_sessions_of_the_bus_that_were_replaced_are_counted() -> None:
    events = [{"source": source, "event": "bus_reopened", "count": 1} for source in ("launch", "agent-1")]
    comms = evaluate(run(APART, events=events), Rules(agents=2, required_separation_m=0.5), "completed")["comms"]
    assert comms["reopened"] == 2


def test_with_true_states_an_unresponsive_peer_is_timed_on_their_clock() -> None:
    row = {"source": "agent-0", "event": "unresponsive", "agent": 1, "utc_us": 90_000_000, "t_us": 11_000_000}
    events = [row | {"begins": True}, {"event": "state", "utc_us": 40_000_000, "t_us": 52_000_000}]
    recorded = run(APART, *(truth(i, [0.0, 1.0], np.zeros((2, 3))) for i in (0, 1)), events=events)
    comms = evaluate(recorded, Rules(agents=2, required_separation_m=0.5), "completed")["comms"]
    assert comms["unresponsive"]["longest_s"] == 41.0


@pytest.mark.parametrize(
    ("outcome", "problems", "judged"),
    [
        ("completed", (), "completed"),
        ("completed", ("agent 1 exited with code -9",), "failed"),
        ("interrupted", (), "interrupted"),
        ("failed", (), "failed"),
    ],
)
def test_outcome(outcome: str, problems: tuple[str, ...], judged: str) -> None:
    summary = evaluate(run(APART), Rules(agents=2, required_separation_m=0.5), outcome, problems)
    assert summary["outcome"] == judged
    assert summary["violations"] == list(problems)


def test_deadlocks_are_counted() -> None:
    noted = [("begins", True), ("lasted_s", 2.5), ("begins", True)]
    events = [{"event": "deadlock", "source": "agent-0", name: value} for name, value in noted]
    summary = evaluate(
        run(APART, events=[{"event": "state"}, *events]), Rules(agents=2, required_separation_m=0.5), "completed"
    )
    assert summary["deadlocks"] == {"count": 2, "longest_s": 2.5, "unresolved": 1}
    assert evaluate(run(APART), Rules(agents=2, required_separation_m=0.5), "completed")["deadlocks"]["count"] == 0


def test_a_deadlock_whose_begin_was_not_recorded_leaves_none_unresolved() -> None:
    """A station that comes later hears its end alone; -1 was a summary that nothing could read."""
    ends = {"event": "deadlock", "begins": False, "lasted_s": 4.2}
    events = [{"source": "agent-0", **ends}, {"source": "agent-1", "event": "deadlock", "begins": True}]
    assert deadlock_counts(events) == {"count": 2, "longest_s": 4.2, "unresolved": 1}


def test_a_mission_that_was_changed_in_flight_counts_with_its_own_duration() -> None:
    rules = Rules(agents=2, required_separation_m=0.5, duration_s=38.0)
    changed = [
        {"event": "mission_changed", "source": f"agent-{agent}", "duration_s": duration_s}
        for agent, duration_s in ((0, 5.0), (0, 20.5), (1, 30.0))
    ]
    summary = evaluate(run(APART, events=changed), rules, "completed")
    assert summary["violations"] == ["mission time 20.0 s of agent 1 below 30 s"]


def test_a_mission_that_begins_again_goes_on_in_time_and_is_judged_by_its_own() -> None:
    first, second = ticks(12, (1.0, 0.0, 0.0)), ticks(6, (3.0, 0.0, 0.0))
    second["t_us"] += 12_020_000
    second["utc_us"] += 12_020_000
    rows = np.concatenate([first, second])
    error = track_error(rows, truth(0, [], np.zeros((0, 3)))[:0], 0)
    assert np.diff(error.mission_t_s) == pytest.approx(0.02)
    assert error.mission_t_s[-1] == pytest.approx(18.02)
    assert error.tracked_s == pytest.approx(6.0)
    changed = [{"event": "mission_changed", "source": "agent-0", "duration_s": 6.0}]
    rules = Rules(agents=1, required_separation_m=0.5, duration_s=38.0)
    summary = evaluate(run({0: rows}, events=changed), rules, "completed")
    assert summary["violations"] == [], "the second is complete"
    after_10s_m = (100 * 1.0 + 301 * 3.0) / 401  # two seconds of the first, then all of the second
    assert summary["tracking"]["index_after_10s_m"] == pytest.approx(after_10s_m, rel=1e-2)


def test_mission_cut_short_is_no_pass() -> None:
    assert (
        evaluate(run(APART), Rules(agents=2, required_separation_m=0.5, duration_s=20.5), "completed")["outcome"]
        == "completed"
    )
    summary = evaluate(run(APART), Rules(agents=2, required_separation_m=0.5, duration_s=38.0), "completed")
    assert summary["violations"][0] == "mission time 20.0 s of agent 0 below 38 s"
    assert (
        evaluate(run(APART), Rules(agents=2, required_separation_m=0.5, duration_s=38.0), "interrupted")["violations"]
        == []
    )


@pytest.mark.parametrize("has_truth", [False, True])
def test_a_mission_that_ends_far_from_its_reference_under_an_own_controller_is_no_pass(has_truth: bool) -> None:
    rules, own = Rules(agents=1, required_separation_m=0.5), {"event": "controller_summary", "source": "agent-0"}

    def violations(left_m: float, *events: dict[str, Any]) -> list[str]:
        rows, t_s = ticks(20, (0.0, 0.0, 0.0)), np.arange(0, 21, 0.02)
        rows["pos_ned_m"][:, 0] = rows["mission_t_s"] * left_m / 20.0
        true = [truth(0, t_s, np.column_stack([t_s * left_m / 20.0, 0 * t_s, 0 * t_s]))] if has_truth else []
        found: list[str] = evaluate(run({0: rows}, *true, events=events), rules, "completed")["violations"]
        return found

    assert violations(46.0, own | {"controller": "own:Away"}) == [
        "controller own:Away left agent 0 46.0 m from its reference"
    ]
    assert violations(3.4, own) == []
    assert violations(46.0) == [], "built-in ones are judged by the figures alone"


def test_diverged_truth_is_no_pass() -> None:
    t_s = np.arange(0, 1, 0.1)
    broken = np.where(t_s[:, None] > 0.5, np.nan, np.zeros((10, 3)))
    summary = evaluate(run({}, truth(0, t_s, broken)), Rules(agents=1, required_separation_m=0.5), "completed")
    assert summary["outcome"] == "failed"
    assert any("not a number" in text for text in summary["violations"])


@pytest.mark.parametrize("data", [run({}), run({0: ticks(0, (0, 0, 0))[:0]}), run(APART)], ids=["none", "empty", "run"])
def test_summary_holds_no_nan_and_every_contract_key(data: RunData) -> None:
    summary = evaluate(data, Rules(agents=2, required_separation_m=0.85), "interrupted")

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    again = json.loads(to_json(summary), parse_constant=refuse)
    assert {"outcome", "violations", "agents", "duration_s", "mode"} <= set(again)
    assert set(again["separation"]) >= {"min_m", "required_m"}
    assert set(again["obstacles"]) == {"min_clearance_m", "required_m", "nearest_m"}
    counted = {"ticks", "due_ticks", "late_ticks", "worst_agent"}
    assert set(again["timing"]) == counted | {"tick_ms", "solve_ms", "speed_factor"}
    assert set(again["solver"]) >= {"name", "failed", "max_residual_m"}
    assert set(again["comms"]) == {
        "path_age_ms",
        "sent",
        "sent_by",
        "rejected",
        "refused_frames",
        "unresponsive",
        "reopened",
    }


def test_the_report_of_a_summary_that_was_written_has_the_rows_of_the_run() -> None:
    obstacle = JudgedObstacle(number=1, obstacle=Obstacle(center_ned_m=(9.0, 0.0, 0.0), radius_m=1.0))
    rules = Rules(agents=2, required_separation_m=0.5, obstacles=(obstacle,), goals_ned_m=((1.0, 0.0, 0.0), None))
    events = [
        {"event": "unresponsive", "source": "agent-0", "agent": 1, "utc_us": 10_000_000, "begins": True},
        {"event": "unresponsive", "source": "agent-0", "agent": 1, "utc_us": 12_500_000, "lasted_s": 2.5},
        {"event": "deadlock", "source": "agent-0", "begins": True},
        {"event": "deadlock", "source": "agent-0", "lasted_s": 1.5},
        {"event": "controller_summary", "source": "agent-0", "controller": "own", "flown_ticks": 3, "mission_ticks": 4},
        refused(0, "late", 2, "agent-1", "path"),
        {"event": "bus_summary", "source": "agent-0", "rejected": {"late": 2}},
    ]
    summary = evaluate(run(APART, events=events), rules, "completed", speed_factor=3.0)
    summary["clocks"] = [{"id": 0, "ahead_s": 0.0}, {"id": 1, "ahead_s": 0.5}]
    summary["timing"]["worst_agent"] = {"id": 1, "due_ticks": 600, "late_ticks": 5}
    rows = list(summary_rows(summary, rules))
    assert list(summary_rows(decode_summary(to_json(summary).encode()), rules)) == rows
    everything = set(re.findall(r'(?:SummaryRow|_least)\(\s*f?"([^"{]+)', inspect.getsource(run_report)))
    shown = [row.name for row in rows]
    assert [name for name in everything if not any(row.startswith(name) for row in shown)] == []


GROUNDED = Rules(agents=1, required_separation_m=0.5, ground_z_m=2.0)


def fallen(mode: Mode = Mode.TRACKING, phase: Phase = Phase.TRACK, tilt_rad: float = 0.0, down_m: float = 0.0) -> Any:
    """The violations of a vehicle that is so from 5 s on, for half a second, in truth and by its autopilot."""
    rows = ticks(20, (0.0, 0.0, 0.0))
    late = (rows["mission_t_s"] >= 5.0) & (rows["mission_t_s"] < 5.5)
    rows["mode"][late], rows["phase"][late] = mode, phase
    rows["q_nb"][late, 0], rows["q_nb"][late, 1] = math.cos(tilt_rad / 2), math.sin(tilt_rad / 2)
    rows["pos_ned_m"][late, 2] = down_m
    return evaluate(run({0: rows}, truth(0, rows["mission_t_s"], rows["pos_ned_m"])), GROUNDED, "completed")[
        "violations"
    ]


def test_a_vehicle_that_its_agent_flies_to_the_ground_or_that_turns_over_has_crashed() -> None:
    assert fallen() == fallen(tilt_rad=1.0) == fallen(down_m=1.9) == []
    assert fallen(tilt_rad=1.6) == ["agent 0 turned over at 5.0 s"]
    assert fallen(down_m=1.99) == ["agent 0 touched the ground in flight, at 5.0 s"]
    assert fallen(down_m=2.0, phase=Phase.GOTO_LAND) == fallen(down_m=2.0)
    assert fallen(down_m=2.0, tilt_rad=1.6, mode=Mode.PILOT_OVERRIDE) == []
    assert fallen(Mode.IDLE, Phase.LAND, down_m=2.0) == []
    assert fallen(Mode.IDLE, Phase.LAND, down_m=2.0, tilt_rad=1.6) == ["agent 0 turned over at 5.0 s"], "whoever lands"
    assert fallen(Mode.IDLE, Phase.DONE, down_m=2.0, tilt_rad=1.6) == [], "somebody may carry it"
