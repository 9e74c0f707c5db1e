"""Every command of README.md and docs/ is run as it stands, only shortened and kept off the screen.

What is launched is shortened by `--duration`, and by a ground no more than a metre below the start; what is simulated
by `--duration` and a start in the air. Both are flown at half the rate, `COARSE`, on which no command depends. The
launch that is shown with a configuration is the whole mission of test_launch.py, at the rates that are configured.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from sitl.studies.bench.ticks import PARTS
from swarmctl.config import load
from swarmctl.control.mpc.solvers.qp import SOLVERS
from swarmctl.core.types import Landed
from swarmctl.telemetry.recording.run_files import load_run
from tests.benches.at_once import at_once

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
RUN_ELSEWHERE = ("configuration.md", "real_autopilots.md")  # the latter shows how to run tests with your own builds
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").glob("*.md") if p.name not in RUN_ELSEWHERE)]
FENCED = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
LINES = [line for page in PAGES for line in FENCED.sub("", page.read_text()).splitlines()]
SHOWN = [line.strip() for line in LINES if re.match(r"    (swarmctl|python3?) ", line)]
BIN = Path(sys.executable).parent
WHILE_FLYING = (("status", "hold"), ("obstacle", "fault", "resume"), ("mission",), ("land",))  # near the start
AFTERWARDS = ("report", "replay", "export")
COARSE = ("--set=sitl.physics_hz=100", "--set=agent.rate_hz=25")
CAMPAIGN = r"^swarmctl campaign "  # is run by tests/closed_loop/test_campaign.py


def shown(pattern: str) -> list[str]:
    return [line for line in SHOWN if re.search(pattern, line)]


def run(line: str, *more: str, timeout_s: float = 400.0, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command, *arguments = shlex.split(line)
    return subprocess.run(
        [str(BIN / command), *arguments, *more],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}


def low(line: str) -> str:
    """Return the option that puts the ground 1 m below where a command's flight starts."""
    return f"--set=sitl.ground_z_m={-1 if '.toml' in line else 1}"


def landed(directory: Path) -> dict[int, bool]:
    """Whether each vehicle of a run folder ended on the ground, in truth."""
    truth = load_run(directory).truth
    return {
        int(v): bool(truth["landed"][truth["vehicle"] == v][-1] == Landed.ON_GROUND)
        for v in np.unique(truth["vehicle"])
    }


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which every `config init` of the pages was run; built-in files are where they are in a checkout."""
    folder = tmp_path_factory.mktemp("begun")
    (folder / "configs").symlink_to(ROOT / "configs")
    for line in shown(r"^swarmctl config init "):
        done = run(line, folder=folder)
        assert done.returncode == 0, done.stderr
    return folder


def test_nothing_is_shown_that_is_not_run() -> None:
    verbs = [*itertools.chain(*WHILE_FLYING), *AFTERWARDS]
    run_here = shown(r"^swarmctl (launch|simulate) ") + shown(rf"^swarmctl ({'|'.join(verbs)})\b")
    run_here += (
        shown(r"^python -m sitl ")
        + shown(r"^python3 -m venv ")
        + shown(r"^swarmctl (reproduce|bench|check) ")
        + shown(CAMPAIGN)
        + shown(r"^swarmctl (config|keys) ")
        + shown(r"^swarmctl sweep ")
        + shown(r"^swarmctl (host|station) ")  # by tests/process/test_hosts.py, as `keys init`
    )
    assert sorted(run_here) == sorted(SHOWN)
    assert len(set(SHOWN)) == len(SHOWN), "shown once, so that it is run once"
    fenced = "\n".join(block for page in PAGES for block in FENCED.findall(page.read_text()))
    assert not re.search(r"^\s*(swarmctl|python3?) ", fenced, re.MULTILINE), "commands are indented, not fenced"


def test_the_two_set_up_lines_install_what_they_use() -> None:
    """Their flight and their tests are run by everything else here and by .ci/run; here: that the parts exist."""
    fly, test = SHOWN[:2]
    for line in (fly, test):
        assert line.startswith("python3 -m venv .venv && .venv/bin/pip install -q -c constraints.txt ")
    assert fly.endswith("&& .venv/bin/swarmctl launch --agents 3")
    assert test.endswith("&& .venv/bin/python -m pytest -q -n 3")
    assert "://" not in (ROOT / "constraints.txt").read_text()


@pytest.mark.parametrize("line", shown(r"^swarmctl simulate "))
def test_simulations(line: str, begun: Path, tmp_path: Path) -> None:
    shorter = ("--duration", "2", "--set=sitl.start=air", *COARSE)
    done = run(line, *shorter, "--run-dir", str(tmp_path / "run"), folder=begun)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "x real time" in done.stdout


def test_looking_up_and_beginning_a_configuration(begun: Path) -> None:
    (show,) = shown(r"^swarmctl config show ")
    assert "sitl.wind.mean_ned_m_s = [0.0, 0.0, 0.0]  # velocity of the air" in run(show).stdout
    assert load(begun / "x500_circle.toml") == load(ROOT / "configs" / "x500_circle.toml")
    assert {path.name for path in begun.iterdir()} > {"six_goals.toml", "own_pid.py", "figure_8.csv"}


def test_new_keys(tmp_path: Path) -> None:
    (line,) = shown(r"^swarmctl keys new ")
    *command, alpha, bravo, charlie = shlex.split(line)
    files = [tmp_path / name for name in (alpha, bravo, charlie)]
    assert run(shlex.join([*command, *map(str, files)])).returncode == 0
    assert len({path.read_text() for path in files}) == 3
    config = load(None, ("swarm.agents=3", f"mavlink.signing_keys={[str(path) for path in files]}"))
    assert config.mavlink.signing_keys == tuple(map(str, files))


def test_a_sweep_has_a_row_for_each_combination_and_charts(tmp_path: Path) -> None:
    (line,) = shown(r"^swarmctl sweep ")
    shorter = ("mission.duration_s=1", "sitl.start=air", "swarm.agents=1")
    done = run(line, *(f"--set={item}" for item in shorter), "--jobs", "1", "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = pq.read_table(tmp_path / "out" / "rows.parquet").to_pylist()
    index_m = {(row["sitl.mass_scale"], row["mission.circle.radius_m"]): row["index_m"] for row in rows}
    assert sorted(index_m) == [(1, 3), (1, 5), (1.25, 3), (1.25, 5)]
    assert {row["outcome"] for row in rows} == {"completed"}
    for mass_scale in (1, 1.25):
        assert index_m[mass_scale, 5] > 1.3 * index_m[mass_scale, 3], "it begins in the centre of the circle"
    assert "<svg" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("line", shown(r"^swarmctl reproduce "))
def test_experiments(line: str, tmp_path: Path) -> None:
    done = run(line, "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out" / "reproduce.json").exists()


@pytest.mark.parametrize("line", shown(r"^swarmctl bench "))
def test_timing(line: str, tmp_path: Path) -> None:
    done = run(line, "--out", str(tmp_path / "new"))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "new" / "bench.json").read_text(encoding="utf-8"))
    assert isinstance(rows, list)
    for row in rows:
        assert row.keys() == {"name", "solver", "neighbours", "p50_ms", "p99_ms"}
        assert 0.0 <= row["p50_ms"] <= row["p99_ms"]
    found = {(row["name"], row["solver"], row["neighbours"]) for row in rows}
    assert len(found) == len(rows)
    expected = {(part, solver, count) for part in PARTS for solver in SOLVERS for count in (0, 2)}
    scenarios = (", swap", ", guaranteed", ", 1 obstacle")
    expected |= {(part + scenario, solver, 2) for part in PARTS for solver in SOLVERS for scenario in scenarios}
    assert {key for key in found if "x-y" not in key[0]} == expected
    assert "one tick" in done.stdout
    assert {row["solver"] for row in rows if "nonlinear" in row["name"]} == {"slsqp"}


def test_a_launch_its_operator_and_what_is_left(tmp_path: Path) -> None:
    (line,) = shown(r"^swarmctl launch --agents 3$")
    directory = tmp_path / "run"
    command, *arguments = shlex.split(line)
    flying = subprocess.Popen(
        [
            str(BIN / command),
            *arguments,
            "--no-view",
            "--duration",
            "60",
            low(line),
            *COARSE,
            "--run-dir",
            str(directory),
        ],
        cwd=ROOT,
        env=environment() | {"TMPDIR": str(tmp_path)} if len(str(tmp_path)) < 40 else environment(),
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert flying.stdout is not None
        for said in flying.stdout:
            if "TRACK" in said:
                break
        for verbs in WHILE_FLYING:
            at_once([partial(operate, verb, directory) for verb in verbs])
        rest = flying.stdout.read()
        assert flying.wait(100) == 130, rest
        assert landed(directory) == {0: True, 1: True, 2: True}
    finally:
        flying.kill()
    (directory / "report.html").unlink()
    for report in shown(r"^swarmctl report "):
        done = run(re.sub(r"runs/\w+", str(directory), report))
        assert done.returncode == 0, done.stderr
    assert (directory / "report.html").exists()
    assert any((directory / "figures").glob("*.svg"))
    assert (directory.parent / "run-against-run.html").exists()
    (export,) = shown(r"^swarmctl export ")
    assert run(export.replace("runs/DIR", str(directory))).returncode == 0
    assert directory.with_name("run.mcap").stat().st_size > 100_000
    (replay,) = shown(r"^swarmctl replay ")
    refused = run(replay.replace("runs/DIR", str(directory)))
    assert refused.returncode == 3
    assert "no display" in refused.stderr


def test_own_reference_and_own_controller_are_launched(begun: Path, tmp_path: Path) -> None:
    """The file is flown as it is shown, by one agent, and by a controller that each agent process has to find."""
    (line,) = shown(r"^swarmctl launch figure_8.toml")
    directory = tmp_path / "run"
    own = ("--set=controller.kind=own_pid:Pid", "--set=sitl.start=air", "--agents", "1", "--no-view")
    done = run(line, *own, "--duration", "2", low(line), "--run-dir", str(directory), folder=begun)
    assert done.returncode == 0, done.stdout + done.stderr
    (directory / "config.toml").rename(tmp_path / "config.toml")
    flown = load(tmp_path / "config.toml")
    assert flown.controller.is_own and flown.mission.kind == "csv"
    summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    assert summary["tracking"]["agents"][0]["rmse_m"] < 0.1
    (own,) = summary["own_controllers"]
    assert own["name"] == "own_pid:Pid" and 0 < own["flown_ticks"] <= own["mission_ticks"]
    assert f"own_pid:Pid flew {own['flown_ticks']} of {own['mission_ticks']} mission ticks" in done.stdout
    events = "".join(path.read_text(encoding="utf-8") for path in directory.glob("*events.jsonl"))
    assert '"TRACK"' in events and "controller_failed" not in events


def operate(verb: str, directory: Path) -> None:
    (order,) = shown(rf"^swarmctl {verb}\b")
    done = run(order, "--run-dir", str(directory))
    assert done.returncode == 0, f"{order}: {done.stdout}{done.stderr}"


def test_vehicles_of_another_process(tmp_path: Path) -> None:
    (simulator,) = shown(r"^python -m sitl ")
    (line,) = shown(r"^swarmctl launch configs/px4_udp")
    command, *arguments = shlex.split(simulator)
    vehicles = subprocess.Popen(
        [str(BIN / command), *arguments, "--physics-hz", "100"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert vehicles.stdout is not None
        ports: list[int] = []
        while len(ports) < 3:
            ports += map(int, re.findall(r"remote=(\d+)", vehicles.stdout.readline()))
        urls = [f"--set=vehicles.{i}.url=udpin://127.0.0.1:{port}" for i, port in enumerate(ports)]
        (check,) = shown(r"^swarmctl check (?!.*--identify)")  # what flies is run by tests/process/test_check.py
        asked = run(check, "--apply", *urls)
        assert asked.returncode == 4, "the simulator's vehicles stand 1 m apart, the configuration keeps 1.5 m"
        assert "stand closer than they may fly" in asked.stdout
        assert "COM_OBL_RC_ACT: 0 -> 4" in asked.stdout
        near = "--set=start.center_ned_m=[0,0,-1]"  # above the ground of those vehicles
        shorter = ("--no-view", "--duration", "2", near, *COARSE)
        done = run(line, *shorter, "--run-dir", str(tmp_path / "run"), *urls)
        assert done.returncode == 0, done.stdout + done.stderr
    finally:
        vehicles.terminate()
        vehicles.wait(10)
