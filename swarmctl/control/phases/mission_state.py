"""Where one agent's mission stands: its phase, who has control, what is followed, and the transitions between. Pure.

It decides nothing by itself: `control.phases.state_machine` does, tick by tick, with the steps of the phases and the
operator's orders. Which trajectory is flown meanwhile is known to `Trajectories`, what holds or pauses the agent to
`Interruptions`, and where it may land to `Landing`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.control.phases.arming import ArmingEvidence
from swarmctl.control.phases.control_mode import control_mode
from swarmctl.control.phases.departure import SPIN_UP_US, Climb
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.interruptions import Interruptions
from swarmctl.control.phases.landing import Landing
from swarmctl.control.phases.refused_orders import Contains
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.phases.trajectories import OfferedMission, Trajectories
from swarmctl.control.reference.feasibility import below_ground
from swarmctl.control.reference.mission import MissionReference
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array, Command, ControlMode, Landed, Mode, Phase, VehicleState

REQUEST_PERIOD_US = 1_000_000  # time between repetitions of a request
PLAN_MODES = (Mode.TRACKING, Mode.REPLAY)
_FLIES_BACK = ": flies back"  # of an outcome, until it is known whether the vehicle has
COMPLETED = "completed"  # the outcome of a mission that was flown to its end
_TAKES_BACK_US = 5_000_000  # from an operator's resume, for which the autopilot may take to follow setpoints again
ASKS_US = 30_000_000  # from the same, for which the autopilot is asked to; later nobody would expect that it does
TAKEN_OVER = "pilot or autopilot took over"
DISARMED = "disarmed before take-off"


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionSetup:
    """What a mission is told before it begins."""

    agent: int  # index of this agent
    peers: int  # number of the other agents
    landing_m: float  # level distance to others at which it may land in place
    home_m: float  # the same at the start position
    start_ned_m: Array  # (3,) start position, also the landing place
    brake_m_s2: float  # mean deceleration of a stop at once, which peers that hear nothing expect
    duration_s: float  # of the tracked mission
    reference: MissionReference  # of the tracked mission
    contains: Contains = lambda _: True  # whether a place lies within the geofence
    volume: FlightVolume | None = None  # to stay in
    has_ground: bool = True  # to land on


class MissionState:
    """What the phases of one agent's mission share.

    Args:
        params: speeds, tolerances and timeouts.
        setup: place in the swarm, and the mission.

    Attributes:
        phase: current phase.
        ready_utc_us: UTC at which the start position was reached, 0 before.
        begin_utc_us: UTC of mission time 0, None until all are ready.
        ordered_begin_utc_us: UTC before which a mission that an operator has ordered does not begin; 0 without one.
        outcome: "completed", or why the mission was not; "" while it is under way.
        waits_for: unmet condition that keeps the vehicle on the ground, or from beginning the mission; or "".
        keeps_up: the processor has shown before take-off that it carries the load of a flight.
        had_control: the autopilot follows our setpoints and control has not been given back.
        pilot_override: pilot or autopilot took over; lasts until an operator resumes.
        overridden_us: monotonic time of the last takeover.
        gone_us: monotonic time from which a vehicle without positions has been out of our control; None: it is not.
        offered: the mission that the order `mission` has flown.
        stop_verb: land or rtl, from the command until the stop begins.
        may_take_control: an operator's resume permits taking control from any mode.
        resumed_us: monotonic time of that resume, or of one that has ended a hold since.
        setpoints_stopped: the override has followed from that.
        airborne: the vehicle was found in the air at start-up.
        must_land: something has ended the mission, or an operator, also after it was completed.
        landing_seen: the autopilot lands, or has.
        outcome_before: outcome before the override, restored by resume.
        patient_from_us: monotonic time from which the patience with the start counts.
        land_by_us: monotonic time at which a vehicle that is not at its landing place by then lands where it is.
        requested_us: monotonic time of the newest request to the autopilot.
    """

    def __init__(self, params: StateMachineParams, setup: MissionSetup) -> None:
        self.params, self.contains, self.volume = params, setup.contains, setup.volume
        self.peers = frozenset(range(setup.peers + 1)) - {setup.agent}
        self.start_ned_m, self.mission_reference = setup.start_ned_m, setup.reference
        self.duration_us = round(setup.duration_s * 1e6)
        self.phase, self.boots = Phase.CONNECT, 0
        self.outcome = self.outcome_before = self.waits_for = self.stop_verb = ""
        self.ready_utc_us = self.ordered_begin_utc_us = self.overridden_us = 0
        self.resumed_us = self.land_by_us = 0
        self.begin_utc_us: int | None = None
        self.gone_us: int | None = None
        self.patient_from_us: int | None = None
        self.requested_us = -REQUEST_PERIOD_US
        self.offered: OfferedMission | None = None
        self.keeps_up = self.had_control = self.pilot_override = self.may_take_control = False
        self.setpoints_stopped = self.airborne = self.landing_seen = self.must_land = False
        self._has_ground = setup.has_ground
        self.arming, self.climb = ArmingEvidence(), Climb(setup.start_ned_m)
        self.trajectories = Trajectories(
            setup.reference,
            setup.start_ned_m,
            speed_m_s=params.speed_m_s,
            accel_m_s2=params.accel_m_s2,
            brake_m_s2=setup.brake_m_s2,
        )
        self.interruptions = Interruptions(self.trajectories)
        self.landing = Landing(
            params,
            setup.agent,
            apart_m=setup.landing_m,
            home_apart_m=setup.home_m,
            start_ned_m=setup.start_ned_m,
            trajectories=self.trajectories,
            volume=setup.volume,
        )

    # -- what is asked of it ------------------------------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        return self.phase is Phase.DONE

    @property
    def held(self) -> bool:
        """Return whether the operator has asked to hold, or to go to a point."""
        return self.interruptions.held

    @property
    def ground_z_m(self) -> float | None:
        """Return the down coordinate of the place that the vehicle takes off from; None where that is not known."""
        return None if self.airborne or self.phase < Phase.ARM else self.climb.ground_z_m

    @property
    def handed_back(self) -> bool:
        """Return whether a vehicle that was found in the air is handed back there: after a completed mission alone.

        What else ends the mission wants it on the ground: an operator's stop, a low battery.
        """
        completed = self.outcome == COMPLETED and not self.must_land
        return self.airborne and (completed or not self._has_ground)

    @property
    def leads_below_ground(self) -> str:
        """Return where the mission leads below the place that the vehicle takes off from, or ""."""
        return below_ground(self.mission_reference, self.duration_us * 1e-6, self.climb.ground_z_m)

    @property
    def yaw_rad(self) -> float | None:
        """Return the heading that the operator has asked for, None for the mission's."""
        return self.interruptions.yaw_rad

    @property
    def may_fly_on(self) -> bool:
        """Return whether the agent is not on its way to land, or is held there for as long as the operator likes."""
        return self.phase < Phase.GOTO_LAND or (self.held and self.phase is Phase.GOTO_LAND)

    @property
    def follows_mission(self) -> bool:
        """Return whether the reference is the mission's: nothing interrupts it."""
        return self.phase is Phase.TRACK and not self.interruptions.active

    @property
    def destination_ned_m(self) -> Array | None:
        """Return where (3,) an operator, the mission or its beginning has the agent come to rest; None of a way."""
        if self.held:
            return self.interruptions.point_ned_m
        if self.phase in (Phase.GOTO_START, Phase.READY):
            return self.start_ned_m
        goal = self.mission_reference.goal
        return goal.pos_ned_m if self.phase is Phase.TRACK and goal is not None else None

    @property
    def place_offset_ned_m(self) -> Array:
        """Return by how much the mission's reference (3,) is beside the one that several agents share."""
        return self.mission_reference.offset_ned_m if self.phase is Phase.TRACK else np.zeros(3)

    def reference(self, utc_us: int, now_us: int, offsets_s: Array) -> tuple[Array, Array]:
        """Return reference positions and velocities, (K, 3) each, NED, at `offsets_s` (K,) from now."""
        if self.follows_mission and self.begin_utc_us is not None:
            return self.trajectories.mission_reference(self.mission_t_s(utc_us), now_us, offsets_s)
        return self.trajectories.reference(now_us, offsets_s)

    def reference_left(self, utc_us: int, now_us: int) -> tuple[Array, Array] | None:
        """Return the mission's position and velocity now, (1, 3) each, while another reference is followed in it.

        That is one that interrupts the mission, or leads back to it. None: the reference that is followed is its own.
        """
        mission_t_s = self.mission_t_s(utc_us)
        if math.isnan(mission_t_s) or (self.follows_mission and not self.trajectories.rejoins(now_us)):
            return None
        return self.mission_reference.sample(np.array([mission_t_s]))

    def mission_yaw_rad(self, utc_us: int) -> float | None:
        """Return the yaw of the mission's reference now; None while that is not followed."""
        if not self.follows_mission or self.begin_utc_us is None:
            return None
        return self.mission_reference.yaw_at_rad(self.mission_t_s(utc_us))

    def mission_t_s(self, utc_us: int) -> float:
        """Return the mission time [s] while tracking, else NaN."""
        if self.phase is not Phase.TRACK or self.begin_utc_us is None:
            return math.nan
        return (utc_us - self.begin_utc_us) * 1e-6

    def ends_in_s(self, now_us: int, utc_us: int) -> float:
        """Return when the mission, or what precedes or follows it, ends by itself [s]; NaN: it does not."""
        if self.held or self.pilot_override or self.patient_from_us is None:
            return math.nan
        if self.phase < Phase.TRACK:
            return self.params.start_timeout_s - (now_us - self.patient_from_us) * 1e-6
        if self.phase is Phase.GOTO_LAND:
            return (self.land_by_us - now_us) * 1e-6
        return self.duration_us * 1e-6 - self.mission_t_s(utc_us)

    def control_mode(self, mode: Mode) -> ControlMode:
        """Return what the vehicle is doing, for the operator; `mode` is that of the tick."""
        return control_mode(
            self.phase,
            Mode.PILOT_OVERRIDE if self.pilot_override and mode is not Mode.STATE_STALE else mode,
            held=self.held,
            goes_to_point=self.interruptions.goes_to_point,
            paused=self.interruptions.paused,
            lands_in_place=self.landing.in_place,
            setpoints_stopped=self.setpoints_stopped,
            completed=self.outcome == COMPLETED,
        )

    def climbs(self, state: VehicleState) -> bool:
        """Return whether the autopilot has the vehicle in the air, on its way up."""
        return self.phase is Phase.TAKEOFF and state.armed and state.landed is not Landed.ON_GROUND

    def takes_back(self, now_us: int) -> bool:
        """Return whether the agent is taking the vehicle back, after an operator's resume, and does not have it yet."""
        return self.may_take_control and not self.had_control and now_us - self.resumed_us < _TAKES_BACK_US

    def asks_in_vain(self, now_us: int) -> bool:
        """Return whether the autopilot gives no control, which it was asked for since a resume for as long as it is."""
        return self.may_take_control and not self.had_control and now_us - self.resumed_us >= ASKS_US

    def is_down(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether the vehicle is on the ground and known to be disarmed."""
        return state.landed is Landed.ON_GROUND and self.arming.is_disarmed(inputs, state)

    # -- transitions --------------------------------------------------------------------------------------------------

    def enter(self, phase: Phase, now_us: int) -> None:
        """Enter a phase; its requests may be made at once."""
        self.phase = phase
        self.trajectories.ground_z_m = self.ground_z_m
        if phase >= Phase.LAND:
            self.interruptions.end_hold()
            self.end_way_back("did not get back")
        self.requested_us = now_us - SPIN_UP_US

    def may_request(self, inputs: PhaseInputs, every_us: int = REQUEST_PERIOD_US) -> bool:
        """Return whether a request is due, which is made then."""
        if inputs.busy or inputs.now_us - self.requested_us < every_us:
            return False
        self.requested_us = inputs.now_us
        return True

    def override(self, why: str, now_us: int) -> None:
        """Note that pilot or autopilot took over."""
        self.pilot_override, self.had_control, self.may_take_control = True, False, False
        self.overridden_us = now_us
        self.setpoints_stopped = False
        self.outcome_before = self.outcome
        self.outcome = why

    def refuse(self, why: str, inputs: PhaseInputs) -> list[Command]:
        """Give up before take-off: nothing is armed any more, and a vehicle that has been armed is disarmed."""
        self.outcome = self.outcome or why
        self.enter(Phase.LAND if self.arming.requested else Phase.DONE, inputs.now_us)
        return []

    def give_up(self, why: str, inputs: PhaseInputs, state: VehicleState) -> None:
        """End the mission; only without a plan does the autopilot land the vehicle from where it is.

        A vehicle that was found in the air and has not been asked for anything yet is left as it was found.
        """
        self.outcome, self.must_land = self.outcome or why, True
        if self.phase < Phase.ARM and not self.arming.requested:
            self.enter(Phase.DONE, inputs.now_us)
            return
        if self.had_control and inputs.mode in PLAN_MODES:
            self.stop_in_place(inputs.now_us, state)
            return
        if self.climbs(state) and inputs.is_over_obstacle(state):
            self.abandon_climb(inputs.now_us)
            return
        self.enter(Phase.DONE if self.is_down(inputs, state) else Phase.LAND, inputs.now_us)

    def abandon_climb(self, now_us: int) -> None:
        """End a climb above an obstacle: the autopilot, which would land straight down, holds until we have control."""
        self.interruptions.end_hold()
        if not self.climb.abandoned:
            self.climb.abandoned = True
            self.climb.cut()
            self.requested_us = now_us - SPIN_UP_US
            self.land_by_us = now_us + round(self.params.land_timeout_s * 1e6)

    def go_home(self, now_us: int, state: VehicleState) -> None:
        """Fly to the landing place, once no pause is left: who is silent may be on the way, and does not know of it."""
        self.landing.go_home(now_us, state)
        self._begin_landing(now_us)
        if self.interruptions.paused:
            self.interruptions.stay(now_us, state)

    def fly_back(self, why: str, now_us: int, state: VehicleState) -> None:
        """Fly to the landing place because something ends the mission."""
        self.outcome, self.must_land = self.outcome or f"{why}{_FLIES_BACK}", True
        self.go_home(now_us, state)

    def end_way_back(self, words: str) -> None:
        """Have the outcome say what has become of a vehicle that flies back."""
        if self.outcome.endswith(_FLIES_BACK):
            self.outcome = f"{self.outcome.removesuffix(_FLIES_BACK)}: {words}"

    def stop_in_place(self, now_us: int, state: VehicleState) -> None:
        """Brake and move away from others under the own plan, then let the autopilot land there."""
        self.landing.stop_in_place(now_us, state, at_once=self.interruptions.stops_at_once)
        self._begin_landing(now_us)

    def go_on(self, now_us: int, utc_us: int, state: VehicleState) -> None:
        """Go on with what was interrupted: the transit, or the mission."""
        if self.phase in (Phase.GOTO_START, Phase.READY, Phase.GOTO_LAND):
            self.trajectories.go_to(self.trajectories.destination_ned_m, now_us, state)
            self._allow_way(now_us)
        else:
            self.rejoin_mission(now_us, utc_us, state)

    def rejoin_mission(self, now_us: int, utc_us: int, state: VehicleState) -> None:
        """Return to the mission's moving reference, if it is under way."""
        if self.phase is Phase.TRACK and self.begin_utc_us is not None:
            self.trajectories.rejoin_mission(self.mission_t_s(utc_us), now_us, state)

    def _begin_landing(self, now_us: int) -> None:
        self.interruptions.end_hold()
        self.enter(Phase.GOTO_LAND, now_us)
        self._allow_way(now_us)

    def _allow_way(self, now_us: int) -> None:
        """Leave time for all of the way that has begun: a vehicle lands where it is only if something stops it."""
        way = self.trajectories.current
        travel_s = way.trajectory.travel_s if way else 0.0
        self.land_by_us = now_us + round((travel_s + self.params.land_timeout_s) * 1e6)
