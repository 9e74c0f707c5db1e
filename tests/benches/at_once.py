"""Runs beside each other what would mostly wait."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor


def at_once(jobs: Sequence[Callable[[], object]]) -> None:
    """Run every job to its end, then fail as the first that failed."""
    with ThreadPoolExecutor(len(jobs)) as pool:
        begun = [pool.submit(job) for job in jobs]
    for job in begun:
        job.result()
