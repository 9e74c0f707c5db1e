"""Plans stay in the flight volume, and what leaves it is not flown; negative controls leave out rows or certificate."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.collision.volume_certificate import volume_margin_m
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.controllers.discovery import ControllerParams, make_controller
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.controllers.own import OwnController
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc import judgement, swarm_mpc
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.reference.landing_places import Taken, landing_place_ned_m
from swarmctl.control.reference.shortest_path import shortest_path
from swarmctl.control.rollout import ModelledVehicle
from swarmctl.core.flight_volume import FlightVolume, VolumeParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.trajectory import Trajectory, resting, stopping
from swarmctl.core.types import Array, PlanStatus, Reference
from tests import builders

VOLUME = FlightVolume(
    VolumeParams(corners_ne_m=((-4.0, -4.0), (4.0, -4.0), (5.0, 4.0), (-4.0, 4.0)), floor_z_m=-0.5, ceiling_z_m=-4.5)
)
MODEL = VehicleModelParams()
KEPT_M, CERTIFIED_M = VOLUME.params.margin_m, VOLUME.params.margin_m - VOLUME.params.certify_slack_m
UTC_US = 1_700_000_000_000_000


def controller(kind: str = "dmpc", volume: FlightVolume | None = VOLUME) -> Controller:
    return make_controller(
        ControllerParams(kind=kind), builders.controller_setup(vehicle=MODEL, max_keep_outs=1, volume=volume)
    )


def flown(
    flies: Controller,
    goal_ned_m: tuple[float, ...],
    pos_ned_m: tuple[float, ...] = (0.0, 0.0, -2.0),
    vel_ned_m_s: tuple[float, ...] = (0.0, 0.0, 0.0),
    *,
    seconds: float = 5.0,
) -> tuple[Array, list[PlanStatus]]:
    """Return positions (T, 3) of the modelled vehicle under every first input, and the status of each plan."""
    pos, vel, held = np.array(pos_ned_m), np.array(vel_ned_m_s), np.array([0.0, 0.0, GRAVITY_M_S2])
    points = flies.longest + 1
    reference = Reference(np.tile(np.array(goal_ned_m), (points, 1)), np.zeros((points, 3)), 0.0)
    track, statuses = [pos], []
    for _ in range(round(seconds * 1e6 / flies.dt_us)):
        cos_tilt = float(np.sqrt(1.0 - held[0] ** 2 - held[1] ** 2))
        start = Start(t_us=0, pos_ned_m=pos, vel_ned_m_s=vel, cos_tilt=cos_tilt, virtual_control=held)
        plan = flies.plan(
            Problem(
                start=start,
                reference=reference,
                disturbance_ned_m_s2=np.zeros(3),
                keep_outs=(),
                guess_ned_m=None,
            )
        )
        vehicle = ModelledVehicle(start, MODEL, np.zeros(3))
        held = plan.virtual_control[0]
        vehicle.step(held, flies.dt_us * 1e-6)
        pos, vel = vehicle.pos_ned_m, vehicle.vel_ned_m_s
        track.append(pos)
        statuses.append(plan.status)
    return np.array(track), statuses


OUTSIDE = [(9.0, 1.0, -2.0), (-7.0, -6.0, -2.0), (0.0, 0.0, -7.0), (0.0, 0.0, 2.0), (6.0, 6.0, -6.0)]
MPC = ("mpc", OUTSIDE[0])


@pytest.mark.parametrize(
    ("kind", "goal"), [*(("dmpc", goal) for goal in OUTSIDE), *(("dmpc3", goal) for goal in OUTSIDE[1:3]), MPC]
)
def test_a_reference_outside_is_followed_up_to_the_margin(kind: str, goal: tuple[float, ...]) -> None:
    track, statuses = flown(controller(kind), goal, seconds=3.5)
    assert float(VOLUME.beyond_m(track).max()) <= -KEPT_M + 0.05
    assert float(VOLUME.beyond_m(track[-1])) >= -KEPT_M - 0.2, "it goes as far as it may"
    assert statuses.count(PlanStatus.OK) >= 0.97 * len(statuses)


@pytest.mark.parametrize("kind", ["dmpc", "dmpc3"])
def test_negative_control_without_rows_the_same_plans_leave(kind: str) -> None:
    track, _ = flown(controller(kind, None), OUTSIDE[0], seconds=4.0)
    assert float(VOLUME.beyond_m(track).max()) > 2.0


@pytest.mark.parametrize(
    ("kind", "pos", "vel"),
    [
        ("dmpc", (6.0, 0.0, -2.0), (0.0, 0.0, 0.0)),
        ("dmpc", (4.2, 4.6, -2.0), (1.0, 1.0, 0.0)),
        ("dmpc", (0.0, 0.0, -5.5), (0.0, 0.0, -1.0)),
        ("dmpc3", (4.2, 4.6, -2.0), (1.0, 1.0, 0.0)),
        ("dmpc3", (0.0, 0.0, 0.2), (0.0, 0.0, 0.3)),
    ],
)
def test_a_vehicle_found_outside_comes_back_although_its_reference_stays_there(
    kind: str, pos: tuple[float, ...], vel: tuple[float, ...]
) -> None:
    track, statuses = flown(controller(kind), pos, pos, vel, seconds=4.0)
    assert float(VOLUME.beyond_m(track[-1])) <= -KEPT_M + 0.02
    reach_m = float(VOLUME.beyond_m(np.array(pos))) + float(np.dot(vel, vel)) / (2.0 * 1.2) + 0.1
    assert float(VOLUME.beyond_m(track).max()) <= reach_m
    assert statuses.count(PlanStatus.OK) >= 0.95 * len(statuses), "no hard failure: plans are flown"


def plan_towards_the_north(speed_m_s: float, from_m: float, brake_m_s2: float = 0.0) -> tuple[Array, Array]:
    """Return positions and velocities (41, 3) of a straight plan over 0.8 s."""
    t_s = np.linspace(0.0, 0.8, 41)
    pos, vel = np.tile([0.0, 0.0, -2.0], (41, 1)), np.zeros((41, 3))
    moving_s = t_s if brake_m_s2 == 0.0 else np.minimum(t_s, speed_m_s / brake_m_s2)
    pos[:, 0] = from_m + speed_m_s * moving_s - 0.5 * brake_m_s2 * moving_s**2
    vel[:, 0] = np.maximum(0.0, speed_m_s - brake_m_s2 * t_s)
    return pos, vel


SQUARE = FlightVolume(
    VolumeParams(corners_ne_m=((-4.0, -4.0), (4.0, -4.0), (4.0, 4.0), (-4.0, 4.0)), floor_z_m=-0.5, ceiling_z_m=-4.5)
)
LIMIT_M = 4.0 - CERTIFIED_M


@pytest.mark.parametrize(
    ("speed_m_s", "from_m", "brake_m_s2", "is_flown"),
    [
        (0.0, LIMIT_M - 0.01, 0.0, True),
        (0.0, LIMIT_M + 0.5, 0.0, True),  # found outside, at rest: it may come back from there
        (1.0, LIMIT_M - 0.8 - 1.0 / 3.0 - 0.01, 0.0, True),  # just stops
        (1.0, LIMIT_M - 0.8 - 1.0 / 3.0 + 0.01, 0.0, False),  # inside throughout, but does not stop any more
        (2.0, LIMIT_M - 0.8, 0.0, False),
        (1.5, LIMIT_M - 0.2, 1.6, False),  # began to brake too late: the last certified plan is better
        (1.5, LIMIT_M + 0.2, 1.6, True),  # outside, and brakes as well as it can
        (1.5, LIMIT_M + 0.2, 0.0, False),  # outside, and goes on
        (-1.0, LIMIT_M + 2.0, 0.0, True),  # comes back
    ],
)
def test_a_plan_is_flown_only_if_it_and_a_stop_behind_it_are_inside(
    speed_m_s: float, from_m: float, brake_m_s2: float, is_flown: bool
) -> None:
    pos, vel = plan_towards_the_north(speed_m_s, from_m, brake_m_s2)
    assert (volume_margin_m(SQUARE, pos, vel, 6) >= 0.0) == is_flown
    assert volume_margin_m(None, pos, vel, 6) == np.inf


def test_the_certificate_refuses_what_rows_have_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without rows every plan towards the outside is refused as soon as it can't stop; with neither it is flown."""
    monkeypatch.setattr(swarm_mpc, "faces_along", lambda volume, axes: None)
    track, statuses = flown(controller(), OUTSIDE[0], seconds=3.0)
    refused = statuses.index(PlanStatus.NOT_CERTIFIED)
    assert float(VOLUME.beyond_m(track[refused])) < -KEPT_M, "while it is well inside"
    monkeypatch.setattr(judgement, "volume_margin_m", lambda *_: np.inf)
    assert PlanStatus.NOT_CERTIFIED not in flown(controller(), OUTSIDE[0], seconds=3.0)[1]


class Northward(OwnController):
    """Tilts to the north, whatever comes."""

    def commands(self, problem: Problem) -> Array:
        return np.tile([-0.1, 0.0, GRAVITY_M_S2], (self.steps, 1))


@pytest.mark.parametrize(
    ("volume", "north_m", "is_flown"), [(VOLUME, 0.0, True), (VOLUME, 4.1, False), (None, 4.1, True)]
)
def test_an_own_controller_that_plans_to_leave_is_not_flown(
    volume: FlightVolume | None, north_m: float, is_flown: bool
) -> None:
    flies = controller(f"{__name__}:Northward", volume)
    here, points = np.array([north_m, 0.0, -2.0]), flies.longest + 1
    plan = flies.plan(
        Problem(
            start=builders.start(t_us=0, pos_ned_m=here),
            reference=Reference(np.tile(here, (points, 1)), np.zeros((points, 3)), 0.0),
            disturbance_ned_m_s2=np.zeros(3),
            keep_outs=(),
            guess_ned_m=None,
        )
    )
    assert plan.failure == ("" if is_flown else f"controller {__name__}:Northward plans to leave the flight volume")


# -- guaranteed separation --------------------------------------------------------------------------------------------


def planner(
    volume: FlightVolume | None = VOLUME, u_max: float = 0.25, model: VehicleModelParams = MODEL
) -> TrajectoryPlanner:
    return TrajectoryPlanner(
        0,
        CommitParams(),
        MpcParams(u_max=u_max),
        model,
        SeparationParams(),
        max_keep_outs=1,
        stopwatch_ns=lambda: 0,
        volume=volume,
    )


def towards(goal: tuple[float, ...]) -> DesiredReference:
    return DesiredReference(lambda t_s: (np.tile(np.array(goal), (len(t_s), 1)), np.zeros((len(t_s), 3))))


def committed_to(plans: TrajectoryPlanner, goal: tuple[float, ...], committed: Trajectory, times: int) -> Trajectory:
    """Return what an agent alone is committed to after `times` proposals, 0.2 s apart."""
    now_us = committed.t0_utc_us
    for _ in range(times):
        now = builders.situation(utc_us=now_us, begin_us=now_us + 100_000, desired=towards(goal))
        committed = plans.proposal(committed, now) or committed
        now_us += 200_000
    return committed


@pytest.mark.parametrize("goal", OUTSIDE)
def test_commitments_stay_inside(goal: tuple[float, ...]) -> None:
    begin = resting(np.array([0.0, 0.0, -2.0]), UTC_US, 100_000)
    after = committed_to(planner(), goal, begin, 30)
    assert float(VOLUME.beyond_m(after.pos_ned_m).max()) <= -CERTIFIED_M + 1e-6
    assert float(VOLUME.beyond_m(after.pos_ned_m[-1])) >= -KEPT_M - 0.4, "it goes as far as it may"


def test_proposals_that_rows_have_let_out_are_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(swarm_mpc, "faces_along", lambda volume, axes: None)
    begin = resting(np.array([0.0, 0.0, -2.0]), UTC_US, 100_000)
    after = committed_to(planner(), OUTSIDE[0], begin, 30)
    assert float(VOLUME.beyond_m(after.pos_ned_m).max()) <= -CERTIFIED_M + 1e-6


def test_negative_control_without_a_volume_commitments_lead_out() -> None:
    begin = resting(np.array([0.0, 0.0, -2.0]), UTC_US, 100_000)
    after = committed_to(planner(None), OUTSIDE[0], begin, 30)
    assert float(VOLUME.beyond_m(after.pos_ned_m[-1])) > 2.0


def test_an_agent_that_is_blown_out_commits_to_come_back() -> None:
    blown = stopping(np.array([4.6, 0.0, -2.0]), np.array([1.0, 0.0, 0.0]), UTC_US, 100_000, brake_m_s2=1.5)
    farthest_m = float(VOLUME.beyond_m(blown.pos_ned_m).max())
    after = committed_to(planner(), (6.0, 0.0, -2.0), blown, 30)
    assert float(VOLUME.beyond_m(after.pos_ned_m).max()) <= farthest_m + 0.02
    assert float(VOLUME.beyond_m(after.pos_ned_m[-1])) <= -CERTIFIED_M


@pytest.mark.parametrize("to", [(1.0, 0.0), (0.6, -0.8), (0.0, 1.0)])
@pytest.mark.parametrize(("volume", "is_inside"), [(VOLUME, True), (None, False)])
def test_what_is_lost_at_speed_is_stopped_inside(
    volume: FlightVolume | None, is_inside: bool, to: tuple[float, float]
) -> None:
    """4 m/s end after 5.3 m at the usual braking; the sides are 4 to 5 m away."""
    vel = 4.0 * np.array([*to, 0.0])
    stopped = planner(volume, u_max=0.6).stopping_from(np.array([0.0, 0.0, -2.0]), vel, UTC_US)
    assert (float(VOLUME.beyond_m(stopped.pos_ned_m).max()) <= -KEPT_M + 1e-6) == is_inside
    assert np.allclose(np.cross(stopped.pos_ned_m[-1] - stopped.pos_ned_m[0], vel), 0.0, atol=1e-9), "straight ahead"


@pytest.mark.parametrize(
    ("tilt_max_rad", "u_max"), [(0.9, 0.8 * 0.6), (0.6, 0.8 * np.sin(0.6)), (0.3, 0.8 * np.sin(0.3))]
)
def test_it_is_stopped_no_harder_than_plans_and_vehicle_may_and_no_harder_than_needed(
    tilt_max_rad: float, u_max: float
) -> None:
    vel, plans = np.array([4.0, 0.0, 0.0]), planner(u_max=0.6, model=VehicleModelParams(tilt_max_rad=tilt_max_rad))
    near = np.array([4.0, 0.0, -2.0])
    hardest_m_s2 = GRAVITY_M_S2 * np.tan(np.arcsin(u_max))
    assert np.linalg.norm(plans.stopping_from(near, vel, UTC_US).acceleration(UTC_US)) == pytest.approx(hardest_m_s2)
    inwards = plans.stopping_from(near, -0.5 * vel, UTC_US)
    assert np.linalg.norm(inwards.acceleration(UTC_US)) == pytest.approx(CommitParams().brake_m_s2)


@pytest.mark.parametrize(
    ("volume", "from_m", "is_inside"), [(VOLUME, 1.9, True), (None, 1.9, False), (VOLUME, 1.1, False)]
)
def test_an_evasion_stays_inside_only_where_one_that_does_is_clear(
    volume: FlightVolume | None, from_m: float, is_inside: bool
) -> None:
    """Under the ceiling a climb over what approaches gains most; a straight stop is clear of what is farther away."""
    moving = stopping(np.array([0.0, 0.0, -4.0]), np.array([1.0, 0.0, 0.0]), UTC_US, 100_000, brake_m_s2=0.5)
    plans = planner(volume)
    ball = builders.keep_out(pos_ned_m=np.linspace([from_m, 0.0, -4.0], [from_m - 0.4, 0.0, -4.0], plans.steps + 1))
    now = builders.situation(utc_us=UTC_US, begin_us=UTC_US, desired=towards((3.0, 0.0, -4.0)), others=[ball])
    found = plans.evasive_trajectory(moving, now)
    assert found is not None
    assert (float(VOLUME.beyond_m(found.pos_ned_m).max()) <= -CERTIFIED_M) == is_inside


# -- ways and places --------------------------------------------------------------------------------------------------


def test_a_detour_does_not_lead_out_of_the_sides() -> None:
    """The shorter way round a disc near a side is outside."""
    start, goal, discs = np.array([-3.0, 3.4]), np.array([3.0, 3.4]), np.array([[0.0, 3.0, 1.0]])
    free = shortest_path(start, goal, discs, 0.3)
    assert free.corners[:, 1].max() > 4.0 - KEPT_M
    kept = shortest_path(start, goal, discs, 0.3, sides=VOLUME.planned_sides)
    heights = np.full((len(kept.corners), 1), -2.0)
    assert float(VOLUME.beyond_plans_m(np.hstack([kept.corners, heights])).max()) <= 0.0
    assert kept.is_clear(discs)


def test_a_landing_place_is_inside() -> None:
    pos, other = np.array([0.0, 3.6, -2.0]), np.array([0.3, 3.2, -2.0])
    taken = [Taken(center_ned_m=other, apart_m=1.1)]
    place = landing_place_ned_m(pos, taken, 0)
    assert float(VOLUME.beyond_plans_m(place)) > 0.0
    inside = landing_place_ned_m(pos, taken, 0, VOLUME)
    assert float(VOLUME.beyond_plans_m(inside)) <= 1e-6
    assert np.linalg.norm((inside - other)[:2]) >= 1.1 - 0.01


def test_margins_are_those_of_the_parameters() -> None:
    wider = FlightVolume(VOLUME.params.model_copy(update={"margin_m": 1.0}))
    track, _ = flown(controller(volume=wider), OUTSIDE[0], seconds=4.0)
    assert float(VOLUME.beyond_m(track).max()) <= -0.95
