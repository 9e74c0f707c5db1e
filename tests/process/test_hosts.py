"""A swarm of several hosts, all on loopback: routers that link by identity, flights, and what ends one host only."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.studies.bench.free_ports import free_ports
from swarmctl.core.recorded.records import TRUTH_COLUMNS
from swarmctl.ops.cli import main
from swarmctl.telemetry.recording.file_names import PACKED_TRUTH
from swarmctl.telemetry.recording.run_files import read_parquet
from tests.benches.at_once import at_once
from tests.benches.launches import READY_S, Launched
from tests.process.test_bus import until
from tests.process.test_readme import shown

pytestmark = pytest.mark.process

SWARM = """
name = "hosts"
[swarm]
agents = 2
[start]
spacing_m = 2.5
[mission]
kind = "swap"
duration_s = {duration_s}
[mission.swap]
travel_s = 6.0
[separation]
mode = "guaranteed"
[agent]
rate_hz = 25
[sitl]
physics_hz = 100
ground_z_m = 0.5
[telemetry]
enabled = false
[bus]
identities = "identities"
[[hosts]]
name = "alpha"
address = "127.0.0.1:{ports[0]}"
agents = [0]
operator = true
[[hosts]]
name = "bravo"
address = "127.0.0.1:{ports[1]}"
agents = [1]
"""


Flight = Callable[[Path], None]
Write = Callable[[Path, Sequence[int]], Path]
OVER_SOON_S, LONG_S = 2.0, 600.0
AGENTS = {"alpha": "0", "bravo": "1"}


class StartedHost(Launched):
    starts = "host"


class StartedStation(Launched):
    starts = "station"


def write_swarm(folder: Path, ports: Sequence[int], duration_s: float = 12.0) -> Path:
    path = folder / "swarm.toml"
    path.write_text(SWARM.format(ports=ports, duration_s=duration_s))
    return path


def write_one_host(folder: Path, ports: Sequence[int], duration_s: float) -> Path:
    """Write a swarm whose agents both fly from alpha."""
    path = write_swarm(folder, ports, duration_s)
    of_one_host, _, _ = path.read_text().replace("agents = [0]", "agents = [0, 1]").rpartition("[[hosts]]")
    path.write_text(of_one_host)
    return path


def as_shown(command: str, path: Path, agents: str = "0,1") -> list[str]:
    """Return the words of a command of docs/hosts.md for this configuration and these agents."""
    (line,) = shown(rf"^swarmctl {command} ")
    own = {"configs/three_hosts.toml": str(path), "0,1": agents}
    return [own.get(word, word) for word in shlex.split(line)]


def make_keys(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", as_shown("keys init", path))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0


@contextmanager
def started(path: Path, agents: Mapping[str, str] = AGENTS) -> Iterator[Callable[[str], Launched]]:
    """Yield what starts alpha, bravo or the station; their folders are gone afterwards."""
    running: list[tuple[Launched, Path]] = []

    def start(name: str) -> Launched:
        temp = Path(tempfile.mkdtemp(prefix="sw"))
        words = as_shown("station", path) if name == "station" else as_shown("host", path, agents[name])
        kind = StartedStation if name == "station" else StartedHost
        options = ("--no-view",) if name == "station" else ()
        launched = kind(path.parent / name, temp, *words[2:], *options)
        running.append((launched, temp))
        return launched

    try:
        yield start
    finally:
        for launched, temp in running:
            for relative in launched.relatives():
                relative.kill()
            launched.process.kill()
            launched.process.wait(20)
            shutil.rmtree(temp, ignore_errors=True)


def least_separation_m(*folders: Path) -> float:
    """Return the least distance of two vehicles by true states, whose simulators share this machine's clock."""
    a, b = (read_parquet(folder / PACKED_TRUTH, TRUTH_COLUMNS) for folder in folders)
    assert (set(a["vehicle"]), set(b["vehicle"])) == ({0}, {1})
    t_us = a["t_us"][(a["t_us"] >= b["t_us"][0]) & (a["t_us"] <= b["t_us"][-1])]
    apart_m: NDArray[np.float64] = positions_at(t_us, a) - positions_at(t_us, b)
    return float(np.linalg.norm(apart_m, axis=0).min())


def positions_at(t_us: NDArray[np.int64], truth: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the true position (3, T) of the only vehicle in rows of truth, NED [m]."""
    times_us: NDArray[np.int64] = truth["t_us"]
    pos_ned_m: NDArray[np.float64] = truth["pos_ned_m"]
    return np.array([np.interp(t_us, times_us, pos_ned_m[:, k]) for k in range(3)])


def test_two_hosts_fly_one_swarm_that_a_station_commands_and_judges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One host comes late: the other says for whom it waits, and tells it of an obstacle that an operator has added."""
    path = write_swarm(tmp_path, free_ports(2), LONG_S)
    make_keys(path, monkeypatch)
    with started(path) as start:
        alpha, station = start("alpha"), start("station")
        alpha.until_phase("STANDBY", 1)
        added = station.verb("obstacle", "add", "--center", "30,30,-3", "--radius", "0.5")
        assert added.returncode == 0, added.stderr
        assert until(lambda: "waits for agent-1 to stand by" in alpha.text()), alpha.text()
        bravo = start("bravo")
        assert until(lambda: bool(bravo.events("obstacles"))), bravo.text()
        refused = bravo.verb("land", "0")
        assert (refused.returncode, "bravo has no operator's identity" in refused.stderr) == (2, True)
        alpha.until_phase("TRACK", 1)
        bravo.until_phase("TRACK", 1)
        for verb in ("hold", "resume", "land"):
            answer = station.verb(verb)
            assert answer.returncode == 0, answer.stderr
            assert [f"agent-{i} accepts" in answer.stdout for i in range(2)] == [True, True]
        for launched in (alpha, bravo, station):
            assert launched.end() == 130, launched.text()
        for launched, agents in ((alpha, {"agent-0"}), (bravo, {"agent-1"}), (station, {"agent-0", "agent-1"})):
            assert {path.stem for path in launched.run_dir.glob("agent-?.parquet")} == agents
        assert least_separation_m(alpha.run_dir, bravo.run_dir) >= 0.85
        separation = station.summary()["separation"]
        assert separation["min_m"] >= 0.85
        assert separation["min_pair"] == [0, 1]
        assert station.summary()["tracking"]["index_m"] is not None
        for name in ("agent-0", "agent-1"):
            assert {row["verb"] for row in station.events("operator", name)} >= {"hold", "resume", "land"}
            assert len(station.events("bus_summary", name)) == 1, "the last events arrive too"
        assert set(station.summary()["comms"]["sent"]) >= {"path", "status", "event"}
        assert station.summary()["commitments"]["committed"] > 0
        assert [abs(clock["ahead_s"]) < 0.05 for clock in station.summary()["clocks"]] == [True, True], "one computer"


def a_stop_of_one_host_lands_its_agents_alone(path: Path) -> None:
    with started(path) as start:
        alpha, bravo, station = start("alpha"), start("bravo"), start("station")
        alpha.until_phase("TRACK", 1)
        bravo.until_phase("TRACK", 1)
        for stopped in (bravo, station):
            stopped.process.send_signal(signal.SIGINT)
        for stopped in (bravo, station):
            assert stopped.end() == 130, stopped.text()
        assert bravo.landed() == {1: True}
        assert alpha.end() == 0, alpha.text()
        assert alpha.summary()["violations"] == []
        assert least_separation_m(alpha.run_dir, bravo.run_dir) >= 0.85


def who_has_landed_with_a_host_that_has_ended_does_not_fail_an_order_to_land_all(path: Path) -> None:
    """Nobody repeats any more that it has landed; the station has heard it, and the other host, which has operators."""
    with started(path) as start:
        alpha, bravo, station = start("alpha"), start("bravo"), start("station")
        alpha.until_phase("TRACK", 1)
        bravo.until_phase("TRACK", 1)
        os.kill(bravo.pid_of("--id", "1"), signal.SIGKILL)
        assert bravo.end() == 4, bravo.text()
        held = station.verb("hold", "1")
        assert held.returncode == 4
        for asked in (station, alpha):
            assert "has ended, its vehicle is on the ground" in asked.verb("status").stdout
        landed = alpha.verb("land")
        assert (landed.returncode, "agent-0 accepts" in landed.stdout) == (0, True), landed.stderr
        assert "agent-1: it has ended, its vehicle is on the ground" in landed.stdout
        assert (alpha.end(), station.end()) == (130, 4), station.text()


def a_station_ends_without_who_was_excluded_and_says_so(path: Path) -> None:
    with started(path) as start:
        alpha, station = start("alpha"), start("station")
        assert until(lambda: "waits for agent-1 to stand by" in alpha.text(), READY_S), alpha.text()
        excluded = station.verb("exclude", "--peer", "1")
        assert excluded.returncode == 0, excluded.stderr
        assert alpha.end() == 0, alpha.text()
        assert station.end() == 0, station.text()
        assert "completed without agent-1" in station.text()
        assert (station.summary()["violations"], station.summary()["without"]) == ([], [1])


def a_station_names_an_agent_that_died_on_the_ground(path: Path) -> None:
    """Its vehicle is taken over by a process that says only that an operator has stopped it."""
    with started(path) as start:
        bravo, station = start("bravo"), start("station")
        bravo.until_phase("STANDBY", 1)
        assert until(lambda: "agent-1  STANDBY" in station.text(), READY_S), station.text()
        os.kill(bravo.pid_of("--id", "1"), signal.SIGKILL)
        assert bravo.end() == 4, bravo.text()
        station.process.send_signal(signal.SIGINT)
        assert station.end() == 130, station.text()
        assert station.summary()["violations"][0] == "agent-1 died before its vehicle was down"
        assert "had not ended: agent-0 (none)" in station.text()


def a_station_that_comes_late_hears_who_has_died(path: Path) -> None:
    """Nothing else is heard of it any more, and its host is not over yet."""
    with started(path, {"alpha": "0,1"}) as start:
        alpha = start("alpha")
        alpha.until_phase("TRACK", 2)
        os.kill(alpha.pid_of("--id", "1"), signal.SIGKILL)
        assert until(lambda: "the vehicle of agent-1 is on the ground" in alpha.text(), READY_S), alpha.text()
        station = start("station")
        assert until(lambda: "agent-0  TRACK" in station.text(), READY_S), station.text()
        landed = station.verb("land", "0")
        assert landed.returncode == 0, landed.stderr
        assert alpha.end() == 4, alpha.text()
        assert station.end() == 4, station.text()
        assert "agent-1 died before its vehicle was down" in station.summary()["violations"]


@pytest.mark.parametrize(
    "flights",
    [
        (
            (a_stop_of_one_host_lands_its_agents_alone, write_swarm),
            (
                who_has_landed_with_a_host_that_has_ended_does_not_fail_an_order_to_land_all,
                partial(write_swarm, duration_s=LONG_S),
            ),
        ),
        (
            (a_station_ends_without_who_was_excluded_and_says_so, partial(write_swarm, duration_s=OVER_SOON_S)),
            (a_station_names_an_agent_that_died_on_the_ground, write_swarm),
            (a_station_that_comes_late_hears_who_has_died, partial(write_one_host, duration_s=LONG_S)),
        ),
    ],
    ids=["a host ends", "an agent dies or never comes"],
)
def test_swarms_that_lose_a_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flights: Sequence[tuple[Flight, Write]]
) -> None:
    """Beside each other, each with ports and identities of its own."""
    paths, ports = [], free_ports(2 * len(flights))  # all found at the same time, so that no two are the same
    for number, (_, write) in enumerate(flights):
        folder = tmp_path / str(number)
        folder.mkdir()
        paths.append(write(folder, ports[2 * number : 2 * number + 2]))
        make_keys(paths[-1], monkeypatch)
    at_once([partial(fly, path) for (fly, _), path in zip(flights, paths, strict=True)])
