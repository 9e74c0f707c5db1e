"""The way into the air: what must be met before a vehicle is armed, and the climb that its autopilot flies. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence, Set

import numpy as np

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, FlightMode, Landed, Phase, VehicleState

SPIN_UP_US = 6_000_000  # ArduCopter's rotors spin up for over 3 s, during which it refuses a second TAKEOFF
_MOST_NAMED = 4  # agents in one line
LEAST_CLIMB_M = 0.5  # of a configuration
_REFUSED_CLIMB_M = 0.25  # heights are estimates: a start at the least height must not be refused for a few centimetres
_STOPPED_US = 3_000_000  # in hold below its height; a PX4 that has climbed goes on rising for a second in it
_NEAR_M = 1.0  # PX4 ends a climb 0.8 m below its height (NAV_MC_ALT_RAD), and estimates drift
_CLIMBS_M_S = 1.0  # of autopilots, at least
_TAKES_CONTROL_S = 3.0  # from the end of the climb, or of a hold in it, to the first setpoint
_HOVER_LEARNING_US = 1_000_000  # hover flown by the autopilot itself, during which its hover thrust is learned


def unmet_start_condition(inputs: PhaseInputs, state: VehicleState, peers: Set[int], top_ned_m: Array) -> str:
    """Return the first condition for arming that is not met, or "".

    Args:
        inputs, state: of this tick.
        peers: agents to wait for.
        top_ned_m: (3,) where its climb would end.
    """
    if state.landed not in (Landed.ON_GROUND, Landed.IN_AIR):
        return "the autopilot to tell whether it has landed"
    if not inputs.armable:
        return f"the autopilot to be ready to arm (it is in {state.mode.name})"
    if unmet := inputs.unsettled or inputs.too_slow:
        return unmet
    there = {agent: peer for agent, peer in inputs.peers().items() if peer.phase >= Phase.STANDBY and peer.alive}
    if absent := peers - there.keys():
        return f"{names_of(absent)} to stand by"
    if slow := {agent for agent, peer in there.items() if peer.phase is Phase.STANDBY and not peer.keeps_up}:
        return f"the processor of {names_of(slow)} to keep up"
    if state.landed is Landed.ON_GROUND and (obstacle := _obstacle_over(inputs, state, top_ned_m)):
        return obstacle
    return "the autopilot's answers" if inputs.busy else ""


def is_beyond_reach(pos_ned_m: Sequence[float], start_ned_m: Sequence[float], params: StateMachineParams) -> bool:
    """Return whether a vehicle at (3,) can't be at its start (3,) in time.

    It is most often the shared origin that is somewhere else: an autopilot would climb to that height all the same.
    """
    away_m, climb_m = math.dist(pos_ned_m[:2], start_ned_m[:2]), max(0.0, pos_ned_m[2] - start_ned_m[2])
    return away_m / params.speed_m_s + climb_m / _CLIMBS_M_S > params.start_timeout_s


def unmet_climb_condition(inputs: PhaseInputs, state: VehicleState, top_ned_m: Array) -> str:
    """Return what has come since STANDBY into the way of a climb to (3,), or into that of its rest, or "".

    The autopilot that climbs avoids nobody, and an order or a lost link may have delayed it.
    """
    if state.landed is Landed.ON_GROUND:
        return inputs.unsettled or _obstacle_over(inputs, state, top_ned_m)
    above = (o for o in inputs.obstacles(top_ned_m) if o.is_above(state.pos_ned_m, float(top_ned_m[2])))
    return _to_go(next(above, None), top_ned_m)


def obstacle_coming(inputs: PhaseInputs, state: VehicleState, top_ned_m: Array) -> Obstacle | None:
    """Return an obstacle that moves into the way of a climb to (3,), until the agent has control; None without one."""
    top_z_m = float(top_ned_m[2])
    spins_up_s = 1e-6 * SPIN_UP_US if state.landed is Landed.ON_GROUND else 0.0
    climbs_s = max(0.0, float(state.pos_ned_m[2]) - top_z_m) / _CLIMBS_M_S
    return inputs.crossing_obstacle(state.pos_ned_m, top_z_m, spins_up_s + climbs_s + _TAKES_CONTROL_S)


def _obstacle_over(inputs: PhaseInputs, state: VehicleState, top_ned_m: Array) -> str:
    """Return which obstacle has to go before the autopilot, which avoids none, can climb to (3,), or ""."""
    if above := _to_go(inputs.obstacle_below(top_ned_m, top_ned_m), top_ned_m):
        return above
    coming = obstacle_coming(inputs, state, top_ned_m)
    return "" if coming is None else f"an obstacle that moves to be past its climb (keep_out_m = {coming.keep_out_m:g})"


def _to_go(obstacle: Obstacle | None, top_ned_m: Array) -> str:
    if obstacle is None:
        return ""
    apart_m = obstacle.descent_distance_m(top_ned_m)
    return f"an obstacle {apart_m:.2f} m beside its climb to go (keep_out_m = {obstacle.keep_out_m:g})"


def names_of(agents: Iterable[int]) -> str:
    """Return agents in words, a few by name."""
    named = [f"agent-{agent}" for agent in sorted(agents)]
    return ", ".join(named[:_MOST_NAMED]) + (f" and {len(named) - _MOST_NAMED} more" if named[_MOST_NAMED:] else "")


class Climb:
    """Knows how high the autopilot has to climb from the ground, and when it has.

    Args:
        start_ned_m: (3,) start position; the climb ends at its height.

    Attributes:
        ground_z_m: down coordinate of the place that the vehicle stood on, 0 before it was armed.
        cut_short: a hold interrupted the climb below its height.
        abandoned: it was ended above an obstacle: the vehicle is to land beside that.
        waits: the autopilot was asked to hold, because an obstacle has come into the way.
        was_ours: since it was armed, the vehicle has been in a mode that follows from our own requests.
    """

    def __init__(self, start_ned_m: Array) -> None:
        self._start_z_m = float(start_ned_m[2])
        self.ground_z_m = 0.0
        self.cut_short = self.abandoned = self.waits = self.was_ours = False
        self._hovering_us: int | None = None  # since when the autopilot hovers
        self._stopped_us: int | None = None  # since when it holds below its height

    @property
    def height_m(self) -> float:
        """Return the height to climb to, above the ground."""
        return self.ground_z_m - self._start_z_m

    @property
    def too_low(self) -> str:
        """Return why the start can't be climbed to from where the vehicle stands, or ""."""
        if self.height_m >= _REFUSED_CLIMB_M:
            return ""
        found = f"its start is {self.height_m:.2f} m above the ground it stands on, less than {LEAST_CLIMB_M} m"
        return f"{found}: raise the start (NED, down is positive) or correct swarm.origin_alt_m"

    def begin(self, state: VehicleState) -> None:
        """Note where the vehicle is before it is armed."""
        self.ground_z_m = float(state.pos_ned_m[2])

    def update(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Advance by one tick of the take-off; return whether the climb is over: the vehicle hovers, at its height."""
        climbed_m = self.ground_z_m - float(state.pos_ned_m[2])
        settled = abs(float(state.vel_ned_m_s[2])) < 0.3 and (abs(climbed_m - self.height_m) < 0.4 or self.cut_short)
        hovers = state.mode in (FlightMode.HOLD, inputs.arm_in) and state.landed is Landed.IN_AIR and settled
        self._hovering_us = (self._hovering_us or inputs.now_us) if hovers else None
        learned = inputs.arm_in is None or inputs.now_us - (self._hovering_us or inputs.now_us) >= _HOVER_LEARNING_US
        return hovers and learned

    def is_stopped(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether the vehicle has been in hold for a while without being at its height."""
        holds = state.mode is FlightMode.HOLD and state.landed is Landed.IN_AIR and self._hovering_us is None
        self._stopped_us = (self._stopped_us or inputs.now_us) if holds else None
        return self._stopped_us is not None and inputs.now_us - self._stopped_us > _STOPPED_US

    def ends_near(self, state: VehicleState) -> bool:
        """Return whether a vehicle in hold is as near to its height as autopilots take for enough."""
        return abs(self.ground_z_m - float(state.pos_ned_m[2]) - self.height_m) < _NEAR_M

    def cut(self) -> None:
        """Note that the climb ends where the vehicle is now; the agent flies the rest of it."""
        self.cut_short, self.waits, self._stopped_us = True, False, None

    def rest_ned_m(self, state: VehicleState) -> Array:
        """Return the end (3,) of the rest of a climb that was cut short, straight above or below the vehicle."""
        return np.array([*state.pos_ned_m[:2], self._start_z_m])

    def finish(self) -> None:
        """Note that the rest of the climb has been flown."""
        self.cut_short = False
