"""What is told of an own controller: what it raised, and how much of a mission it has flown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from swarmctl.agent.watches.controller_watch import ControllerWatch
from swarmctl.core.types import Phase, Plan, PlanStatus
from swarmctl.ops.flight.summary import summary_lines
from swarmctl.telemetry.evaluation.run_counts import own_controllers

BUILT_IN = Plan(
    status=PlanStatus.OK,
    t0_us=0,
    dt_us=20_000,
    pos_ned_m=np.zeros((2, 3)),
    vel_ned_m_s=np.zeros((2, 3)),
    virtual_control=np.zeros((1, 3)),
)


def test_only_ticks_of_missions_in_which_its_own_plan_is_flown_count() -> None:
    watch = ControllerWatch("b1:SlidingMode", lambda *_, **__: None)
    own = replace(BUILT_IN, by_own=True)
    for phase, plan, flown in (
        (Phase.GOTO_START, BUILT_IN, BUILT_IN),  # no mission
        (Phase.TRACK, own, own),
        (Phase.TRACK, BUILT_IN, BUILT_IN),  # the fallback flies
        (Phase.TRACK, own, None),  # a pilot does
        (Phase.TRACK, own, replace(own)),  # an earlier plan is flown again
        (Phase.TRACK, None, None),
        (Phase.GOTO_LAND, BUILT_IN, BUILT_IN),
    ):
        watch.count(phase, plan, flown)
    assert watch.summary == {"controller": "b1:SlidingMode", "flown_ticks": 1, "mission_ticks": 5}
    assert ControllerWatch("", lambda *_, **__: None).summary == {}


def test_a_traceback_is_recorded_in_the_middle_of_an_encounter_too() -> None:
    told: list[tuple[str, dict[str, Any]]] = []
    watch = ControllerWatch("b1:SlidingMode", lambda name, **fields: told.append((name, fields)))
    watch.update(replace(BUILT_IN, failure="plans too close"))
    watch.update(replace(BUILT_IN, failure="raised KeyError", traceback="File b1.py"))
    watch.update(replace(BUILT_IN, failure="raised KeyError"))
    raised = ("controller_raised", {"traceback": "File b1.py"})
    assert told == [("controller_failed", {"begins": True, "why": "plans too close"}), raised]


def test_the_summary_says_how_much_of_the_mission_an_own_controller_flew() -> None:
    events: list[dict[str, Any]] = [
        {"event": "controller_summary", "source": f"agent-{agent}", "controller": "b1:SlidingMode"}
        | {"flown_ticks": flown, "mission_ticks": 500}
        for agent, flown in enumerate((500, 499))
    ]
    counted = own_controllers([{"event": "phase", "source": "agent-0"}, *events])
    assert counted == [{"name": "b1:SlidingMode", "flown_ticks": 999, "mission_ticks": 1000}]
    lines = summary_lines({"own_controllers": counted}, Path("runs/x"))
    assert lines[-2] == "b1:SlidingMode flew 999 of 1000 mission ticks"
    assert len(summary_lines({"own_controllers": own_controllers([])}, Path("runs/x"))) == 5, "nothing of built-in ones"
    hostile = [{**events[0], "flown_ticks": "x", "controller": None, "mission_ticks": float("nan")}]
    assert own_controllers(hostile) == [{"name": "None", "flown_ticks": 0, "mission_ticks": 0}]
