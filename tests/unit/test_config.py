"""Tests of configurations: reasons and messages of refusals, and the round trip of accepted ones."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmctl.bus.messages.json_messages import MAX_OBSTACLES
from swarmctl.config import _RENAMED, Config, dump, load
from swarmctl.configuration.problems import all_keys
from swarmctl.control.reference.kinds.circle import CircleParams
from swarmctl.errors import EXIT_USAGE, ConfigError
from swarmctl.mavlink.signing.key_file import write_new_key

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.toml"))


def refusals(path: Path | None, *overrides: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    assert caught.value.exit_code == EXIT_USAGE
    return caught.value.problems


def file_with(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "swarm.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_are_the_thesis_circle_with_three_agents() -> None:
    config = load(None)
    assert config.swarm.agents == 3
    assert config.mission.kind == "circle"
    assert config.sysids() == (1, 2, 3)
    assert len(config.starts_ned_m()) == 3


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("swarm.agnets=3", ("swarm.agnets = 3", "unknown key", "'agents'")),
        ("swarm.agent=3", ("swarm.agent = 3", "unknown key; did you mean 'agents'?")),
        ("agent.volume.margin_m=1", ("unknown key; did you mean 'volume'?",)),
        ("sitll.enabled=true", ("unknown key", "'sitl'")),
        ("swarm.colour='red'", ("swarm.colour = 'red'", "known here", "agents")),
        ("swarm.agents=0", ("swarm.agents = 0", ">= 1", "<= 100")),
        ("swarm.agents=1000", ("swarm.agents = 1000", ">= 1", "<= 100")),
        ("swarm.agents=-3", ("swarm.agents = -3",)),
        ("swarm.agents=2.5", ("swarm.agents = 2.5", "integer")),
        ("swarm.agents=many", ("swarm.agents = 'many'", "integer")),
        ("swarm.agents=true", ("swarm.agents = True", "integer")),
        ("mission.duration_s=nan", ("mission.duration_s = nan", "finite")),
        ("mission.duration_s=inf", ("mission.duration_s = inf", "finite")),
        ("mission.duration_s=-5", ("mission.duration_s = -5", "> 0")),
        ("mission.duration_s='5'", ("mission.duration_s = '5'", "number")),
        ("start.center_ned_m=[0.0, nan, 0.0]", ("start.center_ned_m.1 = nan", "finite")),
        ("start.center_ned_m=[0.0, 1.0]", ("start.center_ned_m",)),
        ("mission.goto.goals_ned_m=[[5.0, 1.0]]", ("goals_ned_m.0 = [5.0, 1.0]: 2 values; give north, east and down",)),
        ("mission.goto.goals_ned_m=[[5.0]]", ("goals_ned_m.0 = [5.0]: 1 value; give north, east and down",)),
        ("start.center_ned_m=[1.0, 2.0, 3.0, 4.0]", ("4 values; give north, east and down",)),
        ("volume.corners_ne_m=[[1.0]]", ("corners_ne_m.0 = [1.0]: 1 value; give north and east",)),
        ("mission.steps.rows=[[0.0, 1.0]]", ("rows.0 = [0.0, 1.0]: 2 values; more are needed",)),
        ("mission.goto.goals_ned_m=[5.0, 1.0, -2.0]", ("goals_ned_m.0 = 5.0: give a list in brackets",)),
        ("obstacles={center_ned_m=[4.0, 0.0, 0.0]}", ("one of a list; write [[obstacles]]",)),
        ("mission.waypoints.lists={times_s=[]}", ("one of a list; write [[mission.waypoints.lists]]",)),
        ("sitl.preset='mars'", ("sitl.preset = 'mars'", "thesis", "x500")),
        ("telemetry.port=0", ("telemetry.port = 0", ">= 1", "<= 65535")),
        ("name='../../etc'", ("name = '../../etc': allowed are 1 to 40 of the characters A-Z, a-z, 0-9, _ and -",)),
        ("name=", ("name = ''",)),
        ("seed=-1", ("seed = -1", ">= 0")),
        ("seed=1\nname='x'", ("seed", "integer")),
        ("swarm=3", ("swarm = 3: is a section; set a key of it, such as swarm.origin_lat_deg",)),
        ("controller.mpc.z=3", ("is a section; set a key of it, such as controller.mpc.z.q_pos",)),
        ("bus.relay=True", ("bus.relay = 'True': write true or false",)),
        ("bus.relay=7", ("bus.relay = 7: write true or false",)),
        ("mission.goto.speed=2", ("mission.goto.speed = 2: unknown key; did you mean 'speed_m_s'?",)),
        ("swarm.origin=1", ("unknown key; did you mean 'origin_lat_deg' or 'origin_lon_deg' or 'origin_alt_m'?",)),
        (
            "agent.path_sharing={error_m=0.002,heartbeat_s=0.2}",
            ("agent.path_sharing.heartbeat_s = 0.2", "0.125", "separation.lost_after_s", "silent"),
        ),
        ("agent.path_sharing.far_hz=0.2", ("agent.path_sharing.far_hz = 0.2", "0.5 to 25", "silence")),
        ("limits.min_separation_m=2.0", ("limits.min_separation_m = 2.0", "separation.radius_m")),
        ("start.spacing_m=0.5", ("agents 0 and 1", "0.50 m apart", "start.spacing_m")),
        ("geofence.corners_ne_m=[[9.0, 9.0], [9.0, -9.0]]", ("geofence.corners_ne_m", "2 corners", "3 or more")),
        ("volume.floor_z_m=1", ("volume.corners_ne_m: none", "a floor or a ceiling")),
        ("volume.corners_ne_m=[[-9,-9],[9,-9],[9,9],[-9,9]]", ("volume.floor_z_m: missing", "floor and ceiling")),
        (
            "geofence.corners_ne_m=[[0.5, 9.0], [0.5, -9.0], [-9.0, 0.0]]",
            ("geofence.corners_ne_m", "agents [2]", "outside"),
        ),
        ("start.direction_ned=[0.0, 0.0, 0.0]", ("start.direction_ned", "direction")),
        ("start.positions_ned_m=[[0.0, 0.0, -1.0]]", ("start.positions_ned_m", "1 positions", "swarm.agents = 3")),
        ("start.center_ned_m=[0.0, 0.0, 1.9]", ("agent 0", "ground", "sitl.ground_z_m")),
        ("sitl.enabled=false", ("vehicles", "sitl.enabled = false", "[[vehicles]]")),
        ("swarm.agents", ("write it as key.sub=value",)),
        ("swarm..agents=3", ("write it as key.sub=value",)),
        (
            "vehicles.0.url='x'",
            ("'0' is not an index of a list of 0; set the whole list, key=[...], or write it in the file",),
        ),
        ("seed.x=1", ("no such place",)),
        ("agents=5", ("agents = 5", "unknown key", "'swarm.agents'")),
        ("swarm.preset='x500'", ("unknown key", "'sitl.preset'")),
        ("agent.autopilot_params.COM_OBL_RC_ACT=4294967296", ("COM_OBL_RC_ACT = 4294967296", "2147483647")),
        ("agent.autopilot_params.MPC_THR_HOVER=1e39", ("MPC_THR_HOVER = 1e+39", "3.40282e+38")),
        (f"agent.autopilot_params.{'X' * 17}=1", ("no MAVLink parameter name", "1 to 16 letters")),
        (f"agent.autopilot_params.{'X' * 5000}=1", ("no MAVLink parameter name", "XXX ... XXX")),
        ("agent.autopilot_params.MÄH=1", ("no MAVLink parameter name",)),
        (f"seed=1{'0' * 5000}", ("seed", "too many digits", "64 bits")),
        (f"seed=0x{'f' * 50_000}", ("seed", "200000 bits", "64 bits")),
        (f"start.center_ned_m=[0.0, 0x{'f' * 50_000}, 0.0]", ("start.center_ned_m.1", "64 bits")),
        (f"{'a.' * 5000}a=1", ("5001 sections inside each other", "allowed: 12")),
        (f"seed={'[' * 100_000}", ("seed", "nested too deeply")),
        (f"swarm={'[' * 100}{']' * 100}", ("swarm.0", "nested too deeply")),
        (f"vehicles.1{'0' * 5000}.url='x'", ("is not an index of a list of 0",)),
        ("vehicles.²=1", ("vehicles",)),
        ("\x1b[2J=1", (r"\x1b[2J = 1", "unknown key")),
        ("seed='\x1b[2J\\u202e'", (r"\x1b",)),
        ("seed.x.y=1", ("inside a value",)),
    ],
)
def test_refused_in_one_line_with_key_value_and_what_is_allowed(
    tmp_path: Path, override: str, words: tuple[str, ...]
) -> None:
    path = file_with(tmp_path, "seed = 1\n" if override.startswith("seed.") else "")
    problems = refusals(path, override)
    text = problems[0]
    for word in words:
        assert word in text, problems
    assert "\n" not in text


def test_weights_that_are_left_out_are_those_of_their_axis(tmp_path: Path) -> None:
    path = file_with(tmp_path, "[controller.mpc.z]\nq_pos = 3.0\n")
    config = load(path, ["controller.mpc.x.r=0.02", "agent.commit.follow_z.q_vel=0.6"])
    mpc, follow_z = config.controller.mpc, config.agent.commit.follow_z
    assert (mpc.z.q_pos, mpc.z.q_vel, mpc.z.r) == (3.0, 0.05, 1.0)
    assert (mpc.x.q_pos, mpc.x.q_vel, mpc.x.r) == (1.5, 0.5, 0.02)
    assert (follow_z.q_pos, follow_z.q_vel, follow_z.r) == (20.0, 0.6, 0.05)
    assert "unknown key; known here: q_pos, q_vel, r" in refusals(path, "controller.mpc.z.s=1")[0]


def test_agents_of_real_vehicles_share_no_process(tmp_path: Path) -> None:
    real = (
        "sitl.enabled=false",
        'vehicles=[{sysid=1,url="udpin://0.0.0.0:14540"},{sysid=2,url="udpin://0.0.0.0:14541"}]',
    )
    (problem,) = refusals(file_with(tmp_path, ""), "swarm.agents=2", "swarm.agents_per_process=2", *real)
    assert "swarm.agents_per_process = 2: allowed: 1 without the built-in simulator" in problem


def test_those_that_commit_are_heard_often_enough_to_do_without_acknowledgements(tmp_path: Path) -> None:
    commits, path = "separation.mode=guaranteed", file_with(tmp_path, "")
    (problem,) = refusals(path, commits, "agent.path_sharing.far_hz=1.9")
    assert "2 to 25" in problem and "acknowledge everything" in problem
    assert load(path, (commits, "agent.path_sharing.far_hz=2")).separation.mode == "guaranteed"


def test_a_vector_is_reported_once_and_a_missing_file_as_itself(tmp_path: Path) -> None:
    assert len(refusals(None, "mission.goto.goals_ned_m=[[5.0]]")) == 1
    (missing,) = refusals(tmp_path / "none.toml")
    assert missing.endswith("swarmctl config init NAME writes one to begin with")


def test_obstacles_may_be_in_a_file_beside_the_configuration(tmp_path: Path) -> None:
    path = file_with(tmp_path, 'obstacles = "obs.toml"\n')
    assert "no such file" in refusals(path)[0]
    file = tmp_path / "obs.toml"
    file.write_text("[[obstacles]]\ncenter_ned_m = [9.0, 4.0, 0.0]\nradius_m = 0.5\n", encoding="utf-8")
    config = load(path)
    assert [obstacle.center_ned_m for obstacle in config.obstacles] == [(9.0, 4.0, 0.0)]
    resolved = tmp_path / "run" / "config.toml"
    resolved.parent.mkdir()
    resolved.write_text(dump(config), encoding="utf-8")
    changed = load(path, ["obstacles.0.radius_m=0.7"])
    assert [obstacle.radius_m for obstacle in changed.obstacles] == [0.7]
    (tmp_path / "others.toml").write_text("obstacles = []", encoding="utf-8")
    assert load(path, ["obstacles=others.toml"]).obstacles == ()
    file.unlink()
    assert load(path, ["obstacles=others.toml"]).obstacles == ()
    assert load(resolved) == config, "a run folder needs no other file"
    for text, words in (
        ("[swarm]\nagents = 2\n", "holds swarm; a file of obstacles holds [[obstacles]] alone"),
        ("", "holds none"),
        ("[[obstacles]]\nradius_m = 0.5\n", "obstacles.0.center_ned_m: missing"),
        ("[[obstacles", "not TOML"),
        ("[obstacles]\nradius_m = 0.5\n", "write [[obstacles]]"),
        ('obstacles = "again.toml"\n', "holds none"),
    ):
        file.write_text(text, encoding="utf-8")
        assert words in refusals(path)[0]


TWO_OBSTACLES = (
    "obstacles=[{center_ned_m=[4, 0, 0]}, {center_ned_m=[0, 3, 0], column=true, radius_m=0.3, keep_out_m=1.0}]"
)
GOTO = "mission.kind=goto"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("start.center_ned_m=[3, 0, 0]",), "obstacles.0: agent 2 would wait 0.00 m from its centre; its keep_out_m"),
        (("start.center_ned_m=[0, 2.1, -9]",), "obstacles.1: agent 1 would wait 0.90 m from its axis"),
        (("start.center_ned_m=[2.5, 0, -9]",), "obstacles.0: agent 2 would take off 0.50 m from its centre; its keep"),
        (
            (GOTO, "mission.goto.goals_ned_m=[[-9, 0, 0], [4, 1.5, 0], [9, 0, 0]]"),
            "obstacles.0: the goal of agent 1 is 1.50 m from its centre; its keep_out_m is 1.75. Move one of them",
        ),
        ((GOTO, "mission.goto.goals_ned_m=[[4, 0, 0]]"), "obstacles.0: the goal of agent 2"),  # places round it
        (("start.center_ned_m=[1e200, 0, 0]",), "more than 1e+06 m from the shared origin"),
        ((GOTO, "mission.goto.goals_ned_m=[[1e200, 0, 0]]"), "goals [0] are more than 1e+06 m"),
    ],
)
def test_starts_and_goals_in_obstacles_or_beyond_all_bounds(overrides: tuple[str, ...], words: str) -> None:
    assert any(words in problem for problem in refusals(None, TWO_OBSTACLES, *overrides))


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("start.center_ned_m=[1.2, 0, 0]",),
        ("start.center_ned_m=[2.5, 0, -9]", "sitl.start=air"),
        (GOTO, "mission.goto.goals_ned_m=[[-9, 0, 0], [4, 1.8, 0], [9, 0, 0]]"),
        (GOTO, "mission.goto.goals_ned_m=[[4, 0, -2]]"),  # above it
        (GOTO, "mission.goto.goals_ned_m=[[4, 0, 0]]", "obstacles.0.vel_ned_m_s=[0, 1, 0]"),  # not there for long
    ],
)
def test_negative_control_clear_of_obstacles(overrides: tuple[str, ...]) -> None:
    load(None, (TWO_OBSTACLES, *overrides))


def test_problems_of_starts_goals_and_references_are_named_together() -> None:
    low = "mission.goto.goals_ned_m=[[-9, 0, 3], [4, 0, 0], [9, 0, 0]]"
    problems = refusals(None, TWO_OBSTACLES, GOTO, low, "start.spacing_m=0.3", "mission.duration_s=6")
    for words in ("agents 0 and 1 would wait 0.30 m apart", "the goal of agent 1 is", "duration_s = 6", "the ground"):
        assert any(words in problem for problem in problems), words
    hover = refusals(None, "mission.kind=hover", "start.spacing_m=0.3")
    assert all(problem.startswith("start: ") for problem in hover), "what follows from starts is not said again"


def test_a_refused_number_of_agents_is_reported_once() -> None:
    assert len(refusals(None, "swarm.agents=0")) == 1
    assert len(refusals(None, "swarm.agents=1000")) == 1


def test_all_problems_at_once(tmp_path: Path) -> None:
    path = file_with(
        tmp_path, "name = 'bad name'\n[swarm]\nagents = 0\n[sitl]\npresett = 'x500'\n[bus]\nloss_01 = 1.5\n"
    )
    problems = refusals(path)
    assert len(problems) == 4
    assert all(any(key in p for p in problems) for key in ("name", "swarm.agents", "sitl.presett", "bus.loss_01"))
    with pytest.raises(ConfigError, match=r"swarm\.toml: swarm\.agents"):
        load(path)


def test_addresses_that_are_none_are_said_with_all_other_problems(tmp_path: Path) -> None:
    """They came to light one after the other: of the vehicles only when every key was right by itself."""
    path = vehicles(tmp_path, "udq://127.0.0.1:1", "udpin://127.0.0.1:70000", b=300)
    problems = refusals(path, "separation.radius_m=-1", 'mavlink.forward=["udpin://127.0.0.1:1"]')
    keys = ("vehicles.0.url", "vehicles.1.url", "vehicles.1.sysid", "separation.radius_m", "mavlink.forward.0")
    assert len(problems) == len(keys)
    assert all(any(problem.startswith(f"{key} = ") for problem in problems) for key in keys)
    assert "vehicles.0.url = 'udq://127.0.0.1:1': use udpin://HOST:PORT" in "\n".join(problems)
    assert "vehicles.1.url = 'udpin://127.0.0.1:70000': port 70000 is outside 1..65535" in problems


def test_many_close_starts_are_summarised() -> None:
    problems = refusals(None, "swarm.agents=50", "start.spacing_m=0.01")
    assert len(problems) == 4
    assert "1222 more pairs" in problems[-1]


VEHICLES = """
[swarm]
agents = 2
[sitl]
enabled = false
[[vehicles]]
sysid = {a}
url = "{url_a}"
[[vehicles]]
sysid = {b}
url = "{url_b}"
"""


def vehicles(tmp_path: Path, url_a: str, url_b: str, a: int = 1, b: int = 2) -> Path:
    return file_with(tmp_path, VEHICLES.format(url_a=url_a, url_b=url_b, a=a, b=b))


@pytest.mark.parametrize(
    ("url_a", "url_b"),
    [
        ("udpin://127.0.0.1:14540", "udpin://127.0.0.1:14540"),
        ("udpin://0.0.0.0:14540", "udpin://127.0.0.1:14540"),
        ("udpout://10.0.0.2:14540", "udpout://10.0.0.2:14540"),
        ("serial:///dev/ttyUSB0:57600", "serial:///dev/ttyUSB0:921600"),
    ],
)
def test_two_agents_on_one_port(tmp_path: Path, url_a: str, url_b: str) -> None:
    (problem,) = refusals(vehicles(tmp_path, url_a, url_b))
    assert "vehicles.1.url" in problem
    assert "vehicles.0" in problem


@pytest.mark.parametrize(
    ("url_a", "url_b"),
    [
        ("udpin://127.0.0.1:14540", "udpin://127.0.0.1:14541"),
        ("udpin://127.0.0.1:14540", "udpin://127.0.0.2:14540"),
        ("udpout://10.0.0.2:14540", "udpout://10.0.0.3:14540"),
        ("udpout://10.0.0.2:14540", "udpin://127.0.0.1:14540"),
        ("serial:///dev/ttyUSB0:57600", "serial:///dev/ttyUSB1:57600"),
    ],
)
def test_different_links_are_accepted(tmp_path: Path, url_a: str, url_b: str) -> None:
    assert load(vehicles(tmp_path, url_a, url_b, a=7, b=9)).sysids() == (7, 9)


def test_duplicate_sysid_wrong_url_and_missing_vehicle_are_named(tmp_path: Path) -> None:
    path = vehicles(tmp_path, "udpin://127.0.0.1:14540", "udp://:14541", a=3, b=3)
    problems = refusals(path, "swarm.agents=3")
    assert any("vehicles.1.sysid = 3" in p and "MAV_SYS_ID" in p for p in problems)
    assert any("vehicles.1.url" in p and "udpin://HOST:PORT" in p for p in problems)
    assert any("2 listed for swarm.agents = 3" in p for p in problems)
    assert any("70000" in p for p in refusals(vehicles(tmp_path, "udpin://127.0.0.1:70000", "udpin://127.0.0.1:1")))


SLACK = ("mission.kind=hover", "limits.min_separation_m=0.5")


@pytest.mark.parametrize(
    "given",
    [
        ("separation.certify_slack_m=5",),
        ("separation.certify_slack_m=0.5",),
        ("separation.radius_m=0.5",),
        ("separation.body_m=0.85",),
    ],
)
def test_certificates_that_let_bodies_touch_are_refused(given: tuple[str, ...]) -> None:
    said = r"separation.certify_slack_m = .*: plans down to -?[0-9.]* m are flown .* Lower it"
    with pytest.raises(ConfigError, match=said):
        load(None, [*SLACK, *given])
    for knowingly in ("separation.allow_small_radius=true", "swarm.agents=1"):
        load(None, [*SLACK, *given, knowingly])
    load(None, [*SLACK, "separation.certify_slack_m=0.42"])


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (("separation.gust_m_s=4",), "set vehicle_model.drag_1_s"),
        (("separation.gust_m_s=8", "vehicle_model.drag_1_s=1.0"), "gust_m_s = 8: no radius suffices"),
        (("separation.gust_m_s=1", "vehicle_model.drag_1_s=1.0", "separation.radius_m=0.56"), "gusts of 1 m/s"),
    ],
)
def test_gusts_need_a_drag_and_room(overrides: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load(None, [*overrides])


@pytest.mark.parametrize("key", ["agent.state_machine.speed_m_s", "agent.deadlock.speed_m_s"])
def test_ways_faster_than_a_vehicle_may_fly_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key} = 3: more than vehicle_model.speed_max_m_s = 2.5"):
        load(None, ["vehicle_model.speed_max_m_s=2.5", f"{key}=3"])
    load(None, ["vehicle_model.speed_max_m_s=3", f"{key}=3"])


COMMITS = "separation.mode=guaranteed"


@pytest.mark.parametrize(
    ("given", "key", "steps"),
    [
        (("controller.mpc.horizon_z=20",), "controller.mpc.control_z", 20),
        (("controller.mpc.horizon_xy=20",), "controller.mpc.control_xy", 20),
        (("controller.mpc.horizon_xy=20", "controller.kind=dmpc3"), "controller.mpc.control_xy", 20),
        ((COMMITS, "agent.commit.horizon=10"), "agent.commit.moves", 10),
    ],
)
def test_inputs_beyond_the_end_of_a_plan_are_refused(given: tuple[str, ...], key: str, steps: int) -> None:
    """Plans were those with as many as there are steps, at the cost of more, and no more came of a higher number."""
    (problem,) = refusals(None, *given, f"{key}={steps + 1}")
    horizon_key = given[0].partition("=")[0] if given[0] != COMMITS else "agent.commit.horizon"
    assert problem.startswith(f"{key} = {steps + 1}: more than the {steps} steps of a plan, {horizon_key}, ")
    assert problem.endswith("lower it to that, or raise the horizon")
    load(None, [*given, f"{key}={steps}"])


@pytest.mark.parametrize("given", [("controller.kind=pid", "controller.mpc.horizon_xy=2"), ("agent.commit.moves=40",)])
def test_a_horizon_that_no_plan_has_is_accepted(given: tuple[str, ...]) -> None:
    load(None, given)


BRAKES = (
    "agent.barrier.brake_m_s2",
    "agent.commit.brake_m_s2",
    "agent.state_machine.accel_m_s2",
    "separation.brake_m_s2",
)


@pytest.mark.parametrize("key", BRAKES)
def test_braking_that_tilt_does_not_give_is_refused(key: str) -> None:
    hovering = ["mission.kind=hover", "vehicle_model.tilt_max_rad=0.1", "separation.stop_m_s2=0.9"]
    hovering += [f"{other}=0.9" for other in BRAKES if other != key]
    with pytest.raises(ConfigError, match=re.escape(f"{key} = 1.1: more than the 0.98 m/s2")):
        load(None, [*hovering, f"{key}=1.1"])
    load(None, [*hovering, f"{key}=0.9"])


VOLUME = (
    "volume.corners_ne_m=[[-20,-20],[20,-20],[20,20],[-20,20]]",
    "volume.floor_z_m=1",
    "volume.ceiling_z_m=-30",
)
GUARANTEED = ("separation.mode=guaranteed", "controller.kind=pid")
HEAVY = (*VOLUME, "vehicle_model.hover_thrust_01=0.8")


@pytest.mark.parametrize(
    ("given", "key", "has", "too_much"),
    [
        ((), "agent.state_machine.accel_m_s2", "2.00", "2.1"),
        (("controller.kind=open_loop",), "agent.state_machine.accel_m_s2", "2.00", "2.1"),
        ((), "separation.stop_m_s2", "2.00", "2.1"),
        (("vehicle_model.hover_thrust_01=0.9",), "agent.state_machine.accel_m_s2", "1.09", "1.2"),
        (VOLUME, "volume.brake_m_s2", "2.00", "6"),
        ((*VOLUME, "controller.kind=dmpc3"), "volume.brake_m_s2", "2.00", "6"),
        (HEAVY, "volume.brake_z_m_s2", "2.45", "3"),
        (VOLUME, "volume.brake_z_m_s2", "8.83", "9"),
        (GUARANTEED, "agent.commit.brake_m_s2", "1.59", "1.6"),
        ((*GUARANTEED, "controller.mpc.u_max=0.9"), "agent.commit.brake_m_s2", "4.97", "5"),
    ],
)
def test_braking_that_plans_do_not_have_is_refused(given: tuple[str, ...], key: str, has: str, too_much: str) -> None:
    hovering = ["mission.kind=hover", "start.center_ned_m=[0,0,-3]", *given]
    with pytest.raises(ConfigError, match=re.escape(f"{key} = {too_much}: more than the {has} m/s2 that ")):
        load(None, [*hovering, f"{key}={too_much}"])
    load(None, [*hovering, f"{key}={float(has) - 0.01}"])


@pytest.mark.parametrize(
    "given",
    [
        ("agent.commit.brake_m_s2=6",),  # nothing is committed to
        ("volume.brake_m_s2=20", "volume.brake_z_m_s2=20"),  # there is no volume
        ("controller.kind=pid", "agent.state_machine.accel_m_s2=5"),  # it tilts as far as the vehicle may
        ("controller.kind=pid", "separation.stop_m_s2=5"),  # it does not plan
    ],
)
def test_braking_that_no_plan_relies_on_is_accepted(given: tuple[str, ...]) -> None:
    load(None, ["mission.kind=hover", "vehicle_model.tilt_max_rad=0.6", *given])


def test_vehicles_beside_the_simulator_are_refused(tmp_path: Path) -> None:
    path = vehicles(tmp_path, "udpin://127.0.0.1:14540", "udpin://127.0.0.1:14541")
    (problem,) = refusals(path, "sitl.enabled=true")
    assert "set sitl.enabled = false" in problem


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"[swarm\nagents = 3", "not TOML"),
        (b"\xff\xfe\x00", "can't be read: no UTF-8 text, see byte 0. Give the path of a TOML file"),
        (b"x = " + b"[" * 9000, "nested too deeply"),
    ],
)
def test_unreadable_content(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    (problem,) = refusals(path)
    assert word in problem


def test_missing_file_and_folder(tmp_path: Path) -> None:
    assert "no such file" in refusals(tmp_path / "absent.toml")[0]
    assert "can't be read" in refusals(tmp_path)[0]


def test_overrides_reach_sections_lists_and_new_sections(tmp_path: Path) -> None:
    path = vehicles(tmp_path, "udpin://127.0.0.1:14540", "udpin://127.0.0.1:14541")
    config = load(path, ["vehicles.1.sysid=42", "mission.circle.radius_m=2.5", "name=mine", "seed=7", "seed=8"])
    assert config.sysids() == (1, 42)
    assert config.mission.section(CircleParams).radius_m == 2.5
    assert (config.name, config.seed) == ("mine", 8)


@pytest.mark.parametrize("path", [None, *CONFIGS], ids=lambda path: path.name if path else "defaults")
def test_dump_reads_back_to_the_same_tree(tmp_path: Path, path: Path | None) -> None:
    config = load(path)
    assert load(file_with(tmp_path, dump(config))) == config


def test_dump_keeps_lists_of_tables_and_parameters(tmp_path: Path) -> None:
    text = (
        "[agent.autopilot_params]\nCOM_OBL_RC_ACT = 4\nCOM_OF_LOSS_T = 1.5\n"
        "[[obstacles]]\ncenter_ned_m = [1, 2, -3]\n[[obstacles]]\ncenter_ned_m = [1e-7, 2.5, -3]\nradius_m = 2\n"
        "keep_out_m = 2.75\nvisibility_m = 5\n"
    )
    config = load(file_with(tmp_path, text))
    assert load(file_with(tmp_path, dump(config))) == config
    assert [o.radius_m for o in config.obstacles] == [1.0, 2.0]


@pytest.mark.parametrize(
    "text",
    [
        f"seed = 1{'0' * 5000}",
        f"seed = 0x{'f' * 50_000}",
        f"[{'a.' * 5000}a]",
        f"{'a.' * 5000}a = 1",
        f"seed = {'[' * 100}{']' * 100}",
        '"\\u001b[2J" = 1',
        f"name = '{'x' * 100_000}'",
    ],
    ids=["digits", "hexadecimal", "deep table", "deep key", "deep list", "escape", "long"],
)
def test_a_hostile_file_is_refused_in_one_short_printable_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(file_with(tmp_path, text))
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()


ESCAPES = "\x1b[2J\x9b\u202e" + "x" * 200


@pytest.mark.parametrize(
    "override",
    [
        f"{ESCAPES}.{'a.' * 50}a=1",
        f"{ESCAPES}=1{'0' * 5000}",
        f"{ESCAPES}=0x{'f' * 100}",
        f"{ESCAPES}={'[' * 100}{']' * 100}",
        f"seed.{ESCAPES}.x=1",
        f"seed.{ESCAPES}=1",
        f"{ESCAPES}=1",
        f"swarm.{ESCAPES}=1",
        ESCAPES,
    ],
    ids=["deep", "digits", "hexadecimal", "deep list", "inside a value", "no place", "section", "key", "no value"],
)
def test_a_hostile_key_is_shown_short_and_printable(tmp_path: Path, override: str) -> None:
    (problem,) = refusals(file_with(tmp_path, "seed = 1\n"), override)
    assert problem.isprintable()
    assert len(problem.partition("known here:")[0]) < 300


def test_the_name_of_a_file_controls_no_terminal(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load(tmp_path / "\x1b[2J\x9b\u202e.toml")
    assert str(caught.value).isprintable()
    assert r"\x1b[2J\x9b\u202e.toml" in str(caught.value)


def test_the_number_of_reported_problems_is_bounded(tmp_path: Path) -> None:
    problems = refusals(file_with(tmp_path, "".join(f"key{i} = 1\n" for i in range(10_000))))
    assert len(problems) == 31
    assert problems[-1] == "and 9970 more problems"


@pytest.mark.timeout(20)
def test_pipes_and_devices_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(2**40)
    words = {"pipe": "not a regular file", "link": "not a regular file", "huge": "larger than"}
    for name, word in words.items():
        (problem,) = refusals(tmp_path / name)
        assert word in problem
    good = file_with(tmp_path, "seed = 3")
    (tmp_path / "mine").symlink_to(good)
    assert load(tmp_path / "mine").seed == 3


@settings(max_examples=25)  # the reference of hours takes 0.1 s to check
@given(st.floats(min_value=1e-3, max_value=36000), st.integers(0, 2**31 - 1))
def test_numbers_survive_exactly(duration_s: float, seed: int) -> None:
    config = load(None, [f"mission.duration_s={duration_s}", f"seed={seed}"])
    assert config.mission.duration_s == duration_s
    assert f"seed = {seed}\n" in dump(config)


def test_key_files_are_checked_with_all_other_keys_and_only_their_names_are_kept(tmp_path: Path) -> None:
    keys = [write_new_key(tmp_path / f"{i}.key") for i in range(3)]
    path = tmp_path / "swarm.toml"
    path.write_text('[mavlink]\nsigning_keys = ["0.key", "1.key", "2.key"]\n')
    config = load(path)
    assert config.mavlink.signing_keys == tuple(str(tmp_path / f"{i}.key") for i in range(3))
    assert config.simulator().signing_keys == config.mavlink.signing_keys
    assert not any(key.secret.hex() in dump(config) for key in keys)
    elsewhere = tmp_path / "run" / "config.toml"
    elsewhere.parent.mkdir()
    elsewhere.write_text(dump(config))
    assert load(elsewhere) == config
    (tmp_path / "0.key").chmod(0o640)
    (tmp_path / "1.key").unlink()
    with pytest.raises(ConfigError) as refused:
        load(path, ["limits.min_separation_m=5"])
    said = "\n".join(refused.value.problems)
    assert len(refused.value.problems) == 3
    for word in ("mavlink.signing_keys.0", "has mode 0640", "mavlink.signing_keys.1", "No such file", "limits.min"):
        assert word in said
    assert load(path, only_agents=(2,)) == config, "the companion of one vehicle has its key alone"
    assert load(None, ["mavlink.signing_keys=[]"]).simulator().signing_keys == ()


def test_start_line_is_centred_and_spaced() -> None:
    config: Config = load(None, ["swarm.agents=4", "start.spacing_m=2.0", "start.direction_ned=[0.0, 3.0, 0.0]"])
    assert [s[1] for s in config.starts_ned_m()] == [-3.0, -1.0, 1.0, 3.0]


def test_obstacles_that_agents_would_refuse_are_refused(tmp_path: Path) -> None:
    ball = "[[obstacles]]\ncenter_ned_m = [1, 2, -3]\n"
    path = tmp_path / "run.toml"
    path.write_text(ball * MAX_OBSTACLES)
    assert len(load(path).obstacles) == MAX_OBSTACLES
    for text, problem in (
        (ball * (MAX_OBSTACLES + 1), f"obstacles: 65 are listed, agents keep {MAX_OBSTACLES} at most"),
        (ball * 20_000, f"obstacles: 20000 are listed, agents keep {MAX_OBSTACLES} at most"),
        (ball.replace("-3", "-30000.0"), r"obstacles.0.center_ned_m.2 = -30000.0: .* greater than or equal to -10000"),
        (
            ball + "vel_ned_m_s = [0.0, 1e5, 0.0]\n",
            r"obstacles.0.vel_ned_m_s.1 = 100000.0: .* or equal to 10000",
        ),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=problem):
            load(path)


@pytest.mark.parametrize(
    ("sizes", "problems"),
    [
        (
            "radius_m=3",
            (
                "obstacles.0.keep_out_m = 1.75: less than radius_m = 3, so that agents would fly into it; "
                "allowed: >= 3; raise it, or lower radius_m",
                "obstacles.0.visibility_m = 3.0: .* only when they are in its radius_m = 3; allowed: > 3",
            ),
        ),
        ("radius_m=2,visibility_m=9", ("obstacles.0.keep_out_m = 1.75: less than radius_m = 2",)),
        ("radius_m=0.5,keep_out_m=0.4", ("obstacles.0.keep_out_m = 0.4: less than radius_m = 0.5",)),
        (
            "keep_out_m=3",
            ("obstacles.0.visibility_m = 3.0: agents would see it only when they are in its keep_out_m = 3",),
        ),
        (
            "visibility_m=1.5",
            ("obstacles.0.visibility_m = 1.5: .* keep_out_m = 1.75; allowed: > 1.75; raise it, or lower",),
        ),
    ],
)
def test_an_obstacle_is_kept_out_of_and_seen_before_that(sizes: str, problems: tuple[str, ...]) -> None:
    found = refusals(None, f"obstacles=[{{center_ned_m=[40,0,0],{sizes}}}]")
    assert len(found) == len(problems)
    for problem, line in zip(problems, found, strict=True):
        assert re.match(problem, line), line


def test_negative_control_a_keep_out_may_be_as_large_as_the_body() -> None:
    load(None, ["obstacles=[{center_ned_m=[40,0,0],radius_m=2,keep_out_m=2,visibility_m=2.01}]"])


@pytest.mark.parametrize(("old", "new"), sorted(_RENAMED.items()))
def test_a_key_that_was_renamed_is_refused_with_its_new_name(old: str, new: str) -> None:
    section = {"agent.detour", "agent.sequence"} & {old}
    with pytest.raises(ConfigError) as error:
        load(None, [f"{old}.enabled=1" if section else f"{old}=1"])
    assert f"did you mean {new!r}?" in str(error.value)
    assert new in set(all_keys(Config, ""))


BOX = ("volume.corners_ne_m=[[-6, -6], [6, -6], [6, 6], [-6, 6]]", "volume.floor_z_m=1", "volume.ceiling_z_m=-5")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("start.center_ned_m=[5, 0, -1]",), ("start: agent 2", "0.30 m outside", "volume.margin_m = 0.3")),
        (("start.center_ned_m=[0, 0, 0.8]",), ("start: agent 0", "floor")),
        (("controller.kind=pid",), ("controller.kind = 'pid'", "use dmpc")),
        (("separation.tracking_m=0.4", "separation.radius_m=1.2"), ("volume.margin_m = 0.3", "need 0.40 m")),
        (
            (
                *("separation.gust_m_s=8", "vehicle_model.drag_1_s=1", "separation.radius_m=3"),
                *("controller.mpc.u_max=0.8", "vehicle_model.tilt_max_rad=1.2"),
            ),
            ("volume.margin_m = 0.3", "gusts", "need 0."),
        ),
        (("geofence.corners_ne_m=[[-9, -9], [5, -9], [5, 9], [-9, 9]]",), ("volume.corners_ne_m: [[6.0, -6.0]",)),
    ],
)
def test_what_does_not_go_with_a_volume_is_refused(overrides: tuple[str, ...], words: tuple[str, ...]) -> None:
    mission = ("mission.kind=hover", "swarm.agents=3", *BOX)
    with pytest.raises(ConfigError) as refused:
        load(None, [*mission, *overrides])
    assert [word for word in words if word not in "; ".join(refused.value.problems)] == []
    load(None, mission)  # negative control: the volume itself is none


FENCE = "geofence.corners_ne_m=[[-3, -3], [3, -3], [3, 3], [-3, 3]]"
GOAL = ("mission.kind=goto", "swarm.agents=1", "mission.duration_s=60")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("mission.kind=circle", "mission.circle.radius_m=4.0"), ("m outside of", "north -3 to 3 m, east -3 to 3 m")),
        ((*GOAL, "mission.goto.goals_ned_m=[[0.0, 5.0, -2.0]]"), ("mission: agent 0: at ", "move the mission or the")),
        (("start.center_ned_m=[5.0, 0.0, 0.0]", "mission.kind=hover"), ("starts of agents", "lie outside")),
    ],
    ids=["way", "goal", "start"],
)
def test_what_leaves_the_geofence_is_refused(overrides: tuple[str, ...], words: tuple[str, ...]) -> None:
    load(None, overrides)  # negative control: without a fence it can be flown
    text = "; ".join(refusals(None, *overrides, FENCE))
    assert "geofence.corners_ne_m" in text
    assert [word for word in words if word not in text] == []


@pytest.mark.parametrize(
    "overrides", [("mission.kind=circle",), (*GOAL, "mission.goto.goals_ned_m=[[0.0, 3.0, -2.0]]")]
)
def test_what_stays_within_the_geofence_is_flown_also_on_its_border(overrides: tuple[str, ...]) -> None:
    load(None, (*overrides, FENCE if overrides[0].endswith("goto") else FENCE.replace("3", "6")))


def test_commitments_keep_a_volume_whatever_tracks_them() -> None:
    load(None, ["mission.kind=hover", *BOX, "controller.kind=pid", "separation.mode=guaranteed"])


def test_a_run_is_said_to_be_flown_with_the_solver_that_flies_it() -> None:
    named = load(None, ["controller.mpc.qp.solver='osqp'"]).rules().solver_name
    assert (load(None).rules().solver_name, named) == ("daqp", "osqp")
