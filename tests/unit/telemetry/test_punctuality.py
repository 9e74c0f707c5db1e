"""One late agent among many punctual ones is found by verdict, summary and report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swarmctl.core.json_safe import to_json
from swarmctl.ops.flight.summary import summary_lines
from swarmctl.telemetry.evaluation.referee import Rules, evaluate
from swarmctl.telemetry.recording.summary_file import decode_summary
from swarmctl.telemetry.report.run_report import summary_rows
from tests.unit.telemetry.test_referee import run, ticks


@pytest.mark.parametrize(
    ("seconds", "late_01", "said"),
    [
        (12.0, 0.25, "deadline misses of agent 7 25.0% above 20.0% (150 of 601 due)"),
        (12.0, 0.19, ""),
        (9.0, 0.25, ""),
    ],
    ids=["above the limit", "below it", "short flight"],
)
def test_one_late_agent_among_many_is_judged_by_itself(seconds: float, late_01: float, said: str) -> None:
    swarm = {agent: ticks(seconds, (2.0 * agent, 0.0, 0.0)) for agent in range(12)}
    swarm[7]["deadline_misses"] = np.floor(np.arange(len(swarm[7])) * late_01)
    swarm[3]["deadline_misses"] = np.arange(len(swarm[3])) > 30
    summary = evaluate(run(swarm), Rules(agents=12, required_separation_m=0.5), "completed")
    assert summary["violations"] == ([said] if said else [])
    assert summary["outcome"] == ("failed" if said else "completed")
    timing = summary["timing"]
    assert timing["late_ticks"] / timing["due_ticks"] < 0.03, "of all together"
    late = int(swarm[7]["deadline_misses"][-1])
    assert timing["worst_agent"] == {"id": 7, "due_ticks": len(swarm[7]), "late_ticks": late}
    (line,) = (line for line in summary_lines(summary, Path("x")) if line.startswith("ticks "))
    rules = Rules(agents=12, required_separation_m=0.5)
    rows = {row.name: row for row in summary_rows(decode_summary(to_json(summary).encode()), rules)}
    shown = rows["the most of one agent"]
    assert (shown.value, shown.limit) == (f"{late} of {len(swarm[7])}, agent 7", "20%")
    assert shown.good is (None if seconds < 10.0 else not said)
    assert f" from arming on (agent-7: {late} of {len(swarm[7])} due), tick p50" in line


def test_several_late_agents_are_one_violation_and_who_is_late_with_all_others_none_more() -> None:
    swarm = {agent: ticks(12.0, (2.0 * agent, 0.0, 0.0)) for agent in range(12)}
    for agent, late_01 in ((2, 0.3), (5, 0.5)):
        swarm[agent]["deadline_misses"] = np.floor(np.arange(601) * late_01)
    (said,) = evaluate(run(swarm), Rules(agents=12, required_separation_m=0.5), "completed")["violations"]
    assert said == "deadline misses of agent 5 49.9% above 20.0% (300 of 601 due), and of 1 more agents"
    alone = {agent: swarm[agent] for agent in (2, 5)}
    rules = Rules(agents=2, required_separation_m=0.0)
    (said,) = (text for text in evaluate(run(alone), rules, "completed")["violations"] if "deadline" in text)
    assert said == "deadline misses 39.9% above 20.0% (480 of 1202 due)"


def test_a_punctual_swarm_has_no_worst_agent() -> None:
    summary = evaluate(run({0: ticks(2, (0.0, 0.0, 0.0))}), Rules(agents=1, required_separation_m=0.5), "completed")
    assert summary["timing"]["worst_agent"] is None
