"""How ArduCopter's position controller comes to rest in BRAKE and LAND: along a velocity that it brings to zero.

The acceleration of that velocity begins at zero, changes by a limited jerk, and is proportional to the speed where that
is low: in BRAKE, whose limit is 7.5 m/s2, by 0.67 1/s, so that the larger limit brakes the vehicle more softly. The
integral begins at the acceleration that the tilt gives as the mode begins.
"""

from __future__ import annotations

import math

from sitl.acceleration import limited
from sitl.arducopter.parameters import CopterParameters
from sitl.plant.sensors import Estimate

JERK_M_S3 = 5.0  # PSC_JERK_XY
VEL_D_01 = 0.5  # PSC_VELXY_D
_FILTER_1_S = 2.0 * math.pi * 5.0  # PSC_VELXY_FLTE and FLTD
I_MAX_M_S2 = 10.0
Xy = tuple[float, float]


class ShapedStop:
    """One stop of one vehicle, advanced every tick.

    Args:
        parameters: gains.
        estimate: where it begins.
        tilt_m_s2: (north, east) acceleration that the attitude gives then.
    """

    def __init__(self, parameters: CopterParameters, estimate: Estimate, tilt_m_s2: Xy) -> None:
        self._parameters = parameters
        self._pos_m = [estimate.pos_ned_m[0], estimate.pos_ned_m[1]]
        self._vel_m_s = [estimate.vel_ned_m_s[0], estimate.vel_ned_m_s[1]]
        self._accel_m_s2 = 0.0, 0.0
        self._integral_m_s2 = [tilt_m_s2[0], tilt_m_s2[1]]
        self._error_m_s = [0.0, 0.0]
        self._change_m_s2 = [0.0, 0.0]

    def accel_m_s2(self, estimate: Estimate, brake_m_s2: float, dt_s: float) -> Xy:
        """Return the acceleration (north, east) to ask for after one tick more; `brake_m_s2` is the mode's limit."""
        self._shape(brake_m_s2, dt_s)
        real = self._parameters.real
        share = min(1.0, _FILTER_1_S * dt_s)
        asked = []
        for axis in (0, 1):
            wanted = self._vel_m_s[axis] + real("PSC_POSXY_P") * (self._pos_m[axis] - estimate.pos_ned_m[axis])
            before = self._error_m_s[axis]
            self._error_m_s[axis] += share * (wanted - estimate.vel_ned_m_s[axis] - before)
            change = (self._error_m_s[axis] - before) / dt_s
            self._change_m_s2[axis] += share * (change - self._change_m_s2[axis])
            summed = self._integral_m_s2[axis] + real("PSC_VELXY_I") * self._error_m_s[axis] * dt_s
            self._integral_m_s2[axis] = max(-I_MAX_M_S2, min(I_MAX_M_S2, summed))
            fed_back = real("PSC_VELXY_P") * self._error_m_s[axis] + VEL_D_01 * self._change_m_s2[axis]
            asked.append(self._accel_m_s2[axis] + fed_back + self._integral_m_s2[axis])
        return asked[0], asked[1]

    def _shape(self, brake_m_s2: float, dt_s: float) -> None:
        """Advance the velocity that is followed, and the position that follows from it."""
        speed = math.hypot(*self._vel_m_s)
        braking = min(brake_m_s2, _root(speed, JERK_M_S3 / brake_m_s2), speed / dt_s)
        scale = -braking / speed if speed > 0.0 else 0.0
        wanted = scale * self._vel_m_s[0], scale * self._vel_m_s[1]
        change = limited(wanted[0] - self._accel_m_s2[0], wanted[1] - self._accel_m_s2[1], JERK_M_S3 * dt_s)
        self._accel_m_s2 = self._accel_m_s2[0] + change[0], self._accel_m_s2[1] + change[1]
        for axis in (0, 1):
            self._pos_m[axis] += self._vel_m_s[axis] * dt_s + 0.5 * self._accel_m_s2[axis] * dt_s**2
            self._vel_m_s[axis] += self._accel_m_s2[axis] * dt_s


def _root(error: float, gain: float) -> float:
    """Return ArduPilot's square-root controller of an error >= 0: proportional near zero, then limited by the jerk."""
    near = JERK_M_S3 / gain**2
    return gain * error if error < near else math.sqrt(2.0 * JERK_M_S3 * (error - 0.5 * near))
