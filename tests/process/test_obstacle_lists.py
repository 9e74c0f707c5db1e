"""Lists of obstacles of several computers, over real routers: one in the end, whoever is started again or cut off."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sitl.studies.bench.free_ports import free_ports
from swarmctl.bus.bus import Bus
from swarmctl.bus.network.identities import make_identities
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.sealed_bus import FOR_OPERATORS_US
from swarmctl.bus.topics import OBSTACLES
from swarmctl.core.obstacle import Obstacle
from swarmctl.ops.orders import obstacle_list
from swarmctl.ops.orders.operator import list_keepers, list_setters
from swarmctl.ops.running_launches import RunningLaunch
from swarmctl.ops.supervision.obstacle_keeper import ObstacleKeeper, adoption_text
from swarmctl.wall_clock import WallClock
from tests.benches.swarm_of_hosts import LOOPBACK, SwarmOfHosts
from tests.process.test_bus import until

pytestmark = pytest.mark.process

BALL = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0)
TRAIN = Obstacle(center_ned_m=(0.0, 10.0, -2.0), vel_ned_m_s=(1.0, 0.0, 0.0))
STEP_S = 95.0


class Keeper:
    """Keeps the list of one computer until it is closed, as its supervisor does."""

    def __init__(self, swarm: SwarmOfHosts, name: str, hears: tuple[str, ...]) -> None:
        identity = swarm.identity(name)
        self.clock = WallClock(utc_ns=lambda: time.time_ns())  # also after a test has stepped it
        self.bus: Bus = join_bus(
            swarm.endpoint(name),
            "run",
            name,
            {OBSTACLES: hears},
            identity=identity,
            max_age_us=FOR_OPERATORS_US,
            utc_us=self.clock.utc_us,
        )
        self.refused: list[tuple[str, str, str]] = []
        self.said: list[str] = []
        self.keeper = ObstacleKeeper(
            self.bus,
            (BALL,),
            self.clock,
            trusted=list_setters(identity),
            refuse=lambda *message: self.refused.append(message),
        )
        self._is_closed = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def launch(self, swarm: SwarmOfHosts, name: str) -> RunningLaunch:
        """Return what verbs there know of it."""
        ahead_us = self.clock.utc_ahead_us()
        return RunningLaunch(
            "run", swarm.endpoint(name), 1, 0.0, 3, "x", "", swarm.identity(name), utc_ahead_us=ahead_us
        )

    def close(self) -> None:
        self._is_closed = True
        self._thread.join(20)
        self.bus.close()

    def _run(self) -> None:
        while not self._is_closed:
            self.said += [adoption_text(adoption.before, adoption.after) for adoption in self.keeper.receive()]
            self.refused += self.bus.refused()
            self.keeper.repeat()
            time.sleep(0.05)


class Swarm:
    """Alpha, which is an operator's, bravo and the station, whose routers and keepers start and end."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        make_identities(folder, {"alpha": LOOPBACK, "bravo": LOOPBACK, "charlie": LOOPBACK, STATION: None})
        self.hosts, self._stack = SwarmOfHosts.of(folder, free_ports(3)), stack
        self.keepers: dict[str, Keeper] = {}
        self._ends: dict[str, Callable[[], object]] = {}

    def start(self, *names: str, hears: tuple[str, ...] | None = None) -> None:
        """Start computers that hear all lists that they should, or these only."""
        for name in names:
            router = self._stack.enter_context(contextlib.ExitStack())
            router.enter_context(self.hosts.router(name))
            self.keepers[name] = Keeper(self.hosts, name, hears or list_keepers(self.hosts.identity(name)))
            router.callback(self.keepers[name].close)
            self._ends[name] = router.close

    def end(self, name: str) -> None:
        self._ends[name]()
        del self.keepers[name]

    def add(self, at: str, obstacle: Obstacle = BALL) -> obstacle_list.KeptList:
        launch = self.keepers[at].launch(self.hosts, at)
        return obstacle_list.change_obstacles(launch, lambda known: obstacle_list.added(known, [obstacle]))

    def ranks(self) -> set[tuple[int, int]]:
        return {keeper.keeper.newest.rank for keeper in self.keepers.values()}

    def counts(self) -> dict[str, int]:
        return {name: len(keeper.keeper.newest.obstacles) for name, keeper in self.keepers.items()}


@pytest.fixture
def swarm(tmp_path: Path) -> Iterator[Swarm]:
    with contextlib.ExitStack() as stack:
        yield Swarm(tmp_path, stack)


def test_what_is_added_at_an_operators_host_that_was_started_again_is_taken_by_all(swarm: Swarm) -> None:
    swarm.start("alpha", "bravo")
    assert until(lambda: "bravo" in swarm.keepers["alpha"].bus.alive())
    assert swarm.add("alpha").unheard == ("charlie",), "nothing is known of it"
    swarm.add("alpha")
    before = swarm.counts()
    assert before["alpha"] == before["bravo"] > 2
    swarm.end("alpha")
    swarm.start("alpha")
    assert swarm.counts() == {"alpha": 1, "bravo": before["bravo"]}
    assert until(lambda: "bravo" in swarm.keepers["alpha"].bus.alive())
    time.sleep(1.5)  # a repetition
    kept = swarm.add("alpha")
    assert kept.others == ()
    assert swarm.counts() == {"alpha": before["bravo"] + 1, "bravo": before["bravo"] + 1}
    assert len(swarm.ranks()) == 1


def test_two_operators_that_were_apart_have_one_list_when_they_hear_each_other(swarm: Swarm) -> None:
    swarm.start("alpha", hears=("alpha",))
    swarm.add("alpha", TRAIN)
    apart = (STATION, "bravo")
    swarm.start("bravo", STATION, hears=apart)
    bravo = swarm.keepers["bravo"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("swarmctl.ops.orders.operator.list_keepers", lambda _: apart)
        assert until(lambda: swarm.add(STATION).others == ())
    assert swarm.keepers["alpha"].keeper.newest.version == bravo.keeper.newest.version == 2, "a tie"
    assert len(swarm.ranks()) == 2
    for name, keeper in swarm.keepers.items():
        keeper.bus.hear(OBSTACLES, list_keepers(swarm.hosts.identity(name)))
    assert until(lambda: len(swarm.ranks()) == 1), swarm.ranks()
    told = [name for name, keeper in swarm.keepers.items() if any("was overruled" in text for text in keeper.said)]
    assert told in (["alpha"], ["bravo", STATION])


def test_a_change_is_taken_after_the_computers_utc_has_stepped(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    swarm.start("alpha")
    before_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: before_ns() + round(STEP_S * 1e9))
    swarm.add("alpha", TRAIN)
    keeper = swarm.keepers["alpha"]
    (train,) = [item for item in keeper.keeper.newest.obstacles if item.obstacle == TRAIN]
    assert 0.0 <= train.at(keeper.clock.utc_us()).center_ned_m[0] < 10.0, "by the clock of the agents"
    assert keeper.refused == []
