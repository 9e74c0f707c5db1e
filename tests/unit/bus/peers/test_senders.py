"""Acceptance of messages by sender: restarts in every order of events, forgeries, and network effects."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from swarmctl.bus.local.hub import LocalBus, LocalHub
from swarmctl.bus.peers.senders import SILENCE_US, Arrivals, Presence, ReceivedMessage, SenderVerifier, _Stream
from swarmctl.bus.refusals import HARMLESS, Refusals
from swarmctl.core.clock import SimClock

RATE_HZ, TICK_US = 50.0, 20_000
TRUE, REBORN, FORGED = 70, 3, 999
LAST = 2**32 - 1


@dataclass(kw_only=True)
class Bench:
    """One agent that receives a message of agent-1 every tick, unless that is silent."""

    clock: SimClock = field(default_factory=SimClock)
    seq: dict[int, int] = field(default_factory=dict)
    accepted: list[tuple[int, int]] = field(default_factory=list)  # (tick, boot id)
    told: list[dict[str, object]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.hub = LocalHub(self.clock.now_us)
        self.refusals = Refusals(lambda _, **fields: self.told.append(fields))
        self.presence = Presence(self.hub.connect("agent-0"))
        self.token: LocalBus = self.hub.connect("agent-1")
        self.verifier = SenderVerifier("agent-1", "path", RATE_HZ, self.refusals, presence=self.presence)

    def ticks(self, count: int, boots: Iterable[int] = (TRUE,), late_us: int = 0) -> None:
        """Advance ticks, in each of which the given processes publish their next message."""
        for _ in range(count):
            self.clock.advance(TICK_US)
            for boot_id in boots:
                self.seq[boot_id] = self.seq.get(boot_id, 0) + 1
                self.offer(boot_id, self.seq[boot_id], -late_us)
            self.presence.update(self.clock.utc_us())

    def offer(self, boot_id: int, seq: int, shift_us: int = 0, content: bytes = b"") -> bool:
        utc_us = self.clock.utc_us()
        self.presence.update(utc_us)
        received = ReceivedMessage(boot_id, seq, utc_us + shift_us, content or f"{boot_id} {seq}".encode())
        if not self.verifier.accepts(received, utc_us):
            return False
        self.accepted.append((utc_us // TICK_US, boot_id))
        return True

    def leave(self) -> None:
        self.token.close()
        self.presence.update(self.clock.utc_us())

    def come(self) -> None:
        self.token = self.hub.connect("agent-1")
        self.presence.update(self.clock.utc_us())

    def accepted_s(self, boot_id: int, since: int) -> float:
        """Return the time [s] from tick `since` until messages of a boot id are accepted."""
        return min(tick for tick, boot in self.accepted if boot == boot_id and tick >= since) * 0.02 - since * 0.02

    @property
    def tick(self) -> int:
        return self.clock.utc_us() // TICK_US

    @property
    def accused(self) -> dict[str, int]:
        return {reason: n for reason, n in self.refusals.by_reason.items() if reason not in HARMLESS}


@pytest.mark.parametrize("shift_us", [0, 400_000, -400_000])
@pytest.mark.parametrize(("boot_id", "seq"), [(FORGED, 1), (FORGED, LAST), (TRUE, LAST), (TRUE, 5000), (0, 0)])
def test_one_forged_message_locks_out_no_sender(boot_id: int, seq: int, shift_us: int) -> None:
    bench = Bench()
    bench.ticks(50)
    assert not bench.offer(boot_id, seq, shift_us)
    bench.ticks(50)
    assert len(bench.accepted) == 100
    assert sum(bench.refusals.by_reason.values()) == bench.refusals.total == 1
    if shift_us < 400_000:  # else what follows may have been sent before
        assert sum(bench.accused.values()) == 1


def test_controls_without_these_rules_one_message_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here any higher number is accepted, and any boot id with a later stamp."""
    with monkeypatch.context() as patch:
        patch.setattr(_Stream, "continues", lambda self, new, *_: new.boot_id == self.boot_id and new.seq > self.seq)
        bench = Bench()
        bench.ticks(50)
        assert bench.offer(TRUE, LAST)
        bench.ticks(50)
        assert len(bench.accepted) == 51, "the true sender is locked out"
    monkeypatch.setattr(SenderVerifier, "_is_confirmed", lambda *_, **__: True)
    bench = Bench()
    bench.ticks(50)
    assert bench.offer(FORGED, 1)


def test_a_persistent_forger_is_refused_while_the_true_sender_publishes() -> None:
    bench = Bench()
    bench.ticks(50)
    bench.ticks(500, (TRUE, FORGED))
    assert {boot for _, boot in bench.accepted} == {TRUE}
    assert 498 <= bench.accused["boot"] <= 500
    assert bench.refusals.alert(bench.clock.utc_us()) == "path of agent-1 refused: boot"
    bench.ticks(251)
    assert bench.refusals.alert(bench.clock.utc_us()) == "", "shown for some time, then it clears"


def test_refusals_are_reported_by_sender_once_a_second() -> None:
    bench = Bench()
    for _ in range(150):
        bench.ticks(1, (TRUE, FORGED))
        bench.refusals.report(bench.clock.utc_us())
    rows = [row for row in bench.told if row["reason"] == "boot"]
    assert 3 <= len(rows) <= 4
    assert rows[-1]["sender"] == "agent-1" and rows[-1]["topic"] == "path"
    assert int(str(rows[-1]["count"])) > int(str(rows[0]["count"]))


def test_a_restart_is_accepted_with_its_third_message() -> None:
    bench = Bench()
    bench.ticks(500)
    bench.leave()
    bench.clock.advance(700_000)
    bench.come()
    began = bench.tick
    bench.ticks(100, (REBORN,))
    assert bench.accepted_s(REBORN, began) == pytest.approx(0.06)
    assert bench.accused == {}


def test_a_restart_between_two_ticks_is_accepted_with_its_third_message() -> None:
    """Nobody has seen its token absent: it has joined once more."""
    bench = Bench()
    bench.ticks(50)
    bench.token.close()
    bench.token = bench.hub.connect("agent-1")
    bench.ticks(1, [])
    began = bench.tick
    bench.ticks(50, [REBORN])
    assert bench.accepted_s(REBORN, began) == pytest.approx(0.06)
    assert bench.accused == {}


def test_after_a_restart_what_continues_the_messages_of_the_process_before_is_refused() -> None:
    bench = Bench()
    bench.ticks(50)
    bench.leave()
    bench.clock.advance(700_000)
    bench.come()
    bench.ticks(5, [REBORN])
    assert not bench.offer(TRUE, bench.seq[TRUE] + 1)
    bench.ticks(1, [REBORN])
    assert bench.accepted[-1] == (bench.tick, REBORN)


def test_another_sender_that_comes_or_leaves_helps_no_forger_of_one_that_has_stayed() -> None:
    bench = Bench()
    bench.ticks(50)
    other = bench.hub.connect("agent-2")
    bench.ticks(10, [FORGED])
    other.close()
    bench.ticks(10, [FORGED])
    assert {boot_id for _, boot_id in bench.accepted} == {TRUE}


def test_a_sender_that_was_there_before_the_receiver_is_known_to_be_there() -> None:
    bus = SimpleNamespace(alive=lambda: frozenset({"agent-1"}), arrivals=dict)  # none has joined since
    presence = Presence(cast(Arrivals, bus))
    presence.update(7)
    assert (presence.since_us("agent-1"), presence.since_us("agent-2")) == (7, None)


def test_messages_that_overtake_the_token_wait_for_it() -> None:
    bench = Bench()
    bench.ticks(500)
    bench.leave()
    bench.clock.advance(700_000)
    began = bench.tick
    bench.ticks(10, (REBORN,))
    assert bench.accepted[-1][1] == TRUE, "nobody of that name is there"
    bench.come()
    bench.ticks(1, (REBORN,))
    assert bench.accepted_s(REBORN, began) == pytest.approx(0.22)
    assert bench.accused == {}


def test_late_messages_of_the_old_process_do_not_delay_a_restart() -> None:
    bench = Bench()
    bench.ticks(500)
    bench.leave()
    bench.clock.advance(300_000)
    bench.come()
    began = bench.tick
    bench.ticks(5, (TRUE,), late_us=400_000)  # under way since before
    for _ in range(5):  # both at once
        bench.ticks(1, (TRUE,), late_us=400_000)
        bench.offer(REBORN, bench.seq.setdefault(REBORN, 0) + 1)
        bench.seq[REBORN] += 1
    bench.ticks(20, (REBORN,))
    assert bench.accepted_s(REBORN, began) < 0.3
    assert bench.accused == {}


def test_a_restart_beside_a_frozen_process_is_accepted_after_silence() -> None:
    """The token never leaves: the old process holds it until its lease is over, the new one from then on."""
    bench = Bench()
    bench.ticks(500)
    began = bench.tick
    bench.ticks(150, (REBORN,))
    assert bench.accepted_s(REBORN, began) == pytest.approx(SILENCE_US * 1e-6, abs=0.03)


def test_a_silent_peer_is_not_impersonated_before_its_token_has_outlived_it() -> None:
    bench = Bench()
    bench.ticks(500)
    bench.ticks(round(1.5 / 0.02), (FORGED,))  # frozen for one and a half seconds
    bench.ticks(50)
    assert {boot for _, boot in bench.accepted} == {TRUE}
    assert bench.accused == {"boot": 75}


def test_no_claim_is_accepted_without_a_token() -> None:
    bench = Bench()
    bench.ticks(100)
    bench.leave()
    bench.ticks(500, (FORGED,))
    assert {boot for _, boot in bench.accepted} == {TRUE}
    assert bench.accused == {}, "no live peer's messages were refused"


def test_a_lost_router_helps_no_forger_once_the_peer_has_published() -> None:
    bench = Bench()
    bench.ticks(100)
    bench.hub.fail()
    for _ in range(100):
        bench.clock.advance(TICK_US)
        bench.presence.update(bench.clock.utc_us())
    bench.hub.recover()
    bench.seq[TRUE] += 100
    bench.ticks(2)
    bench.ticks(50, (FORGED, TRUE))
    assert {boot for _, boot in bench.accepted} == {TRUE}


def test_a_forger_that_was_first_is_replaced_by_the_true_sender() -> None:
    bench = Bench()
    bench.leave()
    bench.ticks(20, (FORGED,))
    assert bench.accepted, "nothing is known yet"
    bench.clock.advance(TICK_US)
    bench.come()
    bench.ticks(5, (TRUE,))
    assert bench.accepted[-1][1] == TRUE


def test_a_forged_first_message_of_the_highest_number_is_forgotten() -> None:
    bench = Bench()
    bench.offer(TRUE, LAST)
    began = bench.tick
    bench.ticks(150)
    assert bench.accepted[-1] == (bench.tick, TRUE)
    assert (bench.accepted[1][0] - began) * 0.02 == pytest.approx(SILENCE_US * 1e-6, abs=0.03)


def test_a_forger_just_ahead_is_revealed_by_duplicate_numbers() -> None:
    bench = Bench()
    bench.ticks(100)
    assert bench.offer(TRUE, 110, content=b"elsewhere")
    bench.ticks(30)
    assert len(bench.accepted) == 100 + 1 + 20
    assert bench.accused == {"sequence": 10}


def test_the_stamp_must_allow_for_the_number_and_the_number_for_the_stamp() -> None:
    bench = Bench()
    bench.ticks(100)
    assert not bench.offer(TRUE, 100 + 60, 500_000), "half a second is not 60 ticks"
    assert not bench.offer(TRUE, 100 + 12), "no time has passed"
    bench.clock.advance(1_000_000)
    assert bench.offer(TRUE, 100 + 50), "lost for a second"


def test_loss_bursts_duplicates_reordering_and_changing_delay_accuse_nobody() -> None:
    rng = np.random.default_rng(8)
    bench = Bench()
    under_way: list[tuple[int, int, int]] = []  # (arrival, seq, sent)
    for seq in range(1, 4000):
        bench.clock.advance(TICK_US)
        now_us = bench.clock.utc_us()
        if rng.random() > 0.2 and not 1000 < seq < 1060:
            delay_us = int(rng.uniform(0, 100_000)) + (400_000 if 2000 < seq < 2100 else 0)
            under_way += [(now_us + delay_us, seq, now_us)] * (1 + int(rng.random() < 0.1))
        for message in sorted(m for m in under_way if m[0] <= now_us):
            under_way.remove(message)
            bench.offer(TRUE, message[1], message[2] - now_us)
    assert len(bench.accepted) > 2000
    assert bench.tick - bench.accepted[-1][0] < 10
    assert bench.accused == {}


def test_a_flood_of_boot_ids_takes_no_memory_and_changes_nothing() -> None:
    bench = Bench()
    bench.ticks(10)
    for boot_id in range(1000, 3000):
        assert not bench.offer(boot_id, boot_id)
        assert len(bench.verifier._claims) <= 4
    bench.ticks(10)
    assert len(bench.accepted) == 20
    assert len(bench.verifier._claims) == 0
    assert bench.accused == {"boot": 2000}
    bench.ticks(200)
    assert len(bench.verifier._contents) <= 64


def recording(bench: Bench, seconds: float, back_us: int = 8_000_000) -> int:
    """Have messages of an earlier process heard; return by how much their sender's clock has gone back, as it seems."""
    for seq in range(1, round(seconds / 0.02) + 1):
        bench.clock.advance(TICK_US)
        assert not bench.offer(REBORN, seq, -back_us)
    return bench.verifier.gone_back_us(bench.clock.utc_us())


def test_a_clock_that_was_set_back_between_two_processes_is_told_of_and_its_messages_stay_refused() -> None:
    bench = Bench()
    bench.ticks(50)
    bench.leave()
    bench.come()
    assert recording(bench, 1.9) == 0, "messages of the process before may be on their way"
    bench.clock.advance(100_000)
    assert recording(bench, 0.1) > 0
    assert bench.refusals.by_reason == {"replayed": 100}


def test_a_recording_tells_of_no_clock_while_its_sender_is_heard_or_is_away() -> None:
    bench = Bench()
    for seq in range(1, 200):
        bench.ticks(1)
        assert not bench.offer(REBORN, seq, -30_000_000)
        assert bench.verifier.gone_back_us(bench.clock.utc_us()) == 0
    bench.leave()
    assert recording(bench, 4.0, 30_000_000) == 0


def test_one_message_of_an_earlier_process_tells_of_no_clock_however_often_it_is_repeated() -> None:
    bench = Bench()
    bench.ticks(50)
    for _ in range(200):
        bench.clock.advance(TICK_US)
        assert not bench.offer(REBORN, 7, -30_000_000)
    assert bench.verifier.gone_back_us(bench.clock.utc_us()) == 0
