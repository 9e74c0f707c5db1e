"""One agent: `tick(now)` receives, senses, plans, decides the mode, sends a setpoint, publishes and records.

The agent owns no thread, socket or sleep and has no branch for simulation: transport, bus, command executor, clock and
recorder are passed in. Everything it does, it does inside the tick.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from swarmctl.agent.alerts import Alerts
from swarmctl.agent.components import (
    make_controllers,
    make_estimator,
    make_safety_filter,
    make_separation_policy,
    make_state_machine,
)
from swarmctl.agent.controller_watch import ControllerWatch
from swarmctl.agent.mission_change import MissionChange
from swarmctl.agent.mode_selector import ModeSelector
from swarmctl.agent.path_sharing import PathSharing
from swarmctl.agent.reference_selector import ReferenceSelector
from swarmctl.agent.separation_policy import SeparationDirective, SeparationInputs
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.telemetry_publisher import ControlOutput, PlanningResult, TelemetryPublisher, TickSink
from swarmctl.agent.volume_watch import VolumeWatch
from swarmctl.agent.world_model import FLOWN_BY_AGENT, WorldModel
from swarmctl.bus import topics
from swarmctl.bus.path_messages import encode_path
from swarmctl.bus.peers import Bus
from swarmctl.bus.traffic import CountedBus
from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.separation import KeepOuts, radius_problem
from swarmctl.control.estimation.accuracy import AccuracyMonitor
from swarmctl.control.estimation.constant_velocity import predict_constant_velocity
from swarmctl.control.estimation.gust import GustWatch
from swarmctl.control.model import Predictor
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.overload import Level, Overload, SetpointStops
from swarmctl.control.reference.heading import Heading
from swarmctl.control.setpoint import setpoint_of
from swarmctl.core.clock import Clock
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.operator_verbs import EXCLUDE, MISSION, PEER, Order
from swarmctl.core.tick_record import TickRecord, TickTiming
from swarmctl.core.trajectory import grid
from swarmctl.core.types import (
    MAX_MARGIN_M,
    NO_TIMES,
    AttitudeSetpoint,
    FlightMode,
    Mode,
    Phase,
    Plan,
    PlanStatus,
    PredictedPath,
    VehicleState,
)
from swarmctl.mavlink.autopilot import Autopilot
from swarmctl.mavlink.commands import CommandPort
from swarmctl.mavlink.vehicle_setup import VehicleSetup

_NO_TIME_US = -1
_SETPOINT_LOSS_S = 0.5  # time without setpoints after which an autopilot takes over, until it has told its own
# modes in which the vehicle does not follow its committed trajectory
_DEVIATING_MODES = (Mode.BRAKE, Mode.HOLD, Mode.LAND, Mode.PILOT_OVERRIDE)
_START_ALERT_DELAY_US = 3_000_000  # time on the ground after which the unmet condition is raised as an alert
_RESTORE_TIMEOUT_US = 5_000_000  # longest wait for parameters to be restored before the process ends
_AUTOPILOT_HOVER_MODES = (FlightMode.HOLD, FlightMode.EXTERNAL)  # ArduCopter takes off by itself in the latter


class Agent:
    """One agent beside one autopilot.

    Args:
        setup: parameters and place in the swarm.
        autopilot: the vehicle's hot path: states in, setpoints out.
        commands: executor of the slow path: arming, modes, parameters.
        bus: connection to peers and operator.
        clock: monotonic time and UTC [us].
        sink: recorder of ticks and events.
        stopwatch_ns: measures the tick and never influences it.

    Attributes:
        timing: durations of the last tick.
    """

    def __init__(
        self,
        setup: AgentSetup,
        autopilot: Autopilot,
        commands: CommandPort,
        bus: Bus,
        *,
        clock: Clock,
        sink: TickSink,
        stopwatch_ns: Callable[[], int],
    ) -> None:
        self._setup, self._autopilot, self._commands = setup, autopilot, commands
        bus = self._bus = CountedBus(bus)
        self._clock, self._sink, self._stopwatch_ns = clock, sink, stopwatch_ns
        self._path_sharing = PathSharing(setup.params.path_sharing, setup.separation)
        self._vehicle_setup = VehicleSetup(
            autopilot,
            commands,
            setup.params.autopilot_params,
            setup.sysid,
            state_rate_hz=setup.params.state_machine.state_rate_hz,
        )
        self._world_model = WorldModel(
            setup.agent,
            setup.peers,
            setup.separation,
            bus,
            rate_hz=setup.params.rate_hz,
            note=self._note,
            vouchers=setup.vouchers,
        )
        self._missions = MissionChange(setup, bus, self._world_model.refusals)
        self._separation = make_separation_policy(setup, self._world_model, bus, self._note, stopwatch_ns=stopwatch_ns)
        self._directive = SeparationDirective()  # of the newest tick
        self._controller, self._transit = make_controllers(setup, stopwatch_ns)
        self._controller_watch = ControllerWatch(self._note)
        self._volume_watch = VolumeWatch(setup.volume, self._note)
        self._observer = make_estimator(setup)
        self._predictor = Predictor(setup.vehicle_model)
        self._safety_filter = make_safety_filter(setup, self._world_model, self._note, stopwatch_ns)
        self._state_machine = make_state_machine(setup)
        self._heading = Heading(setup.mission.yaw_rad)
        ahead_us = np.arange(self._controller.longest + 1) * self._controller.dt_us  # (longest+1,)
        self._horizon_us = self._predictor.delay_us + ahead_us
        ahead_s = self._predictor.delay_us * 1e-6 + self._controller.dt_us * 1e-6 * grid(self._controller.longest)
        self._reference_selector = ReferenceSelector(setup, self._state_machine, ahead_s, self._note)
        self._alerts = Alerts()
        self._modes = ModeSelector(
            setup,
            self._controller,
            self._predictor.delay_us,
            self._state_machine,
            alerts=self._alerts,
            note=self._note,
        )
        self._virtual_control = np.array([0.0, 0.0, GRAVITY_M_S2])
        self._encounters = Encounters()
        self._gust = GustWatch()
        self._publisher = TelemetryPublisher(
            setup.agent,
            setup.boot_id,
            setup.sysid,
            self._separation.uses_commitments,
            autopilot=autopilot,
            paths=self._world_model.paths,
            bus=bus,
            clock=clock,
            sink=sink,
        )
        self.timing = TickTiming(
            sense_ms=0.0,
            setup_ms=0.0,
            commitment_ms=0.0,
            spaces_ms=0.0,
            solve_ms=0.0,
            certify_ms=0.0,
            barrier_ms=0.0,
            send_ms=0.0,
        )
        self._gaps = self._jumps = 0  # setpoint gaps and estimate jumps already reported
        self._announced: tuple[Phase, Mode, FlightMode] | None = None
        self._accuracy = AccuracyMonitor()
        self._standby_us = 0
        self._overload = Overload(setup.params.overload, round(1e6 / setup.params.rate_hz))
        self._stops = SetpointStops(round(1e6 / setup.params.rate_hz))
        self._done_us: int | None = None
        self._last_state_us = _NO_TIME_US
        self._thrust_01 = setup.vehicle_model.hover_thrust_01

    @property
    def done(self) -> bool:
        """Whether the mission has ended and the autopilot's parameters are restored, or the wait for it timed out."""
        if self._done_us is None:
            return False
        return self._vehicle_setup.restored or self._clock.now_us() - self._done_us > _RESTORE_TIMEOUT_US

    @property
    def finished(self) -> bool:
        """Whether this agent and every peer that is still heard on the bus are done."""
        return self.done and not self._world_model.has_company(self._clock.utc_us())

    @property
    def outcome(self) -> str:
        """ "completed", or the reason why the mission was not."""
        return self._state_machine.outcome or "stopped before the mission began"

    @property
    def has_armed(self) -> bool:
        """Whether arming has been requested; a mission that ends before that counts as one that could not start."""
        return self._state_machine.arming.requested

    @property
    def rejected(self) -> dict[str, int]:
        """Number of bus messages refused so far, by reason."""
        return dict(self._world_model.refusals.by_reason)

    @property
    def sent(self) -> dict[str, dict[str, int]]:
        """Number of `messages` and `bytes` published on the bus so far, by topic."""
        return self._bus.sent

    @property
    def refused_frames(self) -> dict[str, int]:
        """Number of the vehicle's MAVLink frames refused so far, by reason."""
        return dict(self._autopilot.refusals.by_reason)

    @property
    def commits_refused(self) -> int | None:
        """Number of proposals withdrawn or expired; None if separation works without proposals."""
        return self._separation.commits_refused

    def ask(self, order: Order, now_us: int) -> str:
        """Obey an operator's order, or return why it is refused; the operator is answered either way."""
        if order.verb == EXCLUDE:
            self._world_model.exclude(int(order.arguments[PEER]))
            refusal = ""
        else:
            refusal = self._offer_mission(order) if order.verb == MISSION else ""
            state = self._autopilot.poll(now_us)
            refusal = refusal or self._state_machine.operator(order, now_us, self._clock.utc_us(), state)
        self._world_model.answer(order, refusal)
        if refusal:
            self._alerts.put("order", f"{order.verb} refused: {refusal}", now_us)
            self._note("order_refused", verb=order.verb, reason=refusal, **order.arguments)
        else:
            self._note("operator", verb=order.verb, **order.arguments)
            offered = self._state_machine.offered
            if order.verb == MISSION and offered is not None:
                self._note("mission_changed", duration_s=offered.duration_s, mission=offered.text)
        return refusal

    def _offer_mission(self, order: Order) -> str:
        """Have the state machine know the mission of an order; return why it is not flown, or ""."""
        offered = self._missions.offer(order, self._clock.utc_us())
        if isinstance(offered, str):
            return offered
        self._state_machine.offered = offered
        return ""

    def tick(self, now_us: int, deadline_misses: int) -> TickRecord:
        """Run one control step at monotonic time `now_us`.

        Args:
            now_us: monotonic time of the step.
            deadline_misses: deadlines missed since the start, skipped ticks included.

        Returns:
            the record of the tick, already handed to the sink.
        """
        began_ns = self._stopwatch_ns()
        self._watch_deadlines(now_us, deadline_misses)
        self._receive(now_us)
        state = self._sense(now_us)
        self._state_machine.begin_if_due(now_us, self._clock.utc_us())
        sensed_ns = self._stopwatch_ns()
        planning = self._plan(now_us, state)
        planned_ns = self._stopwatch_ns()
        flown = self._decide(now_us, state, planning)
        setpoint = self._act(now_us, flown, planning.start)
        sent_ns = self._stopwatch_ns()
        times = NO_TIMES if planning.plan is None else planning.plan.times
        self.timing = TickTiming(
            sense_ms=(sensed_ns - began_ns) * 1e-6,
            setup_ms=(planned_ns - sensed_ns - self._directive.duration_ns) * 1e-6
            - (times.spaces_us + times.solve_us + times.certify_us) * 1e-3,
            commitment_ms=self._directive.duration_ns * 1e-6,
            spaces_ms=times.spaces_us * 1e-3,
            solve_ms=times.solve_us * 1e-3,
            certify_ms=times.certify_us * 1e-3,
            barrier_ms=self._safety_filter.duration_ms,
            send_ms=(sent_ns - planned_ns) * 1e-6 - self._safety_filter.duration_ms,
        )
        self._share(state, flown)
        self._advance(now_us, state)
        refusals = self._world_model.refusals.alert(self._clock.utc_us())
        if refusals:
            self._alerts.put("bus", refusals, now_us)
        self._watch_signatures(now_us)
        self._publisher.active_alert = self._alerts.newest(now_us)
        return self._publisher.publish(
            now_us,
            state,
            planning,
            ControlOutput(
                mode=self._modes.mode, flown=flown, setpoint=setpoint, safety_filter_acted=self._safety_filter.acts
            ),
            state_machine=self._state_machine,
            estimate=self._observer.estimate,
            deadline_misses=deadline_misses,
            timing=self.timing,
        )

    def _watch_signatures(self, now_us: int) -> None:
        """Report the vehicle's frames that were refused."""
        refusals, utc_us = self._autopilot.refusals, self._clock.utc_us()
        refusals.report(utc_us, self._note)
        if text := refusals.alert(utc_us):
            self._alerts.put("signing", text, now_us)

    def _watch_deadlines(self, now_us: int, deadline_misses: int) -> None:
        before = self._overload.level
        self._overload.update(now_us, deadline_misses)
        loss_s = self._autopilot.setpoint_loss_s
        self._stops.update(now_us, deadline_misses, _SETPOINT_LOSS_S if loss_s is None else loss_s)
        level = self._overload.level
        if level is not Level.NONE:
            self._alerts.put("overload", self._overload.text(), now_us)
        if level is not before:
            self._note("overload", level=level.name, missed_01=round(self._overload.missed_01, 3))

    # -- receive, sense -----------------------------------------------------------------------------------------------

    def _receive(self, now_us: int) -> None:
        self._missions.receive(self._clock.utc_us())
        for order in self._world_model.receive(self._clock.utc_us()):
            self.ask(order, now_us)
        for answer in self._world_model.due_answers():
            self._publisher.answer(answer)
        self._separation.receive(self._clock.utc_us())

    def _sense(self, now_us: int) -> VehicleState | None:
        state = self._autopilot.poll(now_us)
        self._commands.step(now_us)
        for result in self._commands.results():
            self._vehicle_setup.on_result(result)
            asked = f"{result.command.verb.value} {result.command.name}".rstrip()
            if result.ok:
                self._alerts.clear(asked)
            else:
                self._alerts.put(asked, f"{asked} refused: {result.text}", now_us)
            self._note("command", verb=asked, ok=result.ok, text=result.text)
        if (said := self._autopilot.next_text()) is not None:  # one a tick: a flood must not fill the disk
            self._note("autopilot_text", severity=said.severity, text=said.text)
        frame = self._autopilot.frame
        if frame.jumps != self._jumps:
            self._jumps = frame.jumps
            text = f"estimate jumped by {frame.jump_m:.1f} m: peers keep that much more away"
            self._alerts.put("jump", text, now_us)
            self._note("estimate_jumped", metres=frame.jump_m)
        if state is None or state.t_us == self._last_state_us:
            return state
        self._last_state_us = state.t_us
        self._observer.update(state, self._thrust_01 if self._state_machine.had_control else None)
        if self._state_machine.had_control:
            return state
        if self._autopilot.hover_thrust_01 is not None and state.mode in _AUTOPILOT_HOVER_MODES:
            self._observer.learn_hover(self._autopilot.hover_thrust_01 * float(body_z_ned(state.q_nb)[2]))
        return state

    # -- plan ---------------------------------------------------------------------------------------------------------

    def _plan(self, now_us: int, state: VehicleState | None) -> PlanningResult:
        if state is None or not self._modes.is_fresh(now_us, state):
            # the autopilot flies the vehicle, on stale setpoints or by its failsafe
            self._directive = self._separation.wait(self._clock.utc_us(), state)
            return PlanningResult(start=None, plan=None, reference=None, keep_outs=[])
        estimate = self._observer.estimate
        act_us = now_us + self._predictor.delay_us
        if self._state_machine.had_control:
            start = self._predictor.start(
                self._observer.state(state), act_us, estimate.disturbance_ned_m_s2, self._virtual_control
            )
        else:
            self._virtual_control = np.array([0.0, 0.0, GRAVITY_M_S2])
            cos_tilt = float(body_z_ned(state.q_nb)[2])
            start = Start(
                t_us=act_us,
                pos_ned_m=state.pos_ned_m,
                vel_ned_m_s=state.vel_ned_m_s,
                cos_tilt=cos_tilt,
                virtual_control=self._virtual_control,
            )
        steps, dt_us = self._controller.steps, self._controller.dt_us
        near = self._world_model.keep_outs(
            state.pos_ned_m, self._utc(act_us), dt_us, steps, phase=self._state_machine.phase
        )
        keep_outs = self._encounters.noted(near, start.pos_ned_m)
        flies = Phase.GOTO_START <= self._state_machine.phase <= Phase.GOTO_LAND
        if outside := self._volume_watch.update(now_us, state, flies and self._state_machine.had_control):
            self._alerts.put("volume", outside, now_us)
        self._reference_selector.look_ahead(now_us, self._clock.utc_us())
        self._detect_deadlock(now_us, state, keep_outs, flies)
        reference, now_ref = self._reference_selector.reference()
        directive = self._directive = self._separate(now_us, state, keep_outs, flies)
        if not flies:
            return PlanningResult(start=start, plan=None, reference=now_ref, keep_outs=list(keep_outs))
        if directive.alert:
            self._alerts.put("separation", directive.alert, now_us)
        if directive.reference is not None:
            reference = directive.reference
        guess = self._modes.guess_ned_m(act_us)
        controller = self._controller if self._state_machine.phase is Phase.TRACK else self._transit
        plan = controller.plan(
            Problem(
                start=start,
                reference=reference,
                disturbance_ned_m_s2=estimate.disturbance_ned_m_s2,
                keep_outs=directive.keep_outs,
                guess_ned_m=guess,
            )
        )
        return PlanningResult(start=start, plan=plan, reference=now_ref, keep_outs=list(keep_outs))

    def _separate(self, now_us: int, state: VehicleState, keep_outs: KeepOuts, flies: bool) -> SeparationDirective:
        """Return this tick's directive; its reference begins where the setpoint acts."""
        utc_us = self._clock.utc_us()
        if not (flies and self._state_machine.had_control) or self._modes.mode in _DEVIATING_MODES:
            return self._separation.idle(utc_us, state, keep_outs)
        return self._separation.step(
            SeparationInputs(
                utc_us=utc_us,
                state=state,
                phase=self._state_machine.phase,
                desired=self._reference_selector.desired(now_us, utc_us),
                horizon_utc_us=utc_us + self._horizon_us,
                keep_outs=keep_outs,
                disturbance_ned_m_s2=self._observer.estimate.disturbance_ned_m_s2,
            )
        )

    def _detect_deadlock(self, now_us: int, state: VehicleState, keep_outs: KeepOuts, flies: bool) -> None:
        if not (flies and self._state_machine.had_control):
            self._reference_selector.reset(now_us)
            return
        known = (*keep_outs, *self._directive.lost_peer_keep_outs)
        landmarks = self._world_model.landmarks
        deadlock = self._reference_selector.update(
            now_us, self._clock.utc_us(), state.pos_ned_m, known, landmarks=landmarks
        )
        if deadlock is not None:
            self._alerts.put("deadlock", f"deadlocked by {deadlock.names}", now_us)

    # -- decide the mode, send ----------------------------------------------------------------------------------------

    def _decide(self, now_us: int, state: VehicleState | None, planning: PlanningResult) -> Plan | None:
        """Decide the mode of the tick; return the plan that is flown in it, None when the autopilot flies."""
        plan, disturbance_ned_m_s2 = planning.plan, self._observer.estimate.disturbance_ned_m_s2
        if plan is not None and plan.status is not PlanStatus.OK:
            self._publisher.failed_plans += 1
            self._alerts.put("plan", f"plan {plan.status.name.lower()}", now_us)
        if failure := self._controller_watch.update(plan):
            self._alerts.put("controller", failure, now_us)
        self._modes.update(
            now_us,
            state,
            planning,
            disturbance_ned_m_s2=disturbance_ned_m_s2,
            battery_01=self._autopilot.health.battery_01,
        )
        return self._modes.flown(state, planning, disturbance_ned_m_s2)

    def _act(self, now_us: int, flown: Plan | None, start: Start | None) -> AttitudeSetpoint | None:
        if flown is None or start is None:
            self._safety_filter.skip(now_us)
            return None
        act_us = now_us + self._predictor.delay_us
        step = min(max(0, (act_us - flown.t0_us) // flown.dt_us), len(flown.virtual_control) - 1)
        estimate, flies = self._observer.estimate, self._modes.mode in FLOWN_BY_AGENT
        virtual_control = self._safety_filter.keep_apart(
            now_us,
            self._utc(act_us),
            flown.virtual_control[step],
            start,
            estimate=estimate,
            flies=flies,
            committed_peers=self._directive.committed_peers,
        )
        yaw_rad = self._heading.at(now_us, self._reference_selector.heading_rad(self._clock.utc_us()))
        hover_01 = estimate.hover_thrust_01
        setpoint = setpoint_of(virtual_control, yaw_rad, hover_01, now_us, params=self._setup.vehicle_model)
        refused = self._autopilot.send(setpoint, self._clock.now_us())
        if refused:
            self._alerts.put("setpoint", f"setpoint refused: {refused}", now_us)
            self._note("setpoint_refused", reason=refused)
            return None
        if self._autopilot.gaps != self._gaps:
            self._gaps, gap_s = self._autopilot.gaps, self._autopilot.gap_s
            stopped = self._stops.text(now_us) or f"setpoints had stopped for {gap_s:.2f} s"
            self._alerts.put("gap", f"{stopped}: the autopilot's failsafe may have acted", now_us)
            self._note("setpoint_gap", seconds=gap_s)
        self._stops.sent(now_us)
        self._virtual_control, self._thrust_01 = virtual_control, setpoint.thrust_01
        self._predictor.sent(now_us, virtual_control)
        return setpoint

    def _advance(self, now_us: int, state: VehicleState | None) -> None:
        before = self._state_machine.phase, self._state_machine.had_control
        utc_us, dialect = self._clock.utc_us(), self._autopilot.dialect
        inputs = PhaseInputs(
            now_us=now_us,
            utc_us=utc_us,
            state=state,
            prepared=self._vehicle_setup.ready,
            armable=self._autopilot.armable,
            busy=self._commands.busy,
            mode=self._modes.mode,
            unresponsive_peer=self._directive.unresponsive_peer,
            cut_off=self._directive.cut_off or self._controller_watch.suspended,
            peers=self._world_model.peers,
            excused=self._world_model.excused,
            others_ned_m=partial(self._world_model.others_ned_m, utc_us),
            arm_in=None if dialect is None else dialect.arm_in,
            boots=self._autopilot.clock.boots,
            refusal=self._vehicle_setup.refusal if self._state_machine.phase <= Phase.ARM else "",
            unsettled=self._unsettled(now_us),
            overload=self._overload.level,
            escalation=self._modes.escalation,
            setpoints_stopped=self._stops.text(now_us),
            armed_told_us=self._autopilot.armed_told_us,
        )
        for command in self._state_machine.step(inputs):
            self._commands.request(command)
        if self._state_machine.pilot_override:
            self._alerts.put("override", self._state_machine.outcome, now_us)
        self._report_start_blocker(now_us)
        self._restore_parameters(now_us)
        self._vehicle_setup.step(now_us)
        if not before[1] and self._state_machine.had_control:
            self._predictor.clear()
            self._observer.reset()
            self._controller.reset()
        now = (self._state_machine.phase, self._modes.mode, self._autopilot.mode)
        if now != self._announced:
            self._announced = now
            names = {"phase": now[0].name, "mode": now[1].name, "flight_mode": now[2].name}
            self._note("state", **names, reason=self._modes.decision.reason)

    def _report_start_blocker(self, now_us: int) -> None:
        waits_for = self._state_machine.waits_for
        if self._state_machine.phase not in (Phase.STANDBY, Phase.READY):
            self._standby_us = now_us
        elif waits_for and now_us - self._standby_us > _START_ALERT_DELAY_US:
            self._alerts.put("start", f"waits for {waits_for}", now_us)

    def _restore_parameters(self, now_us: int) -> None:
        """After the mission, restore the autopilot's parameters and report those that could not be restored."""
        if not self._state_machine.finished:
            return
        if self._done_us is None:
            self._done_us = now_us
            self._vehicle_setup.restore()
        left = self._vehicle_setup.left_changed
        if left and self.done and self._alerts.put("restore", f"parameters left changed, they were: {left}", now_us):
            self._note("parameters_left_changed", were=left)

    def _unsettled(self, now_us: int) -> str:
        """Return why arming must wait: the estimator still settles, or is too inaccurate for the separation; or ""."""
        if len(self._setup.starts_ned_m) == 1 or self._state_machine.phase > Phase.STANDBY:
            return ""
        self._accuracy.update(now_us, self._autopilot.pos_accuracy_m)
        accuracy_m = self._accuracy.worst_m or 0.0  # if not reported, only body size and tracking error are checked
        return self._accuracy.unsettled(now_us) or radius_problem(
            self._setup.separation, accuracy_m, self._setup.drift_m
        )

    # -- publish, record ----------------------------------------------------------------------------------------------

    def _share(self, state: VehicleState | None, flown: Plan | None) -> None:
        if flown is None or self._separation.uses_commitments:  # commitments have tubes
            self._gust.forget()
        else:
            self._gust.update(self._clock.now_us(), self._observer.estimate.disturbance_ned_m_s2)
        path = None if state is None else self._path_sharing.choose(self._path(state, flown))
        if path is not None:
            self._bus.publish(topics.PATH, encode_path(path))
        self._separation.publish(self._clock.utc_us())

    def _path(self, state: VehicleState, flown: Plan | None) -> PredictedPath:
        setup, seq = self._setup, self._publisher.seq
        margins_m = (
            self._autopilot.frame.margin_m,
            self._overload.margin_m,
            self._directive.margin_m,
            self._gust.margin_m,
        )
        margin_m = min(MAX_MARGIN_M, sum(margins_m))
        if flown is not None:
            t0_us, dt_us, pos = flown.t0_us, flown.dt_us, flown.pos_ned_m
        else:
            t0_us, dt_us = self._clock.now_us() + self._predictor.delay_us, self._controller.dt_us
            ahead_s = grid(self._controller.steps) * (dt_us * 1e-6) + (t0_us - state.t_us) * 1e-6
            pos = predict_constant_velocity(state, ahead_s, setup.separation.brake_m_s2)
        return PredictedPath(
            agent=setup.agent,
            boot_id=setup.boot_id,
            seq=seq,
            t0_utc_us=self._utc(t0_us),
            dt_us=dt_us,
            margin_m=margin_m,
            pos_ned_m=pos,
        )

    def _utc(self, t_us: int) -> int:
        """Convert monotonic time of this process to UTC [us]."""
        return self._clock.utc_us() + t_us - self._clock.now_us()

    def _note(self, name: str, **fields: Any) -> None:
        self._sink.event(name, self._clock.now_us(), self._clock.utc_us(), **fields)
