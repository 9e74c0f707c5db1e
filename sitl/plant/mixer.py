"""Control allocation of all vehicles: wrench to rotor forces within the rotors' limits."""

from __future__ import annotations

import numpy as np

from sitl.plant.airframes import Preset
from swarmctl.core.types import Array

YAW_SIGN = np.array([-1.0, 1.0, -1.0, 1.0])  # of each rotor's yaw torque


class Mixer:
    """Maps wrench to rotor forces and back: the A matrix of thesis (1.13)-(1.16), plus configuration.

    Every rotor stays within [0, rotor_force_max_n]. Roll, pitch and thrust are clipped rotor by rotor; yaw gets the
    remaining range, because its lever is 12 times shorter and a yaw step would otherwise cost all attitude control.
    """

    def __init__(self, preset: Preset, vehicles: int) -> None:
        arm_m, yaw_m, self._max_n = preset.arm_m, preset.yaw_per_force_m, preset.rotor_force_max_n
        half = 0.5 / arm_m
        self._from_wrench = np.array([[0.25, 0, -half], [0.25, -half, 0], [0.25, 0, half], [0.25, half, 0]])
        self._yaw_scale = 0.25 / yaw_m
        self.wrench_of_forces = np.array(  # (4, 4): f_t, tau_x, tau_y, tau_z of the four rotor forces
            [[1, 1, 1, 1], [0, -arm_m, 0, arm_m], [-arm_m, 0, arm_m, 0], yaw_m * YAW_SIGN]
        )
        self._forces = np.zeros((4, vehicles))
        self._one_side, self._other_side = self._forces[:2], self._forces[2:]  # (2, N), opposite each other
        self._even, self._odd = self._forces[::2], self._forces[1::2]  # (2, N), the two pairs of opposite rotors
        self._give = np.zeros((2, vehicles))  # force that each of a pair can lose
        self._take = np.zeros((2, vehicles))  # and gain
        self._taken_by_other = self._take[::-1]
        self._up, self._down = self._give  # (N,) limits of what yaw moves from even to odd rotors, and back
        self._yaw = np.zeros(vehicles)

    def allocate(self, wrench: Array) -> Array:
        """Return rotor forces (4, N) [N] for a wrench (4, N): f_t [N], tau_x, tau_y, tau_z [N m]; reuses its buffer."""
        forces, give, take, yaw = self._forces, self._give, self._take, self._yaw
        np.matmul(self._from_wrench, wrench[:3], out=forces)
        np.maximum(forces, 0.0, out=forces)
        np.minimum(forces, self._max_n, out=forces)
        np.minimum(self._one_side, self._other_side, out=give)
        np.maximum(self._one_side, self._other_side, out=take)
        np.subtract(self._max_n, take, out=take)
        np.minimum(give, self._taken_by_other, out=give)  # what one pair loses, the other gains
        np.multiply(wrench[3], self._yaw_scale, out=yaw)
        np.minimum(yaw, self._up, out=yaw)
        np.negative(self._down, out=self._down)
        np.maximum(yaw, self._down, out=yaw)
        self._even -= yaw
        self._odd += yaw
        return forces
