"""The thesis' position cascade (ch. 2): three PIDs from position errors to pitch, roll and thrust.

The attitude PIDs below it belong to the autopilot. Derivative on measurement for steps (no derivative kick),
derivative of the error for trajectories. Integrals are clamped, and wait while their own output is at its limit
(anti-windup by conditional integration). The reference's acceleration can be fed forward.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field

from swarmctl.control.controllers.kind import ControllerKind
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params, Vec3
from swarmctl.core.types import Array, Plan, PlanStatus, Reference


class PidParams(Params):
    """Sets gains (kP, kI, kD) in the thesis' signs; the defaults are its trajectory set."""

    derivative: Literal["error", "measurement"] = "error"  # what the derivative is taken of
    x: Vec3 = (-0.25, -0.001, -0.3)  # m -> rad of pitch
    y: Vec3 = (0.05, 0.0, 0.45)  # m -> rad of roll
    z: Vec3 = (-3.5, -0.001, -4.0)  # m -> m/s2 of thrust over mass
    accel_feed_forward: float = Field(0.0, ge=0, le=1.5)  # share of the reference's acceleration; thesis 0
    tilt_max_rad: float = Field(0.5, gt=0, lt=1.5)  # largest roll and pitch
    thrust_max_m_s2: float = Field(20.0, gt=9.9, le=100)  # largest thrust over mass
    integral_max: float = Field(5.0, ge=0, le=1e3)  # m s
    dt_s: float = Field(0.02, gt=0.001, le=0.5)  # time between two ticks
    path_steps: int = Field(40, ge=2, le=200)  # points of the shared path, at constant velocity


class PidController:
    """Computes virtual controls from position errors; keeps integrals and last errors between ticks."""

    def __init__(self, params: PidParams) -> None:
        self._params = params
        self._gains = np.array([params.x, params.y, params.z])  # (3 axes, 3 gains)
        self._least = np.array([-params.tilt_max_rad, -params.tilt_max_rad, -GRAVITY_M_S2])
        self._most = np.array([params.tilt_max_rad, params.tilt_max_rad, params.thrust_max_m_s2 - GRAVITY_M_S2])
        self._integral = np.zeros(3)
        self._last: Array | None = None

    @property
    def dt_us(self) -> int:
        """Return the time between plan points [us]."""
        return round(self._params.dt_s * 1e6)

    @property
    def steps(self) -> int:
        """Return the number of steps of a plan."""
        return self._params.path_steps

    @property
    def longest(self) -> int:
        """Return the number of steps of reference that a problem has to hold."""
        return self._params.path_steps

    def reset(self) -> None:
        """Forget integrals and last errors, after a handover."""
        self._integral, self._last = np.zeros(3), None

    def plan(self, problem: Problem) -> Plan:
        """Return a plan that holds the virtual controls of this tick; its path continues the own velocity."""
        p, start = self._params, problem.start
        error = problem.reference.pos_ned_m[0] - start.pos_ned_m
        watched = error if p.derivative == "error" else -start.pos_ned_m
        rate = np.zeros(3) if self._last is None else (watched - self._last) / p.dt_s
        self._last = watched
        integral = np.clip(self._integral + error * p.dt_s, -p.integral_max, p.integral_max)
        gains = self._gains
        wanted = gains[:, 0] * error + gains[:, 1] * integral + gains[:, 2] * rate + self._ahead(problem.reference)
        out = np.clip(wanted, self._least, self._most)
        winding = (wanted != out) & (np.sign(gains[:, 1] * error) == np.sign(wanted))
        self._integral = np.where(winding, self._integral, integral)
        pitch, roll, thrust = float(out[0]), float(out[1]), GRAVITY_M_S2 + float(out[2])
        virtual_control = np.array([math.sin(pitch) * math.cos(roll), -math.sin(roll), thrust])
        pos, vel = start.at_constant_velocity(p.path_steps, p.dt_s)
        return Plan(
            status=PlanStatus.OK,
            t0_us=start.t_us,
            dt_us=self.dt_us,
            pos_ned_m=pos,
            vel_ned_m_s=vel,
            virtual_control=np.tile(virtual_control, (p.path_steps, 1)),
        )

    def _ahead(self, reference: Reference) -> Array:
        """Return pitch, roll and thrust over mass (3,) for the reference's acceleration (linearised at hover)."""
        accel = (reference.vel_ned_m_s[1] - reference.vel_ned_m_s[0]) / self._params.dt_s
        north, east, down = (self._params.accel_feed_forward * float(a) for a in accel)
        return np.array([-north / GRAVITY_M_S2, east / GRAVITY_M_S2, -down])


PID = ControllerKind(
    name="pid",
    section="pid",
    params=PidParams,
    make=lambda params, _: PidController(params),
    plans=False,
    keeps_clear=False,
)
