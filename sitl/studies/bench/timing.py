"""Timing rows of `reproduce`: measured after all flights, alone, solvers in turn on the same problems.

The x-y problem with two neighbours and an obstacle is captured from a flight. SLSQP solves the thesis' own problem:
true distances, hard, at every step, without gradients, as fmincon does by default.
"""

from __future__ import annotations

from rich.progress import Progress

from sitl.studies.bench.captured import capture, circle_with_obstacle, measure_xy
from sitl.studies.thesis.trace import Path, Row

_PROBLEM = "x-y problem, 2 neighbours and 1 obstacle"
_FASTER = 50.0  # required speed-up over SLSQP


def timing_rows(bar: Progress) -> list[Row]:
    """Return medians and 99th percentiles of one run on this machine."""
    captured = capture(circle_with_obstacle())
    task = bar.add_task("solving", total=len(captured.problems))
    found = measure_xy(captured, on_problem=lambda: bar.update(task, advance=1))
    osqp, fmincon = found.qp("osqp"), found.fmincon
    assert fmincon is not None
    kept = f"{fmincon.solved_01:.0%} of {found.problems} problems have a solution to it; the ratio is of those"
    slower = f"{kept}; OSQP is first order and takes some 140 iterations, DAQP's active set a few"
    has_daqp = "daqp" in found.qp_ms  # an optional package
    return [
        _time(f"{_PROBLEM}, OSQP, median", osqp.p50_ms, 0.5),
        _time(f"{_PROBLEM}, OSQP, 99th percentile", osqp.p99_ms, 1.5),
        *([_time(f"{_PROBLEM}, DAQP, median", found.qp("daqp").p50_ms)] if has_daqp else []),
        _time(f"{_PROBLEM}, SLSQP in place of fmincon, median", fmincon.times.p50_ms, note=kept),
        _ratio(f"{_PROBLEM}, OSQP over SLSQP", 1.0 / found.speed_up(), slower),
        *([_ratio(f"{_PROBLEM}, DAQP over SLSQP", 1.0 / found.speed_up("daqp"), kept)] if has_daqp else []),
        _time("whole tick, 2 neighbours and 1 obstacle, median", found.tick.p50_ms, 1.5, path="full"),
    ]


def _time(
    name: str,
    ours_ms: float,
    limit_ms: float | None = None,
    *,
    path: Path = "plant",
    note: str = "",
) -> Row:
    return Row(name=name, published=None, ours=ours_ms, limit=limit_ms, path=path, unit="ms", note=note)


def _ratio(name: str, ours: float, note: str) -> Row:
    return Row(name=name, published=None, ours=ours, limit=1.0 / _FASTER, path="plant", unit="1", note=note)
