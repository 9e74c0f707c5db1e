"""Where vehicles of silent peers may be: of which peers that is asked, and when it is not."""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import cast

import numpy as np
import pytest

from swarmctl.agent.planning.non_participants import NonParticipants
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.types import Array

PLACE = np.array([4.0, 0.0, -3.0])
STEPS, DT_US, UTC_US = 5, 100_000, 1_800_000_000_000_000
FRESH_US, SILENT_US = 120_000, 200_000


class Peers:
    """Stands for a world model: every vehicle rests at one place."""

    def ways_without_setpoints(self, agents: Set[int], t0_utc_us: int, dt_us: int, steps: int) -> dict[int, Array]:
        assert (t0_utc_us, dt_us, steps) == (UTC_US, DT_US, STEPS)
        return {agent: np.tile(PLACE, (steps + 1, 1)) for agent in sorted(agents)}


def doubted(silence_us: Mapping[int, int], relied_on: Set[int] = frozenset(range(9))) -> list[int]:
    """Agents whose vehicles are kept clear of."""
    keeps = NonParticipants(cast(WorldModel, Peers()), SeparationParams(), dt_us=DT_US, steps=STEPS)
    return [keep_out.priority_id for keep_out in keeps.silent(UTC_US, silence_us, relied_on)]


@pytest.mark.parametrize(
    ("silence_us", "expected"),
    [
        ({1: FRESH_US, 2: FRESH_US}, []),
        ({1: SILENT_US, 2: FRESH_US}, [1]),
        ({1: SILENT_US, 2: SILENT_US, 3: FRESH_US, 4: FRESH_US}, [1, 2]),
        ({1: SILENT_US, 2: SILENT_US, 3: FRESH_US}, []),  # two of four: either half may be cut off
        ({1: SILENT_US, 2: SILENT_US}, []),  # the bus, or the own link
        ({1: SILENT_US}, []),
        ({}, []),
    ],
)
def test_silent_peers_are_doubted_while_most_are_heard(silence_us: Mapping[int, int], expected: list[int]) -> None:
    assert doubted(silence_us) == expected


def test_peers_that_are_not_relied_on_are_kept_clear_of_by_their_paths_already() -> None:
    assert doubted({1: SILENT_US, 2: FRESH_US, 3: FRESH_US}, relied_on=frozenset({2, 3})) == []


def test_as_much_is_kept_as_between_committed_trajectories() -> None:
    keeps = NonParticipants(cast(WorldModel, Peers()), SeparationParams(), dt_us=DT_US, steps=STEPS)
    (kept,) = keeps.silent(UTC_US, {1: SILENT_US, 2: FRESH_US}, {1})
    assert kept.hard_min_distance_m == SeparationParams().budget.committed_m
    np.testing.assert_array_equal(kept.pos_ned_m, np.tile(PLACE, (STEPS + 1, 1)))
