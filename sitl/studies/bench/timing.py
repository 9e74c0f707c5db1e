"""Timing rows of `reproduce`: measured after all flights, alone, solvers in turn on the same problems.

The x-y problem with two neighbours and an obstacle is captured from a flight. SLSQP solves the thesis' own problem:
true distances, hard, at every step, without gradients, as fmincon does by default.
"""

from __future__ import annotations

from rich.progress import Progress

from sitl.studies.bench.captured import capture, circle_with_obstacle, measure_xy
from sitl.studies.thesis.trace import Row

_PROBLEM = "x-y problem, 2 neighbours and 1 obstacle"
_FASTER = 50.0  # required speed-up over SLSQP


def timing_rows(bar: Progress) -> list[Row]:
    """Return medians and 99th percentiles of one run on this machine."""
    captured = capture(circle_with_obstacle())
    task = bar.add_task("solving", total=len(captured.problems))
    found = measure_xy(captured, on_problem=lambda: bar.update(task, advance=1))
    osqp, fmincon = found.qp("osqp"), found.fmincon
    assert fmincon is not None
    ms = "ms"
    kept = f"{fmincon.solved_01:.0%} of {found.problems} problems have a solution to it; the ratio is of those"
    slower = f"{kept}; OSQP is first order and takes some 140 iterations, DAQP's active set a few"
    rows = [
        Row(name=f"{_PROBLEM}, OSQP, median", published=None, ours=osqp.p50_ms, limit=0.5, path="plant", unit=ms),
        Row(
            name=f"{_PROBLEM}, OSQP, 99th percentile",
            published=None,
            ours=osqp.p99_ms,
            limit=1.5,
            path="plant",
            unit=ms,
        ),
        Row(
            name=f"{_PROBLEM}, SLSQP in place of fmincon, median",
            published=None,
            ours=fmincon.times.p50_ms,
            limit=None,
            path="plant",
            unit=ms,
            note=kept,
        ),
        Row(
            name=f"{_PROBLEM}, OSQP over SLSQP",
            published=None,
            ours=1.0 / found.speed_up(),
            limit=1.0 / _FASTER,
            path="plant",
            unit="1",
            note=slower,
        ),
        Row(
            name="whole tick, 2 neighbours and 1 obstacle, median",
            published=None,
            ours=found.tick.p50_ms,
            limit=1.5,
            path="full",
            unit=ms,
        ),
    ]
    if "daqp" in found.qp_ms:  # an optional package
        ratio = 1.0 / found.speed_up("daqp")
        rows.insert(
            2,
            Row(
                name=f"{_PROBLEM}, DAQP, median",
                published=None,
                ours=found.qp("daqp").p50_ms,
                limit=None,
                path="plant",
                unit=ms,
            ),
        )
        rows.insert(
            5,
            Row(
                name=f"{_PROBLEM}, DAQP over SLSQP",
                published=None,
                ours=ratio,
                limit=1.0 / _FASTER,
                path="plant",
                unit="1",
                note=kept,
            ),
        )
    return rows
