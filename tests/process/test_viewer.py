"""The telemetry process against a real router: what it records, and that nothing it does reaches an agent."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import psutil
import pytest
import zenoh

from swarmctl.core.recorded.records import TICK_DTYPE
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.types import Mode, Phase, PlanStatus
from swarmctl.telemetry.evaluation.tracks import GAP_US, GRID_US
from swarmctl.telemetry.view.recordings import optimize_recording, viewer_binary
from swarmctl.wall_clock import monotonic_us

pytestmark = [pytest.mark.process, pytest.mark.timeout(120)]

AGENTS = 3
LAUNCHER_WAITS_S = 10.0  # from SIGTERM until it kills the viewer
AT_REST_S, AT_REST_SLEEPS, AT_REST_WITHIN_S = 3.0, 15, 60.0
SPEED_M_S = 0.5
RUN = "test"
OBSTACLE = {"center_ned_m": [2.0, 7.0, -1.5], "radius_m": 1.0, "keep_out_m": 1.75, "visibility_m": 3.0}


def open_session(settings: dict[str, Any]) -> Any:
    config = zenoh.Config()
    for key, value in ({"scouting/multicast/enabled": False, "scouting/gossip/enabled": False} | settings).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Swarm:
    """Publishes what three agents would: on a triangle of side 1 m, 0.577 m from the reference that moves north.

    Where they are follows from the time of each tick: this process may be held up between two of them.
    """

    def __init__(self, endpoint: str) -> None:
        self.session = open_session({"mode": "client", "connect/endpoints": [endpoint]})
        self.stamps_us: list[list[int]] = [[] for _ in range(AGENTS)]
        self.publishers = [
            self.session.declare_publisher(
                f"swarm/{RUN}/agent-{agent}/tick",
                congestion_control=zenoh.CongestionControl.DROP,
                reliability=zenoh.Reliability.BEST_EFFORT,
            )
            for agent in range(AGENTS)
        ]
        self.seq = 0
        self.slowest_put_s = 0.0
        self.began_us, self.north_m = monotonic_us(), [0.0] * AGENTS  # of each one's reference in its last tick

    def fly(self, seconds: float) -> None:
        next_s = time.monotonic()
        for _ in range(round(seconds * 50)):
            for agent in range(AGENTS):
                payload = self.payload(agent)
                began_s = time.monotonic()
                self.publishers[agent].put(payload)
                self.slowest_put_s = max(self.slowest_put_s, time.monotonic() - began_s)
            self.seq += 1
            next_s += 0.02
            time.sleep(max(0.0, next_s - time.monotonic()))

    def instants_without_gap(self) -> int:
        """Return at how many instants, 20 ms apart, every agent had published within the time that is interpolated.

        On a busy machine this process is held up, too, and publishes late and all at once then.
        """
        stamps_us = [np.array(stamps) for stamps in self.stamps_us]
        grid_us = np.arange(max(t_us[0] for t_us in stamps_us), min(t_us[-1] for t_us in stamps_us), GRID_US)
        is_known = np.ones(len(grid_us), bool)
        for t_us in stamps_us:
            after = np.searchsorted(t_us, grid_us, side="right")
            is_known &= t_us[after] - t_us[after - 1] <= GAP_US
        return int(is_known.sum())

    def payload(self, agent: int) -> bytes:
        row = np.zeros(1, TICK_DTYPE)
        row["t_us"], row["utc_us"], row["seq"] = monotonic_us(), time.time_ns() // 1000, self.seq
        self.stamps_us[agent].append(int(row["t_us"][0]))
        row["phase"], row["mode"], row["mission_t_s"] = Phase.TRACK, Mode.TRACKING, self.seq * 0.02
        if self.seq % 50 == 25:
            row["mode"], row["plan_status"] = Mode.REPLAY, PlanStatus.SOLVER_FAILED
        self.north_m[agent] = SPEED_M_S * 1e-6 * float(row["t_us"][0] - self.began_us)
        row["ref_pos_ned_m"] = (self.north_m[agent], 0.0, -2.0)
        around = 2 * np.pi * agent / AGENTS
        row["pos_ned_m"] = row["ref_pos_ned_m"] + np.array([np.cos(around), np.sin(around), 0.0]) / np.sqrt(3)
        row["q_nb"] = (np.cos(0.05), np.sin(0.05), 0.0, 0.0)  # roll 0.1 rad
        row["setpoint_q_nb"] = (np.cos(0.1), np.sin(0.1), 0.0, 0.0)
        row["setpoint_thrust_01"], row["hover_thrust_01"] = 0.6, 0.5
        row["iterations"], row["solve_ms"], row["tick_ms"], row["deadline_misses"] = 25, 2.5, 4.5, self.seq // 10
        plan = (row["pos_ned_m"] + np.arange(26)[:, None] * (0.02, 0.0, 0.0)).astype("<f4")
        payload: bytes = row.tobytes() + struct.pack("<H", len(plan)) + plan.tobytes()
        return payload


@pytest.fixture
def endpoint() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="bus-") as folder:  # a socket's path has to be short
        address = f"unixsock-stream/{folder}/r.sock"
        router = open_session({"mode": "router", "listen/endpoints": [address]})
        yield address
        router.close()


def obstacles_message(version: int, obstacles: list[dict[str, Any]] | str) -> str:
    listed: Any = obstacles
    if isinstance(obstacles, list):
        listed = [{"number": i, "since_utc_us": 0, "obstacle": obstacle} for i, obstacle in enumerate(obstacles)]
    return json.dumps({"version": version, "utc_us": 0, "next_number": 9, "obstacles": listed})


@contextlib.contextmanager
def viewer(endpoint: str, directory: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    directory.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "swarmctl.telemetry.view.viewer", "--run", RUN, "--bus", endpoint]
    flight = json.dumps({"agents": [{}] * AGENTS, "obstacles": [OBSTACLE]})
    command += ["--flight", flight, "--run-dir", str(directory), *more]
    with (directory / "viewer.log").open("wb") as log:
        # It gives way to every other test unless the kernel shares the processors by session.
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGCONT)
            process.kill()
        process.wait(10)


def ready(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("viewer rerun+http://127.0.0.1:"), line
    return line.split()[1]


def until_at_rest(process: subprocess.Popen[str], recording: Path) -> None:
    """Wait until a viewer has written nothing for some seconds in which it had processor time, and slept."""
    size, since_s, until_s = 0, time.monotonic(), time.monotonic() + AT_REST_WITHIN_S
    viewer, slept = psutil.Process(process.pid), 0
    while time.monotonic() < until_s:
        time.sleep(0.1)
        sleeps = viewer.num_ctx_switches().voluntary  # of the thread that draws, which does so ten times a second
        if (now := recording.stat().st_size) != size:
            size, since_s, slept = now, time.monotonic(), sleeps
        elif time.monotonic() > since_s + AT_REST_S and sleeps > slept + AT_REST_SLEEPS:
            return


def finish(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=LAUNCHER_WAITS_S)
    assert process.returncode == 0
    return output.strip().splitlines()[-1]


def values(directory: Path) -> dict[str, list[Any]]:
    """Every non-static row of the recording, per entity: its components without the time columns."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(directory / "telemetry.rrd")).stream():
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if ":" in name]
        rows = found.setdefault(str(chunk.entity_path), [])
        if not chunk.is_static:
            rows += [{name: batch.column(name)[k].as_py() for name in names} for k in range(batch.num_rows)]
    return found


def has_footer(directory: Path) -> bool:
    """Whether the recording has the list of its chunks by which a viewer opens it without reading all of it."""
    from rerun.chunk import RrdReader

    try:
        RrdReader(str(directory / "telemetry.rrd")).store()
    except RuntimeError as error:
        assert "without footer" in str(error)
        return False
    return True


def scalars(rows: list[Any]) -> list[list[float]]:
    return [row[name] for row in rows for name in row if name.endswith("Scalars:scalars")]


def expected_entities() -> set[str]:
    each = ["world/agent/{}", "world/agent/{}/body", "world/agent/{}/safety", "world/trail/{}", "world/plan/{}"]
    each += ["plot/track_err/{}", "plot/att/{}/pitch", "plot/margin/{}", "plot/left/{}", "plot/pos/{}/north"]
    each += ["events/agent-{}", "world/agent/{}/number"]
    each += [column.entity for column in COLUMNS if column.entity]
    shared = {"world", "world/compass", "world/obstacles/body", "world/obstacles/keep_out", "status"}
    shared |= {"plot/separation/min", "plot/separation/limit"}
    return {"/" + path for path in shared | {path.format(i) for path in each for i in range(AGENTS)}}


def test_recording_holds_what_was_published(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path) as process:
        url = ready(process)
        assert (tmp_path / "viewer.url").read_text().strip() == url
        swarm = Swarm(endpoint)
        swarm.fly(2.0)
        time.sleep(0.3)
        assert finish(process) == "telemetry lost=0 received=300 malformed=0"
        swarm.session.close()
    found = values(tmp_path)
    assert expected_entities() <= set(found)
    for agent in range(AGENTS):
        assert len(found[f"/world/agent/{agent}"]) == 100
        assert np.allclose(scalars(found[f"/plot/track_err/{agent}"]), 1 / np.sqrt(3), atol=1e-6)
        assert len(scalars(found[f"/plot/solve_ms/{agent}"])) == 100
        roll = np.array(scalars(found[f"/plot/att/{agent}/roll"]))
        assert np.allclose(np.radians(roll), [0.2, 0.1], atol=1e-6)  # setpoint first, then measured
        plans = [strips for row in found[f"/world/plan/{agent}"] for strips in row.values() if strips]
        assert 1 <= len(plans) <= 25, "one for each time that the viewer looks, ten times a second if it can"
        newest = np.array([np.cos(2 * np.pi * agent / AGENTS) / np.sqrt(3) + swarm.north_m[agent], -2.0])
        assert np.allclose(np.array(plans[-1][0])[0, [0, 2]], newest, atol=1e-6), "that of the last tick"
        modes = [row[name] for row in found[f"/state/{agent}/mode"] for name in row if name.endswith("state")]
        assert ["REPLAY"] in modes
    least = np.array(scalars(found["/plot/separation/min"]))
    due = swarm.instants_without_gap()
    assert due > 0 and len(least) >= due - 2, "one for every tick, but for where an agent published nothing for long"
    assert np.allclose(least, 1.0, atol=1e-4), "also between agents, which publish one after another"
    texts = [row[name][0] for row in found["/events/agent-1"] for name in row if name.endswith("TextLog:text")]
    assert "agent 1: mode REPLAY" in texts
    assert "agent 1: plan refused: solver failed" in texts
    assert not has_footer(tmp_path)
    assert optimize_recording(tmp_path)
    assert has_footer(tmp_path)
    assert len(values(tmp_path)["/world/agent/0"]) == 100


def test_obstacles_of_the_operator_replace_the_first_ones(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path) as process:
        ready(process)
        swarm = Swarm(endpoint)
        swarm.fly(0.3)
        other = OBSTACLE | {"center_ned_m": [1.0, 1.0, -9.0]}
        for version, listed in ((2, [other, OBSTACLE]), (1, []), (3, "nonsense")):
            message = obstacles_message(version, listed)
            swarm.session.put(f"swarm/{RUN}/operator/obstacles", message)
            swarm.fly(0.3)
        until_at_rest(process, tmp_path / "telemetry.rrd")  # on a busy machine it is behind
        finish(process)
        swarm.session.close()
    centers = [
        row[name] for row in values(tmp_path)["/world/obstacles/body"] for name in row if name.endswith("centers")
    ]
    assert centers == [[[2.0, 7.0, -1.5]], [[1.0, 1.0, -9.0], [2.0, 7.0, -1.5]]]


def test_frozen_telemetry_costs_the_agents_nothing(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path) as process:
        ready(process)
        swarm = Swarm(endpoint)
        swarm.fly(0.5)
        process.send_signal(signal.SIGSTOP)
        swarm.slowest_put_s = 0.0
        began_s = time.monotonic()
        swarm.fly(2.0)
        assert time.monotonic() - began_s < 3.0
        assert swarm.slowest_put_s < 0.5
        process.send_signal(signal.SIGCONT)
        swarm.fly(0.5)
        until_at_rest(process, tmp_path / "telemetry.rrd")  # a viewer that yields to others takes in what has waited
        lost, received, _ = (int(word.split("=")[1]) for word in finish(process).split()[1:])
        assert lost + received == 450  # what the frozen process could not take is counted
        assert received >= 150 - 15, "all but what was under way when it froze"
        swarm.session.close()


def test_lost_samples_are_counted(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path) as process:
        ready(process)
        swarm = Swarm(endpoint)
        swarm.fly(0.2)
        swarm.seq += 7
        swarm.fly(0.2)
        swarm.publishers[0].put(b"garbage")
        time.sleep(0.3)
        assert finish(process) == "telemetry lost=21 received=60 malformed=1"
        swarm.session.close()


def test_comes_up_and_stops_without_agents(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path) as process:
        ready(process)
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
        assert process.poll() is None  # Ctrl-C is the launcher's business
        assert finish(process) == "telemetry lost=0 received=0 malformed=0"


def test_the_live_view_is_served_to_browsers_until_the_viewer_ends(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path, "--web") as process:
        url = ready(process)
        assert process.stdout is not None
        page = process.stdout.readline().removeprefix("page ").strip()
        assert parse_qs(urlsplit(page).query)["url"] == [url]
        with urllib.request.urlopen(page, timeout=20) as answer:
            assert b"web viewer" in answer.read()
        (served,) = psutil.Process(process.pid).children()
        assert {own.laddr.ip for own in served.net_connections("tcp") if own.status == psutil.CONN_LISTEN} == {
            "127.0.0.1"
        }
        assert finish(process).startswith("telemetry lost=0")
    assert not psutil.wait_procs([served], timeout=10)[1]


def test_full_disk_leaves_the_live_view(endpoint: str, tmp_path: Path) -> None:
    (tmp_path / "telemetry.rrd").symlink_to("/dev/full")
    with viewer(endpoint, tmp_path) as process:
        port = int(ready(process).rsplit(":", 1)[1].split("/")[0])
        swarm = Swarm(endpoint)
        swarm.fly(0.5)
        socket.create_connection(("127.0.0.1", port), timeout=2).close()
        time.sleep(0.3)
        assert finish(process) == "telemetry lost=0 received=75 malformed=0"
        swarm.session.close()
    assert "live view only" in (tmp_path / "viewer.log").read_text()


def test_two_viewers_find_ports_of_their_own(endpoint: str, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        with (
            viewer(endpoint, tmp_path / "a", "--port", port) as a,
            viewer(endpoint, tmp_path / "b", "--port", port) as b,
        ):
            urls = {ready(a), ready(b)}
            assert len(urls) == 2
            assert f"rerun+http://127.0.0.1:{port}/proxy" not in urls
            finish(a)
            finish(b)


def test_stops_at_once_while_it_waits_for_a_router(tmp_path: Path) -> None:
    with viewer(f"unixsock-stream/{tmp_path}/nobody.sock", tmp_path) as process:
        until_s = time.monotonic() + 60.0
        while not _catches(process.pid, signal.SIGTERM) and time.monotonic() < until_s:
            time.sleep(0.05)
        time.sleep(0.5)  # from then on it connects
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0


def test_ends_with_its_parent(endpoint: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "swarmctl.telemetry.view.viewer", "--run", RUN, "--bus", endpoint]
    command += ["--flight", json.dumps({"agents": [{}]}), "--run-dir", str(tmp_path), "--die-with-parent"]
    code = f"import subprocess, time; print(subprocess.Popen({command!r}).pid, flush=True); time.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    ready(parent)
    parent.kill()
    parent.wait(10)
    until_s = time.monotonic() + 8
    while _alive(pid) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert not _alive(pid)


def _catches(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal."""
    (mask,) = re.findall(r"^SigCgt:\s*([0-9a-f]+)$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    return bool(int(mask, 16) & 1 << (number - 1))


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_frozen_watcher_does_not_hold_up_the_end(endpoint: str, tmp_path: Path) -> None:
    with viewer(endpoint, tmp_path) as process:
        url = ready(process)
        swarm = Swarm(endpoint)
        copy = tmp_path / "copy.rrd"
        saver = [str(viewer_binary()), "--connect", url, "--bind", "127.0.0.1", "--save", str(copy)]
        watcher = subprocess.Popen(saver, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ)
        try:
            while not copy.exists() or copy.stat().st_size < 100_000:  # it watches
                swarm.fly(0.5)
            watcher.send_signal(signal.SIGSTOP)
            log = tmp_path / "viewer.log"
            while "Sender has been blocked" not in log.read_text():  # the server's queues are full
                swarm.fly(1.0)
            until_at_rest(process, tmp_path / "telemetry.rrd")  # on a busy machine it is behind
            ticks = swarm.seq
            assert finish(process) == f"telemetry lost=0 received={AGENTS * ticks} malformed=0"
        finally:
            watcher.kill()
            watcher.wait(10)
            swarm.session.close()
    assert "Flush timed out" in log.read_text()
    assert len(values(tmp_path)["/world/agent/0"]) == ticks
