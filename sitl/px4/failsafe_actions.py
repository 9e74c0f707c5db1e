"""What PX4 does in a failsafe: the mode that is flown, after which delay, and when it returns to the commanded one.

Every cause keeps its action, and the most severe one is flown. Where that is Return or Land it waits COM_FAIL_ACT_T
seconds in Hold, so that a pilot can take over, unless the vehicle acts as severely already. A cause that ends takes its
action with it, but for a geofence and a lost ground station, whose actions last until a mode is commanded. A commanded
mode suspends the others, too, until another cause begins.

`failsafe` monitors the causes except two that are seen here, a lost setpoint stream and a lost position; `Autopilot`
flies the modes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Protocol

from sitl.net.mavlink_values import Severity
from sitl.px4.failsafe import Action, Cause
from sitl.px4.modes import FLIES_BLIND, OffboardLoss, Px4Mode
from sitl.px4.parameters import Parameters

RESUME_US = 20_000  # from a resumed stream to OFFBOARD, before the next tick
_LOSS_ACTIONS: dict[int, Action] = {  # others need a pilot, or are Return
    OffboardLoss.LAND: Action.LAND,
    OffboardLoss.HOLD: Action.HOLD,
    OffboardLoss.TERMINATE: Action.TERMINATE,
    OffboardLoss.DISARM: Action.DISARM,
}
_ACTION_MODES = {Action.HOLD: Px4Mode.AUTO_LOITER, Action.RETURN: Px4Mode.AUTO_RTL, Action.LAND: Px4Mode.AUTO_LAND}
_AT_ONCE = frozenset(  # what a pilot is given no time for
    {(cause, action) for cause in (Cause.OFFBOARD, Cause.POSITION) for action in _ACTION_MODES}
    | {(Cause.GEOFENCE, Action.HOLD)}
)
_ENDS = frozenset({Cause.OFFBOARD, Cause.POSITION, Cause.BATTERY})  # causes that take their actions with them


class FailsafePilot(Protocol):
    """The autopilot as its failsafes see it."""

    @property
    def parameters(self) -> Parameters:
        """The parameters of the autopilot."""

    @property
    def mode(self) -> Px4Mode:
        """The mode that flies."""

    @property
    def intended(self) -> Px4Mode:
        """The commanded mode."""

    @property
    def has_position(self) -> bool:
        """Whether there is a horizontal position."""

    def stream_alive(self, now_us: int) -> bool:
        """Return whether setpoints arrive."""

    def enter(self, mode: Px4Mode) -> None:
        """Fly a mode."""

    def switch_off(self, text: str, *, keep_mode: bool = False) -> None:
        """Disarm, and say why."""

    def stop_for_good(self) -> None:
        """Stop the motors until a reboot."""

    def send_text(self, severity: Severity, text: str) -> None:
        """Queue a STATUSTEXT."""


class FailsafeActions:
    """The failsafe of one vehicle."""

    def __init__(self, pilot: FailsafePilot) -> None:
        self._pilot = pilot
        self.clear()

    def clear(self) -> None:
        """Forget every cause, as when arming and disarming."""
        self._kept: dict[Cause, Action] = {}
        self._lasting: frozenset[Cause] = frozenset()  # causes that are still there
        self._suspended = False
        self._stop()

    def suspend(self) -> None:
        """Leave the vehicle to a mode that has just been commanded."""
        self._kept = {cause: action for cause, action in self._kept.items() if cause in self._lasting}
        self._suspended = bool(self._kept)
        self._stop()

    def _stop(self) -> None:
        self._flown = Action.NONE
        self._hold_until_us: int | None = None
        self._resume_us: int | None = None

    @property
    def active(self) -> bool:
        """Whether the autopilot acts on its own."""
        return self._flown > Action.WARN

    def check(self, wanted: Mapping[Cause, Action], begun: Collection[Cause], now_us: int) -> None:
        """Act on a lost stream or position, and on what `Watch.check` has found, of an armed vehicle."""
        pilot = self._pilot
        self._lasting = frozenset(cause for cause, action in wanted.items() if action > Action.WARN)
        if pilot.intended == Px4Mode.OFFBOARD and not pilot.stream_alive(now_us):
            self._resume_us = None
            self._keep(Cause.OFFBOARD, self._loss_action(), now_us)
        if not pilot.has_position and pilot.intended not in FLIES_BLIND:
            self._keep(Cause.POSITION, Action.LAND, now_us)
        else:
            self._kept.pop(Cause.POSITION, None)
        for cause in self._lasting:
            if cause in begun or cause in self._kept:
                self._keep(cause, wanted[cause], now_us)
        for cause in self._kept.keys() & wanted.keys() - self._lasting:
            if cause in _ENDS or self._suspended:
                del self._kept[cause]
        self._fly(now_us)

    def on_setpoint(self, now_us: int) -> None:
        """Prepare to resume OFFBOARD, when a loss of the stream has ended it."""
        if Cause.OFFBOARD in self._kept and self._resume_us is None:
            self._resume_us = now_us

    def resume_when_due(self, now_us: int) -> None:
        """End a loss of the stream once it is there again, unless it is lost again."""
        if self._resume_us is None or now_us - self._resume_us < RESUME_US:
            return
        self._resume_us = None
        if self._pilot.stream_alive(now_us):
            self._kept.pop(Cause.OFFBOARD, None)
            self._fly(now_us)

    def _keep(self, cause: Cause, action: Action, now_us: int) -> None:
        """Keep what a cause wants; more than before ends what has suspended the others."""
        if action > self._kept.get(cause, Action.NONE):
            self._suspended = False
            wait_s = self._pilot.parameters.real("COM_FAIL_ACT_T")
            waits = action in _ACTION_MODES and (cause, action) not in _AT_ONCE and wait_s > 0.0
            if waits and self._hold_until_us is None:
                self._hold_until_us = now_us + round(wait_s * 1e6)
        self._kept[cause] = action

    def _loss_action(self) -> Action:
        return _LOSS_ACTIONS.get(self._pilot.parameters.integer("COM_OBL_RC_ACT"), Action.RETURN)

    def _fly(self, now_us: int) -> None:
        """Do what the most severe action asks for, or return to the commanded mode when none is left."""
        pilot = self._pilot
        action = Action.NONE if self._suspended else max(self._kept.values(), default=Action.NONE)
        if action < Action.DISARM and self._waits(now_us):
            action = min(action, Action.HOLD)
        if action in (Action.HOLD, Action.RETURN) and not pilot.has_position:
            action = Action.LAND
        before, self._flown = self._flown, action
        if action > max(before, Action.WARN):
            pilot.send_text(Severity.CRITICAL, "Failsafe activated\t")
        if action == Action.TERMINATE:
            pilot.stop_for_good()
        elif action == Action.DISARM:
            pilot.switch_off("Disarmed by failsafe\t", keep_mode=True)
        elif max(action, before) > Action.WARN:
            mode = _ACTION_MODES.get(action, pilot.intended)
            if mode != pilot.mode:
                pilot.enter(mode)

    def _waits(self, now_us: int) -> bool:
        """Return whether a pilot still has time to take over, which a vehicle that does more than hold has not."""
        if self._hold_until_us is None:
            return False
        if self._flown > Action.HOLD or not self._pilot.has_position or now_us >= self._hold_until_us:
            self._hold_until_us = None
        return self._hold_until_us is not None
