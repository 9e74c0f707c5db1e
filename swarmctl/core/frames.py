"""Rotations between body FRD and world NED. Quaternions are (w, x, y, z) and rotate body vectors into NED.

All conversions of the project are here; MAVLink uses the same conventions, so its codec rotates nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmctl.core.types import Array

GRAVITY_M_S2 = 9.81
GRAVITY_NED_M_S2 = np.array([0.0, 0.0, GRAVITY_M_S2])
GRAVITY_NED_M_S2.flags.writeable = False


def quat_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return the quaternion (4,) wxyz, body to NED, of ZYX Euler angles [rad]."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def euler_from_quat(q_nb: Array) -> tuple[float, float, float]:
    """Return ZYX Euler angles (roll, pitch, yaw) [rad] of a unit quaternion (4,) wxyz."""
    w, x, y, z = q_nb.tolist()
    roll_rad = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch_rad = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw_rad = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll_rad, pitch_rad, yaw_rad


def body_z_ned(q_nb: Array) -> Array:
    """Return the body down axis (3,) in NED: the thesis' (u_x, u_y, c_phi c_theta) of eqs. (3.16), (3.23)."""
    w, x, y, z = q_nb.tolist()
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def quat_from_body_z(down_ned: Array, yaw_rad: float) -> Array:
    """Return the quaternion (4,) wxyz with body down axis `down_ned` (3,), a unit vector, and ZYX yaw `yaw_rad`.

    It is the exact inverse of thesis eqs. (3.16) and (3.23), that is (3.26) and the consistent form of (3.33),
    `phi = -asin(u_y c_psi - u_x s_psi)`, without their singularity in the measured angles.
    """
    ux, uy, uz = down_ned.tolist()
    s, c = math.sin(yaw_rad), math.cos(yaw_rad)
    roll_rad = -math.asin(max(-1.0, min(1.0, uy * c - ux * s)))
    pitch_rad = math.atan2(ux * c + uy * s, uz)
    return quat_from_euler(roll_rad, pitch_rad, yaw_rad)


def quat_of_tilt(down_ned: Array, heading_rad: float) -> Array:
    """Return the quaternion (4,) wxyz of a body that is turned to a heading and then tilted by the shortest rotation.

    That is swing after twist: the tilt itself turns it not about its own down axis `down_ned` (3,), a unit vector that
    does not point up.
    """
    ux, uy, uz = down_ned.tolist()
    w = math.sqrt(0.5 * (1.0 + uz))
    x, y = -0.5 * uy / w, 0.5 * ux / w
    s, c = math.sin(0.5 * heading_rad), math.cos(0.5 * heading_rad)
    return np.array([w * c, x * c + y * s, y * c - x * s, w * s])


def rotate_to_ned(q_nb: Array, vector_frd: Array) -> Array:
    """Rotate a body FRD vector (3,) into NED (3,)."""
    return np.array(numbers_rotated_to_ned(q_nb.tolist(), vector_frd.tolist()))


def numbers_rotated_to_ned(q_nb: Sequence[float], vector_frd: Sequence[float]) -> tuple[float, float, float]:
    """Rotate as `rotate_to_ned`, four numbers and three into three."""
    w, x, y, z = q_nb
    vx, vy, vz = vector_frd
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx
