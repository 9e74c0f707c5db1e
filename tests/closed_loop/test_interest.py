"""A swarm wider than what its vehicles reach: few paths are heard, and who meets knows each other as before."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent.sharing.interest import Interest
from swarmctl.bus import topics
from swarmctl.bus.local.hub import LocalBus
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.bus.topics import Topic
from tests.closed_loop.conftest import Flight, closer_than, fly_now

FAR = "agent.path_sharing.far_hz=1"
MET_M = 3.0
TICK_S = 0.02


def to_goals(
    starts: list[list[float]],
    goals: list[list[float]],
    *more: str,
    off_m: float = 0.1,
    shown: Callable[[Lockstep], bool] = lambda _: False,
) -> Flight:
    """Fly every agent to its goal, or so near to it, or until something is shown."""

    def arrived(lockstep: Lockstep) -> bool:
        left_m = np.linalg.norm(lockstep.world.truth_rows()["pos_ned_m"] - np.array(goals), axis=1)
        return bool(left_m.max() < off_m) or shown(lockstep)

    return fly_now(
        *("sitl.start=air", f"swarm.agents={len(starts)}", f"start.positions_ned_m={json.dumps(starts)}"),
        *("mission.kind=goto", f"mission.goto.goals_ned_m={json.dumps(goals)}", "mission.duration_s=25"),
        *more,
        until=arrived,
    )


def paths_heard(*more: str) -> tuple[Flight, int]:
    """Fly two pairs that swap 30 m from each other; return how many paths were received in all."""
    starts = [[x, y, -3.0] for x in (0.0, 30.0) for y in (-3.0, 3.0)]
    counts: Counter[str] = Counter()
    receive: Callable[[LocalBus, Topic], list[tuple[str, bytes]]] = LocalBus.receive

    def counted(self: LocalBus, topic: Topic) -> list[tuple[str, bytes]]:
        arrived = receive(self, topic)
        counts[topic.name] += len(arrived)
        return arrived

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LocalBus, "receive", counted)
        flight = to_goals(starts, [starts[i] for i in (1, 0, 3, 2)], *more)
    return flight, counts[topics.PATH.name] + counts[topics.FAR_PATH.name]


def test_few_paths_are_heard_of_those_out_of_reach() -> None:
    """Each agent has one peer near, heard 50 times a second, and two that it hears 5 times a second."""
    flight, heard = paths_heard(FAR)
    everything, all_heard = paths_heard()
    assert heard < 0.55 * all_heard
    assert flight.separation_m() >= 0.85
    assert everything.separation_m() >= 0.85


def oldest_path_s(flight: Flight) -> float:
    """Return the age of the oldest path by which one of two agents that met planned [s]."""
    ages_s = []
    for agent in range(2):
        ticks = flight.ticks(agent)
        met = ticks[ticks["nearest_peer_m"] < MET_M]
        assert len(met)
        ages_s.append(float(met["plan_staleness_ms"].max()) * 1e-3)
    return max(ages_s)


def head_on(*more: str, shown: Callable[[Lockstep], bool] = lambda _: False) -> Flight:
    """Fly two agents towards each other from out of reach, at 2 m/s, until both are 3 m past, or something is shown."""
    starts = [[0.0, -12.0, -3.0], [0.0, 12.0, -3.0]]
    return to_goals(starts, starts[::-1], FAR, *more, off_m=9.0, shown=shown)


@pytest.fixture(scope="module")
def met() -> Flight:
    return head_on()


def test_who_comes_from_out_of_reach_is_heard_in_full_before_it_matters(met: Flight) -> None:
    assert oldest_path_s(met) <= 2.5 * TICK_S
    assert met.separation_m() >= 0.85
    assert not any("unresponsive" in met.event_names(agent) for agent in range(2))


def test_a_peer_that_is_out_of_reach_is_no_concern_of_a_plan(met: Flight) -> None:
    ticks = met.ticks(0)
    ticks = ticks[np.isfinite(ticks["mission_t_s"])]
    apart_m = ticks["nearest_peer_m"][1:][(ticks["peers"][:-1] == 0) & (ticks["peers"][1:] == 1)]
    assert ticks["peers"][0] == 0 and len(apart_m)
    freshest_m = (
        0.9 + 0.1 + 2.0 * 3.0 * (0.8 + 1.0 + 0.5)
    )  # at 3 m/s each: plan, until the next path, and until it is heard
    oldest_m = freshest_m + 2.0 * 3.0 * 1.12  # by a path of a second before, looked at a tenth later, in the next tick
    late_m = 2.0 * 2.0 * 0.14  # flown since it was last looked at
    assert ((apart_m > freshest_m - late_m) & (apart_m < oldest_m)).all()


def has_silence(lockstep: Lockstep) -> bool:
    """Return whether somebody has been taken for silent."""
    return any(event["event"] == "unresponsive" for log in lockstep.logs for event in log.events)


SLOW = "bus.delay_ms=100"


def test_who_has_just_come_within_reach_is_not_silent_yet() -> None:
    """What is known of it is up to a second old, and its next path is on its way."""
    assert not has_silence(head_on(SLOW).lockstep)


def test_negative_control_by_the_age_of_what_is_known_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    near = PeerPaths.near
    monkeypatch.setattr(PeerPaths, "near", lambda self, before_utc_us=None: near(self))
    assert has_silence(head_on(SLOW, shown=has_silence).lockstep)


def test_negative_control_who_never_gets_within_reach_is_flown_into(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Interest, "_reaches", lambda *_, **__: False)
    assert head_on(shown=closer_than(0.5)).separation_m() < 0.5
