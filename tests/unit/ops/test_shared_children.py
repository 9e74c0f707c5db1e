"""Agents of one process as their supervisor sees them: each ends as it says, or with the process."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import pytest

from swarmctl.ops.processes import Command
from swarmctl.ops.shared_children import SharedAgent, start_agents

SAYS = """
import os, signal, sys, time
fd = int(sys.argv[-1])
def land(*_):
    os.write(fd, b'{"agent":1,"exit_code":130}\\n')
    sys.exit(0)
signal.signal(signal.SIGTERM, land)
print('of the process', flush=True)
os.write(fd, b'{"agent":0,"exit_code":4,"words":"silent"}\\n')
"""
WAIT_S = 30.0


def started(script: str, directory: Path) -> tuple[SharedAgent, SharedAgent]:
    _, (first, second) = start_agents(Command("agents-0-1", (sys.executable, "-Sc", script), (), (0, 1)), directory)
    return first, second


def until_ended(agent: SharedAgent) -> int:
    deadline_s = time.monotonic() + WAIT_S
    while (code := agent.poll()) is None:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    return code


def test_one_agent_ends_and_the_other_flies_on_until_it_is_sent_a_signal(tmp_path: Path) -> None:
    first, second = started(SAYS + "time.sleep(60)", tmp_path)
    assert (first.agents, second.agents) == ((0,), (1,))
    assert until_ended(first) == 4
    assert first.ended_s is not None
    assert (first.last_line(), first.how_it_ended()) == ("silent", "ended with exit code 4: silent")
    assert second.poll() is None
    first.signal(signal.SIGTERM)  # it has ended: the others are not to land
    first.kill_all()
    time.sleep(0.3)
    assert second.poll() is None
    second.signal(signal.SIGTERM)
    assert until_ended(second) == 130
    assert first.poll() == 4
    assert second.wait(WAIT_S)


@pytest.mark.parametrize(
    ("rest", "code"), [("os.kill(os.getpid(), signal.SIGKILL)", 137), ("sys.exit(3)", 3), ("sys.exit(0)", 1)]
)
def test_who_has_said_nothing_ends_as_the_process_does_and_never_well(tmp_path: Path, rest: str, code: int) -> None:
    first, second = started(SAYS + rest, tmp_path)
    assert until_ended(second) == code
    assert first.poll() == 4, "it has said so before"
    assert ("SIGKILL" in second.how_it_ended()) == (code == 137)
    assert second.last_line() == "of the process"


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_no_descriptor_is_left_where_nothing_was_started_or_everything_has_ended(tmp_path: Path) -> None:
    before = descriptors()
    with pytest.raises(Exception, match="can't be started"):
        start_agents(Command("agents-0-1", (str(tmp_path / "absent"),), (), (0, 1)), tmp_path)
    first, second = started(SAYS + "sys.exit(3)", tmp_path)
    until_ended(second)
    assert first.wait(WAIT_S)
    assert descriptors() <= before
