"""One agent: `tick(now)` receives, senses, plans, decides the mode, sends a setpoint, publishes and records.

The agent owns no thread, socket or sleep and has no branch for simulation: what connects it to the world is passed in
(`agent.ports`). Everything it does, it does inside the tick. This module is the order of the tick and what its parts
tell each other; each part is a module of the package that is named after its stage.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from swarmctl.agent.components import (
    make_controllers,
    make_estimator,
    make_interest,
    make_reference_selector,
    make_rehearsal,
    make_safety_filter,
    make_separation_policy,
    make_state_machine,
    make_telemetry_publisher,
    make_vehicle_setup,
    make_world_model,
)
from swarmctl.agent.flying.mode_selector import ModeSelector
from swarmctl.agent.flying.setpoint_output import SetpointOutput
from swarmctl.agent.mission.mission_end import MissionEnd
from swarmctl.agent.mission.operator_orders import OperatorOrders
from swarmctl.agent.mission.start_conditions import StartConditions
from swarmctl.agent.planning.planner import Planner
from swarmctl.agent.ports import Ports
from swarmctl.agent.sensing.own_state import OwnState
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.sharing.path_publisher import PathPublisher
from swarmctl.agent.tick_results import ControlOutput, PlanningResult
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.agent.watches.controller_watch import ControllerWatch
from swarmctl.agent.watches.deadline_watch import DeadlineWatch
from swarmctl.agent.watches.destination_watch import DestinationWatch
from swarmctl.agent.watches.vehicle_watch import VehicleWatch
from swarmctl.control.failsafe.overload import Level
from swarmctl.control.phases.handover import withdrawn_verbs
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.operator_verbs import Order
from swarmctl.core.recorded.tick_record import TickRecord, TickTiming
from swarmctl.core.types import (
    FLOWN_BY_AGENT,
    NO_TIMES,
    Array,
    AttitudeSetpoint,
    FlightMode,
    Mode,
    Phase,
    Plan,
    PlanStatus,
    VehicleState,
    Verb,
)


class Agent:
    """One agent beside one autopilot.

    Args:
        setup: parameters and place in the swarm.
        ports: what connects it to its vehicle, its peers, time and recorder.

    Attributes:
        timing: durations of the last tick.
    """

    timing: TickTiming

    def __init__(self, setup: AgentSetup, ports: Ports) -> None:
        self._ports, self._alerts = ports, Alerts()
        self._make_senses(setup)
        self._make_flight(setup)
        self._publisher = make_telemetry_publisher(setup, ports, self._world_model, self._separation)
        self._announced: tuple[Phase, Mode, FlightMode] | None = None

    def _make_senses(self, setup: AgentSetup) -> None:
        """Make what senses and watches, the state machine of the mission, and what obeys the operators."""
        ports, alerts = self._ports, self._alerts
        self._vehicle_setup = make_vehicle_setup(setup, ports)
        self._world_model = make_world_model(setup, ports)
        self._own_state = OwnState(setup.vehicle_model, make_estimator(setup))
        self._state_machine = make_state_machine(setup)
        self._mission = self._state_machine.mission
        self._vehicle_watch = VehicleWatch(ports, alerts)
        own = setup.controller.kind if setup.controller.is_own else ""
        self._controller_watch = ControllerWatch(own, ports.note)
        self._deadlines = DeadlineWatch(setup.params.overload, setup.params.rate_hz, alerts, ports.note)
        self._orders = OperatorOrders(setup, ports, self._world_model, self._state_machine, alerts=alerts)
        self._destination = DestinationWatch(self._mission, self._world_model.obstacles, alerts, ports.note)
        self._start_conditions = StartConditions(setup, self._mission, alerts)
        self._mission_end = MissionEnd(ports, self._mission, self._vehicle_setup, alerts)

    def _make_flight(self, setup: AgentSetup) -> None:
        """Make what plans, decides, acts and shares."""
        ports, alerts, own_state, mission = self._ports, self._alerts, self._own_state, self._mission
        controller, transit = make_controllers(setup, ports.stopwatch_ns)
        self._separation = make_separation_policy(setup, ports, self._world_model)
        references = make_reference_selector(setup, ports, mission, controller, own_state.delay_us)
        self._modes = ModeSelector(setup, controller, own_state.delay_us, mission, alerts=alerts, note=ports.note)
        self._planner = Planner(
            setup,
            ports,
            self._world_model,
            own_state,
            mission,
            references=references,
            separation=self._separation,
            modes=self._modes,
            controller=controller,
            transit=transit,
            rehearsal=make_rehearsal(setup, ports, self._world_model) if ports.rehearses else None,
            alerts=alerts,
        )
        self._safety_filter = make_safety_filter(setup, ports, self._world_model)
        self._setpoints = SetpointOutput(setup, ports, self._safety_filter, own_state, references, alerts=alerts)
        self._path_publisher = PathPublisher(
            setup, ports, controller, own_state.delay_us, widens_in_gusts=not self._separation.uses_commitments
        )
        self._interest = make_interest(setup, ports, self._world_model, controller)

    @property
    def done(self) -> bool:
        """Whether the mission has ended and the autopilot's parameters are restored, or the wait for it timed out."""
        return self._mission_end.done

    @property
    def finished(self) -> bool:
        """Whether this agent and every peer that is still heard on the bus are done."""
        return self.done and not self._world_model.statuses.has_company(self._ports.clock.utc_us())

    @property
    def outcome(self) -> str:
        """ "completed", or the reason why the mission was not."""
        return self._mission.outcome or "stopped before the mission began"

    @property
    def ends_in_s(self) -> float:
        """Time until what it does ends by itself, the way back too [s]; NaN where it does not, as in a hold."""
        return self._mission.ends_in_s(self._ports.clock.now_us(), self._ports.clock.utc_us())

    @property
    def has_armed(self) -> bool:
        """Whether arming has been requested; a mission that ends before that counts as one that could not start."""
        return self._mission.arming.requested

    @property
    def rejected(self) -> dict[str, int]:
        """Number of bus messages refused so far, by reason."""
        return dict(self._world_model.refusals.by_reason)

    @property
    def sent(self) -> dict[str, dict[str, int]]:
        """Number of `messages` and `bytes` published on the bus so far, by topic."""
        return self._ports.bus.sent

    @property
    def heard_bytes(self) -> int:
        """Number of bytes that the bus has delivered so far."""
        return self._ports.bus.heard_bytes

    @property
    def heard_us(self) -> int:
        """Monotonic time at which the vehicle's newest frame has arrived; 0 before the first."""
        return self._ports.autopilot.received_us or 0

    @property
    def refused_frames(self) -> dict[str, int]:
        """Number of the vehicle's MAVLink frames refused so far, by reason."""
        return dict(self._ports.autopilot.refusals.by_reason)

    @property
    def own_controller(self) -> dict[str, Any]:
        """Name of an own controller, and how many ticks of missions it has flown; empty for a built-in one."""
        return self._controller_watch.summary

    def totals(self, lost: int) -> dict[str, dict[str, Any]]:
        """Return the events that sum up a flight, fields by name; `lost` records are in no file."""
        bus = {"sent": self.sent, "rejected": self.rejected, "lost": lost}
        found: dict[str, dict[str, Any]] = {"bus_summary": bus, "link_summary": {"refused": self.refused_frames}}
        return found | ({"controller_summary": self.own_controller} if self.own_controller else {})

    @property
    def commits_refused(self) -> int | None:
        """Number of proposals withdrawn or expired; None if separation works without proposals."""
        return self._separation.commits_refused

    def ask(self, order: Order, now_us: int) -> str:
        """Obey an operator's order, or return why it is refused; the operator is answered either way."""
        return self._orders.ask(order, now_us)

    def tick(self, now_us: int, deadline_misses: int) -> TickRecord:
        """Run one control step at monotonic time `now_us`.

        Args:
            now_us: monotonic time of the step.
            deadline_misses: deadlines missed since the start, skipped ticks included.

        Returns:
            the record of the tick, already handed to the sink.
        """
        # What a tick decides and records is of `now_us`, in UTC too, also where it is held up on the way.
        stopwatch_ns = self._ports.stopwatch_ns
        began_ns = stopwatch_ns()
        self._ports.clock.begin_tick(now_us)
        self._deadlines.update(now_us, deadline_misses, self._ports.autopilot.setpoint_loss_s)
        self._receive(now_us)
        state = self._sense(now_us)
        self._state_machine.begin_if_due(now_us, self._ports.utc_of_us(now_us), state)
        sensed_ns = stopwatch_ns()
        planning = self._planner.plan(now_us, state)
        planned_ns = stopwatch_ns()
        flown = self._decide(now_us, state, planning)
        setpoint = self._act(now_us, state, flown, planning)
        self.timing = self._timing(began_ns, sensed_ns, planned_ns, stopwatch_ns(), planning.plan)
        setpoint_accel_ned_m_s2 = None if setpoint is None else self._own_state.setpoint_accel_ned_m_s2
        self._share(now_us, state, flown, setpoint_accel_ned_m_s2)
        self._advance(now_us, state)
        self._report_refusals(now_us)
        self._publisher.active_alert = self._alerts.newest(now_us)
        record = self._publisher.record(
            now_us,
            state,
            planning,
            ControlOutput(
                mode=self._modes.mode,
                flown=flown,
                setpoint=setpoint,
                setpoint_accel_ned_m_s2=setpoint_accel_ned_m_s2,
                safety_filter_acted=self._safety_filter.acts,
            ),
            mission=self._mission,
            estimate=self._own_state.estimate,
            deadline_misses=deadline_misses,
            timing=self.timing,
        )
        world_model = self._world_model
        self._publisher.publish(record, self._mission, world_model.statuses.excused, world_model.accepted)
        return record

    def _timing(self, began_ns: int, sensed_ns: int, planned_ns: int, sent_ns: int, plan: Plan | None) -> TickTiming:
        times, agreeing_ns = NO_TIMES if plan is None else plan.times, self._planner.directive.duration_ns
        return TickTiming(
            sense_ms=(sensed_ns - began_ns) * 1e-6,
            setup_ms=(planned_ns - sensed_ns - agreeing_ns) * 1e-6
            - (times.spaces_us + times.solve_us + times.certify_us) * 1e-3,
            commitment_ms=agreeing_ns * 1e-6,
            spaces_ms=times.spaces_us * 1e-3,
            solve_ms=times.solve_us * 1e-3,
            certify_ms=times.certify_us * 1e-3,
            barrier_ms=self._safety_filter.duration_ms,
            send_ms=(sent_ns - planned_ns) * 1e-6 - self._safety_filter.duration_ms,
        )

    def _receive(self, now_us: int) -> None:
        """Take in what peers and operator have sent."""
        utc_us = self._ports.clock.utc_us()
        self._orders.receive_missions()
        for order in self._world_model.receive(utc_us):
            self._orders.ask(order, now_us)
        for answer in self._world_model.due_answers():
            self._publisher.answer(answer)
        self._separation.receive(self._ports.clock.utc_us())

    def _sense(self, now_us: int) -> VehicleState | None:
        """Take in what the vehicle has sent; return its newest state."""
        autopilot, commands = self._ports.autopilot, self._ports.commands
        state = autopilot.poll(now_us)
        commands.withdraw(withdrawn_verbs(self._mission, state))
        commands.step(now_us, heartbeat=autopilot.is_attended(now_us))
        for result in commands.results():
            self._mission.arming.accepted |= result.ok and result.command.verb is Verb.ARM
            self._vehicle_setup.on_result(result)
            self._vehicle_watch.on_result(result, now_us)
        self._vehicle_watch.report_text()
        self._vehicle_watch.report_jump(now_us)
        self._vehicle_watch.report_accuracy(now_us, is_standing=self._mission.phase < Phase.ARM)
        self._vehicle_watch.report_loss(now_us)
        self._vehicle_watch.report_unheard(now_us)
        if state is not None:
            self._own_state.update(state, autopilot.own_hover_01, controls=self._mission.had_control)
        return state

    def _decide(self, now_us: int, state: VehicleState | None, planning: PlanningResult) -> Plan | None:
        """Decide the mode of the tick; return the plan that is flown in it, None when the autopilot flies."""
        plan, disturbance_ned_m_s2 = planning.plan, self._own_state.estimate.disturbance_ned_m_s2
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
            battery_01=self._ports.autopilot.health.battery_01,
            dead_reckoning_s=self._vehicle_watch.accuracy.dead_reckoning_s,
        )
        flown = self._modes.flown(state, planning, disturbance_ned_m_s2)
        self._controller_watch.count(self._mission.phase, plan, flown)
        return flown

    def _act(
        self, now_us: int, state: VehicleState | None, flown: Plan | None, planning: PlanningResult
    ) -> AttitudeSetpoint | None:
        """Send the setpoint of the tick; return it, None if none has left."""
        setpoint = self._setpoints.send(
            now_us,
            flown,
            planning.start,
            state,
            flies=self._modes.mode in FLOWN_BY_AGENT,
            committed_peers=self._planner.directive.committed_peers,
            followed_z_m=planning.followed_z_m,
        )
        if setpoint is not None:
            self._vehicle_watch.report_gap(now_us, self._deadlines.stop_cause(now_us))
            self._deadlines.sent(now_us)
        return setpoint

    def _share(
        self, now_us: int, state: VehicleState | None, flown: Plan | None, setpoint_accel_ned_m_s2: Array | None
    ) -> None:
        """Publish the predicted path, and what the separation policy has to say."""
        jump_m, accuracy_m = self._ports.autopilot.frame.margin_m, self._vehicle_watch.accuracy.margin_m
        self._path_publisher.publish(
            now_us,
            state,
            flown,
            self._publisher.seq,
            setpoint_accel_ned_m_s2=setpoint_accel_ned_m_s2,
            disturbance_ned_m_s2=self._own_state.estimate.disturbance_ned_m_s2,
            margins_m=(jump_m, accuracy_m, self._deadlines.margin_m, self._planner.directive.margin_m),
            as_committed=self._planner.directive.as_committed,
        )
        self._separation.publish(
            self._ports.clock.utc_us(),
            unsure_m=jump_m + accuracy_m,
            relays=self._deadlines.level is Level.NONE,
        )
        waits = self._mission.phase is not Phase.TRACK
        self._interest.update(state, self._path_publisher.told_m_s, self._ports.clock.utc_us(), waits=waits)

    def _advance(self, now_us: int, state: VehicleState | None) -> None:
        """Advance the mission, and request from the autopilot what its phase needs."""
        mission = self._mission
        controlled = mission.had_control
        for command in self._state_machine.step(self._phase_inputs(now_us, state)):
            self._ports.commands.request(command)
        if mission.pilot_override:
            self._alerts.put("override", mission.outcome, now_us)
        self._start_conditions.compare_heights(now_us, state, self._world_model.statuses.standing_m)
        self._start_conditions.report(now_us)
        self._destination.update(now_us)
        self._mission_end.step(now_us)
        self._vehicle_setup.step(now_us)
        if mission.had_control and not controlled:
            self._own_state.reset()
            self._planner.reset()
        now = (mission.phase, self._modes.mode, self._ports.autopilot.mode)
        if now != self._announced:
            self._announced = now
            names = {"phase": now[0].name, "mode": now[1].name, "flight_mode": now[2].name}
            self._ports.note("state", **names, reason=self._modes.decision.reason)

    def _phase_inputs(self, now_us: int, state: VehicleState | None) -> PhaseInputs:
        autopilot, directive, phase = self._ports.autopilot, self._planner.directive, self._mission.phase
        utc_us, accuracy_m = self._ports.utc_of_us(now_us), autopilot.pos_accuracy_m
        others_ned_m = partial(self._world_model.others_ned_m, utc_us)
        return PhaseInputs(
            now_us=now_us,
            utc_us=utc_us,
            state=state,
            prepared=self._vehicle_setup.ready,
            armable=autopilot.armable,
            busy=self._ports.commands.busy,
            mode=self._modes.mode,
            unresponsive_peer=directive.unresponsive_peer,
            cut_off=directive.cut_off or self._controller_watch.suspended,
            peers=self._world_model.statuses.inputs,
            excused=self._world_model.statuses.excused,
            others_ned_m=others_ned_m,
            obstacles=self._world_model.obstacles.at_rest,
            moving_obstacles=partial(self._world_model.obstacles.moving, utc_us),
            arm_in=None if autopilot.dialect is None else autopilot.dialect.arm_in,
            boots=autopilot.clock.boots,
            refusal=self._vehicle_setup.refusal if phase <= Phase.ARM else "",
            unsettled=self._start_conditions.unsettled(
                now_us, accuracy_m, state, others_ned_m, self._world_model.statuses.codes
            ),
            too_slow=self._start_conditions.too_slow(now_us, self._deadlines.missed_01),
            missed_01=self._deadlines.missed_01,
            overload=self._deadlines.level,
            escalation=self._modes.escalation,
            setpoints_stopped=self._deadlines.stop_cause(now_us),
            armed_told_us=autopilot.armed_told_us,
        )

    def _report_refusals(self, now_us: int) -> None:
        """Report messages of the bus, and frames of the vehicle, that were refused, and clocks that differ."""
        if apart := self._world_model.clocks.alert:
            self._alerts.put("clocks", apart, now_us)
        if refused := self._world_model.refusals.alert(self._ports.clock.utc_us()):
            self._alerts.put("bus", refused, now_us)
        self._vehicle_watch.report_refused_frames(now_us)
