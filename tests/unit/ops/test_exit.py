"""Tests of how the command line leaves while a session of the bus is blocked."""

from __future__ import annotations

import atexit
import os
import sys
import threading

import pytest

import swarmctl.bus.zenoh.client  # noqa: F401  (a verb that uses the bus has loaded it)
from swarmctl.ops import cli


class LeftAtOnce(BaseException):
    pass


def leave(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Run `swarmctl --version`, and return what it has done to leave."""
    done: list[object] = []

    def left(code: int) -> None:
        done.append(code)
        raise LeftAtOnce

    monkeypatch.setattr(sys, "argv", ["swarmctl", "--version"])
    monkeypatch.setattr(os, "_exit", left)
    monkeypatch.setattr(atexit, "_run_exitfuncs", lambda: done.append("exit functions"))
    with pytest.raises((LeftAtOnce, SystemExit)):
        cli.main()
    return done


@pytest.mark.parametrize("name", ["bus-reopen", "bus-close"])
def test_a_thread_that_is_blocked_in_the_bus_is_not_unwound(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()
    blocked = threading.Thread(target=goes_on.wait, name=name, daemon=True)
    blocked.start()
    try:
        assert leave(monkeypatch) == ["exit functions", 0]
    finally:
        goes_on.set()
        blocked.join()


def test_otherwise_the_interpreter_ends_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    assert leave(monkeypatch) == []
