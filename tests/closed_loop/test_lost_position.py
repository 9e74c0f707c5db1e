"""Tests of an estimator that loses its position in flight, and goes on sending what it has dead-reckoned."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.mavlink.vehicle import autopilot
from tests.closed_loop.conftest import Flight, Fly

AT_S = 3.0
LANDED_M = 4.0  # from where it took off: lost 6 s, until the estimator has said so twice, and a blind descent


def fly_without_gps(fly: Fly) -> Flight:
    def lose(running: Lockstep) -> None:
        running.world.estimator.lose_gps(0)

    return fly("swarm.agents=1", "mission.kind=hover", "mission.duration_s=60", at={AT_S: lose})


def strayed_m(flight: Flight) -> float:
    places = flight.pos_ned_m[:, 0, :2]
    return float(np.linalg.norm(places - places[0], axis=1).max())


def test_who_has_lost_its_position_is_landed_by_its_autopilot(fly: Fly) -> None:
    flight = fly_without_gps(fly)
    assert "position_lost" in flight.event_names(0)
    assert flight.outcomes.isdisjoint({"completed"})
    assert not flight.lockstep.world.truth_rows()["armed"].any()
    assert strayed_m(flight) < LANDED_M


def test_negative_control_a_lost_position_that_is_believed_is_followed(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(autopilot, "_LOST_REPORTS", 1_000_000)
    flight = fly_without_gps(fly)
    assert flight.outcomes == {"completed"}
    assert strayed_m(flight) > 5 * LANDED_M
