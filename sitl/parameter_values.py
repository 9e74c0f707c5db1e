"""A parameter of a simulated autopilot as MAVLink carries it, whatever its encoding."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class WireValue:
    """A parameter as PARAM_VALUE carries it."""

    name: str
    value: float
    kind: int
    index: int


class UnknownParameterError(KeyError):
    """There is no parameter of that name."""
