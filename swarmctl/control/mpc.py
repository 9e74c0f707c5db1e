"""The thesis' MPC for one vehicle of a swarm: z first, then x-y together with what must be kept clear of (ch. 3, 4).

z'' = g - (f/m) c, with c = cos(phi) cos(theta) frozen at the current attitude (3.11); x'' = -(f/m) u_x and
y'' = -(f/m) u_y with the thrust that the z problem has just chosen (3.18), (3.24). Thrust over mass is the z input, so
the thesis' newtons for its 1 kg are our m/s2. z knows nothing of collisions. The disturbance estimate is a constant
drift of each axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from swarmctl.control.condensed import AxesSolution, Axis, CondensedMpc, Horizon, Penalties
from swarmctl.control.qp import QpParams
from swarmctl.control.separation import KeepOut, SeparationParams, certify, half_spaces_xy
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params
from swarmctl.core.types import Array, Plan, PlanStatus, Reference

RESIDUAL_LIMIT_M = 0.05  # a solution that misses a constraint by more is none; the certificate judges the rest


class AxisWeights(Params):
    """Quadratic weights of one axis."""

    q_pos: float = Field(ge=0, le=1e4)
    q_vel: float = Field(ge=0, le=1e4)
    r: float = Field(gt=0, le=1e4)


class MpcParams(Params):
    """Horizons, weights and bounds; the defaults are the thesis' swarm flight (its section 4.3)."""

    dt_s: float = Field(0.02, gt=0.001, le=0.5)
    discretisation: Literal["zoh", "euler"] = "zoh"  # euler is the thesis' (3.6)
    control_z: int = Field(3, ge=1, le=50)
    horizon_z: int = Field(40, ge=2, le=200)
    control_xy: int = Field(6, ge=1, le=50)
    horizon_xy: int = Field(40, ge=2, le=200)
    z: AxisWeights = AxisWeights(q_pos=2.0, q_vel=0.05, r=0.01)
    x: AxisWeights = AxisWeights(q_pos=1.5, q_vel=0.5, r=0.01)
    y: AxisWeights = AxisWeights(q_pos=1.5, q_vel=0.5, r=0.01)
    thrust_min_m_s2: float = Field(0.0, ge=-20, le=9)  # thesis -20 (a rotor can't pull)
    thrust_max_m_s2: float = Field(20.0, gt=9.9, le=100)
    dthrust_max_m_s2: float = Field(5.0, gt=0, le=100)  # per step
    u_max: float = Field(0.2, gt=0, lt=1)  # sine of the tilt, each axis
    du_max: float = Field(0.05, gt=0, lt=1)  # per step
    terminal_z: Literal["none", "position", "position_velocity"] = "position_velocity"
    terminal_xy: Literal["none", "position"] = "none"
    qp: QpParams = QpParams()


@dataclass(frozen=True, slots=True)
class Start:
    """Where a plan begins: the predicted own state when its first setpoint acts."""

    t_us: int
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    cos_tilt: float  # cos(phi) cos(theta) now
    virtual: Array  # (3,) u_x, u_y, thrust over mass now held


class SwarmMpc:
    """z-MPC, then x-y MPC with half-spaces, then a certificate over true distances."""

    def __init__(self, params: MpcParams, separation: SeparationParams, own_tie: int, slots: int) -> None:
        self._params, self._separation, self._tie, self._slots = params, separation, own_tie, slots
        self._dt_us = round(params.dt_s * 1e6)
        euler = params.discretisation == "euler"
        z_terminal = params.terminal_z
        self._z = CondensedMpc(
            (
                Axis(
                    params.z.q_pos,
                    params.z.q_vel,
                    params.z.r,
                    params.thrust_min_m_s2,
                    params.thrust_max_m_s2,
                    params.dthrust_max_m_s2,
                    z_terminal != "none",
                    z_terminal == "position_velocity",
                ),
            ),
            Horizon(params.control_z, params.horizon_z, params.dt_s, euler),
            0,
            1.0,
            Penalties(),
            params.qp,
        )
        self._xy = CondensedMpc(
            tuple(
                Axis(w.q_pos, w.q_vel, w.r, -params.u_max, params.u_max, params.du_max, terminal, False)
                for w in (params.x, params.y)
                for terminal in (params.terminal_xy == "position",)
            ),
            Horizon(params.control_xy, params.horizon_xy, params.dt_s, euler),
            slots,
            separation.relax_01,
            Penalties(),
            params.qp,
        )

    @property
    def steps(self) -> int:
        """Prediction steps of a plan."""
        return self._params.horizon_xy

    @property
    def longest(self) -> int:
        """Reference steps needed."""
        return max(self._params.horizon_xy, self._params.horizon_z)

    @property
    def dt_us(self) -> int:
        return self._dt_us

    def plan(
        self,
        start: Start,
        reference: Reference,
        disturbance_ned_m_s2: Array,
        keep_outs: Sequence[KeepOut],
        guess_ned_m: Array | None,
    ) -> Plan:
        """One step of distributed MPC. Never raises for an infeasible problem; the status says what may be flown.

        Args:
            start: predicted own state.
            reference: at least `longest` + 1 points from `start.t_us` on.
            disturbance_ned_m_s2: (3,) taken as constant.
            keep_outs: peers and obstacles, aligned with the plan's times.
            guess_ned_m: (steps+1, 3) own previous prediction at the new times; None for constant velocity.
        """
        up = self._solve_z(start, reference, float(disturbance_ned_m_s2[2]))
        thrust = float(up.u[0, 0])
        guess = self._guess(start, up.pos_m[:, 0], guess_ned_m)
        nearest = sorted(keep_outs, key=lambda k: float(np.min(np.sum((guess - k.pos_ned_m) ** 2, axis=1))))
        spaces = half_spaces_xy(
            nearest[: self._slots],
            guess,
            reference.pos_ned_m[self.steps, :2],
            start.vel_ned_m_s[:2],
            self._params.dt_s,
            self._tie,
            self._separation,
        )
        across = self._xy.solve(
            start.pos_ned_m[:2],
            start.vel_ned_m_s[:2],
            start.virtual[:2],
            np.array([-thrust, -thrust]),
            disturbance_ned_m_s2[:2],
            reference.pos_ned_m[1 : self.steps + 1, :2],
            reference.vel_ned_m_s[1 : self.steps + 1, :2],
            spaces,
        )
        return self._assemble(start, up, across, keep_outs)

    def _solve_z(self, start: Start, reference: Reference, disturbance_m_s2: float) -> AxesSolution:
        steps = self._params.horizon_z
        return self._z.solve(
            start.pos_ned_m[2:],
            start.vel_ned_m_s[2:],
            start.virtual[2:],
            np.array([-start.cos_tilt]),
            np.array([GRAVITY_M_S2 + disturbance_m_s2]),
            reference.pos_ned_m[1 : steps + 1, 2:],
            reference.vel_ned_m_s[1 : steps + 1, 2:],
        )

    def _guess(self, start: Start, z_m: Array, previous_ned_m: Array | None) -> Array:
        steps = self.steps
        if previous_ned_m is None:
            t_s = np.arange(steps + 1)[:, None] * self._params.dt_s
            guess = start.pos_ned_m + t_s * start.vel_ned_m_s
        else:
            guess = previous_ned_m.copy()
        count = min(steps, len(z_m))
        guess[1 : count + 1, 2] = z_m[:count]
        return guess

    def _assemble(self, start: Start, up: AxesSolution, across: AxesSolution, keep_outs: Sequence[KeepOut]) -> Plan:
        steps = self.steps
        pos, vel = np.empty((steps + 1, 3)), np.empty((steps + 1, 3))
        virtual = np.empty((steps, 3))
        pos[0], vel[0] = start.pos_ned_m, start.vel_ned_m_s
        pos[1:, :2], vel[1:, :2], virtual[:, :2] = across.pos_m, across.vel_m_s, across.u
        count = min(steps, len(up.pos_m))
        pos[1 : count + 1, 2], vel[1 : count + 1, 2], virtual[:count, 2] = (
            up.pos_m[:count, 0],
            up.vel_m_s[:count, 0],
            up.u[:count, 0],
        )
        pos[count + 1 :, 2], vel[count + 1 :, 2], virtual[count:, 2] = up.pos_m[-1, 0], 0.0, up.u[-1, 0]
        residual_m = max(up.residual_m, across.residual_m)
        status = PlanStatus.OK
        if not (up.solved and across.solved):
            status = PlanStatus.SOLVER_FAILED
        elif residual_m > RESIDUAL_LIMIT_M:
            status = PlanStatus.RESIDUAL
        elif certify(pos, keep_outs, self._params.control_xy) < 0.0:
            status = PlanStatus.NOT_CERTIFIED
        return Plan(
            status,
            start.t_us,
            self._dt_us,
            pos,
            vel,
            virtual,
            0,
            up.iterations + across.iterations,
            across.slack_m,
            residual_m,
            max(up.terminal_gap_m, across.terminal_gap_m),
        )
