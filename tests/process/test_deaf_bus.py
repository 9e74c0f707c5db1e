"""A session of Zenoh that sends and is kept alive, but receives nothing, is replaced by another one.

How such a session comes about is shown by `tools/deaf_sessions.py`. Here its ears are taken away.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

import swarmctl.bus.zenoh.client as zenoh_client
from sitl.studies.bench.free_ports import free_ports
from swarmctl.bus.bus import Bus
from swarmctl.bus.network.identities import make_identities
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.topics import COMMAND, PATH, STATUS
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.errors import StartError
from tests.benches.router_process import start_router
from tests.benches.swarm_of_hosts import LOOPBACK, SwarmOfHosts
from tests.process.test_bus import end

pytestmark = pytest.mark.process

ROUTER_GIVES_UP_MS = 10_000  # accept_timeout of Zenoh


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("bus")
    folder.chmod(0o700)
    endpoint = f"{zenoh_client.SCHEME}{folder}/bus.sock"
    router = start_router(endpoint)
    yield endpoint
    end(router)


@contextmanager
def pair(endpoint: str, deaf_s: float) -> Iterator[tuple[ZenohBus, ZenohBus]]:
    """Join a listener and a talker, who hear each other."""
    listener = ZenohBus(endpoint, "run", "agent-0", {STATUS: ["agent-1"], PATH: ["agent-1"]}, deaf_s=deaf_s)
    talker = ZenohBus(endpoint, "run", "agent-1", {COMMAND: ["agent-0"]})
    try:
        assert hears(listener, talker, 10.0)
        yield listener, talker
    finally:
        listener.close()
        talker.close()


def hears(listener: Bus, talker: Bus, seconds: float) -> bool:
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        talker.publish(STATUS, b"status")
        time.sleep(0.02)
        if listener.receive(STATUS):
            return True
    return False


def deafen(bus: ZenohBus) -> None:
    """Take the ears of its session away; it goes on to send, and its token stays."""
    for subscribers in bus._session._now.inboxes.values():
        for subscriber in subscribers.values():
            subscriber.undeclare()
    bus._session._now.tokens.undeclare()


def test_a_deaf_session_is_replaced(endpoint: str) -> None:
    with pair(endpoint, deaf_s=1.0) as (listener, talker):
        deafen(listener)
        listener.publish(COMMAND, b"command")
        assert not hears(listener, talker, 0.5), "it is deaf"
        assert heard_of(listener, talker), "and is heard"
        assert hears(listener, talker, 10.0)
        assert listener.reopened() == 1
        assert listener.alive() == {"agent-0", "agent-1"}, "from the first moment on: who is absent is taken for ended"
        assert heard_of(listener, talker)
        time.sleep(0.5)
        assert listener.alive() == talker.alive() == {"agent-0", "agent-1"}
        assert dict(talker.arrivals()) == {"agent-0": 1, "agent-1": 1}, "for others nobody left"
        assert hears(listener, talker, 1.0)
        assert listener.reopened() == 1


def test_a_session_in_place_of_a_deaf_one_hears_whom_the_other_heard(endpoint: str) -> None:
    with pair(endpoint, deaf_s=1.0) as (listener, talker):
        listener.hear(PATH, [])
        deafen(listener)
        assert not hears(listener, talker, 0.5)
        assert hears(listener, talker, 10.0)
        assert listener.reopened() == 1
        for _ in range(10):
            talker.publish(PATH, b"path")
            time.sleep(0.02)
        assert listener.receive(PATH) == []


def heard_of(listener: ZenohBus, talker: ZenohBus) -> bool:
    until_s = time.monotonic() + 5.0
    while time.monotonic() < until_s:
        listener.publish(COMMAND, b"command")
        time.sleep(0.02)
        if talker.receive(COMMAND):
            return True
    return False


def test_control_it_stays_deaf_if_nothing_replaces_it(endpoint: str) -> None:
    with pair(endpoint, deaf_s=1e9) as (listener, talker):
        deafen(listener)
        assert not hears(listener, talker, 3.0)
        assert heard_of(listener, talker)


def test_it_is_replaced_at_once_if_asked_for(endpoint: str) -> None:
    with pair(endpoint, deaf_s=1e9) as (listener, talker):
        deafen(listener)
        assert listener.reopen()
        assert hears(listener, talker, 5.0)


def test_nobody_is_asked_where_there_is_no_router(endpoint: str) -> None:
    with pair(endpoint, deaf_s=1e9) as (listener, _):
        listener._session._socket = Path("/nowhere/bus.sock")
        assert not listener.reopen()
        listener.close()
        assert not listener.reopen()


def test_a_sealed_session_is_believed_after_it_was_replaced(tmp_path: Path) -> None:
    """The seals of the process go on: for those who hear it nothing begins anew, and nothing is a replay."""
    make_identities(tmp_path, {"alpha": LOOPBACK, "bravo": LOOPBACK, "charlie": LOOPBACK, STATION: None})
    swarm = SwarmOfHosts.of(tmp_path, free_ports(3))

    def joined(me: str, listen: dict[Any, list[str]]) -> Bus:
        return join_bus(
            swarm.endpoint("alpha"),
            "run",
            me,
            listen,
            identity=swarm.identity("alpha"),
            max_age_us=FOR_AGENTS_US,
            utc_us=lambda: time.time_ns() // 1000,
        )

    with swarm.router("alpha"):
        supervisor = joined("alpha", {STATUS: ["agent-0"]})
        agent = joined("agent-0", {COMMAND: ["alpha"]})
        assert hears(supervisor, agent, 10.0)
        for bus in (supervisor, agent):
            assert bus.reopen()
        until_s = time.monotonic() + 5.0
        while not (supervisor.reopened() and agent.reopened()) and time.monotonic() < until_s:
            hears(supervisor, agent, 0.1)
            agent.receive(COMMAND)
        assert supervisor.reopened() == agent.reopened() == 1
        supervisor.refused()
        assert hears(supervisor, agent, 5.0)
        assert supervisor.refused() == []
        supervisor.close()
        agent.close()


def test_no_client_gives_up_the_opening_of_a_session_before_its_router_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a client gives up in the middle of its opening is a session that is deaf for good."""
    asked: list[Mapping[str, Any]] = []

    def refuse(settings: Mapping[str, Any]) -> None:
        asked.append(settings)
        raise zenoh.ZError("refused")

    monkeypatch.setattr(zenoh_client, "open_session", refuse)
    with pytest.raises(StartError):
        ZenohBus(f"{zenoh_client.SCHEME}/nowhere/bus.sock", "run", "agent-0", {})
    assert asked[0]["transport/unicast/open_timeout"] > ROUTER_GIVES_UP_MS
