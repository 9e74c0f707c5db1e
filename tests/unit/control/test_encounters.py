"""Encounters with several keep-outs at once: each is measured by its own distance now, and remembered by its key."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields, replace

import numpy as np
import pytest

from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts
from swarmctl.control.collision.separation import certify
from tests import builders
from tests.benches.keep_outs import fixed, line


def at_north(north_m: float, key: Hashable) -> KeepOut:
    """Return a keep-out with hard minimum distance 0.8 m."""
    return replace(fixed((north_m, 0.0, 0.0), 0.8), key=key)


def entered_m(encounters: Encounters, *keep_outs: KeepOut, north_m: float = 0.0) -> list[float | None]:
    """Return where each was entered, as noted at a place north of the origin."""
    return [k.entered_m for k in encounters.noted(keep_outs, np.array([north_m, 0.0, 0.0]))]


def test_each_keep_out_has_its_own_encounter() -> None:
    encounters = Encounters()
    behind, ahead, far = at_north(-0.7, "behind"), at_north(1.2, "ahead"), at_north(5.0, "far")
    assert entered_m(encounters, behind, ahead, far) == [pytest.approx(0.7), None, None]
    assert entered_m(encounters, behind, ahead, far, north_m=0.05) == [pytest.approx(0.7), None, None]
    assert entered_m(encounters, far, ahead, behind, north_m=0.5) == [None, pytest.approx(0.7), None], "behind is left"


def test_two_that_are_entered_at_once_do_not_share_a_distance() -> None:
    """With the smaller one of both, certified plans may come as close to the other one."""
    encounters = Encounters()
    near, less_near = at_north(-0.5, "near"), at_north(0.7, "less near")
    noted = encounters.noted((near, less_near), np.zeros(3))
    assert [k.entered_m for k in noted] == pytest.approx([0.5, 0.7])
    assert certify(line((0.1, 0.0, 0.0), (0.1, 0.0, 0.0)), noted, 0) == 0.0, "comes no closer than it is"
    assert certify(line((0.0, 0.0, 0.0), (0.05, 0.0, 0.0)), noted, 0) < 0.0


def test_keep_outs_without_a_key_are_measured_by_where_the_vehicle_is_now() -> None:
    encounters = Encounters()
    assert entered_m(encounters, at_north(-0.7, None), at_north(0.5, None), at_north(0.6, 1)) == [
        None,
        None,
        pytest.approx(0.6),
    ]


def test_what_is_noted_keeps_its_places_and_radii() -> None:
    """Plans and the certificate read the stacked numbers."""
    keep_outs = (at_north(-0.7, 1), at_north(2.0, 2))
    noted, plain = Encounters().noted(keep_outs, np.zeros(3)), KeepOuts(keep_outs)
    assert noted[0].entered_m is not None
    np.testing.assert_array_equal(noted.pos_ned_m, plain.pos_ned_m)
    np.testing.assert_array_equal(noted.radius_m, plain.radius_m)
    for given, kept in zip(keep_outs, noted, strict=True):
        names = {field.name for field in fields(given)} - {"entered_m"}
        assert all(getattr(kept, name) is getattr(given, name) for name in names)


def test_an_encounter_begins_where_the_keep_out_is_now_and_not_where_it_will_be() -> None:
    leaving = replace(builders.keep_out(pos_ned_m=line((0.7, 0.0, 0.0), (5.7, 0.0, 0.0))), key=1)
    coming = replace(builders.keep_out(pos_ned_m=line((-5.7, 0.0, 0.0), (-0.7, 0.0, 0.0))), key=2)
    assert entered_m(Encounters(), leaving, coming) == [pytest.approx(0.7), None]


def test_an_encounter_beside_the_vehicle_counts_as_one_ahead() -> None:
    beside = replace(fixed((0.0, 0.6, 0.0), 0.8), key=1)
    clear = replace(fixed((0.0, 0.9, 0.0), 0.8), key=2)
    assert entered_m(Encounters(), beside, clear) == [pytest.approx(0.6), None]


@pytest.mark.parametrize(
    ("below_m", "downwash", "any_height", "found_m"),
    [
        (0.6, 1.0, False, 0.6),
        (1.2, 1.0, False, None),
        (1.2, 2.0, False, 0.6),
        (1.8, 2.0, False, None),
        (9.0, 1.0, True, 0.0),
    ],
    ids=["a sphere", "below a sphere", "in the downwash", "below the downwash", "a cylinder"],
)
def test_heights_count_as_in_the_certificate(
    below_m: float, downwash: float, any_height: bool, found_m: float | None
) -> None:
    keep_out = replace(fixed((0.0, 0.0, -5.0), 0.8, any_height), downwash=downwash, key=1)
    here = (0.0, 0.0, below_m - 5.0)
    (noted,) = Encounters().noted([keep_out], np.array(here))
    assert noted.entered_m == (None if found_m is None else pytest.approx(found_m))
    assert (certify(line(here, here), [keep_out], 0) == 0.0) is (found_m is not None), "which is violated, too"
