"""The `simulate` verb: a lockstep flight with the run folder, summary and exit code of a launch.

`python -m sitl.simulate [CONFIG] [--agents N] [--duration S] [--run-dir DIR] [--seed K] [--set key=value] [--jobs N]
[--view]`
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import Progress

from sitl.arguments import count
from sitl.flight_log import write_events
from sitl.lockstep import Flown
from sitl.lockstep_processes import LockstepProcesses
from swarmctl.config import Config, dump, load
from swarmctl.configuration.config_warnings import warning_lines
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, SwarmError, exit_code_of
from swarmctl.files import replace_bytes, write_each
from swarmctl.ops.flight.summary import draw_recording, summary_lines, unwritten_line, violation_lines
from swarmctl.ops.supervision.status_table import PlainLines
from swarmctl.process_lifetime import StopRequest
from swarmctl.process_priority import usable_processors
from swarmctl.telemetry.recording.file_names import RECORDING, TRUTH, events_file
from swarmctl.telemetry.recording.kept_outcome import forget_outcome
from swarmctl.telemetry.recording.new_run_folder import create_run_folder, held_run, write_config
from swarmctl.telemetry.recording.run_folder import Outcome, finish_run
from swarmctl.telemetry.view.recordings import open_viewer, optimize_recording
from swarmctl.wall_clock import utc_us


def simulate(config: Config, directory: Path, jobs: int) -> int:
    """Fly `config` in lockstep, in `jobs` processes, into the run folder `directory` and return the exit code."""
    with held_run(directory):
        write_config(directory, dump(config), "lockstep")
        with LockstepProcesses(config, directory, jobs) as flight:
            return _simulate(config, directory, flight)


def _simulate(config: Config, directory: Path, flight: LockstepProcesses) -> int:
    stop = StopRequest(signal.SIGINT, signal.SIGTERM, signal.SIGHUP, raise_at=2)  # the first request lands
    began_s = time.perf_counter()
    is_landing = False
    with _progress(config) as advance:

        def on_step() -> None:
            nonlocal is_landing
            if stop.count and not is_landing:
                is_landing = True
                flight.command("land")
            advance(flight.clock.now_us() * 1e-6)

        flight.run(on_step)
    wall_s = time.perf_counter() - began_s
    interrupted = bool(stop.count)  # what is asked from here on is too late: it has landed
    flown = flight.end()
    problems = flown.problems
    outcome = "interrupted" if interrupted else "failed" if problems else "completed"
    speed_factor = flight.clock.now_us() * 1e-6 / wall_s
    shown = () if interrupted else tuple(problems)
    gone = (*flown.unwritten, *_write_world(flown, directory))
    finished = finish_run(
        directory,
        config.rules("lockstep"),
        Outcome(outcome=outcome, problems=shown, speed_factor=speed_factor),
        flown.run_data(),
    )
    summary, unwritten = finished.summary, (*gone, *finished.unwritten)
    if gone:
        forget_outcome(directory, "lockstep")  # of what is left no report can say how it ended
    if not unwritten:
        draw_recording(config, directory)
        optimize_recording(directory)
    print_line = PlainLines(sys.stdout).print_line  # to a terminal that may have been closed
    for line in (*violation_lines(summary), *summary_lines(summary, directory)):
        print_line(line)
    print_line(f"{speed_factor:.3g} x real time")
    if unwritten:
        print_line(unwritten_line(directory, finished.unwritten, gone))
    if interrupted:
        return EXIT_INTERRUPTED
    return EXIT_OK if summary["outcome"] == "completed" and not unwritten else EXIT_MISSION


@contextmanager
def _progress(config: Config) -> Iterator[Callable[[float], None]]:
    """Yield a function of simulated time [s] that draws a bar on a terminal; a lost terminal stops nothing."""
    total_s = config.mission.duration_s + 20.0  # time to the start and back
    bar = Progress(transient=True, disable=not sys.stdout.isatty())
    task = bar.add_task(f"simulating {config.swarm.agents} agents", total=total_s)
    with suppress(OSError):
        bar.start()
    try:
        yield lambda now_s: bar.update(task, completed=min(total_s, now_s))
    finally:
        with suppress(OSError):
            bar.stop()


def _write_world(flown: Flown, directory: Path) -> tuple[str, ...]:
    """Write the files that a live simulator writes; return what the disk did not take."""
    writers: dict[str, Callable[[], object]] = {TRUTH: lambda: replace_bytes(directory / TRUTH, flown.truth.tobytes())}
    if flown.fault_events:
        faults = events_file("sitl")
        writers[faults] = lambda: write_events(directory / faults, flown.fault_events)
    return write_each(writers)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarmctl simulate", description=__doc__.splitlines()[0])
    parser.add_argument("config", nargs="?", type=Path)
    parser.add_argument("--agents", metavar="N", dest="swarm.agents")
    parser.add_argument("--duration", metavar="S", dest="mission.duration_s")
    parser.add_argument("--seed", metavar="K", dest="seed")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], dest="sets")
    parser.add_argument("--run-dir", metavar="DIR", type=Path, dest="run_dir")
    processors = len(usable_processors())
    jobs = "processes that share the agents, which changes no result; default: %(default)s, one per processor"
    parser.add_argument("--jobs", metavar="N", type=count, default=processors, help=jobs)
    parser.add_argument("--view", action=argparse.BooleanOptionalAction, default=False)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the verb and return the process exit code."""
    options: dict[str, Any] = vars(_parser().parse_args(arguments))
    return exit_code_of(partial(_run, options))


def _run(options: dict[str, Any]) -> int:
    overrides = list(options["sets"])
    overrides += [f"{k}={options[k]}" for k in ("swarm.agents", "mission.duration_s", "seed") if options[k] is not None]
    config = load(options["config"], overrides)
    for line in warning_lines(config):
        print(line, file=sys.stderr)
    directory = create_run_folder(options["run_dir"], config.name, utc_us())
    code = simulate(config, directory, options["jobs"])
    if options["view"]:
        _open(directory / RECORDING)
    return code


def _open(recording: Path) -> None:
    """Open a window on a recording; where none can be opened, say so: the flight keeps its exit code."""
    try:
        open_viewer(str(recording))
    except SwarmError as error:
        print(error, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
