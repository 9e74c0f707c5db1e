"""The motion that virtual controls give a vehicle by its model, and the virtual controls of a wanted acceleration."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

_LEAST_THRUST_M_S2 = 1e-3  # upwards, so that a direction of thrust exists


class ModelledVehicle:
    """Moves step by step from the start of a plan: attitude lag, drag, disturbance and bounds as the model has them.

    Attributes:
        pos_ned_m: (3,) present position.
        vel_ned_m_s: (3,) present velocity.
    """

    def __init__(self, start: Start, vehicle: VehicleModelParams, disturbance_ned_m_s2: Array) -> None:
        self.pos_ned_m, self.vel_ned_m_s = start.pos_ned_m, start.vel_ned_m_s
        (self._tilt_x, self._tilt_y), (self._rate_x, self._rate_y) = start.tilt.tolist(), start.tilt_rate_1_s.tolist()
        self._lag, self._drag_1_s, self._u_max = vehicle.lag(), vehicle.drag_1_s, vehicle.u_max()
        self._thrust_m_s2 = vehicle.thrust_range_m_s2()
        self._disturbance_ned_m_s2 = disturbance_ned_m_s2

    def control_for(self, accel_ned_m_s2: Array) -> Array:
        """Return the virtual controls (3,) of a wanted acceleration (3,), against drag and disturbance, in bounds."""
        resisted = accel_ned_m_s2 - self._disturbance_ned_m_s2 + self._drag_1_s * self.vel_ned_m_s
        north, east, down = resisted.tolist()
        up = max(GRAVITY_M_S2 - down, self._thrust_m_s2[0], _LEAST_THRUST_M_S2)
        whole = math.sqrt(north * north + east * east + up * up)
        ux, uy = self._shortened(-north / whole, -east / whole)
        return self.bounded(np.array([ux, uy, up / math.sqrt(1.0 - ux * ux - uy * uy)]))

    def bounded(self, virtual_control: Array) -> Array:
        """Return virtual controls (3,) as the vehicle is sent them: tilt shortened, thrust limited."""
        ux, uy, thrust = virtual_control.tolist()
        least, most = self._thrust_m_s2
        return np.array([*self._shortened(ux, uy), min(most, max(least, thrust))])

    def step(self, virtual_control: Array, dt_s: float) -> None:
        """Move by one step of held virtual controls (3,)."""
        ux, uy, thrust = self.bounded(virtual_control).tolist()
        if self._lag is not None:
            self._tilt_x, self._rate_x, x_s = self._lag.advance(self._tilt_x, self._rate_x, ux, dt_s)
            self._tilt_y, self._rate_y, y_s = self._lag.advance(self._tilt_y, self._rate_y, uy, dt_s)
            ux, uy = x_s / dt_s, y_s / dt_s
        down = math.sqrt(max(0.0, 1.0 - ux * ux - uy * uy))
        accel = np.array([-thrust * ux, -thrust * uy, GRAVITY_M_S2 - thrust * down])
        accel += self._disturbance_ned_m_s2 - self._drag_1_s * self.vel_ned_m_s
        self.pos_ned_m = self.pos_ned_m + dt_s * self.vel_ned_m_s + 0.5 * dt_s * dt_s * accel
        self.vel_ned_m_s = self.vel_ned_m_s + dt_s * accel

    def _shortened(self, ux: float, uy: float) -> tuple[float, float]:
        """Return the horizontal part of the body's down axis within the largest tilt."""
        share = min(1.0, self._u_max / max(1e-9, math.hypot(ux, uy)))
        return ux * share, uy * share
