"""Quantiles of a few numbers, without NumPy: its function loads masked arrays when it is called first, in a tick."""

from __future__ import annotations

from collections.abc import Iterable


def quantile(values: Iterable[float], share_01: float) -> float:
    """Return the value that a share of some values is below, linear between two of them as NumPy's."""
    ordered = sorted(values)
    low, part = divmod(share_01 * (len(ordered) - 1), 1.0)
    below, above = ordered[int(low)], ordered[min(int(low) + 1, len(ordered) - 1)]
    return below + part * (above - below)
