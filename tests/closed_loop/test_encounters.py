"""Tests that certified plans alone, tick by tick, don't carry a vehicle on into what it is too close to already."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.mpc import attempts
from swarmctl.core.obstacle import Obstacle
from tests.closed_loop.conftest import fly_now, mission_t_s

SLOW = ("swarm.agents=1", "mission.circle.omega_rad_s=0.004", "mission.circle.climb_ned_m_s=0", "sitl.start=air")
UNFILTERED = "agent.barrier.enabled=false"
APPEARS_S, WATCHED_S = 8.0, 4.5
ENTERED_M = 0.75  # of 0.80: the obstacle appears when the vehicle is inside its hard minimum distance already


def closest_m(monkeypatch: pytest.MonkeyPatch) -> float:
    """Follow a reference at 2 cm/s towards an obstacle that appears 0.75 m ahead; only the certificate keeps clear.

    Each plan comes less than 2 cm closer over its horizon of 0.8 s.
    """
    monkeypatch.setattr(attempts, "half_spaces", lambda *_, **__: None)
    centers: list[np.ndarray] = []

    def appear(running: Lockstep) -> None:
        state = running.world.truth_rows()[0]
        reference = running.logs[0].rows[-1]["ref_pos_ned_m"][0]
        ahead = np.array([-reference[1], reference[0], 0.0]) / np.linalg.norm(reference[:2])
        centers.append(state["pos_ned_m"] + ENTERED_M * ahead)
        north_m, east_m, down_m = map(float, centers[0])
        running.set_obstacles(
            [Obstacle(center_ned_m=(north_m, east_m, down_m), radius_m=0.3, keep_out_m=0.9, visibility_m=3.0)]
        )

    flight = fly_now(
        *SLOW, UNFILTERED, at={APPEARS_S: appear}, until=lambda running: mission_t_s(running) > APPEARS_S + WATCHED_S
    )
    since = flight.t_s >= flight.t_s[-1] - WATCHED_S
    return float(np.linalg.norm(flight.pos_ned_m[since, 0] - centers[0], axis=1).min())


def test_a_vehicle_inside_a_keep_out_is_not_carried_on_by_certified_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    assert closest_m(monkeypatch) >= ENTERED_M - 0.02


def test_negative_control_measured_tick_by_tick_it_creeps_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Encounters, "noted", lambda self, keep_outs, pos_ned_m: list(keep_outs))
    assert closest_m(monkeypatch) < 0.70
