"""The thesis' distributed MPC for one vehicle of a swarm: z first, then x-y with the distance constraints (ch. 3, 4).

z'' = g - (f/m) c, with c = cos(phi) cos(theta) frozen at the current attitude (3.11); x'' = -(f/m) u_x and
y'' = -(f/m) u_y with the thrust that the z problem has just chosen (3.18), (3.24). Thrust over mass is the z input, so
the thesis' newtons for its 1 kg are m/s2 here. The z problem has no distance constraints. The disturbance estimate is
a constant drift of each axis. Of a flight volume the z problem has floor and ceiling, the x-y problem the sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from swarmctl.control.collision.half_spaces import half_spaces
from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts, stacked
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.axes import AxesProblem, AxesSolution, Axis, Faces, HalfSpaces, Horizon, Penalties, Terminal
from swarmctl.control.mpc.condensed import CondensedMpc
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.judgement import judged
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.mpc.sized_mpc import SizedMpc
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.control.mpc.vertical_stop import VerticalStop
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params
from swarmctl.core.types import Array, Plan, PlanStatus


def _may_be_left_out(schema: dict[str, Any]) -> None:
    del schema["required"]  # the section that has the weights has the defaults


class AxisWeights(Params):
    """Sets the quadratic weights of one axis."""

    model_config = ConfigDict(json_schema_extra=_may_be_left_out)

    q_pos: float = Field(gt=0, le=1e4)  # weight of the position error
    q_vel: float = Field(ge=0, le=1e4)  # weight of the velocity error
    r: float = Field(gt=0, le=1e4)  # weight of input changes


class MpcParams(Params):
    """Sets horizons, weights and bounds; defaults are those of thesis section 4.3 except for the end and the r of z."""

    dt_s: float = Field(0.02, gt=0.001, le=0.5)  # time between two points of a plan
    discretisation: Literal["zoh", "euler"] = "zoh"  # euler is the thesis' (3.6)
    thrust_ahead: Literal["held", "planned"] = "held"  # x-y uses the thrust of now (thesis) or of the z plan
    control_z: int = Field(3, ge=1, le=50)  # free input changes, in steps
    horizon_z: int = Field(40, ge=2, le=200)  # predicted steps
    control_xy: int = Field(6, ge=1, le=50)  # and of dmpc3, for all three axes
    horizon_xy: int = Field(40, ge=2, le=200)  # predicted steps, also those of a shared path
    blocking_xy: Literal["none", "spread"] = "none"  # changes at the first steps (thesis), or over the whole horizon
    z: AxisWeights = AxisWeights(q_pos=2.0, q_vel=0.05, r=1.0)  # thesis r 0.01 leaves x-y no thrust in fast climbs
    x: AxisWeights = AxisWeights(q_pos=1.5, q_vel=0.5, r=0.01)
    y: AxisWeights = AxisWeights(q_pos=1.5, q_vel=0.5, r=0.01)
    thrust_min_m_s2: float = Field(0.0, ge=-20, le=9)  # thesis -20 (a rotor can't pull)
    thrust_max_m_s2: float = Field(20.0, gt=9.9, le=100)  # largest thrust over mass; never more than the vehicle has
    dthrust_max_m_s2: float = Field(5.0, gt=0, le=100)  # per step
    u_max: float = Field(0.2, gt=0, lt=1)  # sine of the tilt, each axis
    du_max: float = Field(0.05, gt=0, lt=1)  # per step
    proximal_xy: float = Field(10.0, ge=0, le=1e4)  # weight of what a plan among keep-outs changes of the one before
    terminal_z: Terminal = "region"  # thesis: an equality, which limit-cycles with half a tick of delay
    terminal_xy: Terminal = "none"  # the same for x-y
    qp: QpParams = QpParams()

    def accel_max_m_s2(self, vehicle: VehicleModelParams) -> float:
        """Return the largest horizontal acceleration in level flight, by tilt and thrust."""
        by_thrust = math.sqrt(max(0.0, self.most_thrust_m_s2(vehicle) ** 2 - GRAVITY_M_S2**2))
        return min(by_thrust, GRAVITY_M_S2 * math.tan(math.asin(min(self.u_max, vehicle.u_max()))))

    def most_thrust_m_s2(self, vehicle: VehicleModelParams) -> float:
        """Return the largest thrust over mass that plans use: no more than the vehicle has."""
        return min(self.thrust_max_m_s2, vehicle.thrust_range_m_s2()[1])

    def drift_m(self, gust_m_s: float, vehicle: VehicleModelParams) -> float:
        """Return how far a sudden wind blows a vehicle under this controller; see `VehicleModelParams.drift_m`."""
        at_once_m_s2 = GRAVITY_M_S2 * min(self.u_max, vehicle.u_max())
        return vehicle.drift_m(gust_m_s, at_once_m_s2=at_once_m_s2, accel_max_m_s2=self.accel_max_m_s2(vehicle))

    def vertical(self, vehicle: VehicleModelParams) -> Axis:
        """Return the z axis: its input is thrust over mass, realised at once."""
        w = self.z
        least, most, step = self.thrust_min_m_s2, self.most_thrust_m_s2(vehicle), self.dthrust_max_m_s2
        return Axis(
            q_pos=w.q_pos,
            q_vel=w.q_vel,
            r=w.r,
            u_min=least,
            u_max=most,
            du_max=step,
            u_rest=GRAVITY_M_S2,
            gain_m_s2=1.0,
            terminal=self.terminal_z,
        )

    def horizontal(self, vehicle: VehicleModelParams) -> tuple[Axis, Axis]:
        """Return the x and y axes: their inputs are u_x and u_y, which the attitude follows."""
        return self._lateral(self.x, vehicle), self._lateral(self.y, vehicle)

    def _lateral(self, w: AxisWeights, vehicle: VehicleModelParams) -> Axis:
        u, du = min(self.u_max, vehicle.u_max()), self.du_max
        return Axis(
            q_pos=w.q_pos,
            q_vel=w.q_vel,
            r=w.r,
            u_min=-u,
            u_max=u,
            du_max=du,
            u_rest=0.0,
            gain_m_s2=GRAVITY_M_S2,
            terminal=self.terminal_xy,
            proximal=self.proximal_xy,
            lag=vehicle.lag(),
        )

    def horizon_of_z(self, vehicle: VehicleModelParams) -> Horizon:
        """Return the horizon of the z problem, under the vehicle's drag."""
        return self._horizon(self.control_z, self.horizon_z, vehicle)

    def horizon_of_xy(self, vehicle: VehicleModelParams) -> Horizon:
        """Return the horizon of the x-y problem, and of all three axes in one, under the vehicle's drag."""
        return replace(self._horizon(self.control_xy, self.horizon_xy, vehicle), spread=self.blocking_xy == "spread")

    def _horizon(self, control: int, prediction: int, vehicle: VehicleModelParams) -> Horizon:
        return Horizon(
            control=control,
            prediction=prediction,
            dt_s=self.dt_s,
            euler=self.discretisation == "euler",
            drag_1_s=vehicle.drag_1_s,
        )


class SwarmMpc:
    """Plans with the z-MPC, then the x-y MPC with half-spaces, and certifies the result over true distances."""

    def __init__(self, params: MpcParams, setup: ControllerSetup) -> None:
        self._params, self._setup, vehicle = params, setup, setup.vehicle
        self.dt_us = round(params.dt_s * 1e6)
        self.steps = params.horizon_xy
        self.longest = max(params.horizon_xy, params.horizon_z)  # reference steps needed
        self._z = CondensedMpc(
            (params.vertical(vehicle),),
            params.horizon_of_z(vehicle),
            0,
            1.0,
            penalties=Penalties(),
            qp=params.qp,
            stopwatch_ns=setup.stopwatch_ns,
            faces=faces_along(setup.volume, slice(2, 3)),
        )

        def across(room: int) -> CondensedMpc:
            return CondensedMpc(
                params.horizontal(vehicle),
                params.horizon_of_xy(vehicle),
                room,
                setup.separation.relax_01,
                penalties=Penalties(),
                qp=params.qp,
                stopwatch_ns=setup.stopwatch_ns,
                faces=faces_along(setup.volume, slice(0, 2)),
            )

        self._xy = SizedMpc(across, setup.max_keep_outs)
        self._xy_alone = across(0)  # without keep-outs the problem is small and solved exactly
        self._newest: Array | None = None  # (2, Hc) increments of the newest plan
        self._before: Array | None = None  # of the one of the tick before
        self._first_row = self._xy.prediction.first_row()
        following = np.arange(self.steps)
        self._thrust_of = following if params.thrust_ahead == "planned" else 0 * following  # (steps,) of the z plan
        brake_m_s2 = setup.separation.brake_m_s2 if setup.volume is None else setup.volume.params.brake_z_m_s2
        self._stop = VerticalStop(params.vertical(vehicle), params.horizon_of_z(vehicle), brake_m_s2)

    def plan(self, problem: Problem) -> Plan:
        """Solve one step of distributed MPC. Infeasibility is a status, never an exception."""
        self._before = self._newest
        up = self._solve_z(problem)
        guess = first_guess(problem, self._params.dt_s, self.steps)
        guess[1:, 2] = up.pos_m[: self.steps, 0]
        near = partial(
            near_half_spaces,
            problem=problem,
            guess_ned_m=guess,
            axes=2,
            max_keep_outs=self._setup.max_keep_outs,
            dt_s=self._params.dt_s,
            own_priority_id=self._setup.agent,
        )

        return planned(near, partial(self._plan, problem, up), self._setup.separation, self._setup.stopwatch_ns)

    def reset(self) -> None:
        """Forget the newest plan; solvers keep their warm starts."""
        self._newest = None

    def _plan(self, problem: Problem, up: AxesSolution, spaces: HalfSpaces | None, spaces_us: float) -> Plan:
        start, steps = problem.start, self.steps
        asked = AxesProblem(
            pos_m=start.pos_ned_m[:2],
            vel_m_s=start.vel_ned_m_s[:2],
            u_prev=start.virtual_control[:2],
            gain_m_s2=self._gain_m_s2(up),
            drift_m_s2=problem.disturbance_ned_m_s2[:2],
            ref_pos_m=problem.reference.pos_ned_m[1 : steps + 1, :2],
            ref_vel_m_s=problem.reference.vel_ned_m_s[1 : steps + 1, :2],
            realised=start.tilt,
            realised_1_s=start.tilt_rate_1_s,
            before=None if spaces is None else self._before,
        )
        across = (self._xy_alone if spaces is None else self._xy).solve(asked, spaces)
        self._newest = across.increments if across.solved else None
        pos, vel, virtual_control = np.empty((steps + 1, 3)), np.zeros((steps + 1, 3)), np.empty((steps, 3))
        pos[0], vel[0] = start.pos_ned_m, start.vel_ned_m_s
        pos[1:, :2], vel[1:, :2], virtual_control[:, :2] = across.pos_m, across.vel_m_s, across.u
        pos[1:, 2:], vel[1:, 2:], virtual_control[:, 2:] = up.pos_m[:steps], up.vel_m_s[:steps], up.u[:steps]
        return judged(
            problem,
            pos,
            vel,
            virtual_control,
            solutions=(up, across),
            from_step=self._first_row,
            dt_us=self.dt_us,
            spaces_us=spaces_us,
            stopwatch_ns=self._setup.stopwatch_ns,
            volume=self._setup.volume,
        )

    def _solve_z(self, problem: Problem) -> AxesSolution:
        """Return the z plan, of at least as many steps as the x-y plan has."""
        steps, start, reference = self._params.horizon_z, problem.start, problem.reference
        asked = AxesProblem(
            pos_m=start.pos_ned_m[2:],
            vel_m_s=start.vel_ned_m_s[2:],
            u_prev=start.virtual_control[2:],
            gain_m_s2=np.full((steps, 1), -start.cos_tilt),
            drift_m_s2=GRAVITY_M_S2 + problem.disturbance_ned_m_s2[2:],
            ref_pos_m=reference.pos_ned_m[1 : steps + 1, 2:],
            ref_vel_m_s=reference.vel_ned_m_s[1 : steps + 1, 2:],
        )
        up = self._z.solve(asked)
        return up if steps >= self.steps else self._stop.behind(up, asked, self.steps - steps)

    def _gain_m_s2(self, up: AxesSolution) -> Array:
        """Return accelerations (steps, 2) of unit inputs of x and y, which thrust over mass makes."""
        return -up.u.take(self._thrust_of, axis=0).repeat(2, axis=1)


def faces_along(volume: FlightVolume | None, axes: slice) -> Faces | None:
    """Return those faces of a volume that limit positions along `axes` of NED, as plans keep them; None without any."""
    if volume is None:
        return None
    normals = volume.normals_ned[:, axes]
    limits = normals.any(axis=1)
    return Faces(normals=normals[limits], offsets_m=volume.planned_m[limits], brakes_m_s2=volume.brakes_m_s2[limits])


def first_guess(problem: Problem, dt_s: float, steps: int) -> Array:
    """Return positions (steps+1, 3) to linearise around: the previous prediction, or constant velocity."""
    if problem.guess_ned_m is not None:
        return problem.guess_ned_m.copy()
    return problem.start.at_constant_velocity(steps, dt_s)[0]


def closest_keep_outs(keep_outs: Sequence[KeepOut], guess_ned_m: Array, max_keep_outs: int) -> KeepOuts:
    """Return the `max_keep_outs` keep-outs that the guess (steps+1, 3) comes closest to."""
    known = stacked(keep_outs)
    if len(known) < 2:
        return known
    apart = known.apart(guess_ned_m)
    closest_m = np.sqrt(np.minimum.reduce(np.add.reduce(apart * apart, axis=2), axis=1)).tolist()
    gaps_m = [closest - k.radius_m for closest, k in zip(closest_m, known, strict=True)]
    order = sorted(range(len(known)), key=gaps_m.__getitem__)[:max_keep_outs]
    return KeepOuts([known[i] for i in order], known.pos_ned_m.take(order, axis=0))


def near_half_spaces(
    params: SeparationParams,
    *,
    problem: Problem,
    guess_ned_m: Array,
    axes: int,
    max_keep_outs: int,
    dt_s: float,
    own_priority_id: int,
) -> HalfSpaces | None:
    """Return half-spaces of the closest keep-outs around the guess (steps+1, 3), in the first `axes` axes."""
    steps, near = len(guess_ned_m) - 1, closest_keep_outs(problem.keep_outs, guess_ned_m, max_keep_outs)
    goal, vel = problem.reference.pos_ned_m[steps, :axes], problem.start.vel_ned_m_s[:axes]
    return half_spaces(near, guess_ned_m, goal, vel, dt_s=dt_s, own_priority_id=own_priority_id, params=params)


def planned(
    spaces_of: Callable[[SeparationParams], HalfSpaces | None],
    plan: Callable[[HalfSpaces | None, float], Plan],
    separation: SeparationParams,
    stopwatch_ns: Callable[[], int],
) -> Plan:
    """Plan within the half-spaces near the guess and, until a plan is not refused, within others.

    Returns the first plan that may be flown, else the last one solved.

    Args:
        spaces_of: returns half-spaces for given parameters.
        plan: makes a plan within half-spaces, given the time [us] that they took.
        separation: parameters of the first plan; those of the next ones are `_relaxed`.
        stopwatch_ns: see `CondensedMpc`.
    """
    began_ns = stopwatch_ns()
    spaces = spaces_of(separation)
    best = plan(spaces, (stopwatch_ns() - began_ns) * 1e-3)
    for relaxed in _relaxed(separation):
        if spaces is None or best.status is not PlanStatus.NOT_CERTIFIED:
            return best
        began_ns, before, spaces = stopwatch_ns(), spaces, spaces_of(separation.model_copy(update=relaxed))
        if spaces is not None and not _are_equal(spaces, before):
            found = plan(spaces, (stopwatch_ns() - began_ns) * 1e-3)
            best = found if found.status in (PlanStatus.OK, PlanStatus.NOT_CERTIFIED) else best
    return best


def _relaxed(separation: SeparationParams) -> tuple[dict[str, float], ...]:
    """Return what differs in parameters of half-spaces for a plan that comes closer than is ever flown.

    - Without the gate: a plan may move far away from a guess that stands still, while half-spaces far from the guess
      are left out. It then runs into peers that are there by the time it arrives, as does the next from that guess.
    - With the harder braking that peers expect beyond the horizon: room to stop has much slack where peers are on
      several sides, and one slack for each of them lets a plan come too close within the horizon as well. Agents that
      always fly with less room to stop lack it when a peer drops out.
    """
    return {"gate_m": math.inf}, {"gate_m": math.inf, "stop_m_s2": separation.brake_m_s2}


def _are_equal(one: HalfSpaces, other: HalfSpaces) -> bool:
    return np.array_equal(one.offset_m, other.offset_m) and np.array_equal(one.stop_s, other.stop_s)
