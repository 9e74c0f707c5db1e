"""Plays the fault matrix, or shows that each of its rows can fail.

python -m tests.faults                    every row, with its protection
python -m tests.faults --off              every row without it: each must fail
python -m tests.faults --only NAME,NAME   some of them; words of shell patterns
python -m tests.faults --plays 10         again and again
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from fnmatch import fnmatch
from pathlib import Path

import swarmctl  # noqa: F401  (before anything loads numpy)
from tests.faults.matrix import ROWS
from tests.faults.page import page
from tests.faults.row import Row, UnmetError

_MISFITS = ("unexpected keyword argument", "positional argument", "has no attribute")  # of what replaces a protection


def play(row: Row, folder: Path, *, off: bool) -> tuple[bool, str]:
    """Play a row; return whether that is as it should be, and what was seen."""
    try:
        played = row.play(folder, protected=not off)
    except UnmetError as unmet:
        return off, str(unmet)
    except Exception as error:  # without its protection anything may break; with it nothing
        seen = repr(error)
        return off and not any(words in seen for words in _MISFITS), seen
    return not off, f"{played}" if not off else f"HOLDS without {row.protection}: {played}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", help="names of rows, or patterns of them")
    parser.add_argument("--off", action="store_true", help="without the protection of each row, which then must fail")
    parser.add_argument("--plays", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="print the page of all rows")
    options = parser.parse_args()
    if options.page:
        print(page(), end="")
        return 0
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under `nohup` launches would ignore a closed terminal
    chosen = [row for row in ROWS.values() if any(fnmatch(row.name, word) for word in options.only.split(","))]
    failed = 0
    for number in range(options.plays):
        began_s, good = time.monotonic(), 0
        for row in chosen:
            row_s = time.monotonic()
            with tempfile.TemporaryDirectory(prefix="faults") as name:
                holds, seen = play(row, Path(name) / "run", off=options.off)
            good += holds
            print(f"{'ok  ' if holds else 'FAIL'} {row.name:28} {time.monotonic() - row_s:5.1f} s  {seen}", flush=True)
        failed += len(chosen) - good
        took_s = time.monotonic() - began_s
        print(f"play {number + 1}: {good} of {len(chosen)} rows as they should be, {took_s:.0f} s", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
