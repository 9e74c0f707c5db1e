"""What a recorded flight says of its vehicle, on flights whose truth is known: drawn from the model itself.

Estimators err as a real autopilot's does: reported positions and tilts wander, and are noisy. An interval that is
called one of 95 % has to hold the truth about that often, over many flights.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.config import Config, load
from swarmctl.control.estimation.identification import Figure, FlightSegment, Identified, identify, longest_segment
from swarmctl.control.lag import Lag
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_body_z
from swarmctl.core.records import TICK_DTYPE
from swarmctl.core.types import Array, Phase
from swarmctl.ops.identify import identification, table

TRUTH = VehicleModelParams(
    delay_s=0.072, attitude_rad_s=9.0, attitude_damping=0.9, drag_1_s=0.6, hover_thrust_01=0.42, tilt_max_rad=0.7
)
DT_S = 0.02
WIND_NED_M_S = np.array([1.0, -2.0, 0.0])
NAMES = Identified.__slots__


def follow(flight_s: float, seed: int, truth: VehicleModelParams = TRUTH, errors: float = 1.0) -> NDArray[np.void]:
    """Return ticks of a flight around its start with random pushes; `errors` scales the estimator's errors."""
    rng = np.random.default_rng(seed)
    count, fine_s = round(flight_s / DT_S), 0.004
    lag, late = Lag(truth.attitude_rad_s, truth.attitude_damping), round(truth.delay_s / fine_s)
    of_tilt = np.array(lag.advance(1.0, 0.0, 0.0, fine_s))[:2, None]
    of_rate = np.array(lag.advance(0.0, 1.0, 0.0, fine_s))[:2, None]
    of_asked = np.array(lag.advance(0.0, 0.0, 1.0, fine_s))[:2, None]
    ticks = np.zeros(count, TICK_DTYPE)
    pos, vel, tilt, rate = np.zeros(3), np.zeros(3), np.zeros(2), np.zeros(2)
    asked = [np.zeros(3)] * (late + 1)  # tilt and thrust, a fine step each
    wander, push = np.zeros(5), np.zeros(3)
    for k in range(count):
        if k % 40 == 0:
            push = rng.uniform(-1.0, 1.0, 3) * (0.25, 0.25, 0.03)
        wander += DT_S / 4.0 * -wander + errors * math.sqrt(DT_S) * rng.normal(size=5) * (0.03, 0.03, 0.03, 3e-3, 3e-3)
        hold = 0.05 * pos[:2] + 0.1 * vel[:2]
        tilt_asked = np.clip(push[:2] + hold, -0.5, 0.5)
        up = math.sqrt(1.0 - float(tilt @ tilt))
        thrust = truth.hover_thrust_01 * (1.0 + 0.2 * pos[2] + 0.4 * vel[2] + push[2]) / up
        row = ticks[k]
        row["t_us"], row["phase"], row["state_age_ms"] = round(1e6 * k * DT_S), Phase.TRACK, 0.0
        row["pos_ned_m"] = pos + wander[:3] + errors * 0.003 * rng.normal(size=3)
        seen = tilt + wander[3:] + errors * 0.002 * rng.normal(size=2)
        row["q_nb"] = quat_from_body_z(np.array([*seen, math.sqrt(1.0 - float(seen @ seen))]), 0.0)
        down = np.array([*tilt_asked, math.sqrt(1.0 - float(tilt_asked @ tilt_asked))])
        row["setpoint_q_nb"], row["setpoint_thrust_01"] = quat_from_body_z(down, 0.0), thrust
        for _ in range(round(DT_S / fine_s)):
            asked.append(np.array([*tilt_asked, thrust]))
            acts = asked[-1 - late]
            tilt, rate = of_tilt * tilt + of_rate * rate + of_asked * acts[:2]
            down = np.array([*tilt, math.sqrt(1.0 - float(tilt @ tilt))])
            accel = -GRAVITY_M_S2 * acts[2] / truth.hover_thrust_01 * down - truth.drag_1_s * (vel - WIND_NED_M_S)
            accel[2] += GRAVITY_M_S2
            pos, vel = pos + fine_s * vel + 0.5 * fine_s**2 * accel, vel + fine_s * accel
    return ticks


def result(ticks: NDArray[np.void]) -> Identified:
    flight = longest_segment(ticks)
    assert isinstance(flight, FlightSegment), flight
    found = identify(flight)
    assert isinstance(found, Identified), found
    return found


def test_a_flight_without_errors_recovers_the_vehicle() -> None:
    found = result(follow(40.0, 1, errors=0.0))
    for name in NAMES:
        assert getattr(found, name).value == pytest.approx(getattr(TRUTH, name), rel=0.02), name


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    flights = 16
    found = [result(follow(30.0, seed)) for seed in range(flights)]
    for name in NAMES:
        figures = [getattr(one, name) for one in found]
        inside = sum(f.low <= getattr(TRUTH, name) <= f.high for f in figures)
        assert inside >= flights - 3, f"{name}: {inside} of {flights}"  # 4 of 16 outside have a chance of 0.7 %
        widths = [(f.high - f.low) / f.value for f in figures]
        assert np.median(widths) < 0.2, name  # an interval of everything would hold the truth as well


@pytest.mark.parametrize("delay_s", [0.0, 0.2])
def test_dead_times_far_from_the_first_guess_are_found(delay_s: float) -> None:
    found = result(follow(40.0, 3, TRUTH.model_copy(update={"delay_s": delay_s})))
    assert found.delay_s.value == pytest.approx(delay_s, abs=0.012)
    assert found.delay_s.low >= 0.0


def test_only_setpoints_before_an_interruption_are_used() -> None:
    ticks = follow(40.0, 4)
    ticks["setpoint_thrust_01"][1200:1300] = np.nan  # 24 s, 2 s of a pilot, 14 s
    flight = longest_segment(ticks)
    assert isinstance(flight, FlightSegment)
    assert flight.sent_s[-1] == pytest.approx(1199 * DT_S)
    assert result(ticks).hover_thrust_01.value == pytest.approx(TRUTH.hover_thrust_01, rel=0.02)


def still(ticks: NDArray[np.void]) -> NDArray[np.void]:
    ticks["setpoint_q_nb"] = (1.0, 0.0, 0.0, 0.0)
    return ticks


def of_peers(ticks: NDArray[np.void]) -> NDArray[np.void]:
    ticks["q_nb"] = np.roll(ticks["q_nb"], 700, axis=0)
    return ticks


def grounded(ticks: NDArray[np.void]) -> NDArray[np.void]:
    ticks["phase"] = Phase.STANDBY
    return ticks


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (still, "hardly tilted"),
        (of_peers, "does not follow setpoints"),
        (grounded, "no setpoints"),
        (lambda ticks: ticks[:400], "10 s are needed"),
    ],
)
def test_a_flight_without_information_is_refused(spoil, why: str) -> None:  # type: ignore[no-untyped-def]
    flight = longest_segment(spoil(follow(40.0, 5)))
    found = identify(flight) if isinstance(flight, FlightSegment) else flight
    assert isinstance(found, str)
    assert why in found


def reference(**own: float) -> MissionReference:
    starts = np.array([[0.0, 0.0, -3.0], [5.0, 0.0, -3.0]])
    params = MissionParams.model_validate({"kind": "identify", "identify": own})
    return MissionReference(params, starts, 1)


def sampled(mission: MissionReference, until_s: float) -> Array:
    return mission.sample(np.arange(0.0, until_s, 0.1))[0]


def test_steps_begin_and_end_on_the_own_start_and_go_both_ways() -> None:
    params = MissionParams.model_validate({"kind": "identify"}).identify
    places = sampled(reference(), params.duration_s) - (5.0, 0.0, -3.0)
    assert np.all(places[[0, -1]] == 0.0)
    assert places.min(axis=0) == pytest.approx((-params.step_m, -params.step_m, -params.climb_m))
    assert places.max(axis=0) == pytest.approx((params.step_m, params.step_m, 0.0))


@pytest.mark.parametrize(
    ("pos", "vel", "why"),
    [
        ((5.0, 4.9, -3.0), (0.0, 4.9, 0.0), ""),
        ((5.0, 5.1, -3.0), (0.0, 0.0, 0.0), "distance_max_m is 5"),
        ((5.0, 0.0, -3.0), (3.0, 3.0, 3.0), "speed_max_m_s is 5"),
    ],
)
def test_leaving_the_limits_ends_the_flight(pos: tuple[float, ...], vel: tuple[float, ...], why: str) -> None:
    excess = reference().excess(np.array(pos), np.array(vel))
    assert (why in excess) if why else excess == ""


def test_no_other_mission_ends_by_it() -> None:
    circle = MissionReference(MissionParams(), np.zeros((1, 3)), 0)
    assert circle.excess(np.full(3, 100.0), np.full(3, 100.0)) == ""


def configured(tmp_path: Path, text: str) -> Config:
    path = tmp_path / "vehicles.toml"
    path.write_text(text)
    return load(path)


LISTED = "swarm.agents = 1\nsitl.enabled = false\n[vehicle_model]\ntilt_max_rad = 0.7\n"
FOUND = Identified(*(Figure(v, 0.9 * v, 1.1 * v) for v in (0.0712, 9.123, 0.9, 0.61, 0.4242)))


def test_the_table_is_a_configuration_that_flies_what_was_found(tmp_path: Path) -> None:
    before = configured(tmp_path, LISTED + '[[vehicles]]\nsysid = 3\nurl = "udpin://127.0.0.1:14540"\n')
    text = table(before, {0: FOUND}, "2026-01-01")
    after = configured(tmp_path, LISTED + text)
    assert after.vehicles[0].sysid == 3
    assert after.model_of(0) == FOUND.model(before.model_of(0))
    assert (after.model_of(0).attitude_rad_s, after.model_of(0).tilt_max_rad) == (9.12, 0.7)
    assert "hover_thrust_01 = 0.424  # 0.382 to 0.467" in text


def test_the_simulators_table_is_the_model_of_all(tmp_path: Path) -> None:
    after = configured(tmp_path, table(Config(), {0: FOUND, 1: FOUND}, "2026-01-01"))
    assert after.vehicle_model == FOUND.model(Config().vehicle_model)


def test_an_identification_flies_the_same_vehicles_in_another_mission() -> None:
    config = Config()
    flight = identification(config)
    assert (flight.mission.kind, flight.mission.duration_s) == ("identify", config.mission.identify.duration_s)
    assert flight.model_copy(update={"mission": config.mission, "telemetry": config.telemetry}) == config
