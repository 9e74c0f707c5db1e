"""Failsafes of PX4 besides a lost setpoint stream: geofence, battery, ground-station link.

This module monitors and requests actions; `failsafe_actions` executes them.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence

from sitl.net.mavlink_values import Severity
from sitl.px4.parameters import Parameters


class Action(enum.IntEnum):
    """Actions in rising order of severity."""

    NONE = 0
    WARN = 1
    HOLD = 2
    RETURN = 3
    LAND = 4
    DISARM = 5
    TERMINATE = 6


class Cause(enum.IntEnum):
    """Reasons why the autopilot acts on its own."""

    OFFBOARD = 0
    POSITION = 1
    GEOFENCE = 2
    BATTERY = 3
    GCS = 4


_FENCE_ACTIONS = (Action.NONE, Action.WARN, Action.HOLD, Action.RETURN, Action.TERMINATE, Action.LAND)
_LINK_ACTIONS = (Action.NONE, Action.HOLD, Action.RETURN, Action.LAND, Action.NONE, Action.TERMINATE, Action.DISARM)
_BATTERY_ACTIONS = {  # COM_LOW_BAT_ACT: at critical, at emergency
    0: (Action.WARN, Action.WARN),
    1: (Action.RETURN, Action.RETURN),
    2: (Action.LAND, Action.LAND),
    3: (Action.RETURN, Action.LAND),
}
BATTERY_TEXTS = {
    1: (Severity.CRITICAL, "Low battery\t"),
    2: (Severity.CRITICAL, "Critical battery\t"),
    3: (Severity.EMERGENCY, "Emergency battery level\t"),
}
CIRCUIT_BREAKER = 894281


class Watch:
    """Monitors the failsafe conditions of one vehicle.

    Attributes:
        battery_warning: 0 none, 1 low, 2 critical, 3 emergency; never falls while armed.
        fence_broken: it is on the wrong side of an active fence.
    """

    def __init__(self, parameters: Parameters, send_text: Callable[[Severity, str], None]) -> None:
        self._parameters = parameters
        self._send_text = send_text
        self.reset()

    def reset(self) -> None:
        """Reset to the state after boot."""
        self.battery_warning = 0
        self.fence_broken = False
        self._gcs_us: int | None = None
        self._gcs_lost = False
        self._acted: dict[Cause, Action] = {}

    def on_gcs_heartbeat(self, now_us: int) -> None:
        """Take a HEARTBEAT of type 6 from any link."""
        if self._gcs_lost:
            self._gcs_lost = False
            self._send_text(Severity.INFO, "GCS connection regained\t")
        self._gcs_us = now_us

    def forget(self) -> None:
        """Allow causes to act again, after disarming."""
        self._acted.clear()

    def check(
        self, breaches: Sequence[str], battery_01: float, now_us: int, *, armed: bool
    ) -> tuple[dict[Cause, Action], list[Cause]]:
        """Return what every cause wants now, WARN or less being nothing, and those of an armed vehicle that want more.

        A cause that was there before the vehicle was armed wants no more for that.
        """
        wanted = {
            Cause.GEOFENCE: self._fence(breaches),
            Cause.BATTERY: self._battery(battery_01, armed=armed),
            Cause.GCS: self._gcs(now_us),
        }
        begun = [cause for cause, action in wanted.items() if armed and action > self._acted.get(cause, Action.NONE)]
        self._acted.update(wanted)
        return wanted, begun

    def _fence(self, breaches: Sequence[str]) -> Action:
        action = _pick(_FENCE_ACTIONS, self._parameters.integer("GF_ACTION"), Action.WARN)
        broken = bool(breaches) and action > Action.NONE
        if broken and not self.fence_broken:
            for text in breaches:
                self._send_text(Severity.CRITICAL, text)
        self.fence_broken = broken
        return action if broken else Action.NONE

    def _battery(self, battery_01: float, *, armed: bool) -> Action:
        if self._parameters.integer("CBRK_SUPPLY_CHK") == CIRCUIT_BREAKER:
            self.battery_warning = 0
            return Action.NONE
        limits = (self._parameters.real(name) for name in ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR"))
        level = sum(battery_01 < limit for limit in limits) if math.isfinite(battery_01) else 0
        if level > self.battery_warning:
            self._send_text(*BATTERY_TEXTS[level])
        self.battery_warning = max(level, self.battery_warning) if armed else level
        if self.battery_warning < 2:
            return Action.WARN if self.battery_warning else Action.NONE
        critical, emergency = _BATTERY_ACTIONS.get(self._parameters.integer("COM_LOW_BAT_ACT"), _BATTERY_ACTIONS[0])
        return emergency if self.battery_warning == 3 else critical

    def _gcs(self, now_us: int) -> Action:
        limit_us = self._parameters.real("COM_DL_LOSS_T") * 1e6
        silent = self._gcs_us is None or now_us - self._gcs_us > limit_us
        if silent and self._gcs_us is not None and not self._gcs_lost:
            self._gcs_lost = True
            self._send_text(Severity.INFO, "Connection to ground station lost\t")
        return _pick(_LINK_ACTIONS, self._parameters.integer("NAV_DLL_ACT"), Action.NONE) if silent else Action.NONE


def _pick(actions: Sequence[Action], value: int, otherwise: Action) -> Action:
    return actions[value] if 0 <= value < len(actions) else otherwise
