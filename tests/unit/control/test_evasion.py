"""Trajectories that are planned just after a commitment was replaced: the vehicle goes on as it moves."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.collision.separation import SeparationParams, keep_out_of_obstacle, keep_out_of_peer
from swarmctl.control.commit.commit_params import CommitParams, interpolation_margin_m
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.trajectory import Trajectory, ending_at_rest, resting, stopping
from swarmctl.core.types import Array, PredictedPath
from tests import builders

UTC_US = 1_700_000_000_000_000
HEIGHT_M, SPEED_M_S = 3.8, 2.3  # of six real PX4s on a circle


def planned_after(since_us: int) -> Trajectory:
    """Return what an agent proposes so long after it has committed to braking, at 2.3 m/s, amid its mission."""
    plans = TrajectoryPlanner(
        0,
        CommitParams(),
        MpcParams(u_max=0.75, dt_s=0.05),
        VehicleModelParams(drag_1_s=1.0, tilt_max_rad=0.85),
        SeparationParams(),
        max_keep_outs=1,
        stopwatch_ns=lambda: 0,
    )
    begin, vel = np.array([0.0, 0.0, -HEIGHT_M]), np.array([SPEED_M_S, 0.0, 0.0])
    braking = stopping(begin, vel, UTC_US, 100_000, brake_m_s2=1.5)

    def goes_on(t_s: Array) -> tuple[Array, Array]:
        return begin + t_s[:, None] * vel, np.tile(vel, (len(t_s), 1))

    now_us = UTC_US + since_us
    found = plans.proposal(
        braking, builders.situation(utc_us=now_us, begin_us=now_us, desired=DesiredReference(goes_on))
    )
    assert found is not None
    return found


@pytest.mark.parametrize("since_us", [0, 20_000, 40_000])
def test_a_plan_just_after_an_evasion_keeps_its_height_and_speed(since_us: int) -> None:
    """A vehicle that is taken for one at full tilt is planned to fall, and to race ahead."""
    found = planned_after(since_us)
    assert np.abs(found.pos_ned_m[:, 2] + HEIGHT_M).max() < 0.1
    assert np.linalg.norm(found.vel_ned_m_s, axis=1).max() < SPEED_M_S + 0.5


def test_negative_control_taken_for_at_rest_before_it_falls_and_races(monkeypatch: pytest.MonkeyPatch) -> None:
    def from_rest(self: Trajectory, t_utc_us: float) -> Array:
        vel = self.sample(np.array([t_utc_us - 50_000, t_utc_us + 50_000]))[1]
        return np.asarray((vel[1] - vel[0]) / 0.1)

    monkeypatch.setattr(Trajectory, "acceleration", from_rest)
    found = planned_after(20_000)
    assert float(found.pos_ned_m[:, 2].max()) > 1.0 - HEIGHT_M
    assert np.linalg.norm(found.vel_ned_m_s, axis=1).max() > SPEED_M_S + 1.0


def planner(separation: SeparationParams, params: CommitParams | None = None) -> TrajectoryPlanner:
    """Return a planner of the thesis' vehicles."""
    given = (params or CommitParams(), MpcParams(), VehicleModelParams(), separation)
    return TrajectoryPlanner(0, *given, max_keep_outs=2, stopwatch_ns=lambda: 0)


@pytest.mark.parametrize("speed_m_s", [2.0, 4.0, 6.0, 10.0])
@pytest.mark.parametrize("away_m_s", [0.0, 0.5])
def test_a_proposal_keeps_clear_of_obstacles_until_it_is_at_rest_however_fast_it_is(
    speed_m_s: float, away_m_s: float
) -> None:
    """From 6 m/s it is at rest after 6 s, 2 s after the end of the grid on which obstacles are told."""
    separation = SeparationParams(mode="guaranteed")
    plans, vel, here = planner(separation), np.array([speed_m_s, 0.0, 0.0]), np.array([0.0, 0.0, -5.0])
    cruise = here + np.arange(11)[:, None] * 0.1 * vel
    committed = ending_at_rest(UTC_US, 100_000, cruise, np.tile(vel, (11, 1)), brake_m_s2=1.5)
    accepted, begin_us = 0, UTC_US + 60_000

    def goes_on(t_s: Array) -> tuple[Array, Array]:
        return here + t_s[:, None] * vel, np.tile(vel, (len(t_s), 1))

    for north_m in np.arange(4.0, 60.0, 2.0):
        there = Obstacle(
            center_ned_m=(float(north_m), 0.0, -5.0),
            radius_m=1.0,
            keep_out_m=1.75,
            visibility_m=100.0,
            vel_ned_m_s=(away_m_s, 0.0, 0.0),
        )
        keep_out = keep_out_of_obstacle(there, plans.dt_us, plans.steps, separation)
        now = builders.situation(
            utc_us=UTC_US, begin_us=begin_us, desired=DesiredReference(goes_on), others=KeepOuts([keep_out])
        )
        found = plans.proposal(committed, now)
        if found is None:
            continue
        accepted += 1
        t_us = np.arange(begin_us, found.end_utc_us + 10_000, 10_000)
        apart = found.sample(t_us)[0] - there.center_after(1e-6 * (t_us - begin_us)[:, None])
        assert np.linalg.norm(apart, axis=1).min() >= keep_out.hard_min_distance_m - 0.01
    assert accepted >= 5


@pytest.mark.parametrize(("downwash", "higher_m"), [(1.0, 0.0), (1.0, 0.5), (2.0, 0.0), (2.0, 0.8)])
def test_a_climb_goes_over_what_comes_however_high_that_is(downwash: float, higher_m: float) -> None:
    separation = SeparationParams(mode="guaranteed", downwash=downwash)
    plans, here = planner(separation), np.array([0.0, 0.0, -5.0])
    coming = np.array([4.0, 0.0, -higher_m - 5.0]) - np.arange(41)[:, None] * [0.1, 0.0, 0.0]
    path = PredictedPath(agent=1, boot_id=0, seq=0, t0_utc_us=UTC_US, dt_us=100_000, margin_m=0.0, pos_ned_m=coming)
    keep_out = keep_out_of_peer(path, UTC_US, plans.dt_us, plans.steps, params=separation)

    def stays(t_s: Array) -> tuple[Array, Array]:
        return np.tile(here, (len(t_s), 1)), np.zeros((len(t_s), 3))

    now = builders.situation(
        utc_us=UTC_US, begin_us=UTC_US, desired=DesiredReference(stays), others=KeepOuts([keep_out])
    )
    *_, climb = plans._evasive_candidates(resting(here, UTC_US, 100_000), now)
    assert -5.0 - climb.pos_ned_m[-1, 2] == pytest.approx(higher_m + 0.9 * downwash, abs=0.02)
    assert plans.is_clear(climb, now)


@pytest.mark.parametrize("dt_s", [0.05, 0.1, 0.2, 0.5])
def test_what_proposals_keep_on_top_covers_what_cubics_leave_their_chords_by(dt_s: float) -> None:
    """Two come at each other and turn back between two points, where the lines between these are farther apart."""
    separation, params = SeparationParams(mode="guaranteed"), CommitParams(dt_s=dt_s)
    plans, dt_us, accel_m_s2 = planner(separation, params), round(1e6 * dt_s), 1.5
    spare_m = interpolation_margin_m(MpcParams(), params, VehicleModelParams())

    def turning_back(nearest_m: float, side: float) -> Trajectory:
        since_s = dt_s * (np.arange(round(4.0 / dt_s) + 1) - round(2.0 / dt_s) - 0.5)
        pos, vel = np.zeros((len(since_s), 3)), np.zeros((len(since_s), 3))
        pos[:, 0] = side * (0.5 * nearest_m + 0.5 * accel_m_s2 * since_s**2)
        vel[:, 0] = side * accel_m_s2 * since_s
        return ending_at_rest(UTC_US, dt_us, pos, vel, brake_m_s2=accel_m_s2)

    def nearest_m(apart_m: float) -> float:
        t_us = UTC_US + np.arange(0, 4_000_000, 5_000)
        one, other = (turning_back(apart_m, side).sample(t_us)[0] for side in (-1.0, 1.0))
        return float(np.linalg.norm(one - other, axis=1).min())

    apart_m = next(
        gap_m
        for gap_m in np.arange(0.5, 1.5, 0.001)
        if not plans.conflicts(turning_back(gap_m, -1.0), UTC_US, [turning_back(gap_m, 1.0)], spare_m)
    )
    assert nearest_m(apart_m) >= separation.budget.committed_m
    assert (spare_m > 0.01) == (dt_s > 0.1), "the default flies as before"
