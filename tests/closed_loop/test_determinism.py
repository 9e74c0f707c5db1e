"""Tests that lockstep repeats bit for bit in any order of the agents' ticks."""

from __future__ import annotations

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
