"""The command line: quick help, exit codes, words instead of tracebacks, options that become overrides."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import psutil
import pytest
import typer

import swarmctl
from sitl.studies.bench import command
from swarmctl.control.mpc.solvers.qp import SOLVERS
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import MISSION, OPERATOR_VERBS, Answer, OperatorVerb, Order, VerbArgument
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, MissionError, StartError, exit_code_of
from swarmctl.ops import cli, running_launches
from swarmctl.ops.orders import obstacle_list
from swarmctl.ops.orders.order_delivery import Reply
from swarmctl.ops.running_launches import RunningLaunch
from swarmctl.ops.verbs import orders
from swarmctl.simulator_config import FAULTS
from swarmctl.wall_clock import WallClock

Run = Callable[..., int]
HEAVY = ("numpy", "scipy", "osqp", "zenoh", "rerun", "pyarrow", "pydantic", "mavsdk", "pymavlink", "psutil", "msgspec")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    def runner(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["swarmctl", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert isinstance(ended.value.code, int)
        return ended.value.code

    return runner


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['swarmctl', '--help']\n"
        "import atexit; from swarmctl.ops import cli\n"
        f"atexit.register(lambda: print('heavy:', [m for m in {HEAVY!r} if m in sys.modules]))\ncli.main()"
    )
    times_s = []  # of the processor: what a loaded machine adds by waiting is not ours
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times_s.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        assert "heavy: []" in answer.stdout
    assert min(times_s) < 0.4


@pytest.mark.parametrize("module", ["swarmctl.config", "swarmctl.ops.flight.launch", "swarmctl.telemetry.view.viewer"])
def test_a_process_that_makes_no_plans_loads_no_solver(module: str) -> None:
    """With scipy, which comes with them, they take 0.3 s of the processor; agents load them before they fly."""
    code = f"import sys, {module}; print([name for name in ('scipy', 'osqp', 'daqp') if name in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "more",
    [
        ("mission.kind=swap",),
        ("mission.kind=swap", "separation.mode=guaranteed"),
        ("mission.kind=circle", "mission.circle.goal_assignment=true"),  # as over real autopilots
    ],
)
def test_an_agent_loads_nothing_more_once_it_is_made(more: tuple[str, ...]) -> None:
    """A module that is loaded amid a flight costs ticks."""
    code = f"""if True:
        import sys
        from sitl.lockstep import Lockstep
        from swarmctl.config import load
        sets = ("swarm.agents=2", "sitl.start=air", "agent.rate_hz=25", "sitl.physics_hz=100", "mission.duration_s=3")
        flight = Lockstep(load(None, (*sets, *{more!r})))
        before = set(sys.modules)
        flight.run()
        assert not flight.problems()
        print(sorted(set(sys.modules) - before))
        print([name for name in ("scipy", "osqp") if name in sys.modules])"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert answer.stdout.split() == ["[]", "[]"]  # SciPy and OSQP are 20 to 37 MiB more in each agent that uses DAQP


@pytest.mark.parametrize(
    ("module", "options"),
    [
        ("sitl.studies.thesis.command", ("--only", "--plant", "--full", "--out", "--jobs")),
        ("sitl.studies.bench.command", ("--out", "--neighbours", "--solver", "--ticks", "--slsqp", "--no-slsqp")),
    ],
)
def test_help_of_studies_names_every_option_and_imports_nothing_heavy(module: str, options: tuple[str, ...]) -> None:
    code = f"""if True:
        import atexit, runpy, sys
        heavy = lambda: [name for name in ("sitl.lockstep", *{HEAVY!r}, "rich") if name in sys.modules]
        atexit.register(lambda: print("heavy:", heavy()))
        sys.argv = ["x", "--help"]
        runpy.run_module({module!r}, run_name="__main__")"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert "heavy: []" in answer.stdout
    assert [option for option in options if option not in answer.stdout] == []


def test_the_solvers_of_bench_are_those_there_are() -> None:
    assert tuple(SOLVERS) == command.SOLVERS


def test_every_verb_is_there_and_explains_itself(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    verbs = [
        "launch",
        "simulate",
        "check",
        "agent",
        "status",
        "hold",
        "resume",
        "land",
        "rtl",
        "view",
        "replay",
        "report",
        "bundle",
    ]
    for verb in [*verbs, "obstacle"]:
        assert run(verb, "--help") == 0
        assert f"{verb} " in capsys.readouterr().out
    for verb in ("add", "move", "remove", "list", "load", "save"):
        assert run("obstacle", verb, "--help") == 0


@pytest.mark.parametrize(
    ("arguments", "unit"),
    [
        (("launch",), "Duration of the mission [s]"),
        (("check",), "Time to listen to each vehicle [s]"),
        (("fault",), "[deg from north]"),
        (("obstacle", "add"), "Velocity, shared NED [m/s]"),
    ],
)
def test_help_keeps_units_in_brackets(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], unit: str
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert run(*arguments, "--help") == 0
    assert unit in " ".join(capsys.readouterr().out.split())


def test_rtl_help_says_that_the_agent_flies_home(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("rtl", "--help") == 0
    assert "own MPC, then land" in " ".join(capsys.readouterr().out.split())


def test_a_verb_of_the_operator_has_an_option_for_each_argument(
    capsys: pytest.CaptureFixture[str],
) -> None:
    given: list[tuple[Order, str | None, list[int], bool]] = []

    def give(order: Order, run: str | None, agents: list[int], as_json: bool) -> int:
        given.append((order, run, agents, as_json))
        return 7

    app = typer.Typer(rich_markup_mode=None)
    height = VerbArgument(name="height_m", option="--height", help="Height [m].", least=0.5, most=20.0)
    for name, arguments in (("climb", (height,)), ("hold", ())):
        orders.add_operator_verb(app, name, OperatorVerb(help="Do.", phases=frozenset(), arguments=arguments), give)
    assert app(["climb", "--height", "2.5", "--agent", "1", "--run-dir", "r"], standalone_mode=False) == 7
    assert app(["hold"], standalone_mode=False) == 7
    assert app(["hold", "0", "2", "--agent", "1", "--run", "circle", "--json"], standalone_mode=False) == 7
    assert given == [
        (Order("climb", {"height_m": 2.5}), "r", [1], False),
        (Order("hold"), None, [], False),
        (Order("hold"), "circle", [0, 2, 1], True),
    ]
    for wrong in (["climb"], ["climb", "--height", "20.5"], ["climb", "--height", "x"], ["hold", "--height", "1"]):
        with pytest.raises(SystemExit) as ended:
            app(wrong)
        assert ended.value.code == 2
    assert len(given) == 3
    capsys.readouterr()
    app(["climb", "--help"], standalone_mode=False)
    assert "Height [m]." in capsys.readouterr().out


def test_answers_name_everybody_and_why_once_and_the_exit_code_stays(capsys: pytest.CaptureFixture[str]) -> None:
    replies = [
        Reply(agent=0, verb="hold", answer=Answer("hold", 5, accepted=True), phase=Phase.TRACK),
        Reply(agent=1, verb="hold", answer=Answer("hold", 5, accepted=False, reason="it is in LAND"), phase=Phase.LAND),
        Reply(agent=2, verb="hold", answer=None),
    ]
    failed = "hold: 2 of 3 not known to obey: agent-1, agent-2"
    with pytest.raises(MissionError, match=f"^{failed}$"):
        orders.told("hold", "circle-1a", lambda: replies, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert [agent.pop("comes_to") for agent in printed["agents"]] == ["", "", ""]
    assert printed == {
        "run": "circle-1a",
        "order": "hold",
        "agents": [
            {"agent": 0, "accepted": True, "phase": "TRACK", "problem": ""},
            {"agent": 1, "accepted": False, "phase": "LAND", "problem": "agent-1 refuses: it is in LAND"},
            {"agent": 2, "accepted": None, "phase": None, "problem": "agent-2 did not answer within 5 s"},
        ],
    }
    assert orders.told("hold", "circle-1a", lambda: replies[:1]) == 0
    assert capsys.readouterr().out == "hold: circle-1a\nagent-0 accepts, TRACK\n"
    with pytest.raises(MissionError, match=f"^{failed}$"):
        orders.told("hold", "circle-1a", lambda: replies)
    assert capsys.readouterr().out.count("agent-1 refuses: it is in LAND\n") == 1, "why is said once"


def test_what_an_accepted_order_comes_to_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    answer = Answer("goto", 5, accepted=True, reason="flies to 1, 2, -3: 4.0 m, 6 s\x1b[2J")
    replies = [Reply(agent=0, verb="goto", answer=answer, phase=Phase.TRACK)]
    orders.told("goto", "circle-1a", lambda: replies)
    assert capsys.readouterr().out.endswith("agent-0 accepts, TRACK; flies to 1, 2, -3: 4.0 m, 6 s\\x1b[2J\n")
    orders.told("goto", "circle-1a", lambda: replies, as_json=True)
    assert json.loads(capsys.readouterr().out)["agents"][0]["comes_to"].startswith("flies to 1, 2, -3")


def test_far_is_an_argument_of_goto_only_where_it_is_said(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Order] = []

    def give(order: Order, *rest: object) -> int:
        given.append(order)
        return 0

    monkeypatch.setattr(orders, "_give", give)
    assert run("goto", "1", "1000,2,-3") == 0
    assert run("goto", "1", "-1000,2,-3", "--far") == 0
    assert [order.arguments.get("far") for order in given] == [None, 1.0]


def test_every_verb_that_acts_on_a_launch_prints_json_too(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    verbs = [[name] for name in OPERATOR_VERBS if name != MISSION] + [["mission", "set"], ["status"], ["fault"]]
    verbs += [["obstacle", name] for name in ("add", "move", "remove", "list", "load", "save")]
    for verb in verbs:
        assert run(*verb, "--help") == 0
        assert "--json" in capsys.readouterr().out, verb


def test_version_is_printed(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out == f"swarmctl {swarmctl.__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        *[("lanch",), ("launch", "--agents", "x"), ("launch", "--nonsense"), ("agent",), ("launch", "a", "b")],
        *[("replay",), ("replay", "no-such-folder"), ("replay", "no-such-folder", "--web")],
    ],
)
def test_bad_usage_is_2(run: Run, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]) -> None:
    assert run(*arguments) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"), [(b"garbage\n", "is no recording of rerun"), (b"", "is empty: nothing was recorded")]
)
@pytest.mark.parametrize("shown", ["--web", "window"])
def test_what_is_no_recording_is_not_shown(
    run: Run,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    shown: str,
    content: bytes,
    said: str,
) -> None:
    """Its page was served, with nothing on it."""
    (tmp_path / "telemetry.rrd").write_bytes(content)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("it was given to rerun"))
    assert run("replay", str(tmp_path), *(["--web"] if shown == "--web" else [])) == 2
    assert capsys.readouterr().err == f"{tmp_path}/telemetry.rrd: {said}\n"


@pytest.mark.parametrize("verb", [("report",), ("replay",), ("export", "--mcap"), ("bundle",), ("replay", "--decide")])
def test_a_file_of_a_run_is_no_run_folder_and_which_is_is_said(
    run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path, verb: tuple[str, ...]
) -> None:
    recording = tmp_path / "telemetry.rrd"
    recording.touch()
    assert run(*verb, str(recording)) == 2
    assert capsys.readouterr().err == f"{recording}: is a file. Give the run folder that it is in\n"


@pytest.mark.usefixtures("nobody")
def test_kinds_of_faults_are_listed_without_a_launch_too(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fault", "nonsense") == 2
    said = capsys.readouterr().err
    assert all(kind in said for kind in FAULTS)
    assert run("fault", "gps_loss") == 3
    assert "no launch runs" in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("--web",)])
def test_a_folder_without_a_recording_is_bad_usage_with_and_without_a_display(
    run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path, options: tuple[str, ...]
) -> None:
    """It was told to open a file, which is not there, on a computer with a display."""
    assert run("replay", str(tmp_path), *options) == 2
    assert "holds no telemetry.rrd" in capsys.readouterr().err


def test_what_decides_again_serves_no_page(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("replay", "run", "--decide", "--web") == 2
    assert "--web" in capsys.readouterr().err, "it was ignored"


@pytest.mark.parametrize(
    ("error", "code"), [(ConfigError("file", ["a", "b"]), 2), (StartError("no"), 3), (MissionError("hit"), 4)]
)
def test_expected_errors_are_words_and_their_exit_code(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, error: Exception, code: int
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(running_launches, "find_launch", fail)
    assert run("status") == code
    captured = capsys.readouterr()
    assert captured.err == f"{error}\n"


def test_a_page_of_a_launch_without_a_view_is_refused_before_anything_starts(
    run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    assert run("launch", "--web", "--set", "telemetry.enabled=false", "--run-dir", str(folder)) == 2
    assert capsys.readouterr().err == "--web: telemetry.enabled = false: there is no view\n"
    assert not folder.exists()


def test_errors_control_no_terminal(run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    hostile = str(tmp_path / "\x1b]0;owned\x07\x9b2J\u202e")
    assert run("land", "--run-dir", hostile) == 3

    def study() -> int:
        raise StartError(f"{hostile}: no such thing")

    assert exit_code_of(study) == 3
    said = capsys.readouterr().err
    assert said.count(r"\x1b]0;owned\x07\x9b2J\u202e") == 2
    assert all(c.isprintable() or c == "\n" for c in said)


def test_unexpected_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("bug")

    monkeypatch.setattr(running_launches, "find_launch", fail)
    monkeypatch.setattr(sys, "argv", ["swarmctl", "status"])
    with pytest.raises(ZeroDivisionError, match="bug"):
        cli.main()


@pytest.mark.parametrize("verb", ["status", "hold", "resume", "land", "rtl", "view"])
@pytest.mark.usefixtures("nobody")
def test_without_a_launch_operator_verbs_are_3(run: Run, capsys: pytest.CaptureFixture[str], verb: str) -> None:
    assert run(verb) == 3
    assert "swarmctl launch" in capsys.readouterr().err


def test_a_run_folder_without_a_launch_is_3(run: Run, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run("land", "--run-dir", str(tmp_path)) == 3
    assert str(tmp_path) in capsys.readouterr().err


def test_options_override_sets_and_simulate_passes_everything_on(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli._overrides(4, 5.5, 6, ["swarm.agents=2", "a=b"]) == [
        "swarm.agents=2",
        "a=b",
        "swarm.agents=4",
        "mission.duration_s=5.5",
        "seed=6",
    ]
    passed: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(os, "execv", lambda program, arguments: passed.append((program, arguments)))
    assert (
        run(
            "simulate",
            "a.toml",
            "--agents",
            "4",
            "--seed",
            "6",
            "--set",
            "a=b",
            "--set",
            "c=d",
            "--jobs=2",
            "--no-view",
        )
        == 0
    )
    module = [sys.executable, "-m", "sitl.verb", "sitl.simulate"]
    assert passed == [
        (
            sys.executable,
            [*module, "a.toml", "--agents=4", "--seed=6", "--jobs=2", "--set=a=b", "--set=c=d", "--no-view"],
        )
    ]


def test_a_reader_that_goes_away_does_not_change_the_exit_code() -> None:
    code = (
        "import sys; from swarmctl.ops import cli\nfrom swarmctl.ops.supervision import status_table\n"
        "cli._run_app = lambda: status_table.PlainLines(sys.stdout).print_line('landed') or 4\ncli.main()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(60) == 4


def test_obstacles_are_read_strictly() -> None:
    ball = obstacle_list.obstacle("1.5,0,-2", 0.5, 1.0, 3.0, velocity="0,0,0.1")
    assert ball == Obstacle(
        center_ned_m=(1.5, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0, visibility_m=3.0, vel_ned_m_s=(0.0, 0.0, 0.1)
    )
    assert obstacle_list.obstacle("1.5,0,-2", 0.5, 1.0, 3.0, velocity="0,0,0.1", column=True).column
    with pytest.raises(ConfigError) as caught:
        obstacle_list.obstacle("1,2", -1.0, float("nan"), 3.0, velocity="0,inf,0")
    assert [problem.split()[0] for problem in caught.value.problems] == [
        "--center",
        "--radius",
        "--keep-out",
        "--velocity",
    ]


def test_an_obstacle_that_agents_would_fly_into_is_not_added() -> None:
    for sizes_m, problems in (
        ((3.0, 1.75, 3.0), ("--keep-out 1.75: less than radius_m = 3,", "--visibility 3.0: agents would see it only")),
        (
            (2.5, 3.25, 3.0),
            ("--visibility 3.0: agents would see it only when they are in its keep_out_m = 3.25; allowed",),
        ),
    ):
        with pytest.raises(ConfigError) as caught:
            obstacle_list.obstacle("1.5,0,-2", *sizes_m, velocity="0,0,0")
        assert len(caught.value.problems) == len(problems)
        assert all(said.startswith(begin) for said, begin in zip(caught.value.problems, problems, strict=True))


@pytest.mark.usefixtures("nobody")
def test_the_registry_knows_live_launches_and_forgets_dead_ones(tmp_path: Path) -> None:
    registry, folder = tmp_path / f"swarmctl-{os.getuid()}", tmp_path / "run"
    folder.mkdir()
    started_s, pid = running_launches.process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(folder))
    running_launches.announce(launch)
    assert registry.stat().st_mode & 0o777 == 0o700
    assert running_launches.find_launch(None) == launch
    assert running_launches.find_launch(str(folder)) == launch
    running_launches.announce(RunningLaunch("reused pid", "unixsock-stream//x", pid, started_s - 60, 3, str(folder)))
    with pytest.raises(StartError):
        running_launches.find_launch(str(folder))
    with pytest.raises(StartError):
        running_launches.find_launch(None)
    assert list(registry.iterdir()) == []


@pytest.mark.usefixtures("nobody")
def test_a_launch_is_found_after_the_computers_clock_has_stepped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    started_s, pid = running_launches.process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(tmp_path))
    running_launches.announce(launch)
    booted_s = psutil.boot_time()
    before_s = psutil.Process().create_time()
    monkeypatch.setattr("psutil._pslinux.boot_time", lambda: booted_s + 3600.0)
    assert psutil.Process().create_time() == pytest.approx(before_s + 3600.0), "a step moves both"
    assert running_launches.find_launch(None) == launch


def test_verbs_have_the_clock_of_the_launch_after_the_computers_has_stepped(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = WallClock()
    launch = RunningLaunch("run", "unixsock-stream//x", 1, 0.0, 3, "x", utc_ahead_us=clock.utc_ahead_us())
    before_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: before_ns() + 95 * 10**9)
    assert launch.utc_us() == pytest.approx(before_ns() // 1000, abs=1_000_000)
    told_none = RunningLaunch("run", "unixsock-stream//x", 1, 0.0, 3, "x")
    assert told_none.utc_us() == pytest.approx(time.time_ns() // 1000, abs=1_000_000)


@pytest.mark.usefixtures("nobody")
def test_a_note_that_cannot_be_written_stops_neither_the_flight_nor_the_others(tmp_path: Path) -> None:
    started_s, pid = running_launches.process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(tmp_path / "gone"))
    running_launches.announce(launch)
    assert running_launches.find_launch(None) == launch


@pytest.mark.timeout(20)
def test_a_note_in_a_received_folder_that_is_none_is_no_launch(tmp_path: Path) -> None:
    note = tmp_path / running_launches.LAUNCH_FILE
    for content in (b"{", b"[]", b'{"run": 1}', b"\xff\xfe", b"[" * 100_000):
        note.write_bytes(content)
        with pytest.raises(StartError, match="no launch runs there"):
            running_launches.find_launch(str(tmp_path))
    note.unlink()
    os.mkfifo(note)
    with pytest.raises(StartError, match="no launch runs there"):
        running_launches.find_launch(str(tmp_path))


def squat_open(place: Path) -> None:
    place.mkdir()
    place.chmod(0o777)


def squat_of_another(place: Path) -> None:
    place.mkdir(mode=0o700)
    os.chown(place, 12345, 12345)


def squat_file(place: Path) -> None:
    place.write_text("")
    place.chmod(0o600)


def squat_link(place: Path) -> None:
    (place.parent / "elsewhere").mkdir(mode=0o700)
    place.symlink_to(place.parent / "elsewhere")


@pytest.mark.parametrize("squat", [squat_open, squat_of_another, squat_file, squat_link])
@pytest.mark.parametrize("at_launch", [True, False], ids=["runtime directory at launch", "none at launch"])
@pytest.mark.parametrize("at_verb", [True, False], ids=["runtime directory at the verb", "none at the verb"])
def test_a_launch_and_its_verbs_find_each_other_although_another_user_takes_the_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, squat: Callable[[Path], None], at_launch: bool, at_verb: bool
) -> None:
    temporary, runtime, folder = tmp_path / "tmp", tmp_path / "runtime", tmp_path / "run"
    for place in (temporary, runtime, folder):
        place.mkdir(mode=0o700)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    if squat is squat_of_another and os.getuid() != 0:
        pytest.skip("only root can give a directory away")
    squat(temporary / f"swarmctl-{os.getuid()}")
    started_s, pid = running_launches.process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(folder))
    forged = RunningLaunch("forged", "unixsock-stream//evil", pid, started_s + 0.5, 3, str(folder))
    if squat is not squat_file:
        (temporary / f"swarmctl-{os.getuid()}" / "1.json").write_bytes(msgspec.json.encode(forged))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime) if at_launch else "")
    running_launches.announce(launch)
    running_launches.announce(launch)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime) if at_verb else "")
    assert running_launches.find_launch(None) == launch
    running_launches.withdraw()
    if at_launch == at_verb:
        with pytest.raises(StartError):
            running_launches.find_launch(None)
    assert len(list(temporary.glob("swarmctl-*"))) == 2, "one more, not one each time"


def test_a_launch_is_found_whose_temporary_folder_is_full_by_now(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where another disk had room, verbs looked there only."""
    first, second, folder = tmp_path / "first", tmp_path / "second", tmp_path / "run"
    for place in (first, second, folder):
        place.mkdir(mode=0o700)
    monkeypatch.setenv("TMPDIR", str(first))
    monkeypatch.setenv("TEMP", str(second))
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(first))
    started_s, pid = running_launches.process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(folder))
    running_launches.announce(launch)
    monkeypatch.setattr(tempfile, "tempdir", str(second))
    assert running_launches.find_launch(None) == launch
    running_launches.withdraw()
    assert not list(first.glob("*/*.json"))


def test_a_runtime_directory_of_another_user_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As after `su` or `sudo -E`."""
    temporary, runtime, folder = tmp_path / "tmp", tmp_path / "runtime", tmp_path / "run"
    for place in (temporary, runtime, folder):
        place.mkdir(mode=0o700)
    runtime.chmod(0o755)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    started_s, pid = running_launches.process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(folder))
    running_launches.announce(launch)
    assert list(runtime.iterdir()) == []
    assert running_launches.find_launch(None) == launch


@pytest.mark.usefixtures("nobody")
def test_with_several_launches_one_is_chosen_by_name_or_folder(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    started_s, pid = running_launches.process_start_s()
    circle = RunningLaunch("circle-1a", "unixsock-stream//x", pid, started_s, 3, str(tmp_path / "first"))
    swap = RunningLaunch("swap-2b", "unixsock-stream//y", os.getppid(), started_s, 6, str(tmp_path / "second"))
    (tmp_path / "second").mkdir()
    monkeypatch.setattr(running_launches, "runs", lambda launch: launch.run != "dead")
    for launch in (circle, swap):
        running_launches.announce(launch)
    assert running_launches.find_launch("circle") == circle
    assert running_launches.find_launch("swap-2b") == swap
    assert running_launches.find_launch(str(tmp_path / "second")) == swap
    for arguments in (("hold",), ("status",), ("fault", "gust"), ("exclude", "--peer", "1"), ("obstacle", "list")):
        assert run(*arguments) == 2, arguments
        (said,) = capsys.readouterr().err.splitlines()
        assert "2 launches run" in said
        assert f" circle-1a (3 agents, {tmp_path / 'first'})" in said
        assert f" swap-2b (6 agents, {tmp_path / 'second'})" in said
        assert "\\n" not in said
    with pytest.raises(StartError, match=r"running: .*circle-1a"):
        running_launches.find_launch("line")
