"""What is said of exceptions that somebody else's code raises: where, and by which way."""

from __future__ import annotations

import json
import linecache
from collections.abc import Callable
from typing import Any, cast

import pytest

from swarmctl.control.controllers.guard import Guard
from swarmctl.core.discovery.own import in_words, raised_at, traced


class UnspeakableError(Exception):
    """Raises again when it is shown."""

    def __str__(self) -> str:
        raise KeyError("again")


def elsewhere() -> None:
    json.loads("{")


def raised(act: Callable[[], Any]) -> Exception:
    try:
        act()
    except Exception as error:
        return error
    raise AssertionError("it did not raise")


def test_an_exception_is_placed_where_the_module_raised_or_called_what_did() -> None:
    line = elsewhere.__code__.co_firstlineno + 1
    assert raised_at(raised(elsewhere), __name__) == f"test_own.py:{line}"
    assert raised_at(raised(elsewhere), "another").startswith("decoder.py:"), "in none: the innermost frame"
    assert raised_at(KeyError("never raised"), __name__) == "no traceback"


def test_a_traceback_is_short_can_always_be_had_and_reads_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linecache, "getlines", lambda *_: pytest.fail("a tick would wait for the disk"))

    def deep(n: int = 0) -> None:
        deep(n + 1)

    def unspeakable() -> None:
        raise UnspeakableError

    assert f'test_own.py", line {elsewhere.__code__.co_firstlineno + 1}, in elsewhere' in traced(raised(elsewhere))
    assert len(traced(raised(deep)).splitlines()) == 9
    assert len(traced(ValueError("x" * 10_000))) == 4000
    assert "UnspeakableError" in traced(raised(unspeakable))
    assert "can't be shown" in in_words(raised(unspeakable))


@pytest.mark.parametrize(("places", "told"), [(1, 1), (20, 8)])
def test_a_controller_that_raises_in_every_tick_does_not_fill_the_disk(places: int, told: int) -> None:
    guard = Guard("own", cast(Any, object()), cast(Any, None), cast(Any, None))
    traces = []
    for k in range(100):
        code = compile("\n" * (k % places) + f"raise ValueError({k})", "b1.py", "exec")
        _, failure = guard._called(lambda code=code: exec(code, {"__name__": "builtins"}))  # type: ignore[misc]
        assert failure == f"raised ValueError: {k} (b1.py:{k % places + 1})"
        traces += [trace for trace in [guard._untold()] if trace]
    assert len(traces) == told
