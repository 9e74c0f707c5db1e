"""References by hand-computed values, and that what is flown to and fro is smooth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swarmctl.control.reference.kind import MISSIONS
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.control.reference.quintic import QuinticTrajectory, brake_to_rest, quintic_to, transit_to
from swarmctl.core.types import Array

STARTS = np.array([[-1.0, 0.0, -1.0], [0.0, 0.0, -1.0], [1.0, 3.0, -4.0]])

GOTO = {"goals_ned_m": [[6.0, -4.0, -2.0]]}


def sample(t_s: list[float], agent: int = 0, **params: Any) -> tuple[Array, Array]:
    return MissionReference(MissionParams.model_validate(params), STARTS, agent).sample(np.array(t_s))


def test_circle_of_the_thesis() -> None:
    # 5 cos(0.5 t), 5 sin(0.5 t), -1 - 0.1 t at t = 0 and pi (a quarter turn)
    pos, vel = sample([0.0, math.pi], kind="circle")
    np.testing.assert_allclose(pos, [[5.0, 0.0, -1.0], [0.0, 5.0, -1.0 - 0.1 * math.pi]], atol=1e-12)
    np.testing.assert_allclose(vel, [[0.0, 2.5, -0.1], [-2.5, 0.0, -0.1]], atol=1e-12)


def test_all_agents_share_the_circle() -> None:
    for agent in (1, 2):
        np.testing.assert_array_equal(sample([2.0], agent)[0], sample([2.0], 0)[0])


def test_line_of_the_thesis() -> None:
    pos, vel = sample([0.0, 5.0], kind="line")
    np.testing.assert_allclose(pos, [[2.0, 2.0, -2.0], [9.5, 5.5, -2.5]])
    np.testing.assert_allclose(vel, [[1.5, 0.7, -0.1]] * 2)


def test_steps_change_exactly_at_their_times() -> None:
    rows = [[0.0, 0.0, 0.0, -5.0], [15.0, 2.0, 0.0, -5.0], [30.0, 2.0, 2.0, -5.0]]
    pos, vel = sample([0.0, 14.999, 15.0, 29.999, 30.0, 1000.0], kind="steps", steps={"rows": rows})
    np.testing.assert_allclose(pos[:, 0], [0.0, 0.0, 2.0, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(pos[:, 1], [0.0, 0.0, 0.0, 0.0, 2.0, 2.0])
    np.testing.assert_allclose(pos[:, 2], -5.0)
    assert not vel.any()


def test_hover_stays_at_the_own_start() -> None:
    pos, vel = sample([0.0, 7.0], agent=2, kind="hover")
    np.testing.assert_array_equal(pos, [STARTS[2]] * 2)
    assert not vel.any()


def test_a_swap_ends_opposite_through_the_middle_of_the_swarm() -> None:
    middle = STARTS.mean(axis=0)
    for agent in range(3):
        pos, vel = sample([0.0, 4.0, 8.0, 20.0], agent=agent, kind="swap", swap={"travel_s": 8.0})
        np.testing.assert_allclose(pos[0], STARTS[agent], atol=1e-12)
        np.testing.assert_allclose(pos[1], middle, atol=1e-12)
        np.testing.assert_allclose(pos[2:], [2 * middle - STARTS[agent]] * 2, atol=1e-12)
        np.testing.assert_allclose(vel[[0, 2, 3]], 0.0, atol=1e-12)
        # a quintic from rest to rest is fastest in the middle: 1.875 of its mean
        np.testing.assert_allclose(vel[1], 1.875 * (pos[2] - pos[0]) / 8.0, atol=1e-12)


def test_agents_fly_to_their_own_goals_or_to_a_shared_one_and_stay() -> None:
    goals = [[5.0, 0.0, -1.0], [0.0, 6.0, -2.0], [1.0, 3.0, -4.0]]
    for agent in range(3):
        pos, vel = sample([0.0, 60.0, 90.0], agent, kind="goto", goto={"goals_ned_m": goals})
        np.testing.assert_allclose(pos, [STARTS[agent], goals[agent], goals[agent]], atol=1e-12)
        assert not vel.any()
        np.testing.assert_allclose(
            sample([60.0], agent, kind="goto", goto={"goals_ned_m": goals[:1]})[0], goals[:1], atol=1e-12
        )


def test_the_flight_to_a_goal_keeps_speed_and_acceleration() -> None:
    t_s = np.arange(0.0, 20.0, 0.01)
    goto = {"goals_ned_m": [[9.0, 8.0, -1.0]], "speed_m_s": 1.5, "accel_m_s2": 1.0}
    _, vel = sample(t_s.tolist(), kind="goto", goto=goto)
    assert np.linalg.norm(vel, axis=1).max() == pytest.approx(1.5, rel=1e-3)  # as fast as asked, not faster
    assert np.linalg.norm(np.diff(vel, axis=0), axis=1).max() / 0.01 <= 1.0


@pytest.mark.parametrize("kind", ["hover", "circle", "line", "steps", "swap", "goto"])
def test_before_its_time_a_mission_waits_at_rest_where_it_begins(kind: str) -> None:
    pos, vel = sample([-100.0, -1e-6, 0.0], kind=kind, goto=GOTO)
    np.testing.assert_array_equal(pos[:2], [pos[2]] * 2)
    assert not vel[:2].any()


@pytest.mark.parametrize("kind", ["circle", "line", "swap", "goto"])
def test_velocity_is_the_derivative_of_position(kind: str) -> None:
    t_s = np.linspace(0.1, 12.0, 200)
    h = 1e-5
    forward, back = (sample((t_s + sign * h).tolist(), kind=kind, goto=GOTO)[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(sample(t_s.tolist(), kind=kind, goto=GOTO)[1], (forward - back) / (2 * h), atol=1e-6)


def test_missions_that_make_no_sense_are_refused() -> None:
    assert list(MissionParams().problems(1)) == []
    backwards = MissionParams.model_validate({"kind": "steps", "steps": {"rows": [[5.0, 0, 0, 0], [1.0, 0, 0, 0]]}})
    assert "increasing" in next(iter(backwards.problems(3)))
    assert "at least 2" in next(iter(MissionParams(kind="swap").problems(1)))
    for goals, refused in ((0, True), (1, False), (2, True), (3, False)):
        mission = MissionParams.model_validate({"kind": "goto", "goto": {"goals_ned_m": [[0.0, 0.0, -2.0]] * goals}})
        assert [f"{goals} goals" in p for p in mission.problems(3)] == [True] * refused


def test_every_kind_declares_itself_once() -> None:
    own = {"kind", "duration_s", "yaw_rad", "own"}
    assert set(MissionParams.model_fields) - own == set(MISSIONS) - {"hover"}, (
        "a kind without parameters has no section"
    )
    for name, kind in MISSIONS.items():
        mission = MissionParams(kind=name)
        assert type(mission.flown()) is kind
        if name in ("goto", "waypoints", "csv", "skybrush"):  # which have no goals, points and files by default
            assert len(list(mission.problems(3))) == 1
            continue
        assert list(mission.problems(3)) == []
        pos, vel = MissionReference(mission, STARTS, 1).sample(np.array([-1.0, 0.0, 3.0]))
        assert pos.shape == vel.shape == (3, 3)
        assert (vel[0] == 0.0).all()


# -- quintic trajectories ----------------------------------------------------------------------------------------------

FROM, VEL, TO = np.array([1.0, -2.0, -3.0]), np.array([1.5, 0.5, -0.25]), np.array([4.0, 4.0, -2.0])


def derivatives(trajectory: QuinticTrajectory) -> tuple[Array, Array, Array]:
    """Velocity as said, velocity and acceleration by finite differences, at the same times through both ends."""
    h = 1e-4
    t_s = np.linspace(-0.2, trajectory.travel_s + 0.2, 1501)
    t_s = t_s[(np.abs(t_s) > 2 * h) & (np.abs(t_s - trajectory.travel_s) > 2 * h)]
    before, after = trajectory.sample(t_s - h), trajectory.sample(t_s + h)
    inside = t_s > 0.0
    return (
        trajectory.sample(t_s)[1][inside],
        ((after[0] - before[0]) / (2 * h))[inside],
        ((after[1] - before[1]) / (2 * h))[inside],
    )


def test_a_glide_begins_as_it_is_and_ends_at_rest_on_its_target() -> None:
    trajectory = QuinticTrajectory(from_ned_m=FROM, vel_ned_m_s=VEL, to_ned_m=TO, travel_s=5.0)
    pos, vel = trajectory.sample(np.array([0.0, 5.0, 60.0]))
    np.testing.assert_allclose(pos, [FROM, TO, TO], atol=1e-12)
    np.testing.assert_allclose(vel, [VEL, np.zeros(3), np.zeros(3)], atol=1e-12)


def test_a_glide_is_continuous_in_velocity_and_acceleration() -> None:
    said, velocity, accel = derivatives(QuinticTrajectory(from_ned_m=FROM, vel_ned_m_s=VEL, to_ned_m=TO, travel_s=5.0))
    np.testing.assert_allclose(said, velocity, atol=1e-6)
    assert np.abs(np.diff(said, axis=0)).max() < 0.02  # 3.6 ms apart: no jump
    assert np.abs(np.diff(accel, axis=0)).max() < 0.05
    np.testing.assert_allclose(accel[0], 0.0, atol=0.02)  # and none at its beginning
    np.testing.assert_allclose(accel[-1], 0.0, atol=0.02)


def test_a_glide_halfway_by_hand() -> None:
    # s = 1/2: blend 1/2, coast 1/2 - 6/8 + 8/16 - 3/32 = 5/32; slopes 1.875 and 1 - 18/4 + 32/8 - 15/16 = -7/16
    pos, vel = QuinticTrajectory(from_ned_m=FROM, vel_ned_m_s=VEL, to_ned_m=TO, travel_s=4.0).sample(np.array([2.0]))
    np.testing.assert_allclose(pos[0], 0.5 * (FROM + TO) + 5 / 32 * 4.0 * VEL)
    np.testing.assert_allclose(vel[0], 1.875 * (TO - FROM) / 4.0 - 7 / 16 * VEL)


@pytest.mark.parametrize("distance_m", [0.1, 1.0, 5.0, 200.0])
def test_from_rest_a_glide_keeps_speed_and_acceleration(distance_m: float) -> None:
    target = np.array([0.6, 0.0, -0.8]) * distance_m
    trajectory = quintic_to(np.zeros(3), np.zeros(3), target, 2.0, accel_m_s2=1.2)
    said, _, accel = derivatives(trajectory)
    assert np.linalg.norm(said, axis=1).max() <= 2.0 + 1e-6
    assert np.linalg.norm(accel, axis=1).max() <= 1.2 * 1.01
    if distance_m == 200.0:  # and is as quick as the speed allows
        assert np.linalg.norm(said, axis=1).max() > 1.99


def test_a_glide_that_must_turn_round_stays_near_its_acceleration() -> None:
    trajectory = quintic_to(np.zeros(3), np.array([2.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), 2.0, accel_m_s2=1.2)
    _, _, accel = derivatives(trajectory)
    assert np.linalg.norm(accel, axis=1).max() < 1.6 * 1.2


@pytest.mark.parametrize("target_m", [[50.0, 0.0, -11.5], [0.0, 0.0, -11.5], [-5.0, 200.0, -3.0]])
def test_a_first_velocity_carries_no_farther_when_the_way_is_long(target_m: list[float]) -> None:
    # With the acceleration 1.2 m/s^2 that its way on needs at 2.2 m/s: v^2 / a = 4 m, half of it with a steady brake.
    trajectory = quintic_to(
        np.array([0.0, 0.0, -11.5]), np.array([0.0, 0.0, 2.2]), np.array(target_m), 2.0, accel_m_s2=1.2
    )
    down_m = trajectory.sample(np.linspace(0.0, trajectory.travel_s, 2001))[0][:, 2]
    assert down_m.max() < max(-11.5, target_m[2]) + 2.5
    _, velocity, accel = derivatives(trajectory)
    assert np.linalg.norm(accel, axis=1).max() < 1.6 * 1.2
    np.testing.assert_allclose(velocity[0], [0.0, 0.0, 2.2], atol=0.01)


def test_a_long_way_is_cruised_at_the_peak_speed_and_takes_its_time_at_that_and_of_speeding_up() -> None:
    target = np.array([120.0, -160.0, 0.0])
    trajectory = transit_to(np.zeros(3), np.zeros(3), target, 2.0, accel_m_s2=1.2)
    assert trajectory.travel_s == pytest.approx(100.0 + 2.4, abs=0.1)  # one quintic alone takes 187.5 s
    pos, vel = trajectory.sample(np.array([0.0, 10.0, 51.2, 90.0, trajectory.travel_s, 1000.0]))
    np.testing.assert_allclose(pos[[0, -2, -1]], [np.zeros(3), target, target], atol=1e-9)
    np.testing.assert_allclose(vel[1:4], [[1.2, -1.6, 0.0]] * 3, atol=1e-9)
    np.testing.assert_allclose(vel[[0, -2, -1]], 0.0, atol=1e-9)
    said, velocity, accel = derivatives(trajectory)
    np.testing.assert_allclose(said, velocity, atol=1e-6)
    assert np.linalg.norm(said, axis=1).max() <= 2.0 + 1e-9
    assert np.linalg.norm(accel, axis=1).max() <= 1.2 + 1e-6


@pytest.mark.parametrize("vel", [[0.0, 0.0, 0.0], [0.5, -0.3, 0.1], [-2.0, 0.5, 0.0]])
def test_a_cruise_is_joined_and_left_without_a_jump(vel: list[float]) -> None:
    trajectory = transit_to(FROM, np.array(vel), FROM + np.array([40.0, 0.0, 3.0]), 2.0, accel_m_s2=1.2)
    speeds_up_s, step_s = 0.5 * (trajectory.travel_s - trajectory.cruise_s), 1e-5
    for joint_s in (speeds_up_s, speeds_up_s + trajectory.cruise_s, trajectory.travel_s):
        pos, said = trajectory.sample(joint_s + step_s * np.arange(-4.0, 5.0))
        velocity, accel = np.diff(pos, axis=0) / step_s, np.diff(said, axis=0) / step_s
        assert np.abs(np.diff(velocity, axis=0)).max() < 1e-4
        assert np.abs(np.diff(accel, axis=0)).max() < 1e-3
    np.testing.assert_allclose(trajectory.sample(np.zeros(1))[1][0], vel, atol=1e-12)


@pytest.mark.parametrize("vel", [[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [-1.0, 1.5, 0.0], [0.0, -4.0, 0.0]])
def test_the_first_way_with_a_cruise_is_that_of_one_quintic_and_shorter_ones_are_quintics(vel: list[float]) -> None:
    def way_of(distance_m: float) -> QuinticTrajectory:
        return transit_to(np.zeros(3), np.array(vel), np.array([distance_m, 0.0, 0.0]), 2.0, accel_m_s2=1.2)

    least_m, most_m = 1.0, 100.0
    while most_m - least_m > 1e-7:
        middle_m = 0.5 * (least_m + most_m)
        least_m, most_m = (least_m, middle_m) if way_of(middle_m).cruise_s > 0.0 else (middle_m, most_m)
    if not any(vel):  # 3.08 v / a at 1 / 1.875 of v
        assert most_m == pytest.approx(1.643 * 2.0**2 / 1.2, rel=1e-3)
    t_s = np.linspace(0.0, way_of(most_m).travel_s, 500)
    for shorter, longer in zip(way_of(least_m).sample(t_s), way_of(most_m).sample(t_s), strict=True):
        np.testing.assert_allclose(shorter, longer, atol=1e-5)
    assert way_of(least_m).travel_s == max(1.875 * least_m / 2.0, way_of(least_m).shed_s or 0.0)


@pytest.mark.parametrize("speed_m_s", [0.3, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("towards", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
def test_whichever_way_a_vehicle_flies_first_a_cruise_is_no_faster_nor_harder_than_one_quintic(
    speed_m_s: float, towards: list[float]
) -> None:
    def peaks(trajectory: QuinticTrajectory) -> tuple[float, float]:
        said, _, accel = derivatives(trajectory)
        return float(np.linalg.norm(said, axis=1).max()), float(np.linalg.norm(accel, axis=1).max())

    most_m_s2 = 0.0
    for distance_m in (0.5, 1.5, 3.0, 5.0, 8.0, 12.0, 26.0, 100.0):
        target = np.array([distance_m, 0.0, 0.0])
        way = transit_to(np.zeros(3), speed_m_s * np.array(towards), target, 2.0, accel_m_s2=1.2)
        alone_s = max(1.875 * distance_m / 2.0, np.sqrt(5.77 * distance_m / 1.2), way.shed_s or 0.0)
        most_m_s2 = max(most_m_s2, peaks(replace(way, travel_s=alone_s, cruise_s=0.0))[1])
        if way.cruise_s > 0.0:
            fastest_m_s, hardest_m_s2 = peaks(way)
            assert fastest_m_s <= max(2.0, speed_m_s) + 1e-6
            assert hardest_m_s2 <= max(1.2, most_m_s2) + 1e-3
    assert way.cruise_s > 0.0


@pytest.mark.parametrize("speed_m_s", [0.0, 0.3, 2.5, 10.0])
def test_braking_is_straight_ahead_without_overshoot_and_within_the_acceleration(speed_m_s: float) -> None:
    vel = speed_m_s * np.array([0.6, 0.8, 0.0])
    trajectory = brake_to_rest(FROM, vel, 1.2)
    said, _, accel = derivatives(trajectory)
    along = said @ np.array([0.6, 0.8, 0.0])
    np.testing.assert_allclose(said, np.outer(along, [0.6, 0.8, 0.0]), atol=1e-9)
    assert along.min() > -1e-9
    assert (np.diff(along) < 1e-9).all()
    assert np.linalg.norm(accel, axis=1).max() <= 1.2
    np.testing.assert_allclose(trajectory.sample(np.array([100.0]))[1], 0.0)
