"""What a full disk has cost is named; what a killed or stopped process leaves out is not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.core.types import Phase
from swarmctl.telemetry.evaluation.referee import Rules, RunData, evaluate
from tests.unit.telemetry.test_referee import run, ticks, truth

END_S = 30.0


def flown(apart_m: float = 2.0) -> dict[int, NDArray[np.void]]:
    """Return numbered ticks of two agents."""
    found = {agent: ticks(END_S, (0.0, agent * apart_m, 0.0)) for agent in (0, 1)}
    for rows in found.values():
        rows["seq"] = np.arange(len(rows))
    return found


def true_states(*spans: tuple[float, float]) -> list[NDArray[np.void]]:
    """Return true states of both vehicles in spans of mission time."""
    t_s = np.concatenate([np.arange(begin, end + 0.001, 0.02) for begin, end in spans])
    return [truth(vehicle, t_s, (0.0, vehicle * 2.0, 0.0)) for vehicle in (0, 1)]


def violations(data: RunData, ground_z_m: float | None = None) -> list[str]:
    rules = Rules(agents=2, required_separation_m=0.5, ground_z_m=ground_z_m)
    found: list[str] = evaluate(data, rules, "completed")["violations"]
    return found


def cut(rows: NDArray[np.void], begin_s: float, end_s: float) -> NDArray[np.void]:
    """Return ticks without those of an interval."""
    kept: NDArray[np.void] = rows[(rows["mission_t_s"] <= begin_s) | (rows["mission_t_s"] >= end_s)]
    return kept


def test_what_was_recorded_as_a_whole_is_judged() -> None:
    assert violations(run(flown(), *true_states((0.0, END_S)))) == []


@pytest.mark.parametrize(
    ("spans", "told"),
    [
        ([(0.0, 20.0)], "for 10.0 s, from 20.0 s on"),
        ([(0.0, 12.0), (17.0, END_S)], "for 5.0 s, from 12.0 s on"),
    ],
)
def test_true_states_that_are_missing_while_the_simulator_is_heard_are_named(spans: Any, told: str) -> None:
    (only,) = violations(run(flown(), *true_states(*spans)))
    assert told in only
    assert "can't be judged" in only


@pytest.mark.parametrize("end_s", [20.0, END_S])
def test_a_simulator_that_was_killed_or_stopped_has_lost_nothing(end_s: float) -> None:
    by_agent = flown()
    for rows in by_agent.values():  # what it has told last grows old
        silent = (rows["mission_t_s"] > 20.3) & (rows["mission_t_s"] < 25.0)
        rows["state_age_ms"][silent] = (rows["mission_t_s"][silent] - 20.3) * 1e3
    again = [(25.0, END_S)] if end_s == END_S else []
    kept = by_agent if again else {agent: cut(rows, 24.9, END_S + 1.0) for agent, rows in by_agent.items()}
    assert violations(run(kept, *true_states((0.0, 20.0), *again))) == []


def test_an_agent_that_was_killed_or_stopped_has_lost_nothing() -> None:
    by_agent = flown()
    killed, stopped = cut(by_agent[0], 9.0, END_S + 1.0), cut(by_agent[1], 12.0, 15.0)
    stopped["seq"] = np.arange(len(stopped))
    assert violations(run({0: killed, 1: stopped}, *true_states((0.0, END_S)))) == []


def test_ticks_that_were_run_and_not_recorded_are_named_and_tell_of_true_states() -> None:
    by_agent = {agent: cut(rows, 20.0, 28.0) for agent, rows in flown().items()}
    found = violations(run(by_agent, *true_states((0.0, END_S))))
    assert [text.split(" could")[0] for text in found] == ["399 ticks of agent 0", "399 ticks of agent 1"]
    *_, last = violations(run(by_agent, *true_states((0.0, 20.0), (28.0, END_S))))
    assert "true states could not be recorded for 8.0 s, from 20.0 s on" in last


def test_few_ticks_and_those_on_the_ground_may_be_missing() -> None:
    by_agent = flown()
    by_agent[0] = cut(by_agent[0], 20.0, 20.2)
    by_agent[1]["armed"][by_agent[1]["mission_t_s"] > 19.0] = 0
    by_agent[1] = cut(by_agent[1], 20.0, 28.0)
    assert violations(run(by_agent, *true_states((0.0, END_S)))) == []


def test_an_agent_without_ticks_is_named_once_somebody_flew() -> None:
    (only,) = violations(run({0: flown()[0]}, *true_states((0.0, END_S))))
    assert only == "agent 1 has recorded no tick: how it was flown can't be judged"
    waiting = ticks(END_S, (0.0, 0.0, 0.0))
    waiting["phase"], waiting["armed"] = Phase.STANDBY, 0
    standing = [truth(vehicle, np.arange(0, END_S, 0.02), (0.0, vehicle * 2.0, 0.0), 0) for vehicle in (0, 1)]
    assert not any("tick" in text for text in violations(run({0: waiting}, *standing)))


def test_nobody_crashes_by_where_he_was_after_a_gap() -> None:
    spans = true_states((0.0, 10.0), (20.0, END_S))
    for rows in spans:
        rows["pos_ned_m"][rows["t_us"] < rows["t_us"][0] + 15_000_000, 2] = -2.0
    by_agent = {agent: cut(rows, 10.1, 20.1) for agent, rows in flown().items()}
    for rows in by_agent.values():
        rows["phase"][rows["mission_t_s"] > 15.0] = Phase.LAND
    assert not any("touched the ground" in text for text in violations(run(by_agent, *spans), ground_z_m=0.0))
