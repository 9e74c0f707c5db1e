"""Tests of forged messages under a peer's name: no peer is silenced, distances are kept, the run reports it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.commitment_messages import decode_trajectory_message, encode_trajectory_message
from swarmctl.bus.messages.json_messages import CommandMessage, decode_status, encode_message
from swarmctl.bus.messages.path_messages import decode_path, encode_path
from swarmctl.bus.peers.senders import ReceivedMessage, SenderVerifier, _Stream
from swarmctl.core.types import Mode, Phase
from swarmctl.telemetry.evaluation.referee import RunData, evaluate
from tests import builders
from tests.closed_loop.conftest import COARSE, Flight, Fly, fly_now, mission_t_s

AGENTS, VICTIM, STRANGER = 4, 1, 999
LAST = 2**32 - 1
CROSSED_S = 4.0  # the agents meet after 3 s
FORGED_S = 2.0
GUARANTEED = "separation.mode=guaranteed"
SWAP = (
    *COARSE,
    f"swarm.agents={AGENTS}",
    "start.positions_ned_m=[[3,0,0],[0,3,0],[-3,0,0],[0,-3,0]]",
    "mission.swap.travel_s=6",
    "mission.duration_s=12",
    "sitl.start=air",
)


def swap(
    fly: Fly, *overrides: str, at: dict[float, Callable[[Lockstep], None]] | None = None, until_s: float = CROSSED_S
) -> Flight:
    return fly(*SWAP, *overrides, config="swap8.toml", at=at, until=lambda running: mission_t_s(running) >= until_s)


def summary(flight: Flight) -> dict[str, Any]:
    """Return the summary of the flight so far as if it had been completed."""
    logs = flight.lockstep.logs
    events = [event for log in logs for event in log.events]
    data = RunData({log.agent: log.ticks for log in logs}, flight.lockstep.truth, events)
    return evaluate(data, replace(flight.config.rules("lockstep"), duration_s=None), "completed")


def say(running: Lockstep, topic: topics.Topic, payload: bytes, name: int = VICTIM) -> None:
    running.hub.carry(agent_name(name), topic, payload)


def forge_paths(running: Lockstep) -> None:
    """Forge two paths under each name, far away and at rest: one with another boot id, one with the highest number."""
    at_us = running.clock.utc_us() + 40_000
    for agent in range(AGENTS):
        away = np.tile([60.0, 20.0 * agent, -2.0], (26, 1))
        for boot, seq in ((STRANGER, 1), (running.config.seed * 1000 + agent, LAST)):
            path = builders.predicted_path(agent=agent, boot_id=boot, seq=seq, t0_utc_us=at_us, pos_ned_m=away)
            say(running, topics.PATH, encode_path(path), agent)


def overhear(heard: list[bytes], topic: topics.Topic) -> Callable[[Lockstep], None]:
    """Record the messages of the victim on a topic."""

    def tap(running: Lockstep) -> None:
        carry = running.hub.carry

        def listen(sender: str, of: topics.Topic, payload: bytes) -> None:
            if sender == agent_name(VICTIM) and of is topic:
                heard.append(payload)
            carry(sender, of, payload)

        running.hub.carry = listen  # type: ignore[method-assign, assignment]

    return tap


@pytest.fixture(scope="module")
def twin() -> Flight:
    """Fly the same flight without forgery."""
    return swap(fly_now)


def test_forged_paths_change_nothing_and_are_reported(fly: Fly, twin: Flight) -> None:
    flight = swap(fly, at={FORGED_S: forge_paths})
    assert twin.separation_m() >= 0.85
    np.testing.assert_array_equal(flight.pos_ned_m, twin.pos_ned_m)
    found = summary(flight)
    assert found["outcome"] == "failed"
    assert sorted(found["violations"]) == [
        f"messages in the name of agent-{i} were refused (path boot 3, path sequence 3) by "
        + ", ".join(f"agent-{j}" for j in range(AGENTS) if j != i)
        for i in range(AGENTS)
    ]
    assert found["comms"]["unresponsive"]["count"] == 0
    assert summary(twin)["violations"] == []


def newest_wins(self: SenderVerifier, received: ReceivedMessage, utc_us: int) -> str:
    """What was believed before there were claims."""
    known, stream = (
        self._accepted,
        _Stream(
            boot_id=received.boot_id,
            seq=received.seq,
            sent_utc_us=received.sent_utc_us,
            received_utc_us=utc_us,
            began_utc_us=utc_us,
        ),
    )
    if known is not None and (received.boot_id, received.seq) < (known.boot_id, known.seq):
        return "replayed"
    self._accepted = stream
    return ""


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_where_the_newest_is_believed_they_meet(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SenderVerifier, "_refusal", newest_wins)
    flight = swap(fly, at={FORGED_S: forge_paths}, until_s=5.0)
    assert flight.separation_m() < 0.1
    found = summary(flight)["comms"]["unresponsive"]
    assert found["longest_s"] > 1.0, "the silenced peer is named"


def test_forged_statuses_have_no_effect(fly: Fly, twin: Flight) -> None:
    heard: list[bytes] = []

    def forge(running: Lockstep) -> None:
        status = decode_status(heard[-1])
        assert status is not None
        done = msgspec.structs.replace(status, phase=int(Phase.DONE), mode=int(Mode.IDLE), ready_utc_us=0)
        for lie in (
            msgspec.structs.replace(done, boot_id=STRANGER),
            msgspec.structs.replace(done, ticks=2**40),
            msgspec.structs.replace(status, ready_utc_us=2**60, ticks=status.ticks + 1),
        ):
            say(running, topics.STATUS, encode_message(lie))

    flight = swap(fly, at={0.0: overhear(heard, topics.STATUS), FORGED_S: forge})
    np.testing.assert_array_equal(flight.pos_ned_m, twin.pos_ned_m)
    (violation,) = summary(flight)["violations"]
    assert "(status boot 3, status sequence 3)" in violation
    rejected = [agent.rejected for agent in flight.lockstep.agents if agent is not None]
    assert [of.get("future", 0) for of in rejected] == [1, 0, 1, 1]


def forge_trajectories(heard: list[bytes], running: Lockstep) -> None:
    """Of another life, and of the highest number: one that is committed to be elsewhere."""
    message = decode_trajectory_message(heard[-1])
    assert message is not None
    away = replace(message.committed, pos_ned_m=message.committed.pos_ned_m + np.array([60.0, 0.0, 0.0]))
    for boot_id, seq in ((STRANGER, 1), (message.boot_id, LAST)):
        lie = replace(message, boot_id=boot_id, seq=seq, committed=away, proposal=None)
        say(running, topics.TRAJECTORY, encode_trajectory_message(lie))


def test_forged_trajectories_break_no_commitment(fly: Fly) -> None:
    heard: list[bytes] = []
    forge = partial(forge_trajectories, heard)
    untouched = swap(fly, GUARANTEED)
    flight = swap(fly, GUARANTEED, at={0.0: overhear(heard, topics.TRAJECTORY), FORGED_S: forge})
    np.testing.assert_array_equal(flight.pos_ned_m, untouched.pos_ned_m)
    (violation,) = summary(flight)["violations"]
    assert "(trajectory boot 3, trajectory sequence 3)" in violation


def test_permanent_forgery_is_reported_and_distances_are_kept(fly: Fly, twin: Flight) -> None:
    flight = swap(fly, at={0.5 + 0.02 * i: forge_paths for i in range(170)})
    np.testing.assert_array_equal(flight.pos_ned_m, twin.pos_ned_m)
    assert len(summary(flight)["violations"]) == AGENTS


def test_late_and_lost_messages_raise_no_forgery_alarm(fly: Fly) -> None:
    flight = swap(fly, "bus.delay_ms=300", "bus.loss_01=0.2")
    assert not [violation for violation in summary(flight)["violations"] if "refused" in violation]


def falls_silent(lie: Callable[[bytes], bytes] | None) -> Callable[[Lockstep], None]:
    """Let the victim's paths reach nobody any more; the last one that would have is changed first."""

    def tap(running: Lockstep) -> None:
        carry, lies = running.hub.carry, [lie] if lie else []

        def last_words(sender: str, of: topics.Topic, payload: bytes) -> None:
            if sender != agent_name(VICTIM) or of is not topics.PATH:
                carry(sender, of, payload)
            elif lies:
                carry(sender, of, lies.pop()(payload))

        running.hub.carry = last_words  # type: ignore[method-assign, assignment]

    return tap


def in_microseconds(payload: bytes) -> bytes:
    path = decode_path(payload)
    assert path is not None
    return encode_path(replace(path, dt_us=1))


def test_a_peer_that_says_points_of_microseconds_and_falls_silent_is_merely_silent(fly: Fly) -> None:
    """Others looked at 2.5 million points of it in each of their ticks, which took 0.9 s."""
    told = swap(fly, at={FORGED_S: falls_silent(in_microseconds)}, until_s=2.5)
    silent = swap(fly, at={FORGED_S: falls_silent(None)}, until_s=2.5)
    np.testing.assert_array_equal(told.pos_ned_m, silent.pos_ned_m)
    rejected = [agent.rejected.get("malformed", 0) for agent in told.lockstep.agents if agent is not None]
    assert rejected == [1, 0, 1, 1]


def test_commands_with_old_or_future_stamps_are_refused_and_the_last_one_counts(fly: Fly) -> None:
    """The commands are a `land` stamped 1970, one stamped in an hour, and a `hold` repeated after its resume."""
    speeds_m_s: list[float] = []

    def order(running: Lockstep, verb: str, at_us: int) -> None:
        message = CommandMessage(verb, -1, at_us)
        running.hub.carry(topics.OPERATOR, topics.COMMAND, encode_message(message))

    def orders(running: Lockstep) -> None:
        now_us = running.clock.utc_us()
        order(running, "land", 0)
        order(running, "hold", now_us - 200_000)
        order(running, "resume", now_us - 100_000)
        order(running, "hold", now_us - 200_000)
        order(running, "land", now_us + 3_600_000_000)

    def look(running: Lockstep) -> None:
        agent = running.agents[0]
        assert agent is not None
        assert agent.rejected == {"stale_order": 1, "future_order": 1, "superseded_order": 1}
        told = [alert.text for alert in agent._alerts._active.values()]  # beside others that began later
        assert "command of operator refused: future_order" in told
        speeds_m_s.append(float(np.linalg.norm(running.logs[0].rows[-1]["vel_ned_m_s"][0])))

    flight = swap(fly, at={1.0: orders, 2.5: look}, until_s=2.6)  # before they meet
    assert speeds_m_s[0] > 0.3
    assert Mode.HOLD not in flight.modes(0, Phase.TRACK)
    assert not (flight.ticks(0)["phase"] > Phase.TRACK).any()
