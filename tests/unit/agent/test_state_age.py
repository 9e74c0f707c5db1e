"""How much of a state's age counts as its way."""

from __future__ import annotations

import pytest

from swarmctl.agent.planning.state_age import StateAge

SECOND_US = 1_000_000


@pytest.mark.parametrize("age_us", [0, 30_000, 120_000])
def test_a_state_counts_when_it_was_so_where_all_are_as_old(age_us: int) -> None:
    age = StateAge()
    for now_us in range(SECOND_US, 5 * SECOND_US, 20_000):
        assert age.seen_us(now_us - age_us, now_us) == now_us - age_us


def test_states_that_are_older_than_usual_for_a_second_count_as_usual() -> None:
    """As where a simulator stands still, whose vehicle is late then."""
    age = StateAge()
    for now_us in range(0, 20 * SECOND_US, 20_000):
        age.seen_us(now_us - 30_000, now_us)
    for now_us in range(20 * SECOND_US, 21 * SECOND_US, 20_000):
        seen_us = age.seen_us(now_us - 400_000, now_us)
    assert 30_000 <= now_us - seen_us < 70_000


def test_a_link_that_stays_slower_is_usual_after_a_while() -> None:
    age = StateAge()
    for now_us in range(0, 60 * SECOND_US, 20_000):
        seen_us = age.seen_us(now_us - (30_000 if now_us < SECOND_US else 100_000), now_us)
    assert now_us - seen_us > 99_000


def test_a_stamp_ahead_of_the_clock_counts_as_now() -> None:
    assert StateAge().seen_us(20_000, 0) == 0
