"""The trajectories that an agent follows outside of its mission, and the way back to the mission's reference. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.control.phases.way_back import WayBack, way_back
from swarmctl.control.reference.mission import MissionReference
from swarmctl.control.reference.quintic import QuinticTrajectory, brake_to_rest, quintic_to
from swarmctl.core.types import Array, VehicleState

_WAY_POINTS = 300  # of a way that is checked


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
        """Begin to brake to rest, smoothly or at once."""
        accel_m_s2 = max(self._accel_m_s2, 2.0 * self._brake_m_s2) if at_once else self._accel_m_s2
        self._begin(brake_to_rest(state.pos_ned_m, state.vel_ned_m_s, accel_m_s2), now_us)

    def go_to(self, target_ned_m: Array, now_us: int, state: VehicleState, speed_m_s: float | None = None) -> None:
        """Begin a transit to a target (3,), at the peak speed of transits or another one."""
        speed_m_s = self._speed_m_s if speed_m_s is None else speed_m_s
        transit = quintic_to(state.pos_ned_m, state.vel_ned_m_s, target_ned_m, speed_m_s, accel_m_s2=self._accel_m_s2)
        self._begin(transit, now_us)

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
        speed_m_s, accel_m_s2 = self._speed_m_s, self._accel_m_s2
        return way_back(mission, mission_t_s, now_us, state, speed_m_s=speed_m_s, accel_m_s2=accel_m_s2)

    def _begin(self, trajectory: QuinticTrajectory, now_us: int) -> None:
        self.current = BegunTrajectory(trajectory=trajectory, began_us=now_us)


def is_at(state: VehicleState, target_ned_m: Array, within_m: float, slower_m_s: float) -> bool:
    """Return whether a vehicle is near a target (3,) and slow enough."""
    speed_m_s = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
    return math.dist(state.pos_ned_m, target_ned_m) < within_m and speed_m_s < slower_m_s
