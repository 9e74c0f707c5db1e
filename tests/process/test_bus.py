"""The Zenoh bus with real processes: isolation, bounded memory, liveliness, router restart, orphans."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from swarmctl.bus.refusals import HARMLESS, MISDELIVERED, RefusedMessage
from swarmctl.bus.topics import COMMAND, OPERATOR, PATH, STATUS, TICK, TOO_LONG
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import COMMON_SETTINGS, SCHEME, close_session, open_session
from swarmctl.bus.zenoh.marked_keys import MarkedPublisher
from swarmctl.errors import EXIT_START, EXIT_USAGE, StartError
from tests.benches.router_process import start_router

pytestmark = pytest.mark.process

WAIT_S = 20.0


def until(condition: Callable[[], bool], timeout_s: float = WAIT_S) -> bool:
    """Whether the condition came true in time."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if condition():
            return True
        time.sleep(0.02)
    return condition()


def end(process: subprocess.Popen[str]) -> int:
    process.terminate()
    code = process.wait(WAIT_S)
    if process.stdout is not None:
        process.stdout.close()
    return code


@pytest.fixture
def endpoint() -> Iterator[str]:
    directory = tempfile.mkdtemp(prefix="swarm-test-")
    endpoint = f"{SCHEME}{directory}/bus.sock"
    router = start_router(endpoint)
    yield endpoint
    assert end(router) == 0
    assert not Path(directory).exists(), "the router takes its socket and directory away"


@pytest.fixture
def join(endpoint: str) -> Iterator[Callable[..., ZenohBus]]:
    opened: list[ZenohBus] = []

    def opener(me: str, listen: dict[object, list[str]] | None = None, run: str = "run") -> ZenohBus:
        opened.append(ZenohBus(endpoint, run, me, listen or {}))  # type: ignore[arg-type]
        return opened[-1]

    yield opener
    for bus in opened:
        bus.close()


def test_newest_path_only_but_every_command_in_order(join: Callable[..., ZenohBus]) -> None:
    agent = join("agent-0", {PATH: ["agent-1"], COMMAND: [OPERATOR], TICK: ["agent-1"]})
    peer, operator = join("agent-1"), join(OPERATOR)
    assert until(lambda: agent.alive() == {"agent-0", "agent-1", OPERATOR})
    for i in range(400):
        peer.publish(PATH, str(i).encode())
        peer.publish(TICK, str(i).encode())
    for i in range(20):
        operator.publish(COMMAND, str(i).encode())
    commands: list[tuple[str, bytes]] = []

    def all_commands() -> bool:
        commands.extend(agent.receive(COMMAND))
        return len(commands) >= 20

    assert until(all_commands)
    assert commands == [(OPERATOR, str(i).encode()) for i in range(20)]
    time.sleep(0.3)
    assert agent.receive(PATH) == [("agent-1", str(i).encode()) for i in range(400 - PATH.ring, 400)]
    assert agent.receive(PATH) == []
    ticks = agent.receive(TICK)
    assert len(ticks) <= TICK.ring
    assert ticks[-1] == ("agent-1", b"399")


def test_only_the_requested_senders_and_run_are_received(join: Callable[..., ZenohBus]) -> None:
    agent = join("agent-0", {PATH: ["agent-0", "agent-1"]})
    stranger, foreign, peer = join("agent-2"), join("agent-1", run="other"), join("agent-1")
    assert until(lambda: agent.alive() == {"agent-0", "agent-1", "agent-2"})
    for _ in range(5):
        stranger.publish(PATH, b"stranger")
        foreign.publish(PATH, b"foreign")
        agent.publish(PATH, b"echo")
    peer.publish(PATH, b"peer")
    heard: list[tuple[str, bytes]] = []

    def anything() -> bool:
        heard.extend(agent.receive(PATH))
        return bool(heard)

    assert until(anything)
    time.sleep(0.2)
    heard += agent.receive(PATH)
    assert heard == [("agent-1", b"peer")]
    assert agent.receive(STATUS) == []


def test_a_killed_process_is_seen_at_once_and_a_frozen_one_within_its_lease(
    endpoint: str, join: Callable[..., ZenohBus]
) -> None:
    script = (
        "import sys, time; from swarmctl.bus.zenoh.bus import ZenohBus\n"
        f"bus = ZenohBus({endpoint!r}, 'run', sys.argv[1], {{}}, lease_ms=1000)\ntime.sleep(60)"
    )
    watcher = join("agent-0")
    killed, frozen = (subprocess.Popen([sys.executable, "-c", script, name]) for name in ("agent-1", "agent-2"))
    try:
        assert until(lambda: {"agent-1", "agent-2"} <= watcher.alive())
        os.kill(frozen.pid, signal.SIGSTOP)
        killed.kill()
        assert until(lambda: "agent-1" not in watcher.alive(), 2.0)
        assert until(lambda: "agent-2" not in watcher.alive(), 10.0)
        os.kill(frozen.pid, signal.SIGCONT)
        assert until(lambda: "agent-2" in watcher.alive(), 10.0)
    finally:
        for process in (killed, frozen):
            process.kill()
            process.wait(WAIT_S)


def test_router_lost_and_back() -> None:
    endpoint = f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-test-')}/bus.sock"
    router = start_router(endpoint)
    a, b = ZenohBus(endpoint, "run", "agent-0", {PATH: ["agent-1"]}), ZenohBus(endpoint, "run", "agent-1", {})
    try:
        assert until(lambda: len(a.alive()) == 2)
        router.kill()
        router.wait(WAIT_S)
        assert until(lambda: not a.alive())
        for _ in range(100):
            before_s = time.monotonic()
            b.publish(PATH, b"lost")
            assert time.monotonic() - before_s < 0.5, "publishing never waits for the bus"
        assert router.stdout is not None
        router.stdout.close()
        router = start_router(endpoint)
        assert until(lambda: len(a.alive()) == 2)

        def heard() -> bool:
            b.publish(PATH, b"again")
            time.sleep(0.02)
            return bool(a.receive(PATH))

        assert until(heard)
    finally:
        started_s = time.monotonic()
        a.close()
        b.close()
        end(router)
    assert time.monotonic() - started_s < 10.0


def test_a_flood_holds_up_no_tick(endpoint: str, join: Callable[..., ZenohBus]) -> None:
    """What comes while a ring is drained waits for the next tick."""
    script = (
        "from swarmctl.bus.zenoh.bus import ZenohBus\nfrom swarmctl.bus.topics import PATH\n"
        f"bus = ZenohBus({endpoint!r}, 'run', 'agent-1', {{}})\nwhile True: bus.publish(PATH, b'x' * 100)"
    )
    agent = join("agent-0", {PATH: ["agent-1"]})
    flooding = subprocess.Popen([sys.executable, "-c", script])
    try:
        assert until(lambda: bool(agent.receive(PATH)))
        drained: list[int] = []
        deadline_s = time.monotonic() + 3.0
        while time.monotonic() < deadline_s:
            drained += [len(agent.receive(PATH)) for _ in range(10_000)]
    finally:
        flooding.kill()
        flooding.wait(WAIT_S)
    assert sum(drained) > 100
    assert max(drained) <= PATH.ring


def test_nothing_longer_than_its_topic_allows_is_handed_out(join: Callable[..., ZenohBus]) -> None:
    agent, peer = join("agent-0", {PATH: ["agent-1"]}), join("agent-1")
    assert until(lambda: len(agent.alive()) == 2)
    assert heard_of(agent, peer, bytes(PATH.max_bytes)) == {bytes(PATH.max_bytes)}
    for size in (PATH.max_bytes + 1, 900_000):
        assert heard_of(agent, peer, bytes(size)) == {TOO_LONG}
    peer.publish(PATH, bytes(2_000_000))  # the bus itself drops it
    assert heard_of(agent, peer, bytes(7)) == {bytes(7)}


def heard_of(agent: ZenohBus, peer: ZenohBus, payload: bytes) -> set[bytes]:
    """What one client hands out of what the other publishes, again until it comes: a busy bus drops messages."""
    heard: set[bytes] = set()

    def arrived() -> bool:
        peer.publish(PATH, payload)
        time.sleep(0.1)
        heard.update(message for _, message in agent.receive(PATH))
        return bool(heard)

    assert until(arrived)
    time.sleep(0.5)
    agent.receive(PATH)  # what was repeated and came late
    return heard


def test_a_token_has_come_once_however_many_processes_hold_it(join: Callable[..., ZenohBus]) -> None:
    watcher, first = join("agent-0"), join("agent-1")
    assert until(lambda: dict(watcher.arrivals()) == {"agent-0": 1, "agent-1": 1})
    second = join("agent-1")
    time.sleep(0.3)
    first.close()
    time.sleep(0.3)
    assert "agent-1" in watcher.alive()
    assert dict(watcher.arrivals()) == {"agent-0": 1, "agent-1": 1}
    second.close()
    assert until(lambda: "agent-1" not in watcher.alive())
    join("agent-1")
    assert until(lambda: dict(watcher.arrivals()) == {"agent-0": 1, "agent-1": 2})


def test_one_that_left_and_came_back_between_two_looks_has_come_twice(join: Callable[..., ZenohBus]) -> None:
    watcher, witness, first = join("agent-0"), join("agent-2"), join("agent-1")
    assert until(lambda: "agent-1" in watcher.alive() and "agent-1" in witness.alive())
    first.close()
    assert until(lambda: "agent-1" not in witness.alive())
    join("agent-1")
    assert until(lambda: "agent-1" in witness.alive())
    time.sleep(0.5)  # the watcher's session has most likely been told both by now
    assert until(lambda: watcher.arrivals()["agent-1"] == 2)
    assert "agent-1" in watcher.alive()


def test_a_closed_bus_is_silent_and_never_raises(join: Callable[..., ZenohBus]) -> None:
    a, b = join("agent-0", {PATH: ["agent-1"]}), join("agent-1")
    assert until(lambda: len(b.alive()) == 2)
    a.close()
    a.publish(PATH, b"x")
    assert a.receive(PATH) == []
    a.alive()
    a.close()
    assert until(lambda: b.alive() == {"agent-1"})


def test_refusals_name_endpoint_and_fix(endpoint: str, tmp_path: Path) -> None:
    with pytest.raises(StartError, match=r"absent.sock.*python -m swarmctl.bus.network.router"):
        ZenohBus(f"{SCHEME}{tmp_path}/absent.sock", "run", "agent-0", {}, connect_timeout_ms=300)
    tmp_path.chmod(0o755)
    for bad, word, code in (
        (endpoint, "another router", EXIT_START),
        (f"{SCHEME}{tmp_path}/bus.sock", "0700", EXIT_START),
        (f"{SCHEME}/tmp/{'x' * 200}/bus.sock", "longer", EXIT_START),
        ("tcp/127.0.0.1:7447", SCHEME, EXIT_USAGE),
    ):
        command = [sys.executable, "-m", "swarmctl.bus.network.router", bad]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert answer.returncode == code, answer
        assert word in answer.stderr
        assert bad in answer.stderr


def test_router_ignores_ctrl_c_and_dies_with_a_killed_parent() -> None:
    directory = Path(tempfile.mkdtemp(prefix="swarm-test-"))
    endpoint = f"{SCHEME}{directory}/bus.sock"
    script = (
        "import subprocess, sys, time\n"
        f"p = subprocess.Popen([sys.executable, '-m', 'swarmctl.bus.network.router', {endpoint!r}, "
        "'--die-with-parent'], start_new_session=True)\nprint(p.pid, flush=True)\ntime.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert until(lambda: (directory / "bus.sock").exists())
    os.kill(pid, signal.SIGINT)
    time.sleep(0.3)
    assert (directory / "bus.sock").exists()
    parent.kill()
    parent.wait(WAIT_S)
    parent.stdout.close()
    assert until(lambda: not directory.exists()), "socket and directory are gone although nobody asked the router"


def test_standard_output_of_a_router_ends_when_it_is_ready() -> None:
    """Zenoh writes errors there: a router whose output nobody read blocked in the middle of one, and never ended."""
    router = start_router(f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-test-')}/bus.sock")
    assert router.stdout is not None
    try:
        readable, _, _ = select.select([router.stdout], [], [], WAIT_S)
        assert readable and router.stdout.read() == ""
        assert router.poll() is None, "the output of a router that has ended ends too"
    finally:
        router.terminate()
    assert router.wait(WAIT_S) == 0
    router.stdout.close()


def test_who_is_heard_can_change_in_flight(join: Callable[..., ZenohBus]) -> None:
    agent, one, two = join("agent-0", {PATH: ["agent-1", "agent-2"]}), join("agent-1"), join("agent-2")
    assert until(lambda: agent.alive() == {"agent-0", "agent-1", "agent-2"})

    def heard() -> set[str]:
        one.publish(PATH, b"one")
        two.publish(PATH, b"two")
        return {sender for sender, _ in agent.receive(PATH)}

    assert until(lambda: heard() == {"agent-1", "agent-2"})
    agent.hear(PATH, ["agent-2"])
    assert until(lambda: heard() == {"agent-2"})
    deadline_s = time.monotonic() + 0.5
    while time.monotonic() < deadline_s:
        assert "agent-1" not in heard()
        time.sleep(0.02)
    agent.hear(PATH, ["agent-1", "agent-2"])
    assert until(lambda: heard() == {"agent-1", "agent-2"})


def test_a_message_under_the_key_of_another_one_is_dropped_and_counted(
    endpoint: str, join: Callable[..., ZenohBus]
) -> None:
    """Zenoh has confused keys on busy machines: a path of one agent came as that of another one."""
    listener = join("agent-0", {PATH: ["agent-1"]})
    session = open_session(COMMON_SETTINGS | {"mode": "client", "connect/endpoints": [endpoint]})
    key, other = (f"swarm/run/{name}/path" for name in ("agent-1", "agent-2"))
    confused = MarkedPublisher(session, other, reliable=False)
    confused._publisher = session.declare_publisher(key)
    true, plain = MarkedPublisher(session, key, reliable=False), session.declare_publisher(key)
    arrived: list[bytes] = []

    def has_arrived(message: bytes) -> bool:
        true.put(message)
        arrived.extend(payload for _, payload in listener.receive(PATH))
        return message in arrived

    assert until(lambda: has_arrived(b"first"))
    confused.put(b"confused")
    plain.put(b"of another program")
    assert until(lambda: has_arrived(b"last"))
    assert b"confused" not in arrived
    assert b"of another program" in arrived
    assert listener.refused() == [RefusedMessage("agent-1", PATH.name, MISDELIVERED)]
    assert listener.refused() == []
    assert MISDELIVERED in HARMLESS, "nobody has done anything wrong"
    close_session(session)
