"""State machine of one agent's mission: the requests to the autopilot and the reference to follow in each phase.

Pure. Agents agree on the start of the mission without a leader: each publishes when it became ready, and all start one
second after the latest of these times. The operator's orders (`core.operator_verbs`) are applied here too. A
vehicle found in the air at start-up is handed back in the air, in the autopilot's hold.

Autopilots do not know each other. Before one takes over, the agent therefore comes to rest and moves away from others
under its own plan. Only without a plan does the autopilot land the vehicle from where it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from pydantic import Field

from swarmctl.control.phases.arming import ArmingEvidence
from swarmctl.control.phases.control_mode import control_mode
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.overload import Level
from swarmctl.control.phases.refused_orders import Contains, OrderSituation, refusal_of
from swarmctl.control.reference.landing_places import landing_place_ned_m, nearest_in_plane_m
from swarmctl.control.reference.mission import MissionReference
from swarmctl.control.reference.quintic import QuinticTrajectory, brake_to_rest, quintic_to
from swarmctl.core.operator_verbs import GOTO, OPERATOR_VERBS, POINT, SPEED, YAW, Order
from swarmctl.core.params import Params
from swarmctl.core.types import Array, Command, FlightMode, Landed, Mode, Phase, VehicleState, Verb

_REQUEST_PERIOD_US = 1_000_000  # time between repetitions of a request
_SPIN_UP_US = 6_000_000  # ArduCopter's rotors spin up for over 3 s, during which it refuses a second TAKEOFF
_SETTLE_S = 2.0  # time after a stop trajectory in which the vehicle comes to rest
_BEGIN_DELAY_US = 1_000_000  # from the last agent's readiness to mission time 0; several statuses are sent meanwhile
_HOVER_LEARNING_US = 1_000_000  # hover flown by the autopilot itself, during which its hover thrust is learned
_LEAST_HEIGHT_M = 0.5  # above the ground, of a point to go to
_ROOM_MARGIN_M = 0.1  # the target lies beyond the required distance, because it is reached with a tolerance
_PLAN_MODES = (Mode.TRACKING, Mode.REPLAY)
_OWN_MODES = (FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.EXTERNAL)  # modes that follow from our own requests
OPERATOR_STOP = "stopped by the operator"
TAKEN_OVER = "pilot or autopilot took over"
REBOOTED = "the autopilot rebooted"
OVERLOADED = "overload: deadlines were missed for too long"


class StateMachineParams(Params):
    """Speeds of the transits to the start and to the landing place, tolerances and timeouts."""

    speed_m_s: float = Field(2.0, gt=0, le=20)  # peak speed of a transit
    accel_m_s2: float = Field(1.2, gt=0, le=20)  # peak acceleration of a transit, and of stops
    state_rate_hz: float = Field(100.0, ge=20, le=250)  # rate requested for position and attitude
    arrive_m: float = Field(0.15, gt=0, le=5)  # tolerance of the start position
    arrive_m_s: float = Field(0.15, gt=0, le=5)  # largest speed of a vehicle at rest
    land_m: float = Field(0.06, gt=0, le=5)  # tolerance of the landing place; reduces the gap to neighbouring places
    land_m_s: float = Field(0.06, gt=0, le=5)  # largest speed above the landing place
    start_timeout_s: float = Field(90.0, gt=0, le=3600)  # from process start to TRACK
    land_timeout_s: float = Field(20.0, gt=0, le=600)  # to reach the landing place; then land in place
    apart_m: float = Field(0.2, ge=0, le=20)  # beyond separation.radius_m, around an agent that lands in place


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
        contains: whether a place lies in the area to fly in.

    Attributes:
        phase: current phase.
        ready_utc_us: UTC at which the start position was reached, 0 before.
        begin_utc_us: UTC of mission time 0, None until all are ready.
        outcome: "completed", or why the mission was not; "" while it is under way.
        waits_for: unmet condition that keeps the vehicle on the ground, or "".
        had_control: the autopilot follows our setpoints and control has not been given back.
        held: the operator has asked to hold, or to go to a point.
        yaw_rad: heading that the operator has asked for, None for the mission's.
        paused: the agent rests because the bus is lost or its processor is overloaded.
        pilot_override: pilot or autopilot took over; lasts until an operator resumes.
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
    ) -> None:
        self._params, self._agent, self._expected = params, agent, peers
        self._apart_m, self._contains = landing_m, contains
        self._start_ned_m, self._duration_us, self._reference = start_ned_m, round(duration_s * 1e6), reference
        self.phase = Phase.CONNECT
        self.ready_utc_us = 0
        self.begin_utc_us: int | None = None
        self.outcome = ""
        self.waits_for = ""
        self.arming = ArmingEvidence()
        self._stop_verb = ""  # land or rtl, from the command until the stop begins
        self.had_control = False
        self.held = False
        self._held_since_us = 0
        self._held_at: tuple[Array, float] | None = None  # point of a `goto` (3,), and the speed to it
        self.yaw_rad: float | None = None
        self._climb_cut_short = False  # a hold interrupted the take-off below its height
        self.paused = False
        self._destination_ned_m = start_ned_m  # end of the transit that a pause or a hold interrupts
        self._trajectory: tuple[QuinticTrajectory, int] | None = None  # transit or stop, and its start time
        self._rejoin_offset: tuple[QuinticTrajectory, int] | None = None  # decaying offset to the mission's reference
        self._entered_us = 0
        self._first_tick_us: int | None = None
        self._requested_us = -_REQUEST_PERIOD_US
        self._boots = 0
        self.pilot_override = False
        self._ground_z_m = 0.0
        self._hovering_us: int | None = None
        self._airborne = False
        self._may_take_control = False  # an operator's resume permits taking control from any mode
        self._landing_seen = False
        self._lands_in_place = False  # lands where it came to rest instead of at the start position
        self._outcome_before = ""  # outcome before the override, restored by resume
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
        }  # stops are in `_apply_stop`

    @property
    def finished(self) -> bool:
        return self.phase is Phase.DONE

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
            self._override(TAKEN_OVER)
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
            pos, vel = self._reference.sample((utc_us - self.begin_utc_us) * 1e-6 + offsets_s)
            if self._rejoin_offset is not None:
                trajectory, began_us = self._rejoin_offset
                offset, drift = trajectory.sample((now_us - began_us) * 1e-6 + offsets_s)
                pos, vel = pos + offset, vel + drift
            return pos, vel
        if self._trajectory is not None:
            trajectory, began_us = self._trajectory
            return trajectory.sample((now_us - began_us) * 1e-6 + offsets_s)
        return np.tile(self._start_ned_m, (len(offsets_s), 1)), np.zeros((len(offsets_s), 3))

    @property
    def place_offset_ned_m(self) -> Array:
        """Return by how much the present reference (3,) is beside the one that several agents share."""
        return self._reference.offset_ned_m if self._follows_mission else np.zeros(3)

    def mission_yaw_rad(self, utc_us: int) -> float | None:
        """Return the yaw of the mission's reference now; None while that is not followed."""
        if not self._follows_mission or self.begin_utc_us is None:
            return None
        return float(self._reference.yaw_rad(np.array([(utc_us - self.begin_utc_us) * 1e-6]))[0])

    @property
    def _follows_mission(self) -> bool:
        return self.phase is Phase.TRACK and not (self.held or self.paused)

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
            goes_to_point=self.held and self._held_at is not None,
            paused=self.paused,
            lands_in_place=self._lands_in_place,
        )

    def begin_if_due(self, now_us: int, utc_us: int) -> None:
        """Enter TRACK on time. Called before planning, so that the first plan of the mission follows its reference."""
        if self.phase is Phase.READY and self.begin_utc_us is not None and utc_us >= self.begin_utc_us:
            self.phase = Phase.TRACK
            self._entered_us, self._requested_us = now_us, now_us - _REQUEST_PERIOD_US

    def mission_t_s(self, utc_us: int) -> float:
        """Return the mission time [s] while tracking, else NaN."""
        if self.phase is not Phase.TRACK or self.begin_utc_us is None:
            return math.nan
        return (utc_us - self.begin_utc_us) * 1e-6

    def operator(self, order: Order, now_us: int, utc_us: int, state: VehicleState | None) -> str:
        """Apply an operator's order; return why it is refused, or "".

        A stop (land, rtl) is kept until a vehicle state is known to begin it from, so it is lost in no phase.
        """
        situation = OrderSituation(
            phase=self.phase,
            state=state,
            pilot_override=self.pilot_override,
            other_control=state is not None and _is_under_other_control(state),
            lands_in_place=self._lands_in_place,
            controls=self.had_control,
            paused=self.paused,
            lowest_m=self._lowest_m,
            contains=self._contains,
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
        self._interrupt(now_us, state)
        self._held_at = self.yaw_rad = None
        if not self.held:
            self.held, self._held_since_us = True, now_us
            self._requested_us = now_us - _SPIN_UP_US  # on the way up the autopilot is asked at once

    def _goto(self, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
        self._hold(order, now_us, utc_us, state)
        target_ned_m = np.array([order.arguments[name] for name in POINT])
        self._held_at = target_ned_m, order.arguments.get(SPEED, self._params.speed_m_s)
        self.yaw_rad = math.radians(order.arguments[YAW]) if YAW in order.arguments else None
        self._stay(now_us, state)

    def _stay(self, now_us: int, state: VehicleState) -> None:
        """Come to rest where a hold asks for it: here, or at a point."""
        if self._held_at is None:
            self._trajectory = (self._stop_trajectory(state), now_us)
            return
        target_ned_m, speed_m_s = self._held_at
        accel_m_s2 = self._params.accel_m_s2
        trajectory = quintic_to(state.pos_ned_m, state.vel_ned_m_s, target_ned_m, speed_m_s, accel_m_s2=accel_m_s2)
        self._trajectory = (trajectory, now_us)

    @property
    def _lowest_m(self) -> float:
        """Return the down coordinate that a point to go to may not be below: the ground's is known after a take-off."""
        return float(self._start_ned_m[2]) if self._airborne else self._ground_z_m - _LEAST_HEIGHT_M

    def _interrupt(self, now_us: int, state: VehicleState) -> None:
        """Come to rest, and remember where a transit leads."""
        if self._trajectory is not None and not (self.held or self.paused):
            self._destination_ned_m = self._trajectory[0].to_ned_m
        if self.had_control or self.phase > Phase.GOTO_START:  # before, the autopilot hovers
            self._trajectory = (self._stop_trajectory(state), now_us)

    def _go_on(self, now_us: int, utc_us: int, state: VehicleState) -> None:
        """Go on with what was interrupted: the transit, or the mission."""
        if self.phase in (Phase.GOTO_START, Phase.READY, Phase.GOTO_LAND):
            self._trajectory = (self._trajectory_to(self._destination_ned_m, state), now_us)
        else:
            self._rejoin_mission(now_us, utc_us, state)

    def _resume(self, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
        if self.held:
            self._release(now_us, state)
            if not self.paused:
                self._go_on(now_us, utc_us, state)
        elif self.pilot_override:
            self._rejoin_mission(now_us, utc_us, state)
        if self.pilot_override:
            self.pilot_override, self.outcome, self._may_take_control = False, self._outcome_before, True

    def _release(self, now_us: int, state: VehicleState) -> None:
        """End a hold: timeouts have not run meanwhile."""
        self.held, self._requested_us = False, now_us - _SPIN_UP_US
        self._held_at = self.yaw_rad = None
        self._climb_cut_short |= self.phase is Phase.TAKEOFF and state.landed is not Landed.ON_GROUND
        if self._first_tick_us is not None:
            self._first_tick_us += now_us - self._held_since_us
        if self.phase is Phase.GOTO_LAND:
            self._entered_us = now_us

    def _override(self, why: str) -> None:
        self.pilot_override, self.had_control, self._may_take_control = True, False, False
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
            self._lands_in_place = False
            self._go_home(now_us, state)
        elif verb == "land" and (self.held or not self._lands_in_place):
            self._stop_in_place(now_us, state)

    def _is_down(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether the vehicle is on the ground and known to be disarmed."""
        return state.landed is Landed.ON_GROUND and self.arming.is_disarmed(inputs, state)

    def _pause(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Come to rest while the bus is lost, because peers then assume braking, and while deadlines are missed."""
        flying = self.had_control and Phase.GOTO_START <= self.phase <= Phase.GOTO_LAND
        must_wait = inputs.unresponsive_peer or inputs.overload >= Level.HOLD
        if must_wait and flying and not self.paused:
            self._interrupt(inputs.now_us, state)
            self.paused = True
        elif self.paused and not must_wait:
            self.paused = False
            if self.held:
                self._stay(inputs.now_us, state)
            else:
                self._go_on(inputs.now_us, inputs.utc_us, state)

    def _rejoin_mission(self, now_us: int, utc_us: int, state: VehicleState) -> None:
        """Rejoin the mission's moving reference along a quintic offset: after a jump all agents would rush together."""
        if self.phase is not Phase.TRACK or self.begin_utc_us is None:
            return
        pos, vel = self._reference.sample(np.array([(utc_us - self.begin_utc_us) * 1e-6]))
        p, offset, drift = self._params, state.pos_ned_m - pos[0], state.vel_ned_m_s - vel[0]
        self._rejoin_offset = (quintic_to(offset, drift, np.zeros(3), p.speed_m_s, accel_m_s2=p.accel_m_s2), now_us)

    def _stop_trajectory(self, state: VehicleState) -> QuinticTrajectory:
        return brake_to_rest(state.pos_ned_m, state.vel_ned_m_s, self._params.accel_m_s2)

    def _standby(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if not inputs.prepared:  # the autopilot has rebooted since CONNECT
            self.waits_for = "the link to be set up again after a reboot of the autopilot"
            return []
        if inputs.refusal:
            return self._refuse(inputs.refusal, inputs)
        if any(p.phase is Phase.DONE and p.alive for p in inputs.peers.values()):
            return self._refuse("a peer gave up before take-off", inputs)
        self.waits_for = self._start_blocker(inputs, state)
        if not self.waits_for:
            self._ground_z_m = float(state.pos_ned_m[2])
            self._airborne = state.landed is Landed.IN_AIR
            self._enter(Phase.ARM, inputs.now_us)
            return []
        stays = state.mode is FlightMode.EXTERNAL and inputs.arm_in is None and not inputs.armable
        if stays and not state.armed and self._may_request(inputs):
            return [Command(verb=Verb.HOLD)]  # PX4 stays in OFFBOARD after a landing, where it can't be armed
        return []

    def _start_blocker(self, inputs: PhaseInputs, state: VehicleState) -> str:
        """Return the first condition for arming that is not met, or ""."""
        if state.landed not in (Landed.ON_GROUND, Landed.IN_AIR):
            return "the autopilot to tell whether it has landed"
        if not inputs.armable:
            return f"the autopilot to be ready to arm (it is in {state.mode.name})"
        if inputs.unsettled:
            return inputs.unsettled
        absent = self._expected - sum(p.phase >= Phase.STANDBY and p.alive for p in inputs.peers.values())
        if absent:
            return f"{absent} of {self._expected} peers to stand by"
        return "the autopilot's answers" if inputs.busy else ""

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
        height_m = self._ground_z_m - float(self._start_ned_m[2])
        climbed_m = self._ground_z_m - float(state.pos_ned_m[2])
        settled = abs(float(state.vel_ned_m_s[2])) < 0.3 and (abs(climbed_m - height_m) < 0.4 or self._climb_cut_short)
        hovers = state.mode in (FlightMode.HOLD, inputs.arm_in) and state.landed is Landed.IN_AIR and settled
        self._hovering_us = (self._hovering_us or inputs.now_us) if hovers else None
        learned = inputs.arm_in is None or inputs.now_us - (self._hovering_us or inputs.now_us) >= _HOVER_LEARNING_US
        if hovers and learned and not self.held:
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
            return [Command(verb=Verb.TAKEOFF, value=height_m)]
        return []

    def _goto_start(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if not self.had_control:
            if self._trajectory is None:
                self._trajectory = (
                    QuinticTrajectory(
                        from_ned_m=state.pos_ned_m, vel_ned_m_s=np.zeros(3), to_ned_m=state.pos_ned_m, travel_s=1.0
                    ),
                    inputs.now_us,
                )
            return [] if self.held else self._request_control(inputs, state)
        p = self._params
        if self.held or self.paused:
            return []
        if self._climb_cut_short and self._trajectory is not None:
            self._finish_climb(inputs.now_us, state, self._trajectory[0].to_ned_m)
        elif self._at(state, self._start_ned_m, p.arrive_m, p.arrive_m_s):
            self.ready_utc_us = inputs.utc_us
            self._enter(Phase.READY, inputs.now_us)
        return []

    def _finish_climb(self, now_us: int, state: VehicleState, top_ned_m: Array) -> None:
        """Go to the start once the vehicle has climbed to its height."""
        if self._at(state, top_ned_m, self._params.arrive_m, math.inf):
            self._climb_cut_short = False
            self._trajectory = (self._trajectory_home(state), now_us)

    def _request_control(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        """Request control from the autopilot's own hold; from any other mode only after an operator's `resume`.

        No setpoints may be sent meanwhile: PX4 returns to OFFBOARD by itself when they reappear after a failsafe.
        """
        if not self._may_take_control and _is_under_other_control(state):
            self._override(TAKEN_OVER)
            return []
        return [Command(verb=Verb.EXTERNAL)] if self._may_request(inputs) else []

    def _ready(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if any(not p.alive or p.phase >= Phase.GOTO_LAND for p in inputs.peers.values()) and not self.held:
            self.outcome = "a peer gave up or was lost before the mission began"
            self._go_home(inputs.now_us, state)
            return []
        ready = [p.ready_utc_us for p in inputs.peers.values() if p.ready_utc_us > 0]
        if len(ready) == self._expected:
            self.begin_utc_us = max([self.ready_utc_us, *ready]) + _BEGIN_DELAY_US
        return []

    def _track(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        assert self.begin_utc_us is not None
        if not self.had_control:
            return self._request_control(inputs, state)
        if excess := self._reference.excess(state.pos_ned_m, state.vel_ned_m_s):
            self._give_up(excess, inputs, state)
            return []
        if inputs.utc_us - self.begin_utc_us >= self._duration_us and not (self.held or self.paused):
            self.outcome = self.outcome or "completed"
            if self._airborne and not inputs.peers:
                self._enter(Phase.LAND, inputs.now_us)
            elif self._airborne:
                self._stop_in_place(inputs.now_us, state)
            else:
                self._go_home(inputs.now_us, state)
        return []

    def _goto_land(self, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
        if self.held:
            return []
        waited_us = inputs.now_us - self._entered_us
        if self._may_land(inputs, state):
            self._enter(Phase.LAND, inputs.now_us)
        elif waited_us > self._params.land_timeout_s * 1e6:
            at_rest = self._at(state, state.pos_ned_m, math.inf, self._params.arrive_m_s)
            if self._lands_in_place or (at_rest and self._has_room(inputs, state)) or inputs.mode not in _PLAN_MODES:
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

    @staticmethod
    def _at(state: VehicleState, target: Array, within_m: float, slower_m_s: float) -> bool:
        speed = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
        return math.dist(state.pos_ned_m, target) < within_m and speed < slower_m_s

    def _may_land(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether the autopilot may land the vehicle: it is at its landing place, or at rest with enough room.

        A vehicle that lands in place and lacks room is sent to a free place first.
        """
        if self._trajectory is None:
            return True
        trajectory, began_us = self._trajectory
        if not self._lands_in_place:
            return self._at(state, trajectory.to_ned_m, self._params.land_m, self._params.land_m_s) and not self.paused
        if inputs.now_us - began_us <= (trajectory.travel_s + _SETTLE_S) * 1e6:
            return False
        if self._has_room(inputs, state):
            return self._at(state, state.pos_ned_m, math.inf, self._params.arrive_m_s)
        others_ned_m, apart_m = inputs.others_ned_m(), self._apart_m + _ROOM_MARGIN_M
        room = landing_place_ned_m(state.pos_ned_m, others_ned_m, apart_m, self._agent)
        self._trajectory = (self._trajectory_to(room, state), inputs.now_us)
        return False

    def _has_room(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether peers are far enough for a landing; always true without control, which could not change it."""
        return not self.had_control or nearest_in_plane_m(state.pos_ned_m, inputs.others_ned_m()) >= self._apart_m

    def _take_control(self, inputs: PhaseInputs, state: VehicleState) -> None:
        if self.had_control:
            return
        self.had_control = True
        if self.phase is not Phase.GOTO_START:
            return
        target = self._start_ned_m
        if self._climb_cut_short:
            target = np.array([*state.pos_ned_m[:2], self._start_ned_m[2]])
        self._destination_ned_m = target
        self._trajectory = (self._trajectory_to(target, state), inputs.now_us)
        if self.held:
            self._stay(inputs.now_us, state)

    def _trajectory_home(self, state: VehicleState) -> QuinticTrajectory:
        return self._trajectory_to(self._start_ned_m, state)

    def _trajectory_to(self, target_ned_m: Array, state: VehicleState) -> QuinticTrajectory:
        p = self._params
        return quintic_to(state.pos_ned_m, state.vel_ned_m_s, target_ned_m, p.speed_m_s, accel_m_s2=p.accel_m_s2)

    def _go_home(self, now_us: int, state: VehicleState) -> None:
        self._trajectory, self._destination_ned_m = (self._trajectory_home(state), now_us), self._start_ned_m
        self.held = False
        self._enter(Phase.GOTO_LAND, now_us)

    def _give_up(self, why: str, inputs: PhaseInputs, state: VehicleState) -> None:
        self.outcome = self.outcome or why
        if self.had_control and inputs.mode in _PLAN_MODES:
            self._stop_in_place(inputs.now_us, state)
            return
        self._enter(Phase.DONE if self._is_down(inputs, state) else Phase.LAND, inputs.now_us)

    def _stop_in_place(self, now_us: int, state: VehicleState) -> None:
        """Brake and move away from others under the own plan, then let the autopilot land there."""
        trajectory = self._stop_trajectory(state)
        self._trajectory, self._destination_ned_m = (trajectory, now_us), trajectory.to_ned_m
        self._lands_in_place, self.held = True, False
        self._enter(Phase.GOTO_LAND, now_us)

    def _enter(self, phase: Phase, now_us: int) -> None:
        self.phase = phase
        self.held &= phase < Phase.LAND
        self.yaw_rad = self.yaw_rad if self.held else None
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
