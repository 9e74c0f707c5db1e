"""Peers are told to keep more while the wind changes, and no more once it is steady."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.estimation.gust import GustWatch

TICK_US = 20_000


def watched(rate_m_s3: float, seconds: float, steady_s: float = 0.0) -> GustWatch:
    """Return a watch after a disturbance that grew at a rate for some time, and then stayed."""
    watch = GustWatch()
    for k in range(round((seconds + steady_s) * 1e6 / TICK_US)):
        grown_s = min(seconds, k * TICK_US * 1e-6)
        watch.update(k * TICK_US, np.array([0.6 * rate_m_s3 * grown_s, 0.8 * rate_m_s3 * grown_s, -3.0]))
    return watch


@pytest.mark.parametrize(
    ("rate_m_s3", "least_m", "most_m"), [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (5.0, 0.3, 0.4), (50.0, 0.5, 0.5)]
)
def test_the_margin_grows_with_the_change_of_the_wind(rate_m_s3: float, least_m: float, most_m: float) -> None:
    assert least_m <= watched(rate_m_s3, 1.0).margin_m <= most_m


def test_a_strong_wind_that_is_steady_needs_no_margin() -> None:
    grown = watched(5.0, 1.0).margin_m
    assert 0.2 * grown < watched(5.0, 1.0, steady_s=1.4).margin_m < 0.6 * grown
    assert watched(5.0, 1.0, steady_s=8.0).margin_m < 0.001


def test_what_was_flown_by_somebody_else_is_forgotten() -> None:
    watch = watched(5.0, 1.0)
    watch.forget()
    assert watch.margin_m == 0.0
    watch.update(10_000_000, np.array([9.0, 0.0, 0.0]))
    assert watch.margin_m == 0.0
