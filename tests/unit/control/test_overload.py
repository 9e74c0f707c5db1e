"""Tests of the response to missed deadlines: wider distances, rest, landing; and of its end."""

from __future__ import annotations

import pytest

from swarmctl.control.phases.overload import Level, Overload, OverloadParams

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


def test_the_cause_is_named() -> None:
    assert ran([(0.5, 5)]).text() == "overload: 50 % of deadlines missed"


def test_deadlines_missed_before_the_first_update_do_not_count() -> None:
    overload = Overload(OverloadParams(), PERIOD_US)
    overload.update(1_000_000, 500)
    assert overload.level is Level.NONE
