"""Tests of the buffer of the newest certified plan: kept, continued by braking, dropped, run out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.mpc.plan_buffer import PlanBuffer
from swarmctl.control.mpc.problem import Start
from swarmctl.core.flight_volume import FlightVolume, VolumeParams
from swarmctl.core.types import Array, Plan, PlanStatus
from tests import builders

DT_US = 100_000
STEPS = 10
BRAKE_M_S2 = 3.0
BAD = tuple(status for status in PlanStatus if status is not PlanStatus.OK)


def plan_at(t0_us: int, north_m: Array, status: PlanStatus = PlanStatus.OK) -> Plan:
    """Return a plan that moves north at height 2 m."""
    pos = np.column_stack([north_m, np.zeros(len(north_m)), np.full(len(north_m), -2.0)])
    held = np.tile([0.0, 0.0, 9.81], (len(north_m) - 1, 1))
    return Plan(
        status=status,
        t0_us=t0_us,
        dt_us=DT_US,
        pos_ned_m=pos,
        vel_ned_m_s=np.zeros_like(pos),
        virtual_control=held,
    )


def moving(t0_us: int = 0, speed_m_s: float = 2.0, begin_m: float = 0.0, status: PlanStatus = PlanStatus.OK) -> Plan:
    end_m = begin_m + STEPS * speed_m_s * DT_US * 1e-6
    return plan_at(t0_us, np.linspace(begin_m, end_m, STEPS + 1), status)


def start_at(t_us: int) -> Start:
    return builders.start(t_us=t_us, pos_ned_m=np.array([0.0, 0.0, -2.0]))


def wall(north_m: float, hard_min_distance_m: float = 0.8) -> KeepOut:
    """Something that stands at height 2 m."""
    return builders.keep_out(
        pos_ned_m=np.tile([north_m, 0.0, -2.0], (STEPS + 1, 1)),
        radius_m=hard_min_distance_m + 0.1,
        hard_min_distance_m=hard_min_distance_m,
    )


@pytest.fixture
def buffer() -> PlanBuffer:
    return PlanBuffer(0, DT_US, STEPS, BRAKE_M_S2)


def rest() -> Plan:
    """Return a plan that stays where the plan of `moving` is after one step."""
    return moving(100_000, 0.0, 0.2)


def test_the_buffer_is_empty_at_first(buffer: PlanBuffer) -> None:
    assert buffer.plan is None
    assert buffer.guess_ned_m(0) is None


@pytest.mark.parametrize("status", BAD)
def test_a_bad_plan_is_not_kept(buffer: PlanBuffer, status: PlanStatus) -> None:
    buffer.take(moving(status=status), start_at(0), [], rest)
    assert buffer.plan is None


def test_a_good_plan_is_kept_until_the_next_good_one(buffer: PlanBuffer) -> None:
    first, second = moving(), moving(100_000)
    buffer.take(first, start_at(0), [], rest)
    assert buffer.plan is first
    buffer.take(second, start_at(100_000), [], rest)
    assert buffer.plan is second


def test_a_good_plan_is_kept_whatever_is_near(buffer: PlanBuffer) -> None:
    """It has been certified before and is not checked again."""
    plan = moving()
    buffer.take(plan, start_at(0), [wall(1.5)], rest)
    assert buffer.plan is plan


@pytest.mark.parametrize("status", BAD)
def test_after_a_bad_plan_the_last_good_one_is_kept_where_it_is_free(buffer: PlanBuffer, status: PlanStatus) -> None:
    good = moving()
    buffer.take(good, start_at(0), [], rest)
    for keep_outs in ([], [wall(5.0)]):
        buffer.take(moving(100_000, status=status), start_at(100_000), keep_outs, rest)
        assert buffer.plan is good


@pytest.mark.parametrize("status", BAD)
def test_a_plan_is_dropped_when_braking_comes_less_close(buffer: PlanBuffer, status: PlanStatus) -> None:
    """The plan flies through the wall at 2 m; braking stays 1.8 m away from it."""
    buffer.take(moving(), start_at(0), [], rest)
    buffer.take(moving(100_000, status=status), start_at(100_000), [wall(2.0)], rest)
    assert buffer.plan is None
    assert buffer.guess_ned_m(100_000) is None


@pytest.mark.parametrize(("braking_to_m", "kept"), [(0.85, True), (0.54, True), (0.53, False), (0.1, False)])
def test_of_two_that_come_too_close_the_less_close_is_flown(
    buffer: PlanBuffer, braking_to_m: float, kept: bool
) -> None:
    """The plan ends at 0.5 m and is at 0.535 m a step later, closer than 0.8 m to what stands at 1 m."""
    good = moving(speed_m_s=0.5)
    buffer.take(good, start_at(0), [], rest)
    braking = plan_at(100_000, np.linspace(0.05, braking_to_m, STEPS + 1))
    bad = moving(100_000, status=PlanStatus.NOT_CERTIFIED)
    buffer.take(bad, start_at(100_000), [wall(1.0)], lambda: braking)
    assert (buffer.plan is good) is kept


def test_a_plan_is_kept_when_braking_comes_just_as_close(buffer: PlanBuffer) -> None:
    good = moving(speed_m_s=0.5)
    buffer.take(good, start_at(0), [], rest)
    same = plan_at(100_000, buffer.positions_ned_m(good, 100_000)[:, 0])
    bad = moving(100_000, status=PlanStatus.NOT_CERTIFIED)
    buffer.take(bad, start_at(100_000), [wall(1.0)], lambda: same)
    assert buffer.plan is good


def test_the_flown_part_of_a_plan_is_not_checked(buffer: PlanBuffer) -> None:
    """The wall stands where the plan began one second before."""
    good = moving(speed_m_s=2.0)
    buffer.take(good, start_at(0), [], rest)
    buffer.take(moving(900_000, status=PlanStatus.RESIDUAL), start_at(900_000), [wall(0.0)], rest)
    assert buffer.plan is good


def test_the_guess_is_the_plan_at_its_own_times(buffer: PlanBuffer) -> None:
    good = moving()
    buffer.take(good, start_at(0), [], rest)
    guess = buffer.guess_ned_m(0)
    assert guess is not None
    np.testing.assert_allclose(guess, good.pos_ned_m)


def test_positions_between_points_are_interpolated_and_beyond_the_end_braked(buffer: PlanBuffer) -> None:
    # 2 m/s at the end (2 m at 1 s), brake 3 m/s2: 2 t - 1.5 t^2, stops 2/3 s later 2/3 m on
    braked = [2.0 + 2.0 * t - 1.5 * t * t for t in (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65)] + [2.0 + 2.0 / 3.0]
    positions = buffer.positions_ned_m(moving(), 750_000)
    np.testing.assert_allclose(positions[:, 0], [1.5, 1.7, 1.9, *braked], atol=1e-12)
    np.testing.assert_allclose(positions[:, 1:], np.tile([0.0, -2.0], (STEPS + 1, 1)))


@pytest.mark.parametrize(("t_us", "there"), [(999_999, True), (1_000_000, False), (5_000_000, False)])
def test_the_guess_is_none_once_the_plan_has_run_out(buffer: PlanBuffer, t_us: int, there: bool) -> None:
    good = moving()
    buffer.take(good, start_at(0), [], rest)
    assert (buffer.guess_ned_m(t_us) is not None) is there
    assert buffer.plan is good  # the failsafe decides how old a flown plan may be
    np.testing.assert_allclose(buffer.positions_ned_m(good, t_us)[-1, 0], 2.0 + 2.0 / 3.0, atol=1e-9)


# -- a refused plan that comes less close than all else ----------------------------------------------------------------

BLOWN_CLOSE = wall(1.0)  # the plan before, which ends at 0.5 m, and braking at 0.45 m come too close to it
OPENS = np.append([0.3, 0.36], np.linspace(0.36, 0.1, STEPS - 1))  # comes closer before it opens


def after_a_refused_plan(
    buffer: PlanBuffer,
    status: PlanStatus = PlanStatus.NOT_CERTIFIED,
    *,
    kept_m_s: float = 0.5,
    by_own: bool = False,
) -> bool:
    """Return whether the refused plan is flown."""
    buffer.take(moving(speed_m_s=kept_m_s), start_at(0), [], rest)
    refused = replace(plan_at(100_000, OPENS, status), by_own=by_own)
    buffer.take(refused, start_at(100_000), [BLOWN_CLOSE], lambda: plan_at(100_000, np.linspace(0.3, 0.45, STEPS + 1)))
    return buffer.plan is refused


@pytest.mark.parametrize("status", BAD)
def test_a_plan_refused_for_its_distances_is_flown_where_it_comes_least_close(
    buffer: PlanBuffer, status: PlanStatus
) -> None:
    assert after_a_refused_plan(buffer, status) is (status is PlanStatus.NOT_CERTIFIED)


def test_it_is_not_where_commitments_are_flown_nor_out_of_the_volume() -> None:
    committed = PlanBuffer(0, DT_US, STEPS, BRAKE_M_S2, takes_refused=False)
    assert not after_a_refused_plan(committed)
    corners = ((0.25, -9.0), (9.0, -9.0), (9.0, 9.0), (0.25, 9.0))
    north = FlightVolume(VolumeParams(corners_ne_m=corners, floor_z_m=0.0, ceiling_z_m=-9.0))
    assert not after_a_refused_plan(PlanBuffer(0, DT_US, STEPS, BRAKE_M_S2, volume=north))


def test_it_is_not_where_the_plan_before_comes_less_close_nor_of_a_controller_of_somebody_else(
    buffer: PlanBuffer,
) -> None:
    assert not after_a_refused_plan(buffer, kept_m_s=0.25)
    assert not after_a_refused_plan(buffer, by_own=True)
