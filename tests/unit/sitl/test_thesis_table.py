"""The table of the reproduction: every required row, with its published figure and its limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from sitl.studies.thesis import command, reproduce, score
from sitl.studies.thesis import experiments as thesis
from sitl.studies.thesis.comparisons import lower_bound_index_m
from sitl.studies.thesis.experiments import FULL_JOBS, PLANT_JOBS, Job
from sitl.studies.thesis.figures import FLIGHTS, SWARMS
from sitl.studies.thesis.page import flight_of
from sitl.studies.thesis.table import rows
from sitl.studies.thesis.thesis_values import differences
from sitl.studies.thesis.trace import Row, Trace
from sitl.studies.thesis.verdicts import verdict_of
from swarmctl.built_in_configs import built_in_config
from swarmctl.config import load
from swarmctl.core.obstacle import Obstacle
from swarmctl.errors import EXIT_USAGE, ConfigError

JOBS = (*PLANT_JOBS, *FULL_JOBS)
RADII = ("3", "2.7", "2.5", "2.3", "2", "1.5", "1")
INDEX_LIMITS_M = (2.19, 2.04, 1.95, 1.85, 1.80, 1.55, 1.30)
PUBLISHED_M = (2.19, 2.04, 1.95, 1.85, None, None, None)
MPC_SLOW_LIMIT_M, MPC_FAST_LIMIT_M = 1.6 * 0.0043, 1.6 * 0.0145

Wanted = tuple[str, float | None, float | None]  # name, published, limit
SINGLE: list[Wanted] = [
    ("PID slow, Table 5, mean distance", 0.0205, 1.2 * 0.0205),
    ("PID slow, Table 5, MSE x", 0.0020, None),
    ("PID slow, Table 5, MSE y", 9.2778e-5, None),
    ("PID slow, Table 5, MSE z", 0.0059, None),
    ("PID slow, Table 5, tuned, mean distance", 0.0205, 0.0150),
    ("PID fast, Table 6, mean distance", 0.0741, 1.2 * 0.0741),
    ("PID fast, Table 6, MSE x", 0.0068, None),
    ("PID fast, Table 6, MSE y", 0.0011, None),
    ("PID fast, Table 6, MSE z", 0.0197, None),
    ("PID fast, Table 6, tuned, mean distance", 0.0741, 0.0400),
    ("MPC slow, Table 11, mean distance", 0.0043, MPC_SLOW_LIMIT_M),
    ("MPC slow, Table 11, MSE x", 0.0007, None),
    ("MPC slow, Table 11, MSE y", 0.0, None),
    ("MPC slow, Table 11, MSE z", 0.0024, None),
    ("MPC slow, Table 11, tuned, matched start, mean distance", 0.0043, 0.0040),
    ("MPC slow, Table 11, tuned, matched start, MSE x", 0.0007, 0.0008),
    ("MPC slow, Table 11, tuned, matched start, MSE z", 0.0024, 0.0021),
    ("MPC slow, Table 11, tuned, steady RMSE", None, 0.0005),
    ("MPC slow, Table 11, tuned, matched start, steady RMSE", None, 0.0005),
    ("MPC fast, Table 12, matched start, mean distance", 0.0145, MPC_FAST_LIMIT_M),
    ("MPC fast, Table 12, mean distance", 0.0145, 0.0145),
    ("MPC fast, Table 12, MSE z", 0.0081, 0.0081),
    ("MPC fast, Table 12, tuned, mean distance", 0.0145, 0.0145),
    ("MPC fast, Table 12, tuned, MSE z", 0.0081, 0.0081),
    ("MPC fast, Table 12, matched start, MSE x", 0.0024, None),
    ("MPC fast, Table 12, matched start, MSE y", 0.0, None),
    ("MPC fast, Table 12, matched start, MSE z", 0.0081, None),
    ("MPC fast, Table 12, tuned, matched start, mean distance", 0.0145, 0.0130),
    ("MPC fast, Table 12, tuned, steady RMSE", None, 0.0005),
    ("MPC fast, Table 12, tuned, matched start, steady RMSE", None, 0.0005),
]
CIRCLES: list[Wanted] = [
    wanted
    for kind in ("dmpc tuned", "dmpc3 tuned")
    for radius, published_m, limit_m in zip(RADII, PUBLISHED_M, INDEX_LIMITS_M, strict=True)
    for wanted in (
        (f"circle {kind}, Table 19, {radius} x 0.3 m, index", published_m, limit_m),
        (f"circle {kind}, Table 19, {radius} x 0.3 m, closer than the radius by", None, 0.01),
    )
]
SETTLED: list[Wanted] = [
    (f"circle {kind}, Table 19, 3 x 0.3 m, index after 10 s over the theoretical lower bound", None, 1.05)
    for kind in ("dmpc tuned", "dmpc3 tuned")
]
AS_PRINTED: list[Wanted] = [
    (f"circle dmpc thesis values, Table 19, {radius} x 0.3 m, index", published_m, None)
    for radius, published_m in zip(RADII[:5], PUBLISHED_M, strict=False)
]
OBSTACLE: list[Wanted] = [
    *(
        (f"obstacle {kind}, {reading}", 2.88, None)
        for kind in ("dmpc thesis values", "dmpc tuned, thesis weights")
        for reading in ("index", "distances among the agents")
    ),
    *(
        wanted
        for kind in ("dmpc tuned", "dmpc3 tuned")
        for wanted in (
            (f"obstacle {kind}, index", 2.88, 2.60),
            (f"obstacle {kind}, distances among the agents", 2.88, None),
            (f"obstacle {kind}, inside the keep-out by", None, 0.0),
            (f"obstacle {kind}, closer to each other by", None, 0.0),
        )
    ),
]
BETTER: list[Wanted] = [
    *((f"circle, {radius} x 0.3 m, index, dmpc3 over dmpc", None, 1.0) for radius in RADII),
    ("circle, 3 x 0.3 m, index after 10 s, dmpc3 over dmpc", None, 1.0),
    ("obstacle, index, dmpc3 over dmpc", None, 1.0),
]
FULL: list[Wanted] = [
    (f"{name}, full MAVLink loop, index differs from model only by", None, 0.05)
    for name in (
        *(f"pid_{speed} {preset}" for speed in ("slow", "fast") for preset in ("thesis values", "tuned")),
        *(f"mpc_{speed} {preset}" for speed in ("slow", "fast") for preset in ("thesis values", "tuned")),
        *(f"circle {kind} tuned {radius} x 0.3 m" for kind in ("dmpc", "dmpc3") for radius in RADII),
        *(f"obstacle {preset}" for preset in ("dmpc tuned, thesis weights", "dmpc tuned", "dmpc3 tuned")),
    )
]
ALL = (*SINGLE, *CIRCLES, *SETTLED, *AS_PRINTED, *OBSTACLE, *BETTER, *FULL)


def fake(job: Job, apart_m: float = 1.0, off_m: float = 1.0) -> Trace:
    """A synthetic flight: 12 s, agents `off_m` above a reference at rest and `apart_m` from each other."""
    agents = 3 if job.flight in SWARMS else 1
    t_s = np.asarray(np.arange(600) * 0.02, np.float64)
    nothing = np.zeros((600, agents, 3))
    pos = nothing + np.array([0.0, 0.0, -off_m])
    pos[:, :, 0] += apart_m * np.arange(agents)
    spheres = (Obstacle(center_ned_m=(0.0, 0.0, 5.0)),) if job.flight == "obstacle" else ()
    thrust = np.zeros((600, agents))
    ref = nothing + np.array([1.0, 0.0, 0.0]) * (apart_m * np.arange(agents))[None, :, None]
    return Trace(
        name=job.name,
        path=job.path,
        t_s=t_s,
        pos_ned_m=pos,
        vel_ned_m_s=nothing,
        euler_rad=nothing,
        ref_pos_ned_m=ref,
        euler_ref_rad=nothing,
        thrust_n=thrust,
        torque_n_m=nothing,
        failed=0,
        terminal_missed=0,
        obstacles=spheres,
    )


def rows_of(jobs: Sequence[Job]) -> dict[str, Row]:
    return {row.name: row for row in rows({job.name: fake(job) for job in jobs})}


@pytest.fixture(scope="module")
def table() -> dict[str, Row]:
    """All rows, the flights at true distance included."""
    again = [thesis.wider(job, fake(job)) for job in PLANT_JOBS if thesis.is_flown_again(job)]
    return rows_of([*JOBS, *again])


@pytest.mark.parametrize(("name", "published", "limit"), ALL, ids=lambda v: str(v))
def test_what_was_asked_for_is_there(
    table: dict[str, Row], name: str, published: float | None, limit: float | None
) -> None:
    row = table[name]
    assert row.published == published
    assert row.limit == (None if limit is None else pytest.approx(limit, rel=1e-12))
    assert row.path == ("full" if ", full MAVLink loop" in name else "plant")


def test_nothing_else_is_asked_for(table: dict[str, Row]) -> None:
    listed = {name for name, _, limit in ALL if limit is not None}
    assert {name for name, row in table.items() if row.limit is not None} == listed


def test_names_are_unique() -> None:
    assert len({job.name for job in JOBS}) == len(JOBS)
    again = [thesis.wider(job, fake(job)) for job in PLANT_JOBS if thesis.is_flown_again(job)]
    names = [row.name for row in rows({job.name: fake(job) for job in (*JOBS, *again)})]
    assert len(names) == len(set(names)) > 150


def test_every_row_belongs_to_a_flight(table: dict[str, Row]) -> None:
    flights = {flight_of(name) for name in table}
    assert flights == {*FLIGHTS} - {"open_loop", "pid_step", "pid_steps"}  # the thesis gives no figures of those


def test_without_flights_there_are_no_rows() -> None:
    assert rows({}) == []


@pytest.mark.parametrize("job", JOBS, ids=lambda job: str(job.name))
def test_a_flight_alone_makes_only_rows_of_its_own_path(job: Job) -> None:
    found = rows_of([job]).values()
    assert {row.path for row in found} <= {job.path}
    assert not any("over dmpc" in row.name or "differs" in row.name for row in found)


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("PID fast, Table 6, mean distance", 1.0),
        ("PID fast, Table 6, MSE x", 0.0),
        ("PID fast, Table 6, MSE z", 1.0),
        ("MPC slow, Table 11, tuned, steady RMSE", 1.0),
        ("circle dmpc tuned, Table 19, 2 x 0.3 m, index", 3.0),
        ("circle dmpc tuned, Table 19, 3 x 0.3 m, closer than the radius by", 0.0),
        (
            "circle dmpc tuned, Table 19, 3 x 0.3 m, index after 10 s over the theoretical lower bound",
            3.0 / (math.sqrt(3.0) * 0.9),
        ),
        ("obstacle dmpc3 tuned, inside the keep-out by", 0.0),
        ("circle, 3 x 0.3 m, index, dmpc3 over dmpc", 1.0),
        ("mpc_fast tuned, full MAVLink loop, index differs from model only by", 0.0),
    ],
)
def test_rows_show_their_figure(table: dict[str, Row], name: str, ours: float) -> None:
    assert table[name].ours == pytest.approx(ours, abs=1e-12)


def test_distances_that_were_not_kept_are_reported() -> None:
    near = {job.name: fake(job, apart_m=0.85, off_m=-3.5) for job in JOBS if job.flight in SWARMS}
    found = {row.name: row for row in rows(near)}
    assert found["circle dmpc tuned, Table 19, 3 x 0.3 m, closer than the radius by"].ours == pytest.approx(0.05)
    assert found["circle dmpc tuned, Table 19, 3 x 0.3 m, closer than the radius by"].met is False
    assert found["circle dmpc tuned, Table 19, 2.7 x 0.3 m, closer than the radius by"].ours == 0.0
    assert found["obstacle dmpc3 tuned, closer to each other by"].ours == pytest.approx(0.05)
    assert found["obstacle dmpc tuned, inside the keep-out by"].ours == pytest.approx(0.25)


def test_a_ratio_is_of_dmpc3_over_dmpc_and_of_full_over_plant() -> None:
    jobs = {job.name: job for job in JOBS}
    name = "circle dmpc tuned 3 x 0.3 m"
    flown = {
        name: fake(jobs[name]),
        name.replace("dmpc", "dmpc3"): fake(jobs[name.replace("dmpc", "dmpc3")], off_m=0.8),
        f"{name}, full MAVLink loop": fake(jobs[f"{name}, full MAVLink loop"], off_m=0.9),
    }
    found = {row.name: row.ours for row in rows(flown)}
    assert found["circle, 3 x 0.3 m, index, dmpc3 over dmpc"] == pytest.approx(0.8)
    assert found[f"{name}, full MAVLink loop, index differs from model only by"] == pytest.approx(0.1)


@pytest.mark.parametrize("job", JOBS, ids=lambda job: str(job.name))
def test_every_job_names_a_config_that_is_there_and_is_of_its_flight(job: Job) -> None:
    config = job.loaded()
    assert config.swarm.agents == (3 if job.flight in SWARMS else 1)
    assert bool(config.obstacles) is (job.flight == "obstacle")
    kinds = {"open_loop": "open_loop", "pid": "pid", "mpc": "mpc"}
    wanted = kinds.get(job.flight, kinds.get(job.flight.split("_")[0], "dmpc3" if "dmpc3" in job.name else "dmpc"))
    assert config.controller.kind == wanted


@pytest.mark.parametrize("flight", [flight for flight in FLIGHTS if flight.endswith(("_slow", "_fast"))])
def test_what_is_improved_flies_the_published_mission(flight: str) -> None:
    published, improved = (load(built_in_config(f"{kind}_4_{flight}")) for kind in ("thesis", "improved"))
    assert improved.mission == published.mission
    assert improved.starts_ned_m() == published.starts_ned_m()


@pytest.mark.parametrize(
    ("published", "improved"),
    [
        ("thesis_5_circle", "improved_5_circle_dmpc3"),
        ("thesis_6_obstacle", "improved_6_obstacle"),
        ("thesis_6_obstacle", "improved_6_obstacle_dmpc3"),
    ],
)
def test_improved_swarms_fly_the_published_mission_and_keep_no_less(published: str, improved: str) -> None:
    before, after = load(built_in_config(published)), load(built_in_config(improved))
    assert after.mission == before.mission
    assert after.starts_ned_m() == before.starts_ned_m()
    assert after.separation.radius_m >= before.separation.radius_m
    for one, other in zip(before.obstacles, after.obstacles, strict=True):
        assert (other.center_ned_m, other.radius_m) == (one.center_ned_m, one.radius_m)
        assert other.visibility_m == one.visibility_m
        assert other.keep_out_m >= one.keep_out_m


def test_a_config_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(ConfigError, match=r"known are .*thesis_5_circle"):
        built_in_config("thesis_7")


@pytest.mark.parametrize("factor", thesis.RADII)
def test_radii_are_flown_at_what_they_are_called(factor: float) -> None:
    (job,) = (job for job in PLANT_JOBS if job.name == f"circle dmpc tuned {factor:g} x 0.3 m")
    config = job.loaded()
    assert config.separation.radius_m == pytest.approx(0.3 * factor)
    assert config.separation.certify_slack_m <= 0.11 * config.separation.radius_m + 1e-9


def test_a_flight_at_true_distance_is_wider_by_what_was_missing() -> None:
    (job,) = (job for job in PLANT_JOBS if job.name == "circle dmpc tuned 2 x 0.3 m")
    wider = thesis.wider(job, fake(job, apart_m=0.58))
    config = wider.loaded()
    assert config.separation.radius_m == pytest.approx(0.62)
    row = rows_of([wider])["circle dmpc tuned, Table 19, 2 x 0.3 m, index at equal true distance"]
    assert row.limit is None
    kept = thesis.wider(job, fake(job, apart_m=0.61))
    assert kept.loaded().separation.radius_m == pytest.approx(0.6)


def test_lower_bound_of_the_index_is_an_equilateral_triangle() -> None:
    assert lower_bound_index_m(0.9) == pytest.approx(3 * 0.9 / math.sqrt(3.0))  # circumradius of each corner
    corners = 0.9 / math.sqrt(3.0) * np.exp(2j * np.pi * np.arange(3) / 3)
    off = np.stack([corners.real, corners.imag, np.zeros(3)], axis=1)
    job = PLANT_JOBS[-1]
    trace = fake(job)
    trace.pos_ned_m[:] = trace.ref_pos_ned_m[:, :1] + off
    trace.ref_pos_ned_m[:] = trace.ref_pos_ned_m[:, :1]
    assert score.separation_m(trace) == pytest.approx(0.9)
    assert score.index_m(trace) == pytest.approx(lower_bound_index_m(0.9))


# -- what the table says of its rows ----------------------------------------------------------------------------------


def test_a_row_is_called_tuned_if_and_only_if_its_preset_differs_from_the_thesis(table: dict[str, Row]) -> None:
    of_presets = [row for row in table.values() if row.preset]
    assert {("tuned" in row.name) is bool(row.differs) for row in of_presets} == {True}
    assert {row.published is None or row.preset != "" for row in table.values()} == {True}
    assert {bool(row.differs) for row in of_presets} == {True, False}


@pytest.mark.parametrize("job", [job for job in PLANT_JOBS if job.thesis_values or job.config.startswith("thesis_4")])
def test_what_has_the_thesis_values_differs_in_none(job: Job) -> None:
    assert job.differences() == ()


def test_a_difference_names_the_key_and_both_values() -> None:
    flown = load(built_in_config("thesis_4_mpc_fast"), ["controller.mpc.x.r=0.7", "agent.disturbance.enabled=true"])
    assert differences("mpc_fast", flown) == (
        "agent.disturbance.enabled on (thesis off)",
        "controller.mpc.x.r 0.7 (thesis 0.75)",
    )
    circle = differences("circle", load(built_in_config("thesis_5_circle")))
    assert "controller.mpc.z.r 1 (thesis 0.01)" in circle
    assert "controller.mpc.terminal_z region (thesis position_velocity)" in circle


def test_table_12_from_rest_is_asked_for_the_published_figures_and_its_mse_z_is_out_of_reach(
    table: dict[str, Row],
) -> None:
    for preset in ("", ", tuned"):
        mean, mse_z = (table[f"MPC fast, Table 12{preset}, {figure}"] for figure in ("mean distance", "MSE z"))
        assert (mean.limit, mse_z.limit) == (mean.published, mse_z.published) == (0.0145, 0.0081)
        assert mean.bound_source == mse_z.bound_source == "python tools/lower_bound.py"
        assert (mean.out_of_reach, mse_z.out_of_reach) == (False, True)
        assert verdict_of(mse_z) == "missed, out of reach"


def test_a_lower_bound_says_where_it_comes_from(table: dict[str, Row]) -> None:
    bounded = [row for row in table.values() if row.lower_bound is not None]
    assert len(bounded) > 100
    assert all(row.bound_source for row in bounded)
    assert {row.bound_source for row in table.values() if row.lower_bound is None} == {""}


def test_every_limit_of_a_swarm_has_a_lower_bound_beside_it(table: dict[str, Row]) -> None:
    assert all(row.lower_bound is not None for row in table.values() if row.limit and flight_of(row.name) in SWARMS)


def test_both_readings_of_the_distances_of_4_4_are_there(table: dict[str, Row]) -> None:
    reference, among = (table[f"obstacle dmpc tuned, {reading}"] for reading in ("index", "distances among the agents"))
    assert reference.published == among.published == 2.88
    assert reference.ours == pytest.approx(3.0)  # three agents 1 m above the reference
    assert among.ours == pytest.approx(1.0 + 1.0 + 2.0)  # in a row, 1 m apart
    assert among.lower_bound == pytest.approx(2.7)


@pytest.mark.parametrize("job", [job for job in JOBS if job.radius_m is not None], ids=lambda job: str(job.name))
def test_the_safety_filter_is_off_where_it_would_keep_more_than_the_radius_and_the_row_says_so(job: Job) -> None:
    config = job.loaded()
    assert job.radius_m is not None
    kept_m = config.separation.budget.barrier_m(config.agent.barrier.margin_m)
    assert config.agent.barrier.enabled is (job.radius_m >= kept_m)
    found = rows_of([job]).values()
    if job.path == "full":
        assert all(("safety filter off" in row.note) is (job.radius_m < kept_m) for row in found)
    else:
        points = job.radius_m < config.separation.body_m
        assert all(("vehicles are points" in row.note) is points for row in found if row.limit is not None)


# -- which flights ----------------------------------------------------------------------------------------------------


def flights_and_paths(*only: str, plant: bool = False, full: bool = False) -> set[tuple[str, str]]:
    return {(job.flight, job.path) for job in reproduce.chosen(only, plant, full)}


def test_everything_is_chosen_when_nothing_is_said() -> None:
    assert reproduce.chosen((), False, False) == list(JOBS)
    assert reproduce.chosen((), True, True) == list(JOBS)
    assert {job.flight for job in JOBS} == set(FLIGHTS)


def test_one_path_alone() -> None:
    assert reproduce.chosen((), True, False) == list(PLANT_JOBS)
    assert reproduce.chosen((), False, True) == list(FULL_JOBS)


def test_a_start_in_motion_is_flown_on_the_plant_only() -> None:
    assert any(job.matched_velocity for job in PLANT_JOBS)
    assert not any(job.matched_velocity for job in FULL_JOBS)
    assert len(FULL_JOBS) == sum(not job.matched_velocity and not job.thesis_values for job in PLANT_JOBS)


def test_only_some_flights() -> None:
    assert flights_and_paths("pid_fast", "obstacle", plant=True) == {("pid_fast", "plant"), ("obstacle", "plant")}
    assert flights_and_paths("pid_fast") == {("pid_fast", "plant"), ("pid_fast", "full")}
    assert flights_and_paths("circle", full=True) == {("circle", "full")}
    assert flights_and_paths(reproduce.TIMING) == set()


def test_an_unknown_flight_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(ConfigError) as refused:
        reproduce.chosen(["pid_fast", "loop", "7"], False, False)
    assert len(refused.value.problems) == 2
    for problem, name in zip(refused.value.problems, ("loop", "7"), strict=True):
        assert repr(name) in problem
        assert all(known in problem for known in (*FLIGHTS, reproduce.TIMING))


@pytest.mark.parametrize("arguments", [["--only=loop"], ["--only", "pid_fast", "--only", "7"], ["--jobs=0"]])
def test_bad_usage_is_2_and_leaves_nothing(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command.main(arguments) == EXIT_USAGE
    assert arguments[-1].split("=")[-1] in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
