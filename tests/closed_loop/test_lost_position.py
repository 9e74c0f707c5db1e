"""Tests of an estimator that loses its position in flight, and goes on sending what it has dead-reckoned."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent.planning.coordination import Coordination
from swarmctl.control.estimation import accuracy
from swarmctl.core.types import Landed
from swarmctl.mavlink.vehicle import autopilot
from tests.closed_loop.conftest import COARSE, Flight, Fly, closer_than
from tests.closed_loop.test_handover import COPTER

AT_S = 3.0
LANDED_M = 4.0  # from where it took off: lost 6 s, until the estimator has said so twice, and a blind descent
SEPARATION_M = 0.85
TOO_CLOSE_M = 0.6
ENDED_S = 40.0  # start 14 s, loss 3 s, braking 4 s, landing 9 s; waiting for room lasts 20 s
ALONE = (*COARSE, "swarm.agents=1", "mission.kind=hover", "mission.duration_s=40")
# It drifts towards the peer 1.2 m away, who gives way by what the estimator has told by then.
BESIDE = (
    *COARSE,
    "swarm.agents=2",
    "mission.kind=hover",
    "mission.duration_s=15",
    "start.positions_ned_m=[[0,0,-2],[-1.2,0,-2]]",
)
GUARANTEED = ("separation.mode=guaranteed",)
NOT_LANDED = ("agent.failsafe.dead_reckoning_land_s=60",)  # before its flags say that it has no position


def fly_without_gps(
    fly: Fly, scene: Sequence[str] = ALONE, lost: int = 1, until: Callable[[Lockstep], bool] | None = None
) -> Flight:
    """Fly a scene in which so many vehicles, the first ones, lose GPS at once."""

    def lose(running: Lockstep) -> None:
        for vehicle in range(lost):
            running.world.estimator.lose_gps(vehicle)

    return fly(*scene, at={AT_S: lose}, until=until)


def strayed_m(flight: Flight) -> float:
    places = flight.pos_ned_m[:, 0, :2]
    return float(np.linalg.norm(places - places[0], axis=1).max())


def test_who_has_lost_its_position_is_landed_by_its_autopilot(fly: Fly) -> None:
    flight = fly_without_gps(fly, (*ALONE, *NOT_LANDED))
    assert "position_lost" in flight.event_names(0)
    assert flight.outcomes.isdisjoint({"completed"})
    assert not flight.lockstep.world.truth_rows()["armed"].any()
    assert strayed_m(flight) < LANDED_M


def test_negative_control_a_lost_position_that_is_believed_is_followed(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(autopilot, "_LOST_REPORTS", 1_000_000)
    flight = fly_without_gps(fly, (*ALONE, *NOT_LANDED), until=Lockstep.mission_is_over)
    assert flight.outcomes == {"completed"}
    assert strayed_m(flight) > 5 * LANDED_M


@pytest.mark.parametrize("kind", [(), COPTER], ids=["px4", "arducopter"])
def test_who_has_lost_gps_lands_while_it_still_knows_where_it_is(fly: Fly, kind: Sequence[str]) -> None:
    flight = fly_without_gps(fly, (*ALONE, *kind))
    assert all(outcome.startswith("no GPS for") for outcome in flight.outcomes)
    assert not flight.lockstep.world.truth_rows()["armed"].any()
    assert strayed_m(flight) < LANDED_M


def separation_aloft_m(flight: Flight) -> float:
    """Return the least true distance of the two while both are in the air: one lands at its place later."""
    aloft = (flight.pos_ned_m[:, :, 2] < flight.pos_ned_m[0, :, 2] - 0.5).all(axis=1)
    return float(np.linalg.norm(np.diff(flight.pos_ned_m[aloft, :2], axis=1), axis=2).min())


def one_is_down(running: Lockstep) -> bool:
    """No mission is under way, and one of the two has landed: what the other one does is not judged."""
    return running.mission_is_over() and bool((running.world.truth_rows()["landed"] == Landed.ON_GROUND).any())


@pytest.mark.parametrize(
    "landing",
    [(), NOT_LANDED, COPTER, GUARANTEED, (*GUARANTEED, *NOT_LANDED)],
    ids=["lands", "goes-on", "arducopter", "guaranteed-lands", "guaranteed-goes-on"],
)
def test_peers_keep_away_from_who_drifts(fly: Fly, landing: Sequence[str]) -> None:
    flight = fly_without_gps(fly, (*BESIDE, *landing), until=one_is_down)
    assert separation_aloft_m(flight) >= SEPARATION_M
    assert "completed" in flight.outcomes


def test_negative_control_who_drifts_comes_close_to_peers_that_are_not_told(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(accuracy, "_SIGMAS", 0.0)
    flight = fly_without_gps(fly, (*BESIDE, *NOT_LANDED), until=closer_than(TOO_CLOSE_M))
    assert separation_aloft_m(flight) < TOO_CLOSE_M


def test_negative_control_commitments_are_relied_on_whose_tube_leaves_out_the_estimate(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Coordination.publish
    monkeypatch.setattr(
        Coordination, "publish", lambda self, utc_us, **given: told(self, utc_us, **given | {"unsure_m": 0.0})
    )
    flight = fly_without_gps(fly, (*BESIDE, *GUARANTEED, *NOT_LANDED), until=closer_than(TOO_CLOSE_M))
    assert separation_aloft_m(flight) < TOO_CLOSE_M


def test_all_who_have_lost_gps_land_soon_though_none_finds_room(fly: Fly) -> None:
    flight = fly_without_gps(fly, (*COARSE, "mission.duration_s=60"), lost=3)
    assert all(outcome.startswith("no GPS for") for outcome in flight.outcomes)
    assert not flight.lockstep.world.truth_rows()["armed"].any()
    assert flight.t_s[-1] < ENDED_S
    assert flight.separation_m() >= SEPARATION_M
