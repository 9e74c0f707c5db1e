"""What PX4 does in a failsafe: the mode that is flown, after which delay, and when it returns to the commanded one.

`failsafe` monitors the causes except two that are seen here, a lost setpoint stream and a lost position; `Autopilot`
flies the modes.
"""

from __future__ import annotations

from typing import Protocol

from sitl.net.mavlink_values import Severity
from sitl.px4.failsafe import Action, Cause
from sitl.px4.modes import FLIES_BLIND, OffboardLoss, Px4Mode
from sitl.px4.parameters import Parameters

RESUME_US = 20_000  # from a resumed stream to OFFBOARD, before the next tick
_LOSS_MODES = {OffboardLoss.LAND: Px4Mode.AUTO_LAND, OffboardLoss.HOLD: Px4Mode.AUTO_LOITER}
_ACTION_MODES = {Action.HOLD: Px4Mode.AUTO_LOITER, Action.RETURN: Px4Mode.AUTO_RTL, Action.LAND: Px4Mode.AUTO_LAND}


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
    """The failsafe of one vehicle.

    Attributes:
        active: the autopilot acts on its own.
    """

    def __init__(self, pilot: FailsafePilot) -> None:
        self._pilot = pilot
        self.clear()

    def clear(self) -> None:
        """End the failsafe, whatever its cause."""
        self.active = False
        self._cause: Cause | None = None
        self._delayed: tuple[int, Action] | None = None  # time and action after a delay in Hold
        self._resume_us: int | None = None

    def check(self, cause: Cause, action: Action, now_us: int) -> None:
        """Act on a lost stream or position, and carry out what `Watch.check` has requested, of an armed vehicle."""
        pilot = self._pilot
        if pilot.mode == Px4Mode.OFFBOARD and not pilot.stream_alive(now_us):
            self._lose_stream()
        elif not pilot.has_position and pilot.mode not in FLIES_BLIND:
            self._fail(Cause.POSITION, Px4Mode.AUTO_LAND)
        elif pilot.has_position and self._cause == Cause.POSITION:
            self.clear()
            pilot.enter(pilot.intended)
        if action > Action.WARN:
            self._act(cause, action, now_us)
        elif self._delayed is not None and now_us >= self._delayed[0] and self._cause is not None:
            self._do(self._cause, self._delayed[1])

    def on_setpoint(self, now_us: int) -> None:
        """Prepare to resume OFFBOARD, when a loss of the stream has ended it."""
        if self.active and self._cause == Cause.OFFBOARD and self._resume_us is None:
            self._resume_us = now_us

    def resume_when_due(self, now_us: int) -> None:
        """Resume OFFBOARD after a loss of the stream, unless it is lost again."""
        if self._resume_us is None or now_us - self._resume_us < RESUME_US:
            return
        self._resume_us = None
        if self._pilot.stream_alive(now_us) and self._pilot.intended == Px4Mode.OFFBOARD:
            self.clear()
            self._pilot.enter(Px4Mode.OFFBOARD)

    def _lose_stream(self) -> None:
        action = self._pilot.parameters.integer("COM_OBL_RC_ACT")
        self._cause = Cause.OFFBOARD
        if action == OffboardLoss.TERMINATE:
            self._do(Cause.OFFBOARD, Action.TERMINATE)
        elif action == OffboardLoss.DISARM:
            self._do(Cause.OFFBOARD, Action.DISARM)
        else:
            known = OffboardLoss(action) if 0 <= action <= OffboardLoss.DISARM else OffboardLoss.RETURN
            self._fail(Cause.OFFBOARD, _LOSS_MODES.get(known, Px4Mode.AUTO_RTL))

    def _act(self, cause: Cause, action: Action, now_us: int) -> None:
        """Carry out a failsafe's action; Return and Land first wait in Hold for a pilot."""
        wait_s = self._pilot.parameters.real("COM_FAIL_ACT_T")
        if action in (Action.RETURN, Action.LAND) and wait_s > 0:
            self._fail(cause, Px4Mode.AUTO_LOITER)
            self._delayed = now_us + round(wait_s * 1e6), action
        else:
            self._do(cause, action)

    def _do(self, cause: Cause, action: Action) -> None:
        self._delayed = None
        if action in _ACTION_MODES:
            self._fail(cause, _ACTION_MODES[action])
            return
        self._pilot.send_text(Severity.CRITICAL, "Failsafe activated\t")
        if action == Action.TERMINATE:
            self.active = True
            self._pilot.stop_for_good()
        else:
            self._pilot.switch_off("Disarmed by failsafe\t", keep_mode=True)

    def _fail(self, cause: Cause, mode: Px4Mode) -> None:
        """Fly `mode` until a mode is commanded, or until the cause has ended where PX4 then returns by itself."""
        self._delayed = self._resume_us = None
        if not self.active or cause != self._cause:
            self._pilot.send_text(Severity.CRITICAL, "Failsafe activated\t")
        self.active, self._cause = True, cause
        mode = mode if self._pilot.has_position or mode in FLIES_BLIND else Px4Mode.AUTO_LAND
        if mode != self._pilot.mode:
            self._pilot.enter(mode)
