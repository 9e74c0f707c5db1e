"""State machine of one agent's mission: the requests to the autopilot and the reference to follow in each phase.

Pure. Agents agree on the start of the mission without a leader: each publishes when it became ready, and all start one
second after the latest of these times. The operator's orders (`core.operator_verbs`) are applied here too. A
vehicle found in the air at start-up is handed back in the air, in the autopilot's hold.

The machine decides what happens when: the phase, who has control, the requests. Which trajectory is flown meanwhile is
known to `Trajectories`, what holds or pauses the agent to `Interruptions`, and where it may land to `Landing`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from swarmctl.control.phases.arming import ArmingEvidence
from swarmctl.control.phases.control_mode import control_mode
from swarmctl.control.phases.departure import Climb, names_of, unmet_start_condition
from swarmctl.control.phases.failsafe import Response
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.interruptions import HoldPoint, Interruptions
from swarmctl.control.phases.landing import Landing
from swarmctl.control.phases.overload import Level
from swarmctl.control.phases.refused_orders import Contains, OrderSituation, refusal_of
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.phases.trajectories import OfferedMission, Trajectories, is_at
from swarmctl.control.reference.mission import MissionReference
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.operator_verbs import BEGIN, GOTO, MISSION, OPERATOR_VERBS, POINT, SPEED, YAW, Order
from swarmctl.core.types import Array, Command, FlightMode, Landed, Mode, Phase, VehicleState, Verb

_REQUEST_PERIOD_US = 1_000_000  # time between repetitions of a request
_SPIN_UP_US = 6_000_000  # ArduCopter's rotors spin up for over 3 s, during which it refuses a second TAKEOFF
BEGIN_DELAY_US = 1_000_000  # from the last agent's readiness to mission time 0; several statuses are sent meanwhile
_LEAST_HEIGHT_M = 0.5  # above the ground, of a point to go to
_PLAN_MODES = (Mode.TRACKING, Mode.REPLAY)
_OWN_MODES = (FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.EXTERNAL)  # modes that follow from our own requests
OPERATOR_STOP = "stopped by the operator"
TAKEN_OVER = "pilot or autopilot took over"
REBOOTED = "the autopilot rebooted"
OVERLOADED = "overload: deadlines were missed for too long"


class MissionStateMachine:
    """Moves one agent through the phases of its mission.

    Args:
        params: speeds, tolerances and timeouts.
        agent: index of this agent.
        peers: number of the other agents.
        landing_m: level distance to others at which it may land in place.
        start_ned_m: (3,) start position, also the landing place.
        duration_s: duration of the tracked mission.
        reference: reference of the tracked mission.
        contains: whether a place lies within the geofence.
        volume: to stay in; None for none.

    Attributes:
        phase: current phase.
        ready_utc_us: UTC at which the start position was reached, 0 before.
        begin_utc_us: UTC of mission time 0, None until all are ready.
        outcome: "completed", or why the mission was not; "" while it is under way.
        waits_for: unmet condition that keeps the vehicle on the ground, or from beginning the mission; or "".
        had_control: the autopilot follows our setpoints and control has not been given back.
        pilot_override: pilot or autopilot took over; lasts until an operator resumes.
        offered: the mission that the order `mission` has flown.
    """

    def __init__(
        self,
        params: StateMachineParams,
        agent: int,
        peers: int,
        landing_m: float,
        *,
        start_ned_m: Array,
        duration_s: float,
        reference: MissionReference,
        contains: Contains = lambda _: True,
        volume: FlightVolume | None = None,
    ) -> None:
        self._params, self._contains, self._volume = params, contains, volume
        self._peers = frozenset(range(peers + 1)) - {agent}
        self._start_ned_m, self._duration_us, self._reference = start_ned_m, round(duration_s * 1e6), reference
        self.phase = Phase.CONNECT
        self.ready_utc_us = 0
        self.begin_utc_us: int | None = None
        self.outcome = ""
        self.waits_for = ""
        self.arming = ArmingEvidence()
        self._stop_verb = ""  # land or rtl, from the command until the stop begins
        self.had_control = False
        self._climb = Climb(start_ned_m)
        self._trajectories = Trajectories(
            reference, start_ned_m, speed_m_s=params.speed_m_s, accel_m_s2=params.accel_m_s2
        )
        self._interruptions = Interruptions(self._trajectories)
        self._landing = Landing(
            params, agent, landing_m, start_ned_m=start_ned_m, trajectories=self._trajectories, volume=volume
        )
        self.offered: OfferedMission | None = None
        self._entered_us = 0
        self._first_tick_us: int | None = None
        self._requested_us = -_REQUEST_PERIOD_US
        self._boots = 0
        self.pilot_override = False
        self._airborne = False
        self._may_take_control = False  # an operator's resume permits taking control from any mode
        self._landing_seen = False
        self._outcome_before = ""  # outcome before the override, restored by resume
        self._setpoints_stopped = False  # which the override has followed from
        self._steps: dict[Phase, Callable[[PhaseInputs, VehicleState], list[Command]]] = {
            Phase.STANDBY: self._standby,
            Phase.ARM: self._arm,
            Phase.TAKEOFF: self._takeoff,
            Phase.GOTO_START: self._goto_start,
            Phase.READY: self._ready,
            Phase.TRACK: self._track,
            Phase.GOTO_LAND: self._goto_land,
            Phase.LAND: self._land,
        }
        self._order_handlers = {
            "hold": self._hold,
            "resume": self._resume,
            GOTO: self._goto,
            MISSION: self._change_mission,
        }  # stops are in `_apply_stop`

    @property
    def finished(self) -> bool:
        return self.phase is Phase.DONE

    @property
    def held(self) -> bool:
        """Return whether the operator has asked to hold, or to go to a point."""
        return self._interruptions.held

    @property
    def yaw_rad(self) -> float | None:
        """Return the heading that the operator has asked for, None for the mission's."""
        return self._interruptions.yaw_rad

    def step(self, inputs: PhaseInputs) -> list[Command]:
        """Advance by one tick; returns the requests to the autopilot."""
        self._first_tick_us = inputs.now_us if self._first_tick_us is None else self._first_tick_us
        self.arming.update(inputs)
        state = inputs.state
        if inputs.boots != self._boots:
            self._boots = inputs.boots
            if Phase.ARM <= self.phase < Phase.DONE and not self.pilot_override:
                self._override(REBOOTED)
        if state is None:
            return []
        self._apply_stop(inputs.now_us, state)
        if self.phase is Phase.CONNECT and inputs.prepared:  # peers arm as soon as all agents stand by
            self._enter(Phase.STANDBY, inputs.now_us)
            return self._refuse(inputs.refusal, inputs) if inputs.refusal else []
        if inputs.mode is Mode.PILOT_OVERRIDE and not self.pilot_override:
            self._take_over(inputs)
        if self.pilot_override:
            if self._is_down(inputs, state):
                self._enter(Phase.DONE, inputs.now_us)
            return []
        if inputs.mode is Mode.LAND and self.phase < Phase.LAND:
            self._give_up("no plan for too long", inputs, state)
        if inputs.overload is Level.LAND and self._may_fly_on:
            self._give_up(OVERLOADED, inputs, state)
        if inputs.cut_off and self._may_fly_on:
            self._give_up(inputs.cut_off, inputs, state)
        self._escalate(inputs, state)
        self._pause(inputs, state)
        if state.mode is FlightMode.EXTERNAL and Phase.GOTO_START <= self.phase < Phase.LAND:
            self._take_control(inputs, state)
        patience_us = self._params.start_timeout_s * 1e6
        if self.phase < Phase.TRACK and not self.held and inputs.now_us - self._first_tick_us > patience_us:
            cause = f"not tracking after {self._params.start_timeout_s:.0f} s ({self.phase.name})"
            self._give_up(f"{cause}: {self.waits_for}" if self.waits_for else cause, inputs, state)
        handler = self._steps.get(self.phase)
        return handler(inputs, state) if handler else []

    def reference(self, utc_us: int, now_us: int, offsets_s: Array) -> tuple[Array, Array]:
        """Return reference positions and velocities, (K, 3) each, NED, at `offsets_s` (K,) from now."""
        if self._follows_mission and self.begin_utc_us is not None:
            return self._trajectories.mission_reference(self.mission_t_s(utc_us), now_us, offsets_s)
        return self._trajectories.reference(now_us, offsets_s)

    @property
    def place_offset_ned_m(self) -> Array:
        """Return by how much the present reference (3,) is beside the one that several agents share."""
        return self._reference.offset_ned_m if self._follows_mission else np.zeros(3)

    def mission_yaw_rad(self, utc_us: int) -> float | None:
        """Return the yaw of the mission's reference now; None while that is not followed."""
        if not self._follows_mission or self.begin_utc_us is None:
            return None
        return self._reference.yaw_at_rad(self.mission_t_s(utc_us))

    @property
    def _follows_mission(self) -> bool:
        return self.phase is Phase.TRACK and not self._interruptions.active

    @property
    def _may_fly_on(self) -> bool:
        """Return whether the agent is not on its way to land, or is held there for as long as the operator likes."""
        return self.phase < Phase.GOTO_LAND or (self.held and self.phase is Phase.GOTO_LAND)

    def control_mode(self, mode: Mode) -> str:
        """Return what the vehicle is doing, for the operator; `mode` is that of the tick."""
        return control_mode(
            self.phase,
            Mode.PILOT_OVERRIDE if self.pilot_override and mode is not Mode.STATE_STALE else mode,
            held=self.held,
            goes_to_point=self._interruptions.goes_to_point,
            paused=self._interruptions.paused,
            lands_in_place=self._landing.in_place,
            setpoints_stopped=self._setpoints_stopped,
        )

    def begin_if_due(self, now_us: int, utc_us: int) -> None:
        """Enter TRACK on time. Called before planning, so that the first plan of the mission follows its reference."""
        if self.phase is Phase.READY and self.begin_utc_us is not None and utc_us >= self.begin_utc_us:
            self._enter(Phase.TRACK, now_us)

    def mission_t_s(self, utc_us: int) -> float:
        """Return the mission time [s] while tracking, else NaN."""
        if self.phase is not Phase.TRACK or self.begin_utc_us is None:
            return math.nan
        return (utc_us - self.begin_utc_us) * 1e-6

    def ends_in_s(self, now_us: int, utc_us: int) -> float:
        """Return when the mission, or what precedes or follows it, ends by itself [s]; NaN: it does not."""
        if self.held or self.pilot_override or self._first_tick_us is None:
            return math.nan
        if self.phase < Phase.TRACK:
            return self._params.start_timeout_s - (now_us - self._first_tick_us) * 1e-6
        if self.phase is Phase.GOTO_LAND:
            return self._params.land_timeout_s - (now_us - self._entered_us) * 1e-6
        return self._duration_us * 1e-6 - self.mission_t_s(utc_us)

    def operator(self, order: Order, now_us: int, utc_us: int, state: VehicleState | None) -> str:
        """Apply an operator's order; return why it is refused, or "".

        A stop (land, rtl) is kept until a vehicle state is known to begin it from, so it is lost in no phase.
        """
        situation = OrderSituation(
            phase=self.phase,
            state=state,
            pilot_override=self.pilot_override,
            other_control=state is not None and _is_under_other_control(state),
            lands_in_place=self._landing.in_place,
            controls=self.had_control,
            paused=self._interruptions.paused,
            lowest_m=self._lowest_m,
            contains=self._contains,
            volume=self._volume,
        )
        if refusal := refusal_of(order, situation):
            return refusal
        if OPERATOR_VERBS[order.verb].is_stop:
            self._stop_verb = order.verb
        if state is None:
            return ""
        self._apply_stop(now_us, state)
        if order.verb in self._order_handlers:
            self._order_handlers[order.verb](order, now_us, utc_us, state)
        return ""

    def _hold(self, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
        if not self.held:
            self._requested_us = now_us - _SPIN_UP_US  # on the way up the autopilot is asked at once
        autopilot_hovers = self.phase <= Phase.GOTO_START and not self.had_control
        self._interruptions.hold(now_us, state, brakes=not autopilot_hovers)

    def _goto(self, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
        self._hold(order, now_us, utc_us, state)
        arguments = order.arguments
        point = HoldPoint(
            ned_m=np.array([arguments[name] for name in POINT]),
            speed_m_s=arguments.get(SPEED),
            yaw_rad=math.radians(arguments[YAW]) if YAW in arguments else None,
        )
        self._interruptions.move_hold(point, now_us, state)

    def _change_mission(self, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
        """Fly the mission that is offered: from its begin on where one is flown already, else when all are ready."""
        assert self.offered is not None
        self._reference, self._duration_us = self.offered.reference, round(self.offered.duration_s * 1e6)
        self._trajectories.change_mission(self._reference)
        if self.phase is Phase.TRACK:
            self.begin_utc_us = round(order.arguments[BEGIN] * 1e6)
            if not self._interruptions.active:
                self._rejoin_mission(now_us, utc_us, state)

    @property
    def _lowest_m(self) -> float:
        """Return the down coordinate that a point to go to may not be below: the ground's is known after a take-off."""
        return float(self._start_ned_m[2]) if self._airborne else self._climb.ground_z_m - _LEAST_HEIGHT_M

    def _go_on(self, now_us: int, utc_us: int, state: VehicleState) -> None:
        """Go on with what was interrupted: the transit, or the mission."""
        if self.phase in (Phase.GOTO_START, Phase.READY, Phase.GOTO_LAND):
            self._trajectories.go_to(self._trajectories.destination_ned_m, now_us, state)
        else:
            self._rejoin_mission(now_us, utc_us, state)

    def _resume(self, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
        if self.held:
            self._release(now_us, state)
            if not self._interruptions.paused:
                self._go_on(now_us, utc_us, state)
        elif self.pilot_override:
            self._rejoin_mission(now_us, utc_us, state)
        if self.pilot_override:
            self.pilot_override, self.outcome, self._may_take_control = False, self._outcome_before, True

    def _release(self, now_us: int, state: VehicleState) -> None:
        """End a hold: timeouts have not run meanwhile."""
        self._interruptions.end_hold()
        self._requested_us = now_us - _SPIN_UP_US
        if self.phase is Phase.TAKEOFF and state.landed is not Landed.ON_GROUND:
            self._climb.cut()
        if self._first_tick_us is not None:
            self._first_tick_us += now_us - self._interruptions.held_since_us
        if self.phase is Phase.GOTO_LAND:
            self._entered_us = now_us

    def _take_over(self, inputs: PhaseInputs) -> None:
        """Leave the vehicle to who has taken it: its autopilot, if setpoints have stopped."""
        stopped = inputs.setpoints_stopped
        self._override(f"{stopped}: the autopilot took over" if stopped else TAKEN_OVER)
        self._setpoints_stopped = bool(stopped)

    def _override(self, why: str) -> None:
        self.pilot_override, self.had_control, self._may_take_control = True, False, False
        self._setpoints_stopped = False
        self._outcome_before = self.outcome
        self.outcome = why

    def _apply_stop(self, now_us: int, state: VehicleState) -> None:
        """Begin the stop that has been commanded, unless it is under way."""
        verb, self._stop_verb = self._stop_verb, ""
        if not verb or self.phase >= Phase.LAND:
            return
        self.outcome = self.outcome or OPERATOR_STOP
        if self.phase < Phase.GOTO_START or self.pilot_override:
            self._enter(Phase.LAND, now_us)  # ends at once if the vehicle is known to be disarmed
        elif verb == "rtl" and self._may_fly_on:
            self._go_home(now_us, state)
        elif verb == "land" and (self.held or not self._landing.in_place):
            self._stop_in_place(now_us, state)

    def _is_down(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether the vehicle is on the ground and known to be disarmed."""
        return state.landed is Landed.ON_GROUND and self.arming.is_disarmed(inputs, state)

    def _escalate(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Fly home, or land, as battery and link ask for; a vehicle on its way home lands where it is, if it has to."""
        response, why = inputs.escalation.response, inputs.escalation.reason
        flies_home = self.phase is Phase.GOTO_LAND and not self._landing.in_place
        controls = self.had_control and inputs.mode in _PLAN_MODES
        if response is Response.RTL and self._may_fly_on and controls:
            self.outcome = self.outcome or f"{why}: flew back"
            self._go_home(inputs.now_us, state)
        elif (response >= Response.RTL and self._may_fly_on) or (response is Response.LAND and flies_home):
            self._give_up(why, inputs, state)

    def _pause(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Come to rest while the bus is lost, because peers then assume braking, and while deadlines are missed."""
        flies = self.had_control and Phase.GOTO_START <= self.phase <= Phase.GOTO_LAND
        must_wait = inputs.unresponsive_peer or inputs.overload >= Level.HOLD
        if self._interruptions.update_pause(inputs.now_us, state, must_wait=must_wait, flies=flies):
            self._go_on(inputs.now_us, inputs.utc_us, state)

    def _rejoin_mission(self, now_us: int, utc_us: int, state: VehicleState) -> None:
        if self.phase is Phase.TRACK and self.begin_utc_us is not None:
            self._trajectories.rejoin_mission(self.mission_t_s(utc_us), now_us, state)

    def _standby(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if not inputs.prepared:  # the autopilot has rebooted since CONNECT
            self.waits_for = "the link to be set up again after a reboot of the autopilot"
            return []
        if inputs.refusal:
            return self._refuse(inputs.refusal, inputs)
        phases = {peer.phase for peer in inputs.peers().values() if peer.alive}
        if Phase.TRACK in phases:  # peers may fly where this vehicle would climb, and its autopilot avoids nobody
            return self._refuse("the mission has begun without it", inputs)
        if phases and max(phases) > Phase.TRACK:
            return self._refuse("a peer gave up before take-off", inputs)
        self.waits_for = unmet_start_condition(inputs, state, self._peers - inputs.excused)
        if not self.waits_for:
            self._climb.begin(state)
            self._airborne = state.landed is Landed.IN_AIR
            self._enter(Phase.ARM, inputs.now_us)
            return []
        stays = state.mode is FlightMode.EXTERNAL and inputs.arm_in is None and not inputs.armable
        if stays and not state.armed and self._may_request(inputs):
            return [Command(verb=Verb.HOLD)]  # PX4 stays in OFFBOARD after a landing, where it can't be armed
        return []

    def _refuse(self, why: str, inputs: PhaseInputs) -> list[Command]:
        """Give up before take-off: nothing is armed any more, and a vehicle that has been armed is disarmed."""
        self.outcome = self.outcome or why
        self._enter(Phase.LAND if self.arming.requested else Phase.DONE, inputs.now_us)
        return []

    def _arm(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if state.armed and self._airborne and not self._may_take_control and _is_under_other_control(state):
            self._override(TAKEN_OVER)  # decided before the first setpoint, which would already take control
            return []
        if state.armed:
            self._enter(Phase.GOTO_START if self._airborne else Phase.TAKEOFF, inputs.now_us)
            return []
        if inputs.refusal:
            return self._refuse(inputs.refusal, inputs)
        if not self._may_request(inputs):
            return []
        if inputs.arm_in not in (None, state.mode):
            return [Command(verb=Verb.EXTERNAL)]
        self.arming.request()
        return [Command(verb=Verb.ARM)]

    def _takeoff(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        climbed = self._climb.update(inputs, state)
        if climbed and not self.held:
            self._enter(Phase.GOTO_START, inputs.now_us)
            return []
        if not state.armed:  # pilot or autopilot disarmed it: it is not armed again
            self._give_up("disarmed before take-off", inputs, state)
            return []
        if self.held:
            ours = state.mode is not FlightMode.HOLD and not _is_under_other_control(state)
            return [Command(verb=Verb.HOLD)] if ours and self._may_request(inputs) else []
        if (
            state.mode is not FlightMode.TAKEOFF
            and state.landed is Landed.ON_GROUND
            and self._may_request(inputs, _SPIN_UP_US)
        ):
            if state.mode is FlightMode.HOLD and inputs.arm_in is not None:  # where a hold has left it
                self._requested_us = inputs.now_us - _SPIN_UP_US
                return [Command(verb=Verb.EXTERNAL)]
            return [Command(verb=Verb.TAKEOFF, value=self._climb.height_m)]
        return []

    def _goto_start(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if not self.had_control:
            if self._trajectories.current is None:
                self._trajectories.stand(inputs.now_us, state)
            return [] if self.held else self._request_control(inputs, state)
        if self._interruptions.active:
            return []
        if self._climb.cut_short:
            self._finish_climb(inputs.now_us, state)
        elif is_at(state, self._start_ned_m, self._params.arrive_m, self._params.arrive_m_s):
            self.ready_utc_us = inputs.utc_us
            self._enter(Phase.READY, inputs.now_us)
        return []

    def _finish_climb(self, now_us: int, state: VehicleState) -> None:
        """Go to the start once the vehicle has climbed to its height."""
        rest = self._trajectories.current
        if rest is not None and is_at(state, rest.trajectory.to_ned_m, self._params.arrive_m, math.inf):
            self._climb.finish()
            self._trajectories.go_to(self._start_ned_m, now_us, state)

    def _request_control(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        """Request control from the autopilot's own hold; from any other mode only after an operator's `resume`.

        No setpoints may be sent meanwhile: PX4 returns to OFFBOARD by itself when they reappear after a failsafe.
        """
        if not self._may_take_control and _is_under_other_control(state):
            self._take_over(inputs)
            return []
        return [Command(verb=Verb.EXTERNAL)] if self._may_request(inputs) else []

    def _ready(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if any(not p.alive or p.phase >= Phase.GOTO_LAND for p in inputs.peers().values()) and not self.held:
            self.outcome = "a peer gave up or was lost before the mission began"
            self._go_home(inputs.now_us, state)
            return []
        ready_us = {agent: peer.ready_utc_us for agent, peer in inputs.peers().items() if peer.ready_utc_us > 0}
        absent = self._peers - inputs.excused - ready_us.keys()
        self.waits_for = f"{names_of(absent)} to reach the start" if absent else ""
        if not absent:
            self.begin_utc_us = max([self.ready_utc_us, *ready_us.values()]) + BEGIN_DELAY_US
        return []

    def _track(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        assert self.begin_utc_us is not None
        if not self.had_control:
            return self._request_control(inputs, state)
        if excess := self._reference.excess(state.pos_ned_m, state.vel_ned_m_s):
            self._give_up(excess, inputs, state)
            return []
        if inputs.utc_us - self.begin_utc_us >= self._duration_us and not self._interruptions.active:
            self.outcome = self.outcome or "completed"
            if self._airborne and not inputs.peers():
                self._enter(Phase.LAND, inputs.now_us)
            elif self._airborne:
                self._stop_in_place(inputs.now_us, state)
            else:
                self._go_home(inputs.now_us, state)
        return []

    def _goto_land(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if self.held:
            return []
        waited_us, controls = inputs.now_us - self._entered_us, self.had_control
        if self._landing.is_reached(inputs, state, controls=controls, paused=self._interruptions.paused):
            self._enter(Phase.LAND, inputs.now_us)
        elif waited_us > self._params.land_timeout_s * 1e6:
            if self._landing.is_possible_here(inputs, state, controls=controls) or inputs.mode not in _PLAN_MODES:
                self._enter(Phase.LAND, inputs.now_us)
            else:
                self._stop_in_place(inputs.now_us, state)
        return []

    def _land(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        self.had_control = False
        if self._airborne:  # found in the air, handed back in the air
            if state.mode is not FlightMode.EXTERNAL:
                self._enter(Phase.DONE, inputs.now_us)
                return []
            return [Command(verb=Verb.HOLD)] if self._may_request(inputs) else []
        if self._is_down(inputs, state):
            self._enter(Phase.DONE, inputs.now_us)
            return []
        if state.mode is FlightMode.LAND:
            self._landing_seen = True
            return []
        ours = state.mode in _OWN_MODES and not self._landing_seen  # else a pilot flies, or has aborted the landing
        if not ours and state.landed is not Landed.ON_GROUND:
            self._override(TAKEN_OVER)
            return []
        if not self._may_request(inputs):
            return []
        return [Command(verb=Verb.DISARM if state.landed is Landed.ON_GROUND else Verb.LAND)]

    def _take_control(self, inputs: PhaseInputs, state: VehicleState) -> None:
        if self.had_control:
            return
        self.had_control = True
        if self.phase is not Phase.GOTO_START:
            return
        target_ned_m = self._climb.rest_ned_m(state) if self._climb.cut_short else self._start_ned_m
        self._trajectories.go_to(target_ned_m, inputs.now_us, state)
        self._trajectories.keep_destination()
        if self.held:
            self._interruptions.stay(inputs.now_us, state)

    def _go_home(self, now_us: int, state: VehicleState) -> None:
        self._landing.go_home(now_us, state)
        self._interruptions.end_hold()
        self._enter(Phase.GOTO_LAND, now_us)

    def _give_up(self, why: str, inputs: PhaseInputs, state: VehicleState) -> None:
        """End the mission; only without a plan does the autopilot land the vehicle from where it is."""
        self.outcome = self.outcome or why
        if self.had_control and inputs.mode in _PLAN_MODES:
            self._stop_in_place(inputs.now_us, state)
            return
        self._enter(Phase.DONE if self._is_down(inputs, state) else Phase.LAND, inputs.now_us)

    def _stop_in_place(self, now_us: int, state: VehicleState) -> None:
        """Brake and move away from others under the own plan, then let the autopilot land there."""
        self._landing.stop_in_place(now_us, state)
        self._interruptions.end_hold()
        self._enter(Phase.GOTO_LAND, now_us)

    def _enter(self, phase: Phase, now_us: int) -> None:
        self.phase = phase
        if phase >= Phase.LAND:
            self._interruptions.end_hold()
        self._entered_us = now_us
        self._requested_us = now_us - _SPIN_UP_US

    def _may_request(self, inputs: PhaseInputs, every_us: int = _REQUEST_PERIOD_US) -> bool:
        if inputs.busy or inputs.now_us - self._requested_us < every_us:
            return False
        self._requested_us = inputs.now_us
        return True


def _is_under_other_control(state: VehicleState) -> bool:
    """Return whether a pilot, a ground station or a failsafe controls the vehicle."""
    return state.mode not in _OWN_MODES or state.failsafe
