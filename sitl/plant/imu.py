"""Accelerometers of all vehicles: specific force from the change of true velocity between two samples."""

from __future__ import annotations

import numpy as np

from sitl.plant.vehicle import Plant
from swarmctl.core.frames import GRAVITY_M_S2


class Imu:
    """Mean specific force, body axes FRD, over one autopilot tick; it contains every force."""

    def __init__(self, plant: Plant, period_s: float) -> None:
        count = plant.state.shape[1]
        self.force_frd_m_s2 = np.zeros((3, count))
        self.force_frd_m_s2[2] = -GRAVITY_M_S2
        self._plant = plant
        self._per_s = 1.0 / period_s
        self._vel_ned_m_s = plant.vel_ned_m_s.copy()
        self._force_ned = np.zeros((3, count))

    def sample(self) -> None:
        """Take a sample; called once every period."""
        plant, force = self._plant, self._force_ned
        np.subtract(plant.vel_ned_m_s, self._vel_ned_m_s, out=force)
        force *= self._per_s
        force[2] -= GRAVITY_M_S2
        self._vel_ned_m_s[...] = plant.vel_ned_m_s
        rotation = plant.rotation.reshape(3, 3, -1)  # body to NED
        np.einsum("ijn,in->jn", rotation, force, out=self.force_frd_m_s2)

    def of(self, vehicle: int) -> tuple[float, float, float]:
        x, y, z = self.force_frd_m_s2[:, vehicle].tolist()
        return x, y, z
