"""What the safety filter takes a vehicle to do: how it moves until a command takes effect, and what pushes it then."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.collision.barrier import Barrier, BarrierParams, Body
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array
from tests import builders

PARAMS = BarrierParams(slew_1_s=50.0)  # not bounded by how fast it may tilt
HOVER, NO_WIND = np.array([0.0, 0.0, GRAVITY_M_S2]), np.zeros(3)
APART_M, DT_S = 0.53, 0.02


def accel_ned_m_s2(command: Array, pushed_ned_m_s2: Array, vel_ned_m_s: Array, drag_1_s: float) -> Array:
    """Return the acceleration (3,) of a vehicle that flies a command (3,), by what acts on it."""
    up = np.array([*command[:2], math.sqrt(1.0 - command[:2] @ command[:2])])
    lift: Array = command[2] * up
    return np.array([0.0, 0.0, GRAVITY_M_S2]) + pushed_ned_m_s2 - drag_1_s * vel_ned_m_s - lift


def moved(start: Start, model: VehicleModelParams, pushed_ned_m_s2: Array, for_s: float) -> tuple[Array, Array]:
    """Return position and velocity (3,) after a held command, integrated in small steps."""
    steps = 20_000
    dt_s, w, zeta = for_s / steps, model.attitude_rad_s, model.attitude_damping
    pos, vel = start.pos_ned_m.astype(float), start.vel_ned_m_s.astype(float)
    tilt, rate, thrust = np.array(start.tilt, float), np.array(start.tilt_rate_1_s, float), start.virtual_control[2]
    for _ in range(steps):
        lift = thrust * np.array([*tilt, start.cos_tilt])
        vel = vel + dt_s * (np.array([0.0, 0.0, GRAVITY_M_S2]) + pushed_ned_m_s2 - model.drag_1_s * vel - lift)
        pos = pos + dt_s * vel
        rate = rate + dt_s * (w**2 * (start.virtual_control[:2] - tilt) - 2.0 * zeta * w * rate)
        tilt = tilt + dt_s * rate
    return pos, vel


@pytest.mark.parametrize("pushed", [(0.0, 0.0, 0.0), (0.8, -0.4, 0.6)], ids=["calm", "pushed"])
def test_a_vehicle_flies_on_under_the_held_command_until_the_next_one_takes_effect(pushed: tuple[float, ...]) -> None:
    """By its tilt, the rate of that, the lag, the held command, its thrust, drag and what pushes it."""
    model = VehicleModelParams(attitude_rad_s=9.0, attitude_damping=0.9, drag_1_s=0.3)
    barrier = Barrier(PARAMS, model, DT_S)
    assert barrier.ahead_s == pytest.approx(0.2)
    begin = replace(
        builders.start(
            pos_ned_m=np.array([1.0, 2.0, -3.0]),
            vel_ned_m_s=np.array([2.0, -1.0, 0.5]),
            cos_tilt=0.9,
            virtual_control=np.array([0.3, -0.2, 11.0]),
        ),
        tilt=np.array([-0.25, 0.15]),
        tilt_rate_1_s=np.array([1.2, -0.8]),
    )
    pos, vel = barrier._predicted_state(begin, np.array(pushed))
    pos_m, vel_m_s = moved(begin, model, np.array(pushed), barrier.ahead_s)
    np.testing.assert_allclose(pos, pos_m, atol=5e-4)
    np.testing.assert_allclose(vel, vel_m_s, atol=5e-3)


PUSHES = [(0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.6, 0.0), (0.0, 0.0, 0.6), (0.0, 0.0, -0.6)]


@pytest.mark.parametrize("away", [(1.0, 0.0, 0.0), (0.6, 0.8, 0.0), (0.6, 0.0, 0.8)], ids=["north", "aside", "below"])
@pytest.mark.parametrize("drag_1_s", [0.0, 0.2])
@pytest.mark.parametrize("pushed", PUSHES, ids=str)
def test_as_much_is_braked_whatever_pushes_a_vehicle(
    pushed: tuple[float, ...], drag_1_s: float, away: tuple[float, ...]
) -> None:
    """Wind and drag change the thrust that braking takes, and not how much has to be braked."""
    direction, vel = np.array(away), 1.2 * np.array(away)
    here = builders.start(pos_ned_m=np.zeros(3), vel_ned_m_s=vel, virtual_control=HOVER)
    other = Body(
        pos_ned_m=tuple((1.3 * direction).tolist()),
        vel_ned_m_s=tuple((-vel).tolist()),
        apart_m=APART_M,
        responsibility_01=0.5,
    )

    def braked_m_s2(push: Array, drag: float) -> float:
        barrier = Barrier(PARAMS, VehicleModelParams(drag_1_s=drag), DT_S)
        found = barrier.filtered(HOVER, here, push, 0.5, bodies=[other])
        assert found is not None
        return float(-direction @ accel_ned_m_s2(found, push, vel, drag))

    calm = braked_m_s2(NO_WIND, 0.0)
    assert 1.0 < calm < 4.0
    assert braked_m_s2(np.array(pushed), drag_1_s) == pytest.approx(calm, abs=0.02)


def test_the_filter_comes_in_without_a_jump() -> None:
    """It changes what is asked for from where that is too much on, by as much as it is too much."""
    barrier = Barrier(PARAMS, VehicleModelParams(), DT_S)
    here = builders.start(pos_ned_m=np.zeros(3), virtual_control=HOVER)
    other = Body(pos_ned_m=(0.6, 0.0, 0.0), vel_ned_m_s=(0.0, 0.0, 0.0), apart_m=APART_M, responsibility_01=0.5)
    changes = []
    for ux in np.linspace(0.0, -0.5, 201):  # ever more towards it
        wanted = np.array([ux, 0.0, GRAVITY_M_S2])
        found = barrier.filtered(wanted, here, NO_WIND, 0.5, bodies=[other])
        changes.append(0.0 if found is None else float(found[0] - ux))
    assert changes[0] == 0.0 and changes[-1] > 0.02
    assert np.diff(changes).max() < 0.005 and np.diff(changes).min() > -0.001


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_is_left_for_others_to_refuse(place: int, bad: float) -> None:
    """What was made of it could pass their checks."""
    barrier = Barrier(PARAMS, VehicleModelParams(), DT_S)
    here = builders.start(pos_ned_m=np.zeros(3), virtual_control=HOVER)
    other = Body(pos_ned_m=(0.4, 0.0, 0.0), vel_ned_m_s=(-2.0, 0.0, 0.0), apart_m=APART_M, responsibility_01=0.5)
    wanted = HOVER.copy()
    wanted[place] = bad
    assert barrier.filtered(wanted, here, NO_WIND, 0.5, bodies=[other]) is None
    np.testing.assert_array_equal(barrier.eased(wanted, here), wanted)


def approach(pos: Array, vel: Array, heights_01: float, brake_m_s2: float) -> float:
    """Return h of two that are `pos` apart and move at `vel` (3,) to each other, as the module's text defines it."""
    scale = np.array([1.0, 1.0, heights_01])
    distance = float(np.linalg.norm(scale * pos))
    rate = float((scale * pos) @ (scale * vel)) / distance
    left = distance + (PARAMS.react_s * rate if rate < 0.0 else 0.0) - APART_M
    k = PARAMS.near_1_s
    if left > brake_m_s2 / k**2:
        return rate + math.sqrt(2.0 * brake_m_s2 * (left - 0.5 * brake_m_s2 / k**2))
    return rate + k * left


@pytest.mark.parametrize(
    ("place", "own_vel", "its_vel", "share", "kind"),
    [
        ((1.5, 0.0, 0.0), (1.5, 0.0, 0.0), (-1.2, 0.0, 0.0), 0.5, "peer"),
        ((1.3, 0.2, 0.1), (1.4, 1.0, 0.2), (-1.2, -0.6, -0.1), 0.5, "peer"),
        ((0.7, 0.0, 0.0), (0.5, 0.0, 0.0), (-0.4, 0.0, 0.0), 0.5, "peer"),
        ((1.2, 0.0, 0.0), (1.2, 0.0, 0.0), (-0.7, 0.0, 0.0), 1.0, "peer"),
        ((0.65, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, "peer"),
        ((0.48, 0.0, 0.0), (-0.1, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, "peer"),
        ((1.3, 0.0, 0.6), (1.4, 0.0, 0.3), (-1.3, 0.0, -0.3), 0.5, "downwash"),
        ((1.2, 0.0, 5.0), (1.2, 0.0, 0.8), (-0.7, 0.0, -2.0), 1.0, "column"),
        ((1.2, 0.0, 0.4), (1.2, 0.0, 0.3), (-0.8, 0.0, -0.2), 1.0, "solid"),
    ],
    ids=["far", "past", "near", "alone", "alone, near", "opening", "downwash", "a column", "a solid one in downwash"],
)
def test_the_approach_is_slowed_as_the_barrier_says(
    place: tuple[float, ...], own_vel: tuple[float, ...], its_vel: tuple[float, ...], share: float, kind: str
) -> None:
    """With its share of both braking, h' = -gain h; derived in time, and from no formula of the filter's."""
    barrier = Barrier(PARAMS, VehicleModelParams(), DT_S, downwash=2.0 if kind in ("downwash", "solid") else 1.0)
    heights_01 = {"downwash": 0.5, "column": 0.0}.get(kind, 1.0)
    other = Body(
        pos_ned_m=place,
        vel_ned_m_s=its_vel,
        apart_m=APART_M,
        responsibility_01=share,
        column=kind == "column",
        solid=kind in ("column", "solid"),
    )
    own = builders.start(pos_ned_m=np.zeros(3), vel_ned_m_s=np.array(own_vel), virtual_control=HOVER)
    found = barrier.filtered(HOVER, own, NO_WIND, 0.5, bodies=[other])
    assert found is not None
    accel = accel_ned_m_s2(found, NO_WIND, np.array(own_vel), 0.0) / share  # the other one does the rest
    pos, vel = -np.array(place), np.array(own_vel) - np.array(its_vel)

    def after(t_s: float) -> float:
        there = pos + t_s * vel + 0.5 * t_s**2 * accel
        return approach(there, vel + t_s * accel, heights_01, PARAMS.brake_m_s2 / share)

    slope = (after(1e-5) - after(-1e-5)) / 2e-5
    assert slope == pytest.approx(-PARAMS.gain_1_s * after(0.0), abs=0.02)


@pytest.mark.parametrize(("down_m", "least_01", "most_01"), [(0.6, 0.05, 0.56), (-0.6, 0.45, 1.0)])
def test_no_more_and_no_less_thrust_is_asked_for_than_the_airframe_has(
    down_m: float, least_01: float, most_01: float
) -> None:
    """One below that comes up, and one above that comes down; hovering takes half of all thrust."""
    model = VehicleModelParams(thrust_min_01=least_01, thrust_max_01=most_01)
    here = builders.start(pos_ned_m=np.zeros(3), virtual_control=HOVER)
    coming = (0.0, 0.0, -math.copysign(2.0, down_m))
    other = Body(pos_ned_m=(0.0, 0.0, down_m), vel_ned_m_s=coming, apart_m=APART_M, responsibility_01=1.0)
    found = Barrier(PARAMS, model, DT_S).filtered(HOVER, here, NO_WIND, 0.5, bodies=[other])
    assert found is not None
    lift = found[2] * math.sqrt(1.0 - found[:2] @ found[:2])
    assert lift == pytest.approx((most_01 if down_m > 0.0 else least_01) * 2.0 * GRAVITY_M_S2, abs=1e-3)
