"""Tests of the brake-and-hold plan: stopping distance, and tilts and rates that a vehicle can follow."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.fallback import brake_and_hold_plan
from swarmctl.control.lag import Lag
from swarmctl.control.model import acceleration
from swarmctl.control.mpc.problem import Start
from swarmctl.core.types import Array, Plan, PlanStatus
from tests import builders

DT_US = 20_000
DT_S = 0.02
STEPS = 250
NO_WIND = np.zeros(3)


def start(
    vel: tuple[float, ...], pos: tuple[float, ...] = (0.0, 0.0, -5.0), tilt: tuple[float, ...] = (0.0, 0.0)
) -> Start:
    return builders.start(
        t_us=1_000_000, pos_ned_m=np.array(pos), vel_ned_m_s=np.array(vel), virtual_control=np.array([*tilt, 9.81])
    )


def brake(
    vel: tuple[float, ...], at: Array | None = None, wind: Array = NO_WIND, tilt: tuple[float, ...] = (0.0, 0.0)
) -> Plan:
    return brake_and_hold_plan(start(vel, tilt=tilt), at, wind, None, drag_1_s=0.0, dt_us=DT_US, steps=STEPS)


@pytest.mark.parametrize("speed_m_s", [0.5, 1.0, 2.5, 5.0])
def test_stops_within_braking_distance_and_the_distance_lost_to_tilting(speed_m_s: float) -> None:
    plan = brake((speed_m_s, 0.0, 0.0))
    # v^2 / (2 * 3) at full braking, 0.12 s to tilt (0.3 at 2.5 per second), 1 / 4 s tail of the damping: v / 4
    limit_m = speed_m_s**2 / 6.0 + 0.12 * speed_m_s + min(speed_m_s, 0.75) / 4.0
    assert 0.0 < plan.pos_ned_m[-1, 0] <= limit_m
    assert np.linalg.norm(plan.vel_ned_m_s[-1]) < 0.02
    assert plan.vel_ned_m_s[:, 0].min() > -0.02 * speed_m_s - 0.01  # and does not swing back
    np.testing.assert_allclose(plan.pos_ned_m[:, 1], 0.0, atol=1e-9)


def test_braking_pushes_against_the_motion() -> None:
    plan = brake((2.0, -1.0, 0.5))
    wanted = acceleration(plan.virtual_control[20])
    assert wanted[0] < 0.0 < wanted[1]
    assert wanted[2] < 0.0  # sinking is braked upwards
    assert plan.status is PlanStatus.NONE


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (-0.25, 0.1), (0.3, 0.3)])
def test_slew_of_the_tilt_is_respected_from_the_tilt_now_held(tilt: tuple[float, float]) -> None:
    plan = brake((5.0, -5.0, 0.0), tilt=tilt)
    tilts = np.vstack([tilt, plan.virtual_control[:, :2]])
    assert np.abs(np.diff(tilts, axis=0)).max() <= 2.5 * DT_S + 1e-12


def test_acceleration_is_bounded_and_thrust_finite() -> None:
    plan = brake((30.0, -30.0, 10.0))
    accel = np.diff(plan.vel_ned_m_s, axis=0) / DT_S
    assert np.abs(accel).max() <= 3.0 + 0.3  # the slewed tilt meets the unslewed thrust
    assert np.isfinite(plan.virtual_control).all()
    assert (plan.virtual_control[:, 2] > 5.0).all()
    assert np.hypot(plan.virtual_control[:, 0], plan.virtual_control[:, 1]).max() < math.sin(0.6)


def test_the_published_path_is_the_motion_the_commands_cause() -> None:
    wind = np.array([0.5, -0.8, 0.3])
    plan = brake((3.0, -1.0, 0.5), wind=wind, tilt=(0.1, 0.05))
    pos, vel = plan.pos_ned_m[0].copy(), plan.vel_ned_m_s[0].copy()
    worst = 0.0
    for k in range(STEPS):
        accel = acceleration(plan.virtual_control[k]) + wind
        pos, vel = pos + DT_S * vel + 0.5 * DT_S**2 * accel, vel + DT_S * accel
        worst = max(worst, float(np.abs(pos - plan.pos_ned_m[k + 1])[:2].max()))
    assert worst < 1e-9
    # vertically the path ignores that a tilt still on its way changes the lift: centimetres
    np.testing.assert_allclose(vel[2], plan.vel_ned_m_s[-1, 2], atol=0.1)


def test_returns_to_the_place_to_hold_and_stays() -> None:
    plan = brake((1.0, 0.0, 0.0), at=np.array([0.0, 0.0, -5.0]))
    assert math.dist(plan.pos_ned_m[-1], (0.0, 0.0, -5.0)) < 0.03
    assert plan.pos_ned_m[:, 0].max() < 0.5


@pytest.mark.parametrize("wind", [(1.5, 0.0, 0.0), (-0.5, 2.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_known_wind_is_compensated(wind: tuple[float, ...]) -> None:
    plan = brake((0.0, 0.0, 0.0), at=np.array([0.0, 0.0, -5.0]), wind=np.array(wind))
    np.testing.assert_allclose(acceleration(plan.virtual_control[-1]), -np.array(wind), atol=0.02)
    assert np.abs(plan.pos_ned_m - [0.0, 0.0, -5.0]).max() < 0.15


def test_at_rest_on_its_place_nothing_moves() -> None:
    plan = brake((0.0, 0.0, 0.0), at=np.array([0.0, 0.0, -5.0]))
    np.testing.assert_allclose(plan.pos_ned_m, np.tile([0.0, 0.0, -5.0], (STEPS + 1, 1)))
    np.testing.assert_allclose(plan.virtual_control, np.tile([0.0, 0.0, 9.81], (STEPS, 1)))
    assert (plan.t0_us, plan.dt_us) == (1_000_000, DT_US)


# -- a vehicle whose attitude lags ------------------------------------------------------------------------------------

LAG = Lag(9.5, 1.0)  # of the measured autopilot
SLOW = Lag(4.0, 0.8)


def flown(
    believed: Lag | None, true: Lag, vel: tuple[float, ...], at: Array | None, seconds: float
) -> tuple[Array, Array]:
    """Return positions, velocities (T, 3) of a lagging vehicle that flies the first command of each tick's plan."""
    pos, v, tilt, rate, commanded = np.zeros(3), np.array(vel), np.zeros(2), np.zeros(2), np.zeros(2)
    path, speeds = [], []
    for _ in range(round(seconds / DT_S)):
        begin = Start(
            t_us=0,
            pos_ned_m=pos,
            vel_ned_m_s=v,
            cos_tilt=1.0,
            virtual_control=np.array([*commanded, 9.81]),
            tilt=tilt,
            tilt_rate_1_s=rate,
        )
        plan = brake_and_hold_plan(begin, at, NO_WIND, believed, drag_1_s=0.0, dt_us=DT_US, steps=2)
        virtual_control = plan.virtual_control[0]
        ends = [true.advance(float(tilt[i]), float(rate[i]), float(virtual_control[i]), DT_S) for i in (0, 1)]
        tilt, rate = np.array([e[0] for e in ends]), np.array([e[1] for e in ends])
        accel = acceleration(np.array([ends[0][2] / DT_S, ends[1][2] / DT_S, virtual_control[2]]))
        pos, v, commanded = pos + DT_S * v + 0.5 * DT_S**2 * accel, v + DT_S * accel, virtual_control[:2]
        path.append(pos)
        speeds.append(v)
    return np.array(path), np.array(speeds)


@pytest.mark.parametrize("lag", [LAG, SLOW])
def test_a_lagging_vehicle_comes_to_rest_and_does_not_swing(lag: Lag) -> None:
    _, speeds = flown(lag, lag, (3.0, 0.0, 0.0), None, 8.0)
    assert np.abs(speeds[-50:]).max() < 0.02
    assert speeds[:, 0].min() > -0.3
    held, _ = flown(lag, lag, (2.0, 0.0, 0.0), np.zeros(3), 14.0)
    assert np.abs(held[-50:, :2]).max() < 0.05


def test_the_damping_for_a_vehicle_without_lag_would_swing_a_slow_one() -> None:
    """Negative control of the test above."""
    _, speeds = flown(None, SLOW, (3.0, 0.0, 0.0), None, 8.0)
    assert speeds[:, 0].min() < -0.5


@pytest.mark.parametrize("drag_1_s", [0.0, 0.8])
def test_the_published_path_is_the_one_a_lagging_vehicle_flies(drag_1_s: float) -> None:
    begin = Start(
        t_us=0,
        pos_ned_m=np.zeros(3),
        vel_ned_m_s=np.array([2.0, -1.0, 0.0]),
        cos_tilt=1.0,
        virtual_control=np.array([0.1, 0.0, 9.81]),
        tilt=np.array([0.1, 0.0]),
    )
    plan = brake_and_hold_plan(begin, None, NO_WIND, LAG, drag_1_s=drag_1_s, dt_us=DT_US, steps=STEPS)
    pos, vel, tilt, rate = np.zeros(3), np.array([2.0, -1.0, 0.0]), np.array([0.1, 0.0]), np.zeros(2)
    for k, virtual_control in enumerate(plan.virtual_control):
        ends = [LAG.advance(float(tilt[i]), float(rate[i]), float(virtual_control[i]), DT_S) for i in (0, 1)]
        tilt, rate = np.array([e[0] for e in ends]), np.array([e[1] for e in ends])
        accel = acceleration(np.array([ends[0][2] / DT_S, ends[1][2] / DT_S, virtual_control[2]])) - drag_1_s * vel
        pos, vel = pos + DT_S * vel + 0.5 * DT_S**2 * accel, vel + DT_S * accel
        np.testing.assert_allclose(plan.pos_ned_m[k + 1, :2], pos[:2], atol=0.02)


@pytest.mark.parametrize("tilt", [(0.85, 0.85), (-0.99, 0.0), (1.0, 1.0)])
def test_a_plan_from_any_tilt_is_finite(tilt: tuple[float, float]) -> None:
    begin = start((0.0, 0.0, 0.0), tilt=tilt)
    for lag in (None, LAG):
        wind_m_s2 = np.array([8.0, 8.0, 0.0])
        plan = brake_and_hold_plan(begin, None, wind_m_s2, lag, drag_1_s=0.5, dt_us=50_000, steps=40)
        assert all(np.isfinite(values).all() for values in (plan.pos_ned_m, plan.vel_ned_m_s, plan.virtual_control))
        assert plan.virtual_control[:, 2].max() < 9.81 / 0.29
