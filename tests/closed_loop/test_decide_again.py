"""`swarmctl replay --decide`: an agent that receives what it has received decides what it has decided."""

from __future__ import annotations

import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.simulate import simulate
from swarmctl.config import load
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import hold
from swarmctl.ops.decide.verb import decisions_of_run, lines_of, notes_of_run
from swarmctl.ops.running_launches import LAUNCH_FILE, RunningLaunch, process_start_s
from swarmctl.telemetry.recording.run_files import read_parquet, write_parquet
from tests.closed_loop.conftest import mission_t_s

CROSSING = (
    "swarm.agents=2",
    "start.positions_ned_m=[[0,0,-3],[4,0.2,-3]]",
    "mission.kind=goto",
    "mission.goto.goals_ned_m=[[4,0,-3],[0,0.2,-3]]",
    "mission.goto.goal_assignment=false",
    "mission.duration_s=6",
    "sitl.start=air",
    "sitl.estimator=external",
    "obstacles=[{center_ned_m=[2,1.5,-3],radius_m=0.5,keep_out_m=1.0,visibility_m=5.0}]",
)
IN_THE_WAY = Obstacle(center_ned_m=(3.0, -1.0, -3.0), radius_m=0.4, keep_out_m=0.9, visibility_m=5.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fly two agents past each other and obstacles, of which one is set meanwhile; one agent is held and goes on."""
    directory, step = tmp_path_factory.mktemp("run"), Lockstep.step
    due: dict[float, Callable[[Lockstep], None]] = {
        0.5: lambda flight: flight.set_obstacles([*flight.config.obstacles, IN_THE_WAY]),
        2.0: lambda flight: flight.command("hold", 0),
        3.0: lambda flight: flight.command("resume", 0),
    }

    def ordering(self: Lockstep) -> None:
        for at_s in [at_s for at_s in due if mission_t_s(self) >= at_s]:
            due.pop(at_s)(self)
        step(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Lockstep, "step", ordering)
        simulate(load(None, CROSSING), directory, 1)
    assert not due
    return directory


def test_the_same_agent_decides_the_same_in_every_phase(folder: Path) -> None:
    for agent in decisions_of_run(folder, ()):
        assert agent.compared > 500
        assert agent.phases_differ == 0
        assert agent.plans_differ == 0
        assert agent.tilt_rad["max"] < 1e-3, "what is recorded is rounded"
        assert agent.thrust_01["max"] < 1e-3
        assert not agent.differences
        assert lines_of(agent)[0].startswith(f"agent-{agent.agent}: {agent.compared} ticks")


def test_the_keys_of_its_vehicles_are_needed_by_nobody_who_decides_a_run_again(folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(folder, tmp_path / "elsewhere")
    config = copy / "config.toml"
    keys = 'signing_keys = ["/none/0.key", "/none/1.key"]'
    config.write_text(re.sub(r"signing_keys = \[\]", keys, config.read_text()))
    assert keys in config.read_text()
    assert [agent.plans_differ for agent in decisions_of_run(copy, ())] == [0, 0]


@pytest.mark.usefixtures("configured_starts")
def test_messages_that_come_late_are_known_in_the_tick_that_took_them(tmp_path: Path) -> None:
    """As in a launch, where they come whenever they come: they were given to the ticks that follow their stamps.

    Peers' statuses come late too, and the rate shows whether it is told that a peer keeps up.
    """
    late = ("bus.delay_ms=30", "bus.jitter_ms=80", "bus.loss_01=0.05", "agent.rate_hz=10")
    simulate(load(None, [*CROSSING, *late]), tmp_path, 1)
    for agent in decisions_of_run(tmp_path, ()):
        assert agent.compared > 200
        assert agent.phases_differ == agent.plans_differ == 0
        assert agent.tilt_rad["max"] < 1e-3
        assert not agent.differences
    for path in tmp_path.glob("*.received.parquet"):
        path.unlink()
    differ = [sum(found.ticks for found in agent.differences) for agent in decisions_of_run(tmp_path, ())]
    assert sum(differ) > 10, "negative control: by stamps alone"
    assert len([note for note in notes_of_run(tmp_path) if "an older recording" in note]) == 2


def test_frames_that_a_tick_reads_after_its_begin_are_known_in_it(folder: Path, tmp_path: Path) -> None:
    """As in a launch, where reading takes time: every frame was given to the next tick, and each decision came late."""
    late = shutil.copytree(folder, tmp_path / "late")
    for path in late.glob("agent-*.tlog"):
        recorded, later_us, at = bytearray(path.read_bytes()), 300, 0
        while at < len(recorded):
            (utc_us,) = struct.unpack_from(">Q", recorded, at)
            struct.pack_into(">Q", recorded, at, utc_us + later_us)
            version_2 = recorded[at + 8] == 0xFD
            at += 8 + recorded[at + 9] + (12 if version_2 else 8)
        path.write_bytes(recorded)
    for agent in decisions_of_run(late, ()):
        assert not agent.differences


def test_another_parameter_is_seen_where_it_matters(folder: Path) -> None:
    """Negative control: who may tilt less decides otherwise, from the moment on at which it is in control."""
    weaker = ["controller.mpc.u_max=0.05", "agent.state_machine.accel_m_s2=0.4", "separation.stop_m_s2=0.4"]
    for agent in decisions_of_run(folder, weaker):
        assert agent.tilt_rad["max"] > 0.05
        assert agent.differences[0].was.split(",")[0] in ("GOTO_START", "READY")
        assert sum(found.ticks for found in agent.differences) > 100
        assert f"{agent.differences[0].ticks} ticks: {agent.differences[0].was}" in lines_of(agent)[1]


def test_peers_are_heard(folder: Path, tmp_path: Path) -> None:
    """Negative control: without the peer's plans the crossing is decided otherwise."""
    deaf = shutil.copytree(folder, tmp_path / "deaf")
    (deaf / "agent-1.plans.parquet").unlink()
    first, _ = decisions_of_run(deaf, ())
    assert sum(found.ticks for found in first.differences) > 10


def test_obstacles_that_were_set_in_flight_are_known(folder: Path, tmp_path: Path) -> None:
    """Negative control: without the lists that agents have recorded, the one that was set is not avoided."""
    bare = shutil.copytree(folder, tmp_path / "bare")
    lines = (bare / "events.jsonl").read_text().splitlines(keepends=True)
    assert sum('"obstacles_changed"' in line for line in lines) == 4, "two lists, of two agents"
    (bare / "events.jsonl").write_text("".join(line for line in lines if '"obstacles_changed"' not in line))
    assert sum(found.ticks for agent in decisions_of_run(bare, ()) for found in agent.differences) > 10


def test_frames_that_are_lost_are_named(folder: Path, tmp_path: Path) -> None:
    """A `.tlog` that a full disk has cut off looked like an agent that decides otherwise."""
    cut = shutil.copytree(folder, tmp_path / "cut")
    log = (cut / "agent-0.tlog").read_bytes()
    (cut / "agent-0.tlog").write_bytes(log[: len(log) // 2])
    (note,) = notes_of_run(cut)
    assert re.match(r"agent-0: agent-0\.tlog lacks \d+ of \d+ frames that its ticks received", note)


def test_who_has_recorded_no_ticks_or_was_killed_is_named(folder: Path, tmp_path: Path) -> None:
    assert notes_of_run(folder) == []
    for name in ("missing", "empty"):
        lacking = shutil.copytree(folder, tmp_path / name)
        (lacking / "agent-1.parquet").unlink()
        if name == "empty":
            (lacking / "agent-1.ticks").write_bytes(b"")
        assert [decided.agent for decided in decisions_of_run(lacking, ())] == [0]
        (note,) = notes_of_run(lacking)
        assert note.startswith("agent-1: no ticks were recorded")
    killed = shutil.copytree(folder, tmp_path / "killed")
    rows = read_parquet(killed / "agent-1.parquet")
    write_parquet(killed / "agent-1.parquet", rows[: np.flatnonzero(rows["phase"] == Phase.TRACK)[-1]])
    (note,) = notes_of_run(killed)
    assert note.startswith("agent-1: its ticks end in TRACK; how others noticed is not replayed")


def test_a_run_that_is_not_over_is_not_decided_again(folder: Path, tmp_path: Path) -> None:
    """Files that are read one after another while they grow gave ticks their peers' plans were missing for."""
    flying = shutil.copytree(folder, tmp_path / "flying")
    (flying / "summary.json").unlink()
    with (flying / "agent-1.ticks").open("ab") as file:
        hold(file.fileno())
        with pytest.raises(StartError, match=r"agent-1\.ticks: is still written: the run is not over"):
            decisions_of_run(flying, ())
    (flying / "agent-1.ticks").unlink()
    started_s, pid = process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 2, str(flying), ending=True)
    (flying / LAUNCH_FILE).write_bytes(msgspec.json.encode(launch))
    with pytest.raises(StartError, match="still flies or is ending, see: swarmctl status"):
        decisions_of_run(flying, ())
    (flying / LAUNCH_FILE).unlink()
    assert [agent.phases_differ for agent in decisions_of_run(flying, ())] == [0, 0], "one that was cut off is"


def test_what_can_not_be_decided_again_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="committed to is not recorded"):
        decisions_of_run(folder, ["separation.mode=guaranteed"])
    with pytest.raises(ConfigError, match=r"swarm\.agents is that of the run, 2"):
        decisions_of_run(folder, ["swarm.agents=1", "mission.kind=hover"])
    with pytest.raises(ConfigError, match="is no run folder"):
        decisions_of_run(tmp_path, ())
    begun = tmp_path / "begun"  # what a simulation that was killed leaves
    begun.mkdir()
    shutil.copy(folder / "config.toml", begun)
    with pytest.raises(ConfigError, match="holds no ticks of an agent"):
        decisions_of_run(begun, ())
    bare = shutil.copytree(folder, tmp_path / "bare")
    (bare / "agent-0.tlog").unlink()
    with pytest.raises(ConfigError, match=r"agent-0\.tlog: can't be read"):
        decisions_of_run(bare, ())
    (bare / "agent-0.tlog").write_bytes(b"\0" * 64)
    with pytest.raises(ConfigError, match="holds no frames of a vehicle"):
        decisions_of_run(bare, ())
