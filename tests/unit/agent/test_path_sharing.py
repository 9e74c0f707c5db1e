"""Event-triggered sharing: what peers hold is never older, nor further off, than they allow for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.agent.sharing.path_sharing import PathSharing, PathSharingParams
from swarmctl.bus.messages.path_messages import decode_path
from swarmctl.control.collision.separation import SeparationParams, align
from swarmctl.core.types import MAX_MARGIN_M, PredictedPath

TICK_US = 20_000
ACCEL_M_S2 = 4.0
SEPARATION = SeparationParams(age_accel_m_s2=ACCEL_M_S2)
BY_EVENT = PathSharingParams(error_m=0.01, heartbeat_s=0.1, compact=True)
ROUNDED_M = 2e-5  # of the gentle paths here


def path(tick: int, *, off_m: float = 0.0, accel_m_s2: float = 0.0, margin_m: float = 0.0) -> PredictedPath:
    """Flight eastward at 1 m/s as predicted in a tick; `off_m` north, and turning north with an acceleration."""
    ahead_s = np.arange(41) * 0.02
    north, east = off_m + 0.5 * accel_m_s2 * ahead_s**2, tick * 0.02 + ahead_s
    pos = np.column_stack([north, east, np.zeros(41)])
    return PredictedPath(
        agent=0, boot_id=1, seq=tick, t0_utc_us=tick * TICK_US, dt_us=TICK_US, margin_m=margin_m, pos_ned_m=pos
    )


def read(payload: bytes | None) -> PredictedPath | None:
    """The path that peers read; None if there is no message."""
    decoded = None if payload is None else decode_path(payload)
    assert payload is None or decoded is not None
    return decoded


def shared(params: PathSharingParams, *paths: PredictedPath) -> list[int]:
    """Numbers of the paths that are published."""
    sharing = PathSharing(params, SEPARATION)
    return [known.seq for each in paths if (known := read(sharing.message(each))) is not None]


def margin_m(params: PathSharingParams, first: PredictedPath) -> float:
    """Margin of the first path that is published."""
    known = read(PathSharing(params, SEPARATION).message(first))
    assert known is not None
    return known.margin_m


def test_every_path_is_shared_unless_asked_otherwise() -> None:
    assert shared(PathSharingParams(), *(path(i) for i in range(5))) == [0, 1, 2, 3, 4]
    assert margin_m(PathSharingParams(), path(0, margin_m=0.2)) == pytest.approx(0.2, abs=ROUNDED_M)


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


def test_a_larger_margin_is_shared_at_once_and_again_for_who_missed_it() -> None:
    assert shared(BY_EVENT, path(0), *(path(i, margin_m=0.1) for i in range(1, 5))) == [0, 1, 2]


def test_a_smaller_margin_is_shared_at_once() -> None:
    assert shared(BY_EVENT, path(0, margin_m=0.1), *(path(i) for i in range(1, 5))) == [0, 1]


def test_a_path_that_is_new_is_shared_again_for_who_missed_it() -> None:
    assert shared(BY_EVENT, path(0), *(path(i, off_m=0.05) for i in range(1, 5))) == [0, 1, 2]


def test_it_is_not_where_the_one_before_does() -> None:
    """At 0.08 s peers keep 13 mm more because of its age."""
    near = [path(i) for i in range(4)] + [path(i, off_m=0.02) for i in range(4, 6)]
    assert shared(BY_EVENT, *near) == [0, 4]


def turning(seed: int) -> list[PredictedPath]:
    """The paths of two seconds of a vehicle that changes its acceleration at times, and its margin."""
    rng = np.random.default_rng(seed)
    pos, vel, accel, more_m = np.zeros(3), rng.uniform(-2.0, 2.0, 3), np.zeros(3), 0.0
    found, ahead_s = [], np.arange(41)[:, None] * 0.02
    for tick in range(100):
        if rng.random() < 0.1:
            accel = rng.uniform(-6.0, 6.0, 3)
        if rng.random() < 0.03:
            more_m = rng.choice([0.0, 0.1, 0.2])
        points = pos + vel * ahead_s + 0.5 * accel * ahead_s**2
        found.append(
            PredictedPath(
                agent=0,
                boot_id=1,
                seq=tick,
                t0_utc_us=tick * TICK_US,
                dt_us=TICK_US,
                margin_m=more_m,
                pos_ned_m=points,
            )
        )
        pos, vel = points[1], vel + 0.02 * accel
    return found


def least_kept_m(seed: int, sharing: PathSharing, *, forgets: bool = False) -> float:
    """By how much, at least, what a peer keeps exceeds the error of its copy, within what a plan can change later.

    The peer misses a third of the messages, but no two in succession. Ticks in which it misses one are left out.
    """
    rng, known, missed, spare_m = np.random.default_rng([seed, 1]), None, True, []
    for each in turning(seed):
        payload = sharing.message(each)
        if forgets:
            sharing._before = None
        if missed := payload is not None and not missed and bool(rng.random() < 0.5):
            continue
        known = read(payload) or known
        assert known is not None
        age_s = (each.t0_utc_us - known.t0_utc_us) * 1e-6
        error_m = np.linalg.norm(
            each.pos_ned_m - align(known, each.t0_utc_us, TICK_US, 40, brake_m_s2=SEPARATION.brake_m_s2), axis=1
        )
        kept_m = known.margin_m - each.margin_m + SEPARATION.budget.age_margin_m(age_s, parked=False)
        spare_m.append(float((kept_m + 0.5 * ACCEL_M_S2 * (np.arange(41) * 0.02) ** 2 - error_m).min()))
    return min(spare_m)


@pytest.mark.parametrize("compact", [True, False])
def test_who_misses_any_message_but_not_two_keeps_as_much_as_its_copy_is_off(compact: bool) -> None:
    params = BY_EVENT.model_copy(update={"compact": compact})
    assert min(least_kept_m(seed, PathSharing(params, SEPARATION)) for seed in range(20)) >= -1e-6


def test_negative_control_without_the_path_before_who_misses_one_keeps_too_little() -> None:
    assert min(least_kept_m(seed, PathSharing(BY_EVENT, SEPARATION), forgets=True) for seed in range(20)) < -0.01


@pytest.mark.parametrize(("compact", "sent"), [(True, [0, 1, 2]), (False, [0])])
def test_paths_are_compared_as_peers_read_them(compact: bool, sent: list[int]) -> None:
    """With sharp bends somewhere the unit is a millimetre; here every point is half of it away from what is sent."""
    params = PathSharingParams(error_m=0.0005, compact=compact)
    unit_m, ahead = 2.0**-10, np.arange(44)
    east, north = 20 * unit_m * ahead + 0.49 * unit_m, 0.49 * unit_m + 110 * unit_m * np.maximum(0, ahead - 39)
    whole = np.column_stack([north, east, np.full(44, 0.49 * unit_m)])
    paths = [replace(path(i), pos_ned_m=whole[i : i + 41]) for i in range(3)]
    assert shared(params, *paths) == sent


def test_peers_keep_the_error_more() -> None:
    assert margin_m(BY_EVENT, path(0, margin_m=0.2)) == pytest.approx(0.21, abs=ROUNDED_M)
    assert margin_m(BY_EVENT, path(0, margin_m=MAX_MARGIN_M)) == MAX_MARGIN_M, "more would be refused"


def test_a_path_from_before_the_shared_one_is_shared() -> None:
    assert shared(BY_EVENT, path(3), path(1)) == [3, 1], "a clock was set back"


def test_a_path_too_fast_for_peers_is_told_and_not_taken_for_known() -> None:
    """An estimate that has run away must not end its agent."""
    ran_away = replace(path(0), pos_ned_m=np.outer(np.arange(41), [12.0, 0.0, 0.0]))
    sharing = PathSharing(BY_EVENT, SEPARATION)
    assert sharing.message(ran_away) is not None
    assert read(sharing.message(path(1))) is not None, "peers know of no path"
