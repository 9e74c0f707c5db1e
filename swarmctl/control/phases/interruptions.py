"""What interrupts a transit or the mission: the operator's hold and `goto`, and pauses. Pure.

An agent may be held and paused at once: it goes on when neither is left.
"""

from __future__ import annotations

from dataclasses import dataclass

from swarmctl.control.phases.trajectories import Trajectories
from swarmctl.core.types import Array, VehicleState

_DRIVEN_M = 0.3  # from where it has stopped, of a vehicle that rests where it is then


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldPoint:
    """The point of a `goto`."""

    ned_m: Array  # (3,)
    speed_m_s: float | None  # peak speed to it, None for that of transits
    yaw_rad: float | None  # heading there and on the way, None for the mission's


class Interruptions:
    """Brings the agent to rest, where it is or at a point of the operator's.

    Args:
        trajectories: set to the stop or the way to the point.

    Attributes:
        held: the operator has asked to hold, or to go to a point.
        held_since_us: monotonic time at which the last hold began.
        yaw_rad: heading that the operator has asked for, None for the mission's.
        paused: the agent rests because the bus is lost or its processor is overloaded.
    """

    def __init__(self, trajectories: Trajectories) -> None:
        self._trajectories = trajectories
        self.held = False
        self.held_since_us = 0
        self.yaw_rad: float | None = None
        self.paused = self._keeps_up = False
        self._point: HoldPoint | None = None

    @property
    def active(self) -> bool:
        """Return whether anything interrupts the agent."""
        return self.held or self.paused

    @property
    def goes_to_point(self) -> bool:
        """Return whether the operator holds the agent at a point, or on the way there."""
        return self.held and self._point is not None

    @property
    def point_ned_m(self) -> Array | None:
        """Return the point (3,) that a hold asks for; None where it holds where it is, or there is no hold."""
        return self._point.ned_m if self.held and self._point is not None else None

    def hold(self, now_us: int, state: VehicleState, *, brakes: bool) -> None:
        """Hold where the vehicle is; it need not brake where the autopilot hovers."""
        self._interrupt(now_us, state, brakes=brakes)
        self._point = self.yaw_rad = None
        if not self.held:
            self.held, self.held_since_us = True, now_us

    def move_hold(self, point: HoldPoint, now_us: int, state: VehicleState) -> None:
        """Hold at a point from now on, instead of where the vehicle is."""
        self._point, self.yaw_rad = point, point.yaw_rad
        self.stay(now_us, state)

    def stay(self, now_us: int, state: VehicleState) -> None:
        """Come to rest: here, or at the point that a hold asks for, unless the agent is paused."""
        if self._point is None or self.paused:
            self._trajectories.stop(now_us, state, at_once=self.stops_at_once)
        else:
            self._trajectories.go_to(self._point.ned_m, now_us, state, self._point.speed_m_s)

    def end_hold(self) -> None:
        """End a hold, if there is one."""
        self.held, self._point, self.yaw_rad = False, None, None

    @property
    def stops_at_once(self) -> bool:
        """Return whether a stop has to be hard, as in a pause.

        Who is paused is not heard, or hardly. Peers expect such a vehicle to brake hard at the end of its path, and one
        that braked as softly as transits do was met where it was taken to have stopped long before. Who misses
        deadlines can't: it would hold its tilt for too long.
        """
        return self.paused and self._keeps_up

    def update_pause(self, now_us: int, state: VehicleState, *, must_wait: bool, flies: bool, keeps_up: bool) -> bool:
        """Begin or end a pause; return whether the agent goes on with what was interrupted.

        Args:
            now_us, state: now.
            must_wait: peers are silent, or deadlines are missed.
            flies: the agent has control.
            keeps_up: hardly any deadline is missed.
        """
        if must_wait and flies and not self.paused:
            self._interrupt(now_us, state, brakes=False)
            self.paused, self._keeps_up = True, keeps_up
            self.stay(now_us, state)
        elif self.paused and not must_wait:
            self.paused = False
            if not self.held:
                return True
            self.stay(now_us, state)
        elif self.paused and self._trajectories.is_left(now_us, state, _DRIVEN_M):
            self.stay(now_us, state)  # the way back may lead through others that were driven away, too
        return False

    def _interrupt(self, now_us: int, state: VehicleState, *, brakes: bool) -> None:
        """Come to rest, and remember where a transit leads."""
        if not self.active:
            self._trajectories.keep_destination()
        if brakes:
            self._trajectories.stop(now_us, state, at_once=self.stops_at_once)
