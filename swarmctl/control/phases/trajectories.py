"""The trajectories that an agent follows outside of its mission, and the way back to the mission's reference. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from swarmctl.control.phases.way_back import WayBack, way_back
from swarmctl.control.reference.mission import MissionReference
from swarmctl.control.reference.quintic import QuinticTrajectory, brake_to_rest, shedding_s, transit_to
from swarmctl.core.types import Array, VehicleState

_WAY_POINTS = 300  # of a way that is checked
TRANSIT_HEIGHT_M = 0.5  # least above the ground, of a point to go to, and as a vehicle stops or turns round
_LOWER_M = 0.1  # by which one that flies lower than that may sink: it need not brake hard for a swaying
_HARDER = 8  # decelerations that are tried, from that of transits up, until one keeps above the ground
_LOW_POINTS = 60  # of a way whose lowest point is looked for, and of the part in which its first velocity is shed
# most deceleration over `brake_m_s2`: 3/4 of it is the peak of a stop, 1.31 that of shedding a velocity
_OF_STOPS, _OF_SHEDDING = 2.0, 1.15

W = TypeVar("W")


@dataclass(frozen=True, slots=True, kw_only=True)
class BegunTrajectory:
    """A trajectory and the monotonic time of its start."""

    trajectory: QuinticTrajectory
    began_us: int

    def sample(self, now_us: int, offsets_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) each, at `offsets_s` (K,) from now."""
        return self.trajectory.sample((now_us - self.began_us) * 1e-6 + offsets_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class OfferedMission:
    """A mission that an operator may have flown instead of the configured one."""

    reference: MissionReference
    duration_s: float
    text: str  # its parameters as JSON


class Trajectories:
    """Owns the transit or stop under way, its destination and the way back into the mission.

    Args:
        mission: reference of the tracked mission.
        start_ned_m: (3,) start position; the reference until there is a trajectory.
        speed_m_s: peak speed of a transit.
        accel_m_s2: peak acceleration of transits and stops.
        brake_m_s2: mean deceleration of a stop at once.

    Attributes:
        current: transit or stop that began last, None before the first.
        destination_ned_m: (3,) end of the transit that a pause or a hold interrupts.
        ground_z_m: down coordinate of the place of the take-off; None where it is not known.
    """

    def __init__(
        self,
        mission: MissionReference,
        start_ned_m: Array,
        *,
        speed_m_s: float,
        accel_m_s2: float,
        brake_m_s2: float,
    ) -> None:
        self._mission, self._start_ned_m = mission, start_ned_m
        self._speed_m_s, self._accel_m_s2, self._brake_m_s2 = speed_m_s, accel_m_s2, brake_m_s2
        self.current: BegunTrajectory | None = None
        self.destination_ned_m = start_ned_m
        self.ground_z_m: float | None = None
        self._way_back: WayBack | None = None

    def reference(self, now_us: int, offsets_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities outside of the mission, (K, 3) each, at `offsets_s` (K,) from now."""
        if self.current is not None:
            return self.current.sample(now_us, offsets_s)
        return np.tile(self._start_ned_m, (len(offsets_s), 1)), np.zeros((len(offsets_s), 3))

    def mission_reference(self, mission_t_s: float, now_us: int, offsets_s: Array) -> tuple[Array, Array]:
        """Return the mission's positions and velocities, (K, 3) each, or those of the way back to it."""
        pos, vel = self._mission.sample(mission_t_s + offsets_s)
        way = self._way_back
        return (pos, vel) if way is None else way.sample(way.elapsed_s(now_us) + offsets_s, pos, vel)

    def rejoins(self, now_us: int) -> bool:
        """Return whether the way back to the mission's reference is under way."""
        way = self._way_back
        return way is not None and way.elapsed_s(now_us) < max(way.travel_s, way.shed_s)

    def change_mission(self, mission: MissionReference) -> None:
        """Follow another mission from now on."""
        self._mission, self._way_back = mission, None

    def stand(self, now_us: int, state: VehicleState) -> None:
        """Begin to stay at the vehicle's place, as if it were at rest."""
        here = QuinticTrajectory(
            from_ned_m=state.pos_ned_m, vel_ned_m_s=np.zeros(3), to_ned_m=state.pos_ned_m, travel_s=1.0
        )
        self._begin(here, now_us)

    def stop(self, now_us: int, state: VehicleState, *, at_once: bool = False) -> None:
        """Begin to brake to rest, smoothly or at once; harder where a vehicle that sinks would come near the ground."""
        pos, vel = state.pos_ned_m, state.vel_ned_m_s
        least_m_s2, most_m_s2 = self._decelerations_m_s2(vel, _OF_STOPS)
        braked = self._above_ground(
            state,
            (most_m_s2 if at_once else least_m_s2, most_m_s2),
            lambda accel_m_s2: brake_to_rest(pos, vel, accel_m_s2),
            lambda found: float(found.to_ned_m[2]),
        )
        if self.ground_z_m is not None and braked.to_ned_m[2] > (lowest_m := self._lowest_m(state)):
            braked = replace(braked, to_ned_m=np.array([*braked.to_ned_m[:2], lowest_m]))
        self._begin(braked, now_us)

    def go_to(self, target_ned_m: Array, now_us: int, state: VehicleState, speed_m_s: float | None = None) -> None:
        """Begin a transit to a target (3,), at the peak speed of transits or another one."""
        peak_m_s = self._speed_m_s if speed_m_s is None else speed_m_s
        pos, vel, accel_m_s2 = state.pos_ned_m, state.vel_ned_m_s, self._accel_m_s2

        def shed(shed_m_s2: float) -> QuinticTrajectory:
            shed_s = shedding_s(vel, shed_m_s2)
            return transit_to(pos, vel, target_ned_m, peak_m_s, accel_m_s2=accel_m_s2, shed_s=shed_s)

        def lowest_m(found: QuinticTrajectory) -> float:
            return float(found.sample(_low_s(found.travel_s, found.shed_s))[0][:, 2].max())

        between_m_s2 = self._decelerations_m_s2(vel, _OF_SHEDDING)
        self._begin(self._above_ground(state, between_m_s2, shed, lowest_m, float(target_ned_m[2])), now_us)

    def is_left(self, now_us: int, state: VehicleState, away_m: float) -> bool:
        """Return whether the present trajectory is over and the vehicle farther than that from its end."""
        begun = self.current
        if begun is None or now_us - begun.began_us <= begun.trajectory.travel_s * 1e6:
            return False
        return math.dist(state.pos_ned_m, begun.trajectory.to_ned_m) > away_m

    def keep_destination(self) -> None:
        """Take the end of the present trajectory as the destination, which later stops don't change."""
        if self.current is not None:
            self.destination_ned_m = self.current.trajectory.to_ned_m

    def rejoin_mission(self, mission_t_s: float, now_us: int, state: VehicleState) -> None:
        """Rejoin the mission's moving reference on a smooth way: after a jump all agents would rush together."""
        self._way_back = self._way_to(self._mission, mission_t_s, now_us, state)

    def way_into(self, mission: MissionReference, mission_t_s: float, state: VehicleState) -> Array:
        """Return points (K, 3) of the way on which a mission's moving reference would be joined."""
        way = self._way_to(mission, mission_t_s, 0, state)
        t_s = np.linspace(0.0, way.travel_s, _WAY_POINTS)
        return way.sample(t_s, *mission.sample(mission_t_s + t_s))[0]

    def _way_to(self, mission: MissionReference, mission_t_s: float, now_us: int, state: VehicleState) -> WayBack:
        limits = {"speed_m_s": self._speed_m_s, "accel_m_s2": self._accel_m_s2}

        def shed(shed_m_s2: float) -> WayBack:
            shed_s = shedding_s(state.vel_ned_m_s, shed_m_s2)
            return way_back(mission, mission_t_s, now_us, state, **limits, shed_s=shed_s)

        def below_mission_m(found: WayBack) -> float:
            t_s = _low_s(found.travel_s, found.shed_s)
            pos, vel = mission.sample(mission_t_s + t_s)
            lowest_m = float(found.sample(t_s, pos, vel)[0][:, 2].max())
            return -math.inf if lowest_m <= pos[:, 2].max() else lowest_m

        return self._above_ground(
            state, self._decelerations_m_s2(state.vel_ned_m_s, _OF_SHEDDING), shed, below_mission_m
        )

    def _decelerations_m_s2(self, vel_ned_m_s: Array, of_brake: float) -> tuple[float, float]:
        """Return the least and the most deceleration at which a first velocity (3,) is shed, or braked to rest."""
        hard_m_s2 = max(self._accel_m_s2, of_brake * self._brake_m_s2)
        return _gentle_m_s2(vel_ned_m_s, self._speed_m_s, self._accel_m_s2, hard_m_s2), hard_m_s2

    def _lowest_m(self, state: VehicleState) -> float:
        """Return the down coordinate to which a vehicle may be carried; one that is lower already, hardly lower."""
        low_m = float(state.pos_ned_m[2]) + _LOWER_M
        return low_m if self.ground_z_m is None else max(self.ground_z_m - TRANSIT_HEIGHT_M, low_m)

    def _above_ground(
        self,
        state: VehicleState,
        between_m_s2: tuple[float, float],
        way: Callable[[float], W],
        lowest_m: Callable[[W], float],
        end_m: float = -math.inf,
    ) -> W:
        """Return the way with the least deceleration that keeps above the ground, or with the most.

        Args:
            state: of the vehicle.
            between_m_s2: least and most deceleration.
            way: returns the way with a deceleration.
            lowest_m: returns the down coordinate of its lowest point.
            end_m: down coordinate where it is meant to end.
        """
        least_m_s2, most_m_s2 = between_m_s2
        found = way(least_m_s2)
        if self.ground_z_m is None or state.vel_ned_m_s[2] <= 0.0:
            return found
        for harder_m_s2 in np.geomspace(least_m_s2, most_m_s2, _HARDER)[1:].tolist():
            if lowest_m(found) <= max(self._lowest_m(state), end_m):
                return found
            found = way(harder_m_s2)
        return found

    def _begin(self, trajectory: QuinticTrajectory, now_us: int) -> None:
        self.current = BegunTrajectory(trajectory=trajectory, began_us=now_us)


def way_home(
    pos_ned_m: Array, vel_ned_m_s: Array, home_ned_m: Array, *, speed_m_s: float, accel_m_s2: float, brake_m_s2: float
) -> QuinticTrajectory:
    """Return the way home from a place and velocity (3,), of a vehicle that the ground does not have to be kept from.

    Args:
        pos_ned_m, vel_ned_m_s, home_ned_m: where it begins, and ends.
        speed_m_s, accel_m_s2, brake_m_s2: as of `Trajectories`.
    """
    hard_m_s2 = max(accel_m_s2, _OF_SHEDDING * brake_m_s2)
    shed_s = shedding_s(vel_ned_m_s, _gentle_m_s2(vel_ned_m_s, speed_m_s, accel_m_s2, hard_m_s2))
    return transit_to(pos_ned_m, vel_ned_m_s, home_ned_m, speed_m_s, accel_m_s2=accel_m_s2, shed_s=shed_s)


def _low_s(travel_s: float, shed_s: float | None) -> Array:
    """Return the times of a way (K,) at which its lowest point is looked for: a long one leads lowest as it begins."""
    whole_s = np.linspace(0.0, travel_s, _LOW_POINTS)
    if shed_s is None:
        return whole_s
    return np.concatenate([whole_s, np.linspace(0.0, min(shed_s, travel_s), _LOW_POINTS)])


def _gentle_m_s2(vel_ned_m_s: Array, speed_m_s: float, accel_m_s2: float, hard_m_s2: float) -> float:
    """Return the mean deceleration of a velocity (3,): that of transits up to their speed, a hard one above it.

    A mission at 7.5 m/s would else lead 40 m beyond its end.
    """
    first_m_s = math.sqrt(float(vel_ned_m_s @ vel_ned_m_s))
    fast_m_s = first_m_s - speed_m_s
    return accel_m_s2 if fast_m_s <= 0.0 else first_m_s / (speed_m_s / accel_m_s2 + fast_m_s / hard_m_s2)


def is_at(state: VehicleState, target_ned_m: Array, within_m: float, slower_m_s: float) -> bool:
    """Return whether a vehicle is near a target (3,) and slow enough."""
    speed_m_s = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
    return math.dist(state.pos_ned_m, target_ned_m) < within_m and speed_m_s < slower_m_s
