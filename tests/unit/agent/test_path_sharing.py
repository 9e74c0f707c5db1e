"""Event-triggered sharing: what peers hold is never older, nor further off, than they allow for."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.agent.sharing.path_sharing import PathSharing, PathSharingParams
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.types import MAX_MARGIN_M, PredictedPath

TICK_US = 20_000
ACCEL_M_S2 = 4.0
SEPARATION = SeparationParams(age_accel_m_s2=ACCEL_M_S2)
BY_EVENT = PathSharingParams(error_m=0.01, heartbeat_s=0.1)


def path(tick: int, *, off_m: float = 0.0, accel_m_s2: float = 0.0, margin_m: float = 0.0) -> PredictedPath:
    """Flight eastward at 1 m/s as predicted in a tick; `off_m` north, and turning north with an acceleration."""
    ahead_s = np.arange(41) * 0.02
    north, east = off_m + 0.5 * accel_m_s2 * ahead_s**2, tick * 0.02 + ahead_s
    pos = np.column_stack([north, east, np.zeros(41)])
    return PredictedPath(
        agent=0, boot_id=1, seq=tick, t0_utc_us=tick * TICK_US, dt_us=TICK_US, margin_m=margin_m, pos_ned_m=pos
    )


def shared(params: PathSharingParams, *paths: PredictedPath) -> list[int]:
    """Numbers of the paths that are published."""
    sharing = PathSharing(params, SEPARATION)
    return [chosen.seq for each in paths if (chosen := sharing.choose(each)) is not None]


def margin_m(params: PathSharingParams, first: PredictedPath) -> float:
    """Margin of the first path that is published."""
    chosen = PathSharing(params, SEPARATION).choose(first)
    assert chosen is not None
    return chosen.margin_m


def test_every_path_is_shared_unless_asked_otherwise() -> None:
    assert shared(PathSharingParams(), *(path(i) for i in range(5))) == [0, 1, 2, 3, 4]
    assert margin_m(PathSharingParams(), path(0, margin_m=0.2)) == 0.2


def test_what_peers_extrapolate_is_not_sent_again_until_the_heartbeat() -> None:
    assert shared(BY_EVENT, *(path(i) for i in range(12))) == [0, 5, 10]


@pytest.mark.parametrize(("off_m", "sent"), [(0.009, [0]), (0.011, [0, 1])])
def test_a_path_that_is_off_now_is_shared_at_once(off_m: float, sent: list[int]) -> None:
    assert shared(BY_EVENT, path(0), path(1, off_m=off_m)) == sent


@pytest.mark.parametrize(("accel_m_s2", "sent"), [(0.95 * ACCEL_M_S2, [0]), (1.1 * ACCEL_M_S2, [0, 1])])
def test_further_ahead_it_may_differ_by_what_peers_allow_for(accel_m_s2: float, sent: list[int]) -> None:
    assert shared(BY_EVENT, path(0), path(1, accel_m_s2=accel_m_s2)) == sent


def test_small_changes_add_up_against_what_was_shared_and_not_against_the_last_path() -> None:
    assert shared(BY_EVENT, *(path(i, off_m=0.004 * i) for i in range(5))) == [0, 3]


def test_a_change_of_margin_is_shared_at_once() -> None:
    assert shared(BY_EVENT, path(0), path(1, margin_m=0.1), path(2, margin_m=0.1)) == [0, 1]


def test_peers_keep_the_error_more() -> None:
    assert margin_m(BY_EVENT, path(0, margin_m=0.2)) == pytest.approx(0.21)
    assert margin_m(BY_EVENT, path(0, margin_m=MAX_MARGIN_M)) == MAX_MARGIN_M, "more would be refused"


def test_a_path_from_before_the_shared_one_is_shared() -> None:
    assert shared(BY_EVENT, path(3), path(1)) == [3, 1], "a clock was set back"
