"""`swarmctl bundle` as a user calls it: what is in the archive, and what can't be had from a vehicle."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from sitl.studies.bench.free_ports import free_ports
from tests.process.test_check import ENV, Simulator

pytestmark = pytest.mark.process


def bundle(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "swarmctl", "bundle", str(folder), *arguments]
    return subprocess.run(command, cwd=folder.parent, env=ENV, capture_output=True, text=True, timeout=120)


def run_folder(parent: Path, config: str) -> Path:
    folder = parent / "a-run"
    folder.mkdir()
    (folder / "config.toml").write_text(config)
    (folder / "agent-0.parquet").write_bytes(b"PAR1")
    (folder / "elsewhere").symlink_to("/etc/hostname")
    return folder


def test_a_run_of_the_built_in_simulator_is_packed_without_asking_anybody(tmp_path: Path) -> None:
    done = bundle(run_folder(tmp_path, "[swarm]\nagents = 1\n"))
    why = "no logs of agent-0: the built-in simulator keeps no logs"
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'a-run.zip'}\n{why}\n")
    with zipfile.ZipFile(tmp_path / "a-run.zip") as archive:
        files = ["a-run/agent-0.parquet", "a-run/config.toml", "vehicles.json", "versions.json"]
        assert sorted(archive.namelist()) == files, "a link may lead anywhere"
        assert archive.read("a-run/agent-0.parquet") == b"PAR1"
        assert {"swarmctl", "python", "osqp", "mavsdk"} <= json.loads(archive.read("versions.json")).keys()
        assert "built-in simulator" in json.loads(archive.read("vehicles.json"))["agent-0"]["problem"]


def test_an_archive_in_the_run_folder_holds_no_archive(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "[swarm]\nagents = 1\n")
    for _ in range(2):  # the second one replaces what the first has written
        done = bundle(folder, "--output", "a-run/b.zip")
        assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(folder / "b.zip") as archive:
        files = ["a-run/agent-0.parquet", "a-run/config.toml", "vehicles.json", "versions.json"]
        assert sorted(archive.namelist()) == files


def test_what_can_not_be_had_from_a_vehicle_is_named(tmp_path: Path) -> None:
    simulator = Simulator(1)
    try:
        simulator.wait_until_up()
        ports = [simulator.ports[0], free_ports(1)[0]]
        vehicles = "".join(f'[[vehicles]]\nsysid={i}\nurl="udpin://127.0.0.1:{p}"\n' for i, p in enumerate(ports, 1))
        folder = run_folder(tmp_path, f"[swarm]\nagents = 2\n[sitl]\nenabled = false\n{vehicles}")
        done = bundle(folder, "--output", str(tmp_path / "b.zip"))
        assert done.returncode == 0, done.stderr
        with zipfile.ZipFile(tmp_path / "b.zip") as archive:
            told = json.loads(archive.read("vehicles.json"))
        assert told == {"agent-0": {"problem": "it tells no logs"}, "agent-1": {"problem": "nothing is heard"}}
    finally:
        simulator.stop()


def test_of_vehicles_that_sign_it_says_that_it_has_no_logs_and_reads_no_key(tmp_path: Path) -> None:
    vehicles = "".join(f'[[vehicles]]\nsysid={i}\nurl="udpin://127.0.0.1:{i}"\n' for i in (1, 2))
    keys = '[mavlink]\nsigning_keys = ["/etc/shadow", "/etc/gshadow"]\n'
    done = bundle(run_folder(tmp_path, f"[swarm]\nagents = 2\n[sitl]\nenabled = false\n{keys}{vehicles}"))
    assert done.returncode == 0, done.stderr
    assert "no logs of agent-0, agent-1: it signs its link, and a bundle reads no key file" in done.stdout


def test_what_is_no_run_folder_is_refused(tmp_path: Path) -> None:
    done = bundle(tmp_path)
    assert done.returncode == 2
    assert "is no run folder" in done.stderr
    assert bundle(tmp_path / "nowhere").returncode == 2
