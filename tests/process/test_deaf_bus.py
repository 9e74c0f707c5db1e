"""A session of Zenoh that sends and is kept alive, but receives nothing: how one comes about, and what replaces it.

Zenoh gives up the opening of a session after a time limit, also when half of it is done. Here the limit is so short
that this happens to some of several sessions which are connected again at once.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

import swarmctl.bus.zenoh_bus as zenoh_bus
from swarmctl.bus.topics import COMMAND, STATUS
from swarmctl.bus.zenoh_bus import SCHEME, ZenohBus
from swarmctl.errors import StartError
from tests.process.test_bus import end, start_router

pytestmark = pytest.mark.process

LISTENERS = 8
NEVER_S = 1e9
MOST_RESTARTS = 10


class Scene:
    """A router that can be restarted, one who speaks, and listeners who speak too."""

    def __init__(self, deaf_s: float) -> None:
        self.endpoint = f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-test-')}/bus.sock"
        self.router = start_router(self.endpoint)
        self.names = [f"agent-{number}" for number in range(1, 1 + LISTENERS)]
        self.talker = ZenohBus(self.endpoint, "run", "agent-0", {COMMAND: self.names})
        self.deaf_s = deaf_s
        self.listeners: list[ZenohBus] = []

    def listen(self) -> None:
        for name in self.names:
            self.listeners.append(self._opened(name))

    def _opened(self, name: str) -> ZenohBus:
        while True:
            try:
                return ZenohBus(self.endpoint, "run", name, {STATUS: ["agent-0"]}, deaf_s=self.deaf_s)
            except StartError:  # the limit was too short for this one
                continue

    def restart_router(self) -> None:
        self.router.kill()
        self.router.wait()
        assert self.router.stdout is not None
        self.router.stdout.close()
        self.router = start_router(self.endpoint)

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Have everybody speak and listen until a condition is true."""
        until_s = time.monotonic() + seconds
        while not condition() and time.monotonic() < until_s:
            self.talker.publish(STATUS, b"status")
            for name, bus in zip(self.names, self.listeners, strict=True):
                bus.publish(COMMAND, b"command")
                if bus.receive(STATUS):
                    self.hearing.add(name)
            self.heard |= {sender for sender, _ in self.talker.receive(COMMAND)}
            time.sleep(0.02)
        return condition()

    def all_hear(self, seconds: float) -> bool:
        """Return whether all listeners come to hear, while all are heard."""
        self.hearing, self.heard = set[str](), set[str]()
        return self.until(lambda: len(self.hearing) == len(self.heard) == LISTENERS, seconds)


@contextmanager
def scene(deaf_s: float) -> Iterator[Scene]:
    opened = Scene(deaf_s)
    try:
        yield opened
    finally:
        closing = [threading.Thread(target=bus.close) for bus in (opened.talker, *opened.listeners)]
        for thread in closing:  # what is deaf closes slowly
            thread.start()
        for thread in closing:
            thread.join()
        end(opened.router)


def test_sessions_that_went_deaf_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(deaf_s=1.0) as flight:
        with monkeypatch.context() as short:
            short.setattr(zenoh_bus, "_CLIENT_OPEN_TIMEOUT_MS", 1)
            flight.listen()
        assert flight.all_hear(10.0)
        for _ in range(MOST_RESTARTS):
            flight.restart_router()
            assert flight.all_hear(15.0)
            if any(bus.reopened() for bus in flight.listeners):
                break
        assert any(bus.reopened() for bus in flight.listeners)
        for bus in flight.listeners:
            assert flight.until(lambda bus=bus: bus.alive() == {"agent-0", *flight.names}, 5.0)  # type: ignore[misc]


def test_control_they_stay_deaf_if_nobody_replaces_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(deaf_s=NEVER_S) as flight:
        with monkeypatch.context() as short:
            short.setattr(zenoh_bus, "_CLIENT_OPEN_TIMEOUT_MS", 1)
            flight.listen()
        assert flight.all_hear(10.0)
        for _ in range(MOST_RESTARTS):
            flight.restart_router()
            if not flight.all_hear(3.0):
                break
        assert len(flight.hearing) < LISTENERS
        assert len(flight.heard) == LISTENERS, "who is deaf is heard"


def test_with_a_time_limit_longer_than_the_routers_nobody_goes_deaf() -> None:
    with scene(deaf_s=NEVER_S) as flight:
        flight.listen()
        assert flight.all_hear(10.0)
        for _ in range(3):
            flight.restart_router()
            assert flight.all_hear(15.0)
