"""Compares the processor time of ticks with that of an older commit, both measured in turns in one run.

`python tools/tick_ratio.py [--base COMMIT] [--limit 1.15]`. Two processes fly the same lockstep flights, one with the
code of this checkout, the other with that of the commit, and take turns of a fifth of a second of flight. Their ratio
is the median over all turns, so that a busy machine or a change of its frequency hits both. Simulator and bus are
counted with the agents. Exit code 1: a flight costs more than the limit times as much. The commit is that of
`tools/tick_baseline`; whoever accepts a higher cost writes another one there.
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import quantiles

ROOT = Path(__file__).parents[1]
BASELINE = Path(__file__).parent / "tick_baseline"
TURNS = 150
LIMIT = 1.15  # times the older cost
STEPS = 10  # of a turn, a fifth of a second: load that others cause lasts longer, and hits both
UNDER_WAY_STEPS = 400  # before the first turn: all agents are on the circle
ENDLESS = "mission.duration_s=3600"
FLIGHTS = {
    "best effort": ("sitl.start=air", ENDLESS),
    "guaranteed": ("sitl.start=air", ENDLESS, "separation.mode=guaranteed"),
}


def fly(sets: tuple[str, ...]) -> None:
    """Fly a turn for each line of standard input, and print the processor time [s] of each."""
    from sitl.lockstep import Lockstep
    from swarmctl.config import load

    flight = Lockstep(load(None, sets))
    for _ in range(UNDER_WAY_STEPS):
        flight.step()
    gc.collect()
    gc.freeze()
    print("ready", flush=True)
    for _ in sys.stdin:
        began_s = time.process_time()
        for _ in range(STEPS):
            flight.step()
        print(time.process_time() - began_s, flush=True)


class Flight:
    """A process that flies with the code in a folder, a turn at a time."""

    def __init__(self, code: Path, sets: tuple[str, ...]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--fly", *sets],
            env={**os.environ, "PYTHONPATH": str(code)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def get_under_way(self) -> None:
        """Wait until the first turn can be flown."""
        self._answer()

    def turn_s(self) -> float:
        """Fly a turn and return its processor time."""
        assert self._process.stdin is not None
        self._process.stdin.write("turn\n")
        self._process.stdin.flush()
        return float(self._answer())

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        if answer := self._process.stdout.readline():
            return answer
        raise SystemExit(f"the flight has ended with exit code {self._process.wait()}")


def ratios(new: Path, old: Path, sets: tuple[str, ...], turns: int) -> list[float]:
    """Return the processor time of each turn with the code in `new` over that with the code in `old`."""
    flights: list[Flight] = []
    try:
        flights += [Flight(new, sets)]
        flights += [Flight(old, sets)]
        for flight in flights:
            flight.get_under_way()
        found = []
        for turn in range(turns):
            first, second = flights if turn % 2 else flights[::-1]  # neither profits from what is warm
            times_s = {first: first.turn_s(), second: second.turn_s()}
            found.append(times_s[flights[0]] / times_s[flights[1]])
        return found
    finally:
        for flight in flights:
            flight.close()


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Yield a folder with the files of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "-C", str(ROOT), "archive", commit], capture_output=True, check=True)
        subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
        yield Path(folder)


def main() -> int:
    """Compare each flight and print a line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", metavar="COMMIT", default=BASELINE.read_text().strip())
    parser.add_argument("--limit", metavar="RATIO", type=float, default=LIMIT)
    parser.add_argument("--turns", metavar="N", type=int, default=TURNS)
    parser.add_argument("--fly", metavar="SET", nargs="+", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.fly:
        fly(tuple(asked.fly))
        return 0
    slower = False
    with checked_out(asked.base) as old:
        for name, sets in FLIGHTS.items():
            low, median, high = quantiles(ratios(ROOT, old, sets, asked.turns), n=4)
            print(f"{name}: {median:.3f} times {asked.base[:9]} (quartiles {low:.3f} to {high:.3f})", flush=True)
            slower |= median > asked.limit
    return int(slower)


if __name__ == "__main__":
    sys.exit(main())
