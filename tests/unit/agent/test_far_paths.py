"""What those out of reach are told, and when."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.agent.sharing.far_paths import UNTOLD_MARGIN_M, FarPaths, speed_bound_m_s
from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.core.types import PredictedPath
from tests import builders

TICK_US = 20_000
PARAMS = PathSharingParams(far_hz=2.0, speed_m_s=3.0)


def path(speed_m_s: float = 0.0, margin_m: float = 0.0) -> PredictedPath:
    """A straight path eastward, slower at its end than it begins."""
    ahead_s = TICK_US * 1e-6 * np.arange(41)
    pos = np.zeros((41, 3))
    pos[:, 1] = speed_m_s * np.minimum(ahead_s, 0.5)
    return builders.predicted_path(pos_ned_m=pos, dt_us=TICK_US, margin_m=margin_m)


def told(*paths: PredictedPath, params: PathSharingParams = PARAMS) -> list[int]:
    """Numbers of the ticks whose paths all hear."""
    far = FarPaths(params)
    return [i for i, each in enumerate(paths) if far.include(each, i * TICK_US)]


def test_all_hear_so_many_paths_a_second() -> None:
    assert told(*[path(2.9)] * 60) == [0, 25, 50]


def test_all_hear_at_once_of_a_vehicle_that_will_be_faster_than_they_count_on() -> None:
    assert told(*[path(2.0)] * 5, *[path(4.0)] * 5) == [0, 5]
    assert told(*[path(4.0)] * 5, *[path(2.0)] * 5) == [0], "of a slower one they hear in time"


def test_who_accelerates_does_not_tell_all_in_every_tick() -> None:
    assert len(told(*(path(2.0 + 0.02 * i) for i in range(200)))) <= 8 + 8


def test_all_hear_at_once_of_a_margin_that_grows() -> None:
    assert told(path(), path(margin_m=0.9 * UNTOLD_MARGIN_M), path(margin_m=1.1 * UNTOLD_MARGIN_M)) == [0, 2]


def test_where_nobody_is_out_of_reach_no_path_is_for_all() -> None:
    assert told(*[path(9.0)] * 60, params=PathSharingParams()) == []


def test_a_vehicle_keeps_to_the_fastest_part_of_its_path() -> None:
    assert speed_bound_m_s(path(2.0), PARAMS) == 3.0
    assert speed_bound_m_s(path(5.0), PARAMS) == pytest.approx(5.5)
