"""Sums of floats whose terms are added one after the other, by any Python.

From Python 3.12 on `sum` compensates rounding errors of floats, so that a flight would depend on the version.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def ordered_sum(terms: Iterable[float]) -> float:
    """Return the sum of the terms, 0.0 without any."""
    total = 0.0
    for term in terms:
        total += term
    return total


def dot(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the scalar product of two vectors (n,)."""
    total = 0.0
    for a, b in zip(one, other, strict=True):
        total += a * b
    return total
