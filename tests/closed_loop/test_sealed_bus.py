"""Flights over a sealed bus: as over a plain one, bit for bit, also while somebody forges what nobody could tell else.

The intruder goes on from the newest path of its victim exactly as that would: with its boot id, the next number and a
good time. Rules about numbers and rates can't find that; the true sender then looks like the forger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.path_messages import decode_path, encode_path
from swarmctl.bus.network.hosts import HostParams
from swarmctl.bus.network.seals import overhead_bytes
from tests.benches.sealed_hub import SealedHub
from tests.closed_loop.conftest import Flight, Fly, fly_now
from tests.closed_loop.test_forgery import FORGED_S, VICTIM, overhear, summary, swap

HOSTS = [HostParams(name=name, address="127.0.0.1:1", agents=(i,)) for i, name in enumerate(("a", "b", "c", "d"))]
INTRUDER = "c"
UNTIL_S = 4.0
TICK_S = 0.04


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> SealedHub:
    return SealedHub.of(HOSTS, Path(tmp_path_factory.mktemp("identities")))


@pytest.fixture(scope="module")
def twin() -> Flight:
    """Fly over a plain bus without forgery."""
    return swap(fly_now)


def continue_it(heard: list[bytes], seal: Callable[[bytes, int], bytes], seal_bytes: int, running: Lockstep) -> None:
    """Say that the victim is far away, in its next message, before it says anything itself."""
    path = decode_path(heard[-1][seal_bytes:])
    assert path is not None
    away = path.pos_ned_m + np.array([60.0, 0.0, 0.0])
    utc_us = running.clock.utc_us()
    forged = replace(path, seq=path.seq + 1, t0_utc_us=utc_us + 40_000, pos_ned_m=away)
    running.hub.carry(agent_name(VICTIM), topics.PATH, seal(encode_path(forged), utc_us))


def forged(fly: Fly, seal: Callable[[bytes, int], bytes], seal_bytes: int) -> Flight:
    heard: list[bytes] = []
    times_s = np.arange(FORGED_S, UNTIL_S, TICK_S)
    each_tick = {at_s: lambda running: continue_it(heard, seal, seal_bytes, running) for at_s in times_s.tolist()}
    return swap(fly, at={0.0: overhear(heard, topics.PATH), **each_tick}, until_s=UNTIL_S)


def test_a_sealed_flight_is_not_changed_by_who_continues_a_peers_messages(
    fly: Fly, hub: SealedHub, twin: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LocalHub, "connect", hub.connect)
    sealer = hub.sealer(INTRUDER, agent_name(VICTIM))
    flight = forged(
        fly, lambda payload, utc_us: sealer.seal(topics.PATH.name, payload, utc_us), overhead_bytes(hub.roster)
    )
    np.testing.assert_array_equal(flight.pos_ned_m, twin.pos_ned_m)
    (violation,) = summary(flight)["violations"]
    assert violation.startswith(f"messages in the name of agent-{VICTIM} were refused (path forged ")
    assert violation.endswith("by agent-0, agent-2, agent-3")


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_over_a_plain_bus_the_forger_is_believed(fly: Fly) -> None:
    """Where plans keep no more from who comes closer. Ten starts keep 0.46 to 0.88 m, undisturbed at least 0.85 m."""
    this: Fly = partial(fly, "separation.approach_01=0")
    assert swap(this, until_s=UNTIL_S).separation_m() >= 0.85
    assert forged(this, lambda payload, _: payload, 0).separation_m() < 0.7
