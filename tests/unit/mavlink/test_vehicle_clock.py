"""The vehicle's clock: offset and rate through jitter, drift, standstill and reboot."""

from __future__ import annotations

import random

import pytest

from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock

BOOTED_US = 5_000_000  # the vehicle's clock when ours is 0
TICK_US = 10_000
SETTLED_US = 3_000_000


class Link:
    """A vehicle whose clock runs at `rate` of ours, behind a link of seeded delays."""

    def __init__(self, clock: VehicleClock, rate: float, base_us: float = 300.0, asked: bool = True) -> None:
        self.clock, self.rate, self.base_us, self.asked = clock, rate, base_us, asked
        self.witnessed, self.unknown = False, 0  # samples without a time
        self.now_us, self.vehicle_us, self.queue_us = 0.0, float(BOOTED_US), 0.0
        self._random = random.Random(7)

    def delay_us(self) -> float:
        """A short one most times, 30 ms more for one in fifty."""
        late = 30_000.0 * self._random.random() if self._random.random() < 0.02 else 0.0
        return self.base_us + self._random.expovariate(1.0 / 1500.0) + late

    def run(self, seconds: float, still: bool = False, slower: float = 0.0) -> float:
        """Largest error [us] of the mapped times of samples sent meanwhile.

        `still`: the vehicle's clock stops; `slower`: its messages take as much longer with every second.
        """
        worst = 0.0
        for k in range(round(seconds * 1e6 / TICK_US)):
            self.now_us += TICK_US
            if still:
                continue
            self.vehicle_us += TICK_US * self.rate
            self.queue_us += TICK_US * slower
            arrived_us = round(self.now_us + self.queue_us + self.delay_us())
            if self.witnessed:
                self.clock.witness("ATTITUDE", round(self.vehicle_us), arrived_us)
            found_us = self.clock.to_local(round(self.vehicle_us), arrived_us)
            self.unknown += found_us is None
            if found_us is not None and self.now_us > SETTLED_US:
                worst = max(worst, abs(found_us - self.now_us))
            if self.asked and k % 20 == 0:
                up_us, down_us = self.delay_us(), self.delay_us()
                stamp_us = self.vehicle_us + up_us * self.rate
                self.clock.round_trip(
                    round(self.now_us), round(stamp_us), round(self.now_us + up_us + self.queue_us + down_us)
                )
        return worst


@pytest.mark.parametrize("rate", [0.99, 0.97, 1.03])
def test_ages_stay_right_for_ten_minutes_of_drift(rate: float) -> None:
    clock = VehicleClock()
    assert Link(clock, rate).run(600.0) < 2_000
    assert clock.rate == pytest.approx(1.0 / rate - 1.0, abs=2e-4)
    assert clock.boots == 0


def test_negative_control_an_offset_without_a_rate_does_not_stay_right() -> None:
    assert Link(VehicleClock(rate_limit=0.0), 0.99).run(60.0) > 5_000
    assert Link(VehicleClock(rate_limit=0.0), 0.99, asked=False).run(60.0) > 50_000


def test_unanswered_questions_cost_only_the_shortest_delay() -> None:
    assert Link(VehicleClock(), 0.99, asked=False).run(60.0) < 2_000
    assert Link(VehicleClock(), 0.99, base_us=10_000, asked=False).run(30.0) == pytest.approx(10_000, abs=1_000)
    assert Link(VehicleClock(), 0.99, base_us=10_000).run(30.0) < 2_500  # a round trip tells


@pytest.mark.parametrize("standstill_s", [0.06, 0.3, 2.0])
def test_a_vehicle_clock_that_stood_still_is_right_again_at_once_where_questions_are_answered(
    standstill_s: float,
) -> None:
    link = Link(VehicleClock(), 0.99)
    link.run(20.0)
    link.run(standstill_s, still=True)
    link.run(0.4)
    assert link.run(10.0) < 5_000
    unasked = Link(VehicleClock(), 0.99, asked=False)
    unasked.run(20.0)
    unasked.run(standstill_s, still=True)
    unasked.run(0.4)
    assert unasked.run(1.0) > 40_000  # control: takes the delay for the link's


def test_a_rate_that_changes_is_followed() -> None:
    link = Link(VehicleClock(), 0.99)
    link.run(20.0)
    link.rate = 0.95  # a simulator short of CPU
    assert link.run(2.0) < 32_000
    assert link.run(10.0) < 3_000


@pytest.mark.parametrize("slower", [0.02, 0.05, 0.1])
def test_delays_that_creep_up_make_no_old_sample_young(slower: float) -> None:
    link = Link(VehicleClock(), 0.99)
    link.run(20.0)
    assert link.run(10.0, slower=slower) < 1.8e6 * slower, "late by what creeps up within the remembered requests"
    unasked = Link(VehicleClock(), 0.99, asked=False)
    unasked.run(20.0)
    assert unasked.run(10.0, slower=slower) > 8e6 * slower  # control: takes it for the rate of the clock


def test_congestion_for_two_seconds_makes_no_old_sample_young() -> None:
    link = Link(VehicleClock(), 0.99, asked=False)
    link.run(20.0)
    link.base_us = 80_000.0
    assert link.run(2.0) < 3_000


@pytest.mark.parametrize("witness", ["TIMESYNC", "ATTITUDE"])
def test_a_reboot_that_another_message_bears_out_is_one_and_takes_half_a_second(witness: str) -> None:
    link = Link(VehicleClock(), 0.99, asked=witness == "TIMESYNC")
    link.witnessed = witness == "ATTITUDE"
    link.run(10.0)
    assert (link.unknown, link.clock.refused) == (0, 0)
    link.vehicle_us = 1_300_000.0
    assert link.run(5.0) < 12_000  # for a second it has no rate again
    assert (link.clock.boots, link.clock.restarts) == (1, 1)
    assert 10 <= link.unknown <= 50


def test_a_state_that_goes_back_alone_is_no_reboot_until_nothing_else_has_come_for_three_seconds() -> None:
    link = Link(VehicleClock(), 1.0, asked=False)
    link.run(10.0)
    link.vehicle_us = 1_300_000.0
    link.run(2.9)
    assert (link.clock.boots, link.unknown) == (0, 290)
    link.run(0.2)
    assert link.clock.boots == 1


def gone_back() -> Link:
    link = Link(VehicleClock(), 1.0, asked=False)
    link.run(10.0)
    link.vehicle_us = 1_300_000.0
    return link


def test_one_frame_of_another_message_bears_out_no_reboot_and_two_do() -> None:
    link = gone_back()
    link.run(0.5)
    for boots in (0, 1):
        link.clock.witness("ATTITUDE", round(link.vehicle_us), round(link.now_us))
        link.run(0.5)
        assert link.clock.boots == boots


def test_what_other_messages_told_before_bears_out_no_reboot() -> None:
    link = gone_back()
    for before_us in (2_000, 1_000):
        link.clock.witness("ATTITUDE", round(link.vehicle_us) - before_us, round(link.now_us) - before_us)
    link.run(2.9)
    assert (link.clock.boots, link.unknown) == (0, 290)


def test_other_messages_that_go_on_as_before_bear_out_no_reboot() -> None:
    link = gone_back()
    for k in range(1, 30):
        link.run(0.1)
        link.clock.witness("ATTITUDE", BOOTED_US + 10_000_000 + k * 100_000, round(link.now_us))
    assert (link.clock.boots, link.unknown) == (0, 290)


def test_stamps_that_agree_with_nothing_begin_no_clock() -> None:
    link = Link(VehicleClock(), 1.0, asked=False)
    link.run(10.0)
    for k in range(100):
        link.now_us += 20_000.0
        assert link.clock.to_local(10**15 * (1 + k % 4) + 20_000 * k, round(link.now_us)) is None
    assert link.clock.restarts == 0


def test_four_stamps_of_another_time_begin_no_clock_and_the_fifth_does() -> None:
    link = Link(VehicleClock(), 1.0, asked=False)
    link.run(10.0)
    for k in range(5):
        link.now_us += 150_000.0
        found_us = link.clock.to_local(10**15 + 150_000 * k, round(link.now_us))
        assert (found_us is not None, link.clock.restarts) == (k == 4, int(k == 4))


@pytest.mark.parametrize("off_us", [-60_000_000, -1_500_000, 100_000, 900_000, 5_000_000, 10**15])
@pytest.mark.parametrize("every", [None, 2, 9])
def test_stamps_in_past_or_future_among_good_ones_change_nothing(off_us: int, every: int | None) -> None:
    """One of them, every other one, and every ninth; and forged boot times beside them."""
    clean, link = Link(VehicleClock(), 0.99), Link(VehicleClock(), 0.99)
    for each in (clean, link):
        each.run(10.0)
    for k in range(300):
        if (k == 20) if every is None else k % every == 0:
            stamp_us = round(link.vehicle_us) + off_us
            assert link.clock.to_local(stamp_us, round(link.now_us)) is None
            link.clock.witness("SYSTEM_TIME", stamp_us, round(link.now_us))
        assert link.run(0.01) == clean.run(0.01)
    assert (link.clock.boots, link.clock.restarts, link.unknown) == (0, 0, 0)
    assert link.clock.refused > 0


def test_a_wrong_first_stamp_is_corrected_without_a_reboot() -> None:
    for off_us in (10**15, -BOOTED_US):
        link = Link(VehicleClock(), 1.0)
        link.clock.to_local(BOOTED_US + off_us, 0)
        link.run(5.0)
        assert link.run(5.0) < 8_000
        assert (link.clock.boots, link.clock.restarts) == (0, 1)
        assert link.unknown <= 11


def test_a_clock_set_forward_begins_again_and_is_no_reboot() -> None:
    link = Link(VehicleClock(), 1.0)
    link.run(10.0)
    link.vehicle_us += 1e15
    assert link.run(5.0) < 8_000
    assert (link.clock.boots, link.clock.restarts) == (0, 1)
    assert link.unknown <= 11


def test_round_trips_of_another_time_base_are_ignored() -> None:
    link = Link(VehicleClock(), 1.0, asked=False)
    link.run(5.0)
    before = link.clock.offset_us
    link.clock.round_trip(round(link.now_us), 10**15, round(link.now_us) + 500)
    link.clock.round_trip(round(link.now_us), round(link.vehicle_us), round(link.now_us) - 1)
    assert (link.clock.offset_us, link.clock.answered) == (before, 0)


TURN_US = 2**32 * 1000  # 49.7 days, after which `time_boot_ms` begins again


@pytest.mark.parametrize(
    ("since_us", "boot_ms", "found_us"),
    [
        (0, 2**32 - 50, TURN_US - 50_000),  # a late one
        (0, 0, TURN_US),
        (30_000_000, 29_000, TURN_US + 29_000_000),
        (30_000_000, 2**32 - 1000 * 1000, TURN_US - 1000 * 1000_000),  # of another time, whose turn can't be known
        (30_000_000, 3_000_000, 3_000_000_000),  # rebooted
    ],
)
def test_times_since_boot_begin_another_turn_where_it_is_expected(since_us: int, boot_ms: int, found_us: int) -> None:
    clock, newest_us = VehicleClock(), TURN_US - 10_000
    assert clock.boot_us(newest_us // 1000, 0) == newest_us, "before the first stamp"
    clock.to_local(newest_us, 0)
    assert clock.boot_us(boot_ms, since_us) == found_us


def test_a_vehicle_that_was_rebooted_in_its_second_turn_is_seen_to_be() -> None:
    link = Link(VehicleClock(), 0.99)
    link.vehicle_us = TURN_US + 3e12
    link.run(5.0)
    assert link.clock.answered > 20
    link.vehicle_us = 1_300_000.0
    link.run(0.6)
    assert link.clock.boots == 1


def test_round_trips_count_of_a_vehicle_whose_stamps_began_again_before_it_was_heard() -> None:
    """It answers by a clock of 64 bits."""
    clock, turned_us = VehicleClock(), 3 * TURN_US
    for k in range(100):
        clock.to_local(5_000_000 + 20_000 * k, 20_000 * k)
    clock.round_trip(1_980_000, turned_us + 6_990_000, 2_000_000)
    assert clock.answered == 1
