"""Computers of one swarm that keep its list of obstacles: one list in the end, whatever was cut off or set again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest

from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import (
    MAX_ANCESTORS,
    MAX_VERSION_STEP,
    ListedObstacle,
    ObstaclesMessage,
    encode_message,
    first_list,
)
from swarmctl.bus.refusals import MALFORMED, SEQUENCE
from swarmctl.bus.topics import OBSTACLES
from swarmctl.core.obstacle import Obstacle
from swarmctl.ops.orders.operator import list_keepers, list_setters
from swarmctl.ops.supervision.obstacle_keeper import ObstacleKeeper, adoption_text
from swarmctl.wall_clock import WallClock
from tests.benches.swarm_of_hosts import SwarmOfHosts

NAMES = ("alpha", "bravo", "station")
BALL = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0)
TRAIN = Obstacle(center_ned_m=(0.0, 10.0, -2.0), vel_ned_m_s=(1.0, 0.0, 0.0))


class Computer:
    """One computer: its clock, whose UTC may be stepped, and its keeper of the list."""

    def __init__(self, swarm: Swarm, name: str) -> None:
        self._swarm, self.name, self.stepped_s = swarm, name, 0.0
        self.said: list[str] = []
        self.refused: list[tuple[str, str, str]] = []
        self.clock = self.new_clock()
        self.start()

    def new_clock(self) -> WallClock:
        """Return a clock of a process here, as the keeper's."""
        return WallClock(
            lambda: 1000 * self._swarm.now_us, lambda: 1000 * self._swarm.now_us + 10**18 + round(1e9 * self.stepped_s)
        )

    def start(self) -> None:
        """Start the keeper, for the first time or again."""
        identity = self._swarm.hosts.identity(self.name)
        self._swarm.hub.detach(self.name)
        self.keeper = ObstacleKeeper(
            self._swarm.hub.connect(self.name, {OBSTACLES: list_keepers(identity)}),
            (BALL,),
            self.clock,
            trusted=list_setters(identity),
            refuse=lambda *message: self.refused.append(message),
        )

    def step(self) -> None:
        for adoption in self.keeper.receive():
            self.said.append(adoption_text(adoption.before, adoption.after))
        self.said += self.keeper.others()
        self.keeper.repeat()

    def hears(self, sender: str, message: ObstaclesMessage) -> None:
        """Let a list arrive, said here and now."""
        stamped = msgspec.structs.replace(message, utc_us=self.clock.utc_us())
        self._swarm.hub.carry(sender, OBSTACLES, encode_message(stamped), frozenset({self.name}))


class Swarm:
    """Alpha, which is an operator's, bravo, and the station, on a bus in memory."""

    def __init__(self) -> None:
        self.now_us = 50_000_000
        self.hub = LocalHub(lambda: self.now_us)
        self.hosts = SwarmOfHosts.of(Path("unused"))
        self.computers = {name: Computer(self, name) for name in NAMES}

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            self.now_us += 50_000
            for computer in self.computers.values():
                computer.step()

    def lists(self) -> dict[str, tuple[int, ...]]:
        return {name: numbers(computer.keeper.newest) for name, computer in self.computers.items()}


def numbers(message: ObstaclesMessage) -> tuple[int, ...]:
    return tuple(item.number for item in message.obstacles)


def with_one_more(known: ObstaclesMessage, draw: int, obstacle: Obstacle = BALL) -> ObstaclesMessage:
    added = ListedObstacle(number=known.next_number, since_utc_us=known.utc_us, obstacle=obstacle)
    return known.changed((*known.obstacles, added), draw)


def repeated(message: ObstaclesMessage) -> ObstaclesMessage:
    return msgspec.structs.replace(message, proposed=False)


@pytest.mark.parametrize(("at_alpha", "at_station"), [(7, 8), (8, 7)])
def test_lists_that_two_operators_have_set_apart_become_one_and_the_loser_is_told(
    at_alpha: int, at_station: int
) -> None:
    swarm = Swarm()
    swarm.run(2.0)
    swarm.hub.split([frozenset({"alpha"}), frozenset({"bravo", "station"})])
    alpha, bravo, station = (swarm.computers[name] for name in NAMES)
    first = alpha.keeper.newest
    theirs = with_one_more(with_one_more(first, 5), at_station)
    for computer, message in ((alpha, with_one_more(first, 3)), (bravo, theirs), (station, theirs)):
        ours = with_one_more(message, at_alpha) if computer is alpha else message
        computer.hears("alpha" if computer is alpha else "station", ours)
    swarm.run(3.0)
    assert swarm.lists() == {"alpha": (0, 1, 2), "bravo": (0, 1, 2), "station": (0, 1, 2)}
    assert alpha.keeper.newest.rank != station.keeper.newest.rank
    swarm.hub.split([])
    swarm.run(3.0)
    assert {computer.keeper.newest.draw for computer in swarm.computers.values()} == {8}
    losers = [alpha] if at_station == 8 else [bravo, station]
    told = [c.name for c in swarm.computers.values() if any("overruled by an operator" in text for text in c.said)]
    assert told == [loser.name for loser in losers]


def test_a_list_that_was_made_from_the_known_one_overrules_nobody() -> None:
    swarm = Swarm()
    swarm.run(1.0)
    message = swarm.computers["alpha"].keeper.newest
    for draw in range(1, 5):
        message = with_one_more(message, draw)
        swarm.hub.carry("station", OBSTACLES, encode_message(message))
        swarm.run(1.5)
    assert set(swarm.lists().values()) == {(0, 1, 2, 3, 4)}
    assert [text for computer in swarm.computers.values() for text in computer.said if text] == []
    assert len(with_one_more(msgspec.structs.replace(message, made_from=(1,) * 64), 9).made_from) == MAX_ANCESTORS


def test_an_operators_host_that_is_started_again_says_who_keeps_another_list() -> None:
    swarm = Swarm()
    swarm.run(1.0)
    swarm.computers["bravo"].hears("station", with_one_more(swarm.computers["bravo"].keeper.newest, 5))
    swarm.run(1.0)
    del swarm.computers["station"]
    swarm.hub.detach("station")
    alpha = swarm.computers["alpha"]
    alpha.start()
    swarm.run(6.0)
    assert swarm.lists() == {"alpha": (0,), "bravo": (0, 1)}, "bravo has no operator's identity"
    (told,) = [text for text in alpha.said if text]
    assert "bravo keeps clear of other obstacles than this computer (version 2 of the list, here 1)" in told
    swarm.hub.carry("alpha", OBSTACLES, encode_message(with_one_more(swarm.computers["bravo"].keeper.newest, 6)))
    alpha.hears("alpha", with_one_more(swarm.computers["bravo"].keeper.newest, 6))
    swarm.run(2.0)
    assert swarm.lists() == {"alpha": (0, 1, 2), "bravo": (0, 1, 2)}


def test_a_proposal_of_the_same_version_is_not_taken_so_that_its_operator_makes_it_again() -> None:
    swarm = Swarm()
    swarm.run(1.0)
    alpha = swarm.computers["alpha"]
    first = alpha.keeper.newest
    for draw in (5, 9):
        alpha.hears("alpha", with_one_more(first, draw))
        swarm.run(0.1)
    assert alpha.keeper.newest.draw == 5


def off_m(computer: Computer, agent: WallClock) -> float:
    """Return by how much an agent of a computer has a train that was there 30 m ago at another place than it is."""
    (train,) = [item for item in computer.keeper.newest.obstacles if item.obstacle == TRAIN]
    return float(train.at(agent.utc_us()).center_ned_m[0])


@pytest.mark.parametrize("step_s", [30.0, -30.0, 95.0])
def test_an_obstacle_that_moves_is_where_it_is_while_a_step_of_utc_is_followed(step_s: float) -> None:
    swarm = Swarm()
    alpha = swarm.computers["alpha"]
    agent = alpha.new_clock()
    swarm.run(1.0)
    alpha.stepped_s = step_s
    swarm.run(1.0)
    agent.utc_us()
    known = msgspec.structs.replace(alpha.keeper.newest, utc_us=alpha.clock.utc_us())
    alpha.hears("alpha", with_one_more(known, 5, TRAIN))
    for ran_s in (1, 60, 150):
        swarm.run(ran_s - (swarm.now_us * 1e-6 - 52.0))
        agent.utc_us()
        assert off_m(alpha, agent) == pytest.approx(swarm.now_us * 1e-6 - 52.0, abs=0.1)


@pytest.mark.parametrize("step_s", [40.0, -40.0, 0.2, -0.2, 0.02])
@pytest.mark.parametrize("is_known", [True, False])
def test_a_list_by_another_clock_is_kept_by_the_own_one(step_s: float, is_known: bool) -> None:
    swarm = Swarm()
    bravo = swarm.computers["bravo"]
    bravo.stepped_s = step_s
    bravo.clock = bravo.new_clock()
    bravo.start()
    swarm.run(4.0 if is_known else 1.0)
    set_a_train(swarm)
    swarm.run(3.0)
    off_s = step_s if not is_known and abs(step_s) < 0.5 else 0.0  # it may as well have been under way for long
    assert off_m(bravo, bravo.clock) == pytest.approx(3.0 + off_s, abs=0.06)


def test_a_list_that_was_under_way_for_long_is_not_taken_for_one_by_another_clock() -> None:
    """By one clock: a link that repeats what was lost brings it after a second."""
    swarm = Swarm()
    swarm.run(4.0)
    swarm.hub.split([frozenset({"alpha", "station"}), frozenset({"bravo"})])
    set_a_train(swarm)
    swarm.run(0.9)
    late = swarm.computers["alpha"].keeper.newest
    swarm.hub.split([])
    swarm.hub.carry("alpha", OBSTACLES, encode_message(late), frozenset({"bravo"}))
    swarm.run(2.1)
    bravo = swarm.computers["bravo"]
    assert off_m(bravo, bravo.clock) == pytest.approx(3.0, abs=0.06)


def set_a_train(swarm: Swarm) -> None:
    """Let an operator at alpha set a train that is at its centre now."""
    alpha = swarm.computers["alpha"]
    known = msgspec.structs.replace(alpha.keeper.newest, utc_us=alpha.clock.utc_us())
    alpha.hears("alpha", with_one_more(known, 5, TRAIN))


def test_what_is_no_list_is_refused_and_what_nobody_may_set_is_not_adopted() -> None:
    swarm = Swarm()
    swarm.run(1.0)
    alpha = swarm.computers["alpha"]
    first = alpha.keeper.newest
    swarm.hub.carry("bravo", OBSTACLES, b"{}")
    alpha.hears("station", msgspec.structs.replace(first, version=1 + MAX_VERSION_STEP + 1, draw=4))
    alpha.hears("bravo", repeated(with_one_more(first, 5)))
    swarm.run(0.5)
    assert alpha.refused == [("bravo", "obstacles", MALFORMED), ("station", "obstacles", SEQUENCE)]
    assert alpha.keeper.newest.rank == first.rank


def test_lists_have_one_order_whoever_compares_them() -> None:
    first = first_list((BALL,), 1)
    lists: Sequence[ObstaclesMessage] = [repeated(with_one_more(first, draw)) for draw in (3, 9, 5)]
    later = repeated(with_one_more(lists[0], 1))
    for a in (first, *lists, later):
        for b in (first, *lists, later):
            assert a.replaces(b) == (a.rank > b.rank)
            assert [a.replaces(b), b.replaces(a)].count(True) == (a is not b)
