"""Conditions on received fields."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Between:
    """A number within bounds, both included."""

    low: float
    high: float

    def accepts(self, value: Any) -> bool:
        return isinstance(value, int | float) and self.low <= value <= self.high


def near(value: float, tolerance: float) -> Between:
    return Between(value - tolerance, value + tolerance)


@dataclass(frozen=True, slots=True)
class Bits:
    """An integer with all bits of `on` set and none of `off`."""

    on: int = 0
    off: int = 0

    def accepts(self, value: Any) -> bool:
        return isinstance(value, int) and value & self.on == self.on and not value & self.off


@dataclass(frozen=True, slots=True)
class NotANumber:
    """NaN."""

    def accepts(self, value: Any) -> bool:
        return isinstance(value, float) and math.isnan(value)


@dataclass(frozen=True, slots=True)
class Other:
    """Anything but this."""

    than: Any

    def accepts(self, value: Any) -> bool:
        return bool(value != self.than)


@dataclass(frozen=True, slots=True)
class Each:
    """A list whose first elements satisfy these, in order."""

    wanted: tuple[Any, ...]

    def accepts(self, value: Any) -> bool:
        return len(value) >= len(self.wanted) and all(
            fits(v, w) for v, w in zip(value[: len(self.wanted)], self.wanted, strict=True)
        )


def fits(value: Any, wanted: Any) -> bool:
    """Return whether a received field meets a row's condition."""
    if hasattr(wanted, "accepts"):
        return bool(wanted.accepts(value))
    if isinstance(wanted, float):
        return isinstance(value, int | float) and math.isclose(value, wanted, rel_tol=1e-6, abs_tol=1e-6)
    return bool(value == wanted)
