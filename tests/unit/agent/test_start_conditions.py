"""What an agent says that it waits for, and for how long it says it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from swarmctl.agent.mission.start_conditions import StartConditions
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.types import Phase

SECOND = 1_000_000


@pytest.mark.parametrize(
    ("phase", "waits_for"), [(Phase.ARM, "its estimator"), (Phase.TRACK, "agent-1"), (Phase.READY, "")]
)
def test_an_agent_that_waits_no_longer_does_not_say_so(phase: Phase, waits_for: str) -> None:
    mission, alerts = SimpleNamespace(phase=Phase.STANDBY, waits_for="its estimator"), Alerts()
    conditions = StartConditions(cast(AgentSetup, None), cast(MissionState, mission), alerts)
    for now_us in range(0, 5 * SECOND, SECOND // 10):
        conditions.report(now_us)
    alert = alerts.newest(5 * SECOND)
    assert alert is not None
    assert alert.text == "waits for its estimator"
    mission.phase, mission.waits_for = phase, waits_for
    conditions.report(5 * SECOND)
    assert alerts.newest(5 * SECOND) is None
