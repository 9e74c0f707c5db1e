"""No order and no fate of messages leads three agents to commitments in conflict; without one rule of theirs it does.

The agents are the code that flies, with symbols in place of trajectories; `tools/explore_protocol.py` explores farther.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from sitl.studies.protocol.agent import Rules
from sitl.studies.protocol.explorer import Explorer
from sitl.studies.protocol.removed_rules import REMOVED, Removed
from sitl.studies.protocol.scopes import SCOPES

TOOL = Path(__file__).parents[3] / "tools" / "explore_protocol.py"
UNTIL_FOUND = 99


def test_two_agents_that_meet_and_a_third_that_only_answers_are_explored_completely() -> None:
    explored = Explorer(SCOPES["two propose once"]).explore(UNTIL_FOUND)
    assert explored.is_complete and explored.violation == ()
    assert (explored.states, explored.depth) == (2195, 12)


@pytest.mark.parametrize(
    ("scope", "depth", "states"),
    [
        ("two propose twice", 7, 5595),
        ("all propose twice", 5, 2868),
        ("two of three meet", 4, 1338),
        ("one follows another", 5, 646),
        ("one excluded", 5, 3424),
        ("one interrupted", 6, 4829),
        ("all excluded", 3, 1146),
        ("all interrupted", 5, 4680),
        ("two stop", 5, 44242),
    ],
)
def test_no_two_commitments_conflict(scope: str, depth: int, states: int) -> None:
    explored = Explorer(SCOPES[scope]).explore(depth)
    assert explored.violation == ()
    assert (explored.depth, explored.states) == (depth, states)


@pytest.mark.parametrize("removed", [each for each in REMOVED if each.is_needed], ids=lambda each: each.rule)
def test_negative_control_without_one_rule_two_do(removed: Removed) -> None:
    found = Explorer(removed.scope, removed.rules).explore(UNTIL_FOUND, max_states=100_000)
    assert found.violation
    if removed.rules != Rules():
        assert Explorer(removed.scope).explore(found.depth, max_states=5_000).violation == (), "as they are"


def test_the_tool_prints_states_and_depth(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    command = [str(TOOL), "--depth", "5", "--scope", "two propose once", "--no-removed"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(TOOL), run_name="__main__")
    assert ended.value.code == 0
    assert "148" in capsys.readouterr().out
