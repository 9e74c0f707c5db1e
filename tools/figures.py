"""Flies the default mission several times, in real time and in lockstep, and prints medians of the quoted figures.

    python tools/figures.py [--repeats 3] [--agents 3]

Timing is judged in real time, control in lockstep; run it on an otherwise idle machine and quote its output.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

FIGURES: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("summed mean tracking error, whole mission [m]", ("tracking", "index_m"), ".3f"),
    ("summed mean tracking error after 10 s [m]", ("tracking", "index_after_10s_m"), ".3f"),
    ("separation, smallest [m]", ("separation", "min_m"), ".3f"),
    ("solver failed [ticks]", ("solver", "failed"), ".0f"),
    ("not certified [ticks]", ("solver", "not_certified"), ".0f"),
    ("tick p50 [ms]", ("timing", "tick_ms", "p50"), ".2f"),
    ("tick p99 [ms]", ("timing", "tick_ms", "p99"), ".2f"),
    ("deadline misses [%]", ("timing", "missed_percent"), ".2f"),
    ("plan staleness p50 [ms]", ("comms", "path_age_ms", "p50"), ".1f"),
    ("plan staleness p99 [ms]", ("comms", "path_age_ms", "p99"), ".1f"),
    ("speed [x real time]", ("timing", "speed_factor"), ".2f"),
)


def fly(verb: str, agents: int, directory: Path) -> dict[str, Any]:
    """Fly once; return its summary, with the share of late ticks added."""
    command = [
        sys.executable,
        "-m",
        "swarmctl",
        verb,
        "--agents",
        str(agents),
        "--no-view",
        "--run-dir",
        str(directory),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    print(f"{verb}: exit {done.returncode}", file=sys.stderr)
    summary: dict[str, Any] = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    timing = summary["timing"]
    timing["missed_percent"] = 100.0 * timing["late_ticks"] / max(1, timing["ticks"])
    return summary


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--agents", type=int, default=3)
    options = parser.parse_args()
    flown: dict[str, list[dict[str, Any]]] = {"launch": [], "simulate": []}
    with tempfile.TemporaryDirectory(prefix="figures-") as folder:
        for verb, summaries in flown.items():
            for k in range(options.repeats):
                summaries.append(fly(verb, options.agents, Path(folder) / f"{verb}-{k}"))
    print(f"{'':32}{'launch':>26}{'simulate':>26}")
    for name, path, style in FIGURES:
        print(f"{name:32}" + "".join(f"{cell(flown[verb], path, style):>26}" for verb in flown))
    return 0


def cell(summaries: list[dict[str, Any]], path: tuple[str, ...], style: str) -> str:
    """Return median and range over the repeats."""
    values = []
    for summary in summaries:
        value: Any = summary
        for key in path:
            value = value[key]
        if value is not None:
            values.append(float(value))
    if not values:
        return "-"
    return f"{statistics.median(values):{style}} ({min(values):{style}}..{max(values):{style}})"


if __name__ == "__main__":
    sys.exit(main())
