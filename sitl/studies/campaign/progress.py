"""Puts flown rows into a store as they come in, and shows how far it is."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from typing import Any, TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sitl.studies.campaign.store import RowStore
from sitl.studies.campaign.trials import Row

_SAY_EVERY_S = 30.0  # interval of progress lines where there is no terminal
_Job = TypeVar("_Job")


def collect(
    flown: Generator[tuple[_Job, Row | str], None, None],
    total: int,
    store: RowStore[Any],
    *,
    noted: tuple[str, Callable[[Row], bool]],
    unflown: Callable[[_Job, str], Row],
) -> tuple[int, list[str]]:
    """Add every row to the store, those of errors too; return how many were flown, and what was not, in words.

    Args:
        flown: jobs with their rows or errors.
        total: number of jobs.
        store: of the rows.
        noted: what rows are counted on the way, in a word, and which.
        unflown: makes the row of a job that an error ended.
    """
    count, errors = 0, []
    with closing(flown):
        for job, result in _shown(flown, total, *noted):
            if isinstance(result, str):
                errors.append(f"{job}: {result}")
                store.add(unflown(job, result))
                continue
            count += 1
            store.add(result)
    return count, errors


def _shown(
    flown: Iterator[tuple[_Job, Row | str]], total: int, word: str, is_noted: Callable[[Row], bool]
) -> Iterator[tuple[_Job, Row | str]]:
    """Yield the same items with a progress bar on a terminal, and a line now and then elsewhere."""
    noted = done = 0
    began_s = said_s = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True, disable=not sys.stdout.isatty()) as bar:
        task = bar.add_task("flying", total=total)
        for job, result in flown:
            yield job, result
            done += 1
            noted += not isinstance(result, str) and is_noted(result)
            now_s = time.monotonic()
            hourly = 3600.0 * done / max(now_s - began_s, 1e-3)
            bar.update(task, advance=1, description=f"{noted} {word}, {hourly:.0f} runs/h")
            if bar.disable and now_s - said_s >= _SAY_EVERY_S:
                said_s = now_s
                print(f"{done}/{total} flown, {noted} {word}, {hourly:.0f} runs/h", flush=True)
