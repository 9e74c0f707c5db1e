"""One agent: `tick(now)` listens, senses, thinks, judges, acts, shares and records. Nothing else happens anywhere.

It has no thread, socket, sleep or simulation branch: transport, bus, slow path, clock and recorder are handed in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from swarmctl.agent.alerts import Alerts
from swarmctl.agent.components import (
    make_controllers,
    make_coordination,
    make_estimator,
    make_last_layer,
    make_sequence,
)
from swarmctl.agent.reference_selector import Wayfinder
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.telemetry_publisher import Act, Reporter, Thought, TickSink, Took
from swarmctl.agent.world_model import FLOWN_BY_AGENT, Surroundings
from swarmctl.bus import topics
from swarmctl.bus.peers import Bus
from swarmctl.control.collision.separation import KeepOut, radius_problem
from swarmctl.control.estimation.accuracy import AccuracyMonitor
from swarmctl.control.estimation.constant_velocity import coasting
from swarmctl.control.fallback import rest_plan
from swarmctl.control.model import Predictor
from swarmctl.control.mpc.plan_buffer import Replay
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.phases.failsafe import Judgement, judge
from swarmctl.control.phases.inputs import Facts
from swarmctl.control.phases.overload import Level, Overload
from swarmctl.control.setpoint import setpoint_of
from swarmctl.core.clock import Clock
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.types import (
    MAX_RADIUS_M,
    NO_TIMES,
    Array,
    AttitudeSetpoint,
    FlightMode,
    Health,
    Landed,
    Mode,
    Phase,
    Plan,
    PlanStatus,
    PredictedPath,
    Reference,
    TickRecord,
    VehicleState,
)
from swarmctl.mavlink.autopilot import Autopilot
from swarmctl.mavlink.commands import CommandPort
from swarmctl.mavlink.vehicle_setup import VehicleSetup

_NOTHING_US = -1
_DEVIATES = (Mode.BRAKE, Mode.HOLD, Mode.LAND, Mode.YIELD, Mode.BLIND)  # from what it has promised
_WAITS_LONG_US = 3_000_000  # for take-off, before it says for what
_RESTORE_US = 5_000_000  # for parameters to be set back before the process ends
_AUTOPILOT_HOVERS = (FlightMode.HOLD, FlightMode.EXTERNAL)  # in the latter while it takes off by itself


class Agent:
    """See the module. `stopwatch_ns` only measures the tick; it never influences it."""

    def __init__(
        self,
        setup: AgentSetup,
        autopilot: Autopilot,
        commands: CommandPort,
        bus: Bus,
        clock: Clock,
        sink: TickSink,
        stopwatch_ns: Callable[[], int],
    ) -> None:
        self._setup, self._autopilot, self._commands = setup, autopilot, commands
        self._bus, self._clock, self._sink, self._stopwatch_ns = bus, clock, sink, stopwatch_ns
        self._vehicle_setup = VehicleSetup(
            autopilot, commands, setup.params.autopilot_params, setup.sysid, setup.params.sequence.state_rate_hz
        )
        self._surroundings = Surroundings(
            setup.agent, setup.peers, setup.separation, bus, setup.params.rate_hz, self._note
        )
        self._coordination = make_coordination(setup, self._surroundings, bus, self._note, stopwatch_ns)
        self._controller, self._transit = make_controllers(setup, stopwatch_ns)
        self._observer = make_estimator(setup)
        self._predictor = Predictor(setup.vehicle_model)
        self._last_layer = make_last_layer(setup, self._surroundings, self._note, stopwatch_ns)
        self._sequence = make_sequence(setup)
        self._wayfinder = Wayfinder(setup, self._sequence, self._note)
        self._judgement = Judgement(Mode.IDLE, "")
        self._virtual = np.array([0.0, 0.0, GRAVITY_M_S2])
        self._replay = Replay(setup.agent, self._controller.dt_us, self._controller.steps, setup.separation.brake_m_s2)
        self._certified_us: int | None = None
        self._hold_at: Array | None = None
        self._reporter = Reporter(
            setup.agent,
            setup.boot_id,
            setup.sysid,
            setup.promises,
            autopilot,
            self._surroundings.paths,
            bus,
            clock,
            sink,
        )
        self.took = Took(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the last tick
        self._promise_ns = 0  # of the last tick
        self._gaps = self._jumps = 0  # of setpoints and of the estimate, as far as they have been told
        self._announced: tuple[Phase, Mode, FlightMode] | None = None
        self._alerts = Alerts()
        self._accuracy = AccuracyMonitor()
        self._standby_us = 0
        self._overload = Overload(setup.params.overload, round(1e6 / setup.params.rate_hz))
        self._done_us: int | None = None
        self._last_state_us = _NOTHING_US
        self._thrust_01 = setup.vehicle_model.hover_thrust_01

    @property
    def done(self) -> bool:
        """Landed, disarmed, and its parameters as they were."""
        if self._done_us is None:
            return False
        return self._vehicle_setup.restored or self._clock.now_us() - self._done_us > _RESTORE_US

    @property
    def finished(self) -> bool:
        """Done, and so is every peer that is still there."""
        return self.done and all(p.phase is Phase.DONE or not p.alive for p in self._surroundings.peers().values())

    @property
    def outcome(self) -> str:
        """ "completed", or why not."""
        return self._sequence.outcome or "stopped before the mission began"

    @property
    def has_armed(self) -> bool:
        """Whether the autopilot has been asked to arm: before that a mission that ends could not start."""
        return self._sequence.arming.requested

    @property
    def rejected(self) -> dict[str, int]:
        """Bus messages refused so far, by reason."""
        return dict(self._surroundings.refusals.by_reason)

    @property
    def commits_refused(self) -> int | None:
        """Proposals that were not flown after peers had been heard; None unless separation is guaranteed."""
        counts = None if self._coordination is None else self._coordination.counts
        return None if counts is None else counts.withdrawn + counts.expired

    def ask(self, verb: str, now_us: int) -> None:
        """An operator's wish: hold, resume, land, rtl."""
        self._sequence.operator(verb, now_us, self._clock.utc_us(), self._autopilot.poll(now_us))
        self._note("operator", verb=verb)

    def tick(self, now_us: int, late_ticks: int) -> TickRecord:
        """One control step at monotonic time `now_us`, with the deadlines missed so far."""
        began_ns = self._stopwatch_ns()
        self._watch_deadlines(now_us, late_ticks)
        self._listen(now_us)
        state = self._sense(now_us)
        self._sequence.begin_if_due(now_us, self._clock.utc_us())
        sensed_ns = self._stopwatch_ns()
        thought = self._think(now_us, state)
        thought_ns = self._stopwatch_ns()
        self._judge(now_us, state, thought)
        flown = self._flown(state, thought)
        setpoint = self._act(now_us, flown, thought.start)
        sent_ns = self._stopwatch_ns()
        times = NO_TIMES if thought.plan is None else thought.plan.times
        self.took = Took(
            (sensed_ns - began_ns) * 1e-6,
            (thought_ns - sensed_ns - self._promise_ns) * 1e-6
            - (times.spaces_us + times.solve_us + times.certify_us) * 1e-3,
            self._promise_ns * 1e-6,
            times.spaces_us * 1e-3,
            times.solve_us * 1e-3,
            times.certify_us * 1e-3,
            self._last_layer.took_ms,
            (sent_ns - thought_ns) * 1e-6 - self._last_layer.took_ms,
        )
        self._share(state, flown)
        self._advance(now_us, state)
        refusals = self._surroundings.refusals.alert(self._clock.utc_us())
        if refusals:
            self._alerts.put("bus", refusals, now_us)
        self._reporter.problem = self._alerts.text(now_us)
        return self._reporter.report(
            now_us,
            state,
            thought,
            Act(self._judgement.mode, flown, setpoint, self._last_layer.acts),
            self._sequence,
            self._observer.estimate,
            late_ticks,
            self.took,
        )

    def _watch_deadlines(self, now_us: int, late_ticks: int) -> None:
        before = self._overload.level
        self._overload.update(now_us, late_ticks)
        level = self._overload.level
        if level is not Level.NONE:
            self._alerts.put("overload", self._overload.text(), now_us)
        if level is not before:
            self._note("overload", level=level.name, missed_01=round(self._overload.missed_01, 3))

    # -- listen, sense ------------------------------------------------------------------------------------------------

    def _listen(self, now_us: int) -> None:
        for verb in self._surroundings.listen(self._clock.utc_us()):
            self.ask(verb, now_us)
        if self._coordination is not None:
            self._coordination.listen(self._clock.utc_us())

    def _sense(self, now_us: int) -> VehicleState | None:
        state = self._autopilot.poll(now_us)
        self._commands.step(now_us)
        for result in self._commands.results():
            self._vehicle_setup.took(result)
            asked = f"{result.command.verb.value} {result.command.name}".rstrip()
            if result.ok:
                self._alerts.clear(asked)
            else:
                self._alerts.put(asked, f"{asked} refused: {result.text}", now_us)
            self._note("command", verb=asked, ok=result.ok, text=result.text)
        frame = self._autopilot.frame
        if frame.jumps != self._jumps:
            self._jumps = frame.jumps
            text = f"estimate jumped by {frame.jump_m:.1f} m: peers keep that much more away"
            self._alerts.put("jump", text, now_us)
            self._note("estimate_jumped", metres=frame.jump_m)
        if state is None or state.t_us == self._last_state_us:
            return state
        self._last_state_us = state.t_us
        self._observer.update(state, self._thrust_01 if self._sequence.had_control else None)
        if self._sequence.had_control:
            return state
        if self._autopilot.hover_thrust_01 is not None and state.mode in _AUTOPILOT_HOVERS:
            self._observer.learn_hover(self._autopilot.hover_thrust_01 * float(body_z_ned(state.q_nb)[2]))
        return state

    # -- think --------------------------------------------------------------------------------------------------------

    def _think(self, now_us: int, state: VehicleState | None) -> Thought:
        self._promise_ns = 0
        if state is None or not self._fresh(now_us, state):
            if self._coordination is not None:  # the autopilot flies it, blindly or by its failsafe
                self._coordination.idle(self._clock.utc_us(), state)
            return Thought(None, None, None, [])
        estimate = self._observer.estimate
        act_us = now_us + self._predictor.delay_us
        if self._sequence.had_control:
            start = self._predictor.start(
                self._observer.state(state), act_us, estimate.disturbance_ned_m_s2, self._virtual
            )
        else:
            self._virtual = np.array([0.0, 0.0, GRAVITY_M_S2])
            upright = float(body_z_ned(state.q_nb)[2])
            start = Start(act_us, state.pos_ned_m, state.vel_ned_m_s, upright, self._virtual)
        steps, dt_us = self._controller.steps, self._controller.dt_us
        keep_outs = self._surroundings.keep_outs(state.pos_ned_m, self._utc(act_us), dt_us, steps, self._sequence.phase)
        flies = Phase.GOTO_START <= self._sequence.phase <= Phase.GOTO_LAND
        self._look_for_deadlock(now_us, state, keep_outs, flies)
        grid = np.arange(self._controller.longest + 1, dtype=np.float64)
        ahead_s = self._predictor.delay_us * 1e-6 + dt_us * 1e-6 * grid
        reference, now_ref = self._wayfinder.reference(now_us, self._clock.utc_us(), ahead_s)
        promised = self._coordinated(now_us, state, flies)
        if not flies:
            return Thought(start, None, now_ref, keep_outs)
        if promised is not None:
            reference = promised
        guess = self._replay.guess_ned_m(act_us)
        controller = self._controller if self._sequence.phase is Phase.TRACK else self._transit
        kept = tuple(keep_outs) if promised is None else ()  # what it has promised keeps clear already
        plan = controller.plan(Problem(start, reference, estimate.disturbance_ned_m_s2, kept, guess))
        return Thought(start, plan, now_ref, keep_outs)

    def _coordinated(self, now_us: int, state: VehicleState, flies: bool) -> Reference | None:
        """What has been promised, over the horizon from when the setpoint acts; None when nothing is."""
        if self._coordination is None:
            return None
        utc_us, began_ns = self._clock.utc_us(), self._stopwatch_ns()
        if not (flies and self._sequence.had_control) or self._judgement.mode in _DEVIATES:
            self._coordination.idle(utc_us, state)
            return None
        self._coordination.step(utc_us, state, self._sequence.phase, self._wayfinder.wish(now_us, utc_us))
        self._promise_ns = self._stopwatch_ns() - began_ns
        act_us = utc_us + self._predictor.delay_us
        pos, vel = self._coordination.follow(act_us + np.arange(self._controller.longest + 1) * self._controller.dt_us)
        return Reference(pos, vel, self._setup.mission.yaw_rad)

    def _look_for_deadlock(self, now_us: int, state: VehicleState, keep_outs: list[KeepOut], flies: bool) -> None:
        if not (flies and self._sequence.had_control):
            self._wayfinder.rest(now_us)
            return
        known = [*keep_outs, *(self._coordination.left_behind if self._coordination else ())]
        landmarks = self._surroundings.landmarks
        deadlock = self._wayfinder.look(now_us, self._clock.utc_us(), state.pos_ned_m, known, landmarks)
        if deadlock is not None:
            self._alerts.put("deadlock", f"deadlocked by {deadlock.names}", now_us)

    # -- judge, act ---------------------------------------------------------------------------------------------------

    def _judge(self, now_us: int, state: VehicleState | None, thought: Thought) -> None:
        plan = thought.plan
        if plan is None:
            self._certified_us = now_us  # none was asked for
        if plan is not None:
            assert thought.start is not None
            self._replay.take(plan, thought.start, thought.keep_outs, partial(self._rest, thought.start))
        if plan is not None and plan.status is PlanStatus.OK:
            self._certified_us = now_us
        elif plan is not None:
            self._reporter.failed_plans += 1
            self._alerts.put("plan", f"plan {plan.status.name.lower()}", now_us)
        good = self._replay.plan
        delay_us = self._predictor.delay_us
        health = Health(
            _NOTHING_US if state is None else max(0, now_us - state.t_us),
            state is not None and state.armed,
            FlightMode.UNKNOWN if state is None else state.mode,
            Landed.UNKNOWN if state is None else state.landed,
            state is not None and state.failsafe,
            PlanStatus.NONE if plan is None else plan.status,
            _NOTHING_US if good is None else now_us + delay_us - good.t0_us,
            0 if self._certified_us is None else now_us - self._certified_us,
            0.0 if state is None else math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s)),
            self._sequence.phase,
            self._sequence.had_control,
            self._sequence.yielded,
        )
        self._judgement = judge(health, self._setup.params.failsafe)

    def _rest(self, start: Start) -> Plan:
        disturbance = self._observer.estimate.disturbance_ned_m_s2
        lag = self._setup.vehicle_model.lag()
        return rest_plan(start, self._hold_at, disturbance, lag, self._controller.dt_us, self._controller.steps)

    def _flown(self, state: VehicleState | None, thought: Thought) -> Plan | None:
        """The plan whose first input is sent and whose path is shared; None when the autopilot flies."""
        mode = self._judgement.mode
        if mode is not Mode.HOLD:
            self._hold_at = None
        if thought.start is None or state is None:
            return None
        if mode in (Mode.FOLLOW, Mode.STREAM):
            return thought.plan
        if mode is Mode.REPLAY:
            return self._replay.plan
        if mode in (Mode.BRAKE, Mode.HOLD):
            if mode is Mode.HOLD and self._hold_at is None:
                self._hold_at = state.pos_ned_m
            return self._rest(thought.start)
        return None

    def _act(self, now_us: int, flown: Plan | None, start: Start | None) -> AttitudeSetpoint | None:
        if flown is None or start is None:
            self._last_layer.rest(now_us)
            return None
        act_us = now_us + self._predictor.delay_us
        step = min(max(0, (act_us - flown.t0_us) // flown.dt_us), len(flown.virtual) - 1)
        estimate, flies = self._observer.estimate, self._judgement.mode in FLOWN_BY_AGENT
        virtual = self._last_layer.keep_apart(now_us, self._utc(act_us), flown.virtual[step], start, estimate, flies)
        yaw_rad, hover_01 = self._setup.mission.yaw_rad, estimate.hover_thrust_01
        setpoint = setpoint_of(virtual, yaw_rad, hover_01, now_us, self._setup.vehicle_model)
        refused = self._autopilot.send(setpoint, self._clock.now_us())
        if refused:
            self._alerts.put("setpoint", f"setpoint refused: {refused}", now_us)
            self._note("setpoint_refused", reason=refused)
            return None
        if self._autopilot.gaps != self._gaps:
            self._gaps, gap_s = self._autopilot.gaps, self._autopilot.gap_s
            text = f"setpoints had stopped for {gap_s:.2f} s: the autopilot's failsafe may have acted"
            self._alerts.put("gap", text, now_us)
            self._note("setpoint_gap", seconds=gap_s)
        self._virtual, self._thrust_01 = virtual, setpoint.thrust_01
        self._predictor.sent(now_us, virtual)
        return setpoint

    def _advance(self, now_us: int, state: VehicleState | None) -> None:
        before = self._sequence.phase, self._sequence.had_control
        utc_us, dialect = self._clock.utc_us(), self._autopilot.dialect
        facts = Facts(
            now_us,
            utc_us,
            state,
            self._vehicle_setup.ready,
            self._autopilot.armable,
            self._commands.busy,
            self._judgement.mode,
            self._coordination is None and self._surroundings.somebody_is_mute(utc_us),
            self._surroundings.peers(),
            others_ned_m=self._surroundings.others_ned_m(utc_us),
            arm_in=None if dialect is None else dialect.arm_in,
            boots=self._autopilot.clock.boots,
            refusal=self._vehicle_setup.refusal,
            unsettled=self._unsettled(now_us),
            overload=self._overload.level,
            armed_told_us=self._autopilot.armed_told_us,
        )
        for command in self._sequence.step(facts):
            self._commands.request(command)
        self._tell_what_is_waited_for(now_us)
        self._give_parameters_back(now_us)
        self._vehicle_setup.step(now_us)
        if not before[1] and self._sequence.had_control:
            self._predictor.clear()
            self._observer.reset()
            self._controller.reset()
        now = (self._sequence.phase, self._judgement.mode, self._autopilot.mode)
        if now != self._announced:
            self._announced = now
            names = {"phase": now[0].name, "mode": now[1].name, "flight_mode": now[2].name}
            self._note("state", **names, reason=self._judgement.reason)

    def _tell_what_is_waited_for(self, now_us: int) -> None:
        waits_for = self._sequence.waits_for
        if self._sequence.phase is not Phase.STANDBY:
            self._standby_us = now_us
        elif waits_for and now_us - self._standby_us > _WAITS_LONG_US:
            self._alerts.put("start", f"waits for {waits_for}", now_us)

    def _give_parameters_back(self, now_us: int) -> None:
        """Once the mission has ended: set the autopilot's parameters back, and say which of them could not be."""
        if not self._sequence.finished:
            return
        if self._done_us is None:
            self._done_us = now_us
            self._vehicle_setup.restore()
        left = self._vehicle_setup.left_changed
        if left and self.done and self._alerts.put("restore", f"parameters left changed, they were: {left}", now_us):
            self._note("parameters_left_changed", were=left)

    def _unsettled(self, now_us: int) -> str:
        """Why nothing may be armed yet: the estimator settles, or is too inaccurate for the distances asked for."""
        if len(self._setup.starts_ned_m) == 1 or self._sequence.phase > Phase.STANDBY:
            return ""
        self._accuracy.update(now_us, self._autopilot.pos_accuracy_m)
        accuracy_m = self._accuracy.worst_m or 0.0  # not told: body and tracking are left to judge by
        return self._accuracy.unsettled(now_us) or radius_problem(self._setup.separation, accuracy_m)

    # -- share, record ------------------------------------------------------------------------------------------------

    def _share(self, state: VehicleState | None, flown: Plan | None) -> None:
        if state is not None:
            self._bus.publish(topics.PATH, topics.encode_path(self._path(state, flown)))
        if self._coordination is not None:
            self._coordination.say(self._clock.utc_us())

    def _path(self, state: VehicleState, flown: Plan | None) -> PredictedPath:
        setup, seq = self._setup, self._reporter.seq
        margin_m = min(MAX_RADIUS_M, self._autopilot.frame.margin_m + self._overload.margin_m)
        if flown is not None:
            t0_us, dt_us, pos = self._utc(flown.t0_us), flown.dt_us, flown.pos_ned_m
            return PredictedPath(setup.agent, setup.boot_id, seq, t0_us, dt_us, margin_m, pos)
        act_us, dt_us = self._clock.now_us() + self._predictor.delay_us, self._controller.dt_us
        grid = np.arange(self._controller.steps + 1, dtype=np.float64)
        ahead_s = grid * (dt_us * 1e-6) + (act_us - state.t_us) * 1e-6
        pos = coasting(state, ahead_s, setup.separation.brake_m_s2)
        return PredictedPath(setup.agent, setup.boot_id, seq, self._utc(act_us), dt_us, margin_m, pos)

    def _fresh(self, now_us: int, state: VehicleState) -> bool:
        return now_us - state.t_us <= self._setup.params.failsafe.state_max_age_s * 1e6

    def _utc(self, t_us: int) -> int:
        """UTC of a monotonic time of this process."""
        return self._clock.utc_us() + t_us - self._clock.now_us()

    def _note(self, name: str, **fields: Any) -> None:
        self._sink.event(name, self._clock.now_us(), self._clock.utc_us(), **fields)
