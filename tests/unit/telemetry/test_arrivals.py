"""Tests that a run says whether and when each agent reached its goal, and how far is left where it did not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarmctl.config import load
from swarmctl.core.json_safe import to_json
from swarmctl.core.recorded.records import TRUTH_DTYPE
from swarmctl.core.types import Array
from swarmctl.ops.flight.summary import summary_lines
from swarmctl.telemetry.evaluation.arrivals import reached_goals
from swarmctl.telemetry.evaluation.referee import Rules, evaluate
from swarmctl.telemetry.recording.summary_file import decode_summary
from swarmctl.telemetry.report.run_report import arrival_texts, summary_rows
from tests.unit.telemetry.test_referee import run, ticks, truth

NO_TRUTH = np.zeros(0, TRUTH_DTYPE)
T_S = np.arange(0.0, 20.02, 0.02)


def north(*points: tuple[float, float]) -> Array:
    """Return positions (T, 3) on a way to the north through points (time [s], north [m])."""
    way = np.zeros((len(T_S), 3))
    way[:, 0] = np.interp(T_S, [t_s for t_s, _ in points], [north_m for _, north_m in points])
    return way


ARRIVES = ticks(20, north((0, 0), (10, 5)))
GOAL = (5.0, 0.0, 0.0)


def at_goal(rows: Any, goal: Any = GOAL, events: Any = (), true: Any = NO_TRUTH) -> dict[str, Any]:
    found = reached_goals({0: rows}, true, events, {0: goal})
    assert found is not None
    (row,) = found["agents"]
    return {**row, "reached": found["reached"], "of": found["of"]}


@pytest.mark.parametrize(
    ("rows", "reached_at_s", "left_m"),
    [
        (ARRIVES, 9.4, 0.0),  # 0.3 m before its goal, at 0.5 m/s
        (ticks(20, north((0, 0), (20, 4))), None, 1.0),
        (ticks(20, north((0, 0), (5, 5), (10, 5), (11, 8), (15, 5))), 14.6, 0.0),  # pushed away, and back for good
        (ticks(20, north((0, 0), (5, 5), (15, 5), (20, 9))), None, 4.0),  # it was there, and left
        (ticks(20, GOAL), 0.0, 0.0),
        (ticks(20, (np.nan,) * 3), None, None),
    ],
)
def test_a_goal_is_reached_when_an_agent_stays_there(rows: Any, reached_at_s: float | None, left_m: float) -> None:
    found = at_goal(rows)
    assert found["reached_at_s"] == (None if reached_at_s is None else pytest.approx(reached_at_s, abs=0.03))
    assert found["left_m"] == (None if left_m is None else pytest.approx(left_m, abs=0.01))
    assert (found["reached"], found["of"]) == (int(reached_at_s is not None), 1)


def test_true_positions_count_where_there_are_any() -> None:
    elsewhere = truth(0, T_S, north((0, 0), (10, 4)))
    assert at_goal(ARRIVES, true=elsewhere)["left_m"] == pytest.approx(1.0, abs=0.01)


def test_the_goal_is_that_of_the_mission_flown_last() -> None:
    changed = {"event": "mission_changed", "source": "agent-0", "goal_ned_m": [7.0, 0.0, 0.0]}
    assert at_goal(ARRIVES, events=[changed])["left_m"] == pytest.approx(2.0, abs=0.01)
    others = {**changed, "source": "agent-1"}
    assert at_goal(ARRIVES, events=[others])["reached"] == 1
    for none in (None, "x", [1.0, 2.0], [1.0, 2.0, None]):
        assert reached_goals({0: ARRIVES}, NO_TRUTH, [{**changed, "goal_ned_m": none}], {0: GOAL}) is None


def test_verdict_report_and_file_say_who_has_not_arrived() -> None:
    rules = Rules(agents=3, required_separation_m=0.5, goals_ned_m=(GOAL, (0.0, 3.0, 9.0), (0.0, 6.0, 0.0)))
    flown = {0: ARRIVES, 1: ticks(20, (0.0, 3.0, 1.0))}
    summary = evaluate(run(flown), rules, "failed")
    assert [row["id"] for row in summary["goals"]["agents"]] == [0, 1, 2]
    first = summary_lines(summary, Path("x"))[0]
    assert "only 1 of 3 goals reached (agent 1 is 8.00 m away, agent 2 never began)" in first
    read = decode_summary(to_json(summary).encode())
    rows = {row.name: (row.value, row.note) for row in summary_rows(read, rules)}
    assert rows["goals reached"] == ("1 of 3", "the last after 9.4 s")
    assert arrival_texts(read["goals"]) == {0: "9.4 s", 1: "8.00 m away", 2: "never began"}
    arrived = evaluate(run({0: ARRIVES}), Rules(agents=1, required_separation_m=0.5, goals_ned_m=(GOAL,)), "completed")
    assert summary_lines(arrived, Path("x"))[0].startswith("completed, 1 of 1 goals reached, the last after 9.4 s, ")


def test_a_mission_flown_for_its_way_has_no_goals() -> None:
    summary = evaluate(run({0: ARRIVES}), Rules(agents=1, required_separation_m=0.5), "completed")
    assert summary["goals"] is None
    assert "goal" not in summary_lines(summary, Path("x"))[0]
    assert not any("goal" in row.name for row in summary_rows(decode_summary(to_json(summary).encode()), None))


def test_goals_are_those_of_the_configuration() -> None:
    assert load(None).rules().goals_ned_m == (None, None, None)
    swap = load(None, ["mission.kind=swap"])
    np.testing.assert_allclose(np.array(swap.rules().goals_ned_m), np.array(swap.starts_ned_m())[::-1], atol=1e-12)
    points = "mission.waypoints.lists=[{points_ned_m=[[0, 0, -1], [4, 0, -1]]}]"
    assert load(None, ["swarm.agents=1", "mission.kind=waypoints", points]).rules().goals_ned_m == ((4.0, 0.0, -1.0),)
    shared = load(None, ["mission.kind=waypoints", points])
    assert shared.rules().goals_ned_m == (None, None, None), "they can't all be at the one end"
    one = load(None, ["mission.kind=goto", "mission.goto.goals_ned_m=[[4, 0, -1]]"])
    places = np.array(one.rules().goals_ned_m)
    assert np.linalg.norm(places - (4, 0, -1), axis=1).max() < 0.6
    assert np.linalg.norm(places[0] - places[1]) >= 0.9, "each has a place of its own"
