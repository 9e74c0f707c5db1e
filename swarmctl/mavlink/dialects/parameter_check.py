"""Checks of an autopilot's parameters before a flight: a value and facts in, an opinion out. Pure.

Checks that several autopilots share are at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from swarmctl.core.verdict import Verdict

_HOVER_APART_01 = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Opinion:
    """An assessment of one value of one parameter."""

    verdict: Verdict
    wanted: str
    advice: str = ""
    to_set: float | int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterContext:
    """What an opinion on a value may depend on: other facts of the vehicle, and the configuration."""

    number: Callable[[str], float | None]  # value of another parameter; None while it is unknown
    has_radio: bool  # a radio receiver is present and healthy
    is_board: bool  # certainly a real autopilot; False leaves it open
    sysid: int
    wanted_sysid: int
    hover_thrust_01: float  # of the configuration
    tilt_max_rad: float  # of the configuration
    model_key: str  # of the section that has both


@dataclass(frozen=True, slots=True)
class ParameterCheck:
    """One parameter and the rule that assesses its value."""

    name: str
    why: str  # why it matters
    assess: Callable[[float, ParameterContext], Opinion]


def ok(wanted: str) -> Opinion:
    """Return the opinion that nothing needs to be done."""
    return Opinion(verdict=Verdict.OK, wanted=wanted)


def assess_hover(value: float, seen: ParameterContext) -> Opinion:
    """Compare the autopilot's hover thrust with the configured one."""
    ours = seen.hover_thrust_01
    wanted = f"{seen.model_key}.hover_thrust_01 = {ours:g}"
    if abs(value - ours) <= _HOVER_APART_01:
        return ok(wanted)
    return Opinion(
        verdict=Verdict.NOTE,
        wanted=wanted,
        advice=f"first guesses differ; set {seen.model_key}.hover_thrust_01 = {value:g}",
    )


def assess_own_sysid(value: float, seen: ParameterContext) -> Opinion:
    """Compare the stored system id with the one that the autopilot still uses."""
    if value == seen.sysid:
        return ok(f"{seen.wanted_sysid}")
    return Opinion(
        verdict=Verdict.FIX,
        wanted=f"{seen.wanted_sysid}",
        advice="it still speaks as another one; reboot the autopilot",
    )
