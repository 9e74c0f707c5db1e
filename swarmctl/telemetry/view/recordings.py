"""Rerun recordings: packs a file, draws one offline from a finished run, opens one in the native viewer."""

from __future__ import annotations

import os
import subprocess
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.obstacle import Obstacle
from swarmctl.errors import StartError
from swarmctl.files import replaced_by_program
from swarmctl.telemetry.evaluation.referee import RunData

if TYPE_CHECKING:
    from swarmctl.telemetry.view.layout import SceneBounds  # rerun takes a second to import

RECORDING = "telemetry.rrd"
APPLICATION = "swarmctl"
_MIN_RECORDING_BYTES = 4096  # a smaller packed recording contains no entity and is rejected
_CHUNK_TICKS = 50  # ticks of an agent sent at once: one second
_VIEWER_PORT_OPTIONS = ("--bind", "127.0.0.1", "--port", "auto")  # the default port would loop data back to our server
_WINDOW_MEMORY = "2GB"  # the viewer's own default is 75 % of the machine


def viewer_binary() -> Path:
    """Return the path of the native viewer, not of the script of the same name, which forwards no signals."""
    import rerun_cli

    return Path(rerun_cli.__file__).parent / "rerun"


def has_display() -> bool:
    """Return whether a window can be opened."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_viewer(target: str, log: Path | None = None) -> subprocess.Popen[bytes]:
    """Open a live URL or a recording in the native viewer, which outlives this process.

    Args:
        target: `rerun+http://...` or the path of an `.rrd`.
        log: file for the viewer's output; None to discard it.

    Raises:
        StartError: there is no display or no such recording, or the viewer can't be started.
    """
    if not has_display():
        raise StartError(
            f"no display: neither DISPLAY nor WAYLAND_DISPLAY is set. On a machine with one: rerun --port auto {target}"
        )
    if "://" not in target and not Path(target).is_file():
        raise StartError(f"{target}: no such recording")
    command = [str(viewer_binary()), target, "--memory-limit", _WINDOW_MEMORY, *_VIEWER_PORT_OPTIONS]
    try:
        with (log or Path(os.devnull)).open("ab") as output:
            return subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )
    except OSError as error:
        raise StartError(f"the viewer can't be started: {error}") from error


def optimize_recording(directory: Path, timeout_s: float = 60.0) -> bool:
    """Pack `telemetry.rrd` of a run folder, which also adds the footer that a live file lacks.

    Returns:
        whether the file was replaced; on failure, or after `timeout_s`, the original stays.
    """
    source = directory / RECORDING
    if source.is_symlink() or not source.is_file():
        return False
    try:
        with replaced_by_program(source) as packed:
            return _packed(source, packed, timeout_s)
    except (OSError, subprocess.TimeoutExpired):
        return False


def _packed(source: Path, packed: Path, timeout_s: float) -> bool:
    """Write `packed` from `source`; returns whether it succeeded, else `packed` does not exist."""
    command = [str(viewer_binary()), "rrd", "optimize", str(source), "-o", str(packed)]
    until_s = time.monotonic() + timeout_s
    for more in ((), ("--continue-on-error",)):  # the second attempt is for a file whose writer was killed
        left_s = max(0.1, until_s - time.monotonic())
        done = subprocess.run(
            [*command, *more], stdin=subprocess.DEVNULL, capture_output=True, timeout=left_s, check=False
        )
        if done.returncode == 0 and packed.stat().st_size >= _MIN_RECORDING_BYTES:
            return True
        packed.unlink(missing_ok=True)
    return False


def simulated_recording(
    directory: Path,
    run: RunData,
    agents: int,
    separation_m: float,
    *,
    limit_m: float,
    obstacles: Sequence[Obstacle] = (),
) -> Path:
    """Write `telemetry.rrd` of a finished run from its recorded ticks, which contain no predicted paths.

    Args:
        directory: the run folder.
        run: the recorded run.
        agents: size of the swarm.
        separation_m: separation that agents keep.
        limit_m: distance below which the referee sees a violation.
        obstacles: of the configuration.
    """
    import rerun as rr

    from swarmctl.telemetry.view.scene import Scene

    path = directory / RECORDING
    rec = rr.RecordingStream(APPLICATION, recording_id=f"{directory.resolve().name}-{uuid.uuid4().hex[:8]}")
    rec.set_log_time_enabled(False)
    rec.set_sinks(rr.FileSink(path))
    flown = {agent: rows for agent, rows in run.ticks.items() if agent < agents and len(rows)}
    scene = Scene(rec, agents, separation_m, limit_m, bounds=_bounds(flown))
    scene.begin()
    epoch_us = min((int(rows["utc_us"][0]) for rows in flown.values()), default=0)
    scene.obstacles(obstacles, 0, 0.0)
    for first in range(0, max(map(len, flown.values()), default=0), _CHUNK_TICKS):
        for agent, rows in flown.items():
            chunk = rows[first : first + _CHUNK_TICKS]
            scene.ticks(agent, chunk["utc_us"] - epoch_us, chunk, None)
        if any(obstacle.moves for obstacle in obstacles):
            scene.obstacles(obstacles, first * 20_000, first * 0.02)
        scene.plots()
    rec.flush(timeout_sec=30)
    rec.disconnect()
    return path


def _bounds(flown: Mapping[int, NDArray[np.void]]) -> SceneBounds:
    """Return bounds that contain every flown position."""
    from swarmctl.telemetry.view.layout import SceneBounds

    pos_ned_m = np.concatenate([rows["pos_ned_m"] for rows in flown.values()]) if flown else np.zeros((1, 3))
    pos_ned_m = pos_ned_m[np.isfinite(pos_ned_m).all(axis=1)]
    if not len(pos_ned_m):
        return SceneBounds()
    low, high = pos_ned_m.min(axis=0), pos_ned_m.max(axis=0)
    north_m, east_m, down_m = ((low + high) / 2).tolist()
    return SceneBounds((north_m, east_m, down_m), float((high - low).max() / 2) + 1.0)
