"""Best effort among hosts whose clocks differ: what one tells is of another time than the others would think."""

from __future__ import annotations

from typing import Any

import pytest

from sitl.lockstep import Lockstep
from swarmctl.bus import topics
from swarmctl.bus.messages.json_messages import decode_status
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.config import load
from swarmctl.core.clock import ClockError
from tests.closed_loop.conftest import AT_100_HZ, Flight, closer_than, mission_t_s

APART_S = 0.3
CROSSING = (
    AT_100_HZ,
    "swarm.agents=2",
    "start.positions_ned_m=[[-8,0,-5],[0,-8,-5]]",
    "mission.kind=goto",
    "mission.goto.goals_ned_m=[[8,0,-5],[0,8,-5]]",
    "mission.goto.speed_m_s=3.5",
    "mission.goto.accel_m_s2=2",
    "mission.duration_s=30",
    "sitl.start=air",
)


def crossed(ahead_s: float, too_close_m: float = 0.0) -> Flight:
    """Fly two agents across each other's way at 3.5 m/s until both are past it, the clock of one ahead.

    The flight ends when they are too close, or both are 3 m past where their ways cross.
    """
    lockstep = Lockstep(load(None, CROSSING), clocks={0: ClockError(offset_us=round(1e6 * ahead_s))})
    too_close = closer_than(too_close_m)
    while lockstep.world.truth_rows()["pos_ned_m"][[0, 1], [0, 1]].min() < 3.0 and not too_close(lockstep):
        assert lockstep.clock.now_us() < 30e6, "the mission has not begun"
        lockstep.step()
    return Flight(lockstep)


def told(flight: Flight, name: str) -> list[dict[str, Any]]:
    return [event for log in flight.lockstep.logs for event in log.events if event["event"] == name]


@pytest.mark.parametrize("ahead_s", [APART_S, 3.0])  # of one, which is behind that of the other
def test_agents_whose_clocks_differ_keep_apart_and_say_by_how_much(ahead_s: float) -> None:
    """By clocks 3 s apart nothing begins unless they are measured: what one says is refused as a future thing."""
    flight = crossed(ahead_s)
    assert flight.separation_m() >= 0.85
    offsets_s = {event["agent"]: event["ahead_s"] for event in told(flight, "clock_offset")}
    assert offsets_s == {0: pytest.approx(ahead_s, abs=0.03), 1: pytest.approx(-ahead_s, abs=0.03)}
    assert told(flight, "refused") == []


def test_the_operator_is_told_to_set_the_clocks() -> None:
    lockstep = Lockstep(load(None, CROSSING), clocks={0: ClockError(offset_us=round(1e6 * APART_S))})
    operator = lockstep.hub.connect("watch", {topics.STATUS: None})
    while mission_t_s(lockstep) < 0.0:
        lockstep.step()
    said = [decode_status(payload) for _, payload in operator.receive(topics.STATUS)]
    alerts = [status.active_alert for status in said if status is not None]
    assert any("clock of agent-0 is 0.30 s ahead of this one" in alert for alert in alerts), alerts


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_by_stamps_as_they_are_agents_come_too_close(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PeerClocks, "ahead_us", lambda self, agent: 0)
    monkeypatch.setattr(PeerClocks, "spread_us", lambda self, agent: 0)
    assert crossed(APART_S, 0.75).separation_m() < 0.75


def test_equal_clocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = crossed(0.0)
    assert told(measured, "clock_offset") == []
    monkeypatch.setattr(PeerClocks, "ahead_us", lambda self, agent: 0)
    monkeypatch.setattr(PeerClocks, "spread_us", lambda self, agent: 0)
    assert (crossed(0.0).pos_ned_m == measured.pos_ned_m).all()
