"""PX4's commander for one vehicle: modes, arming, offboard entry and loss, failsafes, landing detection.

Scalar code at autopilot rate. Its results and texts are not MAVLink messages (`endpoint` converts them). It turns the
mode into one `Command`, from the offboard stream (`setpoints`) or from the AUTO modes (`auto_flight`).
"""

from __future__ import annotations

import datetime
import math
from collections import Counter, deque
from collections.abc import Sequence

from sitl.boot import Boot
from sitl.net.mavlink_values import Result, Severity
from sitl.plant.sensors import Estimate, LocalOrigin
from sitl.px4.auto_flight import AutoFlight, Phase
from sitl.px4.failsafe import Watch
from sitl.px4.failsafe_actions import FailsafeActions
from sitl.px4.geofence import Geofence
from sitl.px4.landing import LandDetector
from sitl.px4.link.setpoints import OffboardStream
from sitl.px4.missions import Store
from sitl.px4.modes import (
    FLIES_BLIND,
    FLIGHT_MODES,
    MODE_NAMES,
    NEEDS_PILOT,
    NO_ARMING_IN,
    NOT_KEPT_AFTER_LANDING,
    MavState,
    Px4Mode,
    base_mode,
)
from sitl.px4.navigator import Navigator, Triple
from sitl.px4.parameters import Parameters
from sitl.vehicle_parts import IDLE, Command
from swarmctl.core.types import FlightMode, Landed

CHECK_US = 100_000  # period of PX4's failsafe checks
DEAD_RECKONING_US = 5_000_000  # EKF2_NOAID_TOUT: how long a position without GPS is valid
REBOOT_AFTER_US = 400_000  # the acknowledgement is sent first
REFUSED_EVERY_US = 1_000_000  # shortest interval between explanations of refused modes
STATUS_EVERY_US = 500_000  # also sent at every change
EPOCH_UTC_US = 1_767_225_600_000_000  # 2026-01-01, for flights without a wall clock
_HEALTH_TEXT = "Arming denied: Resolve system health failures first\t"


class Autopilot:
    """The commander of one vehicle. `now_us` is time since its boot, except in `tick` and `reboot`.

    Attributes:
        armed: motors may turn.
        mode: mode that flies now.
        intended: commanded mode; differs from `mode` only in a failsafe.
        terminated: motors off until reboot.
        home_ned_m: local position of the last arming.
        output: command to fly.
        released: an air start's clamp has been opened.
        texts: (severity, text) not yet sent.
        reboot_at_us: time of a pending reboot, or None.
        unaided_us: time since the newest position by GPS.
        position_ok: input; there is a horizontal position.
        battery_01, battery_v, battery_a: input; charge, voltage, current (-1: not measured).
        boot_utc_us: UTC of its boot.
    """

    def __init__(
        self,
        parameters: Parameters,
        navigator: Navigator,
        *,
        ekf_ready_us: int,
        airborne: bool,
        reject_bad_setpoints: bool = True,
    ) -> None:
        self.parameters = parameters
        self.texts: deque[tuple[Severity, str]] = deque(maxlen=64)
        self.store = Store()
        self.stream = OffboardStream(reject_bad=reject_bad_setpoints)
        self.flight = AutoFlight(parameters, navigator, self.store, self.send_text)
        self.watch = Watch(parameters, self.send_text)
        self._land_detector = LandDetector(parameters, self.send_text, airborne=airborne)
        self.released = not airborne
        self.position_ok = True
        self.boot = Boot(ekf_ready_us)
        self.battery_01, self.battery_v, self.battery_a = 1.0, 16.2, -1.0
        self.boot_utc_us = EPOCH_UTC_US
        self._fence = Geofence(parameters, self.store)
        self._failsafe = FailsafeActions(self)
        self._navigator = navigator
        self._ekf_ready_us = ekf_ready_us
        self._begin()

    def _begin(self) -> None:
        """Restart; parameters and uploads stay."""
        self.armed = self.terminated = False
        self._failsafe.clear()
        self.mode = self.intended = self._resting_mode = Px4Mode.AUTO_LOITER
        self._land_detector.reset()
        self.home_ned_m: tuple[float, float, float] | None = None
        self.output = IDLE
        self.reboot_at_us: int | None = None
        self.texts.clear()
        self.stream.reset()
        self.flight.reset()
        self.watch.reset()
        self._estimate: Estimate | None = None
        self._refused_us = -REFUSED_EVERY_US
        self._armed_us = self._next_check_us = self._aided_us = self.unaided_us = 0

    def reboot(self, now_us: int) -> None:
        """Restart now; `now_us` is on the clock of the simulation."""
        before_us = self.boot.at_us
        self.boot.again(now_us, self._estimate)
        self.boot_utc_us += self.boot.at_us - before_us
        if self.boot.origin is not None:
            self.start_at(self.boot.origin)
        self._begin()

    def start_at(self, origin: LocalOrigin) -> None:
        """Set the origin of the local frame."""
        self.boot.origin = self.flight.origin = origin
        self.flight.origin_alt_m = origin.alt_mm / 1e3

    # --- what others ask ---

    def send_text(self, severity: Severity, text: str) -> None:
        """Queue a STATUSTEXT."""
        self.texts.append((severity, text))

    def ready(self, now_us: int) -> bool:
        """Whether the estimator has settled."""
        return now_us >= self._ekf_ready_us

    def settled_share(self, now_us: int) -> float:
        """Time since boot over the time the estimator takes until it can be armed."""
        return now_us / self._ekf_ready_us if self._ekf_ready_us else math.inf

    def stream_alive(self, now_us: int) -> bool:
        """Whether a usable setpoint is younger than COM_OF_LOSS_T."""
        return self.stream.age_us(now_us) <= self.parameters.real("COM_OF_LOSS_T") * 1e6

    def armable(self, now_us: int) -> bool:
        """Whether arming would be accepted in the present mode (PREARM_CHECK)."""
        if not self.ready(now_us) or self.terminated or self.intended in NO_ARMING_IN:
            return False
        if self.watch.fence_broken or self.watch.battery_warning >= 2:
            return False
        return self._can_enter(self.intended, now_us)

    def base_mode(self) -> int:
        return base_mode(self.mode, armed=self.armed, streamed=self.stream.seen)

    def system_status(self, now_us: int) -> MavState:
        if self.terminated:
            return MavState.TERMINATION
        if self.armed:
            return MavState.CRITICAL if self.failsafe else MavState.ACTIVE
        return MavState.STANDBY if self.armable(now_us) else MavState.UNINIT

    def status(self, now_us: int) -> tuple[object, ...]:
        """Status that PX4 publishes, and so may report: another value each time it is published."""
        flags = self.armed, self.failsafe, self.system_status(now_us)
        return now_us // STATUS_EVERY_US, self.mode, self.intended, *flags

    def flight_mode(self) -> FlightMode:
        return FLIGHT_MODES.get(self.mode, FlightMode.MANUAL)

    @property
    def failsafe(self) -> bool:
        """Whether the autopilot acts on its own."""
        return self._failsafe.active

    @property
    def has_position(self) -> bool:
        """Whether there is a horizontal position, measured or dead-reckoned for a short while."""
        return self.position_ok and self.unaided_us <= DEAD_RECKONING_US

    @property
    def position_ned_m(self) -> Triple | None:
        """Return the estimated position, or None without one."""
        return self._estimate.pos_ned_m if self._estimate is not None and self.has_position else None

    @property
    def refused(self) -> Counter[str]:
        """Number of unused setpoints, by reason."""
        return self.stream.refused

    @property
    def landed(self) -> Landed:
        """The MAV_LANDED_STATE of the vehicle."""
        return self._land_detector.landed

    @property
    def motors_on(self) -> bool:
        return self.armed and not self.terminated and not self.output.stopped

    @property
    def battery_warning(self) -> int:
        """Battery warning: 0 none, 1 low, 2 critical, 3 emergency."""
        return self.watch.battery_warning

    # --- the offboard stream ---

    def on_setpoint(
        self, type_mask: int, q_nb: Sequence[float], rates: Triple, thrust_01: float, *, now_us: int
    ) -> bool:
        """Take a SET_ATTITUDE_TARGET addressed to this vehicle; return whether it counts as a stream."""
        flying = self.mode == Px4Mode.OFFBOARD
        if not self.stream.take(type_mask, q_nb, rates, thrust_01, now_us=now_us, flying=flying):
            return False
        if flying and self.armed and not self.terminated:
            self.released, self.output = True, self.stream.command
        else:
            self._failsafe.on_setpoint(now_us)
        return True

    # --- commands ---

    def arm(self, now_us: int) -> Result:
        """Execute MAV_CMD_COMPONENT_ARM_DISARM p1=1."""
        if self.armed:
            return Result.ACCEPTED
        if not self.armable(now_us):
            self.send_text(Severity.CRITICAL, _HEALTH_TEXT)
            if not self.ready(now_us):
                self.send_text(Severity.CRITICAL, "Preflight Fail: no heading reference")
            if self.terminated:
                self.send_text(Severity.CRITICAL, "Preflight Fail: Flight termination active")
            return Result.TEMPORARILY_REJECTED
        self.armed, self._armed_us = True, now_us
        self._land_detector.arm(now_us)
        self._failsafe.clear()
        self.mode = self.intended
        if self._estimate is not None:
            if self.has_position:
                self.home_ned_m = self._estimate.pos_ned_m
            self.flight.engage(self.mode, self._estimate, fresh=True)
        self.send_text(Severity.INFO, "Armed by external command\t")
        began = datetime.datetime.fromtimestamp((self.boot_utc_us + now_us) // 1_000_000, datetime.UTC)
        self.send_text(Severity.INFO, f"[logger] ./log/{began:%Y-%m-%d/%H_%M_%S}.ulg\t")
        if self.mode == Px4Mode.OFFBOARD and self.stream.command is not IDLE:
            self.released, self.output = True, self.stream.command
        return Result.ACCEPTED

    def disarm(self, force: bool) -> Result:
        """Execute MAV_CMD_COMPONENT_ARM_DISARM p1=0; in the air only with `force`."""
        if not self.armed:
            return Result.ACCEPTED
        if self.landed != Landed.ON_GROUND and self.released and not force:
            self.send_text(Severity.CRITICAL, "Disarming denied: not landed\t")
            return Result.TEMPORARILY_REJECTED
        self.switch_off("Disarmed by external command\t")
        return Result.ACCEPTED

    def switch_off(self, text: str, *, keep_mode: bool = False) -> None:
        """Disarm, and say why."""
        self.armed = False
        self._failsafe.clear()
        self.watch.forget()
        self.output = self.stream.command = IDLE
        if not keep_mode:
            self.mode = self.intended = self._resting_mode
        self.send_text(Severity.INFO, text)

    def set_mode(
        self, mode: Px4Mode, now_us: int, takeoff_alt_amsl_m: float | None = None, *, tell: bool = True
    ) -> Result:
        """Change the mode by command; this suspends a running failsafe.

        Without a take-off height, MIS_TAKEOFF_ALT is used. `tell`: explain a refusal.
        """
        if self.terminated:
            return Result.TEMPORARILY_REJECTED
        if self.armed and not self._can_enter(mode, now_us):
            if tell and now_us - self._refused_us > REFUSED_EVERY_US:
                self._refused_us = now_us
                self.send_text(Severity.CRITICAL, f"Switching to {MODE_NAMES[mode]} is currently not available\t")
            return Result.TEMPORARILY_REJECTED
        self.intended = mode
        if mode not in NOT_KEPT_AFTER_LANDING:
            self._resting_mode = mode
        if mode == Px4Mode.AUTO_TAKEOFF:
            self.flight.takeoff_alt_amsl_m = takeoff_alt_amsl_m
        if mode == Px4Mode.AUTO_LAND and self.armed:
            self.send_text(Severity.INFO, "Landing at current position\t")
        self._failsafe.suspend()
        self.enter(mode)
        return Result.ACCEPTED

    def _can_enter(self, mode: Px4Mode, now_us: int) -> bool:
        if mode == Px4Mode.OFFBOARD:
            return self.stream_alive(now_us)
        if mode == Px4Mode.AUTO_MISSION and not self.store.mission:
            return False
        return mode not in NEEDS_PILOT and (self.has_position or mode in FLIES_BLIND)

    def terminate(self) -> Result:
        """Execute MAV_CMD_DO_FLIGHTTERMINATION: motors off until reboot."""
        if not self.armed:
            return Result.DENIED
        self.mode = Px4Mode.TERMINATION
        self.stop_for_good()
        return Result.ACCEPTED

    def stop_for_good(self) -> None:
        """Stop the motors until a reboot."""
        self.terminated = True
        self.output = IDLE

    def request_reboot(self, now_us: int) -> Result:
        """Request MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN p1=1, which the world executes."""
        if self.armed:
            return Result.DENIED
        self.reboot_at_us = now_us + REBOOT_AFTER_US
        return Result.ACCEPTED

    def reposition(self, goal_ned_m: Triple, yaw_rad: float) -> None:
        """Set the place that LOITER holds (MAV_CMD_DO_REPOSITION)."""
        if self.armed and self.mode == Px4Mode.AUTO_LOITER and self.landed != Landed.ON_GROUND:
            self.flight.reposition(goal_ned_m, yaw_rad)

    def enter(self, mode: Px4Mode) -> None:
        """Fly a mode, whoever wants it."""
        fresh = self.mode == Px4Mode.OFFBOARD
        self.mode = mode
        self.stream.command = IDLE  # OFFBOARD waits for the next setpoint; until then the last output stays
        if self.armed and mode != Px4Mode.OFFBOARD and self._estimate is not None:
            self.flight.engage(mode, self._estimate, fresh=fresh)

    # --- every tick ---

    def tick(self, estimate: Estimate, now_us: int, dt_s: float) -> None:
        """Detect landing, check stream and failsafes, disarm when due, and fly AUTO modes.

        `now_us` and the estimate are the simulation's: this autopilot may have booted later, and elsewhere.
        """
        now_us = self.boot.since_us(now_us)
        if now_us < 0:
            return
        estimate = self._estimate = self.boot.local(estimate)
        self._aided_us = now_us if estimate.gps_ok else self._aided_us
        self.unaided_us = now_us - self._aided_us
        if self.home_ned_m is None and self.has_position and self.ready(now_us):
            self.home_ned_m = estimate.pos_ned_m
        self._land_detector.update(estimate.on_ground, self._airborne_state(), now_us)
        if now_us >= self._next_check_us:
            self._next_check_us = now_us - now_us % CHECK_US + CHECK_US
            self._check(estimate, now_us)
        if not self.armed or self.terminated:
            return
        self._failsafe.resume_when_due(now_us)
        text = self._land_detector.disarm_text(now_us)
        if text:
            self.switch_off(text)
        if self.armed and self.mode != Px4Mode.OFFBOARD:
            self.output = self.stream.spoiled(self._fly_auto(estimate, now_us, dt_s))

    def _fly_auto(self, estimate: Estimate, now_us: int, dt_s: float) -> Command:
        if not self.has_position and not estimate.on_ground:
            return self._navigator.descend_blind(estimate, dt_s)
        command = self.flight.fly(self.mode, estimate, self.home_ned_m, self._armed_us, now_us=now_us, dt_s=dt_s)
        match self.flight.next_mode:
            case Px4Mode.AUTO_LOITER:  # a take-off is complete
                self.flight.next_mode = None
                self.mode = self.intended = self._resting_mode = Px4Mode.AUTO_LOITER
            case Px4Mode.AUTO_RTL:  # an item of the mission asks for it
                self.set_mode(Px4Mode.AUTO_RTL, now_us)
        return command

    def _check(self, estimate: Estimate, now_us: int) -> None:
        """Run the checks that PX4 does ten times a second."""
        origin = self.flight.origin
        breaches = self._fence.breaches(estimate.pos_ned_m, self.home_ned_m, origin) if origin else []
        wanted, begun = self.watch.check(breaches, self.battery_01, now_us, armed=self.armed)
        if self.armed and not self.terminated:
            self._failsafe.check(wanted, begun, now_us)

    def _airborne_state(self) -> Landed:
        if not self.armed or self.mode == Px4Mode.OFFBOARD:
            return Landed.IN_AIR
        if self.flight.phase == Phase.TAKEOFF:
            return Landed.TAKEOFF
        landing = self.mode == Px4Mode.AUTO_LAND or self.flight.phase == Phase.LANDING
        return Landed.LANDING if landing else Landed.IN_AIR
