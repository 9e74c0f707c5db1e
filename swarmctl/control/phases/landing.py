"""Where an agent lands, and whether its autopilot may land it there yet. Pure.

Autopilots know neither each other nor obstacles. Before one takes over, the agent therefore comes to rest and moves
away from others, and from above obstacles at rest, under its own plan.
"""

from __future__ import annotations

import math

import numpy as np

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.phases.trajectories import BegunTrajectory, Trajectories, is_at
from swarmctl.control.reference.landing_places import Taken, landing_place_ned_m, nearest_in_plane_m
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array, VehicleState

_SETTLE_S = 2.0  # time after a stop trajectory in which the vehicle comes to rest
_ROOM_MARGIN_M = 0.1  # the target lies beyond the required distance, because it is reached with a tolerance


class Landing:
    """Leads the agent to the start position, or to a free place near it or near where it came to rest.

    Args:
        params: tolerances.
        agent: index of this agent.
        apart_m: level distance to others at which it may land in place.
        home_apart_m: the same at its start position.
        start_ned_m: (3,) start position, the landing place unless the agent lands in place.
        trajectories: set to the ways there.
        volume: to stay in; None for none.

    Attributes:
        in_place: the agent lands where it came to rest instead of at the start position.
    """

    def __init__(
        self,
        params: StateMachineParams,
        agent: int,
        *,
        apart_m: float,
        home_apart_m: float,
        start_ned_m: Array,
        trajectories: Trajectories,
        volume: FlightVolume | None,
    ) -> None:
        self._params, self._agent, self._apart_m, self._home_apart_m = params, agent, apart_m, home_apart_m
        self._start_ned_m, self._trajectories, self._volume = start_ned_m, trajectories, volume
        self.in_place = False
        self._beside = False  # its landing place is beside the start position, which an obstacle takes

    def go_home(self, now_us: int, state: VehicleState) -> None:
        """Begin the way to the start position."""
        self.in_place = self._beside = False
        self._trajectories.go_to(self._start_ned_m, now_us, state)
        self._trajectories.keep_destination()

    def stop_in_place(self, now_us: int, state: VehicleState, *, at_once: bool) -> None:
        """Begin to brake, smoothly or at once, to land where the vehicle comes to rest."""
        self.in_place = True
        self._trajectories.stop(now_us, state, at_once=at_once)
        self._trajectories.keep_destination()

    def is_reached(self, inputs: PhaseInputs, state: VehicleState, *, controls: bool, paused: bool) -> bool:
        """Return whether the vehicle is at its landing place, or at rest with enough room.

        A vehicle that lands in place and lacks room is sent to a free place first, one whose landing place is over an
        obstacle to another one beside it.
        """
        begun = self._trajectories.current
        if begun is None:
            return True
        if not self.in_place:
            return not paused and self._is_home(inputs, state, begun, controls=controls)
        if _is_under_way(begun, inputs.now_us):
            return False
        if self._has_room(inputs, state, controls=controls):
            return self._is_at_rest(state)
        self._go_near(state.pos_ned_m, inputs, state)
        return False

    def is_possible_here(self, inputs: PhaseInputs, state: VehicleState, *, controls: bool) -> bool:
        """Return whether a vehicle that does not reach its landing place may land without another stop."""
        return self.in_place or (self._is_at_rest(state) and self._has_room(inputs, state, controls=controls))

    def _is_at_rest(self, state: VehicleState) -> bool:
        return is_at(state, state.pos_ned_m, math.inf, self._params.arrive_m_s)

    def _is_home(self, inputs: PhaseInputs, state: VehicleState, begun: BegunTrajectory, *, controls: bool) -> bool:
        """Return whether the vehicle is at its landing place, or send it to one that is not over an obstacle.

        It waits while another vehicle is there, whoever flies that and at whatever height, until its time is over.

        Where no place is, the way to the one with most room is flown to its end before another is looked for.
        """
        target_ned_m = begun.trajectory.to_ned_m
        if controls and inputs.obstacle_below(target_ned_m, state.pos_ned_m) is not None:
            if self._beside and _is_under_way(begun, inputs.now_us):
                return False
            self._beside = True
            self._go_near(target_ned_m, inputs, state)
            self._trajectories.keep_destination()
            return False
        if not is_at(state, target_ned_m, self._params.land_m, self._params.land_m_s):
            return False
        if self._beside or not controls:
            return self._has_room(inputs, state, controls=controls)
        return nearest_in_plane_m(state.pos_ned_m, inputs.others_ned_m()) >= self._home_apart_m

    def _go_near(self, wanted_ned_m: Array, inputs: PhaseInputs, state: VehicleState) -> None:
        """Begin the way to the free place nearest to one (3,), as far as it can be told."""
        taken = [Taken(center_ned_m=other, apart_m=self._apart_m + _ROOM_MARGIN_M) for other in inputs.others_ned_m()]
        for obstacle in inputs.obstacles(state.pos_ned_m):
            if obstacle.column or obstacle.center_ned_m[2] + obstacle.keep_out_m > wanted_ned_m[2]:
                apart_m = obstacle.keep_out_m + _ROOM_MARGIN_M
                taken.append(Taken(center_ned_m=np.array(obstacle.center_ned_m), apart_m=apart_m))
        room_ned_m = landing_place_ned_m(wanted_ned_m, taken, self._agent, self._volume)
        self._trajectories.go_to(room_ned_m, inputs.now_us, state)

    def _has_room(self, inputs: PhaseInputs, state: VehicleState, *, controls: bool) -> bool:
        """Return whether peers and obstacles leave room for a landing; true without control, which can't change it."""
        if not controls:
            return True
        apart = nearest_in_plane_m(state.pos_ned_m, inputs.others_ned_m()) >= self._apart_m
        return apart and not inputs.is_over_obstacle(state)


def _is_under_way(begun: BegunTrajectory, now_us: int) -> bool:
    return now_us - begun.began_us <= (begun.trajectory.travel_s + _SETTLE_S) * 1e6
