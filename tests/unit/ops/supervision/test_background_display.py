"""What is printed by a thread: all lines in order, of states the newest, and no wait for a terminal that is stuck."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import pytest

from swarmctl.ops.supervision import background_display
from swarmctl.ops.supervision.background_display import BackgroundDisplay
from swarmctl.ops.supervision.status_table import AgentView


class Shown:
    """A display that waits until it may go on."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.goes_on = threading.Event()

    def print_line(self, text: str) -> None:
        self.goes_on.wait()
        self.said.append(text)

    def show(self, agents: Sequence[AgentView]) -> None:
        self.goes_on.wait()
        self.said.append(agents[0].note)

    def close(self) -> None:
        self.said.append("closed")


class Slow(Shown):
    """One that takes a while for each line."""

    def print_line(self, text: str) -> None:
        time.sleep(0.1)
        self.said.append(text)


def test_lines_keep_their_order_and_of_states_the_newest_is_shown() -> None:
    shown, view = Shown(), AgentView(agent=0)
    display = BackgroundDisplay(shown, pytest.fail)
    display.print_line("first")
    for note in ("a", "b", "c"):
        view.note = note
        display.show([view])
    display.print_line("second")
    view.note = "d"
    display.show([view])
    view.note = "later"
    shown.goes_on.set()
    display.close()
    display.print_line("verdict")
    assert shown.said == ["first", "c", "second", "d", "closed", "verdict"]


def test_the_end_waits_for_a_slow_terminal_and_not_for_one_that_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background_display, "_STUCK_S", 0.3)
    stuck = Shown()
    display = BackgroundDisplay(stuck, pytest.fail)
    began_s = time.monotonic()
    display.print_line("never")
    display.close()
    assert time.monotonic() - began_s < 5.0
    slow = Slow()
    display = BackgroundDisplay(slow, pytest.fail)
    for k in range(10):
        display.print_line(f"{k}")
    display.close()
    assert slow.said == [*map(str, range(10)), "closed"]
    stuck.goes_on.set()


class Failing(Shown):
    """One that can't show states, nor the last of them."""

    def show(self, agents: Sequence[AgentView]) -> None:
        raise OverflowError("int too large to convert to float")

    def close(self) -> None:
        raise OverflowError("once more")


def test_what_can_not_be_shown_is_told_once_and_the_rest_is_shown() -> None:
    """One status of a host took the table and all further lines from a station, until it was ended."""
    failing, told = Failing(), list[str]()
    failing.goes_on.set()
    display = BackgroundDisplay(failing, told.append)
    for line in ("first", "second"):
        display.show([AgentView(agent=0)])
        display.print_line(line)
    display.close()
    assert failing.said == ["first", "second"]
    assert told == ["OverflowError: int too large to convert to float"]
