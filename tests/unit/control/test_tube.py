"""What follows when a vehicle leaves the tube around its committed trajectory."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.commit.tube import Grip, Tube

NOMINAL_M = 0.2
TICK_US = 20_000


def flown(tube: Tube, errors_m: list[float], speed_m_s: float = 1.0, since_us: int = 0) -> list[bool]:
    """Return in which ticks the vehicle has left its tube."""
    return [tube.update(since_us + k * TICK_US, error_m, speed_m_s) for k, error_m in enumerate(errors_m)]


def test_a_vehicle_that_stays_inside_tells_the_nominal_tube() -> None:
    tube = Tube(NOMINAL_M)
    assert not any(flown(tube, [0.0, 0.1, 0.2, 0.1], 3.0))
    assert (tube.radius_m, tube.worst_m, tube.grip(4 * TICK_US)) == (NOMINAL_M, 0.2, Grip.HELD)


def test_a_vehicle_outside_is_reported_until_it_is_back() -> None:
    tube = Tube(NOMINAL_M)
    grips = []
    for k, error_m in enumerate((0.1, 0.3, 0.1)):
        tube.update(k * TICK_US, error_m, 0.2)
        grips.append(tube.grip(k * TICK_US))
    assert grips == [Grip.HELD, Grip.OUTSIDE, Grip.HELD]


def test_a_widened_tube_grows_with_the_speed_of_the_deviation_and_narrows_again() -> None:
    radii_m = []
    for speed_m_s in (0.5, 2.0, 100.0):
        tube = Tube(NOMINAL_M)
        assert flown(tube, [0.3], speed_m_s) == [False], "0.1 m outside is not far"
        radii_m.append(tube.radius_m)
    assert radii_m == pytest.approx([NOMINAL_M + 0.25, NOMINAL_M + 0.7, NOMINAL_M + 2.0])
    flown(tube, [0.0] * 250, since_us=TICK_US)
    assert NOMINAL_M < tube.radius_m < NOMINAL_M + 0.05


@pytest.mark.parametrize(
    ("speed_m_s", "lost"),
    [(2.0, [False, False, True, True]), (0.5, [False, False, False, True])],
    ids=["blown", "lags"],
)
def test_a_vehicle_that_is_blown_away_or_far_outside_commits_anew(speed_m_s: float, lost: list[bool]) -> None:
    assert flown(Tube(NOMINAL_M), [0.1, 0.34, 0.36, 0.71], speed_m_s) == lost


def test_a_vehicle_that_merely_lags_has_not_lost_its_commitment() -> None:
    tube = Tube(NOMINAL_M)
    assert not tube.update(0, 0.6, 1.5, late_m=0.3)
    assert tube.radius_m > 0.6, "but peers are told"
    assert tube.update(TICK_US, 0.6, 1.5), "aside it would be blown away"
    assert tube.update(2 * TICK_US, 0.8, 1.5, late_m=0.5), (
        "who can't commit to anything slower for that long has to stop"
    )


@pytest.mark.parametrize(
    ("outside_m", "pace_01"), [(-0.1, 1.0), (0.03, 1.0), (0.08, 0.5), (0.13, 0.0), (0.4, 0.0)], ids=str
)
def test_outside_its_tube_a_vehicle_plans_to_be_slower_and_then_to_stand(outside_m: float, pace_01: float) -> None:
    tube = Tube(NOMINAL_M)
    tube.update(0, NOMINAL_M + outside_m, 0.1)
    assert tube.pace_01 == pytest.approx(pace_01)


def test_a_vehicle_that_is_back_gains_pace_little_by_little() -> None:
    tube = Tube(NOMINAL_M)
    tube.update(0, NOMINAL_M + 0.2, 0.1)
    paces = []
    for k in range(1, 121):
        tube.update(k * TICK_US, 0.0, 0.0)
        paces.append(tube.pace_01)
    assert paces[0] == pytest.approx(0.01)
    assert paces[49] == pytest.approx(0.5)
    assert paces[-1] == 1.0


def test_being_far_outside_again_and_again_has_growing_consequences() -> None:
    tube, grips = Tube(NOMINAL_M), []
    for k in range(40):
        tube.update(k * TICK_US, 0.8, 1.0)
        grips.append(tube.grip(k * TICK_US))
    assert grips == [Grip.WIDENED] * 2 + [Grip.STOPPED] * 37 + [Grip.LOST]


@pytest.mark.parametrize(("lost_times", "inside_s", "grip"), [(3, 0.5, Grip.STOPPED), (3, 1.1, Grip.HELD)])
def test_a_stopped_vehicle_goes_on_after_a_second(lost_times: int, inside_s: float, grip: Grip) -> None:
    tube = Tube(NOMINAL_M)
    flown(tube, [0.8] * lost_times)
    now_us = lost_times * TICK_US + round(1e6 * inside_s)
    tube.update(now_us, 0.0, 0.0)
    assert tube.grip(now_us) is grip


def test_losses_long_ago_do_not_count() -> None:
    tube, times_us = Tube(NOMINAL_M), np.arange(8) * 6_000_000
    for t_us in times_us.tolist():
        tube.update(t_us, 0.8, 1.0)
        assert tube.grip(t_us) is Grip.WIDENED, "at most two in any 10 s"


@pytest.mark.parametrize(
    ("errors_m", "speed_m_s", "lost"),
    [([0.5] * 250, 0.0, True), ([0.5] * 140, 0.0, False), ([0.5] * 250, 0.2, False), ([0.2] * 250, 0.0, False)],
    ids=["rests", "not long enough", "moves", "inside"],
)
def test_a_vehicle_that_rests_outside_for_ever_commits_anew(
    errors_m: list[float], speed_m_s: float, lost: bool
) -> None:
    """One that had evaded out of the flight volume, and was kept in it, waited 0.42 m from there till it was landed."""
    tube = Tube(NOMINAL_M)
    ticks = enumerate(errors_m)
    assert any(tube.update(k * TICK_US, error_m, 0.16, speed_m_s=speed_m_s) for k, error_m in ticks) is lost


def test_negative_control_one_that_comes_back_slowly_does_not() -> None:
    tube, errors_m = Tube(NOMINAL_M), np.linspace(0.6, 0.2, 500)
    assert not any(tube.update(k * TICK_US, float(e), 0.05, speed_m_s=0.05) for k, e in enumerate(errors_m))
