"""Rerun recordings: packs a file, draws one offline from a finished run, opens one in the native viewer."""

from __future__ import annotations

import os
import subprocess
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.recorded.records import NO_POINTS
from swarmctl.core.types import Array
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import replaced_by_program
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.recording.file_names import RECORDING
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight

APPLICATION = "swarmctl"
_MIN_RECORDING_BYTES = 4096  # a smaller packed recording contains no entity and is rejected
_BEGIN = b"RRF"  # of every recording; the number of its format follows
_PLAN_PERIOD_US = 100_000  # of the predicted paths that are drawn
_CHUNK_TICKS = 50  # ticks of an agent sent at once: one second
_VIEWER_PORT_OPTIONS = ("--bind", "127.0.0.1", "--port", "auto")  # the default port would loop data back to our server
NO_PLANS: Mapping[int, NDArray[np.void]] = MappingProxyType({})
_WINDOW_MEMORY = "2GB"  # the viewer's own default is 75 % of the machine


def viewer_binary() -> Path:
    """Return the path of the native viewer, not of the script of the same name, which forwards no signals."""
    import rerun_cli

    return Path(rerun_cli.__file__).parent / "rerun"


def has_display() -> bool:
    """Return whether a window can be opened."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def wants_window(view: bool | None, *, web: bool) -> bool:
    """Return whether to open a window: as asked, else where there is a display and no page is served instead."""
    return (has_display() and not web) if view is None else view


def open_viewer(target: str, log: Path | None = None) -> subprocess.Popen[bytes]:
    """Open a live URL or a recording in the native viewer, which outlives this process.

    Args:
        target: `rerun+http://...` or the path of an `.rrd`.
        log: file for the viewer's output; None to discard it.

    Raises:
        ConfigError: the file is no recording.
        StartError: there is no display or no such recording, or the viewer can't be started.
    """
    if not has_display():
        raise StartError(
            f"no display: neither DISPLAY nor WAYLAND_DISPLAY is set. On a machine with one: rerun --port auto {target}"
        )
    refuse_no_recording(target)
    command = [str(viewer_binary()), target, "--memory-limit", _WINDOW_MEMORY, *_VIEWER_PORT_OPTIONS]
    try:
        with (log or Path(os.devnull)).open("ab") as output:
            return subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )
    except OSError as error:
        raise StartError(f"the viewer can't be started: {error}") from error


def refuse_no_recording(target: str) -> None:
    """Check that a target is a live URL, or a file that begins as a recording does: rerun shows nothing of any other.

    Raises:
        ConfigError: it is a file with something else in it.
        StartError: it does not exist, or can't be read.
    """
    if "://" in target:
        return
    if not Path(target).is_file():
        raise StartError(f"{target}: no such recording")
    try:
        with Path(target).open("rb") as file:
            begin = file.read(len(_BEGIN))
    except OSError as error:
        raise StartError(f"{target}: can't be read: {error.strerror or error}") from error
    if begin != _BEGIN:
        raise ConfigError(target, ["is no recording of rerun" if begin else "is empty: nothing was recorded"])


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
    directory: Path, run: RunData, flight: ViewedFlight, plans: Mapping[int, NDArray[np.void]] = NO_PLANS
) -> Path:
    """Write `telemetry.rrd` of a finished run from what it has recorded.

    Args:
        directory: the run folder.
        run: the recorded run.
        flight: what is shown; its bounds are replaced by those of what was flown.
        plans: predicted paths of each agent, rows of `PLAN_DTYPE`.
    """
    import rerun as rr

    from swarmctl.telemetry.scene.scene import Scene

    path = directory / RECORDING
    rec = rr.RecordingStream(APPLICATION, recording_id=f"{directory.resolve().name}-{uuid.uuid4().hex[:8]}")
    rec.set_log_time_enabled(False)
    rec.set_sinks(rr.FileSink(path))
    flown = {agent: rows for agent, rows in run.ticks.items() if agent < len(flight.agents) and len(rows)}
    scene = Scene(rec, _fitted(flight, flown))
    scene.begin()
    epoch_us = min((int(rows["utc_us"][0]) for rows in flown.values()), default=0)
    scene.obstacles(flight.obstacles, 0, 0.0)
    for first in range(0, max(map(len, flown.values()), default=0), _CHUNK_TICKS):
        now_us = min(int(rows["utc_us"][first]) for rows in flown.values() if len(rows) > first) - epoch_us
        for agent, rows in flown.items():
            chunk = rows[first : first + _CHUNK_TICKS]
            scene.ticks(agent, chunk["utc_us"] - epoch_us, chunk)
        if any(obstacle.moves for obstacle in flight.obstacles):
            scene.obstacles(flight.obstacles, now_us, now_us * 1e-6)
        scene.plots()
    for agent, rows in flown.items():
        offset_us = int(rows["utc_us"][0] - rows["t_us"][0]) - epoch_us
        t_us, paths_ned_m = _paths(plans.get(agent, NO_POINTS))
        scene.plans(agent, t_us + offset_us, paths_ned_m)
    rec.flush(timeout_sec=30)
    rec.disconnect()
    return path


def _paths(points: NDArray[np.void]) -> tuple[NDArray[np.int64], list[Array]]:
    """Return the times (P,) at which the predicted paths that are drawn were flown, and those paths, (M, 3) each."""
    t_us, begins = np.unique(points["t_us"], return_index=True)
    paths = np.split(points["pos_ned_m"].astype(np.float64), begins[1:]) if len(t_us) else []
    _, drawn = np.unique(t_us // _PLAN_PERIOD_US, return_index=True)
    return t_us[drawn], [paths[k] for k in drawn]


def _fitted(flight: ViewedFlight, flown: Mapping[int, NDArray[np.void]]) -> ViewedFlight:
    """Return the flight with bounds that contain every flown position."""
    pos_ned_m = np.concatenate([rows["pos_ned_m"] for rows in flown.values()]) if flown else np.zeros((0, 3))
    pos_ned_m = pos_ned_m[np.isfinite(pos_ned_m).all(axis=1)]
    if not len(pos_ned_m):
        return flight
    low, high = pos_ned_m.min(axis=0), pos_ned_m.max(axis=0)
    middle, extent_m = tuple(((low + high) / 2).tolist()), float((high - low).max() / 2) + 1.0
    return flight.model_copy(update={"center_ned_m": middle, "extent_m": extent_m})
