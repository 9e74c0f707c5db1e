"""The `reproduce` verb: flies the six experiments of the thesis and writes the results beside the published ones.

Its options are in `command`. Flights are independent and shared out over processes; timing is measured afterwards,
alone.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from sitl.studies.bench.timing import timing_rows
from sitl.studies.thesis import experiments as thesis
from sitl.studies.thesis import score
from sitl.studies.thesis.experiments import FULL_JOBS, PLANT_JOBS, TUNED, Job
from sitl.studies.thesis.figures import FLIGHTS, Extra, IndexPoint
from sitl.studies.thesis.mavlink_flight import fly_over_mavlink
from sitl.studies.thesis.model_flight import fly_on_plant
from sitl.studies.thesis.page import write_json, write_page
from sitl.studies.thesis.table import rows as rows_of
from sitl.studies.thesis.trace import Beside, Row, Trace
from sitl.studies.thesis.verdicts import MEANING, counted, counts_text, verdict_of
from swarmctl.errors import EXIT_MISSION, EXIT_OK, ConfigError, StartError
from swarmctl.process_lifetime import serve_parent
from swarmctl.telemetry.recording.new_run_folder import create_run_folder
from swarmctl.wall_clock import utc_us

TIMING = "timing"  # name of the timing rows for `--only`


def fly(job: Job) -> Trace:
    """Fly one job."""
    config = job.loaded()
    if job.path == "plant":
        return fly_on_plant(job.name, config, matched_velocity=job.matched_velocity)
    return fly_over_mavlink(job.name, config)


def fly_job(job: Job) -> tuple[Job, list[Trace], str]:
    """Fly a job in a worker: return its traces (see `thesis.is_flown_again`), or why there is none."""
    try:
        traces = [fly(job)]
        if thesis.is_flown_again(job):
            traces.append(fly(thesis.wider(job, traces[0])))
    except Exception as error:  # a failed flight must not end the others
        return job, [], f"{type(error).__name__}: {error}"
    return job, traces, ""


def fly_all(jobs: Sequence[Job], processes: int, bar: Progress) -> tuple[dict[str, Trace], dict[str, str]]:
    """Return traces by name, and errors by job name. An early exit, also by Ctrl-C, ends the workers."""
    flown: dict[str, Trace] = {}
    failed: dict[str, str] = {}
    task = bar.add_task("flying", total=len(jobs))
    longest_first = sorted(jobs, key=lambda job: job.flight != "circle")
    with multiprocessing.get_context("spawn").Pool(processes, serve_parent) as pool:
        for job, traces, why in pool.imap_unordered(fly_job, longest_first):
            bar.update(task, advance=1, description=job.name)
            flown.update({trace.name: trace for trace in traces})
            if why:
                failed[job.name] = why
    return flown, failed


def chosen(only: Sequence[str], plant: bool, full: bool) -> list[Job]:
    """Return the requested jobs; without a path, both.

    Raises:
        ConfigError: a flight is not known.
    """
    unknown = [name for name in only if name not in (*FLIGHTS, TIMING)]
    if unknown:
        known = ", ".join([*FLIGHTS, TIMING])
        raise ConfigError("--only", [f"{name!r} is no experiment; known are {known}" for name in unknown])
    both = plant == full
    paths = {"plant": plant or both, "full": full or both}
    return [job for job in (*PLANT_JOBS, *FULL_JOBS) if paths[job.path] and (not only or job.flight in only)]


def by_flight(jobs: Sequence[Job], flown: dict[str, Trace]) -> dict[str, list[Trace]]:
    """Return the traces of the page: of a swarm one per path and kind, of single vehicles all."""
    found: dict[str, list[Trace]] = {}
    for job in jobs:
        other_radius = job.radius_m is not None and job.radius_m != thesis.RADII[0] * thesis.SAFE_RADIUS_M
        if job.name in flown and not other_radius:
            found.setdefault(job.flight, []).append(flown[job.name])
    return found


def index_points(flown: dict[str, Trace]) -> Iterator[IndexPoint]:
    """Yield the points of the index over the constraint radius (Table 19)."""
    for kind in (f"dmpc {thesis.THESIS}", f"dmpc {TUNED}", f"dmpc3 {TUNED}"):
        for factor in thesis.RADII:
            trace = flown.get(thesis.radius_name(kind, factor))
            if trace is not None:
                radius_m = factor * thesis.SAFE_RADIUS_M
                yield IndexPoint(
                    radius_m=radius_m,
                    ours_m=score.index_m(trace),
                    published_m=thesis.TABLE_19_M.get(factor),
                    series=kind,
                )


_BESIDE: dict[Beside | None, str] = {
    None: "",
    "beaten": "[green]beaten",
    "equal": "equal",
    "worse": "[red]worse",
    "too close": "[red]too close",
}


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the rows as a table; its head says what the words mean."""
    head = "\n".join(f"[bold]{word}[/]: {meaning}." for word, meaning in MEANING.items())
    table = Table(title=head, title_justify="left", title_style="none", show_edge=False)
    table.add_column("row")
    for name in ("published", "ours"):
        table.add_column(name, justify="right")
    table.add_column("")
    for name in ("limit", "lower bound"):
        table.add_column(name, justify="right")
    table.add_column("")
    for row in rows:
        published, ours, limit, bound = (
            "" if value is None else f"{value:.4g}" for value in (row.published, row.ours, row.limit, row.lower_bound)
        )
        color = "[green]" if row.met else "[red]"
        verdict = f"{color}{verdict_of(row)}" if row.limit is not None else ""
        table.add_row(row.name, published, ours, _BESIDE[row.beside], limit, bound, verdict)
    console.print(table)


def reproduce(only: Sequence[str], plant: bool, full: bool, directory: Path, *, processes: int) -> int:
    """Fly, evaluate and write; return the exit code."""
    console, began_s = Console(), time.perf_counter()
    jobs = chosen(only, plant, full)
    with Progress(console=console, transient=True, disable=not sys.stdout.isatty()) as bar:
        flown, failed = fly_all(jobs, processes, bar)
        rows = rows_of(flown)
        if not only or TIMING in only:
            rows += timing_rows(bar)
    notes = [f"{name} did not complete: {why}" for name, why in failed.items()]
    radius_m = 3.0 * thesis.SAFE_RADIUS_M
    extra = Extra({"circle": radius_m, "obstacle": radius_m}, tuple(index_points(flown)), tuple(notes))
    write_json(directory, rows)
    page = write_page(directory, rows, by_flight(jobs, flown), extra)
    if rows:
        show(rows, console)
    for note in notes:
        print(note, file=sys.stderr)
    words = counts_text(counted(rows)) if rows else "no figures to compare with; the curves are on the page"
    print(f"{words}; {time.perf_counter() - began_s:.0f} s; {page}")
    return EXIT_MISSION if failed else EXIT_OK


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StartError(f"{directory} can't be made: {error}. Choose another with --out") from error


def run(options: argparse.Namespace) -> int:
    """Fly what the command line asks for; return the exit code.

    Raises:
        ConfigError: a flight is not known, or no process is left to fly.
    """
    if options.jobs < 1:
        raise ConfigError("--jobs", [f"{options.jobs}: at least 1 process flies"])
    chosen(options.only, options.plant, options.full)
    directory = options.out or create_run_folder(None, "reproduce", utc_us(), advice="Choose another with --out")
    _make(directory)
    return reproduce(options.only, options.plant, options.full, directory, processes=options.jobs)
