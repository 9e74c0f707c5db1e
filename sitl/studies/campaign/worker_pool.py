"""Worker pool for trials: processes on this machine, or workers of a Dask cluster. Rows are returned as they finish.

Every process has one thread, because a flight is single-threaded and numpy's threads would compete.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, TypeVar

from sitl.studies.campaign.trials import Row, Trial
from swarmctl.errors import StartError
from swarmctl.process_lifetime import serve_parent

_Job = TypeVar("_Job")


def fly_trial(trial: Trial, own: str = "") -> Row:
    """Call `sitl.studies.campaign.flight.fly`, imported in the worker."""
    from sitl.studies.campaign.flight import fly

    return fly(trial, own)


def on_this_machine(
    trials: Sequence[_Job], jobs: int, fly: Callable[[_Job], Row]
) -> Generator[tuple[_Job, Row | str], None, None]:
    """Fly in `jobs` processes; yield each trial with its row, or with the error as text.

    Raises:
        StartError: a process ended by itself, from lack of memory or by a signal.
    """
    if jobs == 1:
        yield from ((trial, _flown(fly, trial)) for trial in trials)
        return
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), serve_parent)
    try:
        todo = iter(trials)
        flying: dict[Future[Row | str], _Job] = {}
        while True:
            for trial in todo:
                flying[pool.submit(_flown, fly, trial)] = trial
                if len(flying) >= 2 * jobs:
                    break
            if not flying:
                return
            done, _ = wait(flying, return_when=FIRST_COMPLETED)
            for future in done:
                yield flying.pop(future), _result(future)
    finally:
        processes = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:  # a running flight is not waited for: it is flown again
            process.terminate()


def on_cluster(
    trials: Sequence[_Job], address: str, fly: Callable[[_Job], Row]
) -> Generator[tuple[_Job, Row | str], None, None]:
    """Fly on the workers of the Dask scheduler at `HOST:PORT`.

    They need this package in the same version, and a thread each: `dask worker HOST:PORT --nthreads 1 --nworkers auto`.

    Raises:
        StartError: no client library, or no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise StartError("--dask: needs dask.distributed; in the checkout, pip install '.[campaign]'") from error
    url = address if "://" in address else f"tcp://{address}"
    try:
        client = Client(url, timeout="10s")
    except (OSError, TimeoutError) as error:
        raise StartError(f"--dask {address}: no scheduler answers ({error}); start one with: dask scheduler") from error
    with client:
        futures: dict[Any, _Job] = {client.submit(_flown, fly, trial, pure=False): trial for trial in trials}
        for future in as_completed(futures):
            yield futures[future], _result(future)


def _flown(fly: Callable[[_Job], Row], trial: _Job) -> Row | str:
    try:
        return fly(trial)
    except Exception as error:  # one broken trial must not end the campaign
        return f"{type(error).__name__}: {error}"


def _result(future: Any) -> Row | str:
    try:
        result: Row | str = future.result()
    except BrokenProcessPool as error:
        raise StartError("a process of the campaign ended by itself (out of memory?); rows so far are kept") from error
    return result
