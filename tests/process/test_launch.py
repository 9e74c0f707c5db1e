"""Real launches, as a user starts them: simulator, agents, bus and view in processes, with signals from outside."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import swarmctl
from swarmctl.config import load
from swarmctl.core.types import Phase
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.signing.key_file import write_new_key
from swarmctl.mavlink.signing.refusals import OLD, REPLAYED
from swarmctl.ops.cli import main
from swarmctl.ops.decide.inputs import frames_of
from swarmctl.ops.decide.verb import decisions_of_run
from swarmctl.ops.processes import wants_realtime
from swarmctl.ops.running_launches import LAUNCH_FILE
from swarmctl.process_priority import WATCHER_NICE, is_realtime_permitted
from swarmctl.telemetry.recording.run_files import read_parquet
from tests.benches.at_once import at_once
from tests.benches.launches import AIR, END_S, NEAR, TWO, GroundStation, Launched, Start
from tests.benches.scheduling import niceness, policies
from tests.process.test_readme import low, shown

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

AT_ONCE_S = 4.0  # a landing takes longer


def test_a_whole_mission_is_flown_recorded_and_summed_up(start: Start) -> None:
    (line,) = shown(r"^swarmctl launch configs/thesis")
    station = GroundStation()
    forward = f"mavlink.forward=['udpout://127.0.0.1:{station.port}']"
    launched = start(*shlex.split(line)[2:], "--duration", "5", low(line), "--no-view", "--set", forward)
    assert sorted(station.read_parameter("COM_OF_LOSS_T")) == [1, 2, 3], "every vehicle answers through its agent"
    station.close()
    launched.until_phase("TRACK", 3)
    (started,) = launched.events("started")
    realtime = is_realtime_permitted() and wants_realtime(load(None), range(3))
    assert started["realtime"] == realtime
    policy = os.SCHED_RR if realtime else os.SCHED_OTHER
    for words in (["swarmctl.bus.network.router"], ["sitl"], *(["agent", "--id", str(i)] for i in range(3))):
        assert policies(launched.pid_of(*words)) == {policy}, words
    viewer = launched.pid_of("swarmctl.telemetry.view.viewer")
    assert policies(viewer) == {os.SCHED_OTHER}, "it waits for those that fly"
    assert niceness(viewer) == {WATCHER_NICE}, "also where these have no real-time priority"
    assert niceness(launched.pid_of("agent", "--id", "0")) == {0}
    assert launched.verb("status").returncode == 0
    refused = launched.verb("report", str(launched.run_dir))
    assert (refused.returncode, refused.stdout) == (3, "")
    assert "still flies or is ending" in refused.stderr
    assert launched.end() == 0, launched.text()
    for i in range(3 * realtime):
        (asked,) = launched.events("realtime", f"agent-{i}")
        assert asked["granted"]
        assert asked["start_up_s"] > 0.3, "modules are loaded at normal priority: other swarms may be flying"
    lines = launched.text().splitlines()
    assert "3 agents" in lines[0]
    assert "bus " in lines[1]
    assert str(launched.run_dir) in lines[2]
    assert any("agent-2  TRACK" in line for line in lines)
    armed = [line for line in lines if "  ARM" in line or "  TAKEOFF" in line]
    assert armed and not any("waits for" in line for line in armed), "who does not wait does not say so"
    assert "GPS_GLOBAL_ORIGIN" not in launched.text(), "that an origin is asked for too early is no alert"
    assert json.loads((launched.run_dir / LAUNCH_FILE).read_bytes())["ending"], "verbs have said so meanwhile"
    assert any(line.startswith("completed, summed mean tracking error") for line in lines[-6:])
    summary = launched.summary()
    assert summary["outcome"] == "completed"
    assert summary["violations"] == []
    assert summary["agents"] == 3
    assert summary["separation"]["min_m"] >= summary["separation"]["required_m"]
    assert summary["obstacles"]["min_clearance_m"] < 3.0, "so near is it seen, and it ends the mission there"
    assert summary["tracking"]["index_m"] < 6.0, "three agents that stayed at the start would have 12"
    assert launched.landed() == {0: True, 1: True, 2: True}
    for name in ("config.toml", "events.jsonl", "telemetry.rrd", "report.html", "truth.parquet"):
        assert (launched.run_dir / name).stat().st_size > 0, name
    for i in range(3):
        assert (launched.run_dir / f"agent-{i}.parquet").stat().st_size > 0
        assert (launched.run_dir / f"agent-{i}.tlog").stat().st_size > 0
    assert not list(launched.run_dir.glob("*.part"))
    received = re.search(r"received=(\d+)", (launched.run_dir / "viewer.log").read_text())
    assert received
    assert int(received[1]) > 300, "the viewer saw the ticks"
    for agent in decisions_of_run(launched.run_dir, ()):
        assert agent.phases_differ == 0, "each frame came a tick late, and with it every change of phase"
        assert not agent.differences, "messages came to other ticks than they had, up to 4 degrees off"
        apart = agent.tilt_rad["max"], agent.thrust_01["max"]
        assert apart == (0.0, 0.0), "a microsecond of UTC was another one; in a minute it grows to a degree"


def test_a_killed_agent_fails_the_launch_and_the_others_finish(start: Start, tmp_path: Path) -> None:
    """In guaranteed mode a dead agent is not waited for, and the others still ask each other.

    All links are signed: the agent that lands the vehicle of the dead one goes on from its time stamps.
    """
    files = [tmp_path / f"{agent}.key" for agent in range(3)]
    keys = [write_new_key(path) for path in files]
    signed = f"mavlink.signing_keys={[str(path) for path in files]}"
    wanted = ("telemetry.enabled=false", "separation.mode=guaranteed", signed)
    launched = start("--agents", "3", "--duration", "4", *NEAR, *(f"--set={it}" for it in wanted))
    launched.until_phase("TRACK", 3)
    os.kill(launched.pid_of("agent", "--id", "1"), signal.SIGKILL)
    assert launched.end() == 4, launched.text()
    assert "agent-1 was killed by SIGKILL" in launched.text()
    ended = [(row["agent"], row["exit_code"]) for row in launched.events("agent_ended")]
    assert {(0, 0), (1, 137), (2, 0)} <= set(ended)
    assert (1, 130) in ended, "its vehicle was landed by another agent"
    assert "the vehicle of agent-1 is on the ground and disarmed" in launched.text()
    were = launched.events("parameters_changed", "agent-1")[0]["were"]
    assert (were["NAV_DLL_ACT"], were["MIS_TAKEOFF_ALT"]) == (0, 2.5)
    for name, was in (("NAV_DLL_ACT", 0), ("MIS_TAKEOFF_ALT", 2.5)):
        killed, after = (values_told(launched.run_dir / it / "agent-1.tlog", name) for it in (".", "recovery"))
        assert (killed[0], killed[-1] != was) == (was, True), "set for the flight, or by the climb"
        assert after[-1] == was, "set back by the other agent, also where the vehicle has landed before it came"
    summary = launched.summary()
    assert summary["outcome"] == "failed"
    assert any("agent-1" in violation for violation in summary["violations"])
    assert summary["commitments"]["committed"] > 50
    assert summary["commitments"]["tracking_violation"] == 0
    assert summary["separation"]["min_m"] >= 0.8
    assert launched.landed()[0]
    assert launched.landed()[2]
    assert set(summary["comms"]["refused_frames"]) <= {OLD, REPLAYED}, "of before the vehicle has heard its agent"
    assert files[0].name in (launched.run_dir / "config.toml").read_text()
    for path in (launched.temp / "state", launched.run_dir):
        for file in (found for found in path.rglob("*") if found.is_file()):
            content = file.read_bytes()
            assert not any(key.secret in content or key.secret.hex().encode() in content for key in keys), file
    assert len(list((launched.temp / "state" / "swarmctl" / "signing").iterdir())) == 3
    for agent in ("agent-0", "agent-2"):
        assert 1 in [row["agent"] for row in launched.events("peer_ended", agent)], "the launch has seen it end"


def values_told(tlog: Path, name: str) -> list[float]:
    """Return the values of a parameter that a vehicle has told, in the bits of floats."""
    codec, found = Codec(255, 190), list[float]()
    for _, frame in frames_of(tlog.read_bytes()):
        message = codec.decode(frame)
        if message is not None and message.get_type() == "PARAM_VALUE" and message.param_id == name:
            found.append(message.param_value)
    return found


def ctrl_c_lands_and_sums_up(start: Start) -> None:
    launched = start(*TWO, *NEAR, "--duration", "60")
    launched.until_phase("TRACK", 2)
    launched.process.send_signal(signal.SIGINT)
    assert launched.end() == 130, launched.text()
    assert launched.landed() == {0: True, 1: True}
    assert launched.summary()["outcome"] == "interrupted"
    assert re.search(r"interrupted, (only )?\d of 2 goals reached.*, summed mean tracking error", launched.text())


def a_second_ctrl_c_ends_everything_at_once(start: Start) -> None:
    launched = start("--agents", "2", *AIR, "--duration", "60", "--no-view")
    launched.until_phase("TRACK", 2)
    launched.process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    launched.process.send_signal(signal.SIGINT)
    deadline_s = time.monotonic() + AT_ONCE_S
    while launched.relatives():
        assert time.monotonic() < deadline_s, "they go on"
        time.sleep(0.05)
    assert launched.end(30.0) == 130, launched.text()
    assert launched.summary()["outcome"] == "interrupted"


def a_closed_terminal_lands_and_keeps_the_verdict(start: Start) -> None:
    """The kernel and the shell both send SIGHUP: that is one request, and after the flight none at all."""
    launched = start(*TWO, *NEAR, "--duration", "60")
    launched.until_phase("TRACK", 2)
    for _ in range(3):
        launched.process.send_signal(signal.SIGHUP)
        time.sleep(0.1)
    deadline_s = time.monotonic() + END_S
    while launched.process.poll() is None and time.monotonic() < deadline_s:
        if launched.events("stopped"):  # all have landed, the run is being judged
            launched.process.send_signal(signal.SIGHUP)
        time.sleep(0.05)
    assert launched.end() == 130, launched.text()
    assert launched.landed() == {0: True, 1: True}
    assert launched.summary()["outcome"] == "interrupted"
    assert "killed" not in launched.text()


def a_killed_launcher_leaves_nothing(start: Start) -> None:
    launched = start("--agents", "2", *AIR, "--duration", "60", "--no-view")
    launched.until_phase("TRACK", 2)
    launched.process.kill()
    launched.process.wait(20)
    refused = launched.verb("report", str(launched.run_dir))
    assert (refused.returncode, "is still written" in refused.stderr) == (3, True), refused.stderr
    deadline_s = time.monotonic() + 30.0
    while any(not path.endswith(".json") for path in launched.leftovers()) and time.monotonic() < deadline_s:
        time.sleep(0.2)
    assert all(path.endswith(".json") for path in launched.leftovers()), launched.leftovers()
    assert launched.verb("report", str(launched.run_dir)).returncode == 0
    assert launched.verb("status").returncode == 3, "the note it left is recognised as stale"
    assert launched.leftovers() == []


def without_its_viewer_the_flight_goes_on(start: Start) -> Launched:
    launched = start("--agents", "2", *AIR, "--duration", "3", "--no-view")
    launched.until_phase("TRACK", 2)
    os.kill(launched.pid_of("swarmctl.telemetry.view.viewer"), signal.SIGKILL)
    assert launched.end() == 0, launched.text()
    assert launched.text().count("the flight goes on") == 1
    return launched


def without_its_router_the_flight_goes_on_with_another(start: Start) -> Launched:
    launched = start(*TWO, *AIR, "--duration", "8")
    launched.until_phase("TRACK", 2)
    os.kill(launched.pid_of("swarmctl.bus.network.router"), signal.SIGKILL)
    assert launched.end() == 0, launched.text()
    assert len(launched.events("router_ended")) == 1
    for agent in range(2):
        rows = read_parquet(launched.run_dir / f"agent-{agent}.parquet")
        tracked = rows[rows["phase"] == Phase.TRACK]
        usual_ms = float(np.median(tracked["plan_staleness_ms"]))
        # How long depends on how fast this machine starts a router: a path every 20 ms, and at least one is missed.
        assert tracked["plan_staleness_ms"].max() > 1.4 * usual_ms, "they heard nothing of each other for a while"
        assert tracked["plan_staleness_ms"][-1] < 100.0, "and do so again"
    return launched


def without_its_simulator_the_launch_ends_as_failed(start: Start) -> None:
    killed_part(start, "sitl", *AIR)


def killed_part(start: Start, name: str, *where: str) -> Launched:
    launched = start(*TWO, *where, "--duration", "60")
    launched.until_phase("TRACK", 2)
    os.kill(launched.pid_of(name), signal.SIGKILL)
    assert launched.end() == 4, launched.text()
    assert launched.summary()["outcome"] == "failed"
    return launched


@pytest.mark.parametrize(
    "ends",
    [
        (
            ctrl_c_lands_and_sums_up,
            a_closed_terminal_lands_and_keeps_the_verdict,
        ),
        (
            a_second_ctrl_c_ends_everything_at_once,
            a_killed_launcher_leaves_nothing,
            without_its_simulator_the_launch_ends_as_failed,
        ),
    ],
    ids=["on the ground", "in the air"],
)
def test_launches_that_end_before_their_time(start: Start, ends: Sequence[Callable[[Start], None]]) -> None:
    at_once([partial(end, start) for end in ends])


@pytest.mark.parametrize("when_s", [(0.0, 2.0), (0.3, 1.0)])
def test_ctrl_c_during_start_leaves_nothing(start: Start, when_s: Sequence[float]) -> None:
    at_once([partial(ctrl_c_during_start, start, after_s) for after_s in when_s])


def ctrl_c_during_start(start: Start, when_s: float) -> None:
    launched = start(*TWO, "--duration", "6")
    while not (launched.run_dir / "config.toml").exists():
        assert launched.process.poll() is None, launched.text()
        time.sleep(0.01)
    time.sleep(when_s)
    launched.process.send_signal(signal.SIGINT)
    assert launched.end() == 130, launched.text()


def test_two_launches_at_once_beside_another_simulator(start: Start) -> None:
    """Every PX4-like simulator sends to 14540 and up until answered: neither launch takes the other's vehicles.

    One loses its viewer, which its flight does not need, the other one its router, which is started again.
    """
    command = [sys.executable, "-m", "sitl", "--vehicles", "2", "--physics-hz", "100"]
    others = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    flown: list[Launched] = []

    def fly(flight: Callable[[Start], Launched]) -> None:
        flown.append(flight(start))

    flights = (without_its_viewer_the_flight_goes_on, without_its_router_the_flight_goes_on_with_another)
    try:
        at_once([partial(fly, flight) for flight in flights])
    finally:
        others.terminate()
        others.wait(10)
    first, second = flown
    (one,), (other,) = first.events("started"), second.events("started")
    assert one["version"] == other["version"] == swarmctl.__version__
    assert not set(one["ports"]) & set(other["ports"])
    assert one["run"] != other["run"]


def test_operator_verbs(
    start: Start, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """In this process, except for one: test_readme.py starts most of them as the programs they are."""
    launched = start(*TWO, *AIR, "--duration", "120")
    monkeypatch.setattr(tempfile, "tempdir", str(launched.temp))
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")

    def verb(*arguments: str) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", ["swarmctl", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, int(ended.value.code or 0), said.out, said.err)

    launched.until_phase("CONNECT", 2)
    early = verb("hold")  # the estimators need four seconds more
    assert early.returncode == 4, early.stdout
    refused = r"hold: \S+\nagent-0 refuses: it is in (CONNECT|STANDBY|ARM); hold is obeyed in .*\nagent-1 refuses: "
    assert re.match(refused, early.stdout), "the run, and a line for each"
    assert early.stderr == "hold: 2 of 2 not known to obey: agent-0, agent-1\n"
    launched.until_phase("TRACK", 2)
    statuses = json.loads(verb("status", "--json").stdout)
    assert [status["agent"] for status in statuses] == [0, 1]
    for status in statuses:
        assert (status["control"], status["gps_fix"], status["satellites"]) == ("TRACKING", 3, 10)
        assert 0.5 < status["battery_01"] <= 1.0
        assert -1.0 < status["altitude_m"] < 5.0
        assert status["ground_speed_m_s"] > 0.0
        assert 0.0 < status["pos_accuracy_m"] < 5.0
        assert 0.0 <= status["link_age_ms"] < 1000.0
    held = verb("hold", "1")
    assert held.returncode == 0, held.stderr
    assert "agent-1 accepts, TRACK" in held.stdout
    assert "agent-0" not in held.stdout
    statuses = json.loads(verb("status", "--json").stdout)
    assert [(status["held"], status["control"]) for status in statuses] == [(False, "TRACKING"), (True, "HOLD")]
    sent = verb("goto", "0", "-2,0.5,-9", "--speed", "1")
    assert sent.returncode == 0, sent.stderr
    assert re.search(r"agent-0 accepts, TRACK; flies to -2, 0.5, -9: \d+\.\d m, \d+ s", sent.stdout)
    far = verb("goto", "0", "1000,2,-9")
    assert far.returncode == 4
    assert re.search(r"agent-0 refuses: 1000, 2, -9 is 10\d\d m away; beyond 500 m say --far", far.stdout)
    assert json.loads(verb("status", "--json").stdout)[0]["control"] == "GOTO"
    buried = verb("goto", "0", "-2,0.5,500")
    assert buried.returncode == 4
    assert "agent-0 refuses: down 500 m is too low" in buried.stdout
    where = ("--center", "-40,2.5,-9", "--radius", "0.5", "--run-dir", str(launched.run_dir))
    added = verb("obstacle", "add", *where)
    assert added.returncode == 0, added.stderr
    assert "0: sphere at -40.00, 2.50, -9.00  radius 0.5  keep-out 1.25  seen from 3  at rest" in added.stdout
    file = tmp_path / "obstacles.toml"
    file.write_text("[[obstacles]]\ncenter_ned_m = [-40.0, 9.0, -9.0]\n")
    assert "1: sphere at -40.00, 9.00, -9.00" in verb("obstacle", "load", str(file)).stdout
    inside = verb("goto", "0", "-40,9.5,-9")
    assert inside.returncode == 4
    assert "agent-0 refuses: -40, 9.5, -9 is in the keep-out of obstacle 1, 0.50 m from its centre" in inside.stdout
    mission = tmp_path / "mission.toml"
    mission.write_text(
        "[mission]\nkind = 'goto'\nduration_s = 120\n"
        "[mission.goto]\ngoals_ned_m = [[-40.0, 9.5, -9.0], [-40.0, 20.0, -9.0]]\n"
    )
    ends_inside = verb("mission", "set", str(mission))
    assert ends_inside.returncode == 2, "before anything is sent"
    assert "obstacles.1: the goal of agent 0 is 0.50 m from its centre" in ends_inside.stderr
    moved = verb("obstacle", "move", "0", "--velocity", "-1,0,0", "--json")
    assert moved.returncode == 0, moved.stderr
    assert json.loads(moved.stdout)[0]["vel_ned_m_s"] == [-1.0, 0.0, 0.0]
    there = json.loads(verb("obstacle", "list", "--json").stdout)
    assert [item["number"] for item in there] == [0, 1]
    assert there[0]["center_ned_m"][0] < -40.0 and there[1]["center_ned_m"][0] == -40.0, "one of them moves"
    assert "2 obstacles" in verb("obstacle", "save", str(tmp_path / "saved.toml")).stdout
    assert "1: sphere at" in verb("obstacle", "remove", "0").stdout
    unknown = verb("obstacle", "remove", "0", "7")
    assert unknown.returncode == 2
    assert unknown.stderr.count("those there are: 1") == 2
    assert "0 obstacles" in verb("obstacle", "remove", "1").stdout
    nobody = verb("hold", "7", "0", "9")
    assert nobody.returncode == 2
    assert re.findall(r"^hold: there is no agent \d; \S+ has agents 0 to 1$", nobody.stderr, re.MULTILINE)
    assert verb("exclude", "--peer", "2").returncode == 2
    resumed = json.loads(verb("resume", "--json").stdout)
    assert [(reply["agent"], reply["accepted"], reply["phase"]) for reply in resumed["agents"]] == [
        (0, True, "TRACK"),
        (1, True, "TRACK"),
    ]
    excluded = launched.verb("exclude", "--peer", "1")
    assert excluded.returncode == 4
    assert re.search(r"agent-0 refuses: agent-1 was heard \d\.\d s ago, so it has not ended", excluded.stdout)
    assert verb("exclude", "--peer", "255").returncode == 2
    landed = verb("land")
    assert landed.returncode == 0, landed.stderr
    assert re.search(r"agent-0 accepts, (GOTO_LAND|LAND)\nagent-1 accepts, (GOTO_LAND|LAND)\n", landed.stdout)
    watched = verb("status", "--watch", "--json")
    assert watched.returncode == 0, "it ends with the launch"
    seen = [status for line in watched.stdout.splitlines() for status in json.loads(line)]
    assert {status["control"] for status in seen} & {"LANDING", "AUTO"}
    assert launched.end() == 130, launched.text()


def test_bad_usage_is_refused_before_anything_starts(
    start: Start, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """In this process, except for one."""
    wrong = [
        (["--agents", "1000"], ["swarm.agents = 1000", "<= 100"]),
        (["--agents", "three"], ["--agents"]),
        (["--duration", "nan"], ["mission.duration_s", "finite"]),
        (["no/such/file.toml"], ["no/such/file.toml", "no such file"]),
        (["--set", "swarm.agnets=3"], ["did you mean 'agents'"]),
        (["--nonsense"], ["--nonsense"]),
    ]
    launched = start("--agents", "0")
    for arguments, words in wrong:
        monkeypatch.setattr(sys, "argv", ["swarmctl", "launch", *arguments, "--run-dir", str(tmp_path / "none")])
        with pytest.raises(SystemExit) as ended:
            main()
        said = "".join(capsys.readouterr())
        assert ended.value.code == 2, said
        for word in words:
            assert word in said
        assert not (tmp_path / "none").exists()
    assert launched.end(30.0) == 2, launched.text()
    for word in ("swarm.agents = 0", ">= 1"):
        assert word in launched.text()
    assert "Traceback" not in launched.text()
    assert not launched.run_dir.exists()


def test_vehicle_links_that_can_not_work_are_all_named_at_once(start: Start, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        urls = [f"udpin://127.0.0.1:{port}", "serial:///dev/no-such-device:57600"]
        vehicles = "".join(f'[[vehicles]]\nsysid = {i + 1}\nurl = "{url}"\n' for i, url in enumerate(urls))
        path = tmp_path / "vehicles.toml"
        path.write_text(f"[swarm]\nagents = 2\n[sitl]\nenabled = false\n{vehicles}")
        launched = start(str(path))
        assert launched.end(30.0) == 3
    for word in ("vehicles.0.url", str(port), "vehicles.1.url", "/dev/no-such-device does not exist"):
        assert word in launched.text()
    assert not launched.run_dir.exists()
