"""Commitments in a swarm wider than its vehicles reach: who is far need not acknowledge, and nobody is met unseen."""

from __future__ import annotations

import json

import numpy as np
import pytest

from swarmctl.agent.planning.commitment_publisher import CommitmentPublisher
from swarmctl.agent.sharing.interest import Interest
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.control.commit.reach import FarPeers
from tests.closed_loop.conftest import COARSE, Flight, closer_than, fly_now, mission_t_s
from tests.closed_loop.test_interest import to_goals

COMMITTED_M = 0.85
FAR = (
    *COARSE,
    "separation.mode=guaranteed",
    "agent.path_sharing.far_hz=4",
    "agent.path_sharing.speed_m_s=2.2",
    "mission.goto.accel_m_s2=1",
)
_STARTS = [[0.0, -14.0, -3.0], [0.0, 14.0, -3.0]]
_FARTHER = [[0.0, -16.0, -3.0], [0.0, 16.0, -3.0]]


@pytest.fixture
def by_commitments_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nobody plan around the predicted paths of others, which would keep them apart, too."""
    monkeypatch.setattr(Interest, "_reaches", lambda *_, **__: False)


def head_on(*more: str, off_m: float = 0.1, too_close_m: float = 0.0) -> Flight:
    """Fly two agents towards each other, each to the start of the other one, from where neither reaches the other.

    The flight ends so near to their goals, or when they are too close.
    """
    return to_goals(_STARTS, _STARTS[::-1], *FAR, *more, off_m=off_m, shown=closer_than(too_close_m))


def sent(flight: Flight) -> dict[str, int]:
    """Return the messages that both have sent, by topic."""
    totals = [agent.sent for agent in flight.lockstep.agents if agent is not None]
    return {name: sum(total.get(name, {}).get("messages", 0) for total in totals) for name in totals[0]}


@pytest.mark.usefixtures("by_commitments_alone")
def test_two_that_come_from_far_acknowledge_each_other_before_they_can_meet() -> None:
    flight = head_on(off_m=11.0)  # 3 m past each other
    assert flight.separation_m() >= COMMITTED_M


@pytest.mark.usefixtures("by_commitments_alone")
def test_negative_control_who_is_taken_for_far_for_ever_is_flown_into(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FarPeers, "_radius_m", lambda *_: -1.0)
    assert head_on(too_close_m=0.5).separation_m() < 0.5


def share_for_all_01() -> float:
    """Swap two pairs, 40 m from each other; return the share of messages that go to all, not to the near one alone."""
    starts = [[x, y, -3.0] for x in (0.0, 40.0) for y in (-3.0, 3.0)]
    goals = [starts[i] for i in (1, 0, 3, 2)]
    flight = to_goals(starts, goals, *FAR)
    assert flight.separation_m() >= COMMITTED_M
    messages = sent(flight)
    return messages[topics.FAR_TRAJECTORY.name] / messages[topics.TRAJECTORY.name]


def test_who_is_far_is_sent_less_than_a_quarter_of_the_messages() -> None:
    """4 messages a second go to all, and about 30 to the one that is near."""
    assert share_for_all_01() < 0.25


def test_negative_control_with_every_message_for_all_it_is_sent_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommitmentPublisher, "_is_for_all", lambda *_: True)
    assert share_for_all_01() > 0.9


def test_faster_proposals_take_the_acknowledgements_of_all() -> None:
    """Everybody counts on 0.5 m/s, and they fly at four times that: all ask all, and get there nevertheless."""
    flight = head_on("agent.path_sharing.speed_m_s=0.5")
    assert flight.separation_m() >= COMMITTED_M


def in_the_dark(too_close_m: float = 0.0) -> Flight:
    """Let the bus fail for 14 s, 6 s after both have begun to fly towards each other; they would meet 9 s later.

    The flight ends when they are too close, if a distance for that is given.
    """
    fails = {6.0: lambda lockstep: lockstep.hub.fail()}
    recovers = {} if too_close_m else {20.0: lambda lockstep: lockstep.hub.recover()}
    too_close = closer_than(too_close_m)
    return fly_now(
        *("sitl.start=air", "swarm.agents=2", f"start.positions_ned_m={json.dumps(_FARTHER)}", *FAR),
        *("mission.kind=goto", f"mission.goto.goals_ned_m={json.dumps(_FARTHER[::-1])}", "mission.duration_s=40"),
        at=fails | recovers,
        until=lambda lockstep: mission_t_s(lockstep) > 24.0 or too_close(lockstep),
    )


@pytest.mark.usefixtures("by_commitments_alone")
def test_without_a_bus_even_those_that_are_far_stop() -> None:
    """Each flies on for the rest of its lease and the final braking, and again once it hears the other."""
    flight = in_the_dark()
    assert flight.separation_m() >= COMMITTED_M
    ticks = flight.ticks(0)
    stands = (ticks["mission_t_s"] > 12.0) & (ticks["mission_t_s"] < 20.0)
    assert np.linalg.norm(ticks["vel_ned_m_s"][stands], axis=1).max() < 0.1
    assert np.linalg.norm(ticks["vel_ned_m_s"][ticks["mission_t_s"] > 22.0], axis=1).max() > 0.5


@pytest.mark.usefixtures("by_commitments_alone")
def test_negative_control_without_the_lease_they_fly_into_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FarPeers, "_is_leased", lambda self, agent, *_: agent not in self.near)
    assert in_the_dark(0.5).separation_m() < 0.5


def gone_on_m() -> float:
    """Cut off the last of four, of which two are 40 m away and fly away; how far those come in 16 s of mission [m]."""
    starts = [[x, y, -3.0] for x in (0.0, 40.0) for y in (-3.0, 3.0)]
    goals = [[-45.0, -3.0, -3.0], [-45.0, 3.0, -3.0], [40.0, -6.0, -3.0], [40.0, 6.0, -3.0]]
    others = frozenset(map(agent_name, range(3)))
    flight = fly_now(
        *(*FAR, "sitl.start=air", "swarm.agents=4", "mission.kind=goto", "mission.duration_s=60"),
        f"start.positions_ned_m={json.dumps(starts)}",
        f"mission.goto.goals_ned_m={json.dumps(goals)}",
        at={3.0: lambda running: running.hub.split([frozenset({agent_name(3)}), others])},
        until=lambda running: mission_t_s(running) > 16.0,
    )
    assert flight.separation_m() >= COMMITTED_M
    return -float(max(flight.ticks(agent)["pos_ned_m"][-1][0] for agent in (0, 1)))


def test_who_is_far_from_an_agent_that_a_majority_has_excluded_flies_on() -> None:
    assert gone_on_m() > 8.0


def test_negative_control_who_asks_the_excluded_for_what_it_has_heard_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FarPeers, "_is_over", lambda *_: False)
    assert gone_on_m() < 2.0
