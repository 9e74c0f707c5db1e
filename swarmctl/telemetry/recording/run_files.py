"""Reads and writes the files of a run folder. A folder may come from another person, so its content is validated.

Formats: `agent-<i>.ticks`, `agent-<i>.plans`, `agent-<i>.received` and `truth.bin` are raw rows of `core.recorded`, as
they are written in flight; `agent-<i>.parquet`, `agent-<i>.plans.parquet`, `agent-<i>.received.parquet` and
`truth.parquet` are the same tables with vectors expanded to one column per component. A partial last row, left by a
killed process, is ignored. Anything but a regular file of bounded size and expected content is refused with a reason.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.core.recorded.received import RECEIVED_COLUMNS
from swarmctl.core.recorded.records import PLAN_COLUMNS, TICK_DTYPE, TRUTH_COLUMNS
from swarmctl.core.recorded.stored_column import StoredColumn, dtype_of
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.text import printable
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import is_held, read_file, replaced
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.evaluation.station_clock import by_newest_clock, is_of_station
from swarmctl.telemetry.evaluation.tracks import MAX_RUN_US
from swarmctl.telemetry.recording.file_names import (
    AGENT_FILE,
    CONFIG,
    EVENTS,
    MAX_EVENTS_BYTES,
    PACKED_PLANS,
    PACKED_RECEIVED,
    PACKED_TRUTH,
    SUMMARY,
    TRUTH,
    events_file,
    plans_file,
    received_file,
)
from swarmctl.telemetry.recording.summary_file import decode_summary
from swarmctl.telemetry.recording.tables import VERSION_KEY, plain_table

_MAX_ROWS_BYTES = 2**31  # a day of one agent, about the memory of a laptop
_MAX_TEXT_BYTES = 2**24
_MAX_EVENT_DEPTH = 8  # largest nesting of an event; written events nest twice
_INT64 = range(-(2**63), 2**63)


def load_run(directory: Path) -> RunData:
    """Return everything recorded in a run folder, whether the run was finished or not.

    Raises:
        ConfigError: the folder does not exist, or a file in it has not the expected content.
    """
    refuse_no_folder(directory)
    ticks: dict[int, NDArray[np.void]] = {}
    cut, events = set[int](), read_events(directory)
    for path in sorted(directory.iterdir(), key=lambda path: path.suffix):  # raw rows come last and replace Parquet
        match = AGENT_FILE.match(path.name)
        if match:
            rows = read_rows(path, TICK_DTYPE) if match[2] == "ticks" else read_parquet(path)
            agent, is_cut = int(match[1]), False
            if is_of_station(events):  # other computers may be started again, or their clocks set
                rows, is_cut = by_newest_clock(rows, MAX_RUN_US)
            ticks[agent] = _in_time(path, rows, ("t_us", "utc_us"))
            (cut.add if is_cut else cut.discard)(agent)
    return RunData(dict(sorted(ticks.items())), _read_truth(directory), events, frozenset(cut))


def _read_truth(directory: Path) -> NDArray[np.void]:
    """Return the true states of a run, (T * vehicles,) of `TRUTH_DTYPE`; none without a simulator."""
    return _read_raw_or_packed(directory / TRUTH, directory / PACKED_TRUTH, TRUTH_COLUMNS, clocks=("t_us",))


def read_plans(directory: Path, agent: int) -> NDArray[np.void]:
    """Return the points of an agent's predicted paths, (K,) of `PLAN_DTYPE`; none if it has recorded none.

    Raises:
        ConfigError: the file has not the expected content.
    """
    raw = directory / plans_file(agent)
    return _read_raw_or_packed(raw, raw.with_suffix(PACKED_PLANS), PLAN_COLUMNS, clocks=("t_us", "at_us"))


def read_received(directory: Path, agent: int) -> NDArray[np.void]:
    """Return what an agent's ticks have received, (K,) of `RECEIVED_DTYPE`; none where that was not recorded.

    Raises:
        ConfigError: the file has not the expected content.
    """
    raw = directory / received_file(agent)
    return _read_raw_or_packed(raw, raw.with_suffix(PACKED_RECEIVED), RECEIVED_COLUMNS, clocks=("t_us",))


def _read_raw_or_packed(
    raw: Path, packed: Path, columns: Sequence[StoredColumn], *, clocks: tuple[str, ...]
) -> NDArray[np.void]:
    """Return the raw rows that a flight writes, or, once these are gone, those that the finished run has packed."""
    if not os.path.lexists(raw) and os.path.lexists(packed):
        return _in_time(packed, read_parquet(packed, columns), clocks)
    return _in_time(raw, read_rows(raw, dtype_of(columns)), clocks)


def refuse_no_folder(directory: Path) -> None:
    """Check that a run folder exists.

    Raises:
        ConfigError: it does not.
    """
    if not directory.is_dir():
        there = "is a file. Give the run folder that it is in"
        none = "no such run folder. Give one that launch or simulate wrote"
        raise ConfigError(str(directory), [there if directory.exists() else none])


def refuse_recorded(directory: Path) -> None:
    """Check that nobody holds the folder of an unfinished run, or its files, which are packed and then removed.

    Raises:
        StartError: somebody does.
    """
    patterns = ("*.ticks", "*.plans", "*.received", events_file("*"), TRUTH)
    files = (path for pattern in patterns for path in sorted(directory.glob(pattern)))
    for path in (directory.resolve(), *files):
        if is_held(path):
            raise StartError(f"{path}: is still written: the run is not over. Wait until its agents have ended")


def read_rows(path: Path, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Return the whole rows of a raw file; none if the file does not exist."""
    data = _content(path, _MAX_ROWS_BYTES)
    return np.frombuffer(data, dtype, len(data) // dtype.itemsize)


def read_text(path: Path) -> str:
    """Return the text of a file of the folder; "" if it does not exist."""
    return _content(path, _MAX_TEXT_BYTES).decode("utf-8", errors="replace")


def read_summary(directory: Path) -> dict[str, Any] | None:
    """Return the summary of a finished run; None if there is none."""
    path = directory / SUMMARY
    content = _content(path, _MAX_TEXT_BYTES)
    if not content and not path.exists():
        return None
    try:
        return decode_summary(content)
    except ValueError as error:
        raise _damaged(path, f"is no summary: {error}. Remove it, and the run is judged again") from error


def refuse_other_swarm(directory: Path, summary: Mapping[str, Any], agents: int) -> None:
    """Check that a summary is of as many agents as the configuration beside it.

    Raises:
        ConfigError: it is not.
    """
    if summary["agents"] != agents:
        problem = f"of {summary['agents']} agents, but {CONFIG} is of {agents}. Remove it to have the run judged"
        raise _damaged(directory / SUMMARY, problem)


def read_events(directory: Path) -> list[dict[str, Any]]:
    """Return the events of all sources in a run folder, sorted by UTC, without duplicates and invalid lines."""
    lines: dict[bytes, None] = {}
    for path in sorted(directory.glob(f"*{EVENTS}")):
        lines.update(dict.fromkeys(_content(path, MAX_EVENTS_BYTES).splitlines()))
    rows = (_event(line) for line in lines)
    return sorted((row for row in rows if row is not None), key=utc_us_of)


def utc_us_of(row: Mapping[str, Any]) -> int:
    """Return the UTC of an event [us]; 0 if it has none."""
    utc_us = row.get("utc_us")
    return utc_us if isinstance(utc_us, int) else 0


def _event(line: bytes) -> dict[str, Any] | None:
    try:
        row = json.loads(line.decode("utf-8", errors="replace"))
    except (ValueError, RecursionError):
        return None
    is_event = isinstance(row, dict) and isinstance(row.get("source", ""), str)
    return _printable(row) if is_event and _is_sane(row) else None


def _printable(value: Any) -> Any:
    """Return a value of JSON with all its text printable, whoever has written the file."""
    if isinstance(value, str):
        return value if value.isprintable() else printable(value)
    if isinstance(value, list):
        return [_printable(item) for item in value]
    if isinstance(value, dict):
        return {_printable(key): _printable(item) for key, item in value.items()}
    return value


def _is_sane(row: dict[str, Any]) -> bool:
    """Return whether nesting and integers of an event are within the limits of the code that reads it."""
    level: list[Any] = [row]
    for _ in range(_MAX_EVENT_DEPTH):
        if any(isinstance(value, int) and value not in _INT64 for value in level):
            return False
        lists = [value for value in level if isinstance(value, list)]
        lists += [list(value.values()) for value in level if isinstance(value, dict)]
        level = [item for values in lists for item in values]
        if not level:
            return True
    return False


def _content(path: Path, most_bytes: int) -> bytes:
    try:
        return read_file(path, most_bytes)
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise _damaged(path, f"can't be read: {error.strerror}") from error


def _in_time(path: Path, rows: NDArray[np.void], clocks: tuple[str, ...]) -> NDArray[np.void]:
    """Return `rows` after a check that each clock spans no more than the longest run."""
    for clock in clocks:
        if len(rows) and int(rows[clock].max()) - int(rows[clock].min()) > MAX_RUN_US:
            why = f"{clock} spans more than {MAX_RUN_US / 3.6e9:.0f} hours"
            raise _damaged(path, f"damaged, or raw rows of another version (this is {__version__}): {why}")
    return rows


def _damaged(path: Path, problem: str) -> ConfigError:
    return ConfigError(str(path), [problem])


def write_parquet(path: Path, rows: NDArray[np.void], columns: Sequence[StoredColumn] = COLUMNS) -> None:
    """Write rows that `columns` describe as Parquet, one column for each component."""
    import pyarrow.parquet as pq  # imported here to keep it out of agent processes

    with replaced(path) as file:
        pq.write_table(plain_table(rows, columns), file, compression="zstd")


def read_parquet(path: Path, columns: Sequence[StoredColumn] = COLUMNS) -> NDArray[np.void]:
    """Read rows written by this or an older version; unknown columns are ignored, missing ones are NaN.

    Raises:
        ConfigError: the file is no Parquet, has too many rows, a column holds no numbers, or an integer column is
            missing for which its declaration states no number.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    most_rows = _MAX_ROWS_BYTES // dtype_of(columns).itemsize
    try:
        file = pq.ParquetFile(pa.BufferReader(_content(path, _MAX_ROWS_BYTES)))
        if file.metadata.num_rows > most_rows:
            raise _damaged(path, f"has {file.metadata.num_rows} rows, more than a day of one agent")
        return _stored_rows(file, columns)
    except (OSError, ValueError, pa.ArrowException) as error:  # a damaged file can raise any of these
        why = str(error).rstrip(".")  # some of Arrow's are sentences
        raise _damaged(path, f"is no recording of ours: {why}. Remove it to see the others") from error


def _stored_rows(file: Any, columns: Sequence[StoredColumn]) -> NDArray[np.void]:
    known = set(file.schema_arrow.names)
    stored = {column.name: _stored_parts(column, known) for column in columns}
    # Arrow's threads, once started, abort a process that ends soon after: "terminate called", exit code 134
    table = file.read(columns=[part for parts in stored.values() for part in parts], use_threads=False)
    rows = np.zeros(table.num_rows, dtype_of(columns))
    for column in columns:
        values = [table.column(part).to_numpy() for part in stored[column.name]]
        if any(value.dtype.kind not in "iufb" for value in values):
            raise ValueError(f"column {column.name} holds no numbers")
        if values:
            rows[column.name] = np.column_stack(values) if column.size else values[0]
        else:
            rows[column.name] = _absent(column, file)
    return rows


def _stored_parts(column: StoredColumn, known: set[str]) -> list[str]:
    """Return the Parquet columns of a value by its present or former name; empty if the file has neither."""
    former = [part.replace(column.name, column.formerly, 1) for part in column.parts]
    return next((parts for parts in (column.parts, former) if known.issuperset(parts)), [])


def _absent(column: StoredColumn, file: Any) -> float:
    """Return the number that stands for a value that was not recorded.

    Raises:
        ValueError: there is none.
    """
    if column.absent is not None:
        return column.absent
    if np.dtype(column.dtype).kind == "f":
        return math.nan
    by = (file.schema_arrow.metadata or {}).get(VERSION_KEY.encode(), b"an unknown version").decode(errors="replace")
    raise ValueError(f"column {column.name} is missing (written by swarmctl {by}, this is {__version__})")
