"""Judges a run and closes its folder after the flight, reports it again, and compares it with others."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from swarmctl.core.json_safe import to_json
from swarmctl.core.recorded.received import RECEIVED_COLUMNS
from swarmctl.core.recorded.records import PLAN_COLUMNS, TRUTH_COLUMNS
from swarmctl.core.recorded.stored_column import StoredColumn, dtype_of
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import replace_text, write_each
from swarmctl.telemetry.evaluation.referee import Rules, RunData, evaluate, flown_without
from swarmctl.telemetry.evaluation.tracks import flight_rows
from swarmctl.telemetry.recording.file_names import (
    CONFIG,
    EVENTS,
    OUTCOME,
    PACKED_PLANS,
    PACKED_RECEIVED,
    PACKED_TICKS,
    PACKED_TRUTH,
    STUDY_ROWS,
    SUMMARY,
    TRUTH,
    events_file,
)
from swarmctl.telemetry.recording.kept_outcome import KeptOutcome, keep_outcome, kept_outcome
from swarmctl.telemetry.recording.obstacle_lists import recorded_obstacles
from swarmctl.telemetry.recording.run_files import (
    load_run,
    read_rows,
    read_summary,
    read_text,
    refuse_other_swarm,
    refuse_recorded,
    utc_us_of,
    write_parquet,
)
from swarmctl.telemetry.report.comparison import JudgedRun, write_comparison
from swarmctl.telemetry.report.run_report import FIGURES, REPORT, write_figures, write_report

_NO_RUN = (
    f"holds no run, only a {CONFIG}. A sweep that was cut off before its first flight had ended leaves no more: "
    "it has nothing to report, and the same call of it goes on"
)

_RAW_ROWS = (  # files of raw rows, the suffixes that they have as Parquet, and their columns
    ("agent-*.ticks", PACKED_TICKS, COLUMNS),
    ("agent-*.plans", PACKED_PLANS, PLAN_COLUMNS),
    ("agent-*.received", PACKED_RECEIVED, RECEIVED_COLUMNS),
    (TRUTH, Path(PACKED_TRUTH).suffix, TRUTH_COLUMNS),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """End of a run as seen by the launcher or by lockstep."""

    outcome: str  # "completed" | "failed" | "interrupted"
    problems: tuple[str, ...] = ()  # problems in words; each becomes a violation
    speed_factor: float | None = None  # simulated seconds per wall second
    events: Sequence[Mapping[str, Any]] = field(default=())  # events of the launcher itself


class Finished(NamedTuple):
    """A judged run, and the files that could not be written."""

    summary: dict[str, Any]
    unwritten: tuple[str, ...]  # "summary.json: No space left on device", ...


def finish_run(directory: Path, rules: Rules, outcome: Outcome, recorded: RunData | None = None) -> Finished:
    """Judge a run and close its folder: summary, one event file, Parquet, report. May be repeated.

    The run is judged before anything is written, so that a full disk costs files but never the result.

    Args:
        directory: the run folder.
        rules: limits; obstacles that an operator has set count as recorded.
        outcome: how the run ended.
        recorded: the recorded run if it is still in memory; None to load it from the folder.

    Raises:
        ConfigError: a file in the folder can't be read.
    """
    run = load_run(directory) if recorded is None else recorded
    run.events[:] = _merged(run.events, outcome.events)
    rules = _with_obstacles(rules, run)
    summary = evaluate(run, rules, outcome.outcome, outcome.problems, speed_factor=outcome.speed_factor)
    writers: dict[str, Callable[[], object]] = {
        EVENTS: partial(_write_events, directory, run.events),
        SUMMARY: partial(replace_text, directory / SUMMARY, to_json(summary, indent=2) + "\n"),
        **{
            path.name: partial(_pack, path, suffix, columns)
            for raw, suffix, columns in _RAW_ROWS
            for path in sorted(directory.glob(raw))
        },
        REPORT: lambda: write_report(directory, run, summary, read_text(directory / CONFIG), rules=rules),
    }
    unwritten = write_each(writers)
    kept = KeptOutcome(
        outcome=outcome.outcome,
        problems=list(outcome.problems),
        speed_factor=outcome.speed_factor,
        mode=rules.mode,
    )
    keep_outcome(directory, kept)  # for what was not written, or is damaged or removed later
    return Finished(summary, unwritten)


def report_run(directory: Path, rules: Rules) -> Path:
    """Write `report.html` again; a run that was never finished is finished first, as failed where its end is not known.

    Raises:
        ConfigError: a file in the folder has not the expected content.
        StartError: the folder can't be written to, or the run is not finished and somebody still records it.
    """
    if (directory / STUDY_ROWS).exists():
        raise ConfigError(str(directory), [f"holds a campaign or a sweep, whose page is {REPORT}, and no run"])
    if read_summary(directory) is None:
        refuse_recorded(directory)
        run = load_run(directory)
        if not (run.ticks or run.events or len(run.truth) or (directory / OUTCOME).exists()):
            raise ConfigError(str(directory), [_NO_RUN])
        kept = kept_outcome(directory)
        problems = dict.fromkeys((*kept.problems, *_cut_off(run, kept.outcome)))
        ended = Outcome(outcome=kept.outcome, problems=tuple(problems), speed_factor=kept.speed_factor)
        finished = finish_run(directory, replace(rules, mode=kept.mode), ended, run)
        if finished.unwritten:
            raise StartError(f"{directory}: can't be written: {'; '.join(finished.unwritten)}")
        return directory / REPORT
    judged = read_judged(directory, rules)
    try:
        return write_report(directory, judged.run, judged.summary, judged.config_text, rules=judged.rules)
    except OSError as error:
        raise StartError(f"{directory / REPORT}: can't be written: {error.strerror or error}") from error


def _cut_off(run: RunData, outcome: str) -> Iterator[str]:
    """Yield whose ticks end in flight, or before it, although the run was completed: the disk was full from then on."""
    without = flown_without(run.events)
    for agent, rows in run.ticks.items() if outcome == "completed" else ():
        if not len(rows) or agent in without:
            continue
        if len(flight_rows(rows[-1:])) or rows["phase"][-1] < Phase.ARM:
            phase = Phase(int(rows["phase"][-1])).name
            yield f"the recording of agent {agent} ends in {phase}: the rest of its flight can't be judged"


def refuse_as_output(output: Path, directory: Path, suffix: str) -> None:
    """Refuse to write over what a run has recorded: an existing file of its folder without the output's own suffix.

    Raises:
        ConfigError: it is one.
    """
    inside = directory.resolve() in output.resolve().parents
    if inside and output.exists() and output.suffix != suffix:
        raise ConfigError("--output", [f"{output}: is a file of the run; choose one that ends with {suffix}"])


def write_run_figures(directory: Path, rules: Rules, *, png: bool = False) -> Path:
    """Write every figure of a finished run as an SVG file, and as PNG too; returns their folder.

    Raises:
        ConfigError: the run is not finished, or a file in the folder has not the expected content.
        StartError: the folder can't be written to, or PNG needs a library that is not installed.
    """
    judged = read_judged(directory, rules)
    if (directory / FIGURES).is_symlink():
        raise ConfigError(str(directory / FIGURES), ["is a symbolic link. Remove it"])
    try:
        return write_figures(directory, judged.run, judged.summary, rules=judged.rules, png=png)
    except OSError as error:
        raise StartError(f"{directory / FIGURES}: can't be written: {error.strerror or error}") from error


def compare_runs(path: Path, runs: Sequence[tuple[Path, Rules]]) -> Path:
    """Write a page that sets finished runs beside each other to `path`, and return it.

    Raises:
        ConfigError: a run is not finished, a file of it has not the expected content, or the page would replace one.
        StartError: the page can't be written.
    """
    for directory, _ in runs:
        refuse_as_output(path, directory, ".html")
    judged = [read_judged(directory, rules) for directory, rules in runs]
    names = [run.name for run in judged]
    judged = [
        run._replace(name=f"{directory.resolve().parent.name}/{run.name}") if names.count(run.name) > 1 else run
        for run, (directory, _) in zip(judged, runs, strict=True)
    ]
    try:
        return write_comparison(path, judged)
    except OSError as error:
        raise StartError(f"{path}: can't be written: {error.strerror or error}") from error


def read_judged(directory: Path, rules: Rules) -> JudgedRun:
    """Return a finished run with its summary, and the rules with the obstacles that there were.

    Raises:
        ConfigError: it is not finished, or a file in the folder has not the expected content.
    """
    summary = read_summary(directory)
    if summary is None:
        raise ConfigError(
            str(directory), [f"holds no {SUMMARY}. Complete the run: swarmctl report {shlex.quote(str(directory))}"]
        )
    refuse_other_swarm(directory, summary, rules.agents)
    run, config_text = load_run(directory), read_text(directory / CONFIG)
    return JudgedRun(directory.resolve().name, run, summary, _with_obstacles(rules, run), config_text)


def _with_obstacles(rules: Rules, run: RunData) -> Rules:
    return replace(rules, obstacles=recorded_obstacles(rules.obstacles, run.events))


def _merged(*sources: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of all sources in order of time, without duplicates."""
    rows = sorted((dict(row) for source in sources for row in source), key=utc_us_of)
    return list({to_json(row): row for row in rows}.values())


def _write_events(directory: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    replace_text(directory / EVENTS, "".join(f"{to_json(row)}\n" for row in rows))
    for path in directory.glob(events_file("*")):
        path.unlink()


def _pack(path: Path, suffix: str, columns: Sequence[StoredColumn]) -> None:
    """Replace a file of raw rows by Parquet."""
    write_parquet(path.with_suffix(suffix), read_rows(path, dtype_of(columns)), columns)
    path.unlink()
