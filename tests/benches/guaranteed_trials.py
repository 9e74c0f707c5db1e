"""Trials of swarms that fly by commitments, and the distances that they have to keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from sitl.studies.campaign.conditions.scenarios import layout_of
from sitl.studies.campaign.flight import TrialFlight
from sitl.studies.campaign.trials import Cell, Trial

COMMITTED_M = 0.8
TOUCH_M = 0.48
GUARANTEED_SWAP = Cell(
    scenario="swap", agents=4, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="guaranteed"
)
TUBE_M = 0.5 * (COMMITTED_M - TOUCH_M)


def flown(cell: Cell, seed: int = 1, **changes: Any) -> TrialFlight:
    """Fly the layout that the seed draws, with these changes of its fields."""
    flight = TrialFlight(Trial(cell, seed), replace(layout_of(cell.scenario, seed, cell.agents), **changes))
    flight.run()
    return flight


def fly_until(flight: TrialFlight, shown: Callable[[TrialFlight], bool]) -> TrialFlight:
    """Fly a trial until it has shown what it is flown for, at the longest to its end."""
    over = flight._over
    flight._over = lambda: shown(flight) or over()  # type: ignore[method-assign]
    flight.run()
    return flight


def events(flight: TrialFlight, name: str) -> list[dict[str, object]]:
    return [event for log in flight.lockstep.logs for event in log.events if event["event"] == name]
