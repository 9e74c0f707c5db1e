"""The safety filter alone: half-spaces and certifier switched off, agents that fly through each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.collision import barrier
from swarmctl.core.obstacle import Obstacle
from tests.closed_loop.conftest import AT_100_HZ, COARSE, FINE, ROOT, Flight, Fly

NO_ROWS = ("mission.kind=swap", "sitl.start=air", "controller.kind=mpc", "mission.duration_s=7")
OFF = "agent.barrier.enabled=false"
BODY_M, X500_BODY_M = 0.48, 0.65
RADIUS_M, TRAVEL_S = 2.6, 6.5  # peaks at 1.5 m/s, so they close in at 3 m/s


def ring(count: int) -> tuple[str, ...]:
    """Return overrides for `count` agents on a circle, each with the opposite place as its goal."""
    angles = [2.0 * math.pi * i / count for i in range(count)]
    places = [[round(RADIUS_M * math.cos(a), 3), round(RADIUS_M * math.sin(a), 3), -3.0] for a in angles]
    return (
        AT_100_HZ,
        f"swarm.agents={count}",
        f"start.positions_ned_m={places}",
        f"mission.swap.travel_s={TRAVEL_S}",
        *NO_ROWS,
    )


def through_each_other(*overrides: str, config: str | None = None) -> Flight:
    """Fly until bodies have touched, or until all have passed."""
    flight = Lockstep(load(ROOT / "configs" / config if config else None, overrides))
    while flight.clock.now_us() < 60e6:
        flight.step()
        if flight.clock.now_us() % 100_000 == 0 and Flight(flight).separation_m() < 0.3:
            break
        if all(len(log.rows) and log.rows[-1]["mission_t_s"][0] > TRAVEL_S for log in flight.logs):
            break
    return Flight(flight)


def safety_filter_ticks(flight: Flight) -> list[int]:
    return [int(flight.ticks(i)["safety_filter_acted"].sum()) for i in range(flight.config.swarm.agents)]


@pytest.mark.parametrize("count", [2, 6])
def test_they_do_not_touch(count: int) -> None:
    flight = through_each_other(*ring(count))
    assert flight.separation_m() >= BODY_M
    assert min(safety_filter_ticks(flight)) > 10
    begun = [event for event in flight.lockstep.logs[0].events if event["event"] == "safety_filter"]
    assert begun[0]["acts"]


@pytest.mark.parametrize("count", [2, 6])
def test_negative_control_without_it_they_touch(count: int) -> None:
    flight = through_each_other(*ring(count), OFF)
    assert flight.separation_m() < BODY_M
    assert not any(safety_filter_ticks(flight))


def test_with_the_dead_time_and_lag_of_a_real_autopilot_they_do_not_touch() -> None:
    flight = through_each_other(*ring(2), FINE, "sitl.estimator=exact", config="x500_circle.toml")
    assert flight.separation_m() >= X500_BODY_M
    assert min(safety_filter_ticks(flight)) > 10


def test_negative_control_of_a_lag_that_it_is_not_told_of_they_touch() -> None:
    plain = ("vehicle_model.attitude_rad_s=0", "vehicle_model.delay_s=0", "vehicle_model.drag_1_s=0")
    flight = through_each_other(*ring(2), FINE, "sitl.estimator=exact", *plain, config="x500_circle.toml")
    assert flight.separation_m() < X500_BODY_M


def test_it_leaves_an_ordinary_flight_alone_bit_by_bit(fly: Fly) -> None:
    short = (*COARSE, "sitl.start=air", "mission.duration_s=2")
    with_it, without = fly(*short, until=Lockstep.mission_is_over), fly(*short, OFF, until=Lockstep.mission_is_over)
    assert not any(safety_filter_ticks(with_it))
    assert with_it.lockstep.truth.tobytes() == without.lockstep.truth.tobytes()
    for i in range(3):
        np.testing.assert_array_equal(with_it.ticks(i)["setpoint_q_nb"], without.ticks(i)["setpoint_q_nb"])


# -- an obstacle ahead ------------------------------------------------------------------------------------------------

AHEAD = (
    *COARSE,
    "sitl.start=air",
    "swarm.agents=1",
    "start.positions_ned_m=[[-12,0,-5]]",
    "mission.kind=goto",
    "mission.goto.goals_ned_m=[[14,0,-5]]",
    "mission.goto.speed_m_s=4.5",
    "mission.goto.accel_m_s2=2",
    "mission.duration_s=12",
)
COMING = Obstacle(  # seen too late to stop for it as planned
    center_ned_m=(12.94, 0.0, -5.1), radius_m=0.5, keep_out_m=1.1, visibility_m=4.25, vel_ned_m_s=(-1.0, 0.0, 0.0)
)


def clearance_m(fly: Fly) -> float:
    """Return the least true distance of the centre of an x500 from the surface of an obstacle that comes at it."""
    began_s: list[float] = []

    def add(running: Lockstep) -> None:
        running.set_obstacles([COMING])
        began_s.append(running.clock.now_us() * 1e-6)

    def past(running: Lockstep) -> bool:
        return bool(running.world.truth_rows()["pos_ned_m"][0, 0] > COMING.center_ned_m[0])

    flight = fly(*AHEAD, config="x500_circle.toml", at={1.0: add}, until=past)
    since_s = flight.t_s[flight.t_s >= began_s[0]] - began_s[0]
    centers = COMING.center_after(since_s[:, None])
    places = flight.pos_ned_m[flight.t_s >= began_s[0], 0]
    return float(np.linalg.norm(places - centers, axis=1).min()) - COMING.radius_m


def test_a_body_that_flies_at_an_obstacle_does_not_touch_it(fly: Fly) -> None:
    assert clearance_m(fly) > 0.5 * X500_BODY_M + 0.1


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_with_tilts_bounded_by_the_wanted_thrust_it_does(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(barrier, "_THRUSTS", 1)
    assert clearance_m(fly) < 0.5 * X500_BODY_M
