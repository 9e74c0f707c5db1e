"""N quadrotors as one batched plant: rigid body of thesis (1.18), rotors with real limits, ground contact.

The attitude is integrated as a quaternion, so that (1.18)'s singularity at theta = 90 deg does not exist; away from it
the equations are the same. Errata built in: v' has `+ g sin(phi) cos(theta)`, kp..kr damp rotation and ku..kw damp
translation (Table 1 describes them the other way round). Rotor forces are in [0, rotor_force_max_n]: the thesis'
negative thrust does not exist.

Arrays are (rows, N), one column a vehicle. This module knows no controller, no MAVLink and no clock.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl.plant.airframes import Preset
from sitl.plant.mixer import YAW_SIGN, Mixer
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

Mask = NDArray[np.bool_]

RATE_LIMIT_RAD_S = 60.0  # keeps a tumbling vehicle finite under an explicit integrator; no controlled flight comes near
GROUND_FRICTION = 0.8  # share of the weight; a vehicle that touches down at 1 m/s slides 6 cm


# Rows of the polynomial's argument: constant, rotor speed sum, quaternion, body rates, body velocity.
_ARGUMENTS = ("1", "wr", "qw", "qx", "qy", "qz", "p", "q", "r", "u", "v", "w")
_QUAT, _RATE, _VEL, _POS = slice(0, 4), slice(4, 7), slice(7, 10), slice(10, 13)
_SPIN_SIGN = -YAW_SIGN
# Left factors of all products of two arguments, then right ones: (288,), and those of quaternions alone (32,).
_FACTORS = np.concatenate([np.repeat(np.arange(12), 12), np.tile(np.arange(12), 12)])
_QUAT_FACTORS = np.concatenate([np.repeat(np.arange(4), 4), np.tile(np.arange(4), 4)])

# Body->NED rotation matrix, row-major, as quadratic forms of the quaternion.
_ROTATION: tuple[tuple[tuple[str, str, float], ...], ...] = (
    (("qw", "qw", 1), ("qx", "qx", 1), ("qy", "qy", -1), ("qz", "qz", -1)),
    (("qx", "qy", 2), ("qw", "qz", -2)),
    (("qx", "qz", 2), ("qw", "qy", 2)),
    (("qx", "qy", 2), ("qw", "qz", 2)),
    (("qw", "qw", 1), ("qx", "qx", -1), ("qy", "qy", 1), ("qz", "qz", -1)),
    (("qy", "qz", 2), ("qw", "qx", -2)),
    (("qx", "qz", 2), ("qw", "qy", -2)),
    (("qy", "qz", 2), ("qw", "qx", 2)),
    (("qw", "qw", 1), ("qx", "qx", -1), ("qy", "qy", -1), ("qz", "qz", 1)),
)


def _quadratic_rows(preset: Preset, mass_kg: float) -> Array:
    """Return (19, 144): derivative (quaternion, rates, velocity), rotation matrix; over products of `_ARGUMENTS`."""
    ix, iy, iz = preset.inertia_kg_m2
    kp, kq, kr = preset.drag_rotation_1_s
    ku, kv, kw = (k / (preset.mass_kg if preset.drag_scales_with_mass else mass_kg) for k in preset.drag_n_s_m)
    jr, g = preset.rotor_inertia_kg_m2, GRAVITY_M_S2
    rows: list[tuple[tuple[str, str, float], ...]] = [
        (("qx", "p", -0.5), ("qy", "q", -0.5), ("qz", "r", -0.5)),
        (("qw", "p", 0.5), ("qy", "r", 0.5), ("qz", "q", -0.5)),
        (("qw", "q", 0.5), ("qz", "p", 0.5), ("qx", "r", -0.5)),
        (("qw", "r", 0.5), ("qx", "q", 0.5), ("qy", "p", -0.5)),
        (("r", "q", (iy - iz) / ix), ("1", "p", -kp), ("wr", "p", -jr)),
        (("p", "r", (iz - ix) / iy), ("1", "q", -kq), ("wr", "q", jr)),
        (("p", "q", (ix - iy) / iz), ("1", "r", -kr)),
        (("r", "v", 1.0), ("q", "w", -1.0), ("1", "u", -ku), *((a, b, c * g) for a, b, c in _ROTATION[6])),
        (("p", "w", 1.0), ("r", "u", -1.0), ("1", "v", -kv), *((a, b, c * g) for a, b, c in _ROTATION[7])),
        (("q", "u", 1.0), ("p", "v", -1.0), ("1", "w", -kw), *((a, b, c * g) for a, b, c in _ROTATION[8])),
        *_ROTATION,
    ]
    table = np.zeros((len(rows), len(_ARGUMENTS), len(_ARGUMENTS)))
    for row, terms in enumerate(rows):
        for left, right, coefficient in terms:
            table[row, _ARGUMENTS.index(left), _ARGUMENTS.index(right)] += coefficient
    return table.reshape(len(rows), -1)


def _attitude_rows() -> Array:
    """Return (13, 16): rotation matrix, then (r21, r10, r22, r00), the arguments of roll's and yaw's arctangents."""
    names = ("qw", "qx", "qy", "qz")
    table = np.zeros((13, 4, 4))
    for row, source in enumerate((*range(9), 7, 3, 8, 0)):
        for left, right, coefficient in _ROTATION[source]:
            table[row, names.index(left), names.index(right)] += coefficient
    return table.reshape(13, 16)


class _Stage(NamedTuple):
    """Buffers of one evaluation of the right-hand side."""

    arguments: Array  # (12, N)
    moving: Array  # (10, N) of these: quaternion, rates, velocity
    polynomial: Array  # (19, N): `_quadratic_rows` of the arguments
    quadratic: Array  # (10, N) of these: derivative of `moving` without forcing
    slope: Array  # (10, N) with it


class Plant:
    """State and one fixed step (Bogacki-Shampine third order, ode3) of all vehicles at once.

    The right-hand side of (1.18) with a quaternion is quadratic in (quaternion, rates, velocity): all products of two
    of its arguments and one constant matrix evaluate it for all vehicles.

    Attributes:
        state: (13, N) quaternion body->NED, rates FRD [rad/s], velocity FRD [m/s], position NED [m].
        q_nb, rate_frd_rad_s, pos_ned_m: parts of it.
        rotation: (9, N) row-major body->NED, of the current state.
        vel_ned_m_s: (3, N), of the current state.
        euler_rad: (3, N) roll, pitch, yaw, of the current state.
        contact: (N,) resting on or sliding over the ground.
        rotor_force_n: (4, N) after motor lag.
        rotor_share_01: (4, N) share of its force that each rotor still gives, or None for all: battery, failures.
        mass_ratio: (N,) mass over the mass at the start, or None.
    """

    def __init__(
        self,
        preset: Preset,
        pos_ned_m: Array,
        dt_s: float,
        *,
        ground: bool = True,
        below_z_m: Array | float = 0.0,
        mass_scale: float = 1.0,
        thrust_curve_01: float = 0.0,
        ground_effect: bool = False,
    ) -> None:
        """Create vehicles at rest, level, nose north.

        Args:
            preset: airframe.
            pos_ned_m: (N, 3) spawn positions; each vehicle's ground is the plane at its own z.
            dt_s: step.
            ground: False for no ground at all.
            below_z_m: (N,) down coordinate above which heights count then, as if there were ground.
            mass_scale: true mass over the preset's.
            thrust_curve_01: k of a rotor's force (1 - k) u + k u^2 over its limit, at command u; PX4's THR_MDL_FAC.
            ground_effect: whether thrust increases close to the ground.
        """
        count = len(pos_ned_m)
        self.preset = preset
        self.dt_s = dt_s
        self.mass_kg = preset.mass_kg * mass_scale
        self._allocate_buffers(count)
        self.state[0] = 1.0
        self.state[_POS] = np.asarray(pos_ned_m, dtype=np.float64).T
        self.ground_z_m: Array | None = self.state[12].copy() if ground else None
        self._height_datum_z_m = below_z_m if self.ground_z_m is None else self.ground_z_m
        self.contact: Mask = np.full(count, ground)
        self.held: Mask = np.zeros(count, dtype=bool)  # clamped at the spawn pose
        self.mixer = Mixer(preset, count)
        self.rotor_force_n = np.zeros((4, count))
        self.rotor_share_01: Array | None = None
        self.mass_ratio: Array | None = None
        self._curve_01 = thrust_curve_01
        self._ground_effect = ground_effect and ground
        self._wind_ned_m_s: Array | None = None
        self._at_rest: tuple[bytes, ...] | None = None  # the situation that the last step has left as it was
        self._lag = 1.0 - math.exp(-dt_s / preset.motor_tau_s) if preset.motor_tau_s > 0 else 1.0
        self._rows = _quadratic_rows(preset, self.mass_kg)
        self._attitude_rows = _attitude_rows()
        scale = 1.0 / np.array([-self.mass_kg, *preset.inertia_kg_m2])
        wrench_rows = self.mixer.wrench_of_forces * scale[:, None]
        self._forcing_rows = np.zeros((10, 4))
        self._forcing_rows[_RATE], self._forcing_rows[9] = wrench_rows[1:], wrench_rows[0]
        self._weights = np.array([2.0, 3.0, 4.0]) * (dt_s / 9.0)
        self.refresh()

    def _allocate_buffers(self, count: int) -> None:
        self._arguments = np.zeros((3, 15, count))  # of each stage: `_ARGUMENTS`, position; the first is the state's
        self._arguments[:, 0] = 1.0
        self.state = self._arguments[0, 2:]
        self._factors = np.zeros((288, count))
        self._products = np.zeros((144, count))
        self._polynomials = np.zeros((3, 19, count))
        self._slopes = np.zeros((3, 13, count))
        self._stages = tuple(
            _Stage(arguments[:12], arguments[2:12], polynomial, polynomial[:10], slope[:10])
            for arguments, polynomial, slope in zip(self._arguments, self._polynomials, self._slopes, strict=True)
        )
        self._change = np.zeros((13, count))
        self._levers = np.zeros((3, 3, 3, count))
        self._forcing = np.zeros((10, count))
        self._spins = np.zeros((4, count))
        self._square = np.zeros((4, count))
        self._norm = np.zeros(count)
        self._quat_factors = np.zeros((32, count))
        self._quat_products = np.zeros((16, count))
        self._attitude = np.zeros((13, count))
        self.vel_ned_m_s = np.zeros((3, count))
        self.euler_rad = np.zeros((3, count))
        self._make_views(count)

    def _make_views(self, count: int) -> None:
        """Make the views of the buffers once: each costs as much as an operation on it."""
        self.q_nb, self.rate_frd_rad_s = self.state[_QUAT], self.state[_RATE]
        self.pos_ned_m, self._vel_frd_m_s = self.state[_POS], self.state[_VEL]
        self.rotation = self._attitude[:9]
        self._left, self._right = self._factors[:144], self._factors[144:]
        self._rotations = self._polynomials[:, 10:].reshape(3, 3, 3, count)  # of the three stages
        self._velocities = self._arguments[:, None, 9:12]
        self._drifts = self._slopes[:, _POS]
        self._flat_slopes = self._slopes.reshape(3, 13 * count)
        self._flat_change = self._change.reshape(13 * count)
        self._quat_left, self._quat_right = self._quat_factors[:16], self._quat_factors[16:]
        self._matrix, self._lever = self.rotation.reshape(3, 3, count), self._levers[0]
        self._sines, self._cosines = self._attitude[9:11], self._attitude[11:]  # of roll and yaw, scaled
        self._roll_yaw, self._pitch = self.euler_rad[::2], self.euler_rad[1]

    @property
    def hover_thrust_01(self) -> float:
        """Thrust setpoint (0..1) that carries the true mass."""
        force_01, k = self.mass_kg * GRAVITY_M_S2 / self.preset.thrust_max_n, self._curve_01
        if not k:
            return force_01
        return (math.sqrt((1.0 - k) ** 2 + 4.0 * k * force_01) - (1.0 - k)) / (2.0 * k)

    @property
    def height_m(self) -> Array:
        """Heights (N,) above the ground, or above where it would be."""
        height_m: Array = self._height_datum_z_m - self.state[12]
        return height_m

    def rotor_01(self, vehicle: int) -> list[float]:
        """Return the forces (4,) of a vehicle's rotors over their limit."""
        forces_01: list[float] = (self.rotor_force_n[:, vehicle] * (1.0 / self.preset.rotor_force_max_n)).tolist()
        return forces_01

    def set_wind(self, wind_ned_m_s: Array | None) -> None:
        """Set the air velocity (3, N) NED that drag acts against; None for still air. Constant over one step."""
        self._wind_ned_m_s = None if wind_ned_m_s is None else np.array(wind_ned_m_s, dtype=np.float64)

    def step(self, rotor_cmd_n: Array) -> None:
        """Advance by `dt_s` under commanded rotor forces (4, N) [N], already within the rotors' limits."""
        rotor_cmd_n = self._achievable(rotor_cmd_n)
        if self._lag < 1.0:
            np.subtract(rotor_cmd_n, self.rotor_force_n, out=self._spins)
            self._spins *= self._lag
            self.rotor_force_n += self._spins
        else:
            self.rotor_force_n[...] = rotor_cmd_n
        lift_n = self.rotor_force_n * self._near_ground() if self._ground_effect else self.rotor_force_n
        np.matmul(self._forcing_rows, lift_n, out=self._forcing)
        if self.preset.rotor_inertia_kg_m2:
            np.multiply(self.rotor_force_n, 1.0 / self.preset.thrust_coeff_n_s2, out=self._spins)
            np.sqrt(self._spins, out=self._spins)
            np.matmul(_SPIN_SIGN, self._spins, out=self._arguments[0, 1])  # w_r = W1 - W2 + W3 - W4
            self._arguments[1:, 1] = self._arguments[0, 1]
        if self.mass_ratio is not None:
            self._reweigh(self.mass_ratio)
        if self._wind_ned_m_s is not None:
            self._add_wind(self._wind_ned_m_s)
        holds = self.held.tolist()
        if False not in holds:
            return  # nothing moves: of the state, only rotor forces change
        situation = self._situation()
        if situation is not None and situation == self._at_rest:
            return  # this step would change nothing, as the one before
        held = self.state[:, self.held].copy() if True in holds else None
        self._integrate()
        if held is not None:
            self.state[:, self.held] = held
        self._touch_ground()
        self.refresh()
        self._at_rest = situation if situation is not None and situation[0] == self.state.tobytes() else None

    def _situation(self) -> tuple[bytes, ...] | None:
        """Return all that a step depends on while every vehicle is on the ground, its state first; else None."""
        if False in self.contact.tolist():
            return None
        mass_ratio = b"" if self.mass_ratio is None else self.mass_ratio.tobytes()
        return self.state.tobytes(), self.rotor_force_n.tobytes(), self._forcing.tobytes(), mass_ratio

    def _achievable(self, rotor_cmd_n: Array) -> Array:
        """Return the real force of the commanded ones: thrust curve first, then battery and rotor health."""
        if self._curve_01:
            command = rotor_cmd_n / self.preset.rotor_force_max_n
            rotor_cmd_n = rotor_cmd_n * (1.0 - self._curve_01 + self._curve_01 * command)
        return rotor_cmd_n if self.rotor_share_01 is None else rotor_cmd_n * self.rotor_share_01

    def _near_ground(self) -> Array:
        """Return thrust (N,) over that of the same rotor far up: I. C. Cheeseman and W. E. Bennett, ARC R&M 3021, 1955.

        One rotor's formula, 1 / (1 - (R / 4 z)^2); the rotor is taken to stand one radius above the skids.
        """
        radius_m = self.preset.rotor_radius_m
        share = 0.25 * radius_m / (np.maximum(self.height_m, 0.0) + radius_m)
        gain: Array = 1.0 / (1.0 - share * share)
        return gain

    def _reweigh(self, mass_ratio: Array) -> None:
        """Apply another mass to thrust and drag; the inertia stays (the load is at the centre)."""
        lighter = 1.0 / mass_ratio
        self._forcing[9] *= lighter
        if not self.preset.drag_scales_with_mass:
            self._forcing[_VEL] += self._drag_1_s() * (1.0 - lighter) * self._vel_frd_m_s

    def _drag_1_s(self) -> Array:
        """Return the drag rates (3, 1) [1/s] of the mass at the start."""
        mass_kg = self.preset.mass_kg if self.preset.drag_scales_with_mass else self.mass_kg
        rate: Array = np.array(self.preset.drag_n_s_m)[:, None] / mass_kg
        return rate

    def _add_wind(self, wind_ned_m_s: Array) -> None:
        drag = self._drag_1_s()
        if self.mass_ratio is not None and not self.preset.drag_scales_with_mass:
            drag = drag / self.mass_ratio
        np.multiply(self._matrix, wind_ned_m_s[:, None], out=self._lever)
        self._forcing[_VEL] += drag * self._lever.sum(axis=0)

    def _integrate(self) -> None:
        first, second, third = self._stages
        self._slope(first)
        np.multiply(first.slope, 0.5 * self.dt_s, out=second.moving)
        np.add(second.moving, first.moving, out=second.moving)
        self._slope(second)
        np.multiply(second.slope, 0.75 * self.dt_s, out=third.moving)
        np.add(third.moving, first.moving, out=third.moving)
        self._slope(third)
        np.multiply(self._rotations, self._velocities, out=self._levers)
        np.add.reduce(self._levers, axis=2, out=self._drifts)
        np.matmul(self._weights, self._flat_slopes, out=self._flat_change)
        np.add(self.state, self._change, out=self.state)
        rates, quat = self.rate_frd_rad_s, self.q_nb
        np.minimum(rates, RATE_LIMIT_RAD_S, out=rates)
        np.maximum(rates, -RATE_LIMIT_RAD_S, out=rates)
        np.multiply(quat, quat, out=self._square)
        np.add.reduce(self._square, axis=0, out=self._norm)
        np.sqrt(self._norm, out=self._norm)
        quat /= self._norm

    def _slope(self, stage: _Stage) -> None:
        """Evaluate the right-hand side of (1.18), but for the position."""
        stage.arguments.take(_FACTORS, 0, self._factors, "clip")  # "raise" would copy once more
        np.multiply(self._left, self._right, out=self._products)
        np.matmul(self._rows, self._products, out=stage.polynomial)
        np.add(stage.quadratic, self._forcing, out=stage.slope)

    def refresh(self) -> None:
        """Update rotation, NED velocity and Euler angles from the current state."""
        self.q_nb.take(_QUAT_FACTORS, 0, self._quat_factors, "clip")
        np.multiply(self._quat_left, self._quat_right, out=self._quat_products)
        np.matmul(self._attitude_rows, self._quat_products, out=self._attitude)
        np.multiply(self._matrix, self._vel_frd_m_s, out=self._lever)
        np.add.reduce(self._lever, axis=1, out=self.vel_ned_m_s)
        np.arctan2(self._sines, self._cosines, out=self._roll_yaw)
        pitch = self._pitch
        np.maximum(self._attitude[6], -1.0, out=pitch)
        np.minimum(pitch, 1.0, out=pitch)
        np.arcsin(pitch, out=pitch)
        np.negative(pitch, out=pitch)

    def _touch_ground(self) -> None:
        if self.ground_z_m is None:
            return
        np.greater_equal(self.state[12], self.ground_z_m, out=self.contact)
        if True not in self.contact.tolist():
            return
        self.refresh()
        lift_n = (self.rotor_force_n.sum(axis=0) * self.rotation[8]).tolist()
        for i in np.flatnonzero(self.contact).tolist():
            self._rest_on_ground(i, lift_n[i], self.ground_z_m[i])

    def _rest_on_ground(self, i: int, lift_n: float, ground_z_m: float) -> None:
        """Enforce the ground: no penetration, upright on the skids, Coulomb friction; lift above weight takes off."""
        yaw = math.atan2(self.rotation[3, i], self.rotation[0, i])
        north, east, down = self.vel_ned_m_s[:, i].tolist()
        mass_kg = self.mass_kg * (float(self.mass_ratio[i]) if self.mass_ratio is not None else 1.0)
        load_n = max(0.0, mass_kg * GRAVITY_M_S2 - lift_n)
        speed = math.hypot(north, east)
        slowed = max(0.0, speed - GROUND_FRICTION * load_n / mass_kg * self.dt_s)
        ratio = slowed / speed if speed > 0 else 0.0
        north, east, down = north * ratio, east * ratio, min(down, 0.0)
        c, s = math.cos(yaw), math.sin(yaw)
        upright = math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)
        at_rest = 0.0, 0.0, 0.0
        self.state[:10, i] = *upright, *at_rest, c * north + s * east, c * east - s * north, down
        self.state[12, i] = ground_z_m
