"""The safety filter alone keeps point masses apart that are steered through each other."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from swarmctl.control.collision import barrier as barrier_module
from swarmctl.control.collision.barrier import Barrier, BarrierParams, Body, body_of_obstacle, body_of_peer
from swarmctl.control.collision.separation import SeparationParams, align
from swarmctl.control.model import VehicleModelParams, acceleration
from swarmctl.control.mpc.problem import Start
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, PredictedPath
from tests import builders

PARAMS, MODEL = BarrierParams(), VehicleModelParams()
DT_S, BODY_M, STILL = 0.02, 0.48, np.zeros(3)
APART_M = BODY_M + PARAMS.margin_m
BUDGET = SeparationParams(body_m=BODY_M).budget
HOVER = np.array([0.0, 0.0, GRAVITY_M_S2])


def filtered(barrier: Barrier, virtual_control: Array, start: Start, bodies: list[Body]) -> Array | None:
    return barrier.filtered(virtual_control, start, STILL, 0.5, bodies=bodies)


def start(pos: Array, vel: Array, held: Array = HOVER) -> Start:
    return builders.start(pos_ned_m=pos, vel_ned_m_s=vel, virtual_control=held)


def lift_m_s2(command: Array) -> float:
    """Return the vertical thrust over mass of a command (3,)."""
    return float(command[2] * math.sqrt(1.0 - command[:2] @ command[:2]))


def fly_at_goals(
    pos: Array,
    vel: Array,
    goals: Array,
    params: BarrierParams | None,
    others: list[Body] | None = None,
    for_s: float = 6.0,
) -> tuple[float, float]:
    """Simulate attracted point masses; return the smallest distance of any two [m] and of any from `others`."""
    barriers = [Barrier(params, MODEL, DT_S) if params else None for _ in pos]
    held = np.tile(HOVER, (len(pos), 1))
    least = beside = math.inf
    for k in range(round(for_s / DT_S)):
        moved = [
            Body(
                pos_ned_m=tuple((np.array(o.pos_ned_m) + k * DT_S * np.array(o.vel_ned_m_s)).tolist()),
                vel_ned_m_s=o.vel_ned_m_s,
                apart_m=o.apart_m,
                responsibility_01=o.responsibility_01,
                column=o.column,
            )
            for o in others or []
        ]
        bodies = [
            Body(pos_ned_m=tuple(p.tolist()), vel_ned_m_s=tuple(v.tolist()), apart_m=APART_M, responsibility_01=0.5)
            for p, v in zip(pos, vel, strict=True)
        ]
        commands = []
        for i, barrier in enumerate(barriers):
            pull = np.clip(2.0 * (goals[i] - pos[i]) - 2.0 * vel[i], -2.0, 2.0)
            lift = np.array([0.0, 0.0, GRAVITY_M_S2]) - pull
            wanted = np.array([*(lift[:2] / np.linalg.norm(lift)), np.linalg.norm(lift)])
            seen = [b for j, b in enumerate(bodies) if j != i] + moved
            changed = None if barrier is None else filtered(barrier, wanted, start(pos[i], vel[i], held[i]), seen)
            commands.append(wanted if changed is None else changed)
        held = np.array(commands)
        accel = np.array([acceleration(c) for c in commands])
        pos, vel = pos + DT_S * vel + 0.5 * DT_S**2 * accel, vel + DT_S * accel
        least = float(np.fmin(least, closest_pair_m(pos[None])[0]))
        for p, o in itertools.product(pos, moved):
            axes = 2 if o.column else 3
            beside = min(beside, math.dist(p[:axes], o.pos_ned_m[:axes]))
    return least, beside


def ring(count: int, radius_m: float, climb_m: float = 0.0) -> Array:
    angle = 2.0 * math.pi * np.arange(count) / count
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), climb_m * np.cos(7.0 * angle)], axis=1)


@pytest.mark.parametrize(
    ("count", "climb_m", "speed_m_s"),
    [(2, 0.0, 1.5), (2, 0.15, 1.5), (2, 0.0, 2.5), (6, 0.0, 1.5), (6, 0.05, 2.5), (6, 0.1, 1.5), (6, 0.3, 1.0)],
)
def test_agents_that_fly_at_each_other_do_not_touch(count: int, climb_m: float, speed_m_s: float) -> None:
    pos = ring(count, 3.0, climb_m)
    vel = -speed_m_s * pos / np.linalg.norm(pos, axis=1, keepdims=True)
    assert fly_at_goals(pos, vel, -pos, PARAMS)[0] >= BODY_M


@pytest.mark.parametrize("count", [2, 6])
def test_negative_control_without_it_they_do(count: int) -> None:
    pos = ring(count, 3.0)
    assert fly_at_goals(pos, -0.5 * pos, -pos, None)[0] < 0.2


@pytest.mark.parametrize("column", [False, True])
@pytest.mark.parametrize("speed_m_s", [0.0, 1.0])
def test_against_an_obstacle_the_vehicle_brakes_alone(column: bool, speed_m_s: float) -> None:
    """The obstacle may approach as well: only the own braking counts."""
    obstacle = [
        Body(
            pos_ned_m=(3.0, 0.1, 0.0),
            vel_ned_m_s=(-speed_m_s, 0.0, 0.0),
            apart_m=1.24 + PARAMS.margin_m,
            responsibility_01=1.0,
            column=column,
        )
    ]
    pos, vel, goal = np.zeros((1, 3)), np.array([[1.5, 0.0, 0.0]]), np.array([[6.0, 0.0, 0.0]])
    assert fly_at_goals(pos, vel, goal, PARAMS, obstacle, 2.0)[1] >= 1.24
    assert fly_at_goals(pos, vel, goal, None, obstacle, 2.0)[1] < 0.8


def test_both_of_a_pair_brake_and_one_alone_brakes_all_of_it() -> None:
    barrier = Barrier(PARAMS.model_copy(update={"slew_1_s": 50.0}), MODEL, DT_S)
    here = start(np.zeros(3), np.array([1.5, 0.0, 0.0]))
    other = [
        Body(pos_ned_m=(1.3, 0.0, 0.0), vel_ned_m_s=(-1.5, 0.0, 0.0), apart_m=APART_M, responsibility_01=share)
        for share in (0.5, 1.0)
    ]
    half, whole = (filtered(barrier, HOVER, here, [body]) for body in other)
    assert half is not None
    assert whole is not None
    assert 0.15 < half[0] < whole[0]
    mirrored = filtered(
        barrier,
        HOVER,
        start(np.zeros(3), -here.vel_ned_m_s),
        [Body(pos_ned_m=(-1.3, 0.0, 0.0), vel_ned_m_s=(1.5, 0.0, 0.0), apart_m=APART_M, responsibility_01=0.5)],
    )
    assert mirrored is not None
    np.testing.assert_allclose(mirrored, half * [-1.0, 1.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("pos", "vel"),
    [
        ((0.9, 0.0, 0.0), (0.0, 0.0, 0.0)),  # side by side
        ((0.9, 0.0, 0.0), (0.0, 2.0, 0.0)),  # passing by
        ((3.0, 0.0, 0.0), (-3.0, 0.0, 0.0)),  # coming on, far away
        ((0.6, 0.0, 0.0), (2.0, 0.0, 0.0)),  # parting
        ((0.0, 0.0, 0.9), (0.0, 0.0, 0.0)),  # below
    ],
)
def test_the_filter_does_not_act_on_agents_that_keep_apart(pos: tuple[float, ...], vel: tuple[float, ...]) -> None:
    barrier = Barrier(PARAMS, MODEL, DT_S)
    assert (
        filtered(
            barrier,
            np.array([0.2, 0.1, 9.9]),
            start(np.zeros(3), np.zeros(3)),
            [Body(pos_ned_m=pos, vel_ned_m_s=vel, apart_m=APART_M, responsibility_01=0.5)],
        )
        is None
    )
    assert filtered(barrier, HOVER, start(np.zeros(3), np.zeros(3)), []) is None


@pytest.mark.parametrize(("distance_m", "acts"), [(APART_M - 0.1, True), (APART_M + 0.3, False)])
def test_flying_past_does_not_count_as_parting_where_two_are_too_close(distance_m: float, acts: bool) -> None:
    here = start(np.zeros(3), np.zeros(3))
    passing = Body(
        pos_ned_m=(distance_m, 0.0, 0.0), vel_ned_m_s=(0.0, 3.0, 0.0), apart_m=APART_M, responsibility_01=0.5
    )
    found = filtered(Barrier(PARAMS, MODEL, DT_S), HOVER, here, [passing])
    assert (found is not None) is acts
    if found is not None:
        assert acceleration(found)[0] < -0.3, "away from it"


def test_a_vehicle_gets_away_from_one_that_is_too_close_and_does_not_fly_past_as_told() -> None:
    """A peer is told to fly past at 3 m/s, by what it has committed to, but hangs where it is."""
    barrier, pos, vel, held = Barrier(PARAMS, MODEL, DT_S), np.zeros(3), np.zeros(3), HOVER
    peer = Body(
        pos_ned_m=(APART_M - 0.1, 0.0, 0.0), vel_ned_m_s=(0.0, 3.0, 0.0), apart_m=APART_M, responsibility_01=0.5
    )
    for _ in range(50):
        found = filtered(barrier, HOVER, start(pos, vel, held), [peer])
        held = HOVER if found is None else found
        accel = acceleration(held)
        pos, vel = pos + DT_S * vel + 0.5 * DT_S**2 * accel, vel + DT_S * accel
    assert math.dist(pos, peer.pos_ned_m) > APART_M


def test_commands_stay_within_the_airframe_bounds() -> None:
    """Even without a feasible command, tilt, slew and thrust stay within bounds and finite."""
    rng = np.random.default_rng(3)
    barrier, slew = Barrier(PARAMS, MODEL, DT_S), PARAMS.slew_1_s * DT_S
    acted = 0
    for _ in range(300):
        held = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(6.0, 14.0)])
        wanted = held + np.array([*rng.uniform(-0.04, 0.04, 2), rng.uniform(-1.0, 1.0)])
        bodies = [
            Body(
                pos_ned_m=tuple(rng.normal(scale=0.5, size=3).tolist()),
                vel_ned_m_s=tuple(rng.normal(scale=2.0, size=3).tolist()),
                apart_m=APART_M,
                responsibility_01=1.0,
            )
            for _ in range(5)
        ]
        found = filtered(barrier, wanted, start(np.zeros(3), rng.normal(size=3), held), bodies)
        if found is None:
            continue
        acted += 1
        assert np.isfinite(found).all()
        assert np.abs(found[:2] - held[:2]).max() <= slew + 1e-9
        assert np.abs(found[:2]).max() <= MODEL.u_max() + 1e-9
        assert abs(lift_m_s2(found) - lift_m_s2(wanted)) < 2.5 + 0.1, "vertical thrust, with what clipped tilt adds"
    assert acted > 150


def test_coincident_bodies_part_along_their_relative_velocity() -> None:
    barrier = Barrier(PARAMS, MODEL, DT_S)
    found = filtered(
        barrier,
        HOVER,
        start(np.zeros(3), np.array([1.0, 0.0, 0.0])),
        [Body(pos_ned_m=(0.0,) * 3, vel_ned_m_s=(-1.0, 0.0, 0.0), apart_m=APART_M, responsibility_01=0.5)],
    )
    assert found is not None
    assert found[0] > 0.0


# -- what is known of others ------------------------------------------------------------------------------------------


def path(t0_us: int, vel: tuple[float, float, float] = (1.0, 0.0, 0.0), points: int = 41) -> PredictedPath:
    return builders.predicted_path(
        t0_utc_us=t0_us, dt_us=20_000, pos_ned_m=np.arange(points)[:, None] * 0.02 * np.array(vel)
    )


def body(known: PredictedPath, act_us: int, ahead_s: float = 0.0, filters: bool = True) -> Body:
    age_margin_m = BUDGET.age_margin_m(max(0.0, (act_us - known.t0_utc_us) * 1e-6), parked=False)
    apart_m = BUDGET.barrier_peer_m(PARAMS.margin_m, known.margin_m, age_margin_m)
    return body_of_peer(known, act_us, ahead_s, apart_m, filters=filters, brake_m_s2=2.0)


def test_a_peer_is_predicted_to_when_the_command_takes_effect() -> None:
    found = body(path(0), 100_000, 0.21)
    assert found.pos_ned_m == pytest.approx((0.31, 0.0, 0.0))
    assert found.vel_ned_m_s == pytest.approx((1.0, 0.0, 0.0))
    assert found.apart_m == pytest.approx(APART_M + 0.02)
    assert (found.responsibility_01, body(path(0), 100_000, filters=False).responsibility_01) == (0.5, 1.0)


def test_the_margin_of_a_stale_peer_grows_with_time() -> None:
    reach = [body(path(0), age_us).apart_m for age_us in (0, 100_000, 300_000, 600_000, 5_000_000)]
    assert reach == sorted(reach)
    assert reach[-1] == pytest.approx(APART_M + 1.0)


@pytest.mark.parametrize("age_us", [100_000, 790_000, 900_000, 1_050_000, 5_000_000])
@pytest.mark.parametrize("vel", [(1.0, 0.0, 0.0), (0.6, -1.2, 0.1), (0.0, 0.0, 0.0)], ids=str)
def test_a_stale_peer_is_where_plans_assume_it(vel: tuple[float, float, float], age_us: int) -> None:
    """Otherwise an agent would stand before a peer that no plan sees, and no recovery would begin."""
    known = path(0, vel)
    found = body(known, age_us)
    assert found.pos_ned_m == pytest.approx(align(known, age_us, 20_000, 1, brake_m_s2=2.0)[0])
    before, after = (np.array(body(known, age_us + by_us).pos_ned_m) for by_us in (-100, 100))
    assert found.vel_ned_m_s == pytest.approx((after - before) / 2e-4, abs=1e-3)


def test_an_obstacle_moves_on() -> None:
    ball = Obstacle(
        center_ned_m=(1.0, 2.0, 3.0),
        radius_m=0.5,
        keep_out_m=1.0,
        visibility_m=3.0,
        vel_ned_m_s=(0.0, -1.0, 0.0),
        column=True,
    )
    found = body_of_obstacle(ball, 0.2, 0.29)
    assert found.pos_ned_m == pytest.approx((1.0, 1.8, 3.0))
    assert found.apart_m == pytest.approx(0.79)
    assert (found.responsibility_01, found.column, found.solid) == (1.0, True, True)


def test_downwash_demands_more_distance_vertically_than_horizontally() -> None:
    sinking = start(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 0.5]))
    below = [Body(pos_ned_m=(0.0, 0.0, 0.0), vel_ned_m_s=(0.0, 0.0, 0.0), apart_m=APART_M, responsibility_01=0.5)]
    assert filtered(Barrier(PARAMS, MODEL, DT_S), HOVER, sinking, below) is None
    found = filtered(Barrier(PARAMS, MODEL, DT_S, downwash=2.0), HOVER, sinking, below)
    assert found is not None
    assert found[2] > GRAVITY_M_S2


# -- an obstacle ahead of a vehicle that is tilted towards it ----------------------------------------------------------

TICK_S = 0.04


def towards_an_obstacle(u: float, higher_m: float) -> list[float]:
    """Fly at 3 m/s, tilted ahead by u, at an obstacle that comes at 1.5 m/s; return u and each u_x that is sent."""
    wanted = np.array([u, 0.0, GRAVITY_M_S2 / math.sqrt(1.0 - u * u)])
    barrier, held, sent = Barrier(PARAMS, MODEL, TICK_S), wanted, [u]
    pos, vel, apart_m = np.zeros(3), np.array([3.0, 0.0, 0.0]), 0.875
    for k in range(6):
        ahead = Body(
            pos_ned_m=(2.5 + apart_m - 1.5 * k * TICK_S, 0.0, -higher_m),
            vel_ned_m_s=(-1.5, 0.0, 0.0),
            apart_m=apart_m,
            responsibility_01=1.0,
            solid=True,
        )
        changed = filtered(barrier, wanted, start(pos, vel, held), [ahead])
        held = wanted if changed is None else changed
        sent.append(float(held[0]))
        accel = acceleration(held)
        pos, vel = pos + TICK_S * vel + 0.5 * TICK_S**2 * accel, vel + TICK_S * accel
    return sent


@pytest.mark.parametrize("higher_m", [0.03, 0.2, -0.1])
@pytest.mark.parametrize("u", [-0.2, -0.4, -0.65])
def test_who_has_to_brake_sheds_its_tilt_as_fast_as_it_may(u: float, higher_m: float) -> None:
    assert np.diff(towards_an_obstacle(u, higher_m)).min() > 0.9 * PARAMS.slew_1_s * TICK_S


@pytest.mark.parametrize("u", [-0.4, -0.65])
def test_negative_control_bounded_by_the_wanted_thrust_it_leans_on(u: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Below something, thrust is traded for a trace of distance: the same force is more tilt then."""
    monkeypatch.setattr(barrier_module, "_THRUSTS", 1)
    assert max(towards_an_obstacle(u, 0.03)) < u + 0.01
