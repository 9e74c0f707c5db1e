"""The folder of one run: made before the flight, read back after it, finished by the launcher.

Formats: `agent-<i>.ticks` and `truth.bin` are raw rows of `core.records`; `agent-<i>.parquet` is the same table with
vectors expanded to one column per component. Half rows at the end, of a killed process, are ignored.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.records import TICK_DTYPE, TRUTH_DTYPE
from swarmctl.errors import ConfigError, StartError
from swarmctl.telemetry.atomic import write_text
from swarmctl.telemetry.plain import to_json
from swarmctl.telemetry.referee import Rules, RunData, judge
from swarmctl.telemetry.report import write_report

EVENTS = "events.jsonl"
SUMMARY = "summary.json"
TRUTH = "truth.bin"
CONFIG = "config.toml"
RECORDING = "telemetry.rrd"

_AGENT_FILE = re.compile(r"^agent-(\d+)\.(ticks|parquet)$")
_LAUNCHES_PER_SECOND = 1000
_AXES = {3: ("x", "y", "z"), 4: ("w", "x", "y", "z")}


def create_run_folder(base: Path | None, name: str, utc_us: int) -> Path:
    """A fresh folder for one run.

    Args:
        base: the folder itself; None for `runs/<UTC>-<name>`, with a number behind it when that second has one.
        name: of the configuration.
        utc_us: start of the run [us since 1970].

    Raises:
        ConfigError: `base` holds a run already.
        StartError: the folder can't be made.
    """
    try:
        if base is not None:
            return _claim(base)
        stamp = datetime.fromtimestamp(utc_us / 1e6, UTC).strftime("%Y%m%dT%H%M%SZ")
        Path("runs").mkdir(exist_ok=True)
        for attempt in range(1, _LAUNCHES_PER_SECOND):
            path = Path("runs") / (f"{stamp}-{name}" if attempt == 1 else f"{stamp}-{name}-{attempt}")
            with contextlib.suppress(FileExistsError):
                path.mkdir(exist_ok=False)
                return path
    except OSError as error:
        raise StartError(f"run folder can't be made: {error}. Choose another with --run-dir") from error
    raise StartError(f"runs/{stamp}-{name}: {_LAUNCHES_PER_SECOND} launches in one second")


def _claim(base: Path) -> Path:
    base.mkdir(parents=True, exist_ok=True)
    taken = sorted(
        path.name
        for path in base.iterdir()
        if path.name in (EVENTS, SUMMARY, TRUTH, RECORDING) or _AGENT_FILE.match(path.name)
    )
    if taken:
        raise ConfigError(f"--run-dir {base}", [f"holds a run already ({taken[0]}). Choose a new folder or empty it"])
    return base


def load_run(directory: Path) -> RunData:
    """Everything recorded in a run folder, whether finished or not.

    Raises:
        ConfigError: there is no such folder.
    """
    if not directory.is_dir():
        raise ConfigError(str(directory), ["no such run folder. Give one that launch or simulate wrote"])
    ticks: dict[int, NDArray[np.void]] = {}
    for path in sorted(directory.iterdir(), key=lambda path: path.suffix):  # raw rows win over their Parquet
        match = _AGENT_FILE.match(path.name)
        if match:
            ticks[int(match[1])] = read_rows(path, TICK_DTYPE) if match[2] == "ticks" else read_parquet(path)
    return RunData(
        ticks=dict(sorted(ticks.items())),
        truth=read_rows(directory / TRUTH, TRUTH_DTYPE),
        events=read_events(directory),
    )


def read_rows(path: Path, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Whole rows of a raw file; empty when there is none."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return np.zeros(0, dtype)
    return np.frombuffer(data, dtype, len(data) // dtype.itemsize)


def read_events(directory: Path) -> list[dict[str, Any]]:
    """Events of every source in a run folder, sorted by UTC, each once; lines that aren't JSON objects are skipped."""
    lines: dict[str, None] = {}
    for path in sorted(directory.glob(f"*{EVENTS}")):
        lines.update(dict.fromkeys(path.read_text(encoding="utf-8", errors="replace").splitlines()))
    rows: list[dict[str, Any]] = []
    for line in lines:
        with contextlib.suppress(json.JSONDecodeError):
            row = json.loads(line)
            if isinstance(row, dict):
                rows.append(row)
    return sorted(rows, key=_utc_us)


def _utc_us(row: Mapping[str, Any]) -> int:
    utc_us = row.get("utc_us")
    return utc_us if isinstance(utc_us, int) else 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """How the launcher, or lockstep, saw the run end."""

    outcome: str  # "completed" | "failed" | "interrupted"
    problems: tuple[str, ...] = ()  # what went wrong, in words; each becomes a violation
    speed_factor: float | None = None  # simulated seconds per wall second
    events: Sequence[Mapping[str, Any]] = field(default=())  # the launcher's own rows


def finish_run(directory: Path, rules: Rules, outcome: Outcome) -> dict[str, Any]:
    """Close a run folder: one event file, judgement, Parquet, report. May be repeated.

    Returns: the summary, as written to `summary.json`. Events and summary come first: a disk that fills up during
    the rest costs the Parquet (raw rows stay) or the report, never the judgement.
    """
    _merge_events(directory, outcome.events)
    run = load_run(directory)
    summary = judge(run, rules, outcome.outcome, outcome.problems, outcome.speed_factor)
    write_text(directory / SUMMARY, to_json(summary, indent=2) + "\n")
    for path in sorted(directory.glob("agent-*.ticks")):
        with contextlib.suppress(OSError):
            write_parquet(path.with_suffix(".parquet"), read_rows(path, TICK_DTYPE))
            path.unlink()
    with contextlib.suppress(OSError):
        write_report(directory, run, summary, _config_text(directory), rules)
    return summary


def report_run(directory: Path, rules: Rules) -> Path:
    """Write `report.html` again from what is in the folder; a run that never finished is finished first, as failed."""
    summary_file = directory / SUMMARY
    if not summary_file.exists():
        load_run(directory)  # refuses what isn't a folder
        finish_run(directory, rules, Outcome("failed", ("the launcher did not finish this run",)))
    summary = json.loads(summary_file.read_text(encoding="utf-8"))
    return write_report(directory, load_run(directory), summary, _config_text(directory), rules)


def _config_text(directory: Path) -> str:
    config = directory / CONFIG
    return config.read_text(encoding="utf-8") if config.exists() else ""


def _merge_events(directory: Path, own: Sequence[Mapping[str, Any]]) -> None:
    rows = sorted([*read_events(directory), *own], key=_utc_us)
    lines = dict.fromkeys(to_json(row) for row in rows)
    write_text(directory / EVENTS, "".join(f"{line}\n" for line in lines))
    for path in directory.glob(f"*.{EVENTS}"):
        path.unlink()


def write_parquet(path: Path, rows: NDArray[np.void]) -> None:
    """Structured rows as Parquet; `pos_ned_m` becomes `pos_ned_m_x`, `_y`, `_z`, quaternions `_w` to `_z`."""
    import pyarrow as pa  # an agent process must not pay for it
    import pyarrow.parquet as pq

    columns: dict[str, Any] = {}
    for name in rows.dtype.names or ():
        shape = rows.dtype[name].shape
        if shape:
            for k, axis in enumerate(_AXES[shape[0]]):
                columns[f"{name}_{axis}"] = pa.array(np.ascontiguousarray(rows[name][:, k]))
        else:
            columns[name] = pa.array(np.ascontiguousarray(rows[name]))
    part = path.with_name(path.name + ".part")
    pq.write_table(pa.table(columns), part, compression="zstd")
    part.replace(path)


def read_parquet(path: Path) -> NDArray[np.void]:
    """Inverse of `write_parquet` for ticks; columns this version doesn't know are ignored, missing ones are zero."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    known = set(table.column_names)
    rows = np.zeros(table.num_rows, TICK_DTYPE)
    for name in TICK_DTYPE.names or ():
        shape = TICK_DTYPE[name].shape
        if shape:
            for k, axis in enumerate(_AXES[shape[0]]):
                if f"{name}_{axis}" in known:
                    rows[name][:, k] = table.column(f"{name}_{axis}").to_numpy()
        elif name in known:
            rows[name] = table.column(name).to_numpy()
    return rows
