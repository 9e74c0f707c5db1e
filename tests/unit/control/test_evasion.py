"""Trajectories that are planned just after a commitment was replaced: the vehicle goes on as it moves."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.swarm_mpc import MpcParams
from swarmctl.core.trajectory import Trajectory, stopping
from swarmctl.core.types import Array
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
