"""What keeps a vehicle on the ground before its mission, besides what its autopilot and its peers say."""

from __future__ import annotations

from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.collision.separation import radius_problem
from swarmctl.control.estimation.accuracy import AccuracyMonitor
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.types import Phase

_START_ALERT_DELAY_US = 3_000_000  # time on the ground after which the unmet condition is raised as an alert


class StartConditions:
    """Judges the estimate's accuracy before the start, and tells what the agent waits for.

    Args:
        setup: the distances that the accuracy has to suffice for.
        mission: phase, and what it waits for.
        alerts: are told what it waits for.
    """

    def __init__(self, setup: AgentSetup, mission: MissionState, alerts: Alerts) -> None:
        self._setup, self._mission, self._alerts = setup, mission, alerts
        self._accuracy = AccuracyMonitor()
        self._waits_since_us = 0

    def unsettled(self, now_us: int, pos_accuracy_m: float | None) -> str:
        """Return why arming must wait: the estimator still settles, or is too inaccurate for the separation; or ""."""
        if len(self._setup.starts_ned_m) == 1 or self._mission.phase > Phase.STANDBY:
            return ""
        self._accuracy.update(now_us, pos_accuracy_m)
        accuracy_m = self._accuracy.worst_m or 0.0  # if not reported, only body size and tracking error are checked
        return self._accuracy.unsettled(now_us) or radius_problem(
            self._setup.separation, accuracy_m, self._setup.drift_m
        )

    def report(self, now_us: int) -> None:
        """Raise the unmet condition as an alert once the agent has waited for a while; clear it once it is met."""
        waits_for, may_wait = self._mission.waits_for, self._mission.phase in (Phase.STANDBY, Phase.READY)
        if not may_wait:
            self._waits_since_us = now_us
        if not (may_wait and waits_for):
            self._alerts.clear("start")
        elif now_us - self._waits_since_us > _START_ALERT_DELAY_US:
            self._alerts.put("start", f"waits for {waits_for}", now_us)
