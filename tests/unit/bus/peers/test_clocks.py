"""Offsets of clocks, as bounded by messages that take an unknown time."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest

from swarmctl.bus.peers.clocks import PeerClocks

UTC_US = 1_700_000_000_000_000
SECOND_US = 1_000_000


class Pair:
    """The own clock, and a peer's that is ahead; messages cross with delays."""

    def __init__(self, ahead_us: int = 0, drift_ppm: float = 0.0) -> None:
        self.told: list[dict[str, Any]] = []
        self.clocks = PeerClocks([1], lambda name, **fields: self.told.append({"event": name, **fields}))
        self.now_us, self.ahead_us, self.drift_ppm = UTC_US, ahead_us, drift_ppm

    @property
    def true_us(self) -> int:
        return self.ahead_us + round(self.drift_ppm * (self.now_us - UTC_US) * 1e-6)

    def exchange(self, there_us: int, back_us: int) -> None:
        """A message to the peer, and its answer."""
        sent_us = self.now_us
        self.now_us += there_us
        arrived_us = self.now_us + self.true_us
        stamp_us = self.now_us + self.true_us
        self.now_us += back_us
        self.clocks.received(1, stamp_us, self.now_us)
        self.clocks.answered(1, sent_us, arrived_us, self.now_us)


@pytest.mark.parametrize("ahead_us", [-500_000, -80_000, 0, 200_000, 7_000_000])
@pytest.mark.parametrize("delays_us", [(20_000, 20_000), (10_000, 60_000), (50_000, 5_000)])
def test_the_offset_is_within_the_bound_whatever_the_delays(ahead_us: int, delays_us: tuple[int, int]) -> None:
    pair = Pair(ahead_us)
    pair.exchange(*delays_us)
    assert abs(pair.clocks.ahead_us(1) - ahead_us) <= pair.clocks.error_us(1) <= sum(delays_us)


def test_equal_clocks_are_never_corrected_however_uneven_the_delays() -> None:
    pair, draw = Pair(0), random.Random(1)
    for _ in range(500):
        pair.exchange(draw.randint(1_000, 300_000), draw.randint(1_000, 300_000))
        assert pair.clocks.ahead_us(1) == 0
    assert pair.told == []


def test_short_delays_among_long_ones_make_it_tight() -> None:
    """Messages leave at 50 Hz, as agents send them, and overtake each other."""
    pair, draw = Pair(200_000), random.Random(1)
    sent_us = [UTC_US + 20_000 * tick for tick in range(100)]
    arrivals = [(us + draw.randint(10_000, 300_000), us) for us in sent_us]
    answers = [(arrived_us + draw.randint(10_000, 300_000), us, arrived_us) for arrived_us, us in arrivals]
    for now_us, stamp_us, arrived_us in sorted(answers):
        pair.clocks.answered(1, stamp_us, arrived_us + pair.ahead_us, now_us)
        pair.clocks.received(1, arrived_us + pair.ahead_us, now_us)
    assert pair.clocks.error_us(1) < 60_000


def test_a_drifting_clock_is_followed() -> None:
    pair = Pair(300_000, drift_ppm=200.0)
    for _ in range(3000):
        pair.exchange(20_000, 20_000)
        off_us = abs(pair.clocks.ahead_us(1) - pair.true_us)
        assert off_us <= 45_000
        assert off_us <= pair.clocks.error_us(1), "distances leave room for the error that is told"
    assert pair.true_us > 300_000 + 20_000


@pytest.mark.parametrize("drift_ppm", [-20_000.0, -10_000.0, 10_000.0, 20_000.0])
@pytest.mark.parametrize("delay_us", [5_000, 60_000])
def test_the_error_told_holds_while_clocks_follow_steps_of_utc(drift_ppm: float, delay_us: int) -> None:
    """Each by 1 % of the time that passes, as `swarmctl.wall_clock` does; the delays vary."""
    pair, draw = Pair(0, drift_ppm), random.Random(1)
    for _ in range(400):
        pair.exchange(delay_us + draw.randint(0, 5_000), delay_us + draw.randint(0, 5_000))
        off_us = abs(pair.clocks.ahead_us(1) - pair.true_us)
        assert off_us <= pair.clocks.error_us(1) <= 3 * delay_us + 30_000
    assert abs(pair.clocks.ahead_us(1)) > 30_000, "corrected"


def test_a_clock_that_is_set_is_followed_at_once() -> None:
    pair = Pair(0)
    for _ in range(20):
        pair.exchange(20_000, 20_000)
    pair.ahead_us = -3 * SECOND_US
    pair.exchange(20_000, 20_000)
    assert pair.clocks.ahead_us(1) == 0, "its answer alone tells no lower bound, and an interval without one no middle"
    pair.exchange(20_000, 20_000)
    assert abs(pair.clocks.ahead_us(1) - pair.ahead_us) <= 40_000


def test_an_unanswered_message_corrects_nothing() -> None:
    """It may have been under way for long: an interval without an end has no middle."""
    pair = Pair(0)
    pair.clocks.received(1, UTC_US - SECOND_US, UTC_US)
    assert pair.clocks.ahead_us(1) == 0
    assert pair.clocks.error_us(1) > SECOND_US


def test_a_correction_is_reported_once_with_its_error() -> None:
    pair = Pair(200_000)
    for _ in range(10):
        pair.exchange(20_000, 20_000)
    assert pair.told == [{"event": "clock_offset", "agent": 1, "ahead_s": 0.2, "error_s": 0.02}]


def test_an_unknown_peer_is_taken_as_it_stamps() -> None:
    assert Pair(0).clocks.ahead_us(9) == 0


def test_no_room_is_left_for_a_clock_that_is_not_measured() -> None:
    """Without trajectory messages, in best effort, clocks are taken for equal."""
    pair = Pair(0)
    pair.clocks.received(1, UTC_US, UTC_US + 20_000)
    assert pair.clocks.spread_us(1) == 0
    pair.exchange(20_000, 30_000)
    assert pair.clocks.spread_us(1) == pair.clocks.error_us(1) > 0
    assert pair.clocks.spread_us(9) == 0


def test_where_clocks_that_may_be_equal_are_trusted_room_is_left_for_those_that_differ() -> None:
    for ahead_us, leaves_room in ((0, False), (200_000, True)):
        pair = Pair(ahead_us)
        pair.clocks = PeerClocks([1], lambda *_, **__: None, trusts_equal=True)
        pair.exchange(20_000, 30_000)
        assert (pair.clocks.spread_us(1) > 0) is leaves_room


def test_the_operator_is_told_which_clock_is_farthest_off_until_it_is_set() -> None:
    pair = Pair(-200_000)
    pair.exchange(20_000, 20_000)
    assert pair.clocks.alert == (
        "clock of agent-1 is 0.20 s behind this one, which is allowed for. Set the clocks of the hosts (chrony, PTP)"
    )
    pair.ahead_us = 0
    pair.exchange(20_000, 20_000)
    pair.exchange(20_000, 20_000)
    assert pair.clocks.alert == ""


def test_a_clock_that_is_too_far_ahead_is_told_with_how_far_until_it_is_believed() -> None:
    clocks = PeerClocks([1, 2], lambda *_, **__: None)
    clocks.refused(1, 3_700_000_000, 100_000_000)
    clocks.refused(2, 111_000_000, 100_000_000)
    apart = "clock of agent-1 is 3600.00 s ahead of this one, which is too far: nothing it says is believed"
    assert clocks.alert.startswith(apart)
    clocks.received(1, 101_000_000, 101_000_000)
    assert clocks.alert.startswith("clock of agent-2 is 11.00 s ahead of this one")
    clocks.received(2, 101_000_000, 101_000_000)
    assert clocks.alert == ""


@pytest.mark.parametrize(
    "off",
    [
        lambda clocks: clocks.refused(1, UTC_US + 11_000_000, UTC_US),
        lambda clocks: clocks.gone_back(1, 2_000_000),
        lambda clocks: clocks.too_far_behind(1),
        lambda clocks: measured(clocks, UTC_US),
    ],
    ids=["too far ahead", "gone back", "too far behind", "allowed for"],
)
def test_the_clock_of_a_peer_that_has_ended_is_told_again_only_when_the_peer_is_heard_again(
    off: Callable[[PeerClocks], None],
) -> None:
    clocks = PeerClocks([1], lambda *_, **__: None)
    off(clocks)
    told = clocks.alert
    assert told.startswith("clock of agent-1 ")
    clocks.ended(0)  # the own agent, as who runs it says when it is started again
    assert clocks.alert == told
    clocks.ended(1)
    assert clocks.alert == ""
    off(clocks)
    assert clocks.alert == told


def measured(clocks: PeerClocks, utc_us: int) -> None:
    clocks.received(1, utc_us + 200_000, utc_us)
    clocks.answered(1, utc_us, utc_us + 200_000, utc_us)


def test_of_several_clocks_that_are_off_the_farthest_is_told() -> None:
    clocks = PeerClocks([1, 2, 3], lambda *_, **__: None)
    for agent, ahead_us in ((1, 100_000), (2, -700_000), (3, 0)):
        clocks.received(agent, UTC_US + ahead_us, UTC_US)
        clocks.answered(agent, UTC_US, UTC_US + ahead_us, UTC_US)
        farthest = "agent-1 is 0.10 s ahead" if agent == 1 else "agent-2 is 0.70 s behind"
        assert clocks.alert.startswith(f"clock of {farthest}")
