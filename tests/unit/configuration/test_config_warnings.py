"""Tests what is said of configurations that are valid, and may not be what was meant."""

from __future__ import annotations

import json
import re
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import swarmctl
from swarmctl.config import dump, load, load_mission
from swarmctl.configuration.config_warnings import config_warnings, unplayed, warning_lines
from swarmctl.core.obstacle import Obstacle
from swarmctl.errors import ConfigError

ROOT = Path(__file__).parents[3]
GOALS = "mission.goto.goals_ned_m=[[4, 0, -1]]"


def lines(*overrides: str) -> list[str]:
    return config_warnings(load(None, overrides))


def test_the_section_of_a_kind_that_is_not_flown_is_named() -> None:
    (said,) = lines("mission.kind=circle", GOALS)
    assert said == "mission.goto is set, mission.kind is 'circle': it is not flown"
    assert warning_lines(load(None, ["mission.kind=circle", GOALS])) == [f"warning: {said}"]
    assert "mission.own is set" in lines("mission.kind=hover", "mission.own.a=1")[0]
    assert len(lines("mission.kind=hover", GOALS, "mission.circle.radius_m=3")) == 2


def test_commitments_that_keep_less_than_the_flight_is_judged_by_are_named() -> None:
    guaranteed = "separation.mode=guaranteed"
    (said,) = lines(guaranteed)
    assert said.startswith("separation.radius_m = 0.9: commitments keep 0.82 m, and the flight fails below")
    assert said.endswith("limits.min_separation_m = 0.85; 0.95 m keeps that")
    assert lines(guaranteed, "separation.radius_m=0.95") == lines(guaranteed, "limits.min_separation_m=0.8") == []
    assert lines(guaranteed, "swarm.agents=1") == [], "there is nobody to keep it from"


def test_commitments_that_keep_less_from_an_obstacle_than_the_flight_is_judged_by_are_named() -> None:
    """The built-in obstacle flight came to 1.680 m, where 1.73 m were required."""
    keeps = ("separation.mode=guaranteed", "separation.radius_m=0.95")
    wide, narrow = (f"obstacles=[{{center_ned_m=[20,20,-1],radius_m=1,keep_out_m={m}}}]" for m in (1.78, 1.05))
    (said,) = lines(*keeps, wide)
    assert said.startswith("obstacles.0.keep_out_m = 1.78: commitments keep 1.68 m, and the flight fails below 1.73 m;")
    assert said.endswith("; limits.obstacle_margin_m = 0.1 judges by that")
    assert lines(*keeps, wide, "limits.obstacle_margin_m=0.1") == lines(wide) == []
    (said,) = lines(*keeps, narrow, "limits.obstacle_margin_m=0.1")
    assert said.endswith("commitments keep 0.95 m, and the flight fails below 1.00 m; 1.1 m keeps that")
    assert lines(*keeps, narrow.replace("1.05", "1.1"), "limits.obstacle_margin_m=0.1") == []


ALONE = ("swarm.agents=1", "start.positions_ned_m=[[0,0,-2]]")
FAR_POINTS = ("mission.kind=waypoints", "mission.waypoints.lists=[{points_ned_m=[[0,0,-2],[80,0,-2]]}]")


def table(folder: Path) -> tuple[str, ...]:
    path = folder / "long.csv"
    path.write_text("t,x,y,z\n0,0,0,-2\n60,30,0,-2\n")
    return ("mission.kind=csv", f"mission.csv.files=['{path}']")


def show(folder: Path) -> tuple[str, ...]:
    points = [[0, [0, 0, 2], []], [60, [30, 0, 2], []]]
    drone = {"settings": {"trajectory": {"version": 1, "takeoffTime": 0, "points": points}}}
    with zipfile.ZipFile(folder / "show.skyc", "w") as archive:
        archive.writestr("show.json", json.dumps({"version": 1, "swarm": {"drones": [{"type": "generic", **drone}]}}))
    return ("mission.kind=skybrush", f"mission.skybrush.file='{folder / 'show.skyc'}'")


@pytest.mark.parametrize(
    ("mission", "enough_s"),
    [(lambda _: FAR_POINTS, 200), (table, 60), (show, 60)],
    ids=["waypoints", "csv", "skybrush"],
)
def test_a_mission_that_ends_before_its_reference_does_is_named(
    mission: Callable[[Path], tuple[str, ...]], enough_s: int, tmp_path: Path
) -> None:
    flown = (*ALONE, *mission(tmp_path))
    (said,) = lines(*flown, "mission.duration_s=30")
    assert said.startswith("mission.duration_s = 30: the reference of agent 0 is then ")
    assert " m from where it ends, after " in said
    assert lines(*flown, f"mission.duration_s={enough_s}") == []


def test_a_swap_that_is_cut_short_is_named() -> None:
    swap = ("swarm.agents=2", "start.spacing_m=4", "mission.kind=swap", "mission.swap.travel_s=20")
    assert len(lines(*swap, "mission.duration_s=10")) == 2
    assert lines(*swap, "mission.duration_s=20") == []


@pytest.mark.parametrize(("corner_m", "outside"), [(11, True), (25, False)])
def test_a_way_home_that_leaves_the_fence_is_named(corner_m: int, outside: bool) -> None:
    """On the circle of 5 m it ends at 7.5 m/s."""
    corners = [[-corner_m, -corner_m], [corner_m, -corner_m], [corner_m, corner_m], [-corner_m, corner_m]]
    fast = load(ROOT / "configs" / "x500_fast_circle.toml", [f"geofence.corners_ne_m={corners}"])
    (said,) = config_warnings(fast) or [""]
    assert ("agent 0: after the mission, at 7.5 m/s, its way home leads " in said) is outside


@pytest.mark.parametrize(("notch_m", "crossed"), [(5, True), (40, False)])
def test_a_way_home_across_a_notch_of_the_fence_is_named(notch_m: int, crossed: bool) -> None:
    """From the north to the east by a corner: the straight way back is in the fence at first, and not later on."""
    corners = f"[[-5,-5],[40,-5],[40,{notch_m}],[{notch_m},{notch_m}],[{notch_m},40],[-5,40]]"
    flown = "mission.waypoints.lists=[{points_ned_m=[[30,0,-3],[0,0,-3],[0,30,-3]]}]"
    mission = ("mission.kind=waypoints", "mission.duration_s=60", flown)
    fence = ("start.positions_ned_m=[[30,0,-3]]", "swarm.agents=1", f"geofence.corners_ne_m={corners}")
    said = lines(*mission, *fence)
    assert len(said) == crossed
    assert all(
        re.match(r"agent 0: from \d\d s on, its straight way home .* leads up to \d+\.\d m out", line) for line in said
    )


@pytest.mark.parametrize(
    ("mission", "at_m"),
    [
        ("mission.waypoints.lists=[{points_ned_m=[[0,-3,-2],GOAL]},{points_ned_m=[[0,3,-2],[10,0,-2]]}]", 0.0),
        ("mission.goto={goal_assignment=false,goals_ned_m=[GOAL,[10,0,-2]]}", 0.1),
        ("mission.goto={goal_assignment=false,goals_ned_m=[GOAL,[10,0,-2]]}", 1.0),
    ],
    ids=["waypoints", "goto", "apart"],
)
def test_goals_that_two_agents_can_not_both_be_at_are_named(mission: str, at_m: float) -> None:
    kind = mission.split(".")[1].partition("=")[0]
    two = ("swarm.agents=2", "start.positions_ned_m=[[0,-3,-2],[0,3,-2]]", f"mission.kind={kind}")
    found = lines(*two, mission.replace("GOAL", f"[10,{at_m},-2]"))
    near = f"the goals of agents 0 and 1 are {at_m:.2f} m apart; separation.radius_m = 0.9: not both arrive"
    assert found == ([near] if at_m < 0.9 else [])


def test_obstacles_whose_certificates_begin_inside_of_them_are_named() -> None:
    ball = "obstacles=[{center_ned_m=[20,20,-1],radius_m=1,keep_out_m=1.05}]"
    (said,) = lines(ball)
    assert said.startswith("obstacles.0.keep_out_m = 1.05: plans down to 0.95 m are flown, which is inside of it")
    assert said.endswith("(radius_m = 1); 1.1 m keeps them out")
    assert lines(ball.replace("1.05", "1.1")) == lines(ball, "separation.certify_slack_m=0.05") == []


def test_starts_that_only_heights_keep_apart_are_named() -> None:
    hover = ("swarm.agents=2", "mission.kind=hover", "start.positions_ned_m=[[0,0,-1],[0.7,0,-4]]")
    (said,) = lines(*hover)
    assert "agents 0 and 1 start 0.70 m apart in the plane" in said
    assert "limits.min_separation_m = 0.85" in said
    assert lines(*hover, "sitl.start=air") == []
    assert lines(*hover[:2], "start.positions_ned_m=[[0,0,-1],[0.95,0,-4]]") == []


@pytest.mark.parametrize(("speed_m_s", "is_named"), [(2.0, False), (10.0, True)])
def test_an_obstacle_on_the_way_that_is_seen_too_late_is_named(speed_m_s: float, is_named: bool) -> None:
    """At 10 m/s one was passed 0.33 m from its centre, of a radius of 1 m."""
    goto = f"mission.goto={{goals_ned_m=[[60,0,0]],speed_m_s={speed_m_s},accel_m_s2=3}}"
    alone = ("swarm.agents=1", "mission.kind=goto", goto, "start.positions_ned_m=[[0,0,0]]", "mission.duration_s=60")
    tilts = "controller.mpc.u_max=0.31"  # it may accelerate by the 3 m/s2 that the mission asks for
    on_the_way, aside = (f"obstacles=[{{center_ned_m=[30,{east},-1]}}]" for east in (0.1, 20.0))
    said = lines(*alone, tilts, "sitl.start=air", on_the_way)
    assert len(said) == is_named
    assert all("obstacles.0: agent 0 sees it 1.25 m before its keep-out, at" in line for line in said)
    assert lines(*alone, tilts, "sitl.start=air", aside) == []


@pytest.mark.parametrize(("away_m", "is_named"), [(60, True), (0, False)])
def test_an_obstacle_on_the_way_to_a_reference_that_begins_elsewhere_is_named(away_m: int, is_named: bool) -> None:
    """One that caught up with a circle 60 m away, at 9.6 m/s, passed it 0.74 m from its centre, of a radius of 1 m."""
    circle = f"mission.circle={{center_ned_m=[{away_m},0,-2],radius_m=3,climb_ned_m_s=0.0}}"
    alone = ("swarm.agents=1", "sitl.start=air", "start.positions_ned_m=[[3,0,-2]]", circle, "mission.kind=circle")
    on_the_way, aside = (f"obstacles=[{{center_ned_m=[{away_m // 2 + 1},{east},-2]}}]" for east in (0.4, 20.0))
    named = [
        " as it catches up with its reference, from which it stops in " in line for line in lines(*alone, on_the_way)
    ]
    assert named == [True] * is_named
    assert lines(*alone, aside) == []


def test_an_obstacle_that_is_seen_later_than_is_committed_is_named() -> None:
    """Three in formation, one of them straight at it, came 0.2 m closer than they certify; seen from afar none does."""
    goto = "mission.goto={goals_ned_m=[[60,0,0]],speed_m_s=1.5}"
    alone = ("swarm.agents=1", "mission.kind=goto", goto, "start.positions_ned_m=[[0,0,0]]", "mission.duration_s=99")
    late, early = (f"obstacles=[{{center_ned_m=[30,0.1,-1],visibility_m={m}}}]" for m in (3.0, 6.3))
    keeps = ("separation.mode=guaranteed", "separation.radius_m=0.95", "limits.obstacle_margin_m=0.1")
    commits = (*alone, "sitl.start=air", *keeps)
    (said,) = lines(*commits, late)
    assert said == (
        "obstacles.0: agent 0 sees it 1.25 m before its keep-out, at 1.5 m/s, by when it has committed to 4.50 m; "
        "raise visibility_m"
    )
    assert lines(*commits, early) == lines(*alone, "sitl.start=air", late) == []


def test_a_reference_that_asks_for_more_than_the_controller_may_tilt_is_named() -> None:
    """Of 4.05 m/s2 it has 2.0 by default: one was 4.5 m off a circle of 5 m, and the flight was "completed"."""
    fast = "mission.circle.omega_rad_s=0.9"
    (said,) = lines(fast)
    assert "asks for up to 4.05 m/s2 along an axis, controller.mpc.u_max = 0.2 gives 2.00" in said
    alone = ("swarm.agents=1", "controller.kind=pid")
    assert lines(fast, "controller.mpc.u_max=0.5") == lines(fast, *alone) == lines() == []
    guaranteed = 'separation.mode="guaranteed"'  # plans by these parameters under every controller
    assert any("asks for up to 4.05" in said for said in lines(fast, "controller.kind=pid", guaranteed))


def test_an_own_controller_is_told_that_it_is_asked_more_often_than_its_plans_step() -> None:
    own = "controller.kind=tests.benches.misbehaving:Straight"
    (said,) = lines(own, "agent.rate_hz=100")
    assert "is asked every 0.01 s, and its dt_s is controller.mpc.dt_s = 0.02" in said
    assert lines(own) == lines(own, "agent.rate_hz=100", "controller.mpc.dt_s=0.01") == []


def test_real_vehicles_that_may_tilt_steeply_at_the_yaw_of_euler_angles_are_named() -> None:
    real = ("swarm.agents=1", "sitl.enabled=false", 'vehicles=[{url="udpin://127.0.0.1:14540",sysid=1}]')
    steep = "vehicle_model.tilt_max_rad=0.85"
    (said,) = lines(*real, steep)
    assert said.startswith("vehicle_model.heading = 'euler' with tilt_max_rad = 0.85") and "'swing_twist'" in said
    assert lines(steep) == lines(*real) == lines(*real, steep, "vehicle_model.heading=swing_twist") == []


@pytest.mark.parametrize("limit_m", [0.52, 0.6, 0.85, 1.5])
def test_the_radius_named_is_the_least_that_keeps_it(limit_m: float) -> None:
    budget = load(None).separation.budget
    radius_m = budget.radius_that_commits_m(limit_m)
    assert replace(budget, radius_m=radius_m).committed_m == pytest.approx(limit_m)
    assert replace(budget, radius_m=radius_m - 0.01).committed_m < limit_m


def test_without_any_kind_it_is_refused() -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, [GOALS, "mission.helix.rise_s=9"])
    (problem,) = caught.value.problems
    assert problem.startswith("mission.goto is set, as mission.helix, mission.kind is not: 'circle' would be flown")
    assert problem.endswith("Set mission.kind = 'goto'")
    with pytest.raises(ConfigError, match="'module:Class'"):
        load(None, ["mission.own.a=1"])


def test_so_is_a_mission_for_a_running_launch(tmp_path: Path) -> None:
    path = tmp_path / "mission.toml"
    path.write_text("[mission.goto]\ngoals_ned_m = [[4.0, 0.0, -1.0]]\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="is not: 'circle' would be flown"):
        load_mission(load(None), path)


def test_negative_control_nothing_is_said_of_what_is_flown(tmp_path: Path) -> None:
    assert lines() == lines("mission.circle.radius_m=3") == lines("mission.kind=goto", GOALS) == []
    assert lines("mission.identify.step_m=1") == [], "which check --identify flies, whatever the mission"
    path = tmp_path / "config.toml"
    path.write_text(dump(load(None, ["mission.kind=goto", GOALS])), encoding="utf-8")
    assert config_warnings(load(path)) == [], "a resolved configuration holds every section"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").rglob("*.toml")), ids=lambda path: path.name)
def test_nothing_is_said_of_our_own_files(path: Path) -> None:
    assert config_warnings(load(path)) == []


FALLS = "vehicle_model.thrust_min_01=0.2"


@pytest.mark.parametrize("given", [(), ("controller.kind=dmpc3",), ("controller.mpc.thrust_min_m_s2=-20",)])
def test_plans_that_fall_harder_than_the_vehicle_are_named(given: tuple[str, ...]) -> None:
    (said,) = lines(FALLS, *given)
    bound = "-20" if "controller.mpc.thrust_min_m_s2=-20" in given else "0"
    assert said == (
        f"controller.mpc.thrust_min_m_s2 = {bound}: plans fall by up to 9.81 m/s2, vehicle_model.thrust_min_01 = 0.2"
        " leaves 5.89: the vehicle is above what it has told others. Raise it to 3.92"
    )


@pytest.mark.parametrize(
    "given",
    [(FALLS, "controller.mpc.thrust_min_m_s2=3.92"), (FALLS, "controller.kind=pid", "swarm.agents=1"), ()],
)
def test_negative_control_who_falls_as_planned_is_not(given: tuple[str, ...]) -> None:
    assert lines(*given) == []


@pytest.mark.parametrize(("dt_s", "named"), [(0.08, True), (0.06, False)])
def test_plans_too_coarse_for_agents_that_meet_are_named(dt_s: float, named: bool) -> None:
    given = f"controller.mpc.dt_s={dt_s}"
    assert [said.startswith(f"controller.mpc.dt_s = {dt_s}: agents that meet") for said in lines(given)] == [
        True
    ] * named
    committed = ("separation.mode=guaranteed", "separation.radius_m=0.95")
    assert lines(given, "swarm.agents=1") == lines(given, *committed) == []


def begins_at(tmp_path: Path, z_m: float, *overrides: str) -> list[str]:
    path = tmp_path / "up.csv"
    path.write_text(f"t,x,y,z\n0,0,0,{z_m}\n20,1,0,{z_m}\n", encoding="utf-8")
    flown = ("mission.kind=csv", f"mission.csv.files=['{path}']", "mission.duration_s=20")
    return lines(*flown, "start.center_ned_m=[0,0,-2]", *overrides)


def test_a_reference_that_begins_away_from_its_agent_is_named(tmp_path: Path) -> None:
    said = begins_at(tmp_path, -2.5, "mission.csv.from_start=true", "start.spacing_m=2", "swarm.agents=5")
    assert said[0].startswith(
        "agent 0: the reference begins 2.50 m from its start (at -4, 0, -4.5, start -4, 0, -2); mission.csv.from_start"
    )
    assert len(said) == 4
    assert said[-1].startswith("2 more")
    timed = "mission.waypoints.lists=[{points_ned_m=[[9, 0, 0], [9, 1, 0]], times_s=[0, 9]}"
    timed = f"{timed}, {{points_ned_m=[[2, 0, 0], [2, 1, 0]], times_s=[0, 9]}}]"
    (own,) = lines("swarm.agents=2", "start.spacing_m=4", "mission.kind=waypoints", timed)
    assert own.startswith("agent 0: the reference begins 11.00 m from its start")
    assert "from_start" not in own


def test_negative_control_one_that_begins_there_or_is_shared_is_not(tmp_path: Path) -> None:
    assert begins_at(tmp_path, -0.4, "mission.csv.from_start=true") == []
    assert begins_at(tmp_path, -2.5) == [], "agents that share a reference fly to it"


def test_a_script_is_warned() -> None:
    with pytest.warns(UserWarning, match="mission.goto is set, mission.kind is 'hover'") as caught:
        swarmctl.load(set={"mission.kind": "hover", "mission.goto.goals_ned_m": [[4.0, 0.0, -1.0]]})
    assert caught[0].filename == __file__, "it points at the script"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        swarmctl.load()


def test_a_launch_says_what_only_lockstep_plays() -> None:
    assert list(unplayed(load(None))) == []
    (said,) = unplayed(load(None, ["bus.loss_01=0.5", "sitl.link_latency_ms=100"]))
    assert said.startswith("bus.loss_01 = 0.5, sitl.link_latency_ms = 100: of lockstep only")


def test_a_mission_whose_goals_are_in_an_obstacle_is_refused_in_flight_too(tmp_path: Path) -> None:
    flying = load(None, ["obstacles=[{center_ned_m=[4.0,0.0,-3.0],radius_m=0.5,keep_out_m=1.0}]"])
    path = tmp_path / "goals.toml"
    for north_m, refused in ((4.0, True), (8.0, False)):
        goals = f"[[{north_m}, 0.0, -3.0], [{north_m}, 4.0, -3.0], [{north_m}, 8.0, -3.0]]"
        text = f"[mission]\nkind = 'goto'\nduration_s = 60\n[mission.goto]\ngoals_ned_m = {goals}\n"
        path.write_text("\ufeff" + text, encoding="utf-8")  # with a mark of its byte order, as editors write it
        if refused:
            with pytest.raises(ConfigError, match=r"the goal of agent 0 is 0\.00 m from its centre"):
                load_mission(flying, path)
        else:
            load_mission(flying, path)


def test_in_flight_it_is_judged_by_the_obstacles_that_are_there_now(tmp_path: Path) -> None:
    began_with = load(None, ["swarm.agents=1", "obstacles=[{center_ned_m=[4.0,0.0,-3.0],radius_m=0.5,keep_out_m=1.0}]"])
    path = tmp_path / "goals.toml"
    for north_m, obstacles, is_refused in ((4.0, {}, False), (8.0, None, False), (8.0, {3: (8.5, 0.0, -3.0)}, True)):
        path.write_text(
            "[mission]\nkind = 'goto'\nduration_s = 60\n"
            f"[mission.goto]\ngoals_ned_m = [[{north_m}, 0.0, -3.0]]\ngoal_assignment = false\n"
        )
        there = {n: Obstacle(center_ned_m=centre) for n, centre in (obstacles or {}).items()}
        if not is_refused:
            load_mission(began_with, path, None if obstacles is None else there)
            continue
        with pytest.raises(ConfigError, match=r"obstacles\.3: the goal of agent 0 is 0\.50 m from its centre"):
            load_mission(began_with, path, there)
        load_mission(began_with, path, {3: there[3].model_copy(update={"vel_ned_m_s": (0.0, 1.0, 0.0)})})


@pytest.mark.parametrize("kind", ["pid", "mpc"])
def test_references_that_meet_are_named_where_the_controller_keeps_clear_of_nothing(kind: str) -> None:
    """Three on the default circle came to 0.53 m, as near as the safety filter lets them, without a word before."""
    chosen = (f"controller.kind={kind}", "mission.duration_s=10")
    said = lines(*chosen)
    assert len(said) == 3
    assert said[0].startswith(
        f"controller.kind = {kind!r} keeps clear of nothing but a touch: the references of agents"
    )
    assert "come to 0.00 m, and the flight fails below limits.min_separation_m = 0.85" in said[0]
    obstacle = "obstacles=[{center_ned_m=[0,5,-2],column=true}]"
    (said_of_it,) = lines(*chosen, *ALONE, "mission.kind=circle", obstacle, "mission.circle.omega_rad_s=0.2")
    assert "the reference of agent 0 leads into the keep_out_m of obstacles.0" in said_of_it
    assert lines(*chosen, *ALONE, "mission.kind=circle") == lines(*chosen, "mission.kind=hover") == []
    assert lines(*chosen, "separation.mode=guaranteed", "separation.radius_m=0.95") == []
