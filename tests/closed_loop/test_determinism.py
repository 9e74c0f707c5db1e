"""Tests that lockstep repeats bit for bit in any order of the agents' ticks."""

from __future__ import annotations

import builtins
import math
from collections.abc import Iterable
from typing import Any

import pytest

from sitl.lockstep import Lockstep
from tests.closed_loop.conftest import COARSE, Flight, Fly, fly_now

SHORT = (*COARSE, "mission.duration_s=2", "sitl.start=air", "bus.loss_01=0.2", "bus.delay_ms=30")


@pytest.fixture(scope="module")
def first() -> Flight:
    return fly_now(*SHORT, "seed=7", until=Lockstep.mission_is_over)


def test_same_seed_same_bytes_in_any_order(first: Flight, fly: Fly) -> None:
    again = fly(*SHORT, "seed=7", order=[2, 0, 1], until=Lockstep.mission_is_over)
    assert first.lockstep.truth.tobytes() == again.lockstep.truth.tobytes()


def test_negative_control_another_seed_loses_other_messages(first: Flight, fly: Fly) -> None:
    other = fly(*SHORT, "seed=8", until=Lockstep.mission_is_over)
    assert first.lockstep.truth.tobytes() != other.lockstep.truth.tobytes()


def test_same_bytes_by_pythons_that_add_floats_in_another_way(
    first: Flight, fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From Python 3.12 on `sum` of floats compensates rounding errors."""

    def compensated(terms: Iterable[Any], /, start: Any = 0) -> Any:
        listed = list(terms)
        are_floats = bool(listed) and all(type(term) is float for term in listed)
        return math.fsum([start, *listed]) if are_floats else plain(listed, start)

    plain = sum
    monkeypatch.setattr(builtins, "sum", compensated)
    again = fly(*SHORT, "seed=7", until=Lockstep.mission_is_over)
    assert first.lockstep.truth.tobytes() == again.lockstep.truth.tobytes()
