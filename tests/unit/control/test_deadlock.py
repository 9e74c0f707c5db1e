"""Detection of deadlocks, blocking peers, and the rule by which agents yield."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.reference.deadlock import DeadlockRecovery, ProgressMonitor
from swarmctl.control.reference.deadlock_params import DeadlockParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array
from tests import builders

PARAMS = DeadlockParams(behind_m=0.2, moved_m=0.2, patience_s=1.5, near_m=0.4, speed_m_s=1.0)
WANTED = np.array([5.0, 0.0, -2.0])
HERE = np.array([0.0, 0.0, -2.0])


def keep_out(north_m: float, east_m: float = 0.0, priority_id: int = 1, ends_m: float = 0.0) -> KeepOut:
    """A peer (an obstacle with `priority_id` -1) that plans to move `ends_m` north over the horizon."""
    path = np.linspace([north_m, east_m, -2.0], [north_m + ends_m, east_m, -2.0], 41)
    return builders.keep_out(pos_ned_m=path, any_height=priority_id < 0, priority_id=priority_id)


def reference(offsets_s: Array) -> tuple[Array, Array]:
    return np.tile(WANTED, (len(offsets_s), 1)), np.zeros((len(offsets_s), 3))


def watched(seconds: float, keep_outs: list[KeepOut], speed_m_s: float = 0.0, wanted: Array = WANTED) -> list[Any]:
    progress = ProgressMonitor(PARAMS)
    ticks = [(k * 20_000, HERE + np.array([speed_m_s * k * 0.02, 0.0, 0.0])) for k in range(round(seconds * 50) + 1)]
    return [d for t_us, pos in ticks if (d := progress.step(t_us, pos, wanted, keep_outs)) is not None]


def test_a_blocked_agent_at_rest_is_deadlocked_after_its_patience() -> None:
    before = [keep_out(1.0, priority_id=3), keep_out(0.8, 0.5, priority_id=-1)]
    assert watched(1.4, before) == []
    found = watched(3.2, before)
    assert [d.by for d in found] == [(-1, 3)] * 2  # told again every 1.5 s
    assert found[0].since_us == 0
    assert found[0].names == "an obstacle, agent 3"


@pytest.mark.parametrize(
    ("keep_outs", "speed_m_s", "wanted"),
    [
        ([keep_out(1.0)], 0.2, WANTED),  # it gets on
        ([keep_out(1.0)], 0.0, HERE + np.array([0.1, 0.0, 0.1])),  # it is there
        ([keep_out(-1.0)], 0.0, WANTED),  # what is near is behind it
        ([keep_out(1.4)], 0.0, WANTED),  # what is ahead is far enough
        ([], 0.0, WANTED),  # nobody is there: wind, or a weak vehicle
    ],
    ids=["moving", "arrived", "behind", "far", "alone"],
)
def test_a_moving_or_unblocked_agent_is_not_deadlocked(
    keep_outs: list[KeepOut], speed_m_s: float, wanted: Array
) -> None:
    assert watched(4.0, keep_outs, speed_m_s, wanted) == []


def stood(
    recovery: DeadlockRecovery, seconds: float, keep_outs: list[KeepOut], obstacles: tuple[Obstacle, ...] = ()
) -> None:
    for k in range(round(seconds * 50) + 1):
        recovery.step(k * 20_000, HERE, WANTED, reference, keep_outs, obstacles=lambda: obstacles)


def aside_m(recovery: DeadlockRecovery) -> float:
    """Return how far beside the straight line the path leads in the next seconds [m]."""
    return float(np.abs(recovery.sample(np.linspace(0.0, 4.0, 81))[0][:, 1]).max())


@pytest.mark.parametrize(("agent", "seconds", "yields"), [(2, 1.6, False), (2, 3.2, True), (0, 3.2, False)])
def test_the_higher_id_yields_to_the_lower_one(agent: int, seconds: float, yields: bool) -> None:
    recovery = DeadlockRecovery(PARAMS, agent, 0.9)
    stood(recovery, seconds, [keep_out(1.0)])
    assert recovery.active
    assert (aside_m(recovery) > 0.8) == yields


def test_the_lower_id_yields_too_at_the_third_level() -> None:
    recovery = DeadlockRecovery(PARAMS, 0, 0.9)
    stood(recovery, 4.7, [keep_out(1.0)])
    assert aside_m(recovery) > 0.8


def test_a_blocking_peer_is_avoided_although_it_moves_now() -> None:
    recovery = DeadlockRecovery(PARAMS, 2, 0.9)
    stood(recovery, 3.2, [keep_out(1.0, ends_m=-0.5)])
    assert aside_m(recovery) > 0.8
    passing = DeadlockRecovery(PARAMS, 2, 0.9)
    stood(passing, 3.2, [keep_out(1.0, priority_id=-1), keep_out(3.0, ends_m=-0.5)])
    assert aside_m(passing) < 0.1, "who is only passing is not"


def test_a_wall_is_avoided_at_the_first_level_until_the_reference_is_reached() -> None:
    posts = tuple(
        Obstacle(
            center_ned_m=(1.5, east, 0.0),
            radius_m=0.3,
            keep_out_m=0.9,
            visibility_m=3.0,
            vel_ned_m_s=(0.0, 0.0, 0.0),
            column=True,
        )
        for east in (-0.6, 0.0, 0.6)
    )
    recovery = DeadlockRecovery(PARAMS, 0, 0.9)
    stood(recovery, 1.6, [keep_out(1.0, priority_id=-1)], posts)
    assert aside_m(recovery) > 1.4
    assert recovery.deadlock is not None
    pos, vel = recovery.sample(np.array([0.0, 0.5]))
    np.testing.assert_allclose(np.linalg.norm(pos[1] - pos[0]), 0.5)
    np.testing.assert_allclose(np.linalg.norm(vel, axis=1), 1.0)
    recovery.step(1_700_000, HERE + np.array([0.0, 2.0, 0.0]), WANTED, reference, [], obstacles=lambda: posts)
    assert recovery.active
    assert recovery.deadlock is None, "it has moved on"
    recovery.step(9_000_000, WANTED - [0.1, 0.0, 0.0], WANTED, reference, [], obstacles=lambda: posts)
    assert not recovery.active


def test_a_sphere_below_is_not_avoided() -> None:
    ball = Obstacle(
        center_ned_m=(1.5, 0.0, 0.0), radius_m=0.3, keep_out_m=0.9, visibility_m=3.0, vel_ned_m_s=(0.0, 0.0, 0.0)
    )
    recovery = DeadlockRecovery(PARAMS, 0, 0.9)
    stood(recovery, 1.6, [keep_out(1.0, priority_id=-1)], (ball,))
    assert aside_m(recovery) < 0.1


def test_a_disabled_recovery_only_reports() -> None:
    recovery = DeadlockRecovery(PARAMS.model_copy(update={"enabled": False}), 2, 0.9)
    stood(recovery, 4.0, [keep_out(1.0)])
    assert recovery.deadlock is not None
    assert not recovery.active


def test_a_reset_ends_the_recovery() -> None:
    recovery = DeadlockRecovery(PARAMS, 2, 0.9)
    stood(recovery, 4.0, [keep_out(1.0)])
    recovery.reset()
    assert recovery.deadlock is None
    assert not recovery.active
