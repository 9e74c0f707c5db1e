"""Lockstep repeats bit for bit, whatever the order agents are ticked in."""

from __future__ import annotations

from tests.closed_loop.conftest import Fly

SHORT = ("mission.duration_s=4", "bus.loss_01=0.2", "bus.delay_ms=30")


def test_same_seed_same_bytes_in_any_order(fly: Fly) -> None:
    first, again = fly(*SHORT, "seed=7"), fly(*SHORT, "seed=7", order=[2, 0, 1])
    assert first.lockstep.truth.tobytes() == again.lockstep.truth.tobytes()


def test_control_another_seed_loses_other_messages(fly: Fly) -> None:
    first, other = fly(*SHORT, "seed=7"), fly(*SHORT, "seed=8")
    assert first.lockstep.truth.tobytes() != other.lockstep.truth.tobytes()
