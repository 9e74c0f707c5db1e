"""Accepted senders on the real bus: a restarted process at once, a stranger under the same name never."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.bus.peers.senders import SILENCE_US, Presence
from swarmctl.bus.refusals import Refusals
from swarmctl.bus.topics import PATH
from swarmctl.bus.zenoh.bus import ZenohBus
from tests import builders
from tests.process.test_bus import WAIT_S, end, endpoint, join  # noqa: F401  (fixtures)

pytestmark = pytest.mark.process

TICK_S = 0.02
TRUE, REBORN, FORGED = 70, 71, 999
PEER = """
import sys, time
import numpy as np
from swarmctl.core.types import PredictedPath
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.topics import PATH
bus = ZenohBus(sys.argv[1], "run", "agent-1", {}, lease_ms=1000)
seq = 0
while True:
    seq += 1
    t0_us = time.time_ns() // 1000 + 40_000
    path = PredictedPath(
        agent=1,
        boot_id=int(sys.argv[2]),
        seq=seq,
        t0_utc_us=t0_us,
        dt_us=100_000,
        margin_m=0.0,
        pos_ned_m=np.zeros((5, 3)),
    )
    bus.publish(PATH, encode_path(path))
    time.sleep(0.02)
"""


def now_us() -> int:
    return time.time_ns() // 1000


class Listener:
    """Agent 0, at 50 Hz."""

    def __init__(self, bus: ZenohBus) -> None:
        self._bus = bus
        self.refusals = Refusals(lambda *_, **__: None)
        self.presence = Presence(bus)
        self.paths = PeerPaths([1], 1 / TICK_S, self.refusals, self.presence)
        self.worst_age_s = 0.0

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Whether it came true in time."""
        deadline_s = time.monotonic() + seconds
        self.worst_age_s = 0.0
        while time.monotonic() < deadline_s:
            if until():
                return True
            self.presence.update(now_us())
            for sender, payload in self._bus.receive(PATH):
                self.paths.offer(sender, payload, now_us())
            for path in self.paths.latest():
                self.worst_age_s = max(self.worst_age_s, (now_us() - path.t0_utc_us) * 1e-6)
            time.sleep(TICK_S)
        return until()

    def believes(self, boot_id: int) -> bool:
        return any(path.boot_id == boot_id for path in self.paths.latest())

    def hears_of(self, reason: str) -> bool:
        return self.refusals.by_reason[reason] > 0


@pytest.fixture
def start(endpoint: str) -> Iterator[Callable[[int], subprocess.Popen[bytes]]]:  # noqa: F811
    started: list[subprocess.Popen[bytes]] = []

    def starter(boot_id: int) -> subprocess.Popen[bytes]:
        started.append(subprocess.Popen([sys.executable, "-c", PEER, endpoint, str(boot_id)]))
        return started[-1]

    yield starter
    for process in started:
        process.kill()
        process.wait(WAIT_S)


@pytest.fixture
def listener(join: Callable[..., ZenohBus]) -> Listener:  # noqa: F811
    return Listener(join(agent_name(0), {PATH: [agent_name(1)]}))


def forge(bus: ZenohBus, boot_id: int, seq: int) -> None:
    away = np.tile([60.0, 0.0, -2.0], (5, 1))
    bus.publish(
        PATH,
        encode_path(builders.predicted_path(boot_id=boot_id, seq=seq, t0_utc_us=now_us() + 40_000, pos_ned_m=away)),
    )


def test_a_restarted_peer_is_believed_with_its_first_words(
    listener: Listener, start: Callable[[int], subprocess.Popen[bytes]]
) -> None:
    first = start(TRUE)
    assert listener.listen(WAIT_S, lambda: listener.believes(TRUE))
    listener.listen(0.5)
    first.kill()
    start(REBORN)
    assert listener.listen(WAIT_S, lambda: listener.hears_of("unconfirmed"))
    assert listener.listen(0.5, lambda: listener.believes(REBORN)), "within ticks of the first that came"
    listener.listen(0.5)
    assert not {"boot", "sequence"} & listener.refusals.by_reason.keys()


def test_a_peer_restarted_beside_its_frozen_former_self_is_believed_after_silence(
    listener: Listener, start: Callable[[int], subprocess.Popen[bytes]]
) -> None:
    first = start(TRUE)
    assert listener.listen(WAIT_S, lambda: listener.believes(TRUE))
    second = start(REBORN)
    assert listener.listen(WAIT_S, lambda: listener.hears_of("boot")), "two speak at once"
    first.send_signal(signal.SIGSTOP)
    assert listener.listen(SILENCE_US * 1e-6 + 1.0, lambda: listener.believes(REBORN))
    assert second.poll() is None


def test_a_stranger_silences_no_agent(
    listener: Listener,
    start: Callable[[int], subprocess.Popen[bytes]],
    join: Callable[..., ZenohBus],  # noqa: F811
) -> None:
    start(TRUE)
    assert listener.listen(WAIT_S, lambda: listener.believes(TRUE))
    stranger = join(agent_name(1))  # holds a token of that name, too
    listener.listen(0.5)
    for boot_id, seq in ((FORGED, 1), (TRUE, 2**32 - 1), (FORGED, 2**32 - 1)):
        forge(stranger, boot_id, seq)
        listener.listen(0.5)
        assert listener.believes(TRUE)
        assert listener.worst_age_s < 0.4
    for seq in range(100):
        forge(stranger, FORGED, 2 + seq)
        listener.listen(TICK_S)
        assert listener.believes(TRUE)
    stranger.close()
    listener.listen(0.5)
    assert listener.believes(TRUE) and listener.worst_age_s < 0.4
    assert listener.refusals.by_reason["boot"] > 80
    assert listener.refusals.by_reason["sequence"] == 1
