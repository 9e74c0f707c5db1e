"""Tests of offline recordings, of the mesh, and of the parts of the live view that need no bus."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.core.frames import euler_from_quat, quat_from_euler
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import TICK_DTYPE, TRUTH_DTYPE, pack_tick
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.types import ControlMode, Mode, Phase
from swarmctl.errors import StartError
from swarmctl.telemetry.evaluation.attitude import roll_pitch_rad
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.palette import CONTROL_RGB, MODE_RGB, PHASE_RGB, agent_rgb
from swarmctl.telemetry.scene.quad_mesh import quad_glb
from swarmctl.telemetry.scene.scene import Scene
from swarmctl.telemetry.scene.separation_feed import SeparationFeed
from swarmctl.telemetry.scene.viewed_flight import AgentBounds, ViewedFlight
from swarmctl.telemetry.view.feed import AgentClock, Feed
from swarmctl.telemetry.view.recordings import open_viewer, optimize_recording, simulated_recording

NO_TRUTH = np.zeros(0, TRUTH_DTYPE)


def flown(agent: int, count: int = 120) -> NDArray[np.void]:
    rows = np.zeros(count, TICK_DTYPE)
    rows["t_us"] = 20_000 * np.arange(count)
    rows["utc_us"] = rows["t_us"] + 1_780_000_000_000_000
    rows["seq"] = np.arange(count)
    rows["phase"], rows["mode"], rows["iterations"], rows["solve_ms"] = Phase.TRACK, Mode.TRACKING, 25, 1.5
    rows["pos_ned_m"][:, 0] = float(agent)
    rows["q_nb"][:, 0] = 1.0
    rows["setpoint_q_nb"] = np.nan
    return rows


def viewed(agents: int, **more: Any) -> ViewedFlight:
    return ViewedFlight(agents=(AgentBounds(),) * agents, **more)


def test_offline_recording_holds_the_run_and_can_be_packed(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    run = RunData({0: flown(0), 1: flown(1)}, NO_TRUTH, [])
    obstacle = Obstacle(center_ned_m=(5.0, 0.0, 0.0))
    path = simulated_recording(tmp_path, run, viewed(2, obstacles=(obstacle,)))
    assert optimize_recording(tmp_path)
    rows: dict[str, int] = {}
    distances: list[float] = []
    versions: list[list[str]] = []
    for chunk in RrdReader(str(path)).stream():
        batch: Any = chunk.to_record_batch()
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + batch.num_rows
        if str(chunk.entity_path) == "/__properties/swarmctl":
            versions += batch.column("version").to_pylist()
        if str(chunk.entity_path) == "/plot/separation/min" and not chunk.is_static:
            distances += [value[0] for value in batch.column("Scalars:scalars").to_pylist()]
    assert rows["/world/agent/0"] == rows["/world/agent/1"] == 120
    assert "/world/obstacles/body" in rows
    shown = {f"/{column.entity.format(agent)}" for column in COLUMNS if column.entity for agent in range(2)}
    assert len(shown) > 10
    assert shown - rows.keys() == set()
    assert versions == [[__version__]]
    assert len(distances) == 120
    assert set(distances) == {1.0}


@pytest.mark.parametrize("rate_hz", [25, 50])
def test_an_obstacle_moves_to_the_end_of_a_recording_at_any_rate(
    rate_hz: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn_s = list[float]()
    monkeypatch.setattr(Scene, "obstacles", lambda _self, _obstacles, _t_us, elapsed_s: drawn_s.append(elapsed_s))
    rows = flown(0, 601)[:: 50 // rate_hz]  # of 12 s
    moving = Obstacle(center_ned_m=(5.0, 0.0, 0.0), vel_ned_m_s=(1.0, 0.0, 0.0))
    simulated_recording(tmp_path, RunData({0: rows}, NO_TRUTH, []), viewed(1, obstacles=(moving,)))
    assert max(drawn_s) == pytest.approx(12.0, abs=2.0)


def test_recording_that_cannot_be_packed_stays(tmp_path: Path) -> None:
    assert not optimize_recording(tmp_path)
    (tmp_path / "telemetry.rrd").write_bytes(b"not a recording")
    assert not optimize_recording(tmp_path)
    assert (tmp_path / "telemetry.rrd").read_bytes() == b"not a recording"
    assert [path.name for path in tmp_path.iterdir()] == ["telemetry.rrd"]


def test_recording_that_is_a_link_is_not_packed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "received").mkdir()
    mine = simulated_recording(tmp_path / "mine", RunData({0: flown(0)}, NO_TRUTH, []), viewed(1))
    before = mine.read_bytes()
    link = tmp_path / "received" / "telemetry.rrd"
    link.symlink_to(mine)
    assert not optimize_recording(tmp_path / "received")
    assert link.is_symlink()
    assert mine.read_bytes() == before


def test_recording_of_a_killed_viewer_is_repaired(tmp_path: Path) -> None:
    path = simulated_recording(tmp_path, RunData({0: flown(0)}, NO_TRUTH, []), viewed(1))
    path.write_bytes(path.read_bytes()[:-30_000])
    assert optimize_recording(tmp_path)
    assert path.stat().st_size > 20_000


def test_opening_a_window_without_a_display_is_refused_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(StartError, match="no display"):
        open_viewer("rerun+http://127.0.0.1:9876/proxy")


def test_recordings_can_be_imported_without_rerun() -> None:
    modules = "swarmctl.telemetry.view.recordings, swarmctl.telemetry.recording.run_folder"
    code = f"import sys, {modules}; print({{'pyarrow', 'rerun', 'zenoh'}} & set(sys.modules))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert output.stdout.strip() == "set()"


def test_mesh_is_a_sound_glb_of_a_small_quadrotor() -> None:
    glb = quad_glb(agent_rgb(0))
    magic, version, length, json_length, kind = struct.unpack_from("<4sIIII", glb)
    assert (magic, version, length, kind) == (b"glTF", 2, len(glb), 0x4E4F534A)
    document = json.loads(glb[20 : 20 + json_length])
    blob = glb[28 + json_length :]
    assert len(blob) == document["buffers"][0]["byteLength"]
    colors = [material["pbrMetallicRoughness"]["baseColorFactor"][:3] for material in document["materials"]]
    assert colors.count(pytest.approx([(c / 255) ** 2.2 for c in agent_rgb(0)], abs=1e-5)) == 2
    assert len(glb) < 60_000
    corners = []
    for primitive in document["meshes"][0]["primitives"]:
        accessor = document["accessors"][primitive["attributes"]["POSITION"]]
        offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        corners.append(np.frombuffer(blob, "<f4", 3 * accessor["count"], offset).reshape(-1, 3))
    size_m = np.ptp(np.concatenate(corners), axis=0)
    assert 0.3 < size_m[0] < 0.5
    assert size_m[2] < 0.1


def test_smallest_distance_of_agents_that_report_at_different_instants() -> None:
    feed = SeparationFeed(3)
    t_us = 20_000 * np.arange(50)
    feed.offer(0, t_us, np.zeros((50, 3)))
    second_us = t_us + 13_000
    feed.offer(1, second_us, np.column_stack([1.0 + second_us / 1e6, np.zeros(50), np.zeros(50)]))
    grid_us, least_m = feed.take()
    assert (grid_us[0], grid_us[-1]) == (13_000, 973_000)  # while both are known
    assert np.allclose(least_m, 1.0 + grid_us / 1e6)
    assert len(feed.take()[0]) == 0


def test_silent_agent_does_not_stop_the_others() -> None:
    feed = SeparationFeed(3)
    t_us = 20_000 * np.arange(50)
    for agent in range(3):
        feed.offer(agent, t_us, np.full((50, 3), float(agent)))
    feed.take()
    last_us = 0
    for _ in range(5):
        t_us = t_us + 1_000_000
        for agent in range(2):
            feed.offer(agent, t_us, np.full((50, 3), float(agent)))
        grid_us, _ = feed.take()
        last_us = max([last_us, *grid_us.tolist()])
    assert last_us == t_us[-1]


def clock_rows(seqs: list[int], t_us: list[int], offset_us: int) -> NDArray[np.void]:
    rows = np.zeros(len(seqs), TICK_DTYPE)
    rows["seq"], rows["t_us"], rows["utc_us"] = seqs, t_us, np.array(t_us) + offset_us
    return rows


def test_clock_of_an_agent_ignores_utc_steps_counts_gaps_and_survives_a_restart() -> None:
    clock = AgentClock()
    t_us, newer = clock.place(clock_rows([0, 1, 4], [100, 200, 500], 1000), 1000, 2000)
    assert t_us.tolist() == [100, 200, 500]
    assert newer.all()
    assert clock.lost == 2
    t_us, newer = clock.place(clock_rows([5, 6], [600, 600], 999_999), 1000, 2000)  # UTC stepped; one sample came twice
    assert t_us.tolist() == [600, 600]
    assert newer.tolist() == [True, False]
    t_us, newer = clock.place(clock_rows([0, 1], [10, 30], 2000), 1000, 3000)  # another process, later in UTC
    assert t_us.tolist() == [1010, 1030]
    assert newer.all()
    assert clock.lost == 2


class Sent:
    """A bus on which ticks arrive once."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []

    def receive(self, topic: object) -> list[tuple[str, bytes]]:
        arrived, self.sent = self.sent, []
        return arrived


class Live:
    """A view of two agents, each 20 ms a tick of both; agent 1 is 2 m from agent 0."""

    def __init__(self) -> None:
        self.bus, self.now_us, self.seqs = Sent(), 1_780_000_000_000_000, [0, 0]
        self.feed, self.separation = Feed(cast(Any, self.bus), 2, lambda: self.now_us), SeparationFeed(2)
        self.drawn, self.least_m = [0, 0], list[float]()

    def say(self, agent: int, *, t_us: int | None = None, utc_us: int | None = None, ahead_us: int = 0) -> None:
        row = np.zeros(1, TICK_DTYPE)
        row["seq"], row["pos_ned_m"] = self.seqs[agent], (2.0 * agent, 0.0, 0.0)
        row["t_us"] = self.now_us - BOOTED_UTC_US if t_us is None else t_us
        row["utc_us"] = self.now_us + ahead_us if utc_us is None else utc_us
        self.seqs[agent] += 1
        self.bus.sent.append((f"agent-{agent}", pack_tick(row, None)))

    def fly(self, ticks: int, ahead_us: int = 0) -> None:
        for _ in range(ticks):
            self.now_us += 20_000
            self.say(0)
            self.say(1, ahead_us=ahead_us)
            self.take()

    def take(self) -> None:
        for batch in self.feed.take():
            self.drawn[batch.agent] += len(batch.rows)
            corrected_us = batch.t_us - batch.ahead_us
            self.separation.offer(batch.agent, corrected_us, batch.rows["pos_ned_m"], is_anew=batch.is_anew)
        self.least_m += self.separation.take()[1].tolist()


BOOTED_UTC_US = 1_779_000_000_000_000
HOUR_US = 3_600_000_000


@pytest.mark.parametrize(
    ("t_us", "utc_us"),
    [
        (0, -(2**63)),
        (2**63 - 1, -(2**63)),
        (2**62, 2**62),
        (10**15, None),
        (2 * HOUR_US, None),
        (-HOUR_US, None),
        (10**15, 10**15),
    ],
)
@pytest.mark.parametrize("begins", [False, True])
def test_a_tick_of_no_clock_is_counted_and_the_view_goes_on(t_us: int, utc_us: int | None, begins: bool) -> None:
    """One such tick ended the viewer, or asked it for 373 GiB, or kept an agent out of the view for good."""
    live = Live()
    if not begins:
        live.fly(100)
    before, counted = live.drawn[1], live.feed.malformed
    live.say(1, t_us=t_us, utc_us=utc_us)
    live.take()
    assert live.drawn[1] - before <= begins
    assert live.feed.malformed - counted == 1 or begins
    before = live.drawn[1]
    live.fly(100)
    assert live.drawn[1] - before >= 98, "two are not believed after a first one that was not true"
    assert live.least_m[-50:] == [2.0] * 50


@pytest.mark.parametrize("again", [True, False], ids=["its agent is started again", "its agent flies on"])
@pytest.mark.parametrize("ahead_us", [300_000_000, -300_000_000])
def test_an_agent_whose_clock_was_set_is_drawn_on(ahead_us: int, again: bool) -> None:
    """One that had been 5 minutes ahead was not drawn for as long, or for good."""
    live = Live()
    live.fly(100, ahead_us)
    live.seqs[1] = 0 if again else live.seqs[1]
    drawn, compared = live.drawn[1], len(live.least_m)
    live.fly(100)
    assert live.drawn[1] == drawn + 100
    assert len(live.least_m) >= compared + 95
    assert set(live.least_m) == {2.0}


def test_who_falls_silent_and_comes_back_after_long_is_compared_from_then_on() -> None:
    """All instants between were computed at once: 373 GiB of them."""
    feed = SeparationFeed(2)
    for begins_us in (0, 10**15):
        t_us = begins_us + 20_000 * np.arange(50)
        for agent in range(2):
            feed.offer(agent, t_us, np.full((50, 3), float(agent)))
        grid_us, least_m = feed.take()
        assert begins_us <= grid_us[0] and grid_us[-1] == t_us[-1]
        assert 49 <= len(least_m) <= 50


@pytest.mark.parametrize("ahead_us", [0, 500_000, -3_600_000_000])
def test_live_distances_are_of_the_same_instants_whatever_clocks_say(ahead_us: int) -> None:
    """Two vehicles fly the same line 1 m apart, at 2 m/s: by stamps 0.5 s apart they would meet."""
    hub_us, bus = 1_000_000_000, Sent()
    feed, separation, least_m = Feed(cast(Any, bus), 2, lambda: now_us), SeparationFeed(2), list[float]()
    now_us = hub_us
    for tick in range(500):
        now_us = hub_us + 20_000 * tick
        for agent in range(2):
            row = np.zeros(1, TICK_DTYPE)
            row["seq"], row["t_us"] = tick, 20_000 * tick
            row["utc_us"] = now_us + agent * ahead_us
            row["pos_ned_m"] = (2.0 * 0.02 * tick - agent, 0.0, 0.0)
            bus.sent.append((f"agent-{agent}", pack_tick(row, None)))
        if tick % 5 == 0:
            now_us += 3_000
            for batch in feed.take():
                separation.offer(batch.agent, batch.t_us - batch.ahead_us, batch.rows["pos_ned_m"])
            least_m += separation.take()[1].tolist()
    assert len(least_m) > 400
    assert np.allclose(least_m, 1.0, atol=0.01)


def test_roll_and_pitch_of_many_agree_with_those_of_one() -> None:
    angles = np.random.default_rng(1).uniform(-1.0, 1.0, (20, 3))
    q_nb = np.array([quat_from_euler(*row) for row in angles])
    one_by_one = np.array([euler_from_quat(q)[:2] for q in q_nb])
    assert np.allclose(roll_pitch_rad(q_nb), one_by_one)


def test_every_state_and_agent_has_a_colour() -> None:
    assert set(PHASE_RGB) == {phase.name for phase in Phase}
    assert set(MODE_RGB) == {mode.name for mode in Mode}
    assert set(CONTROL_RGB) == {mode.name for mode in ControlMode}
    colours = [agent_rgb(agent) for agent in range(30)]
    assert len(set(colours)) == 30
