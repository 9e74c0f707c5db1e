"""End of a run: the referee judges the run folder, and the result is printed in five lines."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmctl.bus.bus import agent_name
from swarmctl.config import Config, load_recorded
from swarmctl.configuration.view import viewed_flight
from swarmctl.core.text import printable
from swarmctl.mavlink.signing.refusals import HARMLESS
from swarmctl.ops.running_launches import refuse_running
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.telemetry.evaluation.referee import SUMMED_ERROR
from swarmctl.telemetry.evaluation.station_clock import corrected_text
from swarmctl.telemetry.recording.file_names import RECORDING

_LONGEST_NAME = 180  # bytes of a page's name: file systems take 255, of which its temporary name needs some
_LATE_SHOWN = 5  # agents that are named because a station has not seen their beginning
_MISSED_SHOWN = 5  # agents that are named because they have not reached their goals


def sum_up(
    config: Config, directory: Path, result: LaunchResult, print_line: Callable[[str], None], *, had_viewer: bool
) -> bool:
    """Finish the run folder and print the result; return whether the referee found a violation.

    A folder that can't be read or written is a problem of the run, and never loses the result. Where there was a
    viewer that has recorded nothing, which has the processor time that others leave, the recording is drawn now.
    """
    from swarmctl.telemetry.recording.run_folder import Outcome, finish_run  # heavy

    try:
        outcome = Outcome(outcome=result.outcome, problems=tuple(result.problems))
        summary, unwritten = finish_run(directory, config.rules(), outcome)
    except Exception as error:
        known = {"outcome": result.outcome, "violations": list(result.problems)}
        for line in (*violation_lines(known), *summary_lines(known, directory)):
            print_line(line)
        result.problems.append(f"summary: {error}")
        why = f"{error!r}. What was recorded is in {directory}"
        print_line(f"the run can't be judged: {why if directory.is_dir() else f'{directory} was removed or renamed'}")
        return False
    for line in (*violation_lines(summary), *summary_lines(summary, directory)):
        print_line(line)
    if unwritten:
        result.problems.append(f"run folder: {'; '.join(unwritten)}")
        print_line(unwritten_line(directory, unwritten))
    _complete_recording(config, directory, print_line, had_viewer=had_viewer)
    return bool(summary.get("violations"))


def _complete_recording(
    config: Config, directory: Path, print_line: Callable[[str], None], *, had_viewer: bool
) -> None:
    from swarmctl.telemetry.view.recordings import optimize_recording  # heavy

    if had_viewer and not (directory / RECORDING).exists():
        try:
            draw_recording(config, directory)
        except Exception as error:  # rerun's, the disk's, or of a folder that somebody has changed
            print_line(f"no {RECORDING}: the viewer has written none, and it can't be drawn: {error!r}")
            return
        print_line(f"{RECORDING}: drawn after the flight, because the viewer has recorded nothing")
    optimize_recording(directory)


def draw_recording(config: Config, directory: Path) -> None:
    """Write `telemetry.rrd` of a finished run from what its agents have recorded."""
    from swarmctl.telemetry.recording.run_files import load_run, read_plans  # heavy
    from swarmctl.telemetry.view.recordings import simulated_recording

    plans = {agent: read_plans(directory, agent) for agent in range(config.swarm.agents)}
    simulated_recording(directory, load_run(directory), viewed_flight(config), plans)


def unwritten_line(directory: Path, unwritten: Sequence[str], gone: Sequence[str] = ()) -> str:
    """Return the line that reports files the disk did not take, and those of them that were in memory only: `gone`."""
    named = "; ".join(dict.fromkeys((*gone, *unwritten)))
    files = ", ".join(line.partition(":")[0] for line in gone)
    advice = (
        f"What of {files} was not written is lost: make room, and fly again"
        if gone
        else f"Make room, then: swarmctl report {shlex.quote(str(directory))}"
    )
    return f"not everything could be written to {directory}: {named}. {advice}"


def rewrite_report(directory: Path) -> Path:
    """Write `report.html` of a run folder again and return its path.

    Raises:
        ConfigError: it is no run folder.
        StartError: the run is not over yet.
    """
    from swarmctl.telemetry.recording.run_files import read_summary, refuse_no_folder  # heavy
    from swarmctl.telemetry.recording.run_folder import report_run

    refuse_no_folder(directory)
    if read_summary(directory) is None:
        refuse_running(directory)
    return report_run(directory, load_recorded(directory).rules())


def write_figures(directory: Path, *, png: bool) -> Path:
    """Write every figure of a run folder as an SVG file, and as PNG too, and return the folder they are in.

    Raises:
        ConfigError: it is no folder of a finished run.
    """
    from swarmctl.telemetry.recording.run_folder import write_run_figures  # heavy

    return write_run_figures(directory, load_recorded(directory).rules(), png=png)


def compare(directories: Sequence[Path], output: Path | None) -> Path:
    """Write a page that sets run folders beside each other and return it; by default it is beside the last of them.

    Raises:
        ConfigError: one is no folder of a finished run.
    """
    from swarmctl.telemetry.recording.run_folder import compare_runs  # heavy

    runs = [(directory, load_recorded(directory).rules()) for directory in directories]
    names = "-against-".join(directory.resolve().name for directory in directories)
    if len(names.encode()) > _LONGEST_NAME:
        first, last = directories[0].resolve().name, directories[-1].resolve().name
        names = f"{first}-against-{len(directories) - 2}-and-{last}"
    return compare_runs(output or directories[-1].resolve().parent / f"{names}.html", runs)


def summary_lines(summary: Mapping[str, Any], directory: Path) -> tuple[str, ...]:
    """Return five lines: outcome, separation, timing, solver and bus, folder.

    One more says what a station has not seen, and one for each own controller how much it has flown.
    """
    violations = summary.get("violations") or []
    obstacles = _section(summary, "obstacles")
    timing, solver, comms = (_section(summary, name) for name in ("timing", "solver", "comms"))
    tick, solve, age = _section(timing, "tick_ms"), _section(timing, "solve_ms"), _section(comms, "path_age_ms")
    rejected = sum(_section(comms, "rejected").values())
    goals = _goals(_section(summary, "goals"))
    error = f"summed mean tracking error {_m(_section(summary, 'tracking').get('index_m'))}"
    outcome = f"{summary.get('outcome')}{_without(summary)}, {goals}{error} ({SUMMED_ERROR})"
    if len(violations) == 1:
        outcome += f"; 1 violation: {printable(violations[0])}"
    elif violations:
        outcome += f"; {len(violations)} violations, each with a line above"
    clearance = obstacles.get("min_clearance_m")
    return (
        outcome,
        _separation(summary)
        + (f", obstacles {_m(clearance)} (required {_m(obstacles.get('required_m'))})" if clearance is not None else "")
        + _corrected(summary),
        *_seen_late(summary),
        f"ticks {_count(timing, 'ticks')}, deadline misses {_count(timing, 'late_ticks')} from arming on"
        f"{_worst(summary)}, tick p50/p99/max {_ms(tick)} ms, solve p50/p99/max {_ms(solve)} ms",
        f"solver {_count(solver, 'name')}, failed {_count(solver, 'failed')}; "
        f"plan staleness p50/p99 {_ms(age, ('p50', 'p99'))} ms, {rejected} bus messages refused"
        + _refused_frames(comms)
        + _unresponsive(comms)
        + _reopened(comms)
        + _deadlocks(summary),
        *(
            f"{printable(own['name'])} flew {own['flown_ticks']} of {own['mission_ticks']} mission ticks"
            for own in summary.get("own_controllers") or ()
        ),
        f"run folder {directory}",
    )


def _without(summary: Mapping[str, Any]) -> str:
    """Return without whom the others have flown; "" where everybody has."""
    names = ", ".join(map(agent_name, summary.get("without") or ()))
    return f" without {names}" if names else ""


def _separation(summary: Mapping[str, Any]) -> str:
    found = _section(summary, "separation")
    if summary.get("agents") == 1:
        return "no other agent"
    return f"separation {_m(found.get('min_m'))} (required {_m(found.get('required_m'))})"


def _corrected(summary: Mapping[str, Any]) -> str:
    corrected = corrected_text(summary.get("clocks"))
    return f"; clocks corrected: {corrected}" if corrected else ""


def _worst(summary: Mapping[str, Any]) -> str:
    """Return which of several agents has missed most of its deadlines; "" where none were missed."""
    worst = _section(_section(summary, "timing"), "worst_agent")
    if not worst or summary.get("agents") == 1:
        return ""
    return f" (agent-{worst['id']}: {worst['late_ticks']} of {worst['due_ticks']} due)"


def _seen_late(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """Return one line that says from when on a station that began late has seen whom; none if it has seen all."""
    found = summary.get("seen_late") or ()
    shown = found[:_LATE_SHOWN]
    said = [f"agent {row['id']} from {_at(row['from_s'])} on, in {printable(row['phase'])}" for row in shown]
    said += [f"{len(found) - _LATE_SHOWN} more"] if len(found) > _LATE_SHOWN else []
    return (f"not seen from the start, and not judged before: {', '.join(said)}",) if said else ()


def _at(at_s: float | None) -> str:
    return "an unknown time" if at_s is None else f"{at_s:.1f} s"


def _goals(found: Mapping[str, Any]) -> str:
    """Return how many agents have reached their goals, and who has not; "" of a mission without goals."""
    if not found:
        return ""
    missed = [row for row in found["agents"] if row["reached_at_s"] is None]
    if not missed:
        last_s = max(row["reached_at_s"] for row in found["agents"])
        return f"{found['of']} of {found['of']} goals reached, the last after {last_s:.1f} s, "
    said = [f"agent {row['id']} {_far(row['left_m'])}" for row in missed[:_MISSED_SHOWN]]
    said += [f"{len(missed) - _MISSED_SHOWN} more are not there"] if len(missed) > _MISSED_SHOWN else []
    return f"only {found['reached']} of {found['of']} goals reached ({', '.join(said)}), "


def _far(left_m: float | None) -> str:
    return "never began" if left_m is None else f"is {left_m:.2f} m away"


def _refused_frames(comms: Mapping[str, Any]) -> str:
    count = sum(n for reason, n in _section(comms, "refused_frames").items() if reason not in HARMLESS)
    return f", {count} MAVLink frames refused" if count else ""


def _unresponsive(comms: Mapping[str, Any]) -> str:
    found = _section(comms, "unresponsive")
    return f"; agent-{found['agent']} unresponsive for {found['longest_s']:.1f} s" if found.get("count") else ""


def _reopened(comms: Mapping[str, Any]) -> str:
    """Return how often the session of a process was deaf, or seemed so, and was replaced."""
    count = comms.get("reopened")
    return f"; bus sessions opened again: {count}" if count else ""


def violation_lines(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """Return one line per violation when there are several; the summary's first line holds a single one."""
    violations = summary.get("violations") or []
    return tuple(f"violation: {printable(violation)}" for violation in violations) if len(violations) > 1 else ()


def _deadlocks(summary: Mapping[str, Any]) -> str:
    found = _section(summary, "deadlocks")
    return f"; {found['count']} deadlocks, {found['unresolved']} unresolved" if found.get("count") else ""


def _section(tree: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = tree.get(key)
    return value if isinstance(value, Mapping) else {}


def _count(tree: Mapping[str, Any], key: str) -> str:
    return str(tree.get(key, "-"))


def _m(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"


def _ms(values: Mapping[str, Any], keys: tuple[str, ...] = ("p50", "p99", "max")) -> str:
    return "/".join("-" if values.get(key) is None else f"{values[key]:.1f}" for key in keys)
