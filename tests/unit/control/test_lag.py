"""The attitude lag agrees with closed forms, with a fine integration, and with the MPC's prediction."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.lag import Lag, lag_response
from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, Axis, Horizon, Penalties
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.core.types import Array

LAGS = [Lag(9.5, 1.0), Lag(9.5, 0.5), Lag(25.0, 1.8)]
DT_S = 0.05


def finely(lag: Lag, tilt: float, rate: float, command: float, t_s: float) -> tuple[float, float, float]:
    """Classic Runge-Kutta in 0.1 ms steps."""

    def slope(y: Array) -> Array:
        w = lag.natural_rad_s
        return np.array([y[1], w * w * (command - y[0]) - 2.0 * lag.damping * w * y[1], y[0]])

    y, h = np.array([tilt, rate, 0.0]), 1e-4
    for _ in range(round(t_s / h)):
        k1 = slope(y)
        k2 = slope(y + 0.5 * h * k1)
        k3 = slope(y + 0.5 * h * k2)
        k4 = slope(y + h * k3)
        y = y + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    return float(y[0]), float(y[1]), float(y[2])


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("t_s", [0.001, 0.02, 0.3])
def test_it_moves_as_its_differential_equation(lag: Lag, t_s: float) -> None:
    np.testing.assert_allclose(lag.advance(0.1, -0.7, 0.3, t_s), finely(lag, 0.1, -0.7, 0.3, t_s), atol=1e-9)


def test_a_step_of_the_measured_autopilot_is_met() -> None:
    """10 deg of roll behind 80 ms of dead time: 63 % at 0.30 to 0.32 s, 90 % at 0.46 to 0.51 s, no overshoot."""
    lag, t_s = Lag(9.5, 1.0), np.arange(0, 1.0, 0.001)
    tilt = np.array([lag.advance(0.0, 0.0, 1.0, float(t))[0] for t in t_s])
    assert t_s[np.argmax(tilt > 0.632)] + 0.08 == pytest.approx(0.31, abs=0.02)
    assert t_s[np.argmax(tilt > 0.9)] + 0.08 == pytest.approx(0.485, abs=0.025)
    assert tilt.max() <= 1.0


def test_a_ramp_is_followed_by_its_delay() -> None:
    lag, tilt, rate = Lag(9.5, 1.2), 0.0, 0.0
    for k in range(4000):
        tilt, rate, _ = lag.advance(tilt, rate, 0.5 * k * 1e-3, 1e-3)
    assert 0.5 * 4.0 - tilt == pytest.approx(0.5 * lag.ramp_delay_s, abs=1e-3)


@pytest.mark.parametrize("lag", LAGS)
def test_means_are_those_of_any_commands_from_any_start(lag: Lag) -> None:
    rng = np.random.default_rng(4)
    commands, tilt, rate = rng.normal(size=12), 0.3, -1.5
    response = lag_response(lag, DT_S, 12)
    means = response.of_command @ commands + response.of_tilt * tilt + response.of_rate_s * rate
    for k, command in enumerate(commands):
        tilt, rate, integral = finely(lag, tilt, rate, float(command), DT_S)
        assert means[k] == pytest.approx(integral / DT_S, abs=1e-8)


def test_without_a_lag_the_command_acts_at_once() -> None:
    response = lag_response(None, DT_S, 5)
    np.testing.assert_array_equal(response.of_command, np.eye(5))
    assert not response.of_tilt.any() and not response.of_rate_s.any()


def axis(lag: Lag | None) -> Axis:
    return Axis(
        q_pos=1.5,
        q_vel=0.5,
        r=0.01,
        u_min=-0.5,
        u_max=0.5,
        du_max=0.1,
        u_rest=0.0,
        gain_m_s2=9.81,
        terminal="none",
        lag=lag,
    )


def planner(lag: Lag | None, drag_1_s: float) -> CondensedMpc:
    horizon = Horizon(control=8, prediction=30, dt_s=DT_S, euler=False, drag_1_s=drag_1_s)
    return CondensedMpc((axis(lag),), horizon, 0, 1.0, penalties=Penalties(), qp=QpParams(), stopwatch_ns=lambda: 0)


@pytest.mark.parametrize("drag_1_s", [0.0, 1.0])
@pytest.mark.parametrize("lag", [None, LAGS[0]])
def test_the_plan_is_the_motion_of_a_body_with_lag_and_drag(lag: Lag | None, drag_1_s: float) -> None:
    """To within what a mean acceleration per step leaves out."""
    one, steps = np.ones(1), np.ones((30, 1))
    asked = AxesProblem(
        pos_m=0.4 * one,
        vel_m_s=-0.8 * one,
        u_prev=0.1 * one,
        gain_m_s2=-9.81 * steps,
        drift_m_s2=0.6 * one,
        ref_pos_m=2.0 * steps,
        ref_vel_m_s=0.0 * steps,
        realised=-0.05 * one,
        realised_1_s=0.4 * one,
    )
    plan = planner(lag, drag_1_s).solve(asked)
    assert plan.solved and np.ptp(plan.u) > 0.1
    pos, vel, tilt, rate, h = 0.4, -0.8, -0.05, 0.4, 1e-3
    for k in range(30):
        for _ in range(round(DT_S / h)):
            command, acts = float(plan.u[k, 0]), float(plan.u[k, 0])
            if lag is not None:
                tilt, rate, integral = lag.advance(tilt, rate, command, h)
                acts = integral / h
            accel = -9.81 * acts + 0.6 - drag_1_s * vel
            pos, vel = pos + h * vel + 0.5 * h * h * accel, vel + h * accel
        assert plan.pos_m[k, 0] == pytest.approx(pos, abs=4e-3)
        assert plan.vel_m_s[k, 0] == pytest.approx(vel, abs=4e-3)


def test_a_lag_left_out_of_the_prediction_is_seen() -> None:
    """The control of the test above: the same commands, without the lag, end somewhere else."""
    one, steps = np.ones(1), np.ones((30, 1))
    asked = AxesProblem(
        pos_m=0.0 * one,
        vel_m_s=0.0 * one,
        u_prev=0.0 * one,
        gain_m_s2=-9.81 * steps,
        drift_m_s2=0.0 * one,
        ref_pos_m=2.0 * steps,
        ref_vel_m_s=0.0 * steps,
    )
    with_lag, without = planner(LAGS[0], 0.0), planner(None, 0.0)
    plan = with_lag.solve(asked)
    pos, _ = without.prediction.motion(np.zeros(1), np.zeros(1), -9.81 * plan.u)
    assert abs(float(pos[-1, 0] - plan.pos_m[-1, 0])) > 0.3


def test_rows_begin_where_moves_behind_the_lag_can_matter() -> None:
    without, with_lag = (planner(lag, 0.0).prediction.first_row() * DT_S for lag in (None, LAGS[0]))
    assert 0.10 <= without <= 0.20
    assert 0.30 <= with_lag <= 0.45  # with 80 ms of dead time before it: about 0.4 s
    assert with_lag - without == pytest.approx(LAGS[0].ramp_delay_s, abs=DT_S)


def test_drag_slows_down_as_it_should() -> None:
    horizon = Horizon(control=2, prediction=20, dt_s=DT_S, euler=False, drag_1_s=0.7)
    gone_s, left = horizon.of_velocity_s()
    assert left[-1] == pytest.approx(math.exp(-0.7))
    assert gone_s[-1] == pytest.approx((1 - math.exp(-0.7)) / 0.7)
    pos, vel = (response @ np.ones(20) for response in horizon.of_acceleration())
    assert vel[-1] == pytest.approx((1 - math.exp(-0.7)) / 0.7)
    assert pos[-1] == pytest.approx((1.0 - (1 - math.exp(-0.7)) / 0.7) / 0.7)
