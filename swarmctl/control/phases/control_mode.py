"""The control mode that an operator is shown: who flies a vehicle at the moment, and what it is doing. Pure."""

from __future__ import annotations

from swarmctl.core.types import ControlMode, Mode, Phase

_FAILSAFES = {
    Mode.REPLAY: ControlMode.REPLAY,
    Mode.BRAKE: ControlMode.BRAKE,
    Mode.HOLD: ControlMode.HOLD,
}


def control_mode(
    phase: Phase,
    mode: Mode,
    *,
    held: bool,
    goes_to_point: bool,
    paused: bool,
    lands_in_place: bool,
    setpoints_stopped: bool = False,
    completed: bool = False,
) -> ControlMode:
    """Return the control mode: the first row that applies."""
    rows = (
        (phase is Phase.CONNECT, ControlMode.AUTO),  # it was not seen yet
        (mode is Mode.STATE_STALE, ControlMode.LOST),
        (mode is Mode.PILOT_OVERRIDE and setpoints_stopped, ControlMode.FAILSAFE),
        (mode is Mode.PILOT_OVERRIDE, ControlMode.PILOT),
        (phase is Phase.LAND or mode is Mode.LAND, ControlMode.LANDING),
        *((mode is decided, shown) for decided, shown in _FAILSAFES.items()),
        (goes_to_point, ControlMode.GOTO),
        (held, ControlMode.HOLD),
        (mode is Mode.IDLE, ControlMode.AUTO),
        (paused, ControlMode.WAIT),
        (phase is Phase.GOTO_LAND and lands_in_place, ControlMode.LANDING),
        (phase is Phase.GOTO_LAND, ControlMode.RETURN if completed else ControlMode.RTL),
        (mode is Mode.PRIMING, ControlMode.PRIMING),
    )
    return next((shown for applies, shown in rows if applies), ControlMode.TRACKING)
