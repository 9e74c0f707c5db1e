"""Tests that agents are not silent while the process that watches them does not run."""

from __future__ import annotations

import pytest

from swarmctl.ops.supervision.own_pause import OwnPause
from swarmctl.ops.supervision.status_table import AgentView
from tests import builders


@pytest.mark.parametrize(("paused_s", "excused_s"), [(0.4, 0.0), (7.0, 7.0)])
def test_a_pause_of_the_watching_process_is_nobodys_silence(paused_s: float, excused_s: float) -> None:
    heard = AgentView(agent=0, status=builders.status_message(), received_s=99.0)
    never_heard, not_noted = AgentView(agent=1, received_s=90.0), AgentView(agent=2)
    pause, views = OwnPause(100.0), (heard, never_heard, not_noted)
    pause.excuse(100.0 + paused_s, views)
    pause.excuse(100.1 + paused_s, views)
    assert [view.received_s for view in views] == pytest.approx([99.0 + excused_s, 90.0 + excused_s, 0.0])
    assert not_noted.silent_s == 0.0
