"""Parameters of the MPCs: horizons, weights and bounds, and the axes and horizons of their problems that follow."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

from pydantic import ConfigDict, Field

from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.condensed_qp.axes import Axis, Horizon, Terminal
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params


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
    control_z: int = Field(3, ge=1, le=50)  # free input changes, in steps; at most horizon_z
    horizon_z: int = Field(40, ge=2, le=200)  # predicted steps
    control_xy: int = Field(6, ge=1, le=50)  # and of dmpc3, for all three axes; at most horizon_xy
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
