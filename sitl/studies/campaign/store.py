"""The folder of a campaign: `rows.parquet` with one row per finished run, replaced in one step as rows come in.

`RowStore` keeps the rows of any study of many flights; `Store` those of a campaign.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Generic, Self, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from sitl.studies.campaign.trials import SCHEMA, Row, Trial, is_flown, trial_of
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import hold, read_file, replaced
from swarmctl.telemetry.recording.file_names import STUDY_ROWS

_SAVE_EVERY_S = 1.0
_MAX_BYTES = 2**31
_Job = TypeVar("_Job")  # what is flown, and its result told from others by


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Tell in words what the disk refuses in this block.

    Raises:
        StartError: `path` can't be written.
    """
    try:
        yield
    except OSError as error:
        raise StartError(f"{path}: can't be written: {error.strerror or error}. Choose another with --out") from error


class RowStore(Generic[_Job]):
    """Rows of many flights; a context manager that has the folder to itself, and saves the rest when it ends.

    Args:
        directory: made when it is missing.
        code: digest of the present sources, a column of every row.
        mix: accept rows flown by other sources.
        schema: columns of the rows.
        job_of: the flight that a row is the result of.

    Raises:
        ConfigError: the folder holds something else, or rows of other sources.
        StartError: the folder, or later its file, can't be written.
    """

    advice: ClassVar[str] = "give a new --out"  # where rows are of other sources

    def __init__(
        self, directory: Path, code: str, mix: bool = False, *, schema: pa.Schema, job_of: Callable[[Row], _Job]
    ) -> None:
        self._path = directory / STUDY_ROWS
        self._schema, self._job_of = schema, job_of
        self.rows: list[Row] = []
        with writing(directory):
            directory.mkdir(parents=True, exist_ok=True)
        self._load()
        others = sorted({row["code"] for row in self.rows} - {code})
        if others and not mix:
            raise ConfigError(
                str(self._path),
                [f"flown by other sources ({', '.join(others)}; these are {code}): {self.advice}"],
            )
        self._saved_s, self._is_saved = time.monotonic(), True
        self._held = ExitStack()

    def __enter__(self) -> Self:
        """Keep other studies out of the folder, which would replace rows of this one by theirs alone.

        Raises:
            StartError: another one flies into it.
        """
        with writing(self._path.parent):
            fd = os.open(self._path.parent, os.O_RDONLY | os.O_CLOEXEC)
        self._held.callback(os.close, fd)
        if not hold(fd):
            self._held.close()
            told = f"{self._path.parent}: another sweep or campaign flies into it"
            raise StartError(f"{told}. Wait until it has ended, or choose another with --out")
        self._load()  # one that has just ended may have added some
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._held:
            self.save()

    def _load(self) -> None:
        if self._path.exists():
            self.rows = _read(self._path, self._schema.names)
        self._finished = {self._job_of(row) for row in self.rows if is_flown(row)}
        self._unflown = {self._job_of(row) for row in self.rows} - self._finished

    def missing(self, jobs: Iterable[_Job]) -> list[_Job]:
        """Return the flights not flown yet, in order, each once; one that an error ended is flown again."""
        return [job for job in dict.fromkeys(jobs) if job not in self._finished]

    def add(self, row: Row) -> None:
        """Add a row, in place of that of an error; it is on disk within a second, or with the next one."""
        job = self._job_of(row)
        if job in self._unflown:
            self.rows = [other for other in self.rows if self._job_of(other) != job]
            self._unflown.discard(job)
        self.rows.append(row)
        (self._finished if is_flown(row) else self._unflown).add(job)
        self._is_saved = False
        if time.monotonic() - self._saved_s >= _SAVE_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write all rows, if there are new ones."""
        self._saved_s = time.monotonic()
        if self._is_saved:
            return
        with writing(self._path), replaced(self._path) as file:
            pq.write_table(pa.Table.from_pylist(self.rows, self._schema), file)
        self._is_saved = True


class Store(RowStore[Trial]):
    """Rows of one campaign."""

    advice: ClassVar[str] = "give a new --out, or --mix to go on with both"

    def __init__(self, directory: Path, code: str, mix: bool = False) -> None:
        super().__init__(directory, code, mix, schema=SCHEMA, job_of=trial_of)


def _read(path: Path, names: Sequence[str]) -> list[Row]:
    try:
        table = pq.ParquetFile(pa.BufferReader(read_file(path, _MAX_BYTES))).read(use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise ConfigError(str(path), [f"can't be read ({error}); give another --out"]) from error
    if table.schema.names != names:
        raise ConfigError(str(path), ["has other columns than these sources write; give another --out"])
    rows: list[Row] = table.to_pylist()
    return rows
