"""Tests of when a reported accuracy is used: PX4's measured figures after boot must not be used early."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.estimation.accuracy import AccuracyLoss, AccuracyMonitor
from swarmctl.control.failsafe.overload import Readiness

SECOND = 1_000_000
PX4_AFTER_BOOT_S, PX4_CLAIM_M = [1.2, 2.2, 4.2, 9.0, 30.0], [14.1, 0.010, 0.073, 0.285, 0.290]


def fed(claims: list[float | None], every_s: float = 1.0) -> AccuracyMonitor:
    """Return a monitor updated at 50 Hz with each figure for `every_s`."""
    monitor, now_us = AccuracyMonitor(), 0
    for claim in claims:
        for _ in range(round(every_s * 50)):
            monitor.update(now_us, claim)
            now_us += SECOND // 50
    return monitor


def test_px4s_accuracy_after_boot_is_used_only_once_settled() -> None:
    monitor = AccuracyMonitor()
    judged_s = None
    for k in range(50, 1500):
        since_boot_s = k / 50
        claim_m = float(np.interp(np.floor(since_boot_s), PX4_AFTER_BOOT_S, PX4_CLAIM_M))
        monitor.update(k * SECOND // 50, claim_m)
        if judged_s is None and not monitor.unsettled(k * SECOND // 50):
            judged_s, worst_m = since_boot_s, monitor.worst_m
    assert judged_s is not None
    assert 8.0 < judged_s < 16.0
    assert worst_m is not None
    assert 0.25 < worst_m < 0.3, "neither the 14 m of the first second nor the 0.01 m of the second"


def test_a_constant_accuracy_is_used_after_a_window_by_its_largest_value() -> None:
    monitor = fed([0.30, 0.33, 0.29, 0.31, 0.30])
    assert monitor.unsettled(5 * SECOND) == ""
    assert monitor.worst_m == 0.33
    assert "settle" in fed([0.3, 0.3]).unsettled(2 * SECOND)


def test_a_rising_accuracy_is_not_used() -> None:
    waits_for = fed([0.1, 0.3, 0.5, 0.7, 0.9]).unsettled(5 * SECOND)
    assert waits_for == "the estimator's accuracy to settle, within 25 % and 2 cm for 4 s (now 0.90 m)"


def test_a_vehicle_that_reports_no_accuracy_is_waited_for_briefly() -> None:
    assert "tell" in fed([None]).unsettled(1 * SECOND)
    silent = fed([None] * 4)
    assert (silent.unsettled(4 * SECOND), silent.worst_m) == ("", None)


def test_what_an_accuracy_loses_in_flight_becomes_a_margin() -> None:
    loss, now_us = AccuracyLoss(), 0
    for claim_m in (None, 14.1, 0.2, 0.3):  # of an estimator that settles; the newest counts
        now_us += SECOND
        loss.update(now_us, claim_m, is_standing=True)
        assert loss.margin_m == 0.0
    for claim_m, margin_m in ((0.39, 0.0), (0.7, 1.22), (100.0, 4.22), (100.0, 7.22), (0.3, 0.0), (None, 0.0)):
        now_us += SECOND
        loss.update(now_us, claim_m, is_standing=False)
        assert loss.margin_m == pytest.approx(margin_m)


def test_an_agent_that_starts_in_flight_takes_the_accuracy_it_finds() -> None:
    loss = AccuracyLoss()
    for k, (claim_m, margin_m) in enumerate(((1.0, 0.0), (1.5, 0.92))):
        loss.update(k * SECOND, claim_m, is_standing=False)
        assert loss.margin_m == pytest.approx(margin_m)


def test_only_an_estimate_that_gets_worse_dead_reckons() -> None:
    loss = AccuracyLoss()
    loss.update(0, 0.3, is_standing=True)
    loss.update(SECOND, 0.3, is_standing=False, fix_missing_s=2.0)
    assert loss.dead_reckoning_s == 0.0, "it has another source of positions"
    loss.update(2 * SECOND, 0.5, is_standing=False, fix_missing_s=3.0)
    assert loss.dead_reckoning_s == 3.0
    loss.update(3 * SECOND, 0.5, is_standing=False)
    assert loss.dead_reckoning_s == 0.0, "it has a fix"


def test_what_is_judged_here_is_the_program() -> None:
    """Flights of tests/closed_loop begin early in the same process, before these tests."""
    assert AccuracyMonitor.unsettled.__module__ == AccuracyMonitor.__module__
    assert Readiness.unmet.__module__ == Readiness.__module__
