"""PX4's commander for one vehicle: modes, arming, offboard entry and loss, failsafe, landing detection.

Scalar code at autopilot rate. It speaks in results and texts, not in MAVLink messages (`endpoint` does), and turns the
mode into one attitude and thrust, from the offboard stream or from the `Navigator`.

Unlike PX4 1.18, a setpoint that is not finite or has a zero quaternion is refused and counted instead of poisoning the
attitude controller, body-rate setpoints (type_mask 128) count as no stream, and the newest setpoint acts at the moment
OFFBOARD is entered instead of with the next one.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence

import numpy as np

from sitl.modes import (
    FLIGHT_MODES,
    NEEDS_PILOT,
    NO_ARMING_IN,
    NOT_KEPT_AFTER_LANDING,
    MavState,
    OffboardLoss,
    Px4Mode,
    Result,
    Severity,
    base_mode,
)
from sitl.navigator import Command, Navigator
from sitl.parameters import Parameters
from sitl.sensors import Estimate
from swarmctl.core.types import FlightMode, Landed

FORCE = 21196.0  # p2 of ARM/DISARM
LANDED_AFTER_US = 500_000  # continuous ground contact
TAKEOFF_REACHED_M = 0.1
MASK_THRUST_BODY, MASK_NO_THRUST, MASK_NO_ATTITUDE = 32, 64, 128
IDLE = Command(np.array([1.0, 0.0, 0.0, 0.0]), 0.0)
_HEALTH_TEXT = "Arming denied: Resolve system health failures first\t"
_LOSS_MODES = {OffboardLoss.LAND: Px4Mode.AUTO_LAND, OffboardLoss.HOLD: Px4Mode.AUTO_LOITER}


class Autopilot:
    """Commander of one vehicle.

    Attributes:
        armed: motors may turn.
        mode: what flies now.
        intended: what was commanded; differs from `mode` only in a failsafe.
        failsafe: the autopilot acts on its own.
        terminated: motors off for good.
        landed: MAV_LANDED_STATE.
        home_ned_m: local position of the last arming.
        output: attitude and thrust to fly; thrust 0 when idle.
        released: an air start's clamp has been opened.
        texts: (severity, text) not yet sent.
        refused: setpoints not used, by reason.
    """

    def __init__(self, parameters: Parameters, navigator: Navigator, *, ekf_ready_us: int, airborne: bool) -> None:
        self.parameters = parameters
        self.armed = False
        self.mode = self.intended = Px4Mode.AUTO_LOITER
        self.failsafe = self.terminated = False
        self.landed = Landed.IN_AIR if airborne else Landed.ON_GROUND
        self.home_ned_m: tuple[float, float, float] | None = None
        self.output = IDLE
        self.released = not airborne
        self.texts: deque[tuple[Severity, str]] = deque(maxlen=64)
        self.refused: Counter[str] = Counter()
        self.streamed = False
        self._navigator = navigator
        self._ekf_ready_us = ekf_ready_us
        self._airborne = airborne
        self._resting_mode = Px4Mode.AUTO_LOITER
        self._setpoint = IDLE
        self._setpoint_us: int | None = None
        self._estimate: Estimate | None = None
        self._armed_us = self._landed_us = 0
        self._contact_us: int | None = None
        self._flown = False
        self._above_home = False  # RTL has arrived and lands
        self._takeoff_z_m: float | None = None
        self._takeoff_alt_amsl_m: float | None = None
        self.origin_alt_m = 0.0

    # --- what others ask ---

    def ready(self, now_us: int) -> bool:
        """The estimator has settled; `now_us` is time since boot throughout this class."""
        return now_us >= self._ekf_ready_us

    def stream_alive(self, now_us: int) -> bool:
        """A usable setpoint is younger than COM_OF_LOSS_T."""
        if self._setpoint_us is None:
            return False
        return now_us - self._setpoint_us <= self.parameters.real("COM_OF_LOSS_T") * 1e6

    def armable(self, now_us: int) -> bool:
        """PREARM_CHECK: arming would be accepted in the present mode."""
        if not self.ready(now_us) or self.terminated or self.intended in NO_ARMING_IN:
            return False
        return self.intended != Px4Mode.OFFBOARD or self.stream_alive(now_us)

    def base_mode(self) -> int:
        return base_mode(self.mode, armed=self.armed, streamed=self.streamed)

    def system_status(self, now_us: int) -> MavState:
        if self.terminated:
            return MavState.TERMINATION
        if self.armed:
            return MavState.CRITICAL if self.failsafe else MavState.ACTIVE
        return MavState.STANDBY if self.armable(now_us) else MavState.UNINIT

    def flight_mode(self) -> FlightMode:
        return FLIGHT_MODES.get(self.mode, FlightMode.MANUAL)

    # --- the offboard stream ---

    def on_setpoint(self, type_mask: int, q_nb: Sequence[float], thrust_01: float, now_us: int) -> bool:
        """SET_ATTITUDE_TARGET addressed to this vehicle; True when it counts as a stream."""
        if type_mask & MASK_NO_ATTITUDE:
            return self._refuse("no_attitude")
        if type_mask & MASK_THRUST_BODY:
            thrust_01 = 0.0  # thrust_body is flown instead, and the dialect has no such field: zeros
        elif type_mask & MASK_NO_THRUST:
            return self._refuse("no_thrust")
        size = math.sqrt(sum(c * c for c in q_nb))
        if not (math.isfinite(size) and math.isfinite(thrust_01)):
            return self._refuse("not_finite")
        if size < 1e-6:
            return self._refuse("zero_quaternion")
        self._setpoint = Command(np.array(q_nb, dtype=np.float64) / size, max(0.0, min(1.0, thrust_01)))
        self._setpoint_us = now_us
        self.streamed = True
        if self.armed and not self.terminated and self.intended == Px4Mode.OFFBOARD:
            self.mode, self.failsafe = Px4Mode.OFFBOARD, False  # also the return after a loss
            self.released, self._above_home = True, False
            self.output = self._setpoint
        return True

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False

    # --- commands ---

    def arm(self, now_us: int) -> Result:
        """MAV_CMD_COMPONENT_ARM_DISARM p1=1."""
        if self.armed:
            return Result.ACCEPTED
        if not self.armable(now_us):
            self.texts.append((Severity.CRITICAL, _HEALTH_TEXT))
            if not self.ready(now_us):
                self.texts.append((Severity.CRITICAL, "Preflight Fail: no heading reference"))
            if self.terminated:
                self.texts.append((Severity.CRITICAL, "Preflight Fail: Flight termination active"))
            return Result.TEMPORARILY_REJECTED
        self.armed, self.failsafe, self._flown = True, False, self._airborne
        self._armed_us = self._landed_us = now_us
        self._above_home = False
        self.mode = self.intended
        if self._estimate is not None:
            self.home_ned_m = self._estimate.pos_ned_m
            self._navigator.engage(self._estimate, fresh=True)
        self._takeoff_z_m = None
        self.texts.append((Severity.INFO, "Armed by external command\t"))
        if self.mode == Px4Mode.OFFBOARD:
            self.released, self.output = True, self._setpoint
        return Result.ACCEPTED

    def disarm(self, force: bool) -> Result:
        """MAV_CMD_COMPONENT_ARM_DISARM p1=0; in the air only with `force`."""
        if not self.armed:
            return Result.ACCEPTED
        if self.landed != Landed.ON_GROUND and self.released and not force:
            self.texts.append((Severity.CRITICAL, "Disarming denied: not landed\t"))
            return Result.TEMPORARILY_REJECTED
        self._disarm("Disarmed by external command\t")
        return Result.ACCEPTED

    def _disarm(self, text: str, *, keep_mode: bool = False) -> None:
        self.armed = self.failsafe = False
        self.output = IDLE
        if not keep_mode:
            self.mode = self.intended = self._resting_mode
        self.texts.append((Severity.INFO, text))

    def set_mode(self, mode: Px4Mode, now_us: int, takeoff_alt_amsl_m: float | None = None) -> Result:
        """A commanded mode change; cancels a running failsafe. No takeoff height given: MIS_TAKEOFF_ALT."""
        if self.terminated:
            return Result.TEMPORARILY_REJECTED
        if mode == Px4Mode.AUTO_MISSION or (self.armed and not self._can_enter(mode, now_us)):
            name = {**NEEDS_PILOT, Px4Mode.OFFBOARD: "Offboard"}.get(mode, "Mission")
            self.texts.append((Severity.CRITICAL, f"Switching to {name} is currently not available\t"))
            return Result.TEMPORARILY_REJECTED
        self.intended = mode
        if mode not in NOT_KEPT_AFTER_LANDING:
            self._resting_mode = mode
        if mode == Px4Mode.AUTO_TAKEOFF:
            self._takeoff_z_m, self._takeoff_alt_amsl_m = None, takeoff_alt_amsl_m
            if takeoff_alt_amsl_m is None:
                height = self.parameters.real("MIS_TAKEOFF_ALT")
                self.texts.append((Severity.INFO, f"Using default takeoff altitude: {height:.1f} m\t"))
        if mode == Px4Mode.AUTO_LAND and self.armed:
            self.texts.append((Severity.INFO, "Landing at current position\t"))
        self.failsafe = False
        self._enter(mode)
        return Result.ACCEPTED

    def _can_enter(self, mode: Px4Mode, now_us: int) -> bool:
        if mode == Px4Mode.OFFBOARD:
            return self.stream_alive(now_us)
        return mode not in NEEDS_PILOT

    def terminate(self) -> Result:
        """MAV_CMD_DO_FLIGHTTERMINATION: motors off for good."""
        self.terminated = True
        self.output = IDLE
        return Result.ACCEPTED

    def _enter(self, mode: Px4Mode) -> None:
        came_from_stream = self.mode == Px4Mode.OFFBOARD
        self.mode, self._above_home = mode, False
        if not self.armed:
            return
        if mode == Px4Mode.OFFBOARD:
            self.released, self.output = True, self._setpoint
        elif self._estimate is not None:
            self._navigator.engage(self._estimate, fresh=came_from_stream)

    # --- every tick ---

    def tick(self, estimate: Estimate, now_us: int, dt_s: float) -> None:
        """Detect landing, judge the stream, disarm when due, and fly AUTO modes."""
        self._estimate = estimate
        if self.home_ned_m is None and self.ready(now_us):
            self.home_ned_m = estimate.pos_ned_m
        self._detect_landing(estimate, now_us)
        if not self.armed or self.terminated:
            return
        if self.mode == Px4Mode.OFFBOARD and not self.stream_alive(now_us):
            self._lose_stream()
        self._disarm_when_due(now_us)
        if self.armed and not self.terminated and self.mode != Px4Mode.OFFBOARD:
            self.output = self._fly_auto(estimate, now_us, dt_s)

    def _lose_stream(self) -> None:
        self.failsafe = True
        self.texts.append((Severity.CRITICAL, "Failsafe activated\t"))
        action = self.parameters.integer("COM_OBL_RC_ACT")
        if action == OffboardLoss.TERMINATE:
            self.terminate()
        elif action == OffboardLoss.DISARM:
            self._disarm("Disarmed by failsafe\t", keep_mode=True)
        else:
            self._enter(
                _LOSS_MODES.get(OffboardLoss(action), Px4Mode.AUTO_RTL) if 0 <= action <= 7 else Px4Mode.AUTO_RTL
            )

    def _detect_landing(self, estimate: Estimate, now_us: int) -> None:
        if self._airborne:
            return
        if not estimate.on_ground:
            self._contact_us = None
            if self.landed == Landed.ON_GROUND:
                self.texts.append((Severity.INFO, "Takeoff detected\t"))
            self._flown = True
            self.landed = self._airborne_state()
            return
        if self._contact_us is None:
            self._contact_us = now_us
        if self.landed != Landed.ON_GROUND and now_us - self._contact_us >= LANDED_AFTER_US:
            self.landed, self._landed_us = Landed.ON_GROUND, now_us
            self.texts.append((Severity.INFO, "Landing detected\t"))

    def _airborne_state(self) -> Landed:
        if self.armed and self.mode == Px4Mode.AUTO_TAKEOFF:
            return Landed.TAKEOFF
        landing = self.mode == Px4Mode.AUTO_LAND or self._above_home
        return Landed.LANDING if self.armed and landing else Landed.IN_AIR

    def _disarm_when_due(self, now_us: int) -> None:
        if self.landed != Landed.ON_GROUND:
            return
        name, since, text = (
            ("COM_DISARM_LAND", self._landed_us, "Disarmed by landing\t")
            if self._flown
            else ("COM_DISARM_PRFLT", self._armed_us, "Disarmed by auto preflight disarming\t")
        )
        limit_s = self.parameters.real(name)
        if limit_s > 0 and now_us - since >= limit_s * 1e6:
            self._disarm(text)

    # --- AUTO modes ---

    def _fly_auto(self, estimate: Estimate, now_us: int, dt_s: float) -> Command:
        if self.mode == Px4Mode.AUTO_TAKEOFF:
            return self._take_off(estimate, now_us, dt_s)
        if estimate.on_ground and not self._airborne:
            return IDLE
        if self.mode == Px4Mode.AUTO_RTL and not self._above_home and self.home_ned_m is not None:
            command = self._navigator.go_home(estimate, self.home_ned_m[:2], dt_s)
            if command is not None:
                return command
            self.texts.append((Severity.INFO, "RTL: land at destination\t"))
            self._above_home = True
        if self.mode == Px4Mode.AUTO_LAND or self._above_home:
            return self._navigator.descend(estimate, dt_s)
        return self._navigator.hold(estimate, dt_s)

    def _take_off(self, estimate: Estimate, now_us: int, dt_s: float) -> Command:
        if now_us - self._armed_us < self.parameters.real("COM_SPOOLUP_TIME") * 1e6:
            return IDLE
        if self._takeoff_z_m is None:
            ground_z_m = self.home_ned_m[2] if self.home_ned_m is not None else estimate.pos_ned_m[2]
            self._takeoff_z_m = ground_z_m - self.parameters.real("MIS_TAKEOFF_ALT")
            if self._takeoff_alt_amsl_m is not None:
                self._takeoff_z_m = self.origin_alt_m - self._takeoff_alt_amsl_m
        if estimate.pos_ned_m[2] <= self._takeoff_z_m + TAKEOFF_REACHED_M:
            self.mode = self.intended = self._resting_mode = Px4Mode.AUTO_LOITER
            self._navigator.engage(estimate, fresh=False)
            if estimate.pos_ned_m[2] > self._takeoff_z_m - 1.0:  # climbed to it, not started above it
                self._navigator.keep_height(self._takeoff_z_m)
            return self._navigator.hold(estimate, dt_s)
        return self._navigator.climb_to(estimate, self._takeoff_z_m, dt_s)
