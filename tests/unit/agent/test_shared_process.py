"""Agents that share a process: each ticks at its own deadlines and ends alone."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from swarmctl.agent import shared_process
from swarmctl.agent.agent_end import AgentEnd
from swarmctl.agent.runner import AgentProcess, Ending
from swarmctl.agent.shared_process import Turns, run_agents
from swarmctl.core.clock import SimClock
from swarmctl.errors import EXIT_MISSION, EXIT_OK, EXIT_START, ConfigError, MissionError, StartError

PERIOD_US = 20_000
TICK_US = 3_000
WHOLE_S = 30.0


class Flight:
    """An agent that flies so many ticks of 3 ms and then ends, as it is told to."""

    period_us = PERIOD_US

    def __init__(self, clock: SimClock, ticks: int, end: Callable[[], Ending]) -> None:
        self._clock, self._left, self._end = clock, ticks, end
        self.due_us = 0
        self.ticked_us: list[int] = []
        self.noted: list[dict[str, Any]] = []

    def begin_at(self, first_us: int) -> None:
        self.due_us = first_us

    def note(self, name: str, **fields: Any) -> None:
        self.noted.append({"event": name, **fields})

    def step(self) -> Ending | None:
        self.ticked_us.append(self._clock.now_us())
        self._clock.advance(TICK_US)
        self.due_us += PERIOD_US
        self._left -= 1
        return None if self._left > 0 else self._end()


def completed() -> Ending:
    return Ending(EXIT_OK)


def silent() -> Ending:
    raise MissionError("vehicle at udpin://x: silent for 15 s")


def broken() -> Ending:
    raise ZeroDivisionError("division by zero")


def leaves() -> Ending:
    raise SystemExit(7)


class Scene:
    """Agents in turns on a simulated clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = SimClock()
        paced: Any = SimpleNamespace(now_us=self.clock.now_us, sleep_until=self._sleep_until)
        self.told: list[AgentEnd] = []
        self.turns = Turns(paced, self.told.append)
        self.flights: dict[int, Flight] = {}
        self.refused: dict[int, Exception] = {}
        self.closes: dict[int, Callable[[], Any]] = {}
        monkeypatch.setattr(shared_process, "flying_agent", self._flying)
        monkeypatch.setattr(shared_process, "keep_from_collections", lambda: None)

    def add(self, agent: int, ticks: int, end: Callable[[], Ending] = completed) -> Flight:
        self.flights[agent] = Flight(self.clock, ticks, end)
        self.open(agent)
        return self.flights[agent]

    def open(self, agent: int) -> None:
        stop: Any = None
        self.turns.open(AgentProcess(config_path=Path(), agent=agent, run="", bus="", run_dir=Path()), stop)

    def fly(self) -> int:
        self.turns.begin(realtime=False)
        while self.turns.step():
            pass
        return self.turns.wait_for_ends()

    def end_of(self, agent: int) -> AgentEnd:
        (end,) = (end for end in self.told if end.agent == agent)
        return end

    def _sleep_until(self, t_us: int) -> None:
        if t_us > self.clock.now_us():
            self.clock.advance(t_us - self.clock.now_us())

    @contextmanager
    def _flying(self, process: AgentProcess, *_: object) -> Iterator[Flight]:
        if process.agent in self.refused:
            raise self.refused[process.agent]
        yield self.flights[process.agent]
        self.closes.get(process.agent, lambda: None)()


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(monkeypatch)


def test_first_ticks_are_spread_over_one_period_and_the_longest_waiting_goes_first(scene: Scene) -> None:
    flights = [scene.add(agent, ticks=3) for agent in range(4)]
    assert scene.fly() == EXIT_OK
    for agent, flight in enumerate(flights):
        assert flight.ticked_us == [agent * 5_000 + tick * PERIOD_US for tick in range(3)]
    assert {end.agent: end.exit_code for end in scene.told} == dict.fromkeys(range(4), EXIT_OK)


def test_where_all_are_late_each_gets_its_turn(scene: Scene) -> None:
    """Ten ticks of 3 ms do not fit into 20 ms."""
    flights = [scene.add(agent, ticks=10) for agent in range(10)]
    scene.fly()
    latest_us = [flight.ticked_us[-1] for flight in flights]
    assert max(latest_us) - min(latest_us) < 10 * TICK_US + PERIOD_US


@pytest.mark.parametrize(
    ("end", "code", "words"),
    [
        (silent, EXIT_MISSION, "vehicle at udpin://x: silent for 15 s"),
        (broken, 1, "ZeroDivisionError: division by zero"),
        (leaves, 1, "SystemExit: 7"),
        (lambda: Ending(EXIT_START, "mission not completed: no"), EXIT_START, "mission not completed: no"),
    ],
)
def test_an_agent_that_fails_ends_alone(
    scene: Scene, end: Callable[[], Ending], code: int, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    scene.add(3, ticks=2, end=end)
    other = scene.add(4, ticks=50)
    assert scene.fly() == code
    assert len(other.ticked_us) == 50
    assert (scene.end_of(3).exit_code, scene.end_of(3).words) == (code, words)
    assert scene.end_of(4) == AgentEnd(agent=4, exit_code=EXIT_OK)
    assert f"agent-3: {words}" in capfd.readouterr().err


def test_an_agent_that_can_not_begin_ends_alone(scene: Scene) -> None:
    scene.refused[0] = StartError("router does not answer")
    scene.open(0)
    other = scene.add(1, ticks=5)
    assert scene.fly() == EXIT_START
    assert len(other.ticked_us) == 5
    assert scene.end_of(0) == AgentEnd(agent=0, exit_code=EXIT_START, words="router does not answer")


def test_the_end_of_one_delays_no_tick_of_another_and_is_told_when_all_is_closed(scene: Scene) -> None:
    """A session of the bus or a disk can take seconds to close."""
    other_is_done = threading.Event()

    def ends_last() -> Ending:
        assert scene.told == [], "the vehicle's link is still open"
        other_is_done.set()
        return Ending(EXIT_OK)

    scene.closes[0] = lambda: other_is_done.wait(WHOLE_S)
    scene.add(0, ticks=1)
    scene.add(1, ticks=20, end=ends_last)
    assert scene.fly() == EXIT_OK
    assert other_is_done.is_set()
    assert {end.agent for end in scene.told} == {0, 1}


def test_what_can_not_be_closed_is_no_success(scene: Scene) -> None:
    def fails() -> None:
        raise OSError("no space left on device")

    scene.closes[0] = fails
    scene.add(0, ticks=2)
    scene.add(1, ticks=2)
    assert scene.fly() == 1
    assert scene.end_of(0) == AgentEnd(agent=0, exit_code=1, words="OSError: no space left on device")
    assert scene.end_of(1).exit_code == EXIT_OK


def test_agents_of_real_vehicles_do_not_take_turns(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    links = (f'{{sysid={n},url="udpin://127.0.0.1:{14540 + n}"}}' for n in (1, 2))
    path.write_text(f"vehicles=[{','.join(links)}]\n[swarm]\nagents=2\n[sitl]\nenabled=false\n", encoding="utf-8")
    both = [AgentProcess(config_path=path, agent=agent, run="", bus="none", run_dir=tmp_path) for agent in (0, 1)]
    with pytest.raises(ConfigError, match="agents of real vehicles have processes of their own"):
        run_agents(both)
    assert list(tmp_path.iterdir()) == [path]


def test_priority_is_asked_for_once_and_noted_by_every_agent(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [True]
    monkeypatch.setattr("swarmctl.agent.flight_priority.request_realtime", answers.pop)
    flights = [scene.add(agent, ticks=1) for agent in range(3)]
    scene.turns.begin(realtime=True)
    assert answers == []
    assert [[note["granted"] for note in flight.noted] for flight in flights] == [[True]] * 3
    while scene.turns.step():
        pass
    scene.turns.wait_for_ends()
