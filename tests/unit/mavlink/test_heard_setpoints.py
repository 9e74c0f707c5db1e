"""What is concluded from the setpoints that a vehicle repeats."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest

from swarmctl.mavlink.vehicle.heard_setpoints import HeardSetpoints

PERIOD_US = 20_000
LOST_US = 1_000_000  # from then on nothing reaches the vehicle
NEVER_US = 1 << 62
BOTH = pytest.mark.parametrize("again", [True, False], ids=["repeated as ArduCopter does", "as PX4 does"])


def changing(t_us: int) -> float:
    """Return a thrust that differs from setpoint to setpoint."""
    return 0.4 + 1e-8 * t_us


def as_sent(thrust_01: float) -> float:
    """Return what a frame carries of a thrust."""
    return float(struct.unpack("<f", struct.pack("<f", thrust_01))[0])


def concluded(
    heard: HeardSetpoints,
    *,
    again: bool,
    until_us: int = 2_000_000,
    every_us: int = 20_000,
    reaches: Callable[[int], bool] = lambda t_us: t_us < LOST_US,
    returns: Callable[[int], bool] = lambda t_us: True,
    one_way_us: int = 1_000,
    thrust: Callable[[int], float] = changing,
    sends: Callable[[int], bool] = lambda t_us: True,
    flies_itself_from_us: int = NEVER_US,
) -> dict[int, int | None]:
    """Send setpoints to a vehicle that repeats the last one it has got; return what is concluded at each tick.

    Args:
        heard: under test.
        again: a setpoint is repeated until the next one comes, not once.
        every_us: between repetitions.
        reaches, returns: whether what is sent to the vehicle, and by it, at a time arrives.
        sends: whether a setpoint is sent at a time.
    """
    got: list[tuple[int, float]] = []
    found: dict[int, int | None] = {}
    told, state_us = 0, 0
    for now_us in range(0, until_us, 1_000):
        if now_us % PERIOD_US == 0:
            found[now_us] = heard.unheard_since_us(now_us, state_us)
            if sends(now_us):
                heard.sent(now_us, thrust(now_us))
                if reaches(now_us):
                    got.append((now_us + one_way_us, as_sent(thrust(now_us))))
        told_us = now_us - one_way_us
        if told_us % every_us or not returns(told_us):
            continue
        state_us = told_us
        flown = [thrust_01 for at_us, thrust_01 in got if at_us <= told_us]
        itself = told_us >= flies_itself_from_us
        if flown and (again or itself or len(flown) > told):
            heard.repeated(0.123 if itself else flown[-1], now_us)
            told = len(flown)
    return found


@BOTH
@pytest.mark.parametrize("every_us", [20_000, 50_000])
def test_setpoints_that_are_repeated_are_heard(again: bool, every_us: int) -> None:
    found = concluded(HeardSetpoints(), again=again, every_us=every_us, reaches=lambda t_us: True)
    assert set(found.values()) == {None}


@BOTH
def test_setpoints_that_do_not_arrive_are_known_to_be_unheard_within_120_ms_until_one_arrives(again: bool) -> None:
    back_us = 1_400_000
    found = concluded(HeardSetpoints(), again=again, reaches=lambda t_us: not LOST_US <= t_us < back_us)
    assert {found[t_us] for t_us in found if t_us < LOST_US + 60_000} == {None}, "two that are lost are nothing"
    assert {found[t_us] for t_us in found if LOST_US + 120_000 <= t_us < back_us} == {LOST_US - PERIOD_US}
    assert {found[t_us] for t_us in found if t_us > back_us + 60_000} == {None}


@BOTH
@pytest.mark.parametrize("is_told", [True, False], ids=["by TIMESYNC", "by the quickest"])
def test_the_way_there_and_back_is_no_loss(again: bool, is_told: bool) -> None:
    heard = HeardSetpoints()
    heard.round_trip_us = 300_000 if is_told else 0
    found = concluded(heard, again=again, one_way_us=150_000, reaches=lambda t_us: True)
    assert set(found.values()) == {None}
    found = concluded(HeardSetpoints(), again=again, one_way_us=150_000)
    assert found[LOST_US + 700_000] == LOST_US - PERIOD_US, "though it takes longer to be seen"


@BOTH
@pytest.mark.parametrize(
    "cause",
    [
        {"reaches": lambda t_us: True, "returns": lambda t_us: t_us // PERIOD_US % 4 == 0},
        {"reaches": lambda t_us: t_us // PERIOD_US % 3 != 0},
        {"reaches": lambda t_us: True, "sends": lambda t_us: not LOST_US <= t_us < LOST_US + 400_000},
    ],
    ids=["three of four repetitions are lost", "one of three setpoints is", "nothing is sent for a while"],
)
def test_what_is_lost_now_and_then_or_not_sent_says_nothing(again: bool, cause: dict[str, Any]) -> None:
    assert set(concluded(HeardSetpoints(), again=again, **cause).values()) == {None}


def test_equal_setpoints_say_nothing_where_they_are_repeated_again() -> None:
    assert set(concluded(HeardSetpoints(), again=True, thrust=lambda t_us: 0.5).values()) == {None}


def test_what_the_autopilot_flies_by_itself_is_no_setpoint_that_was_heard() -> None:
    found = concluded(HeardSetpoints(), again=True, flies_itself_from_us=LOST_US + 500_000)
    assert {found[t_us] for t_us in found if t_us >= LOST_US + 150_000} == {LOST_US - PERIOD_US}
    by_itself = concluded(HeardSetpoints(), again=True, flies_itself_from_us=0)
    assert set(by_itself.values()) == {None}, "it has never flown one"


@BOTH
def test_a_vehicle_that_is_not_heard_any_more_is_not_known_to_miss_setpoints(again: bool) -> None:
    found = concluded(HeardSetpoints(), again=again, reaches=lambda t_us: True, returns=lambda t_us: t_us < LOST_US)
    assert set(found.values()) == {None}
    found = concluded(HeardSetpoints(), again=True, returns=lambda t_us: t_us < LOST_US + 200_000)
    assert found[LOST_US + 300_000] == LOST_US - PERIOD_US
    assert found[LOST_US + 600_000] is None


def test_a_vehicle_that_repeats_nothing_any_more_is_believed_to_for_a_while_only() -> None:
    found = concluded(HeardSetpoints(), again=False, until_us=4_000_000)
    assert found[LOST_US + 1_000_000] == LOST_US - PERIOD_US
    assert found[LOST_US + 2_000_000] is None, "somebody has turned the message off"
