"""Where vehicles of silent peers may be, and whether most peers are heard."""

from __future__ import annotations

from collections.abc import Set
from typing import cast

import numpy as np
import pytest

from swarmctl.agent.planning.non_participants import NonParticipants, most_are_heard
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.types import Array

PLACE = np.array([4.0, 0.0, -3.0])
STEPS, DT_US, UTC_US = 5, 100_000, 1_800_000_000_000_000


class Peers:
    """Stands for a world model: every vehicle rests at one place."""

    def ways_without_setpoints(self, agents: Set[int], t0_utc_us: int, dt_us: int, steps: int) -> dict[int, Array]:
        assert (t0_utc_us, dt_us, steps) == (UTC_US, DT_US, STEPS)
        return {agent: np.tile(PLACE, (steps + 1, 1)) for agent in sorted(agents)}


@pytest.mark.parametrize(
    ("silent", "heard", "expected"),
    [
        ({1}, {2}, True),
        ({1, 2}, {3, 4}, True),
        ({1, 2}, {3}, False),  # two of four: either half may be cut off
        ({1, 2}, set(), False),  # the bus, or the own link
        ({1}, set(), False),
    ],
)
def test_most_are_heard(silent: set[int], heard: set[int], expected: bool) -> None:
    assert most_are_heard(silent, silent | heard) is expected


def test_as_much_is_kept_as_between_committed_trajectories() -> None:
    keeps = NonParticipants(cast(WorldModel, Peers()), SeparationParams(), dt_us=DT_US, steps=STEPS)
    kept, other = keeps.without_setpoints({1, 2}, UTC_US)
    assert (kept.priority_id, other.priority_id) == (1, 2)
    assert kept.hard_min_distance_m == SeparationParams().budget.committed_m
    np.testing.assert_array_equal(kept.pos_ned_m, np.tile(PLACE, (STEPS + 1, 1)))
