"""The subset that is flown with every change: small cells for the tool, a protection and its negative control."""

from __future__ import annotations

from sitl.studies.campaign.trials import Cell, Trial

_CELLS: tuple[tuple[Cell, int], ...] = (
    (Cell(scenario="swap", agents=3, delay_ms=100.0, loss=0.1, noise="exact", wind_m_s=0.0, protections="default"), 1),
    (Cell(scenario="swap", agents=3, delay_ms=100.0, loss=0.1, noise="exact", wind_m_s=0.0, protections="off"), 2),
    (
        Cell(
            scenario="swap", agents=3, delay_ms=300.0, loss=0.3, noise="exact", wind_m_s=0.0, protections="guaranteed"
        ),
        1,
    ),
    (Cell(scenario="random", agents=4, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="default"), 1),
)

QUICK: tuple[Trial, ...] = tuple(Trial(cell, seed) for cell, seeds in _CELLS for seed in range(1, seeds + 1))
