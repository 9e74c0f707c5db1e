"""Tests that messages are passed on where a link fails, by few of many, and not because an agent was held up.

Relays that grow with what they are to remedy never end: twelve agents on a busy machine, each late, passed on all of
each other's messages in every tick, 87 % of all bytes, and so kept each other late.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from sitl.lockstep import Lockstep
from swarmctl.bus.bus import agent_name
from swarmctl.bus.peers.trajectories import PeerTrajectories
from tests.closed_loop.conftest import Flight, fly_now, mission_t_s

GUARANTEED = ("sitl.start=air", "separation.mode=guaranteed")
TICKS = 130  # in which it lasts


def relays(lockstep: Lockstep) -> list[int]:
    """Return how many messages of others each agent has passed on, several at once counted as one."""
    return [agent.sent.get("relay", {}).get("messages", 0) for agent in lockstep.agents if agent]


def flown(begin: Callable[[Lockstep], None], enough: float = math.inf) -> Flight:
    """Return two and a half seconds of a swap of eight that begin when something does, or until enough is relayed."""

    def until(lockstep: Lockstep) -> bool:
        return mission_t_s(lockstep) > 3.6 or sum(relays(lockstep)) > enough

    return fly_now(*GUARANTEED, config="swap8.toml", at={1.0: begin}, until=until)


def held_up(lockstep: Lockstep) -> None:
    """Two of eight run one of six ticks from now on: they send every 120 ms."""
    lockstep.starved = {0: 6, 4: 6}


def cut_off(lockstep: Lockstep) -> None:
    """Two of eight do not hear each other from now on."""
    lockstep.hub.cut(agent_name(0), agent_name(4))
    lockstep.hub.cut(agent_name(4), agent_name(0))


def test_nothing_is_passed_on_of_agents_that_are_held_up() -> None:
    assert sum(relays(flown(held_up).lockstep)) == 0


def test_negative_control_by_silence_alone_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PeerTrajectories, "lacked_us", lambda *_: 1_000_000)
    assert sum(relays(flown(held_up, 20).lockstep)) > 20


def test_two_of_six_that_could_pass_on_what_two_others_lack_of_each_other() -> None:
    """The peer has to say that it lacks something, and then that it has it: five ticks or more for each message."""
    flight = flown(cut_off)
    counts = relays(flight.lockstep)
    assert flight.separation_m() >= 0.85
    assert TICKS / 8 < max(counts) < TICKS / 3
    assert sum(count > 5 for count in counts) <= 4, "two for each of the two"
    assert sum(counts) <= 4 * max(counts)
