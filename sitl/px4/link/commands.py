"""Meaning of each MAV_CMD for one vehicle, and PX4's answer. Flight decisions are the `Autopilot`'s."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from pymavlink.dialects.v20 import development as mav

from sitl.net.mavlink_values import Result, Severity
from sitl.px4.autopilot import Autopilot
from sitl.px4.modes import MODE_NAMES, Px4Mode

FORCE = 21196.0  # p2 of ARM/DISARM
CUSTOM_MODE_FLAG = 1
CHANGE_MODE_FLAG = 1  # p2 flag of DO_REPOSITION
Params = tuple[float, float, float, float, float, float, float]
_MAIN_AUTO, _SUB_MISSION = 4, 4
_TOLD_WHY = 190  # component of a ground station, which alone receives the reason of a refused mode
_AFTER_TERMINATION = frozenset(
    {
        mav.MAV_CMD_SET_MESSAGE_INTERVAL,
        mav.MAV_CMD_GET_MESSAGE_INTERVAL,
        mav.MAV_CMD_REQUEST_MESSAGE,
        mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
    }
)


class Messages(Protocol):
    """Message operations of a link."""

    sender: tuple[int, int]  # system and component of the command being handled

    def set_interval(self, message: int, interval_us: int) -> bool:
        """Set the interval of a message; return False when there is no such message."""

    def request(self, message: int, argument: float) -> bool:
        """Send a message once; return False when there is no such message, or no content for it."""


class Commands:
    """Commands of one vehicle as they arrive on one link."""

    def __init__(self, autopilot: Autopilot, messages: Messages) -> None:
        self._autopilot = autopilot
        self._messages = messages
        self._now_us = 0
        self._actions: dict[int, Callable[[Params], Result | None]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mav.MAV_CMD_DO_SET_MODE: self._set_mode,
            mav.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            mav.MAV_CMD_NAV_LAND: lambda _: self._enter(Px4Mode.AUTO_LAND),
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._enter(Px4Mode.AUTO_RTL),
            mav.MAV_CMD_MISSION_START: self._start_mission,
            mav.MAV_CMD_DO_SET_MISSION_CURRENT: self._set_current,
            mav.MAV_CMD_DO_REPOSITION: self._reposition,
            mav.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            mav.MAV_CMD_DO_SET_HOME: self._set_home,
            mav.MAV_CMD_DO_FLIGHTTERMINATION: self._terminate,
            mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            mav.MAV_CMD_PREFLIGHT_STORAGE: lambda _: Result.ACCEPTED,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
        }

    def run(self, command: int, params: Params, now_us: int) -> Result | None:
        """Execute a command; None: PX4 does not even acknowledge it."""
        self._now_us = now_us
        action = self._actions.get(command)
        if action is None:
            return Result.UNSUPPORTED
        if self._autopilot.terminated and command not in _AFTER_TERMINATION:
            return Result.TEMPORARILY_REJECTED
        return action(params)

    def set_mode(self, base: int, custom_mode: int, now_us: int) -> Result | None:
        """Execute the message SET_MODE."""
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        params = (float(base), float(main), float(sub), 0.0, 0.0, 0.0, 0.0)
        return self.run(mav.MAV_CMD_DO_SET_MODE, params, now_us)

    # --- flight ---

    def _enter(self, mode: Px4Mode) -> Result:
        return self._autopilot.set_mode(mode, self._now_us, tell=self._messages.sender[1] == _TOLD_WHY)

    def _arm_disarm(self, params: Params) -> Result | None:
        if params[0] == 1.0:
            return self._autopilot.arm(self._now_us)
        if params[0] == 0.0:
            return self._autopilot.disarm(force=params[1] == FORCE)
        self._autopilot.send_text(Severity.CRITICAL, f"Unsupported ARM_DISARM param: {params[0]:.3f}\t")
        return None

    def _set_mode(self, params: Params) -> Result:
        base, main, sub = (_whole(p) for p in params[:3])
        if base is None or main is None or not base & CUSTOM_MODE_FLAG:
            return self._unsupported("base")
        if main == _MAIN_AUTO:
            main |= (sub or _SUB_MISSION) << 8
        mode = main << 16
        if mode not in MODE_NAMES:
            return self._unsupported("auto" if main & 0xFF == _MAIN_AUTO else "main")
        return self._enter(Px4Mode(mode))

    def _unsupported(self, what: str) -> Result:
        self._autopilot.send_text(Severity.CRITICAL, f"Unsupported {what} mode\t")
        return Result.TEMPORARILY_REJECTED

    def _takeoff(self, params: Params) -> Result:
        alt_amsl_m = params[6] if math.isfinite(params[6]) else None
        tell = self._messages.sender[1] == _TOLD_WHY
        return self._autopilot.set_mode(Px4Mode.AUTO_TAKEOFF, self._now_us, alt_amsl_m, tell=tell)

    def _start_mission(self, params: Params) -> Result:
        pilot, first = self._autopilot, _whole(params[0])
        if not pilot.store.mission:
            return Result.DENIED
        if first is None or not -1 <= first < len(pilot.store.mission):
            return Result.TEMPORARILY_REJECTED
        if self._enter(Px4Mode.AUTO_MISSION) != Result.ACCEPTED or pilot.arm(self._now_us) != Result.ACCEPTED:
            name = MODE_NAMES[Px4Mode.AUTO_MISSION]
            pilot.send_text(Severity.CRITICAL, f"Switching to {name} is currently not available\t")
            return Result.TEMPORARILY_REJECTED
        pilot.store.jump(max(0, first))
        return Result.ACCEPTED

    def _set_current(self, params: Params) -> Result:
        seq = _whole(params[0])
        return Result.ACCEPTED if seq is not None and self._autopilot.store.jump(seq) else Result.DENIED

    def _reposition(self, params: Params) -> Result:
        pilot, flags = self._autopilot, _whole(params[1]) or 0
        if flags & CHANGE_MODE_FLAG and self._enter(Px4Mode.AUTO_LOITER) != Result.ACCEPTED:
            return Result.TEMPORARILY_REJECTED
        here, origin = pilot.position_ned_m, pilot.boot.origin
        if here is None or origin is None:
            return Result.ACCEPTED
        x_m, y_m, z_m = here
        if math.isfinite(params[4]) and math.isfinite(params[5]) and abs(params[4]) <= 90 and abs(params[5]) <= 180:
            x_m, y_m = origin.to_xy_m(params[4] * 1e7, params[5] * 1e7)
        if math.isfinite(params[6]):
            z_m = origin.alt_mm / 1e3 - params[6]
        if math.isfinite(params[0]) and params[0] > 0:
            pilot.flight.cruise(params[0])
        pilot.reposition((x_m, y_m, z_m), params[3])
        return Result.ACCEPTED

    def _change_speed(self, params: Params) -> Result:
        if math.isfinite(params[1]):
            self._autopilot.flight.cruise(params[1] if params[1] > 0 else None)
        return Result.ACCEPTED

    def _set_home(self, params: Params) -> Result:
        pilot = self._autopilot
        origin, here = pilot.boot.origin, pilot.position_ned_m
        if origin is None or here is None:
            return Result.TEMPORARILY_REJECTED
        if params[0] == 1.0:
            pilot.home_ned_m = here
        elif all(math.isfinite(p) for p in params[4:]) and abs(params[4]) <= 90 and abs(params[5]) <= 180:
            pilot.home_ned_m = *origin.to_xy_m(params[4] * 1e7, params[5] * 1e7), origin.alt_mm / 1e3 - params[6]
        else:
            return Result.DENIED
        return Result.ACCEPTED

    def _terminate(self, params: Params) -> Result:
        return self._autopilot.terminate() if params[0] > 0.5 else Result.ACCEPTED

    def _reboot(self, params: Params) -> Result:
        if params[0] == 0.0:
            return Result.ACCEPTED  # nothing requested of the autopilot itself
        return self._autopilot.request_reboot(self._now_us) if params[0] == 1.0 else Result.DENIED

    # --- messages ---

    def _set_interval(self, params: Params) -> Result:
        message, interval_us = _whole(params[0]), _whole(params[1])
        if message is None or interval_us is None or not self._messages.set_interval(message, interval_us):
            return Result.FAILED
        return Result.ACCEPTED

    def _get_interval(self, params: Params) -> Result:
        self._messages.request(mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL, params[0])
        return Result.ACCEPTED

    def _request_message(self, params: Params) -> Result:
        message = _whole(params[0])
        if message is None:
            return Result.DENIED
        return Result.ACCEPTED if self._messages.request(message, params[1]) else Result.DENIED


def _whole(value: float) -> int | None:
    """Return the integer of a command parameter; None for NaN and infinities."""
    return int(value) if math.isfinite(value) else None
