"""Flies a launch for a long time, and says whether any process grows or any agent becomes slower.

    python tools/soak.py --minutes 60 --agents 3 --out runs/soak

The resident memory of every process is taken every ten seconds; its growth is that from the end of the first tenth of
the mission to its end. The 99th percentile of the tick time is shown for each tenth.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil

from swarmctl.core.types import Phase
from swarmctl.telemetry.recording.file_names import AGENT_FILE
from swarmctl.telemetry.recording.run_files import read_parquet

_SAMPLE_S = 10.0
_PARTS = 10
_NAMES = {"swarmctl.bus.network.router": "router", "sitl": "sitl", "swarmctl.telemetry.view.viewer": "viewer"}


def name_of(process: psutil.Process) -> str:
    """Return what a process of the launch is called."""
    words = process.cmdline()
    if "agent" in words:
        return f"agent-{words[words.index('--id') + 1]}"
    return next((name for module, name in _NAMES.items() if module in words), "launch")


def resident_bytes(launch: psutil.Process) -> dict[str, int]:
    """Return the resident memory of the launch and of its processes, by name."""
    found = {}
    for process in (launch, *launch.children(recursive=True)):
        try:
            found[name_of(process)] = process.memory_info().rss
        except psutil.Error:
            continue  # it has just ended
    return found


def growth(samples: list[tuple[float, dict[str, int]]]) -> dict[str, dict[str, float]]:
    """Return resident megabytes after the first tenth of the samples, at their end, and the growth; {} without any."""
    if not samples:
        return {}
    settled, last = samples[len(samples) // _PARTS][1], samples[-1][1]
    return {
        name: {
            "settled_mb": round(settled[name] / 1e6, 2),
            "end_mb": round(last[name] / 1e6, 2),
            "growth_percent": round(100.0 * (last[name] / settled[name] - 1.0), 2),
        }
        for name in settled
        if name in last
    }


def tick_p99_ms(directory: Path) -> dict[str, list[float]]:
    """Return the 99th percentile of the tick time of each agent in each tenth of the mission."""
    found = {}
    paths = {int(match[1]): path for path in directory.iterdir() if (match := AGENT_FILE.match(path.name))}
    for _, path in sorted(paths.items()):
        rows = read_parquet(path)
        tick_ms = rows["tick_ms"][rows["phase"] == Phase.TRACK]
        found[path.stem] = [round(float(np.percentile(part, 99)), 2) for part in np.array_split(tick_ms, _PARTS)]
    return found


def main() -> None:
    """Fly, sample, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the mission")
    parser.add_argument("--agents", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True, help="run folder to create")
    options = parser.parse_args()
    line = [sys.executable, "-m", "swarmctl", "launch", "--agents", str(options.agents), "--no-view"]
    line += ["--duration", str(60.0 * options.minutes), "--run-dir", str(options.out)]
    launch = subprocess.Popen(line, stdout=subprocess.DEVNULL)
    process, samples, began_s = psutil.Process(launch.pid), [], time.monotonic()
    while launch.poll() is None:
        time.sleep(_SAMPLE_S)
        since_s = time.monotonic() - began_s
        if _SAMPLE_S * 4 < since_s < 60.0 * options.minutes and launch.poll() is None:
            samples.append((since_s, resident_bytes(process)))
    result = {"exit_code": launch.returncode, "memory": growth(samples), "tick_p99_ms": tick_p99_ms(options.out)}
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
