"""Aggressive flight of x500s, judged on true states: a circle at 7.5 m/s and a swap at 6 m/s, tilted by 54 degrees."""

from __future__ import annotations

import numpy as np

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.scenarios import layout_of
from sitl.studies.campaign.flight import TrialFlight
from sitl.studies.campaign.trials import Cell, Trial
from swarmctl.core.types import Phase
from tests.closed_loop.conftest import Flight, Fly

SETTLED_S = 4.0  # of the circle, flown from rest
FAST_SWAP = Cell(
    scenario="fast_swap", agents=8, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="default"
)


def circled(fly: Fly, *settings: str) -> Flight:
    return fly(
        "mission.duration_s=12",
        "sitl.start=air",
        *settings,
        config="x500_fast_circle.toml",
        until=Lockstep.mission_is_over,
    )


def rms_m(flight: Flight, *, believed: bool) -> float:
    """Return the RMS of the true, or of the estimated, distance to the reference once the circle is flown steadily."""
    ticks, error = flight.tracked(0)
    if believed:
        error = ticks["pos_ned_m"] - ticks["ref_pos_ned_m"]
    return float(np.sqrt(np.mean(np.linalg.norm(error[ticks["mission_t_s"] >= SETTLED_S], axis=1) ** 2)))


def test_a_circle_of_5_m_at_1_5_rad_s_is_tracked(fly: Fly) -> None:
    flight = circled(fly, "sitl.estimator=exact")
    ticks, _ = flight.tracked(0)
    speed_m_s = np.linalg.norm(ticks["vel_ned_m_s"][ticks["mission_t_s"] >= SETTLED_S], axis=1)
    assert speed_m_s.min() > 7.2
    assert rms_m(flight, believed=False) <= 0.06


def test_of_what_an_estimator_errs_on_it_the_controller_adds_little(fly: Fly) -> None:
    flight = circled(fly)
    assert rms_m(flight, believed=True) <= 0.06
    assert rms_m(flight, believed=False) <= 0.2, "the estimate is 20 ms old: 0.15 m at this speed"


def test_negative_control_inputs_that_change_at_the_first_steps_only_do_not_track_it(fly: Fly) -> None:
    first = circled(fly, "sitl.estimator=exact", "controller.mpc.blocking_xy=none", "controller.mpc.control_xy=15")
    assert rms_m(first, believed=False) > 0.15


def test_eight_swap_places_at_6_m_s() -> None:
    flight = TrialFlight(Trial(FAST_SWAP, 1), layout_of("fast_swap", 1, 8))
    flight.run()
    row = flight.row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= 0.65
    ticks = [log.ticks[log.ticks["phase"] == Phase.TRACK] for log in flight.lockstep.logs]
    fastest_m_s = [np.linalg.norm(rows["vel_ned_m_s"], axis=1).max() for rows in ticks]
    assert min(fastest_m_s) > 5.5


def test_the_way_home_from_a_fast_circle_swings_out_no_farther_than_braking_takes(fly: Fly) -> None:
    """By the acceleration of transits alone it led 21 m beyond the circle of 5 m."""
    flight = fly("mission.duration_s=6", "sitl.start=air", config="x500_fast_circle.toml")
    after = flight.t_s > float(flight.tracked(0)[0]["t_us"][-1]) * 1e-6
    assert np.abs(flight.pos_ned_m[after, 0, :2]).max() < 16.0
