"""When a supervisor believes that an agent is silent, and when it doubts its own session first."""

from __future__ import annotations

import pytest

from swarmctl.bus.bus import Bus
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.traffic import CountedBus
from swarmctl.ops.supervision.hearing import Hearing

LIMIT_S = 5.0


class Sessions(CountedBus):
    """A bus on which another session can be opened, or not."""

    def __init__(self, bus: Bus, *, can_open: bool = True) -> None:
        super().__init__(bus)
        self.can_open, self.asked, self.sessions = can_open, 0, 0

    def reopen(self) -> bool:
        self.asked += 1
        return self.can_open

    def reopened(self) -> int:
        return self.sessions


class Bench:
    """Hearing that looks ten times a second for as long as an agent is not heard."""

    def __init__(self, *, can_open: bool = True) -> None:
        self.bus = Sessions(LocalHub(lambda: 0).connect("alpha"), can_open=can_open)
        self.said: list[str] = []
        self.hearing = Hearing(self.bus, lambda event, _: self.said.append(event))

    def silent_from_s(self, until_s: float, *, anew_at_s: float | None = None, begin_s: float = 0.0) -> float | None:
        """Return the silence after which an agent is called silent; another session takes over at `anew_at_s`."""
        for tenth in range(round(10 * begin_s), round(10 * until_s)):
            silent_s = tenth / 10
            if anew_at_s is not None and silent_s >= anew_at_s:
                self.bus.sessions = 1
            if self.hearing.is_silent(0, silent_s, LIMIT_S):
                return silent_s
        return None


def test_an_agent_that_was_heard_lately_costs_no_session() -> None:
    bench = Bench()
    assert bench.silent_from_s(3.05) is None
    assert bench.bus.asked == 0 and bench.said == []


def test_another_session_is_opened_before_the_limit_and_told_of_once() -> None:
    bench = Bench()
    assert bench.silent_from_s(5.0) is None
    assert bench.bus.asked == 1 and bench.said == ["bus_doubted"]


@pytest.mark.parametrize(("anew_at_s", "silent_s"), [(3.2, 5.0), (4.8, 5.8), (7.0, 8.0)])
def test_an_agent_is_silent_when_another_session_has_not_heard_it_for_a_second(
    anew_at_s: float, silent_s: float
) -> None:
    assert Bench().silent_from_s(20.0, anew_at_s=anew_at_s) == pytest.approx(silent_s + 0.1, abs=0.01)


def test_a_session_that_does_not_come_up_is_waited_for_as_long_again() -> None:
    assert Bench().silent_from_s(20.0) == pytest.approx(10.1)


def test_without_a_router_silence_is_what_it_seems_from_the_limit_on() -> None:
    bench = Bench(can_open=False)
    assert bench.silent_from_s(20.0) == pytest.approx(5.1)
    assert bench.said == []


def test_who_is_heard_on_another_session_was_not_silent_and_is_doubted_anew() -> None:
    bench = Bench()
    assert bench.silent_from_s(4.0, anew_at_s=3.5) is None
    bench.hearing.hear(0)
    assert bench.said == ["bus_doubted", "bus_was_deaf"]
    assert bench.silent_from_s(20.0) == pytest.approx(10.1), "that session took over before this silence began"


def test_who_is_heard_again_on_the_same_session_proves_it_no_deaf_one() -> None:
    bench = Bench()
    assert bench.silent_from_s(4.0) is None
    bench.hearing.hear(0)
    bench.hearing.hear(0)
    assert bench.said == ["bus_doubted"]
