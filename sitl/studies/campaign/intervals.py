"""Exact binomial confidence intervals (Clopper and Pearson, Biometrika 26, 1934)."""

from __future__ import annotations

from typing import NamedTuple

from scipy.special import betaincinv

LEVEL = 0.95


class Interval(NamedTuple):
    """Bounds of a probability, 0..1."""

    low: float
    high: float


def clopper_pearson(hits: int, trials: int, level: float = LEVEL) -> Interval:
    """Return the two-sided interval that covers the true probability with at least `level`; 0..1 without trials.

    The bounds are quantiles of beta distributions: B(a/2; k, n - k + 1) and B(1 - a/2; k + 1, n - k).
    """
    if not 0 <= hits <= trials:
        raise ValueError(f"{hits} hits in {trials} trials")
    tail = 0.5 * (1.0 - level)
    low = float(betaincinv(hits, trials - hits + 1, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1, trials - hits, 1.0 - tail)) if hits < trials else 1.0
    return Interval(low, high)
