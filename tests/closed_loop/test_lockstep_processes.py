"""One lockstep flight in several processes: the same flight, and none of the processes is left when it ends."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest

import sitl.lockstep
from sitl.flight_parts import SentMessage
from sitl.lockstep import Flown, Lockstep
from sitl.lockstep_processes import LockstepProcesses
from swarmctl.bus.local.hub import LocalHub
from swarmctl.config import load
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError
from tests.closed_loop.conftest import COARSE, ROOT

WALL_TIMES = ("tick_ms", "solve_ms")
TELLS_OF_WALL_TIME = ("bus_summary", "resources")  # bytes of statuses that tell of it
FAULTS = """sitl.faults=[{kind="wind", at_s=6, value=3}, {kind="motor", at_s=6.5, for_s=0.2, vehicle=3, value=0.9},
{kind="link_loss", at_s=7, for_s=2, vehicle=2, value=0.5}]"""
WINDY = ("sitl.wind.mean_ned_m_s=[1,0.5,0]", "sitl.wind.turbulence_m_s=3", FAULTS)
LOSSY = ("bus.delay_ms=20", "bus.jitter_ms=10", "bus.loss_01=0.05", "bus.burst_01=0.02")
TWO, FOUR, AIR = (*COARSE, "swarm.agents=2"), (*COARSE, "swarm.agents=4"), ("sitl.start=air",)
FLIGHTS: dict[str, tuple[str | None, tuple[str, ...], float]] = {  # configuration, values, and when the flight ends
    "to the landing": (None, (*TWO, "mission.duration_s=1"), 60.0),
    "impaired": (None, (*FOUR, *AIR, *LOSSY, *WINDY), 9.0),
    "guaranteed": (None, (*FOUR, *AIR, "separation.mode=guaranteed"), 7.0),
    "arducopter": ("ardupilot_sitl.toml", (*TWO, *AIR), 7.0),
}


def flown(config: str | None, sets: Sequence[str], until_s: float, jobs: int, folder: Path | None = None) -> Flown:
    loaded = load(ROOT / "configs" / config if config else None, sets)
    with LockstepProcesses(loaded, folder, jobs) as flight:
        flight.run(lambda: flight.clock.now_us() >= until_s * 1e6)
        return flight.end()


def contents(flight: Flown) -> dict[str, object]:
    """Return all that has to be the same bit for bit, by name."""
    fields = [name for name in flight.ticks[0].dtype.names or () if name not in WALL_TIMES]
    ticks = {f"{agent} {name}": rows[name].tobytes() for agent, rows in flight.ticks.items() for name in fields}
    events = [event for event in flight.events if event["event"] not in TELLS_OF_WALL_TIME]
    return {"truth": flight.truth.tobytes(), "events": events, "faults": flight.fault_events, **ticks}


def differing(one: Flown, other: Flown) -> set[str]:
    ours, theirs = contents(one), contents(other)
    return {name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name)}


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_flight_is_the_same_in_several_processes(name: str, tmp_path: Path) -> None:
    one, three = tmp_path / "1", tmp_path / "3"
    one.mkdir()
    three.mkdir()
    alone, shared = flown(*FLIGHTS[name], 1, one), flown(*FLIGHTS[name], 3, three)
    assert differing(alone, shared) == set()
    assert shared.unwritten == () and shared.problems == alone.problems
    assert all(Phase.TRACK in ticks["phase"] for ticks in shared.ticks.values())
    assert not shared.problems or name != "to the landing"
    assert sorted(path.name for path in one.iterdir()) == sorted(path.name for path in three.iterdir())
    for path in [path for kind in ("received", "plans", "tlog") for path in one.glob(f"*{kind}*")]:
        assert path.read_bytes() == (three / path.name).read_bytes(), path.name


def test_a_flight_differs_where_parts_do_not_hear_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = (None, (*TWO, *AIR), 4.0)
    alone = flown(*flight, 1)

    def not_carried(hub: LocalHub, messages: Sequence[SentMessage]) -> None:
        del hub, messages

    monkeypatch.setattr(sitl.lockstep, "carry", not_carried)
    assert differing(alone, flown(*flight, 1)) == set()
    assert "1 phase" in differing(alone, flown(*flight, 2))


def test_all_agents_hear_the_operator() -> None:
    with LockstepProcesses(load(None, (*FOUR, *AIR)), None, 4) as flight:
        flight.run(lambda: flight.clock.now_us() >= 3_000_000)
        flight.command("land")
        flight.run(lambda: None)
        ended = flight.end()
    assert [ticks["phase"][-1] for ticks in ended.ticks.values()] == [Phase.DONE] * 4
    assert ended.problems == [f"agent {i}: stopped by the operator" for i in range(4)]


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (ValueError("raised by an agent"), RuntimeError, "in raising\n.*\nValueError: raised by an agent"),
        (ConfigError("agent 1", ["refused"]), ConfigError, "agent 1: refused"),
    ],
)
def test_what_an_agent_raises_elsewhere_ends_the_flight(
    error: Exception, kind: type[Exception], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = Lockstep.step

    def raising(flight: Lockstep) -> None:
        if flight.logs[0].agent == 1:
            raise error
        step(flight)

    monkeypatch.setattr(Lockstep, "step", raising)
    with (
        LockstepProcesses(load(None, TWO), None, 2) as flight,
        pytest.raises(kind, match=f"(?s){text}"),
    ):
        flight.run(lambda: None)
    assert workers() == []


def test_a_process_that_ends_by_itself_is_told_of() -> None:
    with (
        LockstepProcesses(load(None, (*COARSE, "swarm.agents=3")), None, 2) as flight,
        pytest.raises(StartError, match="agents 1 to 2: their process ended by itself"),
    ):
        flight.run(lambda: os.kill(workers()[0], signal.SIGKILL))
    assert workers() == []


def test_a_process_that_can_not_be_started_is_told_of_and_ends_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    fork, calls = os.fork, [0]

    def full() -> int:
        calls[0] += 1
        if calls[0] == 2:
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        return fork()

    monkeypatch.setattr(os, "fork", full)
    with pytest.raises(StartError, match="process 3 did not start"):
        LockstepProcesses(load(None, (*COARSE, "swarm.agents=3")), None, 3)
    assert workers() == []


def test_only_the_leading_process_answers_signals_that_ask_to_stop() -> None:
    signums = [signal.SIGINT, signal.SIGHUP, signal.SIGTERM]

    def asks() -> bool:
        if signums and flight.clock.now_us() > 1_000_000:
            os.kill(workers()[0], signums.pop())
        return flight.clock.now_us() >= 2_000_000

    with LockstepProcesses(load(None, TWO), None, 2) as flight:
        flight.run(asks)
        assert workers() and not signums
    assert workers() == []


def workers() -> list[int]:
    """Return the processes that this one has started and that still run."""
    return [child.pid for child in multiprocessing.active_children() if child.pid is not None]
