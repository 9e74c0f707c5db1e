"""Disturbances of a campaign: one table, each row a function of seed, agents and strength.

A disturbance is drawn apart from the scenario: the same seed flies the same layout under every disturbance. Its
strength follows a colon, as in `steps:6`; without one it has the strength of the table.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sitl.studies.campaign.conditions.events import (
    Freeze,
    OneWayCut,
    Recovery,
    Restart,
    ScenarioEvent,
    SimulatorFault,
    Split,
)
from sitl.studies.campaign.conditions.scenarios import Layout
from swarmctl.core.clock import ClockError
from swarmctl.simulator_config import FaultParams

NONE = "none"
_PURPOSE = 11  # of the random stream
_BEGINS_S = (0.3, 4.0)  # mission time at which most of them begin: on the way to the middle of a swap, and in it
_LASTS_S = (1.0, 8.0)
_GUST_S = (1.0, 4.0)
_DRIFT_PPM = 200.0
_ENDED_AFTER_S = 10.0  # `swarmctl.ops.supervision.supervisor`: named after 5 s of silence, ended after 5 s more


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbance:
    """A row of the table."""

    title: str
    draw: Callable[[np.random.Generator, Layout, float], Layout]  # of the undisturbed layout and the strength
    strength: float = 0.0  # unless another one is given
    unit: str = ""


def _nothing(rng: np.random.Generator, layout: Layout, strength: float) -> Layout:
    return layout


def _clocks(rng: np.random.Generator, layout: Layout, offset_ms: float) -> Layout:
    offsets_us = (1000.0 * rng.uniform(-offset_ms, offset_ms, layout.agents)).round().astype(int).tolist()
    drifts_ppm = rng.uniform(-_DRIFT_PPM, _DRIFT_PPM, layout.agents).tolist()
    errors = [ClockError(offset_us=us, drift_ppm=ppm) for us, ppm in zip(offsets_us, drifts_ppm, strict=True)]
    return replace(layout, clocks=dict(enumerate(errors)))


def _split(rng: np.random.Generator, layout: Layout, heals_01: float) -> Layout:
    """Cut the swarm into two groups; for good, only a majority is expected to arrive, and nobody of two halves."""
    agents = layout.agents
    order, size = rng.permutation(agents).tolist(), int(rng.integers(1, agents))
    groups = [frozenset(order[:size]), frozenset(order[size:])]
    heals = rng.random() < heals_01
    at_s, for_s = float(rng.uniform(*_BEGINS_S)), float(rng.uniform(*_LASTS_S)) if heals else math.inf
    minorities = [group for group in groups if 2 * len(group) <= agents]
    return _with(layout, [Split(groups, at_s, for_s)], lost=() if heals else frozenset().union(*minorities))


def _one_way(rng: np.random.Generator, layout: Layout, for_s: float) -> Layout:
    """For a while, one agent receives another one no longer, which still receives it; as many times as there are."""
    events = []
    for _ in range(layout.agents):
        sender, receiver = rng.choice(layout.agents, 2, replace=False).tolist()
        events.append(OneWayCut(sender, receiver, float(rng.uniform(*_BEGINS_S)), for_s))
    return _with(layout, events)


def _bursts(rng: np.random.Generator, layout: Layout, bad_01: float) -> Layout:
    return _set(layout, f"bus.burst_01={bad_01}", "bus.burst_s=2.0")


def _jitter(rng: np.random.Generator, layout: Layout, jitter_ms: float) -> Layout:
    return _set(layout, f"bus.jitter_ms={jitter_ms}")


def _freeze(rng: np.random.Generator, layout: Layout, for_s: float) -> Layout:
    """Stop a process; one that stays so is ended by its host's supervisor, which has another land the vehicle."""
    victim, at_s = int(rng.integers(layout.agents)), float(rng.uniform(*_BEGINS_S))
    if for_s <= _ENDED_AFTER_S:
        return _with(layout, [Freeze(victim, at_s, for_s)])
    events = [Freeze(victim, at_s, math.inf), Recovery(victim, at_s + _ENDED_AFTER_S)]
    return _with(_set(layout, "sitl.start=ground"), events, lost={victim})  # where it lands


def _restarts(rng: np.random.Generator, layout: Layout, after_s: float) -> Layout:
    """Start one agent's process again, which lands the vehicle: no agent takes one back from a failsafe by itself."""
    victim, at_s = int(rng.integers(layout.agents)), float(rng.uniform(*_BEGINS_S))
    return _with(_set(layout, "sitl.start=ground"), [Restart(victim, at_s, after_s)], lost={victim})


def _steps(rng: np.random.Generator, layout: Layout, wind_m_s: float) -> Layout:
    return _on_each(rng, layout, "wind", wind_m_s)


def _gusts(rng: np.random.Generator, layout: Layout, wind_m_s: float) -> Layout:
    return _on_each(rng, layout, "gust", wind_m_s, lasts_s=_GUST_S)


def _turbulence(rng: np.random.Generator, layout: Layout, wind_m_s: float) -> Layout:
    return _set(layout, f"sitl.wind.turbulence_m_s={wind_m_s}")


def _gaps(rng: np.random.Generator, layout: Layout, gap_s: float) -> Layout:
    return _on_each(rng, layout, "link_loss", 1.0, lasts_s=(gap_s, gap_s), direction="from_vehicle")


def _masses(rng: np.random.Generator, layout: Layout, spread_01: float) -> Layout:
    ratios = rng.uniform(1.0 - spread_01, 1.0 + spread_01, layout.agents).tolist()
    faults = ", ".join(f'{{kind="mass", vehicle={i}, value={ratio}}}' for i, ratio in enumerate(ratios))
    return _set(layout, f"sitl.faults=[{faults}]")


def _on_each(
    rng: np.random.Generator,
    layout: Layout,
    kind: str,
    value: float,
    *,
    lasts_s: tuple[float, float] | None = None,
    **fields: str,
) -> Layout:
    """Put a fault on every vehicle, at a time and in a direction of its own; without `lasts_s` it lasts."""
    events = []
    for vehicle in range(layout.agents):
        at_s, towards_deg = float(rng.uniform(*_BEGINS_S)), float(rng.uniform(-180.0, 180.0))
        for_s = 0.0 if lasts_s is None else float(rng.uniform(*lasts_s))
        chosen = {"kind": kind, "vehicle": vehicle, "value": value, "towards_deg": towards_deg, "for_s": for_s}
        events.append(SimulatorFault(FaultParams.model_validate(chosen | fields), at_s))
    return _with(layout, events)


def _with(layout: Layout, events: Sequence[ScenarioEvent], lost: Iterable[int] = ()) -> Layout:
    return replace(layout, events=(*layout.events, *events), lost=layout.lost | frozenset(lost))


def _set(layout: Layout, *settings: str) -> Layout:
    return replace(layout, settings=(*layout.settings, *settings))


DISTURBANCES: dict[str, Disturbance] = {
    NONE: Disturbance(title="nothing happens", draw=_nothing),
    "clocks": Disturbance(
        title=f"agents' clocks are wrong and drift by up to {_DRIFT_PPM:g} ppm", draw=_clocks, strength=500.0, unit="ms"
    ),
    "split": Disturbance(
        title="two random groups no longer hear each other; strength: how many splits end again",
        draw=_split,
        strength=0.5,
        unit="0..1",
    ),
    "one_way": Disturbance(title="single directions between two agents fail", draw=_one_way, strength=3.0, unit="s"),
    "bursts": Disturbance(title="links fail for 2 s at a time", draw=_bursts, strength=0.4, unit="0..1 of the time"),
    "jitter": Disturbance(
        title="messages are late by chance and overtake each other", draw=_jitter, strength=100.0, unit="ms"
    ),
    "freeze": Disturbance(title="one agent's process stops", draw=_freeze, strength=math.inf, unit="s"),
    "restarts": Disturbance(
        title="one agent's process dies, and another one is started", draw=_restarts, strength=1.0, unit="s"
    ),
    "steps": Disturbance(
        title="a wind of its own hits every vehicle from one instant to the next", draw=_steps, strength=8.0, unit="m/s"
    ),
    "gusts": Disturbance(title="the same as 1-cosine gusts of 1 to 4 s", draw=_gusts, strength=8.0, unit="m/s"),
    "turbulence": Disturbance(title="Dryden turbulence of this wind", draw=_turbulence, strength=8.0, unit="m/s"),
    "gaps": Disturbance(title="telemetry of every vehicle stops once", draw=_gaps, strength=0.35, unit="s"),
    "masses": Disturbance(
        title="vehicles are lighter or heavier than modelled", draw=_masses, strength=0.3, unit="0..1"
    ),
}


def disturbed(layout: Layout, disturbance: str, seed: int) -> Layout:
    """Return a layout under a disturbance, `name` or `name:strength`, as a seed draws it.

    Raises:
        ValueError: there is no such disturbance, or its strength is no number.
    """
    name, _, strength = disturbance.partition(":")
    if name not in DISTURBANCES:
        raise ValueError(f"{name}: allowed: {', '.join(DISTURBANCES)}")
    row = DISTURBANCES[name]
    rng = np.random.default_rng([seed, layout.agents, zlib.crc32(name.encode()), _PURPOSE])
    return row.draw(rng, layout, float(strength) if strength else row.strength)
