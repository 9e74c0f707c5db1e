"""Which launches ask for real-time priority, and what is read of a process's output."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from swarmctl.config import load
from swarmctl.ops.processes import Child, Command, RunContext, agent_commands, crowding_warning, wants_realtime


@pytest.mark.parametrize(
    ("processors", "sets", "wanted"),
    [
        (2, ("swarm.agents=4",), True),
        (2, ("swarm.agents=5",), False),  # they could leave nothing for a shell
        (1, ("swarm.agents=2",), True),
        (2, ("swarm.agents=20", "swarm.agents_per_process=10"), True),  # each has a processor, or gives the priority up
        (2, ("swarm.agents=20", "swarm.agents_per_process=9"), False),
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


def test_a_process_whose_log_can_not_be_opened_runs_without_it(tmp_path: Path) -> None:
    """As in a run folder that was removed, or on a disk without room: vehicles are landed all the same."""
    child = Child(Command("x", (sys.executable, "-Sc", "print('lost'); raise SystemExit(4)")), tmp_path / "removed")
    assert child.wait(60.0)
    assert child.how_it_ended() == "ended with exit code 4"


def test_who_has_got_the_number_of_a_process_that_ended_is_not_killed_in_its_place(tmp_path: Path) -> None:
    child = Child(Command("x", (sys.executable, "-Sc", "")), tmp_path)
    assert child.wait(60.0)
    other = Child(Command("y", (sys.executable, "-Sc", "import time; time.sleep(60)")), tmp_path)
    child.pid = other.pid
    child.kill_all()
    assert not other.wait(0.5)
    other.kill_all()
    assert other.wait(60.0), "its own number is its own"


@pytest.mark.parametrize(
    ("agents", "most", "shares"),
    [
        (3, 1, [(0,), (1,), (2,)]),
        (12, 6, [tuple(range(6)), tuple(range(6, 12))]),
        (7, 3, [(0, 1), (2, 3), (4, 5, 6)]),  # three processes do, none of which has much more than others
        (2, 5, [(0, 1)]),
    ],
)
def test_agents_share_processes_as_they_are_told(
    tmp_path: Path, agents: int, most: int, shares: list[tuple[int, ...]]
) -> None:
    config = load(None, (f"swarm.agents={agents}", f"swarm.agents_per_process={most}"))
    commands = agent_commands(config, RunContext("run", "endpoint", tmp_path, tuple(range(agents))), ())
    assert [command.agents for command in commands] == shares
    for command in commands:
        ids = [command.argv[i + 1] for i, word in enumerate(command.argv) if word == "--id"]
        assert ids == [str(agent) for agent in command.agents]
    assert len({command.name for command in commands}) == len(commands)


@pytest.mark.parametrize(
    ("agents", "sets", "share"),
    [
        (6, (), ""),
        (7, (), "swarm.agents_per_process=4 "),
        (12, (), "swarm.agents_per_process=6 "),
        (12, ("swarm.agents_per_process=6",), ""),
        (12, ("swarm.agents_per_process=1",), "swarm.agents_per_process=6 "),
        (12, ("swarm.agents_per_process=2",), ""),
        (14, ("swarm.agents_per_process=2",), "swarmctl simulate"),
        (20, (), "swarmctl simulate"),
    ],
)
def test_a_crowd_of_processes_is_warned_of(
    monkeypatch: pytest.MonkeyPatch, agents: int, sets: tuple[str, ...], share: str
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    lines = crowding_warning(load(None, (f"swarm.agents={agents}", *sets)), range(agents))
    assert len(lines) == bool(share)
    assert all(share in line for line in lines)


@pytest.mark.parametrize(
    ("processors", "sets", "wanted"),
    [
        ({0, 1, 2, 5}, ("swarm.agents=6", "agent.pinned=true"), [5, 2, 1, 0, 5, 2]),
        ({0, 1, 2, 5}, ("swarm.agents=6", "agent.pinned=true", "swarm.agents_per_process=3"), [5, 2]),
        ({0, 1, 2, 5}, ("swarm.agents=2",), [None, None]),
    ],
)
def test_processes_of_agents_are_bound_to_processors_in_turns(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, processors: set[int], sets: tuple[str, ...], wanted: list[int]
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: processors)
    config = load(None, sets)
    context = RunContext("run", "endpoint", tmp_path, tuple(range(config.swarm.agents)))
    assert [command.processor for command in agent_commands(config, context, ())] == wanted
    warned = [line for line in crowding_warning(config, context.agents) if "agent.pinned" in line]
    assert len(warned) == (len(wanted) >= len(processors))


@pytest.mark.skipif(sys.platform != "linux", reason="no other system binds")
def test_a_bound_process_runs_on_its_processor_with_all_its_threads(tmp_path: Path) -> None:
    script = "import os, threading; t = threading.Thread(target=lambda: print(os.sched_getaffinity(0))); t.start()"
    mine = min(os.sched_getaffinity(0))
    child = Child(
        Command("x", (sys.executable, "-Sc", f"import time; time.sleep(0.2); {script}"), processor=mine), tmp_path
    )
    assert child.wait(60.0)
    assert child.last_line() == f"{{{mine}}}"


@pytest.mark.parametrize("is_wanted", [True, False])
def test_a_recovery_has_the_priority_of_its_launch(tmp_path: Path, is_wanted: bool) -> None:
    """One agent alone would always be few enough, and compute before all that fly."""
    config = load(None, ("swarm.agents=9",))
    context = RunContext("run", "endpoint", tmp_path, tuple(range(9)), realtime=is_wanted)
    (command,) = agent_commands(config, replace(context, agents=(3,)), ())
    assert ("--realtime" in command.argv, "--no-realtime" in command.argv) == (is_wanted, not is_wanted)
