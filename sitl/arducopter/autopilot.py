"""ArduCopter 4.6's commander for one vehicle: modes, arming, GUIDED attitude setpoints, landing, GCS failsafe.

Scalar code at autopilot rate. Its results and texts are not MAVLink messages (`sitl.arducopter.endpoint` converts
them).

No radio is operated: its sticks are centred while the vehicle flies (STABILIZE hovers on hover thrust, LOITER and
ALT_HOLD keep the height) and its throttle is down on the ground. Unlike ArduCopter, body rates that are not finite are
refused; everything else about setpoints is as measured, GUID_OPTIONS and type masks included.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence

from sitl.arducopter.boot_times import BootTimes, arming_refusals
from sitl.arducopter.guided import LEVEL, SOME_RATES, Guided, GuidedFlight, levelled
from sitl.arducopter.land_detector import LandDetector
from sitl.arducopter.modes import (
    BASE_ALWAYS,
    BASE_ARMED,
    BASE_POSITION_CONTROL,
    ENDS_ON_GROUND,
    FLIGHT_MODES,
    NEEDS_POSITION,
    NO_ARMING_IN,
    NOT_FLOWN_HERE,
    WITHOUT_POSITION_CONTROL,
    CopterMode,
    CopterState,
)
from sitl.arducopter.navigator import CopterNavigator
from sitl.arducopter.parameters import CopterParameters
from sitl.arducopter.return_home import ReturnHome, ReturnStage
from sitl.boot import Boot
from sitl.net.mavlink_values import Result, Severity
from sitl.plant.sensors import Estimate, LocalOrigin
from sitl.vehicle_parts import IDLE, Command
from swarmctl.core.types import Array, FlightMode, Landed

BRAKE_M_S2 = 7.5  # largest deceleration of BRAKE
FORCE_ARM, FORCE_DISARM = 2989.0, 21196.0  # p2 of ARM/DISARM


class ArduCopter:
    """The commander of one vehicle.

    Attributes:
        boot: its own time and local frame.
        boot_times: when its parts start to work, since its boot.
        armed: motors may turn.
        mode: mode that flies.
        guided: its GUIDED mode.
        home_ned_m: local position of the last arming, or of the EKF origin before.
        home_set: number of times home has been set.
        output: attitude and thrust to fly.
        target_q_nb, throttle_in_01: the attitude controller's input, before angle boost (ATTITUDE_TARGET).
        released: an air start's clamp has been opened.
        has_origin: the EKF has its origin, and so a position.
        failsafe: the ground station is lost.
        refused: number of unused setpoints, by reason.
    """

    def __init__(
        self,
        parameters: CopterParameters,
        navigator: CopterNavigator,
        origin: LocalOrigin,
        *,
        ekf_ready_us: int,
        airborne: bool,
    ) -> None:
        self.parameters = parameters
        self.boot = Boot()
        self.boot.origin = origin
        self.boot_times = BootTimes.armable_after(ekf_ready_us)
        self.released = not airborne
        self.refused: Counter[str] = Counter()
        self._outboxes: list[deque[tuple[Severity, str]]] = []
        self._navigator = navigator
        self._airborne = airborne
        self._fliers: dict[CopterMode, Callable[[Estimate, float], tuple[Array, float]]] = {
            CopterMode.STABILIZE: self._stabilize,
            CopterMode.ALT_HOLD: self._alt_hold,
            CopterMode.GUIDED: self._fly_guided,
            CopterMode.LOITER: self._loiter,
            CopterMode.BRAKE: self._brake,
            CopterMode.RTL: self._return,
            CopterMode.LAND: self._land,
        }
        self._power_up()

    def _power_up(self) -> None:
        self.armed = False
        self.mode = CopterMode.STABILIZE
        self.guided = GuidedFlight(self.parameters, self._navigator)
        self.home_ned_m: tuple[float, float, float] | None = None
        self.home_set = 0
        self.output = IDLE
        self.target_q_nb, self.throttle_in_01 = LEVEL, 0.0
        self._land_detector = LandDetector(self.parameters, self._navigator.hover_01, self._airborne)
        self._return_home = ReturnHome(self.parameters, self._navigator)
        self._estimate: Estimate | None = None
        self._now_us = 0
        self._initialised = self.has_origin = False
        self._gcs_us: int | None = None
        self.failsafe = False

    def reboot(self, now_us: int) -> None:
        """Restart at `now_us` of the simulation; parameters are kept, the local frame begins at the vehicle's place."""
        self.boot.again(now_us, self._estimate)
        self._power_up()

    # --- what others ask ---

    def outbox(self) -> deque[tuple[Severity, str]]:
        """Return a new queue that receives every text: one for each link."""
        box: deque[tuple[Severity, str]] = deque(maxlen=64)
        self._outboxes.append(box)
        return box

    def prearm_passed(self, now_us: int) -> bool:
        """Whether the PREARM_CHECK of SYS_STATUS passes, independent of the mode."""
        return self.armed or now_us >= self.boot_times.armable_us

    @property
    def landed(self) -> Landed:
        if self._land_detector.landed:
            return Landed.ON_GROUND
        if self.armed and self._lands():
            return Landed.LANDING
        if self.armed and self._takes_off():
            return Landed.TAKEOFF
        return Landed.IN_AIR

    def base_mode(self) -> int:
        """HEARTBEAT.base_mode: bit 8 while the horizontal position controller is active."""
        angle = self.mode == CopterMode.GUIDED and self.guided.stage is Guided.ANGLE
        positions = self.mode not in WITHOUT_POSITION_CONTROL and not angle
        return BASE_ALWAYS | (BASE_POSITION_CONTROL if positions else 0) | (BASE_ARMED if self.armed else 0)

    def system_status(self) -> CopterState:
        if not self._initialised:
            return CopterState.BOOT
        if self.failsafe:
            return CopterState.CRITICAL
        return CopterState.STANDBY if self._land_detector.landed else CopterState.ACTIVE

    def flight_mode(self) -> FlightMode:
        return FLIGHT_MODES.get(self.mode, FlightMode.MANUAL)

    def send_text(self, severity: Severity, text: str) -> None:
        """Queue a STATUSTEXT on every link."""
        for box in self._outboxes:
            box.append((severity, text))

    # --- setpoints ---

    def on_setpoint(
        self,
        type_mask: int,
        q_nb: Sequence[float],
        rates: Sequence[float],
        thrust: float,
        *,
        now_us: int,
    ) -> bool:
        """Take a SET_ATTITUDE_TARGET, see `Setpoints.take`; return whether it will be flown."""
        if self.mode != CopterMode.GUIDED:
            return self._refuse("not_guided")
        refusal = self.guided.setpoints.take(type_mask, q_nb, rates, thrust, flown=self.target_q_nb, now_us=now_us)
        if refusal:
            if refusal == SOME_RATES and self.guided.stage is not Guided.STOP:
                self._enter_guided(Guided.STOP)
            return self._refuse(refusal)
        if self.guided.stage is not Guided.ANGLE:
            self._enter_guided(Guided.ANGLE)
        if not self.armed:
            return True
        self.released = True
        if not self._land_detector.landed:  # acts at once: the real one's loop runs at 400 Hz
            target = self.guided.setpoints.target
            self._put_out(target.q_nb, self.throttle_in_01 if target.thrust_01 is None else target.thrust_01)
        return True

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False

    # --- commands ---

    def arm(self, now_us: int, *, force: bool = False) -> Result:
        """Execute MAV_CMD_COMPONENT_ARM_DISARM p1=1."""
        if self.armed:
            return Result.ACCEPTED
        reasons = arming_refusals(self.boot_times, now_us)
        if force and now_us >= self.boot_times.initialised_us:
            reasons = ()
        if self.mode in NO_ARMING_IN:
            reasons = (*reasons, f"Arm: {self.mode.name} mode not armable")
        for reason in reasons:
            self.send_text(Severity.CRITICAL, reason)
        if reasons or self._estimate is None:
            return Result.FAILED
        self.armed = True
        self._land_detector.armed_at(now_us)
        self._set_home(self._estimate)
        self.send_text(Severity.INFO, "Arming motors")
        self._engage()
        return Result.ACCEPTED

    def disarm(self, *, force: bool = False) -> Result:
        """Execute MAV_CMD_COMPONENT_ARM_DISARM p1=0; in the air only with `force`."""
        if not self.armed:
            return Result.ACCEPTED
        if not self._land_detector.landed and self.released and not force:
            return Result.FAILED
        self._disarm()
        return Result.ACCEPTED

    def _disarm(self) -> None:
        self.armed = self.failsafe = False
        self.output, self.throttle_in_01 = IDLE, 0.0
        self.send_text(Severity.INFO, "Disarming motors")

    def set_mode(self, number: int) -> Result:
        """Change the mode by command; while disarmed any mode can be set."""
        if number not in set(CopterMode):
            known = NOT_FLOWN_HERE.get(number)
            text = f"Mode change to {known} failed: init failed" if known else f"No such mode {number}"
            self.send_text(Severity.WARNING, text)
            return Result.FAILED
        mode = CopterMode(number)
        if self.armed and mode in NEEDS_POSITION and not self.has_origin:
            self.send_text(Severity.WARNING, f"Mode change to {mode.name} failed: requires position")
            return Result.FAILED
        if mode != self.mode:
            self._enter(mode)
        return Result.ACCEPTED

    def take_off(self, height_m: float) -> Result:
        """Execute MAV_CMD_NAV_TAKEOFF: `height_m` above home. In GUIDED, armed, on the ground."""
        estimate, home = self._estimate, self.home_ned_m
        if (
            not self.armed
            or not self._land_detector.landed
            or self.mode != CopterMode.GUIDED
            or estimate is None
            or home is None
        ):
            return Result.FAILED
        z_m = home[2] - height_m
        if not z_m < estimate.pos_ned_m[2]:  # not above it, or not a number
            return Result.FAILED
        self.guided.aim(z_m)
        if self.guided.stage is not Guided.TAKEOFF:  # a repeated request continues the spin-up
            self._enter_guided(Guided.TAKEOFF)
        return Result.ACCEPTED

    def on_gcs_heartbeat(self, now_us: int) -> None:
        """Take a HEARTBEAT from SYSID_MYGCS."""
        self._gcs_us = now_us
        if self.failsafe:
            self.failsafe = False
            self.send_text(Severity.WARNING, "GCS Failsafe Cleared")

    def _enter(self, mode: CopterMode) -> None:
        self.mode = mode
        self.guided.stage = Guided.STOP
        self._land_detector.stay()
        if self._estimate is not None and self.home_ned_m is not None:
            self._return_home.begin(self._estimate, self.home_ned_m)
        self._engage()

    def _enter_guided(self, what: Guided) -> None:
        self.guided.stage = what
        self._land_detector.stay()
        self._engage()

    def _engage(self) -> None:
        if self._estimate is not None:
            self._navigator.engage(self._estimate)

    # --- every tick ---

    def tick(self, estimate: Estimate, now_us: int, dt_s: float) -> None:
        """Boot, detect landing and lost ground stations, disarm when due, and fly the mode.

        `estimate` and `now_us` are the simulation's; everywhere else time is since boot.
        """
        now_us = self.boot.since_us(now_us)
        if now_us < 0:
            return
        estimate = self.boot.local(estimate)
        self._estimate, self._now_us = estimate, now_us
        self._boot_on(estimate, now_us)
        self._land_detector.watch(estimate, self.throttle_in_01, self.armed, now_us)
        self._watch_gcs(now_us)
        if not self.armed:
            return
        if self._land_detector.disarms(self.mode in ENDS_ON_GROUND, now_us):
            self._disarm()
            return
        if self._land_detector.landed and not self._lifts_off(estimate, now_us):
            self.throttle_in_01 = self._land_detector.takeoff_throttle_01(now_us) if self._takes_off() else 0.0
            self.output = Command(q_nb=IDLE.q_nb, thrust_01=self.throttle_in_01) if self.throttle_in_01 else IDLE
            return
        self._put_out(*self._fliers[self.mode](estimate, dt_s))

    def _boot_on(self, estimate: Estimate, now_us: int) -> None:
        if not self._initialised and now_us >= self.boot_times.initialised_us:
            self._initialised = True
            self._enter(CopterMode.STABILIZE)
        if not self.has_origin and now_us >= self.boot_times.origin_us:
            self.has_origin = True
            self.send_text(Severity.INFO, "EKF3 IMU0 origin set")
            self._set_home(estimate)

    def _set_home(self, estimate: Estimate) -> None:
        self.home_ned_m = estimate.pos_ned_m
        self.home_set += 1

    def _watch_gcs(self, now_us: int) -> None:
        action = self.parameters.integer("FS_GCS_ENABLE")
        if not action or not self.armed or self.failsafe or self._gcs_us is None or self._land_detector.landed:
            return
        if now_us - self._gcs_us > self.parameters.real("FS_GCS_TIMEOUT") * 1e6:
            self.failsafe = True
            self.send_text(Severity.WARNING, "GCS Failsafe")
            self._enter(CopterMode.LAND if action in (4, 5, 7) else CopterMode.RTL)

    def _lifts_off(self, estimate: Estimate, now_us: int) -> bool:
        """Return whether a vehicle on the ground is to take off and its motors have spun up."""
        asked = self.mode == CopterMode.GUIDED and self.guided.wants_up(estimate, self.target_q_nb, now_us)
        if not asked:
            self._land_detector.stay()
        if not asked or not self._land_detector.lifts_off(now_us, slowly=self.guided.stage is Guided.TAKEOFF):
            return False
        self._engage()
        return True

    def _put_out(self, q_nb: Array, throttle_01: float) -> None:
        """Pass attitude and throttle to the attitude controller, which boosts the throttle by the requested tilt."""
        self.target_q_nb, self.throttle_in_01 = q_nb, throttle_01
        boost = 1.0
        if self.parameters.integer("ATC_ANGLE_BOOST"):
            boost = 1.0 / max(0.1, 1.0 - 2.0 * float(q_nb[1] ** 2 + q_nb[2] ** 2))
        self.output = Command(q_nb=q_nb, thrust_01=max(0.0, min(1.0, throttle_01 * boost)))

    # --- modes: attitude and throttle of this tick ---

    def _stabilize(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        return levelled(self.target_q_nb), self._navigator.hover_01

    def _alt_hold(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        return levelled(self.target_q_nb), self._navigator.hold_height(estimate, dt_s)

    def _loiter(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        return self._navigator.hold(estimate, dt_s), self._navigator.hold_height(estimate, dt_s)

    def _brake(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        return self._navigator.stop(estimate, BRAKE_M_S2, dt_s), self._navigator.hold_height(estimate, dt_s)

    def _land(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        speed_m_s = self.parameters.metres("LAND_SPEED")
        ground_z_m = self.home_ned_m[2] if self.home_ned_m is not None else estimate.pos_ned_m[2]
        if ground_z_m - estimate.pos_ned_m[2] > self.parameters.metres("LAND_ALT_LOW"):
            speed_m_s = self.parameters.metres("LAND_SPEED_HIGH") or self.parameters.metres("WPNAV_SPEED_DN")
        attitude = self._navigator.stop(estimate, self.parameters.metres("WPNAV_ACCEL"), dt_s)
        return attitude, self._navigator.climb(estimate, -speed_m_s, dt_s)

    def _fly_guided(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        return self.guided.fly(estimate, self.target_q_nb, self._now_us, dt_s)

    def _return(self, estimate: Estimate, dt_s: float) -> tuple[Array, float]:
        if self._return_home.stage is ReturnStage.LAND:
            return self._land(estimate, dt_s)
        return self._return_home.fly(estimate, self.home_ned_m or estimate.pos_ned_m, self._now_us, dt_s)

    def _lands(self) -> bool:
        return self.mode == CopterMode.LAND or (
            self.mode == CopterMode.RTL and self._return_home.stage is ReturnStage.LAND
        )

    def _takes_off(self) -> bool:
        return self.mode == CopterMode.GUIDED and self.guided.takes_off
