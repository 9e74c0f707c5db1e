"""Rows of real processes: launches as a user starts them, and what is done to them from outside."""

from __future__ import annotations

import itertools
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil

import swarmctl
from swarmctl.errors import SwarmError
from tests.benches.launches import Launched
from tests.faults.row import Off, Played, Row, require

_GRID_US = 20_000


class Bounded(Launched):
    """A launch whose reaction is awaited for a bounded time."""

    within_s = math.inf  # of the row
    keeps_note = False  # for operators' verbs, which recognise a stale one

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.since_s = time.monotonic()
        self.reacted_s: float | None = None

    def event(self) -> None:
        """Begin the time of the reaction."""
        self.since_s = time.monotonic()

    def reacts(self, what: str, holds: Callable[[], bool]) -> None:
        """Wait for the reaction."""
        while not holds():
            require(time.monotonic() - self.since_s < self.within_s, f"not within {self.within_s:g} s: {what}")
            time.sleep(0.05)
        self.reacted_s = time.monotonic() - self.since_s

    def end(self, timeout_s: float = math.inf) -> int:
        """Return the exit code; the end is the reaction where none was awaited."""
        left_s = self.within_s if self.reacted_s is None else 150.0
        code = self.process.wait(min(timeout_s, max(1.0, self.since_s + left_s - time.monotonic())))
        require(self.left() == [], f"left: {self.left()}")
        if self.reacted_s is None:
            self.reacted_s = time.monotonic() - self.since_s
        return code

    def left(self) -> list[str]:
        """Return the processes, sockets and notes that are left."""
        return [path for path in self.leftovers() if not (self.keeps_note and path.endswith(".json"))]

    def said(self, words: str) -> bool:
        """Return whether it has printed these words."""
        return words in self.text()

    def verdict(self) -> str:
        """Return the line of the result."""
        lines = [line for line in self.text().splitlines() if "summed mean tracking error" in line]
        require(len(lines) == 1, f"no verdict was printed:\n{self.text()[-600:]}")
        return lines[0]


Start = Callable[..., Bounded]
Script = Callable[[Start], object]


@dataclass(frozen=True, kw_only=True)
class LaunchedRow(Row):
    """A row whose script starts launches, does something to them, and says what must come of it.

    In every one no process, socket or note is left, what was flown kept `apart_m` by true states, and run folders that
    were finished can be read.

    Attributes:
        script: gets what starts a launch, and may end it.
        readable: the run folder is finished and can be read.
    """

    script: Script
    readable: bool = True
    apart_m: float = 0.8
    off: Off

    def play(self, folder: Path, *, protected: bool = True) -> Played:
        folder.mkdir(parents=True)
        launches: list[Bounded] = []
        settings = () if protected else self.off.settings
        with self._preloaded(folder, protected), _starter(folder, launches, self.within_s, settings) as start:
            self.script(start)
            for launched in launches:
                launched.process.wait(30)
                require(launched.left() == [], f"left: {launched.left()}")
            apart_m = min((least_apart_m(launched.run_dir) for launched in launches), default=math.inf)
            require(apart_m >= self.apart_m, f"two vehicles came to {apart_m:.2f} m")
            if self.readable:
                for launched in launches:
                    _require_readable(launched.run_dir)
        reacted_s = max((launched.reacted_s or 0.0 for launched in launches), default=None)
        return Played(reacted_s=reacted_s, apart_m=apart_m if math.isfinite(apart_m) else None)

    @contextmanager
    def _preloaded(self, folder: Path, protected: bool) -> Iterator[None]:
        """Have every Python process run the code that switches the protection off."""
        if protected:
            yield
            return
        (folder / "sitecustomize.py").write_text(f"import sys\nwords = sys.orig_argv\n{self.off.preload}\n")
        path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH", ""))))
        with patch.dict(os.environ, PYTHONPATH=path), self.off.applied():
            yield


@contextmanager
def _starter(folder: Path, launches: list[Bounded], within_s: float, settings: tuple[str, ...]) -> Iterator[Start]:
    number = itertools.count()
    sets = [word for setting in settings for word in ("--set", setting)]

    def start(*arguments: str, kind: type[Bounded] = Bounded, run_dir: Path | None = None) -> Bounded:
        temp = Path(tempfile.mkdtemp(prefix="sw"))
        launched = kind(run_dir or folder / f"run{next(number)}", temp, *arguments, *sets)
        launched.within_s = within_s
        launches.append(launched)
        return launched

    try:
        yield start
    finally:
        for launched in launches:
            for relative in launched.relatives():
                with suppress(psutil.Error):
                    relative.kill()
            launched.process.kill()
            with suppress(subprocess.TimeoutExpired):
                launched.process.wait(20)
            shutil.rmtree(launched.temp, ignore_errors=True)


def least_apart_m(run_dir: Path) -> float:
    """Return the least distance of two armed vehicles by true states; infinite if none were recorded."""
    try:
        truth = swarmctl.load_run(run_dir).true_rows()
    except (SwarmError, OSError):
        return math.inf
    tracks = [truth[(truth["vehicle"] == vehicle) & (truth["armed"] != 0)] for vehicle in np.unique(truth["vehicle"])]
    return min((_apart_m(a, b) for a, b in itertools.combinations(tracks, 2) if len(a) and len(b)), default=math.inf)


def _apart_m(a: Any, b: Any) -> float:
    t_us = np.arange(max(a["t_us"][0], b["t_us"][0]), min(a["t_us"][-1], b["t_us"][-1]), _GRID_US)
    apart = [
        np.interp(t_us, a["t_us"], a["pos_ned_m"][:, k]) - np.interp(t_us, b["t_us"], b["pos_ned_m"][:, k])
        for k in range(3)
    ]
    return float(np.linalg.norm(apart, axis=0).min(initial=math.inf))


def _require_readable(run_dir: Path) -> None:
    try:
        run = swarmctl.load_run(run_dir)
    except (SwarmError, OSError) as error:
        require(False, f"the run folder can't be read: {error}")
    else:
        require(bool(run.agents), "the run folder holds no ticks")
        require(run.outcome in ("completed", "failed", "interrupted"), f"outcome {run.outcome}")
