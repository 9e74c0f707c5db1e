"""AUTO modes of one vehicle: take-off, hold, return, landing, and the items of a mission, tick by tick.

It decides the target; the `Navigator` flies there, and the `Autopilot` decides when. Local NED, time since boot.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable

from sitl.net.mavlink_values import Severity
from sitl.plant.sensors import Estimate, LocalOrigin
from sitl.px4.missions import (
    DO_CHANGE_SPEED,
    DO_JUMP,
    NAV_DELAY,
    NAV_LAND,
    NAV_LOITER_TIME,
    NAV_LOITER_UNLIM,
    NAV_RETURN,
    NAV_TAKEOFF,
    Item,
    Store,
)
from sitl.px4.modes import Px4Mode
from sitl.px4.navigator import Navigator
from sitl.px4.parameters import Parameters
from sitl.vehicle_parts import IDLE, Command

TAKEOFF_REACHED_M = 0.1
HEIGHT_REACHED_M = 0.5
HOME_REACHED_M = 0.5
RAMP_S = 0.9  # from idle to hover thrust after spool-up: PX4 reports take-off 2.0 s after arming
_JUMPS_MAX = 100  # limit of mission jumps without a flown item
Ned = tuple[float, float, float]
Xy = tuple[float, float]


class Phase(enum.IntEnum):
    """Part of an AUTO flight in the air that EXTENDED_SYS_STATE reports."""

    CRUISE = 0
    TAKEOFF = 1
    LANDING = 2


class AutoFlight:
    """Flies the AUTO modes of one vehicle: `engage` at entry to a mode, then `fly` every tick.

    Attributes:
        phase: taking off, landing, or neither.
        next_mode: mode that flight changes to: TAKEOFF has reached its height, or an item asks for a return.
        mission_finished: the last item has been flown.
        reached: mission items reached and not yet reported.
        takeoff_alt_amsl_m: height of NAV_TAKEOFF; None: MIS_TAKEOFF_ALT above home.
    """

    def __init__(
        self,
        parameters: Parameters,
        navigator: Navigator,
        store: Store,
        send_text: Callable[[Severity, str], None],
    ) -> None:
        self.origin: LocalOrigin | None = None
        self.origin_alt_m = 0.0
        self._parameters = parameters
        self._navigator = navigator
        self._store = store
        self._send_text = send_text
        self.reset()

    def reset(self) -> None:
        """Reset to the state after boot."""
        self.phase = Phase.CRUISE
        self.next_mode: Px4Mode | None = None
        self.mission_finished = False
        self.reached: list[int] = []
        self.takeoff_alt_amsl_m: float | None = None
        self._takeoff_z_m: float | None = None
        self._goal_ned_m: Ned | None = None  # of DO_REPOSITION, or of a climb that LOITER goes on with
        self._return_z_m: float | None = None
        self._climb_xy_m: Xy | None = None
        self._climbed = False
        self._seen_changes = -1
        self._inside_us: int | None = None
        self._jumps: dict[int, int] = {}

    def engage(self, mode: Px4Mode, estimate: Estimate, *, fresh: bool) -> None:
        """Begin a mode at the vehicle's place; see `Navigator.engage` for `fresh`.

        LOITER keeps the goal of a return that is climbing, as PX4 does: it goes on to climb.
        """
        goal_ned_m = self._climb_goal() if mode == Px4Mode.AUTO_LOITER else None
        self.phase = Phase.CRUISE
        self.next_mode = None
        self._takeoff_z_m = self._return_z_m = self._climb_xy_m = self._inside_us = None
        self._goal_ned_m = goal_ned_m
        self._climbed = False
        self._navigator.engage(estimate, fresh=fresh)
        if mode == Px4Mode.AUTO_TAKEOFF and self.takeoff_alt_amsl_m is None:
            height_m = self._parameters.real("MIS_TAKEOFF_ALT")
            self._send_text(Severity.INFO, f"Using default takeoff altitude: {height_m:.1f} m\t")
        if mode == Px4Mode.AUTO_MISSION and self.mission_finished:
            self._store.current, self.mission_finished = 0, False
        self._seen_changes = self._store.changes

    def target(self) -> tuple[float, ...]:
        """Target (11,), see `Navigator.target`."""
        return self._navigator.target()

    def cruise(self, speed_m_s: float | None) -> None:
        """Set the speed of AUTO flight [m/s]; None: MPC_XY_CRUISE."""
        self._navigator.speed_m_s = speed_m_s

    def reposition(self, goal_ned_m: Ned, yaw_rad: float) -> None:
        """Set the place to hold (DO_REPOSITION)."""
        self._goal_ned_m = goal_ned_m
        self._navigator.set_yaw(yaw_rad)

    def fly(
        self, mode: Px4Mode, estimate: Estimate, home_ned_m: Ned | None, armed_us: int, *, now_us: int, dt_s: float
    ) -> Command:
        """Return the command of this tick; `armed_us` is when the motors began to turn."""
        home = home_ned_m or estimate.pos_ned_m
        if mode == Px4Mode.AUTO_TAKEOFF:
            return self._take_off(estimate, home, self._takeoff_alt(home), armed_us, now_us=now_us, dt_s=dt_s)
        if mode == Px4Mode.AUTO_MISSION:
            return self._fly_mission(estimate, home, armed_us, now_us, dt_s=dt_s)
        if estimate.on_ground:
            return IDLE
        if mode == Px4Mode.AUTO_RTL:
            return self._return(estimate, home, dt_s)
        if mode == Px4Mode.AUTO_LAND:
            return self._land(estimate, home, dt_s)
        if self._goal_ned_m is not None:
            return self._navigator.go_to(estimate, self._goal_ned_m[:2], self._goal_ned_m[2], dt_s)
        return self._navigator.hold(estimate, dt_s)

    # --- take-off, landing, return ---

    def _takeoff_alt(self, home: Ned) -> float:
        if self.takeoff_alt_amsl_m is not None:
            return self.origin_alt_m - self.takeoff_alt_amsl_m
        return home[2] - self._parameters.real("MIS_TAKEOFF_ALT")

    def _take_off(
        self, estimate: Estimate, home: Ned, target_z_m: float, armed_us: int, *, now_us: int, dt_s: float
    ) -> Command:
        since_s = (now_us - armed_us) * 1e-6 - self._parameters.real("COM_SPOOLUP_TIME")
        if since_s < 0:
            return IDLE
        self.phase = Phase.TAKEOFF
        if self._takeoff_z_m is None:
            self._takeoff_z_m = target_z_m
        if estimate.on_ground and since_s < RAMP_S:
            return Command(q_nb=IDLE.q_nb, thrust_01=self._navigator.hover_01 * since_s / RAMP_S)
        if estimate.pos_ned_m[2] <= self._takeoff_z_m + TAKEOFF_REACHED_M:
            self.next_mode, self.phase = Px4Mode.AUTO_LOITER, Phase.CRUISE
            climbed = estimate.pos_ned_m[2] > self._takeoff_z_m - 1.0  # false when it started above it
            self._navigator.engage(estimate, fresh=False)
            if climbed:
                self._navigator.keep_height(self._takeoff_z_m)
            return self._navigator.hold(estimate, dt_s)
        ramp_s = self._parameters.real("MPC_TKO_RAMP_T")
        ramp_01 = min(1.0, (since_s - RAMP_S) / ramp_s) if ramp_s > 0 else 1.0
        return self._navigator.climb_to(estimate, self._takeoff_z_m, home[2], max(0.1, ramp_01), dt_s=dt_s)

    def _land(self, estimate: Estimate, home: Ned, dt_s: float, xy_m: Xy | None = None) -> Command:
        self.phase = Phase.LANDING
        return self._navigator.descend(estimate, home[2], dt_s, xy_m)

    def _return(self, estimate: Estimate, home: Ned, dt_s: float) -> Command:
        """Climb to the return height, fly home at it, and land there."""
        x_m, y_m, z_m = estimate.pos_ned_m
        away_m = math.hypot(x_m - home[0], y_m - home[1])
        if self.phase == Phase.LANDING:
            return self._land(estimate, home, dt_s, home[:2])
        if self._return_z_m is None:
            self._return_z_m = self._return_height(away_m, home, z_m)
            above_m = home[2] - self._return_z_m
            amsl_m = self.origin_alt_m - self._return_z_m
            self._send_text(Severity.INFO, f"RTL: start return at {amsl_m:.0f} m ({above_m:.0f} m above destination)\t")
        if away_m < HOME_REACHED_M:
            self._send_text(Severity.INFO, "RTL: land at destination\t")
            return self._land(estimate, home, dt_s, home[:2])
        if self._climb_xy_m is None:
            self._climb_xy_m = x_m, y_m
        if z_m > self._return_z_m + HEIGHT_REACHED_M and not self._climbed:
            return self._navigator.go_to(estimate, self._climb_xy_m, self._return_z_m, dt_s)
        self._climbed = True
        return self._navigator.go_to(estimate, home[:2], self._return_z_m, dt_s)

    def _climb_goal(self) -> Ned | None:
        """Return where a return climbs to; None unless it is climbing."""
        if self._climb_xy_m is None or self._return_z_m is None or self._climbed or self.phase == Phase.LANDING:
            return None
        return *self._climb_xy_m, self._return_z_m

    def _return_height(self, away_m: float, home: Ned, z_m: float) -> float:
        """Return the height of PX4's cone: lower near home, no climb close above it; never below the vehicle."""
        real = self._parameters.real
        highest_m, radius_m = real("RTL_RETURN_ALT"), real("NAV_ACC_RAD")
        cone_deg = real("RTL_CONE_ANG")
        if away_m <= radius_m:
            height_m = 2.0 * away_m
        else:
            height_m = highest_m
            if cone_deg > 0 and away_m <= real("RTL_MIN_DIST"):
                height_m = min(height_m, away_m / math.tan(math.radians(max(1.0, min(89.0, cone_deg)))))
            height_m = max(height_m, 2.0 * radius_m)
        return home[2] - max(min(height_m, highest_m), home[2] - z_m)

    # --- missions ---

    def _fly_mission(self, estimate: Estimate, home: Ned, armed_us: int, now_us: int, *, dt_s: float) -> Command:
        store = self._store
        if self._seen_changes != store.changes:
            self.engage(Px4Mode.AUTO_MISSION, estimate, fresh=False)
        self._skip_unflown()
        if self.mission_finished or not store.mission:
            return IDLE if estimate.on_ground else self._navigator.hold(estimate, dt_s)
        item = store.mission[store.current]
        if item.command == NAV_TAKEOFF or estimate.on_ground:
            return self._fly_takeoff(item, estimate, home, armed_us, now_us=now_us, dt_s=dt_s)
        if item.command == NAV_RETURN:
            self.next_mode = Px4Mode.AUTO_RTL
            return self._navigator.hold(estimate, dt_s)
        if item.command == NAV_DELAY:
            return self._wait(item, estimate, now_us, dt_s)
        goal = self._place(item, home, estimate)
        self._navigator.set_yaw(math.radians(item.params[3]) if item.command != NAV_LAND else math.nan)
        if item.command == NAV_LAND:
            away_m = math.dist(goal[:2], estimate.pos_ned_m[:2])
            if self.phase == Phase.LANDING or away_m < self._parameters.real("NAV_ACC_RAD"):
                return self._land(estimate, home, dt_s, goal[:2])
            return self._navigator.go_to(estimate, goal[:2], estimate.pos_ned_m[2], dt_s)
        if item.command != NAV_LOITER_UNLIM and self._stayed(item, goal, estimate, now_us):
            self._advance()
        return self._navigator.go_to(estimate, goal[:2], goal[2], dt_s)

    def _fly_takeoff(
        self, item: Item, estimate: Estimate, home: Ned, armed_us: int, *, now_us: int, dt_s: float
    ) -> Command:
        """Fly NAV_TAKEOFF; a mission that begins on the ground with another item takes off first, too."""
        if item.command == NAV_LAND and self.phase == Phase.LANDING:
            self._advance()
            return IDLE
        target_z_m = self._place(item, home, estimate)[2]
        if item.command != NAV_TAKEOFF:
            target_z_m = home[2] - self._parameters.real("MIS_TAKEOFF_ALT")
        command = self._take_off(estimate, home, target_z_m, armed_us, now_us=now_us, dt_s=dt_s)
        if self.next_mode is not None:
            self.next_mode = self._takeoff_z_m = None
            if item.command == NAV_TAKEOFF:
                self._advance()
        return command

    def _stayed(self, item: Item, goal: Ned, estimate: Estimate, now_us: int) -> bool:
        """Return whether it has stayed at the item for the requested time."""
        away_m = math.dist(goal[:2], estimate.pos_ned_m[:2])
        radius_m = item.params[1] if item.params[1] > 0 else self._parameters.real("NAV_ACC_RAD")
        if away_m > radius_m or abs(goal[2] - estimate.pos_ned_m[2]) > HEIGHT_REACHED_M:
            return False
        if self._inside_us is None:
            self._inside_us = now_us
        timed = item.command == NAV_LOITER_TIME or item.params[0] > 0
        return not timed or now_us - self._inside_us >= item.params[0] * 1e6

    def _advance(self) -> None:
        store = self._store
        self.reached.append(store.current)
        self._inside_us = None
        self.phase = Phase.CRUISE
        if store.current + 1 < len(store.mission):
            store.current += 1
        else:
            self.mission_finished = True

    def _skip_unflown(self) -> None:
        """Carry out items without a place."""
        store = self._store
        for _ in range(_JUMPS_MAX):
            if self.mission_finished or store.current >= len(store.mission):
                return
            item = store.mission[store.current]
            if item.command == DO_CHANGE_SPEED:
                self._navigator.speed_m_s = item.params[1] if item.params[1] > 0 else None
            elif item.command != DO_JUMP:
                return
            elif self._jump(item):
                continue
            self._advance()

    def _jump(self, item: Item) -> bool:
        here, target = self._store.current, int(item.params[0])
        done = self._jumps.get(here, 0)
        if done >= item.params[1] or not 0 <= target < len(self._store.mission):
            self._jumps.pop(here, None)
            return False
        self._jumps[here] = done + 1
        self._store.current = target
        return True

    def _wait(self, item: Item, estimate: Estimate, now_us: int, dt_s: float) -> Command:
        if self._inside_us is None:
            self._inside_us = now_us
        if now_us - self._inside_us >= item.params[0] * 1e6:
            self._advance()
        return self._navigator.hold(estimate, dt_s)

    def _place(self, item: Item, home: Ned, estimate: Estimate) -> Ned:
        """Return the local NED place of an item; without a position, the vehicle's own."""
        if self.origin is None or (item.lat_e7 == 0 and item.lon_e7 == 0):
            x_m, y_m = estimate.pos_ned_m[:2]
        else:
            x_m, y_m = self.origin.to_xy_m(item.lat_e7, item.lon_e7)
        height_m = item.z_m if math.isfinite(item.z_m) else 0.0
        return x_m, y_m, (home[2] - height_m if item.relative else self.origin_alt_m - height_m)
