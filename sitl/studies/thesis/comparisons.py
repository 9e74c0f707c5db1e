"""Rows that relate flights: at equal true distance, `dmpc3` over `dmpc`, full MAVLink loop beside model only."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from sitl.studies.thesis import score
from sitl.studies.thesis.experiments import (
    FULL_JOBS,
    FULL_LOOP,
    PLANT_JOBS,
    RADII,
    SAFE_RADIUS_M,
    SAFETY_FILTER_M,
    TABLE_19_M,
    TUNED,
    Flown,
    Job,
    radius_name,
)
from sitl.studies.thesis.trace import Row, Trace
from swarmctl.telemetry.evaluation.referee import STEADY_AFTER_S

TRIANGLE = "an equilateral triangle around the reference: sqrt(3) r"
NO_LESS = "by definition"


def lower_bound_index_m(radius_m: float) -> float:
    """Theoretical lower bound [m] of the tracking index: three agents `radius_m` apart form an equilateral triangle."""
    return math.sqrt(3.0) * radius_m


def settled_over_bound(radius_m: float) -> Callable[[Trace], float]:
    """Return the figure of the index after the start-up, over its lower bound."""
    return lambda trace: score.index_m(trace, STEADY_AFTER_S) / lower_bound_index_m(radius_m)


def true_distance_rows(flown: Flown) -> Iterator[Row]:
    jobs = {job.name: job for job in PLANT_JOBS}
    for factor in RADII:
        job = jobs[radius_name(f"dmpc {TUNED}", factor)]
        trace = flown.get(f"{job.name}, true distance")
        if trace is not None:
            apart_m, radius_m = score.separation_m(trace), factor * SAFE_RADIUS_M
            yield Row(
                name=f"circle dmpc {TUNED}, Table 19, {factor:g} x 0.3 m, index at equal true distance",
                published=TABLE_19_M.get(factor),
                ours=score.index_m(trace),
                limit=None,
                path="plant",
                unit="m",
                note=f"smallest true distance {apart_m:.4f} m, the constraint being wider by what was missing",
                lower_bound=lower_bound_index_m(radius_m),
                bound_source=TRIANGLE,
                decimals=2,
                short_m=max(0.0, radius_m - apart_m),
                preset=job.preset,
                differs=job.differences(),
            )


def dmpc3_rows(flown: Flown) -> Iterator[Row]:
    """Yield `dmpc3` relative to `dmpc`, both tuned, on every row they share: 1 and below is not worse."""
    tuned = [(radius_name(f"dmpc {TUNED}", f), radius_name(f"dmpc3 {TUNED}", f), f) for f in RADII]
    bounds_m = [lower_bound_index_m(factor * SAFE_RADIUS_M) for factor in RADII]
    pairs: list[tuple[str, str, str, Callable[[Trace], float], float]] = [
        (f"circle, {factor:g} x 0.3 m, index", one, other, score.index_m, bound_m)
        for (one, other, factor), bound_m in zip(tuned, bounds_m, strict=True)
    ]
    one, other, factor = tuned[0]
    settled = settled_over_bound(factor * SAFE_RADIUS_M)
    pairs.append((f"circle, {factor:g} x 0.3 m, index after 10 s", one, other, settled, 1.0))
    jobs = f"obstacle dmpc {TUNED}", f"obstacle dmpc3 {TUNED}"
    pairs.append(("obstacle, index", *jobs, score.index_m, bounds_m[0]))
    for name, one, other, figure, bound in pairs:
        if one in flown and other in flown:
            before = figure(flown[one])
            yield Row(
                name=f"{name}, dmpc3 over dmpc",
                published=None,
                ours=figure(flown[other]) / before,
                limit=1.0,
                path="plant",
                unit="1",
                note=f"both {TUNED}",
                lower_bound=bound / before,
                bound_source=f"{TRIANGLE}, over the figure of dmpc",
            )


def _full_note(job: Job) -> str:
    """Say what the figure is and, where the radius is below what it keeps, that the safety filter is off."""
    notes = ["for one vehicle: its mean distance"] if job.radius_m is None else []
    if job.radius_m is not None and job.radius_m < SAFETY_FILTER_M:
        notes.append(f"safety filter off: it keeps {SAFETY_FILTER_M:g} m between centres, and vehicles are points here")
    return "; ".join(notes)


def full_rows(flown: Flown) -> Iterator[Row]:
    """Yield the figures of the full MAVLink loop, and their difference from the model-only flights."""
    for job in FULL_JOBS:
        trace, plant = flown.get(job.name), flown.get(job.name.removesuffix(FULL_LOOP))
        if trace is None or job.flight in ("open_loop", "pid_step", "pid_steps"):
            continue
        index = Row(
            name=f"{job.name}, index",
            published=None,
            ours=score.index_m(trace),
            limit=None,
            path="full",
            unit="m",
            note=_full_note(job),
            preset=job.preset,
            differs=job.differences(),
        )
        yield index
        if plant is not None:
            yield replace(
                index,
                name=f"{job.name}, index differs from model only by",
                ours=abs(index.ours / score.index_m(plant) - 1.0),
                limit=0.05,
                unit="1",
                note="",
                lower_bound=0.0,
                bound_source=NO_LESS,
            )
