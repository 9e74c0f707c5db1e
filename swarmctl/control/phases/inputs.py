"""What the sequence of phases goes by: one tick, as it sees it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from swarmctl.control.phases.overload import Level
from swarmctl.core.types import Array, FlightMode, Mode, Phase, VehicleState


@dataclass(frozen=True, slots=True)
class PeerInputs:
    """What the sequence needs to know of a peer."""

    phase: Phase
    ready_utc_us: int
    alive: bool


@dataclass(frozen=True, slots=True)
class PhaseInputs:
    """This tick, as the sequence sees it."""

    now_us: int
    utc_us: int
    state: VehicleState | None
    prepared: bool  # the link is set up: all that had to be asked of the autopilot has been answered
    armable: bool
    busy: bool  # a command is being executed
    mode: Mode  # last judgement
    bus_lost: bool  # a peer that may well be flying has not been heard for too long
    peers: Mapping[int, PeerInputs]
    others_ned_m: tuple[Array, ...] = ()  # (3,) each: where peers are now
    arm_in: FlightMode | None = None  # flight mode to be in before arming; None: the one it is in
    boots: int = 0  # reboots of the autopilot so far
    refusal: str = ""  # why nothing may be armed
    unsettled: str = ""  # why nothing may be armed yet; it may pass
    overload: Level = Level.NONE  # what missed deadlines ask for
    armed_told_us: int = -1  # arrival of the HEARTBEAT that told `state.armed`
