"""Inputs of the mission state machine in one tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from swarmctl.control.failsafe.decision import NOTHING_WORN, Escalation
from swarmctl.control.failsafe.overload import Level
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, FlightMode, Mode, Phase, VehicleState


@dataclass(frozen=True, slots=True)
class PeerInputs:
    """The status of one peer, as far as the state machine needs it."""

    phase: Phase
    ready_utc_us: int
    alive: bool
    keeps_up: bool = True  # with its deadlines, as it has shown in rehearsals


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseInputs:
    """Everything the state machine's step depends on."""

    now_us: int
    utc_us: int
    state: VehicleState | None
    prepared: bool  # link setup is complete: the autopilot has answered every request
    armable: bool
    busy: bool  # a command is being executed
    mode: Mode  # last decision of the failsafe
    unresponsive_peer: bool  # no message for too long from a peer that may be flying
    peers: Callable[[], Mapping[int, PeerInputs]]  # returns what peers have told of themselves
    excused: frozenset[int] = frozenset()  # peers that have never been heard, and whom an operator has excluded
    cut_off: str = ""  # why the mission must end here, because peers don't answer
    others_ned_m: Callable[[], Sequence[Array]] = tuple  # returns the present position (3,) of each peer
    obstacles: Callable[[Array], Sequence[Obstacle]] = lambda _: ()  # returns those at rest known at a position (3,)
    moving_obstacles: Callable[[], Sequence[Obstacle]] = tuple  # returns those that move, where they are now
    arm_in: FlightMode | None = None  # flight mode required for arming; None: any
    boots: int = 0  # reboots of the autopilot so far
    refusal: str = ""  # reason why arming is refused for good, up to ARM
    unsettled: str = ""  # reason why arming must wait
    too_slow: str = ""  # what its processor has yet to show, likewise
    missed_01: float = 0.0  # fraction of deadlines missed of late
    overload: Level = Level.NONE  # response to missed deadlines
    escalation: Escalation = NOTHING_WORN  # response to what wears out: battery, link
    setpoints_stopped: str = ""  # by missed deadlines a moment ago, in words
    armed_told_us: int = -1  # arrival time of the HEARTBEAT that reported `state.armed`

    def crossing_obstacle(self, place_ned_m: Array, end_z_m: float, within_s: float) -> Obstacle | None:
        """Return an obstacle that moves onto the vertical from a place (3,) to a height, NED z, within a time."""
        coming = (o for o in self.moving_obstacles() if o.will_cross(place_ned_m, end_z_m, within_s))
        return next(coming, None)

    def obstacle_below(self, place_ned_m: Array, seen_from_ned_m: Array) -> Obstacle | None:
        """Return an obstacle, known at a position (3,), whose keep-out is on the vertical down from a place (3,)."""
        known = self.obstacles(seen_from_ned_m)
        return next((o for o in known if o.is_below(place_ned_m)), None)

    def is_over_obstacle(self, state: VehicleState) -> bool:
        """Return whether the autopilot, which avoids none, would land a vehicle on an obstacle."""
        return self.obstacle_below(state.pos_ned_m, state.pos_ned_m) is not None
