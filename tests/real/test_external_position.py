"""Position fed from outside, as motion capture does: from the simulator's truth, into the autopilot's filter."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.studies.campaign.conditions.scenarios import AGILE
from tests.real.autopilots import PX4
from tests.real.conftest import Fielder
from tests.real.test_flights import LONE_PX4, PX4_CONFIG, flown_in_time, true_rmse_m
from tests.real.witness import Truth, Witness

pytestmark = [pytest.mark.process, pytest.mark.timeout(1500)]

FED = {  # see docs/real_autopilots.md, "Positions from outside"
    "EKF2_EV_CTRL": 3,
    "EKF2_GPS_CTRL": 0,
    "EKF2_HGT_REF": 3,
    "EKF2_EVP_NOISE": 0.01,
    "EKF2_ACC_NOISE": 1.0,
    "EKF2_DELAY_MAX": 40,
    "EKF2_TAU_POS": 0.1,
    "EKF2_TAU_VEL": 0.1,
}
CLOSE = (
    *("--set", "separation.radius_m=0.9"),
    *("--set", "swarm.origin_alt_m=0"),  # without GPS a PX4 takes its first height for 0 m above the sea
)
INDEX_M, SIX_INDEX_M = 1.72, 5.3  # what best effort flies
ORIGIN_EVERY, ORIGIN_UNTIL = 25, 300  # samples
SAMPLE_EVERY_US = 20_000
NO_COVARIANCE = [math.nan] * 21


def feed(witness: Witness, index: int, truth: Truth) -> None:
    """Send the origin of the frame, then one sample of the truth after the other."""
    samples = len(witness.vehicles[index].t_s)
    if samples < ORIGIN_UNTIL:
        if samples % ORIGIN_EVERY == 0:
            origin = PX4.origin
            place = round(origin.lat_deg * 1e7), round(origin.lon_deg * 1e7), 0
            witness.say(index, mav.MAVLink_set_gps_global_origin_message(index + 1, *place))
            witness.ask_truth_every(index, SAMPLE_EVERY_US)
        return
    velocity, rates = truth.vel_ned_m_s, (math.nan,) * 3
    frame = mav.MAV_FRAME_LOCAL_NED
    fields = (0, frame, frame, *truth.pos_ned_m, list(truth.q_nb), *velocity, *rates, NO_COVARIANCE, NO_COVARIANCE)
    witness.say(index, mav.MAVLink_odometry_message(*fields, 0, mav.MAV_ESTIMATOR_TYPE_VISION))


@pytest.mark.parametrize("time_number", [1, 2])
def test_three_px4_with_external_position_fly_close_together(field: Fielder, time_number: int) -> None:
    here = field(PX4, 3, FED, feed, is_alone=True)
    summary = flown_in_time(here, PX4_CONFIG, *CLOSE).summary()
    assert summary["violations"] == []
    assert summary["tracking"]["index_after_10s_m"] <= 1.75
    assert summary["separation"]["min_m"] >= 0.87
    assert here.witness.min_separation_m() >= 0.79


@pytest.mark.parametrize("time_number", [1, 2])
def test_three_px4_fly_close_together_by_commitments(field: Fielder, time_number: int) -> None:
    here = field(PX4, 3, FED, feed, is_alone=True)
    summary = flown_in_time(here, PX4_CONFIG, *CLOSE, "--set", "separation.mode=guaranteed").summary()
    assert summary["violations"] == [], "0.85 m by estimate among them"
    assert summary["tracking"]["index_after_10s_m"] <= 1.25 * INDEX_M
    assert here.witness.min_separation_m() >= 0.79


def six(field: Fielder, mode: str) -> dict[str, Any]:
    """Return the summary of six in one formation, at 25 Hz: two processors are too few for six at 50 Hz."""
    here = field(PX4, 6, FED, feed, is_alone=True)
    links = ", ".join(f'{{sysid={i + 1}, url="udpin://127.0.0.1:{14540 + i}"}}' for i in range(6))
    sets = ("swarm.agents=6", f"vehicles=[{links}]", "agent.rate_hz=25", f"separation.mode={mode}")
    launched = flown_in_time(here, PX4_CONFIG, *CLOSE, *(word for value in sets for word in ("--set", value)))
    assert here.witness.min_separation_m() >= 0.79
    return launched.summary()


def test_six_px4_fly_close_together_by_commitments(field: Fielder) -> None:
    summary = six(field, "guaranteed")
    assert summary["violations"] == [], "0.85 m by estimate among them"
    assert summary["tracking"]["index_after_10s_m"] <= 1.25 * SIX_INDEX_M


def test_six_px4_fly_close_together_without_them(field: Fielder) -> None:
    assert six(field, "best_effort")["tracking"]["index_after_10s_m"] == pytest.approx(SIX_INDEX_M, rel=0.1)


FAST = (
    *("--set", "mission.duration_s=30"),
    *(word for setting in AGILE for word in ("--set", setting)),
    *("--set", "controller.mpc.u_max=0.85"),
    *("--set", "vehicle_model.tilt_max_rad=1.05"),
)


@pytest.mark.parametrize(("omega_rad_s", "estimated_m", "true_m"), [(1.2, 0.07, 0.1), (1.5, 0.1, 0.15)])
def test_a_lone_px4_tracks_a_circle_of_5_m_at_6_and_7_5_m_s(
    field: Fielder, omega_rad_s: float, estimated_m: float, true_m: float
) -> None:
    """Tilted by 44 and 55 degrees, the faster one with `heading = "euler"` is 0.76 m beside it, if it flies at all."""
    here = field(PX4, 1, FED, feed, is_alone=True)
    circle = f"mission.circle={{omega_rad_s={omega_rad_s},climb_ned_m_s=0.0}}"
    launched = flown_in_time(here, PX4_CONFIG, *LONE_PX4, *CLOSE, *FAST, "--set", circle)
    assert launched.summary()["tracking"]["agents"][0]["steady_rmse_m"] < estimated_m
    assert true_rmse_m(launched, here.witness.vehicles[0]) < true_m
