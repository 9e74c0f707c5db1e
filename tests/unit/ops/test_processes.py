"""Which launches ask for real-time priority; what they get is in `tests/process/test_launch.py`."""

from __future__ import annotations

import os

import pytest

from swarmctl.config import load
from swarmctl.ops.processes import wants_realtime


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
    assert wants_realtime(load(None, sets)) is wanted
