"""What keeps a vehicle on the ground before its mission, besides what its autopilot and its peers say."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.bus.bus import agent_name
from swarmctl.control.collision.separation import radius_problem
from swarmctl.control.estimation.accuracy import AccuracyMonitor
from swarmctl.control.failsafe.overload import Readiness
from swarmctl.control.phases.departure import is_beyond_reach
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.control.reference.landing_places import nearest_in_plane_m
from swarmctl.core.types import Array, Landed, Phase, VehicleState

_WAITING = (Phase.STANDBY, Phase.ARM, Phase.TAKEOFF, Phase.READY)
_START_ALERT_DELAY_US = 3_000_000  # time on the ground after which the unmet condition is raised as an alert
_APART_FOR_US = 4_000_000  # estimates wander: vehicles have to be apart for as long as accuracy has to be steady


class StartConditions:
    """Judges the estimate's accuracy and the processor before the start, and tells what the agent waits for.

    Args:
        setup: the distances that the accuracy has to suffice for, and how many deadlines may be missed.
        mission: phase, and what it waits for.
        alerts: are told what it waits for, and of heights that differ.
    """

    def __init__(self, setup: AgentSetup, mission: MissionState, alerts: Alerts) -> None:
        self._setup, self._mission, self._alerts = setup, mission, alerts
        self._accuracy, self._readiness = AccuracyMonitor(), Readiness(setup.params.overload)
        self._waits_since_us = 0
        self._close_us: int | None = None  # when another vehicle was last seen too close

    def unsettled(
        self,
        now_us: int,
        pos_accuracy_m: float | None,
        state: VehicleState | None,
        others_ned_m: Callable[[], Sequence[Array]],
        codes: Callable[[], Mapping[int, str]],
    ) -> str:
        """Return why arming, or the climb that follows it, must wait, or "".

        The start is out of reach, a peer flies other code, the estimator still settles, or is too inaccurate for the
        separation, or another vehicle stands too close: the autopilot, which climbs first, knows no peers. Between
        arming and the climb another one may come, where an order or a lost link delays the climb.

        Args:
            now_us: monotonic time.
            pos_accuracy_m: newest reported accuracy, 1-sigma; None while there is none.
            state: newest one.
            others_ned_m: returns the position (3,) of each peer.
            codes: returns the code that each peer flies, by agent number.
        """
        if far := self._far_start(state):
            return far
        if len(self._setup.starts_ned_m) == 1:
            return ""
        if self._mission.phase in (Phase.ARM, Phase.TAKEOFF):
            return self._who_is_beside(state, others_ned_m, now_us, away_for_us=0)
        if self._mission.phase > Phase.STANDBY:
            return ""
        self._accuracy.update(now_us, pos_accuracy_m)
        accuracy_m = self._accuracy.worst_m or 0.0  # if not reported, only body size and tracking error are checked
        separation = self._setup.separation
        problem = (
            self._other_code(codes)
            or self._accuracy.unsettled(now_us)
            or radius_problem(separation, accuracy_m, self._setup.drift_m)
        )
        return problem or self._who_is_beside(state, others_ned_m, now_us, away_for_us=_APART_FOR_US)

    def _far_start(self, state: VehicleState | None) -> str:
        """Return that the start is too far from where the vehicle is, or ""."""
        if self._mission.phase > Phase.STANDBY or state is None or state.landed is Landed.UNKNOWN:
            return ""
        place, start = state.pos_ned_m.tolist(), self._setup.starts_ned_m[self._setup.agent].tolist()
        if not is_beyond_reach(place, start, self._setup.params.state_machine):
            return ""
        away_m, climb_m = math.dist(place[:2], start[:2]), place[2] - start[2]
        return (
            f"its start to be within reach (it is {away_m:.0f} m beside it, {climb_m:.0f} m below): correct "
            "swarm.origin_*, or move it"
        )

    def _other_code(self, codes: Callable[[], Mapping[int, str]]) -> str:
        """Return which peer flies other code than this agent, whose predictions of it would be wrong, or ""."""
        own = self._setup.code
        others = {agent: code for agent, code in codes().items() if code != own} if own else {}
        if not others:
            return ""
        agent = min(others)
        return f"{agent_name(agent)} to fly the same code: {others[agent] or 'an older swarmctl'} there, {own} here"

    def _who_is_beside(
        self,
        state: VehicleState | None,
        others_ned_m: Callable[[], Sequence[Array]],
        now_us: int,
        *,
        away_for_us: int,
    ) -> str:
        """Return why a vehicle on the ground must not climb, or "".

        Another one, at whatever height, is beside it, or has not been away for so long.
        """
        if state is None or state.landed is not Landed.ON_GROUND:
            return ""
        least_m = self._setup.separation.budget.standing_m(self._accuracy.worst_m or 0.0)
        nearest_m = nearest_in_plane_m(state.pos_ned_m, others_ned_m())
        is_close = nearest_m < least_m
        self._close_us = now_us if is_close else self._close_us
        was_close = self._close_us is not None and now_us - self._close_us < away_for_us
        return f"{least_m:.2f} m to the next vehicle (now {nearest_m:.2f} m)" if is_close or was_close else ""

    def too_slow(self, now_us: int, missed_01: float) -> str:
        """Return what the processor has to show before arming, in the rehearsals of STANDBY, or "".

        Args:
            now_us: monotonic time.
            missed_01: fraction of deadlines missed of late.
        """
        if self._mission.phase > Phase.STANDBY:
            return ""
        if self._mission.phase < Phase.STANDBY:
            self._readiness.reset()
        return self._readiness.unmet(now_us, missed_01)

    def compare_heights(
        self, now_us: int, state: VehicleState | None, standing_m: Callable[[], Mapping[int, float]]
    ) -> None:
        """Raise an alert where a vehicle estimates to stand far above or below another one.

        On level ground one of the estimates is wrong, and stays so in flight; on a slope none is. So both may fly.

        Args:
            now_us: monotonic time.
            state: newest one.
            standing_m: returns the height [m] of each peer's vehicle that stands, by agent number.
        """
        if self._mission.phase > Phase.STANDBY or state is None or state.landed is not Landed.ON_GROUND:
            return
        apart_m = {agent: -float(state.pos_ned_m[2]) - its_m for agent, its_m in standing_m().items()}
        agent = max(apart_m, key=lambda it: abs(apart_m[it]), default=-1)
        if agent < 0 or abs(apart_m[agent]) <= self._setup.separation.budget.level_m:
            return
        where = f"{abs(apart_m[agent]):.1f} m {'above' if apart_m[agent] > 0.0 else 'below'} {agent_name(agent)}"
        text = f"estimates to stand {where}: if it does not, they meet where they mean to pass above each other"
        self._alerts.put("heights", text, now_us)

    def report(self, now_us: int) -> None:
        """Raise the unmet condition as an alert once the agent has waited for a while; clear it once it is met."""
        waits_for, may_wait = self._mission.waits_for, self._mission.phase in _WAITING
        if not may_wait:
            self._waits_since_us = now_us
        if not (may_wait and waits_for):
            self._alerts.clear("start")
        elif now_us - self._waits_since_us > _START_ALERT_DELAY_US:
            self._alerts.put("start", f"waits for {waits_for}", now_us)
