"""Virtual controls -> attitude and thrust, against attitudes worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.control.model import Predictor, VehicleModelParams, acceleration, tilt_rate
from swarmctl.control.setpoint import HELD_MAX_US, VALID_US, SetpointHold, holding_height, setpoint_of, within_tilt
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned, euler_from_quat, quat_from_body_z, quat_of_tilt
from swarmctl.core.types import Array, VehicleState
from tests import builders

MODEL = VehicleModelParams()  # thrust 0.05..1, tilt 0.6 rad
SWUNG = MODEL.model_copy(update={"heading": "swing_twist"})
G = 9.81


def test_level_at_hover_thrust() -> None:
    setpoint = setpoint_of(np.array([0.0, 0.0, G]), 0.0, 0.42, 1_000, params=MODEL)
    np.testing.assert_allclose(setpoint.q_nb, [1.0, 0.0, 0.0, 0.0])
    assert setpoint.thrust_01 == pytest.approx(0.42)
    assert setpoint.valid_until_us == 1_000 + VALID_US


@pytest.mark.parametrize(
    ("u_x", "u_y", "yaw_deg", "roll_deg", "pitch_deg"),
    [
        (-0.5, 0.0, 0.0, 0.0, -30.0),  # accelerate north, heading north: nose down
        (0.5, 0.0, 0.0, 0.0, 30.0),
        (0.0, -0.5, 0.0, 30.0, 0.0),  # accelerate east, heading north: right side down
        (0.0, 0.5, 0.0, -30.0, 0.0),
        (-0.5, 0.0, 90.0, -30.0, 0.0),  # accelerate north, heading east: left side down
        (0.0, -0.5, 90.0, 0.0, -30.0),  # accelerate east, heading east: nose down
        (-0.5, 0.0, 180.0, 0.0, 30.0),  # accelerate north, heading south: nose up
    ],
)
def test_attitudes_by_hand(u_x: float, u_y: float, yaw_deg: float, roll_deg: float, pitch_deg: float) -> None:
    q_nb = setpoint_of(np.array([u_x, u_y, G]), math.radians(yaw_deg), 0.5, 0, params=MODEL).q_nb
    roll, pitch, yaw = (math.degrees(a) for a in euler_from_quat(q_nb))
    assert [roll, pitch] == pytest.approx([roll_deg, pitch_deg], abs=1e-9)
    assert math.cos(math.radians(yaw - yaw_deg)) == pytest.approx(1.0)


@given(st.floats(-0.39, 0.39), st.floats(-0.39, 0.39), st.floats(-3.1, 3.1))
def test_the_body_axis_of_the_attitude_is_what_was_asked(u_x: float, u_y: float, yaw: float) -> None:
    swung = setpoint_of(np.array([u_x, u_y, G]), yaw, 0.5, 0, params=SWUNG).q_nb
    np.testing.assert_allclose(body_z_ned(swung), [u_x, u_y, math.sqrt(1 - u_x**2 - u_y**2)], atol=1e-9)
    np.testing.assert_allclose(swung, quat_of_tilt(body_z_ned(swung), yaw), atol=1e-9)
    q_nb = setpoint_of(np.array([u_x, u_y, G]), yaw, 0.5, 0, params=MODEL).q_nb
    np.testing.assert_allclose(body_z_ned(q_nb), [u_x, u_y, math.sqrt(1 - u_x**2 - u_y**2)], atol=1e-9)
    assert math.cos(euler_from_quat(q_nb)[2] - yaw) == pytest.approx(1.0)


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_tilt_is_limited_by_shortening_and_never_by_turning(u_x: float, u_y: float) -> None:
    down = body_z_ned(setpoint_of(np.array([u_x, u_y, G]), 0.3, 0.5, 0, params=MODEL).q_nb)
    assert math.acos(min(1.0, down[2])) <= 0.6 + 1e-6
    assert down[0] * u_y - down[1] * u_x == pytest.approx(0.0, abs=1e-6)
    assert down[0] * u_x + down[1] * u_y >= -1e-9


@pytest.mark.parametrize(
    ("specific_m_s2", "hover_01", "thrust_01"),
    [(G, 0.5, 0.5), (2 * G, 0.3, 0.6), (3 * G, 0.5, 1.0), (0.0, 0.5, 0.05), (-20.0, 0.5, 0.05), (G / 2, 0.6, 0.3)],
)
def test_thrust_is_linear_in_weights_and_bounded(specific_m_s2: float, hover_01: float, thrust_01: float) -> None:
    setpoint = setpoint_of(np.array([0.0, 0.0, specific_m_s2]), 0.0, hover_01, 0, params=MODEL)
    assert setpoint.thrust_01 == pytest.approx(thrust_01)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("entry", range(3))
def test_nonsense_in_is_a_setpoint_that_is_refused(entry: int, bad: float) -> None:
    virtual_control = np.array([0.1, -0.1, G])
    virtual_control[entry] = bad
    assert setpoint_of(virtual_control, 0.0, 0.5, 0, params=MODEL).problem(0)


def test_acceleration_of_virtual_controls_by_hand() -> None:
    np.testing.assert_allclose(acceleration(np.array([0.0, 0.0, G])), 0.0, atol=1e-12)
    # 30 degrees nose down with the vertical part carrying the weight: g tan 30 to the north
    virtual_control = np.array([-0.5, 0.0, G / math.cos(math.radians(30))])
    np.testing.assert_allclose(acceleration(virtual_control), [G * math.tan(math.radians(30)), 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(acceleration(np.array([0.0, 0.0, 0.0])), [0.0, 0.0, G])


HOVER = np.array([0.0, 0.0, GRAVITY_M_S2])


def level_and(north_m_s2: float, east_m_s2: float) -> Array:
    """Virtual controls that accelerate like this without climbing."""
    lift = np.array([-north_m_s2, -east_m_s2, GRAVITY_M_S2])
    size = float(np.linalg.norm(lift))
    return np.array([lift[0] / size, lift[1] / size, size])


def state(t_us: int, pos: tuple[float, ...], vel: tuple[float, ...]) -> VehicleState:
    level = np.array([1.0, 0.0, 0.0, 0.0])
    return builders.vehicle_state(t_us=t_us, pos_ned_m=np.array(pos), vel_ned_m_s=np.array(vel), q_nb=level)


def predicted(predictor: Predictor, now: VehicleState, until_us: int, wind: Array) -> tuple[Array, Array]:
    start = predictor.start(now, until_us, wind, HOVER)
    assert start.t_us == until_us
    return start.pos_ned_m, start.vel_ned_m_s


def test_all_commands_of_the_longest_dead_time_are_remembered_at_the_highest_rate() -> None:
    predictor, tick_us = Predictor(VehicleModelParams(delay_s=1.0)), 5_000  # 200 Hz
    for k in range(400):
        predictor.sent(k * tick_us, np.array([-0.2 if k < 250 else 0.2, 0.0, G]))
    now_us = 400 * tick_us
    start = predictor.start(builders.vehicle_state(t_us=now_us), now_us + 1_000_000, np.zeros(3), builders.HOVERING)
    # to the north for the first quarter of a second, those of before act, then to the south
    assert start.vel_ned_m_s[0] == pytest.approx(0.2 * G * (0.25 - 0.75), rel=0.02)


def test_prediction_applies_each_command_from_when_it_acts() -> None:
    predictor = Predictor(VehicleModelParams(delay_s=0.1))
    north, east = level_and(2.0, 0.0), level_and(0.0, 4.0)
    predictor.sent(0, north)  # acts from 0.1 s
    predictor.sent(100_000, east)  # acts from 0.2 s
    pos, vel = predicted(predictor, state(150_000, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), 300_000, np.zeros(3))
    # 50 ms at 2 m/s2 north, then 100 ms at 4 m/s2 east
    np.testing.assert_allclose(vel, [1.1, 0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(pos, [1.0 + 0.05 + 0.0025 + 0.11, 0.02, 0.0], atol=1e-12)
    before = predicted(predictor, state(150_000, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), 180_000, np.zeros(3))
    np.testing.assert_allclose(before[1], [1.06, 0.0, 0.0], atol=1e-12)  # what acts later does not yet


def test_prediction_adds_the_disturbance_to_commands_and_nothing_before_the_first() -> None:
    predictor = Predictor(VehicleModelParams(delay_s=0.1))
    wind = np.array([0.0, 1.0, 0.0])
    hover = state(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(predicted(predictor, hover, 1_000_000, wind)[1], 0.0)  # whoever flies holds against it
    predictor.sent(0, HOVER)
    np.testing.assert_allclose(predicted(predictor, hover, 1_100_000, wind)[1], [0.0, 1.1, 0.0], atol=1e-12)
    predictor.clear()
    np.testing.assert_allclose(predicted(predictor, hover, 1_000_000, wind)[1], 0.0)


# -- with an attitude that lags behind --------------------------------------------------------------------------------

LAGGING = VehicleModelParams(delay_s=0.08, attitude_rad_s=9.5, drag_1_s=1.0)


def tilted(t_us: int, u_x: float, rate_1_s: float) -> VehicleState:
    """At rest, leaning so that the down axis has a north part `u_x`, which changes by `rate_1_s`."""
    q_nb = quat_from_body_z(np.array([u_x, 0.0, math.sqrt(1.0 - u_x * u_x)]), 0.0)
    pitch_rate = rate_1_s / math.sqrt(1.0 - u_x * u_x)
    return replace(
        state(t_us, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), q_nb=q_nb, rate_frd_rad_s=np.array([0, pitch_rate, 0])
    )


def test_rate_of_the_tilt_is_that_of_the_body() -> None:
    now = tilted(0, 0.3, 0.8)
    np.testing.assert_allclose(tilt_rate(now), [0.8, 0.0], atol=1e-12)
    turned = replace(now, q_nb=quat_from_body_z(body_z_ned(now.q_nb), 1.1), rate_frd_rad_s=np.array([0.4, -0.2, 5.0]))
    h, (p, q, r) = 1e-6, turned.rate_frd_rad_s
    step = np.array([1.0, 0.5 * h * p, 0.5 * h * q, 0.5 * h * r])
    after = body_z_ned(product(turned.q_nb, step))
    np.testing.assert_allclose(tilt_rate(turned), (after - body_z_ned(turned.q_nb))[:2] / h, atol=1e-4)


def product(a: Array, b: Array) -> Array:
    """Hamilton product of two quaternions wxyz."""
    w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([w, *v])


def test_a_lagging_vehicle_is_predicted_from_its_measured_tilt() -> None:
    predictor, lag = Predictor(LAGGING), LAGGING.lag()
    assert lag is not None
    command = np.array([0.2, 0.0, GRAVITY_M_S2 / math.sqrt(1 - 0.04)])
    predictor.sent(-200_000, command)
    start = predictor.start(tilted(0, 0.05, 0.5), 80_000, np.zeros(3), command)
    tilt, rate, _ = lag.advance(0.05, 0.5, 0.2, 0.08)
    assert start.tilt[0] == pytest.approx(tilt, abs=1e-9)
    assert start.tilt_rate_1_s[0] == pytest.approx(rate, abs=1e-9)
    assert start.cos_tilt == pytest.approx(math.sqrt(1.0 - tilt * tilt))
    vel = 0.0
    for k in range(800):
        leaning, _, _ = lag.advance(0.05, 0.5, 0.2, k * 1e-4)
        vel += 1e-4 * (-float(command[2]) * leaning - 1.0 * vel)
    assert start.vel_ned_m_s[0] == pytest.approx(vel, abs=2e-3)


def test_without_the_lag_in_the_model_the_same_vehicle_is_predicted_elsewhere() -> None:
    """The control of the test above."""
    command = np.array([0.2, 0.0, GRAVITY_M_S2])
    believed = []
    for params in (LAGGING, LAGGING.model_copy(update={"attitude_rad_s": 0.0})):
        predictor = Predictor(params)
        predictor.sent(-200_000, command)
        believed.append(predictor.start(tilted(0, 0.0, 0.0), 80_000, np.zeros(3), command).vel_ned_m_s[0])
    assert abs(believed[1]) > 4.0 * abs(believed[0])


def test_both_axes_together_tilt_no_more_than_the_vehicle_may() -> None:
    asked = np.array([0.5, -0.5, 12.0])
    found = within_tilt(asked, MODEL)
    assert np.hypot(*found[:2]) == pytest.approx(MODEL.u_max()) and MODEL.u_max() < 0.7
    assert found[0] == -found[1] and found[2] == 12.0
    within = np.array([0.3, -0.3, 12.0])
    assert within_tilt(within, MODEL) is within


def test_who_has_sunk_tilts_no_more_than_its_thrust_carries_up_again() -> None:
    asked = np.array([0.6, -0.6, 15.0])
    assert holding_height(asked, 0.3, 15.0) is asked, "what a gust costs is made good again"
    held = holding_height(asked, 2.0, 15.0)
    assert held[0] == -held[1] > 0.0, "the direction stays"
    assert 15.0 * math.sqrt(1.0 - held[0] ** 2 - held[1] ** 2) == pytest.approx(GRAVITY_M_S2 + 1.0)
    upright = np.array([0.1, 0.1, 15.0])
    assert holding_height(upright, 2.0, 15.0) is upright
    assert holding_height(asked, 2.0, 10.0)[:2] == pytest.approx([0.0, 0.0]), "level where thrust is too weak"


@pytest.mark.parametrize(
    ("intervals_ms", "later_ms"),
    [
        ((), 0.0),
        ((20, 20, 20), 0.0),
        ((40, 40), 10.0),
        ((100, 100, 100), 40.0),
        ((20, 300), 0.0),
        ((300, 300), 90.0),
        ((100, 20), 0.0),
        ((10, 10), 0.0),
    ],
    ids=["first", "in time", "25 Hz", "one of five", "one stall", "longest", "in time again", "faster than the plan"],
)
def test_a_setpoint_that_is_held_for_long_is_that_of_the_middle(intervals_ms: tuple[int, ...], later_ms: float) -> None:
    hold, now_us = SetpointHold(), 5_000_000
    later_us = hold.middle_us(now_us, 20_000)
    for interval_ms in intervals_ms:
        now_us += interval_ms * 1000
        later_us = hold.middle_us(now_us, 20_000)
    assert later_us == later_ms * 1000
    assert later_us < HELD_MAX_US / 2
