"""Several senders of one process on one session of Zenoh: whom each hears, who leaves, and what follows deafness."""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from sitl.studies.bench.free_ports import free_ports
from swarmctl.bus.bus import Bus
from swarmctl.bus.network.identities import make_identities
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.topics import COMMAND, OPERATOR, PATH, STATUS
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import CLOSE_DEADLINE_S, SCHEME
from swarmctl.bus.zenoh.session import SharedSession, ZenohSession
from tests.benches.router_process import start_router
from tests.benches.swarm_of_hosts import LOOPBACK, SwarmOfHosts
from tests.process.test_bus import end, endpoint, until  # noqa: F401  (a fixture)
from tests.process.test_deaf_bus import deafen

pytestmark = pytest.mark.process

OTHERS = {i: [f"agent-{k}" for k in range(3) if k != i] for i in range(3)}


class Swarm:
    """Agents 0 and 1 share a session, agent 2 and the operator have their own."""

    def __init__(self, where: str, deaf_s: float = 1e9) -> None:
        self.session = SharedSession()
        listen = {i: {PATH: OTHERS[i], COMMAND: [OPERATOR]} for i in range(3)}
        self.together = [
            ZenohBus(where, "run", f"agent-{i}", listen[i], opens=self.session, deaf_s=deaf_s) for i in (0, 1)
        ]
        self.alone = ZenohBus(where, "run", "agent-2", listen[2])
        self.operator = ZenohBus(where, "run", OPERATOR, {STATUS: [f"agent-{i}" for i in range(3)]})
        self.agents = [*self.together, self.alone]

    def paths(self) -> list[set[str]]:
        """Let everybody publish a path, and return whose each agent has heard."""
        for i, agent in enumerate(self.agents):
            agent.publish(PATH, f"{i}".encode())
        time.sleep(0.02)
        heard = [agent.receive(PATH) for agent in self.agents]
        assert all(payload.decode() == sender[-1] for paths in heard for sender, payload in paths)
        return [{sender for sender, _ in paths} for paths in heard]

    def close(self) -> None:
        for bus in (*self.agents, self.operator):
            bus.close()
        self.session.close()


@pytest.fixture
def swarm(endpoint: str) -> Iterator[Swarm]:  # noqa: F811
    joined = Swarm(endpoint)
    yield joined
    joined.close()


def test_all_hear_each_other_once_however_they_are_connected(swarm: Swarm) -> None:
    assert until(lambda: all(agent.alive() == {"agent-0", "agent-1", "agent-2", OPERATOR} for agent in swarm.agents))
    assert until(lambda: swarm.paths() == [set(OTHERS[i]) for i in range(3)])
    for agent in swarm.agents:
        agent.receive(PATH)
    for number in range(3):
        swarm.agents[0].publish(PATH, f"{number}".encode())
    time.sleep(0.3)
    for agent in swarm.agents[1:]:
        assert agent.receive(PATH) == [("agent-0", f"{number}".encode()) for number in range(3)]
    assert swarm.agents[0].receive(PATH) == [], "nobody hears itself"
    assert dict(swarm.agents[0].arrivals()) == {"agent-0": 1, "agent-1": 1, "agent-2": 1, OPERATOR: 1}


def test_what_comes_from_elsewhere_comes_to_each_in_order(swarm: Swarm) -> None:
    assert until(lambda: len(swarm.operator.alive()) == 4)
    for number in range(20):
        swarm.operator.publish(COMMAND, f"{number}".encode())
    heard: list[list[tuple[str, bytes]]] = [[], []]

    def is_complete() -> bool:
        for commands, agent in zip(heard, swarm.together, strict=True):
            commands += agent.receive(COMMAND)
        return all(len(commands) >= 20 for commands in heard)

    assert until(is_complete)
    assert heard == [[(OPERATOR, f"{number}".encode()) for number in range(20)]] * 2


def test_who_does_not_look_keeps_the_newest_of_each_sender(swarm: Swarm) -> None:
    """Its neighbour, which looks often, takes them out of the rings of the session."""
    assert until(lambda: swarm.paths() == [set(OTHERS[i]) for i in range(3)])
    swarm.together[0].receive(PATH)
    for number in range(10, 10 + 5 * PATH.ring):
        swarm.alone.publish(PATH, f"{number}".encode())
        assert until(lambda said=f"{number}": ("agent-2", said.encode()) in swarm.together[1].receive(PATH))  # type: ignore[misc]
    last = range(10 + 4 * PATH.ring, 10 + 5 * PATH.ring)
    kept = swarm.together[0].receive(PATH)
    assert [payload for sender, payload in kept if sender == "agent-2"] == [f"{number}".encode() for number in last]


def test_each_hears_whom_it_asks_for(swarm: Swarm) -> None:
    everybody = [set(OTHERS[i]) for i in range(3)]
    assert until(lambda: swarm.paths() == everybody)
    swarm.together[0].hear(PATH, ["agent-1"])
    swarm.together[1].hear(PATH, [])
    for _ in range(10):
        heard = swarm.paths()
        assert heard[0] <= {"agent-1"} and heard[1] == set()
    swarm.together[0].hear(PATH, OTHERS[0])
    swarm.together[1].hear(PATH, OTHERS[1])
    assert until(lambda: swarm.paths() == everybody)


def test_who_leaves_is_gone_for_all_and_the_others_go_on(swarm: Swarm) -> None:
    left, stays = swarm.together
    assert until(lambda: swarm.paths() == [set(OTHERS[i]) for i in range(3)])
    left.close()
    assert until(lambda: all("agent-0" not in bus.alive() for bus in (stays, swarm.alone, swarm.operator)))
    left.publish(PATH, b"0")
    assert left.receive(PATH) == []
    assert until(lambda: swarm.paths() == [set(), {"agent-2"}, {"agent-1"}])
    left.close()
    stays.close()
    assert until(lambda: swarm.operator.alive() == {"agent-2", OPERATOR})


def test_who_leaves_waits_for_no_router_that_hangs() -> None:
    where = f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-test-')}/bus.sock"
    router = start_router(where)
    swarm = Swarm(where)
    assert until(lambda: swarm.paths() == [set(OTHERS[i]) for i in range(3)])
    left, stays = swarm.together
    router.send_signal(signal.SIGSTOP)
    for _ in range(2000):  # until the link takes nothing more
        stays.publish(STATUS, bytes(20_000))
    began_s = time.monotonic()
    left.close()
    assert time.monotonic() - began_s < CLOSE_DEADLINE_S + 2.0
    for _ in range(100):
        stays.publish(PATH, b"1")
        assert stays.receive(PATH) is not None
    assert time.monotonic() - began_s < CLOSE_DEADLINE_S + 4.0
    router.send_signal(signal.SIGCONT)
    assert until(lambda: swarm.operator.alive() == {"agent-1", "agent-2", OPERATOR})
    swarm.close()
    end(router)


def test_a_deaf_session_of_several_is_replaced_though_they_hear_each_other(endpoint: str) -> None:  # noqa: F811
    swarm = Swarm(endpoint, deaf_s=1.0)
    everybody = [set(OTHERS[i]) for i in range(3)]
    assert until(lambda: swarm.paths() == everybody)
    own = {PATH: {"agent-0", "agent-1"}}
    inboxes = swarm.session("", "")._now.inboxes
    for topic, of_topic in inboxes.items():
        for sender, inbox in of_topic.items():
            if sender not in own.get(topic, ()):
                inbox.undeclare()
    assert swarm.paths()[:2] == [{"agent-1"}, {"agent-0"}], "it is deaf to all but its own senders"
    assert until(lambda: swarm.paths() == everybody)
    assert [agent.reopened() for agent in swarm.agents] == [1, 1, 0]
    assert swarm.together[0].alive() == {"agent-0", "agent-1", "agent-2", OPERATOR}
    assert dict(swarm.alone.arrivals()) == {"agent-0": 1, "agent-1": 1, "agent-2": 1, OPERATOR: 1}
    swarm.close()


def test_who_left_while_another_session_was_opened_does_not_come_back_with_it(
    swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, stays = swarm.together
    session = swarm.session("", "")
    deafen(stays)
    begun: Callable[[], object] = session._begun

    def leaves_meanwhile() -> object:
        opened = begun()
        left.close()
        return opened

    monkeypatch.setattr(session, "_begun", leaves_meanwhile)
    assert stays.reopen()
    assert until(lambda: stays.receive(PATH) is not None and stays.reopened() == 1)
    assert until(lambda: swarm.operator.alive() == {"agent-1", "agent-2", OPERATOR})
    assert until(lambda: swarm.paths()[1:] == [{"agent-2"}, {"agent-1"}])


def test_sealed_senders_of_one_session_believe_each_other_and_are_believed(tmp_path: Path) -> None:
    make_identities(tmp_path, {"alpha": LOOPBACK, "bravo": LOOPBACK, "charlie": LOOPBACK, STATION: None})
    one_each = SwarmOfHosts.of(tmp_path, free_ports(3))
    agents_of = {"alpha": (0, 1), "bravo": (2,), "charlie": (3,)}
    with_two = tuple(host.model_copy(update={"agents": agents_of[host.name]}) for host in one_each.hosts)
    hosts = replace(one_each, hosts=with_two)
    session = SharedSession()

    def joined(me: str, listen: Sequence[str], opens: Callable[..., ZenohSession]) -> Bus:
        return join_bus(
            hosts.endpoint("alpha"),
            "run",
            me,
            {STATUS: listen},
            identity=hosts.identity("alpha"),
            max_age_us=FOR_AGENTS_US,
            utc_us=lambda: time.time_ns() // 1000,
            opens=opens,
        )

    with hosts.router("alpha"):
        supervisor = joined("alpha", ["agent-0", "agent-1"], ZenohSession)
        agents = [joined("agent-0", ["agent-1"], session), joined("agent-1", ["agent-0"], session)]
        buses, heard = [supervisor, *agents], [set[str](), set[str](), set[str]()]

        def all_hear() -> bool:
            for agent in agents:
                agent.publish(STATUS, b"status")
            time.sleep(0.02)
            for bus, names in zip(buses, heard, strict=True):
                names.update(sender for sender, payload in bus.receive(STATUS) if payload == b"status")
            return heard == [{"agent-0", "agent-1"}, {"agent-1"}, {"agent-0"}]

        assert until(all_hear)
        assert [bus.refused() for bus in buses] == [[], [], []]
        for bus in buses:
            bus.close()
        session.close()


def test_senders_of_one_session_hear_each_other_without_a_router() -> None:
    where = f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-test-')}/bus.sock"
    router = start_router(where)
    swarm = Swarm(where)
    assert until(lambda: swarm.paths() == [set(OTHERS[i]) for i in range(3)])
    router.kill()
    end(router)
    assert until(lambda: not swarm.together[0].alive())
    assert until(lambda: swarm.paths() == [{"agent-1"}, {"agent-0"}, set()])
    swarm.close()
