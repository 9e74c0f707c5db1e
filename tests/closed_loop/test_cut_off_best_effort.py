"""Swarms of several computers that fly in best effort, and are cut off from each other amid a meeting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent import assembly
from swarmctl.bus.bus import agent_name
from swarmctl.config import load
from swarmctl.control.collision.barrier import Barrier
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.control.phases.trajectories import Trajectories
from swarmctl.control.reference.quintic import brake_to_rest
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Array, Phase, VehicleState
from swarmctl.simulator_config import EVERY_VEHICLE, FaultParams
from tests.closed_loop.conftest import COARSE, closer_than, fly_now, mission_t_s

CUT_AT_S, CUT_S = 0.5, 5.0
SWAP = (
    *COARSE,
    "sitl.start=air",
    "swarm.agents=4",
    "start.positions_ned_m=[[3,0,0],[0,3,0],[-3,0,0],[0,-3,0]]",
    "mission.kind=swap",
    "mission.swap.travel_s=6",
    "mission.duration_s=60",
)


def hosts(*agents: tuple[int, ...]) -> str:
    listed = (f'{{name="h{i}",address="10.0.0.{i + 1}:7448",agents={list(own)}}}' for i, own in enumerate(agents))
    return f"hosts=[{','.join(listed)}]"


@dataclass(frozen=True)
class Flown:
    """What came of a flight, on true states."""

    least_m: float
    fastest_m_s: float  # when the cut ended, or 8 s after it began
    paused: tuple[bool, ...]  # who waited then
    left_m: float  # the longest way to a goal at the end


def fly(*apart: tuple[int, ...], lost: tuple[int, ...] = (), until_s: float = 16.0) -> Flown:
    """Fly a swap of hosts with these agents, whose links are all cut for a while, or of which one is lost for good."""
    flight = Lockstep(load(None, (*SWAP, hosts(*apart), "bus.relay=true")))
    least_m, is_cut = np.inf, False
    seen: tuple[float, tuple[bool, ...]] = (np.inf, ())  # speed, and who is paused
    goals_ned_m = -np.array(flight.config.starts_ned_m())
    while not mission_t_s(flight) > until_s:
        flight.step()
        t_s = mission_t_s(flight)
        if t_s >= CUT_AT_S and not is_cut:
            is_cut = True
            for agent in lost:
                flight.agents[agent] = None
                flight.hub.detach(agent_name(agent))
            if not lost:
                flight.hub.split([frozenset(map(agent_name, own)) for own in apart])
        truth = flight.world.truth_rows()
        if t_s < CUT_AT_S + CUT_S:  # until it ends
            fastest_m_s = float(np.linalg.norm(truth["vel_ned_m_s"], axis=1).max())
            living = [agent for agent in flight.agents if agent is not None]
            seen = fastest_m_s, tuple(agent._mission.interruptions.paused for agent in living)
        else:
            flight.hub.heal()
        least_m = min(least_m, float(closest_pair_m(truth["pos_ned_m"][np.newaxis])[0]))
    away_m = np.linalg.norm((truth["pos_ned_m"] - goals_ned_m)[:, :2], axis=1)
    left_m = float(max(away_m[i] for i in range(4) if i not in lost))
    return Flown(least_m, *seen, left_m)


def test_halves_that_do_not_hear_each_other_rest_until_they_do() -> None:
    flown = fly((0, 1), (2, 3))
    assert flown.least_m >= 0.8
    assert (flown.paused, flown.fastest_m_s < 0.1) == ((True,) * 4, True)
    assert flown.left_m < 0.4


def test_negative_control_halves_that_take_missing_tokens_for_deaths_come_too_close(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(assembly, "_quorum", lambda _: 1)
    assert fly((0, 1), (2, 3), until_s=7.0).least_m < 0.6


def test_a_majority_goes_on_and_keeps_clear_of_who_rests_cut_off() -> None:
    flown = fly((0,), (1, 2, 3), until_s=8.0)
    assert flown.least_m >= 0.75
    assert flown.paused == (True, False, False, False)


def test_a_majority_goes_on_without_a_host_that_is_lost() -> None:
    assert fly((0,), (1,), (2, 3), lost=(1,), until_s=6.0).paused == (False,) * 3


@pytest.mark.parametrize(("relay", "quorum"), [(True, 3), (False, 4)])
def test_without_relays_nobody_is_taken_for_dead(relay: bool, quorum: int) -> None:
    """Two hosts may each see a third one, and not each other."""
    config = load(None, (*SWAP, hosts((0, 1), (2, 3)), f"bus.relay={str(relay).lower()}"))
    assert assembly._quorum(config) == quorum
    assert assembly._quorum(load(None, SWAP)) == 1, "on one computer who has left is dead"


# -- two that swap places, when the bus carries nothing any more -------------------------------------------------------

PAIR = (*COARSE, "sitl.start=air", "swarm.agents=2", "mission.kind=swap", "mission.duration_s=30")
# 2.3 m/s each, 13 m apart: either is to stop where the other would have to be by then, if it stopped as transits do.
FAR = (*PAIR, "start.positions_ned_m=[[10,0,-2],[-10,0,-2]]", "mission.swap.travel_s=12")
FAR_CUT_S, FAR_AT_REST_S = 3.6, 8.6
# Likewise, but it is the first one alone that hears nobody: the others are a majority, and fly on.
THREE = (
    *COARSE,
    "sitl.start=air",
    "swarm.agents=3",
    "mission.kind=swap",
    "mission.duration_s=30",
    "start.positions_ned_m=[[10,0,-2],[-10,0,-2],[3,16,-2]]",
    "mission.swap.travel_s=12",
    "bus.relay=true",
    hosts((0,), (1,), (2,)),
)
THREE_CUT_S, THREE_PASSED_S = 3.8, 8.8
# They have passed each other, so that their ways home meet again.
NEAR = (
    *PAIR,
    "start.positions_ned_m=[[2,0,-2],[-2,0,-2]]",
    "mission.swap.travel_s=5",
    "agent.failsafe.window_s=1",
    "sitl.battery.capacity_mah=3000",
)
NEAR_CUT_S, NEAR_LOW_S = 4.5, 6.0
HOME_S = 5.0  # from there, for who flies at once


# Six that meet in the middle: who rests is driven from where it stopped by where others are believed to be.
SIX = (
    *COARSE,
    "sitl.start=air",
    "swarm.agents=6",
    "mission.kind=swap",
    "mission.duration_s=30",
    "start.positions_ned_m=[[3,0,-2],[1.5,2.6,-2],[-1.5,2.6,-2],[-3,0,-2],[-1.5,-2.6,-2],[1.5,-2.6,-2]]",
    "mission.swap.travel_s=6",
)
SIX_CUT_S, SIX_DEADLOCKED_S, SIX_DRIVEN_S = 2.4, 11.5, 5.5


def cut(running: Lockstep) -> None:
    running.hub.fail()


def cut_off(running: Lockstep) -> None:
    running.hub.split([frozenset([agent_name(0)]), frozenset(map(agent_name, (1, 2)))])


def wear(running: Lockstep) -> None:
    """Leave so little charge to all vehicles that they fly back."""
    running.world.faults.begin(FaultParams(kind="battery", vehicle=EVERY_VEHICLE, value=0.15), running.clock.now_us())


def past(t_s: float) -> Callable[[Lockstep], bool]:
    return lambda running: mission_t_s(running) >= t_s


def returning_for(seconds: float) -> Callable[[Lockstep], bool]:
    """Return what ends a flight so long after all have left their mission."""
    began_us: list[int] = []

    def ends(running: Lockstep) -> bool:
        if running.mission_is_over() and not began_us:
            began_us.append(running.clock.now_us())
        return bool(began_us) and running.clock.now_us() >= began_us[0] + round(seconds * 1e6)

    return ends


def softly(now: Trajectories, now_us: int, state: VehicleState, **_: object) -> None:
    """Brake to rest as softly in a pause as transits do."""
    now._begin(brake_to_rest(state.pos_ned_m, state.vel_ned_m_s, now._accel_m_s2), now_us)


def home_at_once(now: MissionState, now_us: int, state: VehicleState) -> None:
    """Fly home, whoever is silent."""
    now.landing.go_home(now_us, state)
    now._begin_landing(now_us)


@pytest.mark.parametrize("seed", [0, 1])
def test_who_hears_nobody_any_more_stops_within_the_way_that_peers_expect(seed: int) -> None:
    flight = fly_now(*FAR, at={FAR_CUT_S: cut}, until=past(FAR_AT_REST_S), seed=seed)
    assert flight.separation_m() >= 3.0
    assert speeds_m_s(flight.lockstep).max() < 0.1


def test_negative_control_softer_stops_end_in_a_collision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trajectories, "stop", softly)
    fly_now(*FAR, at={FAR_CUT_S: cut}, until=closer_than(0.3))


def test_who_is_cut_off_stops_within_the_way_that_a_majority_expects() -> None:
    flight = fly_now(*THREE, at={THREE_CUT_S: cut_off}, until=past(THREE_PASSED_S), seed=2)
    assert flight.separation_m() >= 0.85


def test_negative_control_who_stops_softer_is_met_by_the_majority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trajectories, "stop", softly)
    fly_now(*THREE, at={THREE_CUT_S: cut_off}, until=closer_than(0.3), seed=2)


@pytest.mark.parametrize("seed", [0, 1])
def test_worn_batteries_bring_nobody_home_through_silent_peers(seed: int) -> None:
    """All are worn at about the same time, as all have flown for as long."""
    flight = fly_now(*NEAR, at={NEAR_CUT_S: cut, NEAR_LOW_S: wear}, until=returning_for(HOME_S), seed=seed)
    assert flight.separation_m() >= 0.85
    assert [flight.lockstep.logs[i].rows[-1]["phase"][0] for i in range(2)] == [Phase.GOTO_LAND] * 2
    assert speeds_m_s(flight.lockstep).max() < 0.1


def test_negative_control_worn_batteries_bring_all_home_through_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MissionState, "go_home", home_at_once)
    fly_now(*NEAR, at={NEAR_CUT_S: cut, NEAR_LOW_S: wear}, until=closer_than(0.3))


def speeds_m_s(flown: Lockstep) -> Array:
    return np.asarray(np.linalg.norm(flown.world.truth_rows()["vel_ned_m_s"], axis=1))


def test_who_rests_stays_where_it_has_been_driven_to() -> None:
    flight = fly_now(*SIX, at={SIX_CUT_S: cut}, until=past(SIX_DEADLOCKED_S), seed=1)
    assert flight.separation_m() >= 0.8
    assert speeds_m_s(flight.lockstep).max() < 0.1


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_who_goes_back_to_where_it_stopped_meets_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trajectories, "is_left", lambda *_: False)
    fly_now(*SIX, at={SIX_CUT_S: cut}, until=closer_than(0.3), seed=1)


def driven_m() -> float:
    """Return how far one of six is driven outwards at most, from where it was nearest to the middle."""
    flight = fly_now(*SIX, at={SIX_CUT_S: cut}, until=past(SIX_DRIVEN_S), seed=6)
    from_middle_m = np.linalg.norm(flight.pos_ned_m[:, :, :2], axis=2)
    return float((from_middle_m[-1] - from_middle_m.min(axis=0)).max())


def test_who_is_driven_from_others_does_not_fly_on_for_metres() -> None:
    assert driven_m() < 2.1


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_a_tilt_taken_back_at_once_leaves_an_attitude_that_lags(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rotors that are saturated turn it only in part, and the thesis' loops take seconds for what is left."""
    monkeypatch.setattr(Barrier, "eased", lambda _, wanted, __: wanted)
    assert driven_m() > 4.0
