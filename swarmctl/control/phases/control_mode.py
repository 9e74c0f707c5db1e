"""The control mode that an operator is shown: who flies a vehicle at the moment, and what it is doing. Pure."""

from __future__ import annotations

import enum

from swarmctl.core.types import Mode, Phase


class ControlMode(enum.StrEnum):
    """Names what a vehicle is doing; where the failsafe decides, its modes have their own names."""

    LOST = "LOST"  # no vehicle state that is new enough
    PILOT = "PILOT"  # its pilot or its autopilot has taken over
    FAILSAFE = "FAILSAFE"  # its autopilot has, because our setpoints had stopped
    AUTO = "AUTO"  # its autopilot flies it at the agent's request, or it stands
    HOLD = "HOLD"  # an operator holds it
    GOTO = "GOTO"  # at a point of the operator's, or on the way there
    WAIT = "WAIT"  # it rests because a peer is silent or deadlines are missed
    RETURN = "RETURN"  # on its way to its landing place, after a mission that is complete
    RTL = "RTL"  # the same because an operator, the battery, the link or the loss of a peer has ended the mission
    LANDING = "LANDING"


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
) -> str:
    """Return the control mode: the first row that applies."""
    rows = (
        (phase is Phase.CONNECT, ControlMode.AUTO),  # it was not seen yet
        (mode is Mode.STATE_STALE, ControlMode.LOST),
        (mode is Mode.PILOT_OVERRIDE and setpoints_stopped, ControlMode.FAILSAFE),
        (mode is Mode.PILOT_OVERRIDE, ControlMode.PILOT),
        (phase is Phase.LAND or mode is Mode.LAND, ControlMode.LANDING),
        (mode in (Mode.REPLAY, Mode.BRAKE, Mode.HOLD), mode.name),
        (goes_to_point, ControlMode.GOTO),
        (held, ControlMode.HOLD),
        (mode is Mode.IDLE, ControlMode.AUTO),
        (paused, ControlMode.WAIT),
        (phase is Phase.GOTO_LAND and lands_in_place, ControlMode.LANDING),
        (phase is Phase.GOTO_LAND, ControlMode.RETURN if completed else ControlMode.RTL),
    )
    return next((str(name) for applies, name in rows if applies), mode.name)
