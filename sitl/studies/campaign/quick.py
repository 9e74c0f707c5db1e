"""The subset that is flown with every change: small cells for the tool, a protection and its negative control."""

from __future__ import annotations

from sitl.studies.campaign.trials import Cell, Trial

_CELLS: tuple[tuple[Cell, int], ...] = (
    (Cell("swap", 3, 100.0, 0.1, "exact", 0.0, "default"), 1),
    (Cell("swap", 3, 100.0, 0.1, "exact", 0.0, "off"), 2),
    (Cell("swap", 3, 300.0, 0.3, "exact", 0.0, "guaranteed"), 1),
    (Cell("random", 4, 0.0, 0.0, "exact", 0.0, "default"), 1),
)

QUICK: tuple[Trial, ...] = tuple(Trial(cell, seed) for cell, seeds in _CELLS for seed in range(1, seeds + 1))
