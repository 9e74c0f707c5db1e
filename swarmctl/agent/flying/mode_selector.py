"""Selects how a tick is flown: the mode that the failsafe decides, and the plan that is flown in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.tick_results import PlanningResult
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.failsafe.decision import NOTHING_WORN, Escalation, FailsafeDecision, Response, decide, escalate
from swarmctl.control.failsafe.endurance import Endurance
from swarmctl.control.fallback import brake_and_hold_plan
from swarmctl.control.mpc.plan_buffer import PlanBuffer
from swarmctl.control.mpc.problem import Start
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.types import (
    NO_AGE_US,
    Array,
    FlightMode,
    Health,
    Mode,
    Phase,
    Plan,
    PlanStatus,
    VehicleState,
)


class ModeSelector:
    """Judges every tick by the failsafe, and keeps what is flown when its plan must not be.

    Args:
        setup: parameters of the agent.
        controller: its plans have the grid of those that replace them.
        delay_us: from sending a setpoint to when it acts.
        mission: phase, and who has control.
        alerts: are told what becomes of the mission.
        note: receives the event `escalation` when that changes.

    Attributes:
        decision: of the newest tick.
        escalation: response to what wears out: battery, link, positions.
    """

    def __init__(
        self,
        setup: AgentSetup,
        controller: Controller,
        delay_us: int,
        mission: MissionState,
        *,
        alerts: Alerts,
        note: Callable[..., None],
    ) -> None:
        self._params, self._delay_us = setup.params.failsafe, delay_us
        self._lag, self._drag_1_s = setup.vehicle_model.lag(), setup.vehicle_model.drag_1_s
        self._dt_us, self._steps = controller.dt_us, controller.steps
        self._mission, self._alerts, self._note = mission, alerts, note
        self._plan_buffer = PlanBuffer(
            setup.agent,
            self._dt_us,
            self._steps,
            setup.separation.brake_m_s2,
            volume=setup.volume,
            takes_refused=setup.separation.mode == "best_effort" and setup.separation.gust_m_s > 0.0,
        )
        self._certified_us: int | None = None
        self._hold_at: Array | None = None
        self._endurance = Endurance(self._params.window_s)
        self.decision, self.escalation = FailsafeDecision(Mode.IDLE, ""), NOTHING_WORN

    @property
    def mode(self) -> Mode:
        """Return the mode of the newest tick."""
        return self.decision.mode

    def is_fresh(self, now_us: int, state: VehicleState) -> bool:
        """Return whether a state is new enough to plan from."""
        return now_us - state.t_us <= self._params.state_max_age_s * 1e6

    def guess_ned_m(self, t0_us: int) -> Array | None:
        """Return the newest certified plan from `t0_us` on, (steps+1, 3), to linearise around; None without one."""
        return self._plan_buffer.guess_ned_m(t0_us)

    def update(
        self,
        now_us: int,
        state: VehicleState | None,
        planning: PlanningResult,
        *,
        disturbance_ned_m_s2: Array,
        battery_01: float | None,
        dead_reckoning_s: float,
    ) -> None:
        """Decide the mode of a tick from its state and plan.

        Args:
            now_us: monotonic time.
            state: newest state, perhaps stale.
            planning: what was planned from it.
            disturbance_ned_m_s2: (3,) estimate.
            battery_01: newest report of the charge; None if the vehicle does not know it.
            dead_reckoning_s: for how long its estimate has been going on without GPS.
        """
        plan, start = planning.plan, planning.start
        if plan is None or plan.status is PlanStatus.OK:
            self._certified_us = now_us  # without a plan none was needed in this tick, so its absence is no failure
        if plan is not None and start is not None:
            brakes = partial(self._brake_and_hold, start, disturbance_ned_m_s2)
            self._plan_buffer.take(plan, start, planning.keep_outs, brakes)
        is_stale = state is not None and not self.is_fresh(now_us, state)
        self._endurance.update(now_us, battery_01, is_stale)
        health = self._health(now_us, state, plan, dead_reckoning_s)
        self.decision = decide(health, self._params)
        self._report(now_us, escalate(health, self._params))

    def flown(self, state: VehicleState | None, planning: PlanningResult, disturbance_ned_m_s2: Array) -> Plan | None:
        """Return the plan whose input is sent and whose path is published; None when the autopilot flies."""
        mode = self.mode
        if mode is not Mode.HOLD:
            self._hold_at = None
        if planning.start is None or state is None:
            return None
        if mode in (Mode.TRACKING, Mode.PRIMING):
            return planning.plan
        if mode is Mode.REPLAY:
            return self._plan_buffer.plan
        if mode in (Mode.BRAKE, Mode.HOLD):
            if mode is Mode.HOLD and self._hold_at is None:
                self._hold_at = state.pos_ned_m
            return self._brake_and_hold(planning.start, disturbance_ned_m_s2)
        return None

    def _health(self, now_us: int, state: VehicleState | None, plan: Plan | None, dead_reckoning_s: float) -> Health:
        good = self._plan_buffer.plan
        return Health(
            state_age_us=NO_AGE_US if state is None else max(0, now_us - state.t_us),
            armed=state is not None and state.armed,
            mode=FlightMode.UNKNOWN if state is None else state.mode,
            autopilot_failsafe=state is not None and state.failsafe,
            plan_status=PlanStatus.NONE if plan is None else plan.status,
            last_good_plan_age_us=NO_AGE_US if good is None else now_us + self._delay_us - good.t0_us,
            last_good_plan_lasts_us=0 if good is None else len(good.virtual_control) * good.dt_us,
            planless_us=0 if self._certified_us is None else now_us - self._certified_us,
            speed_m_s=0.0 if state is None else math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s)),
            phase=self._mission.phase,
            had_control=self._mission.had_control,
            battery_01=self._endurance.battery_01,
            link_lost_01=self._endurance.link_lost_01,
            dead_reckoning_s=dead_reckoning_s,
            pilot_override=self._mission.pilot_override,
        )

    def _report(self, now_us: int, now: Escalation) -> None:
        before, self.escalation = self.escalation, now
        if now.response is not before.response:
            self._note("escalation", response=now.response.name, reason=now.reason)
        if now.response is not Response.NONE and self._mission.phase < Phase.DONE:
            self._alerts.put("escalation", now.reason, now_us)

    def _brake_and_hold(self, start: Start, disturbance_ned_m_s2: Array) -> Plan:
        return brake_and_hold_plan(
            start,
            self._hold_at,
            disturbance_ned_m_s2,
            self._lag,
            drag_1_s=self._drag_1_s,
            dt_us=self._dt_us,
            steps=self._steps,
        )
