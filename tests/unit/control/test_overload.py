"""Tests of the response to missed deadlines: wider distances, rest, landing; and of its end."""

from __future__ import annotations

import pytest

from swarmctl.control.failsafe.overload import Level, Overload, OverloadParams, SetpointStops

PERIOD_US = 20_000


def ran(pattern: list[tuple[float, float]]) -> Overload:
    """Run an agent that misses the fraction `share` of its deadlines for `seconds`, for each pair in turn."""
    overload, now_us, missed, debt = Overload(OverloadParams(), PERIOD_US), 0, 0, 0.0
    for share, seconds in pattern:
        for _ in range(round(seconds * 50)):
            debt += share
            now_us += PERIOD_US
            if debt >= 1.0:
                debt, missed = debt - 1.0, missed + 1
                continue  # a skipped tick calls no update
            overload.update(now_us, missed)
    return overload


@pytest.mark.parametrize(
    ("pattern", "level"),
    [
        ([(0.0, 5)], Level.NONE),
        ([(0.03, 5)], Level.NONE),
        ([(0.2, 5)], Level.WIDEN),
        ([(0.2, 5), (0.13, 3)], Level.WIDEN),
        ([(0.13, 5)], Level.NONE),
        ([(0.2, 5), (0.08, 3)], Level.NONE),
        ([(0.5, 5)], Level.HOLD),
        ([(0.5, 15)], Level.LAND),
        ([(0.5, 5), (0.3, 3)], Level.HOLD),
        ([(0.5, 5), (0.0, 3)], Level.NONE),
        ([(0.0, 5), (1.0, 0.5), (0.0, 0.1)], Level.WIDEN),
        ([(0.0, 5), (1.0, 1.0), (0.0, 0.1)], Level.HOLD),
        ([(0.5, 8), (0.0, 3), (0.5, 5)], Level.HOLD),
    ],
)
def test_levels(pattern: list[tuple[float, float]], level: Level) -> None:
    assert ran(pattern).level is level


def test_margin_grows_with_the_fraction_and_is_bounded() -> None:
    margins = [ran([(share, 5)]).margin_m for share in (0.0, 0.2, 0.3, 0.6)]
    assert margins[0] == 0.0
    assert margins == sorted(margins)
    assert 0.02 < margins[1] < margins[2] < margins[3] == pytest.approx(0.2)


def stalled(*stalls_s: float, then_s: float, flew: bool = True) -> Overload:
    """Tick for a second before each stall, and for `then_s` after the last."""
    overload, now_us, missed = Overload(OverloadParams(), PERIOD_US), 0, 0
    for stall_s in stalls_s:
        for _ in range(50):
            overload.update(now_us, missed, flew=flew)
            now_us += PERIOD_US
        now_us, missed = now_us + round(stall_s * 1e6), missed + round(stall_s * 50)
    for _ in range(round(then_s * 50)):
        overload.update(now_us, missed, flew=flew)
        now_us += PERIOD_US
    return overload


def test_a_stall_while_the_autopilot_flies_is_not_remembered() -> None:
    assert stalled(0.3, then_s=5.0, flew=False).margin_m == 0.0


@pytest.mark.parametrize(
    ("stalls_s", "then_s", "margin_m"),
    [
        ((0.3,), 0.02, 0.18),  # 4 m/s2 * (0.3 s)^2 / 2
        ((0.3,), 29.0, 0.18),
        ((0.3,), 31.0, 0.0),
        ((0.3, 0.2), 28.5, 0.18),  # the older one is the longer one, and over for 29.7 s
        ((0.3, 0.2), 29.5, 0.08),
        ((0.2, 0.3), 0.02, 0.18),
        ((2.0,), 5.0, 0.5),
        ((), 5.0, 0.0),
    ],
)
def test_stalls_are_remembered(stalls_s: tuple[float, ...], then_s: float, margin_m: float) -> None:
    assert stalled(*stalls_s, then_s=then_s).margin_m == pytest.approx(margin_m, abs=1e-6)


def test_the_cause_is_named() -> None:
    assert ran([(0.5, 5)]).text() == "overload: 50 % of deadlines missed"
    assert stalled(0.3, then_s=5.0).text() == "overload: stood still for 0.3 s"
    assert stalled(0.08, then_s=5.0).text() == ""


def test_deadlines_missed_before_the_first_update_do_not_count() -> None:
    overload = Overload(OverloadParams(), PERIOD_US)
    overload.update(1_000_000, 500)
    assert overload.level is Level.NONE


def stops_after(ticks_s: list[float], missed: list[int] | None = None, sends: bool = True) -> tuple[SetpointStops, int]:
    """Fly for a second, sending; then tick at these times after it, with deadlines counted as missed."""
    stops, now_us = SetpointStops(PERIOD_US), 0
    for _ in range(50):
        now_us += PERIOD_US
        stops.update(now_us, 7, 0.5)
        stops.sent(now_us)
    for at_s, count in zip(ticks_s, missed or [7] * len(ticks_s), strict=True):
        now_us = 1_000_000 + round(at_s * 1e6)
        stops.update(now_us, count, 0.5)
        if sends:
            stops.sent(now_us)
    return stops, now_us


def test_a_process_that_stood_still_is_told_with_its_numbers() -> None:
    stops, now_us = stops_after([0.6])  # the loop counts those missed in its sleep a tick later
    assert stops.text(now_us) == "overload: setpoints stopped 0.6 s (29 deadline misses, 36 since the start)"
    stops, now_us = stops_after([0.6, 0.62, 0.64], [7, 36, 36])
    assert stops.text(now_us), "autopilots tell their mode twice a second"
    assert stops.text(now_us + 3_000_000) == ""


def test_ticks_that_are_late_and_send_nothing_are_an_overload_too() -> None:
    late_s = [0.1 * k for k in range(1, 7)]  # on states too old to be flown, for example
    stops, now_us = stops_after(late_s, [7 + 4 * k for k in range(1, 7)], sends=False)
    assert stops.text(now_us) == "overload: setpoints stopped 0.6 s (24 deadline misses, 31 since the start)"


@pytest.mark.parametrize(
    ("ticks_s", "sends"),
    [([0.4], True), ([0.02 * k for k in range(1, 100)], False), ([0.02 * k for k in range(1, 100)], True)],
    ids=["shorter than the failsafe waits", "nothing to send, on time", "as usual"],
)
def test_a_pilot_who_takes_over_is_no_overload(ticks_s: list[float], sends: bool) -> None:
    stops, now_us = stops_after(ticks_s, sends=sends)
    assert stops.text(now_us) == ""
