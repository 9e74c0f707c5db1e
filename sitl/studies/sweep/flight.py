"""One flight of a sweep: in lockstep, judged by the referee as that of `simulate` is."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from sitl.lockstep import Lockstep
from sitl.studies.sweep.figures import FIGURES, Row
from sitl.studies.sweep.points import Axis, Flight
from swarmctl.telemetry.evaluation.referee import evaluate


@dataclass(frozen=True, slots=True)
class FlySweep:
    """Flies the flights of one sweep; it is sent to the worker processes."""

    base: Path  # the configuration to which swept values are applied
    axes: tuple[Axis, ...]
    code: str  # digest of the sources that fly, own modules among them

    def __call__(self, flight: Flight) -> Row:
        """Fly one and return its row."""
        began_s = time.process_time()
        config = flight.config(self.base)
        lockstep = Lockstep(config)
        lockstep.run()
        problems = lockstep.problems()
        outcome = "failed" if problems else "completed"
        summary = evaluate(lockstep.recorded(), config.rules("lockstep"), outcome, problems)
        swept = {axis.key: axis.stored(value) for axis, (_, value) in zip(self.axes, flight.settings, strict=True)}
        figures = {figure.name: figure.of(summary) for figure in FIGURES}
        ended = {"cpu_s": time.process_time() - began_s, "code": self.code}
        return {**swept, "seed": flight.seed, "outcome": summary["outcome"], **figures, **ended}
