"""Which launches ask for real-time priority, and what is read of a process's output."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from swarmctl.config import load
from swarmctl.ops.processes import Child, Command, wants_realtime


@pytest.mark.parametrize(
    ("processors", "sets", "wanted"),
    [
        (2, ("swarm.agents=4",), True),
        (2, ("swarm.agents=5",), False),  # they could leave nothing for a shell
        (1, ("swarm.agents=2",), True),
        (8, ("swarm.agents=3", "agent.realtime=false"), False),
    ],
)
def test_real_time_priority_is_wanted_where_processors_suffice(
    monkeypatch: pytest.MonkeyPatch, processors: int, sets: tuple[str, ...], wanted: bool
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(processors)))
    config = load(None, sets)
    assert wants_realtime(config, range(config.swarm.agents)) is wanted


def test_the_last_words_of_a_process_control_no_terminal(tmp_path: Path) -> None:
    script = "print('\\x1b]0;owned\\x07\\n'); raise SystemExit(4)"
    child = Child(Command("x", (sys.executable, "-Sc", script)), tmp_path)
    assert child.wait(60.0)
    assert child.how_it_ended() == r"ended with exit code 4: \x1b]0;owned\x07"
    assert child.line_with("owned") == r"\x1b]0;owned\x07"
