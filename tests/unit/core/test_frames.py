"""Rotations against numbers worked out by hand: a sign error shared by code and inverse cannot hide here."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.core.clock import SimClock
from swarmctl.core.frames import (
    body_z_ned,
    euler_from_quat,
    quat_from_body_z,
    quat_from_euler,
    quat_of_tilt,
    rotate_to_ned,
)
from swarmctl.core.types import Array

RAD = math.pi / 180.0
tilts = st.floats(-1.4, 1.4)
yaws = st.floats(-3.1, 3.1)


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "yaw_deg", "q_nb"),
    [
        (0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0)),
        (0.0, 10.0, 0.0, (0.996194698, 0.0, 0.087155743, 0.0)),
        (20.0, 0.0, 0.0, (0.984807753, 0.173648178, 0.0, 0.0)),
        (0.0, 0.0, 90.0, (0.707106781, 0.0, 0.0, 0.707106781)),
        (0.0, 0.0, -60.0, (0.866025404, 0.0, 0.0, -0.5)),
        # yaw 90 then pitch 90: q_z * q_y = (0.5, -0.5, 0.5, 0.5)
        (0.0, 90.0, 90.0, (0.5, -0.5, 0.5, 0.5)),
    ],
)
def test_quaternion_of_euler_angles_typed_by_hand(
    roll_deg: float, pitch_deg: float, yaw_deg: float, q_nb: tuple[float, ...]
) -> None:
    np.testing.assert_allclose(quat_from_euler(roll_deg * RAD, pitch_deg * RAD, yaw_deg * RAD), q_nb, atol=1e-8)


def test_body_axes_point_where_a_pilot_expects() -> None:
    nose, right = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    east = quat_from_euler(0.0, 0.0, math.pi / 2)
    np.testing.assert_allclose(rotate_to_ned(east, nose), [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rotate_to_ned(east, right), [-1.0, 0.0, 0.0], atol=1e-12)
    nose_up = quat_from_euler(0.0, 30 * RAD, 0.0)
    np.testing.assert_allclose(rotate_to_ned(nose_up, nose), [math.cos(30 * RAD), 0.0, -0.5], atol=1e-12)
    right_down = quat_from_euler(30 * RAD, 0.0, 0.0)
    np.testing.assert_allclose(rotate_to_ned(right_down, right), [0.0, math.cos(30 * RAD), 0.5], atol=1e-12)


def test_body_down_axis_of_pitch_and_roll_has_the_signs_of_the_thesis() -> None:
    # (3.16), psi = 0: u_x = cos phi sin theta, u_y = -sin phi
    np.testing.assert_allclose(body_z_ned(quat_from_euler(0.0, 30 * RAD, 0.0)), [0.5, 0.0, math.cos(30 * RAD)])
    np.testing.assert_allclose(
        body_z_ned(quat_from_euler(30 * RAD, 0.0, 0.0)), [0.0, -0.5, math.cos(30 * RAD)], atol=1e-15
    )


@given(tilts, tilts, yaws)
def test_body_down_axis_is_the_thesis_formula_at_any_attitude(roll: float, pitch: float, yaw: float) -> None:
    s, c = math.sin, math.cos
    u_x = s(roll) * s(yaw) + c(roll) * c(yaw) * s(pitch)
    u_y = c(roll) * s(yaw) * s(pitch) - c(yaw) * s(roll)
    q_nb = quat_from_euler(roll, pitch, yaw)
    np.testing.assert_allclose(body_z_ned(q_nb), [u_x, u_y, c(roll) * c(pitch)], atol=1e-12)
    np.testing.assert_allclose(body_z_ned(q_nb), rotate_to_ned(q_nb, np.array([0.0, 0.0, 1.0])), atol=1e-12)


@given(tilts, tilts, yaws)
def test_euler_angles_round_trip(roll: float, pitch: float, yaw: float) -> None:
    q_nb = quat_from_euler(roll, pitch, yaw)
    assert abs(float(q_nb @ q_nb) - 1.0) < 1e-12
    np.testing.assert_allclose(euler_from_quat(q_nb), (roll, pitch, yaw), atol=1e-7)


@given(tilts, tilts, yaws, st.tuples(*[st.floats(-50.0, 50.0)] * 3))
def test_rotation_keeps_length_and_is_the_sandwich_product(
    roll: float, pitch: float, yaw: float, vector: tuple[float, float, float]
) -> None:
    def product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
        return (
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        )

    q_nb = quat_from_euler(roll, pitch, yaw)
    w, x, y, z = (float(c) for c in q_nb)
    sandwich = product(product((w, x, y, z), (0.0, *vector)), (w, -x, -y, -z))[1:]
    np.testing.assert_allclose(rotate_to_ned(q_nb, np.array(vector)), sandwich, atol=1e-10)


@given(st.floats(-0.95, 0.95), st.floats(-0.95, 0.95), yaws)
def test_attitude_of_a_thrust_direction_has_that_direction_and_that_yaw(u_x: float, u_y: float, yaw: float) -> None:
    length2 = u_x * u_x + u_y * u_y
    if length2 > 0.9:
        return
    down_ned = np.array([u_x, u_y, math.sqrt(1.0 - length2)])
    q_nb = quat_from_body_z(down_ned, yaw)
    np.testing.assert_allclose(body_z_ned(q_nb), down_ned, atol=1e-9)
    assert math.cos(euler_from_quat(q_nb)[2] - yaw) > 1.0 - 1e-9


@given(tilt_rad=st.floats(0.0, 1.4), towards_rad=st.floats(-3.1, 3.1), heading_rad=st.floats(-3.1, 3.1))
def test_a_tilted_body_is_turned_to_its_heading_and_swung_by_the_shortest_way(
    tilt_rad: float, towards_rad: float, heading_rad: float
) -> None:
    flat = math.sin(tilt_rad)
    down_ned = np.array([flat * math.cos(towards_rad), flat * math.sin(towards_rad), math.cos(tilt_rad)])
    q_nb = quat_of_tilt(down_ned, heading_rad)
    np.testing.assert_allclose(body_z_ned(q_nb), down_ned, atol=1e-9)
    level = quat_from_euler(0.0, 0.0, heading_rad)
    assert 2.0 * math.acos(min(1.0, abs(float(q_nb @ level)))) == pytest.approx(tilt_rad, abs=1e-6)


@pytest.mark.parametrize(("attitude", "rates_rad_s"), [(quat_of_tilt, (-0.5, -0.5)), (quat_from_body_z, (-1.25, 0.0))])
def test_a_tilt_that_goes_round_turns_the_body_about_its_down_axis(
    attitude: Callable[[Array, float], Array], rates_rad_s: tuple[float, float]
) -> None:
    """At 1.5 rad/s and 48 degrees: evenly, by 1.5 (1 - cos 48); or by fits and starts, twice a round."""
    step_rad, found = 1e-4, []
    for towards_rad in np.linspace(0.0, math.tau, 200):
        (w0, x0, y0, z0), (w1, x1, y1, z1) = (
            attitude(np.array([math.sin(0.84) * math.cos(at), math.sin(0.84) * math.sin(at), math.cos(0.84)]), 0.0)
            for at in (towards_rad, towards_rad + step_rad)
        )
        turned_rad = 2.0 * (w0 * z1 - x0 * y1 + y0 * x1 - z0 * w1)  # about down, of conj(q0) q1
        found.append(1.5 * turned_rad / step_rad)
    assert (min(found), max(found)) == pytest.approx(rates_rad_s, abs=0.01)


def test_simulated_clocks_run_together_and_never_back() -> None:
    clock = SimClock(epoch_us=1_000)
    clock.advance(250)
    assert (clock.now_us(), clock.utc_us()) == (250, 1_250)
    for step_us in (0, -1):
        with pytest.raises(ValueError, match="step_us"):
            clock.advance(step_us)
