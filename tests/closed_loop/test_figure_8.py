"""A figure-8 of least snap, 4 m from its middle to its ends, by an x500 whose estimator errs as a real one does."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.core.types import Array
from tests.closed_loop.conftest import Flight, Fly


def errors_m(flight: Flight) -> tuple[Array, Array, Array]:
    """Return distances (K,) of a figure: true to reference, estimated to reference, true to estimated position."""
    ticks, error = flight.tracked(0)
    moves = np.linalg.norm(np.diff(ticks["ref_pos_ned_m"], axis=0, prepend=0.0), axis=1) > 1e-6
    flown = ticks["mission_t_s"] <= float(ticks["mission_t_s"][moves][-1])
    believed = ticks["pos_ned_m"] - ticks["ref_pos_ned_m"]
    return tuple(np.linalg.norm(part[flown], axis=1) for part in (error, believed, error - believed))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def flown(fly: Fly, speed_m_s: float, *settings: str) -> Flight:
    fast = f"mission.waypoints.speed_m_s={speed_m_s}", f"mission.duration_s={44.0 / speed_m_s}"
    return fly(*fast, "sitl.start=air", *settings, config="x500_figure_8.toml", until=Lockstep.mission_is_over)


@pytest.mark.parametrize(("speed_m_s", "true_m", "believed_m"), [(2.0, 0.06, 0.02), (4.0, 0.15, 0.03)])
def test_it_is_tracked(fly: Fly, speed_m_s: float, true_m: float, believed_m: float) -> None:
    flight = flown(fly, speed_m_s)
    true, believed, estimate = (rms(values) for values in errors_m(flight))
    ticks, _ = flight.tracked(0)
    assert np.linalg.norm(ticks["vel_ned_m_s"], axis=1).max() > 0.9 * speed_m_s
    assert np.ptp(ticks["ref_pos_ned_m"][:, 0]) > 7.9
    assert true <= true_m
    assert believed <= believed_m, "the rest is the estimator's, which no controller sees"
    assert estimate > 0.02, "it errs"


def test_negative_control_plans_that_turn_slowly_do_not_track_it(fly: Fly) -> None:
    true, believed, _ = errors_m(flown(fly, 4.0, "controller.mpc.du_max=0.05"))
    assert rms(true) > 0.15
    assert rms(believed) > 0.1
