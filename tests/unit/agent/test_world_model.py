"""Tests of the world model: bounded input, checked senders, and reports of unresponsive peers."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from swarmctl.agent.sensing.peer_statuses import PeerStatuses
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import (
    MAX_OBSTACLES,
    MAX_VERSION_STEP,
    CommandMessage,
    EndedMessage,
    decode_obstacles,
    encode_message,
    first_list,
)
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.network.hosts import HostParams
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.bus.peers.senders import Presence
from swarmctl.bus.refusals import Refusals
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.clock import SimClock
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import EXCLUDE, PEER
from swarmctl.core.trajectory import resting
from swarmctl.core.types import FlightMode, Landed, Mode, Phase
from tests import builders
from tests.benches.sealed_hub import SealedHub
from tests.unit.bus.test_topics import STATUS

BALL = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0, visibility_m=100.0)
HERE = np.array([0.0, 0.0, -2.0])
TICK_US = 20_000


@dataclass
class Bench:
    """Agent 0 among agents 1 and 2, and an operator."""

    clock: SimClock = field(default_factory=SimClock)
    events: list[dict[str, Any]] = field(default_factory=list)
    seq: int = 0
    quorum: int = 1
    rate_hz: float = 50.0
    path_s: float = 0.02
    connect: Callable[[LocalHub, str], Bus] = LocalHub.connect

    def __post_init__(self) -> None:
        self.hub = LocalHub(self.clock.now_us)
        self.bus = self.connect(self.hub, agent_name(0))
        self.peer, self.operator = self.hub.connect(agent_name(1)), self.hub.connect(topics.OPERATOR)
        note = lambda name, **fields: self.events.append({"event": name, **fields})  # noqa: E731
        vouchers = {topics.OPERATOR: {0, 1, 2}, "bravo": {1}}
        self.world_model = WorldModel(
            0,
            [1, 2],
            SeparationParams(),
            self.bus,
            utc_us=self.clock.utc_us,
            rate_hz=self.rate_hz,
            path_s=self.path_s,
            note=note,
            vouchers=vouchers,
            quorum=self.quorum,
            model=VehicleModelParams(),
        )

    def tick(self) -> list[str]:
        self.clock.advance(TICK_US)
        return [order.verb for order in self.world_model.receive(self.clock.utc_us())]

    def say_path(self, boot_id: int = 1) -> None:
        self.seq += 1
        path = builders.predicted_path(
            boot_id=boot_id, seq=self.seq, t0_utc_us=self.clock.utc_us(), dt_us=TICK_US, pos_ned_m=np.tile(HERE, (5, 1))
        )
        self.peer.publish(topics.PATH, encode_path(path))

    def say_status(self, **fields: Any) -> None:
        said = msgspec.structs.replace(STATUS, agent=1, ticks=self.seq, ready_utc_us=0, utc_us=self.clock.utc_us())
        self.peer.publish(topics.STATUS, encode_message(msgspec.structs.replace(said, **fields)))

    def set_obstacles(self, count: int, version: int) -> None:
        self.operator.publish(
            topics.OBSTACLES, encode_message(first_list((BALL,) * count, self.clock.utc_us(), version))
        )
        self.tick()

    @property
    def seen(self) -> int:
        return len(self.world_model.keep_outs(HERE, self.clock.utc_us(), 100_000, 25, phase=Phase.TRACK))

    @property
    def rejected(self) -> dict[str, int]:
        return dict(self.world_model.refusals.by_reason)

    @property
    def unresponsive(self) -> list[dict[str, Any]]:
        return [row for row in self.events if row["event"] == "unresponsive"]


def test_a_list_of_too_many_obstacles_is_refused_and_reported() -> None:
    bench = Bench()
    bench.set_obstacles(MAX_OBSTACLES, 1)
    assert bench.seen == MAX_OBSTACLES
    for count in (MAX_OBSTACLES + 1, 6000):  # the longer one is not even decoded
        bench.set_obstacles(count, 2)
    assert bench.seen == MAX_OBSTACLES
    assert bench.rejected == {"malformed": 2}
    assert bench.world_model.refusals.alert(bench.clock.utc_us()) == "obstacles of operator refused: malformed"


def cost_s(bench: Bench) -> float:
    """Return the processor time that keep-outs and bodies take in one tick."""
    began_s = time.thread_time()
    bench.world_model.keep_outs(HERE, bench.clock.utc_us(), 100_000, 25, phase=Phase.TRACK)
    bench.world_model.bodies(HERE, bench.clock.utc_us(), 0.1, 0.1, committed_peers={})
    return time.thread_time() - began_s


def test_the_cost_of_obstacles_grows_no_faster_than_their_number() -> None:
    """Ticks with few and with many take turns, because processors change their speed."""
    few, many = Bench(), Bench()
    few.set_obstacles(MAX_OBSTACLES // 8, 1)
    many.set_obstacles(MAX_OBSTACLES, 1)
    ratios = [cost_s(many) / cost_s(few) for _ in range(60)]
    assert statistics.median(ratios) < 10.0, "8 times at most, and noise"


def test_a_version_far_ahead_does_not_block_later_ones() -> None:
    bench = Bench()
    bench.set_obstacles(1, 7)
    bench.set_obstacles(3, 2**62)
    assert (bench.seen, bench.rejected) == (1, {"sequence": 1})
    bench.set_obstacles(2, 8)
    assert bench.seen == 2
    bench.set_obstacles(1, 8)
    bench.set_obstacles(1, 7)
    assert (bench.seen, bench.rejected) == (2, {"sequence": 1}), "what the launcher repeats is not refused, just known"
    bench.set_obstacles(4, 8 + MAX_VERSION_STEP)
    assert bench.seen == 4


def test_a_list_of_obstacles_is_noted_as_it_was_received_when_it_is_another() -> None:
    bench = Bench()
    for count, version in ((0, 1), (1, 2), (1, 2), (2, 3)):
        bench.set_obstacles(count, version)
    noted = [row for row in bench.events if row["event"] == "obstacles_changed"]
    messages = [decode_obstacles(row["listed"].encode()) for row in noted]
    assert [(m.version, len(m.obstacles)) for m in messages if m] == [(2, 1), (3, 2)], "not what is only repeated"
    assert messages[0] is not None and messages[0].obstacles[0].obstacle == BALL


def test_a_peer_refused_for_long_counts_as_bus_loss_and_is_avoided_at_any_height() -> None:
    """The peer is on the bus and alive, but every path it publishes has a stamp in the future."""
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=int(Phase.TRACK))
    for _ in range(100):
        bench.tick()
        bench.seq += 1
        ahead = bench.clock.utc_us() + 600_000
        path = builders.predicted_path(seq=bench.seq, t0_utc_us=ahead, dt_us=TICK_US, pos_ned_m=np.tile(HERE, (5, 1)))
        bench.peer.publish(topics.PATH, encode_path(path))
    utc_us = bench.clock.utc_us()
    assert bench.world_model.has_unresponsive_peer(utc_us)
    far_ned_m = np.array([5.0, 0.0, 0.0])
    kept, stopped = bench.world_model.keep_outs(HERE + far_ned_m, utc_us, 100_000, 5, phase=Phase.TRACK)
    assert stopped.any_height and stopped.radius_m == kept.radius_m, "it may fly as it planned, or have stopped"
    assert stopped.key != kept.key
    assert kept.any_height and kept.radius_m > SeparationParams().radius_m + 0.9
    kept, _ = bench.world_model.keep_outs(HERE + 0.3 * far_ned_m, utc_us, 100_000, 5, phase=Phase.TRACK)
    assert kept.radius_m == pytest.approx(1.5), "who is nearer comes no closer, and is not driven away"
    kept, _ = bench.world_model.keep_outs(HERE, utc_us, 100_000, 5, phase=Phase.TRACK)
    assert kept.radius_m == pytest.approx(SeparationParams().radius_m)
    assert bench.world_model.refusals.alert(utc_us) == "path of agent-1 refused: future"
    assert bench.unresponsive == [{"event": "unresponsive", "agent": 1, "begins": True}]
    assert [row["count"] for row in bench.events if row["event"] == "refused"] == [1, 51]
    bench.say_path()
    bench.tick()
    assert not bench.world_model.has_unresponsive_peer(bench.clock.utc_us())
    assert bench.unresponsive[1]["begins"] is False
    assert bench.unresponsive[1]["lasted_s"] == pytest.approx(2.0, abs=0.1)


def test_who_has_just_come_within_reach_is_expected_on_its_path_alone() -> None:
    """Of those out of reach, paths are heard now and then: an old one is no silence."""
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=int(Phase.TRACK))
    bench.tick()

    def kept() -> int:
        return len(bench.world_model.keep_outs(HERE, bench.clock.utc_us(), 100_000, 5, phase=Phase.TRACK))

    assert kept() == 1
    bench.clock.advance(300_000)
    assert kept() == 2
    bench.world_model.paths.attend([], bench.clock.utc_us())
    bench.world_model.paths.attend([1], bench.clock.utc_us())
    assert kept() == 1


@pytest.mark.parametrize(("peers", "silent_s"), [(1, 0.5), (2, 0.3)])
def test_several_that_fall_silent_at_once_are_noticed_sooner_than_one(peers: int, silent_s: float) -> None:
    """One may have lost a few messages; all of them have not."""
    bench = Bench()
    for agent in range(1, peers + 1):
        path = builders.predicted_path(
            agent=agent, t0_utc_us=bench.clock.utc_us(), dt_us=TICK_US, pos_ned_m=np.tile(HERE, (5, 1))
        )
        bench.hub.carry(agent_name(agent), topics.PATH, encode_path(path))
    waited_us = 0
    while not bench.world_model.has_unresponsive_peer(bench.clock.utc_us()):
        bench.tick()
        waited_us += TICK_US
        assert waited_us < 2_000_000
    assert waited_us * 1e-6 == pytest.approx(silent_s, abs=0.05)


@pytest.mark.parametrize(("quorum", "may_fly_on"), [(1, False), (2, False), (3, True)])
def test_a_silent_peer_that_has_left_counts_as_dead_where_enough_others_are_there(
    quorum: int, may_fly_on: bool
) -> None:
    """From another computer it may be cut off, and fly on: who sees too few may be the one that is cut off."""
    bench = Bench(quorum=quorum)
    others = bench.hub.connect(agent_name(2))
    bench.say_path()
    bench.say_status()
    bench.tick()
    bench.peer.close()
    bench.clock.advance(2_000_000)
    assert bench.world_model.has_unresponsive_peer(bench.clock.utc_us()) is may_fly_on
    bench.world_model.statuses.exclude(1)
    assert not bench.world_model.has_unresponsive_peer(bench.clock.utc_us()), "somebody vouches for it"
    others.close()


@pytest.mark.parametrize("why", ["gone", "done"])
def test_a_peer_that_died_or_landed_is_not_reported_unresponsive(why: str) -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=int(Phase.DONE if why == "done" else Phase.TRACK))
    bench.tick()
    if why == "gone":
        bench.peer.close()
    for _ in range(100):
        bench.tick()
    assert bench.unresponsive == []


def test_statuses_are_accepted_like_paths_and_future_ready_times_refused() -> None:
    bench = Bench()
    for _ in range(5):
        bench.seq += 10
        bench.say_status(phase=int(Phase.READY), ready_utc_us=7)
        for _ in range(10):
            bench.tick()
    ready = bench.world_model.statuses.inputs()[1]
    assert (ready.phase, ready.ready_utc_us, ready.alive) == (Phase.READY, 7, True)
    bench.say_status(phase=int(Phase.DONE), boot_id=STATUS.boot_id + 1)
    bench.say_status(phase=int(Phase.DONE), ticks=2**62)
    bench.say_status(phase=int(Phase.READY), ready_utc_us=bench.clock.utc_us() + 2_000_000)
    bench.tick()
    assert bench.world_model.statuses.inputs()[1] == ready
    assert bench.rejected == {"unconfirmed": 2, "future": 1}


@pytest.mark.parametrize(("ahead_us", "measured"), [(300_000, True), (9_000_000, True), (-9_000_000, True), (0, False)])
def test_in_best_effort_statuses_measure_clocks_by_which_paths_and_ready_times_are_taken(
    ahead_us: int, measured: bool
) -> None:
    """A status says when those of the receiver have arrived, by the clock of its sender."""
    bench = Bench()
    for _ in range(3):
        bench.seq += 10
        its_us = bench.clock.utc_us() + ahead_us
        bench.say_status(utc_us=its_us, ready_utc_us=its_us, lags_us={0: ahead_us + 10_000}, uses_commitments=False)
        bench.tick()
    assert bench.rejected == {}
    assert bench.world_model.clocks.ahead_us(1) == pytest.approx(ahead_us, abs=15_000)
    assert bench.world_model.statuses.inputs()[1].ready_utc_us == pytest.approx(
        bench.clock.utc_us(), abs=15_000 + TICK_US
    )
    assert bench.world_model.statuses.next_lags_us(bench.clock.utc_us()) == {1: TICK_US - ahead_us}
    assert any(event["event"] == "clock_offset" for event in bench.events) is measured
    bench.clock.advance(2_000_000)
    assert bench.world_model.statuses.next_lags_us(bench.clock.utc_us()) == {}, "a clock drifts"


def restarted(back_us: int, seconds: float, *, copies: int = 1) -> Bench:
    """Return who has heard agent 1 for two seconds, and since then another process of it, by a clock that was set back.

    Args:
        back_us: by how much.
        seconds: for how long it has spoken.
        copies: of each status, as over several ways.
    """
    bench = Bench()
    for _ in range(10):
        bench.seq += 10
        bench.say_status(boot_id=70, uses_commitments=False)
        for _ in range(10):
            bench.tick()
    bench.peer.close()
    for _ in range(50):
        bench.tick()
    bench.peer, bench.seq = bench.hub.connect(agent_name(1)), 0
    for _ in range(round(5 * seconds)):
        bench.seq += 10
        for _ in range(copies):
            bench.say_status(boot_id=60, utc_us=bench.clock.utc_us() - back_us, uses_commitments=False)
        for _ in range(10):
            bench.tick()
    return bench


def gone_back(bench: Bench) -> list[dict[str, Any]]:
    return [event for event in bench.events if event["event"] == "clock_gone_back"]


@pytest.mark.parametrize("copies", [1, 2])
def test_a_restart_by_a_clock_that_has_gone_back_is_told_once_with_what_to_do(copies: int) -> None:
    """What it says looks like what was said before: it is refused, as that could be sent again by anybody."""
    bench = restarted(8_000_000, 4.0, copies=copies)
    assert bench.rejected == {"replayed": 20 * copies}
    assert bench.world_model.statuses.boot_id(1) == 70
    (told,) = gone_back(bench)
    assert told["agent"] == 1
    assert told["by_s"] == pytest.approx(8.0, abs=0.1)
    alert = bench.world_model.clocks.alert
    assert alert.startswith("clock of agent-1 may have gone back by 8.0 s"), alert
    assert "Set the clocks of the hosts (chrony, PTP), then start agent-1 again" in alert


def test_a_clock_that_has_gone_back_is_told_of_until_its_peer_is_believed() -> None:
    bench = restarted(8_000_000, 10.0)
    assert bench.world_model.statuses.boot_id(1) == 60, "its clock has passed the begin of the process before"
    assert len(gone_back(bench)) == 1
    assert "gone back" not in bench.world_model.clocks.alert


@pytest.mark.parametrize("by", ["operator", "supervisor"])
def test_a_clock_that_has_gone_back_is_not_told_of_once_its_peer_has_ended(by: str) -> None:
    """Who was switched off for it stayed the alert of everybody else."""
    bench = restarted(8_000_000, 4.0)
    if by == "operator":
        bench.world_model.statuses.exclude(1)
    else:
        bench.hub.carry("bravo", topics.ENDED, encode_message(EndedMessage(agent=1, boot_id=60, is_down=True)))
        bench.tick()
    assert bench.world_model.clocks.alert == ""


def test_a_restart_by_a_clock_that_has_not_gone_back_tells_nothing_of_it() -> None:
    bench = restarted(0, 4.0)
    assert bench.world_model.statuses.boot_id(1) == 60
    assert gone_back(bench) == []


def test_what_an_ended_process_has_said_comes_again_beside_the_one_that_follows_and_tells_nothing_of_clocks() -> None:
    bench, seq = restarted(0, 2.0), 0
    for _ in range(20):
        seq, bench.seq = seq + 10, bench.seq + 10
        bench.say_status(boot_id=50, ticks=seq, utc_us=bench.clock.utc_us() - 30_000_000)
        bench.say_status(boot_id=60)
        for _ in range(10):
            bench.tick()
    assert bench.rejected["replayed"] == 20
    assert gone_back(bench) == []


HOSTS = [
    HostParams(name=name, address=f"127.0.0.1:{7000 + agent}", agents=(agent,)) for agent, name in enumerate("abc")
]


class SealedPeer:
    """Agent 1 on another computer, whose clock is behind; agent 0 hears it at 5 Hz."""

    def __init__(self, folder: Path) -> None:
        sealed = SealedHub.of(HOSTS, folder)
        self.bench = Bench(connect=lambda hub, name: sealed.connect(hub, name, None))
        self.sealer = sealed.sealer("b", agent_name(1))

    def speak(self, seconds: float, behind_us: int) -> str:
        """Have it speak by such a clock; return the alert then."""
        bench = self.bench
        for _ in range(round(5 * seconds)):
            bench.seq += 10
            stamp_us = bench.clock.utc_us() - behind_us
            said = msgspec.structs.replace(STATUS, agent=1, ticks=bench.seq, ready_utc_us=0, utc_us=stamp_us)
            sent_us = bench.hub.now_us() - behind_us
            bench.peer.publish(topics.STATUS, self.sealer.seal(topics.STATUS.stream, encode_message(said), sent_us))
            for _ in range(10):
                bench.tick()
        return bench.world_model.clocks.alert


def test_a_peer_whose_clock_is_too_far_behind_to_be_believed_is_told_of_until_it_is(tmp_path: Path) -> None:
    """The seals of its messages are too old, as those of any recording. Who was cut off sends old ones for a moment."""
    peer = SealedPeer(tmp_path)
    peer.bench.clock.advance(60_000_000)
    assert peer.speak(1.8, 15_000_000) == ""
    alert = peer.speak(0.6, 15_000_000)
    assert alert.startswith("clock of agent-1 is more than 10 s behind this one, which is too far"), alert
    assert "Set the clocks of the hosts (chrony, PTP)" in alert
    assert peer.bench.world_model.statuses.boot_id(1) is None
    assert peer.bench.rejected == {"late": 12}
    assert "too far" not in peer.speak(0.4, 0)
    assert peer.bench.world_model.statuses.boot_id(1) == STATUS.boot_id


def test_old_messages_beside_new_ones_tell_of_no_clock(tmp_path: Path) -> None:
    peer = SealedPeer(tmp_path)
    peer.bench.clock.advance(60_000_000)
    for _ in range(20):
        assert peer.speak(0.2, 15_000_000) == ""
        assert peer.speak(0.2, 0) == ""
    peer.bench.clock.advance(20_000_000)
    assert peer.speak(0.2, 15_000_000) == "", "it was cut off, and this has waited"


def test_a_status_that_comes_while_the_agent_is_held_up_says_nothing_of_clocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the begin of a tick and its look at the bus other programs may run, and peers send."""
    bench = Bench()
    receive = bench.bus.receive

    def late(topic: topics.Topic) -> Any:
        if topic is topics.STATUS:
            bench.clock.advance(30_000)
            bench.seq += 10
            bench.say_status(lags_us={0: 80_000}, uses_commitments=False)
            bench.clock.advance(30_000)
        return receive(topic)

    monkeypatch.setattr(bench.bus, "receive", late)
    for _ in range(3):
        bench.tick()
    assert bench.world_model.statuses.inputs()
    assert bench.world_model.clocks.ahead_us(1) == 0


def test_a_status_tells_lags_of_a_few_peers_in_turn() -> None:
    """Its size must not grow with the swarm, whose statuses everybody hears."""
    peers = range(1, 21)
    clock, refusals = SimClock(), Refusals(lambda *_, **__: None)
    hub = LocalHub(clock.now_us)
    bus = hub.connect(agent_name(0))
    statuses = PeerStatuses(
        0,
        peers,
        bus,
        rate_hz=50.0,
        note=lambda *_, **__: None,
        refusals=refusals,
        presence=Presence(bus),
        clocks=PeerClocks(peers, lambda *_, **__: None),
        vouchers={},
    )
    for peer in peers:
        said = msgspec.structs.replace(STATUS, agent=peer, ready_utc_us=0, utc_us=clock.utc_us())
        assert statuses.take(agent_name(peer), encode_message(said), clock.utc_us())
    told = [list(statuses.next_lags_us(clock.utc_us())) for _ in range(3)]
    assert [len(agents) for agents in told] == [8, 8, 8]
    assert told[0] + told[1] + told[2] == [*peers, 1, 2, 3, 4]


def test_statuses_of_another_day_are_refused() -> None:
    bench = Bench()
    bench.say_status(utc_us=bench.clock.utc_us() + 11_000_000)
    bench.tick()
    assert bench.rejected == {"future": 1}
    assert bench.world_model.clocks.alert.startswith("clock of agent-1 is 10.98 s ahead of this one, which is too far")


def test_statuses_that_waited_for_a_late_receiver_are_no_forgeries() -> None:
    """Three are read in one tick: more numbers than its time since the last reading allows."""
    bench = Bench()
    bench.say_status()
    bench.tick()
    for _ in range(3):
        bench.seq += 11
        bench.clock.advance(11 * TICK_US)
        bench.say_status()
    bench.tick()
    bench.seq += 11
    bench.say_status(ticks=bench.seq + 11)  # sent too early by its own stamp
    bench.tick()
    assert bench.rejected == {"unconfirmed": 1}


def test_a_status_under_a_foreign_or_unknown_name_is_refused() -> None:
    bench = Bench()
    bench.say_status(agent=2)
    bench.operator.publish(topics.STATUS, encode_message(STATUS))
    bench.peer.publish(topics.STATUS, b"?")
    bench.tick()
    assert bench.world_model.statuses.inputs() == {}
    assert bench.rejected == {"identity": 2, "malformed": 1}
    stranger = bench.hub.connect(agent_name(7))
    stranger.publish(topics.STATUS, encode_message(msgspec.structs.replace(STATUS, agent=7, ready_utc_us=0)))
    bench.tick()
    assert bench.world_model.statuses.inputs() == {}
    assert bench.rejected == {"identity": 2, "malformed": 1, "unknown_peer": 1}


def test_a_tick_processes_at_most_one_ring_of_messages_per_sender() -> None:
    bench = Bench()
    for _ in range(100):
        bench.say_path(boot_id=bench.seq)
    bench.tick()
    assert bench.world_model.refusals.total + 1 == topics.PATH.ring


def test_whose_end_is_vouched_for_has_ended_until_another_process_is_heard() -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=int(Phase.TRACK))
    bench.tick()
    assert not bench.world_model.statuses.has_ended(1)
    bench.world_model.statuses.exclude(1)
    for _ in range(150):  # it is silent
        bench.tick()
    assert bench.world_model.statuses.has_ended(1)
    assert not bench.world_model.has_unresponsive_peer(bench.clock.utc_us()), "nobody waits for it"
    for _ in range(3):
        bench.seq += 1
        bench.say_status(phase=int(Phase.TRACK), boot_id=STATUS.boot_id + 1)
        bench.tick()
    assert not bench.world_model.statuses.has_ended(1)


def test_a_path_that_was_just_heard_speaks_against_the_word_that_a_peer_has_ended() -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=int(Phase.TRACK))
    bench.tick()
    for _ in range(150):  # out of reach, where statuses are not heard
        bench.seq += 1
        bench.say_path()
        bench.tick()
    assert "was heard" in bench.world_model.life_sign(1, bench.clock.utc_us())
    for _ in range(150):
        bench.tick()
    assert bench.world_model.life_sign(1, bench.clock.utc_us()) == ""


def test_a_silent_peer_for_whom_nobody_vouches_has_not_ended() -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=int(Phase.TRACK))
    bench.tick()
    bench.peer.close()
    for _ in range(150):
        bench.tick()
    assert not bench.world_model.statuses.has_ended(1)


def test_a_moving_obstacle_is_avoided_where_it_is_now_not_where_it_was_when_it_was_added() -> None:
    bench = Bench()
    train = BALL.model_copy(update={"center_ned_m": (30.0, 0.0, -2.0), "vel_ned_m_s": (-2.0, 0.0, 0.0)})
    near = train.model_copy(update={"visibility_m": 15.0})
    message = first_list((train, near), bench.clock.utc_us())
    bench.operator.publish(topics.OBSTACLES, encode_message(message))
    bench.tick()
    assert bench.seen == 1, "the other one is too far to be seen"
    for _ in range(500):  # 10 s
        bench.tick()
    now_us = bench.clock.utc_us()
    for keep_out in bench.world_model.keep_outs(HERE, now_us, 100_000, 25, phase=Phase.TRACK):
        assert keep_out.pos_ned_m[0] == pytest.approx([10.0, 0.0, -2.0], abs=0.05)
        assert keep_out.pos_ned_m[25] == pytest.approx([5.0, 0.0, -2.0], abs=0.05), "2.5 s ahead"
    bodies = bench.world_model.bodies(HERE, now_us, 0.5, 0.1, committed_peers={})
    assert [body.pos_ned_m[0] for body in bodies] == pytest.approx([9.0, 9.0], abs=0.05)


def test_of_two_lists_of_one_version_agents_take_what_the_keepers_take_and_no_proposal() -> None:
    bench = Bench()
    first = first_list((BALL,), bench.clock.utc_us())
    one, three = (
        msgspec.structs.replace(first_list((BALL,) * count, bench.clock.utc_us(), 2), draw=draw)
        for count, draw in ((1, 5), (3, 9))
    )
    proposed = msgspec.structs.replace(first_list((BALL,) * 4, bench.clock.utc_us(), 3), draw=7, proposed=True)
    for message in (first, one, three, one, proposed):
        bench.operator.publish(topics.OBSTACLES, encode_message(message))
        bench.tick()
    assert bench.seen == 3
    assert bench.rejected == {}


def test_a_repeated_list_corrects_the_time_of_obstacles_and_they_stay_seen() -> None:
    bench = Bench()
    train = BALL.model_copy(update={"vel_ned_m_s": (-2.0, 0.0, 0.0)})
    message = first_list((BALL, train), bench.clock.utc_us())
    for later in (message, message.shifted(-1_000_000)):
        bench.operator.publish(topics.OBSTACLES, encode_message(later))
        bench.tick()
        assert bench.seen == 2
    north_m = BALL.center_ned_m[0]
    keep_outs = bench.world_model.keep_outs(HERE, bench.clock.utc_us(), 100_000, 25, phase=Phase.TRACK)
    assert [k.pos_ned_m[0][0] for k in keep_outs] == pytest.approx([north_m, north_m - 2.0], abs=0.1)
    assert bench.world_model.obstacles.landmarks() == [BALL]


def test_obstacles_that_were_seen_stay_known_when_another_is_added() -> None:
    bench = Bench()
    bench.set_obstacles(1, 1)
    assert bench.seen == 1
    known = first_list((BALL,), bench.clock.utc_us() - TICK_US)
    far = BALL.model_copy(update={"center_ned_m": (500.0, 0.0, 0.0)})
    more = msgspec.structs.replace(first_list((BALL, far), known.utc_us, 2), next_number=2)
    bench.operator.publish(topics.OBSTACLES, encode_message(more))
    bench.tick()
    assert bench.world_model.obstacles.landmarks() == [BALL]
    bench.set_obstacles(0, 3)
    assert bench.world_model.obstacles.landmarks() == []


def test_a_landing_knows_obstacles_at_rest_that_were_seen_or_will_be_on_the_way_down() -> None:
    bench = Bench()
    seen = BALL
    deep = BALL.model_copy(update={"center_ned_m": (1.0, 0.0, 60.0), "visibility_m": 3.0})
    beside = deep.model_copy(update={"center_ned_m": (5.0, 0.0, 60.0)})
    above = deep.model_copy(update={"center_ned_m": (1.0, 0.0, -60.0)})
    moving = deep.model_copy(update={"vel_ned_m_s": (0.1, 0.0, 0.0)})
    message = first_list((seen, deep, beside, above, moving), bench.clock.utc_us())
    bench.operator.publish(topics.OBSTACLES, encode_message(message))
    bench.tick()
    assert bench.seen == 1
    assert bench.world_model.obstacles.at_rest(HERE) == [seen, deep]


def test_an_encounter_is_remembered_by_the_obstacles_number_apart_from_peers() -> None:
    bench = Bench()
    bench.say_path()
    bench.set_obstacles(2, 1)
    ticks = [bench.world_model.keep_outs(HERE, bench.clock.utc_us(), 100_000, 25, phase=Phase.TRACK) for _ in range(2)]
    keys = [[keep_out.key for keep_out in keep_outs] for keep_outs in ticks]
    assert keys[0] == keys[1]
    assert len(set(keys[0])) == 3


@pytest.mark.parametrize(
    ("sender", "peer", "believed"), [("bravo", 1, True), ("bravo", 2, False), ("mallory", 1, False)]
)
def test_only_who_runs_an_agent_says_that_it_has_ended(sender: str, peer: int, believed: bool) -> None:
    bench = Bench()
    bench.hub.carry(sender, topics.ENDED, encode_message(EndedMessage(agent=peer, boot_id=1, is_down=False)))
    bench.hub.carry(sender, topics.ENDED, encode_message(CommandMessage("land", -1, bench.clock.utc_us() + 1)))
    assert bench.tick() == []
    assert bench.world_model.statuses.has_ended(1) is believed
    assert bench.world_model.refusals.by_reason == {"malformed": 1, **({} if believed else {"identity": 1})}


def test_an_end_counts_as_soon_as_it_is_told_though_no_peer_is_heard_any_more() -> None:
    bench = Bench()
    bench.say_status(phase=Phase.TRACK)
    bench.tick()
    assert bench.world_model.statuses.ended == set()
    ended = EndedMessage(agent=1, boot_id=STATUS.boot_id, is_down=False)
    bench.hub.carry("bravo", topics.ENDED, encode_message(ended))
    bench.tick()
    assert bench.world_model.statuses.ended == {1}


def test_an_end_that_is_told_again_says_nothing_of_the_next_process() -> None:
    bench = Bench()

    def ended_while_heard(process: int, told: int) -> list[bool]:
        found = []
        for _ in range(4):
            bench.seq += 1
            bench.say_status(phase=int(Phase.STANDBY), boot_id=process)
            bench.hub.carry("bravo", topics.ENDED, encode_message(EndedMessage(agent=1, boot_id=told, is_down=False)))
            bench.tick()
            found.append(bench.world_model.statuses.has_ended(1))
        return found

    assert all(ended_while_heard(1, told=1))
    for _ in range(150):  # it is silent
        bench.tick()
    assert not ended_while_heard(2, told=1)[-1], "another process, which was heard often enough"
    assert all(ended_while_heard(2, told=2))
    assert all(ended_while_heard(2, told=1)), "this is old news"
    assert [row["boot_id"] for row in bench.events if row["event"] == "peer_ended"] == [1, 2]


def test_more_ends_than_an_agent_has_processes_are_refused() -> None:
    bench = Bench()
    for boot_id in range(70):
        bench.hub.carry("bravo", topics.ENDED, encode_message(EndedMessage(agent=1, boot_id=boot_id, is_down=False)))
        bench.tick()
    assert len([row for row in bench.events if row["event"] == "peer_ended"]) == 64
    assert bench.world_model.refusals.by_reason == {"sequence": 6}


def test_what_an_operator_says_of_a_peer_that_was_just_heard_is_doubted() -> None:
    bench = Bench()
    assert bench.world_model.life_sign(1, bench.clock.utc_us()) == "", "it has never been heard"
    bench.peer.publish(topics.STATUS, encode_message(builders.status_message(agent=1)))
    bench.tick()
    heard_us = bench.clock.utc_us()
    assert "heard 1.5 s ago, so it has not ended" in bench.world_model.life_sign(1, heard_us + 1_500_000)
    assert bench.world_model.life_sign(1, heard_us + 2_000_000) == ""
    bench.world_model.statuses.exclude(1)  # as a supervisor says that has seen its process end
    assert bench.world_model.life_sign(1, heard_us) == ""


def test_who_has_never_been_heard_is_excused_until_it_is_heard() -> None:
    bench = Bench()
    order = CommandMessage(EXCLUDE, -1, bench.clock.utc_us(), {PEER: 1})
    bench.hub.carry(topics.OPERATOR, topics.COMMAND, encode_message(order))
    assert bench.tick() == [EXCLUDE]
    bench.world_model.statuses.exclude(1)  # as the agent obeys
    assert bench.world_model.statuses.excused == {1}
    bench.peer.publish(topics.STATUS, encode_message(builders.status_message(agent=1)))
    bench.tick()
    assert bench.world_model.statuses.excused == set()
    assert not bench.world_model.statuses.has_ended(1), "this is another process than the one that was vouched for"


@pytest.mark.parametrize("boot_id", [None, 7])
def test_who_has_ended_before_it_was_heard_is_waited_for_until_an_operator_excludes_it(boot_id: int | None) -> None:
    """Those who had heard it waited for it on the ground, and those who had not took off without it."""
    bench = Bench()
    ended = EndedMessage(agent=1, boot_id=boot_id, is_down=True)
    bench.hub.carry("bravo", topics.ENDED, encode_message(ended))
    bench.tick()
    assert bench.world_model.statuses.has_ended(1)
    assert bench.world_model.statuses.excused == set()
    bench.world_model.statuses.exclude(1)
    assert bench.world_model.statuses.excused == {1}


def test_who_is_silent_for_long_is_no_company_though_its_token_stays() -> None:
    """A router may keep the token of a computer that was lost for good: nobody would end."""
    bench = Bench()
    bench.say_status(phase=Phase.TRACK)
    bench.tick()
    assert bench.world_model.statuses.has_company(bench.clock.utc_us())
    bench.clock.advance(9_000_000)
    assert bench.world_model.statuses.has_company(bench.clock.utc_us())
    bench.clock.advance(2_000_000)
    assert agent_name(1) in bench.bus.alive()
    assert not bench.world_model.statuses.has_company(bench.clock.utc_us())


def test_who_is_done_or_has_left_is_no_company() -> None:
    bench = Bench()
    bench.say_status(phase=Phase.DONE)
    bench.tick()
    assert not bench.world_model.statuses.has_company(bench.clock.utc_us())
    bench.say_status(phase=Phase.TRACK, ticks=2)
    bench.tick()
    assert bench.world_model.statuses.has_company(bench.clock.utc_us())
    bench.peer.close()
    assert not bench.world_model.statuses.has_company(bench.clock.utc_us())


@pytest.mark.parametrize(
    ("commits", "mode", "silent_s", "share_01"),
    [
        (False, Mode.TRACKING, 0.1, 0.5),
        (False, Mode.PILOT_OVERRIDE, 0.1, 1.0),
        (False, Mode.TRACKING, 3.0, 1.0),
        (True, Mode.TRACKING, 0.1, 0.5),
        (True, Mode.PILOT_OVERRIDE, 0.1, 1.0),
    ],
)
def test_the_safety_filter_takes_half_of_the_avoidance_only_where_that_of_the_peer_takes_the_other_half(
    commits: bool, mode: Mode, silent_s: float, share_01: float
) -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=Phase.TRACK, mode=int(mode))
    bench.tick()
    bench.clock.advance(round(1e6 * silent_s))
    committed = {1: [resting(HERE, bench.clock.utc_us(), TICK_US)]} if commits else {}
    there = HERE + np.array([9.0, 0.0, 0.0])
    bodies = bench.world_model.bodies(there, bench.clock.utc_us(), 0.1, 0.1, committed_peers=committed)
    assert {body.responsibility_01 for body in bodies} == {share_01}


@pytest.mark.parametrize(
    ("mode", "speed_m_s", "landed", "grows"),
    [
        (FlightMode.HOLD, 0.1, Landed.IN_AIR, False),
        (FlightMode.HOLD, 2.0, Landed.IN_AIR, True),
        (FlightMode.LAND, 0.1, Landed.IN_AIR, True),
        (FlightMode.HOLD, 2.0, Landed.ON_GROUND, False),
    ],
    ids=["rests in hold", "is moved in hold", "descends", "stands"],
)
def test_the_margin_of_who_is_done_grows_with_age_while_its_vehicle_moves(
    mode: FlightMode, speed_m_s: float, landed: Landed, grows: bool
) -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(phase=Phase.DONE, flight_mode=mode, ground_speed_m_s=speed_m_s, landed=landed)
    bench.tick()

    def apart_m() -> float:
        there = HERE + np.array([9.0, 0.0, 0.0])
        body, *_ = bench.world_model.bodies(there, bench.clock.utc_us(), 0.1, 0.1, committed_peers={})
        return body.apart_m

    before_m = apart_m()
    bench.clock.advance(500_000)
    assert (apart_m() > before_m + 0.1) is grows


@pytest.mark.parametrize(
    ("mode", "agents", "expected"),
    [(Mode.TRACKING, {1}, [1]), (Mode.TRACKING, {2}, []), (Mode.PILOT_OVERRIDE, {1}, [])],
    ids=["", "another one", "flown by a pilot"],
)
def test_only_vehicles_that_agents_fly_miss_their_setpoints(mode: Mode, agents: set[int], expected: list[int]) -> None:
    bench = Bench()
    bench.say_path()
    bench.say_status(mode=mode, phase=Phase.TRACK)
    bench.tick()
    ways = bench.world_model.ways_without_setpoints(agents, bench.clock.utc_us(), 100_000, 5)
    assert list(ways) == expected
    for points in ways.values():
        np.testing.assert_allclose(points, np.tile(HERE, (6, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("rate_hz", "path_s", "age_s", "ways"),
    [
        (50.0, 0.02, 0.14, 1),
        (50.0, 0.02, 0.18, 2),
        (25.0, 0.04, 0.18, 2),
        (50.0, 0.25, 0.3, 1),
        (10.0, 0.1, 0.38, 1),
        (10.0, 0.1, 0.42, 2),
    ],
)
def test_a_peer_is_expected_without_setpoints_too_once_its_path_is_late(
    rate_hz: float, path_s: float, age_s: float, ways: int
) -> None:
    bench = Bench(rate_hz=rate_hz, path_s=path_s)
    bench.say_path()
    bench.say_status(mode=Mode.TRACKING, phase=Phase.TRACK)
    bench.tick()
    bench.clock.advance(round(1e6 * age_s) - TICK_US)
    (path,) = bench.world_model.paths.latest()
    assert len(bench.world_model._ways(path, bench.clock.utc_us())) == ways


@pytest.mark.parametrize(("error_m", "longest_s"), [(0.0, 0.1), (0.02, 0.25)])
def test_only_event_triggered_paths_are_apart_by_the_heartbeat(error_m: float, longest_s: float) -> None:
    assert PathSharingParams(error_m=error_m, heartbeat_s=0.25).longest_s(10.0) == longest_s
