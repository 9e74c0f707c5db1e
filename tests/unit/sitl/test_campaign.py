"""The parts of a campaign that fly nothing: judging, intervals, layouts, the folder, and refusals."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.collision_monitor import CollisionMonitor
from sitl.studies.campaign.command import _parser, _trials, main
from sitl.studies.campaign.conditions.disturbances import DISTURBANCES, NONE, disturbed
from sitl.studies.campaign.conditions.events import Appearance
from sitl.studies.campaign.conditions.factors import NOISES, PROTECTIONS
from sitl.studies.campaign.conditions.layouts import least_sum_m
from sitl.studies.campaign.conditions.scenarios import SCENARIOS, layout_of
from sitl.studies.campaign.flight import TrialFlight, config_of, drawn
from sitl.studies.campaign.page import again, write_page
from sitl.studies.campaign.progress import collect
from sitl.studies.campaign.source import code_of
from sitl.studies.campaign.store import Store
from sitl.studies.campaign.summary import CellSummary, Share, summaries
from sitl.studies.campaign.trials import CELL_FIELDS, SCHEMA, Cell, Row, Trial, cells, unflown
from sitl.studies.campaign.worker_pool import on_cluster, on_this_machine
from swarmctl.bus import topics
from swarmctl.bus.bus import DEFAULT_LEASE_MS, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import MAX_OBSTACLES
from swarmctl.config import load
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.obstacle import Obstacle
from swarmctl.errors import EXIT_USAGE, ConfigError, StartError

CELL = Cell(scenario="swap", agents=3, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="default")
SWAP = replace(CELL, agents=6, protections="guaranteed")
REST = np.zeros((2, 3))
LEASE_US = 1000 * DEFAULT_LEASE_MS


def row_of(trial: Trial, code: str = "this") -> Row:
    cell = {name: getattr(trial.cell, name) for name in Cell.__dataclass_fields__}
    return dict.fromkeys(SCHEMA.names) | cell | {"seed": trial.seed, "code": code}


def monitor(goals: np.ndarray | None = None) -> CollisionMonitor:
    return CollisionMonitor(0.5, goals, 0.1, np.array([True, True]))


def test_bodies_that_pass_between_two_samples_have_touched() -> None:
    watcher = monitor()
    watcher.see(0.0, np.array([[-1.0, 0.0, 0.0], [1.0, 0.1, 0.0]]), REST)
    assert not watcher.collided
    watcher.see(0.02, np.array([[1.0, 0.0, 0.0], [-1.0, 0.1, 0.0]]), REST)
    assert watcher.collided
    assert watcher.min_separation_m == pytest.approx(0.1)


@pytest.mark.parametrize(("column", "collided"), [(True, True), (False, False)])
def test_a_column_is_in_the_way_at_every_height(column: bool, collided: bool) -> None:
    watcher = monitor()
    solid = Obstacle(center_ned_m=(0.0, 0.0, 5.0), radius_m=0.3, column=column)
    for x in (-2.0, 2.0):  # 0.5 m beside the axis: the hull's 0.25 m and the column's 0.3 m meet
        watcher.see(x, np.array([[x, 0.5, 0.0], [x, 9.0, 0.0]]), REST, [solid])
    assert watcher.collided is collided
    assert watcher.min_separation_m > 8.0


def test_a_vehicle_that_leaves_again_has_not_arrived() -> None:
    watcher = monitor(np.zeros((2, 3)))
    there = np.zeros((2, 3))
    watcher.see(1.0, there, REST)
    assert watcher.arrived_s == 1.0
    watcher.see(2.0, there + 0.2, REST)
    assert watcher.arrived_s == np.inf
    watcher.see(3.0, there, REST)
    assert watcher.arrived_s == 3.0
    watcher.see(4.0, there, REST + 0.5)
    assert watcher.arrived_s == np.inf, "passing through"


def test_standing_still_is_distinguished_from_creeping() -> None:
    watcher = monitor(np.zeros((2, 3)))
    for tick in range(200):
        watcher.see(0.02 * tick, np.array([[1.0, 0.0, 0.0], [0.05 * 0.02 * tick, 3.0, 0.0]]), REST)
    assert watcher.standing().tolist() == [True, False]


@pytest.mark.parametrize(
    ("goal_m", "speed_m_s", "appears"),
    [(4.0, 0.0, True), (3.0, 0.0, False), (3.0, 0.5, True)],
    ids=["clear", "on it", "passes"],
)
def test_a_static_obstacle_never_appears_at_a_goal(goal_m: float, speed_m_s: float, appears: bool) -> None:
    """2.5 m before a vehicle that flies north; one metre is kept from it."""
    goals = np.array([[goal_m, 0.0, 0.0]])
    appearance = Appearance(
        0, 1.0, 2.5, 2.2, radius_m=0.5, keep_out_m=1.0, speed_m_s=speed_m_s, side=1, goals_ned_m=goals
    )
    lockstep = Lockstep(load(None, ["swarm.agents=1"]))
    for t_s in (0.9, 1.1):
        appearance.step(lockstep, t_s, np.zeros((1, 3)), np.array([[2.0, 0.0, 0.0]]))
        assert bool(appearance.obstacles(t_s)) is (appears and t_s > 1.0)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_is_a_valid_configuration(scenario: str) -> None:
    agents = max(SCENARIOS[scenario].agents)
    for seed, noise, protections in ((1, "exact", "default"), (2, "external", "off")):
        cell = Cell(
            scenario=scenario,
            agents=agents,
            delay_ms=50.0,
            loss=0.1,
            noise=noise,
            wind_m_s=8.0,
            protections=protections,
        )
        layout = layout_of(scenario, seed, agents)
        config = config_of(cell, seed, layout, agents)
        assert config.sitl.start == "air"
        assert config.bus.delay_ms == 50.0
        assert closest_pair_m(np.array([layout.starts_ned_m]))[0] >= config.separation.radius_m
        if scenario == "forest":
            assert all(o.keep_out_m - config.separation.certify_slack_m > o.radius_m + 0.075 for o in config.obstacles)


@pytest.mark.parametrize("protections", PROTECTIONS)
def test_a_seed_draws_the_same_layout_under_all_conditions(protections: str) -> None:
    cell = Cell(
        scenario="random", agents=6, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections=protections
    )
    layouts = [layout_of("random", seed, 6) for seed in (5, 5, 6)]
    assert np.array_equal(layouts[0].starts_ned_m, layouts[1].starts_ned_m)
    assert not np.array_equal(layouts[0].starts_ned_m, layouts[2].starts_ned_m)
    assert config_of(cell, 5, layouts[0], 6).starts_ned_m() == tuple(map(tuple, layouts[0].starts_ned_m.tolist()))


def test_radii_grow_with_the_noise() -> None:
    layout = layout_of("swap", 1, 3)
    radii = [
        config_of(
            Cell(scenario="swap", agents=3, delay_ms=0, loss=0, noise=n, wind_m_s=0, protections="default"),
            1,
            layout,
            3,
        ).separation.radius_m
        for n in NOISES
    ]
    assert radii == pytest.approx([0.9, 0.9, 1.31])


@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_a_disturbance_is_drawn_apart_from_the_layout(disturbance: str) -> None:
    calm = layout_of("swap", 3, 6)
    windy = [disturbed(calm, disturbance, seed) for seed in (3, 3, 4)]
    assert all(np.array_equal(layout.starts_ned_m, calm.starts_ned_m) for layout in windy)
    assert (windy[0].settings, windy[0].clocks, windy[0].lost) == (windy[1].settings, windy[1].clocks, windy[1].lost)
    told = [layout for layout in windy if layout.events or layout.clocks or layout.settings != calm.settings]
    assert bool(told) is (disturbance != NONE)
    cell = replace(SWAP, disturbance=disturbance)
    assert config_of(cell, 3, drawn(cell, 3), 6).swarm.agents == 6


def test_the_strength_of_a_disturbance_is_chosen() -> None:
    clocks = {ms: disturbed(layout_of("swap", 1, 6), f"clocks:{ms}", 1).clocks for ms in (100, 1000)}
    assert all(abs(error.offset_us) <= 100_000 for error in clocks[100].values())
    assert [10 * e.offset_us for e in clocks[100].values()] == pytest.approx(
        [e.offset_us for e in clocks[1000].values()], abs=10
    )


def test_turbulence_of_a_disturbance_is_flown_in_a_wind_too() -> None:
    for disturbance, turbulence_m_s in ((NONE, 2.0), ("turbulence", 8.0), ("turbulence:5", 5.0)):
        cell = replace(CELL, wind_m_s=2.0, disturbance=disturbance)
        wind = config_of(cell, 1, drawn(cell, 1), 3).sitl.wind
        assert (wind.mean_ned_m_s, wind.turbulence_m_s) == ((0.0, 2.0, 0.0), turbulence_m_s)


def test_an_obstacle_that_moves_is_judged_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 30 m above the middle of the circle on which two vehicles stand, at 20 m/s, for a second."""
    sets = "obstacles=[{center_ned_m=[0,0,-30],vel_ned_m_s=[0,0,20],radius_m=0.5}]"
    trial = Trial(replace(CELL, agents=2, sets=sets), 1)
    flight = TrialFlight(trial, drawn(trial.cell, 1))
    clock = flight.lockstep.clock
    monkeypatch.setattr(flight, "_over", lambda: clock.now_us() >= 1_000_000)
    flight.run()
    assert flight.monitor.min_clearance_m == pytest.approx(np.hypot(4.0, 10.0) - 0.5 - 0.24, abs=0.05)


def test_another_airframe_and_its_gusts_take_more_room() -> None:
    sets = {"": 0.9, "separation.gust_m_s=8": 4.01}
    for text, radius_m in sets.items():
        cell = replace(SWAP, airframe="x500", sets=text)
        config = config_of(cell, 1, drawn(cell, 1), 6)
        assert (config.sitl.preset, config.separation.body_m) == ("x500", 0.65)
        assert config.separation.radius_m == pytest.approx(radius_m)


def test_the_least_sum_of_three_and_seven() -> None:
    assert least_sum_m(3, 1.0) == pytest.approx(3.0 / np.sqrt(3.0), abs=1e-3)  # a triangle
    assert least_sum_m(7, 1.0) == pytest.approx(6.0, abs=1e-3)  # one in the middle of a hexagon


def test_finished_runs_are_not_flown_again(tmp_path: Path) -> None:
    trials = [
        Trial(cell, seed)
        for cell in cells(["swap"], [2, 3], [0, 50], [0], noises=["exact"], winds_m_s=[0], protections=["off"])
        for seed in (1, 2)
    ]
    with Store(tmp_path, "this") as store:
        assert store.missing(trials) == trials
        for trial in trials[:5]:
            store.add(row_of(trial))
    assert Store(tmp_path, "this").missing(trials) == trials[5:]
    with pytest.raises(ConfigError, match="flown by other sources"):
        Store(tmp_path, "that")
    assert Store(tmp_path, "that", mix=True).missing(trials) == trials[5:]


def test_two_campaigns_do_not_fly_into_one_folder(tmp_path: Path) -> None:
    with (
        Store(tmp_path, "this") as store,
        pytest.raises(StartError, match="another sweep or campaign flies into it"),
        Store(tmp_path, "this"),
    ):
        pass
    late = Store(tmp_path, "this")
    with store:
        store.add(row_of(Trial(CELL, 1)))
    with late:
        late.add(row_of(Trial(CELL, 2)))
    assert not Store(tmp_path, "this").missing([Trial(CELL, 1), Trial(CELL, 2)])


@pytest.mark.parametrize(
    ("key", "option"),
    [("seed", "--first-seed"), ("swarm.agents", "--agents"), ("bus.delay_ms", "--delay"), ("bus.loss_01", "--loss")],
)
def test_what_rows_tell_of_a_flight_is_not_set_to_something_else(
    key: str, option: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["--trials", "1", "--out", str(tmp_path), "--set", f"{key}=0.5"]) == EXIT_USAGE
    assert capsys.readouterr().err == f"--set: {key} is told by {option}; give it there\n"


def broken(trial: Trial) -> Row:
    if trial.seed == 2:
        raise RuntimeError("no such luck")
    return row_of(trial)


def test_a_trial_that_fails_is_reported_and_the_others_go_on() -> None:
    trials = [Trial(CELL, seed) for seed in (1, 2, 3)]
    results = dict(on_this_machine(trials, 1, broken))
    assert results[trials[1]] == "RuntimeError: no such luck"
    assert [results[trials[i]]["seed"] for i in (0, 2)] == [1, 3]  # type: ignore[index]


def flown(trial: Trial) -> Row:
    nothing = dict.fromkeys(("collided", "deadlocked"), False) | dict.fromkeys(("plans_failed", "cpu_s"), 1)
    return row_of(trial) | nothing | {"arrived": True, "outcome": "arrived", "flight_time_s": 5.0}


def flown_but_for_two(trial: Trial) -> Row:
    if trial.seed == 2:
        raise ConfigError("campaign", ["no room"])
    return flown(trial)


def test_a_trial_that_fails_counts_is_named_and_is_flown_again(tmp_path: Path) -> None:
    trials = [Trial(CELL, seed) for seed in (1, 2, 3)]

    def go_on(fly: Callable[[Trial], Row]) -> tuple[CellSummary, str]:
        with Store(tmp_path, "this") as store:
            missing = store.missing(trials)
            add = partial(unflown, code="this")
            collect(on_this_machine(missing, 1, fly), len(missing), store, noted=("", bool), unflown=add)
        (summary,) = summaries(Store(tmp_path, "this").rows)
        return summary, write_page(tmp_path, Store(tmp_path, "this").rows).read_text(encoding="utf-8")

    summary, page = go_on(flown_but_for_two)
    assert (summary.not_flown, summary.arrived, summary.collided) == (1, Share(2, 3), Share(0, 2))
    assert "not flown: ConfigError: campaign: no room" in page
    assert Store(tmp_path, "this").missing(trials) == trials[1:2]
    summary, page = go_on(flown)
    assert (summary.not_flown, summary.arrived, summary.collided) == (0, Share(3, 3), Share(0, 3))
    assert "not flown" not in page


def test_a_cell_of_which_nothing_was_flown_is_not_a_success(tmp_path: Path) -> None:
    rows = [unflown(Trial(CELL, 1), "no room", "this")]
    (summary,) = summaries(rows)
    assert (summary.arrived, summary.collided) == (Share(0, 1), Share(0, 0))
    assert "class=ok" not in write_page(tmp_path, rows).read_text(encoding="utf-8").replace('"', "")


OWN = """
from swarmctl.control.controllers.own import FeedbackController

class Own(FeedbackController):
    def accel_ned_m_s2(self, pos, vel, wanted_pos, wanted_vel, wanted_accel):
        return {gain} * (wanted_pos - pos)
"""


def test_an_own_controller_that_has_changed_is_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly(trial: Trial, own: str) -> Row:
        return flown(trial) | {"code": code_of(own)}

    monkeypatch.setattr("sitl.studies.campaign.command.fly_trial", fly)
    module = tmp_path / "campaign_own.py"
    sets = [f"--set=own_folder={tmp_path}", "--set=controller.kind=campaign_own:Own"]
    asked = [*sets, "--agents", "2", "--trials", "1", "--jobs", "1", "--out", str(tmp_path / "out")]
    module.write_text(OWN.format(gain=1.0))
    assert main(asked) == main(asked) == 0
    assert "1 runs, 1 of them there already" in capsys.readouterr().out
    module.write_text(OWN.format(gain=12.5))
    assert main(asked) == 2
    assert "flown by other sources" in capsys.readouterr().err


def test_every_maze_has_no_more_columns_than_agents_keep() -> None:
    for seed in (5, 17, 23, 41):  # whose first walls are of 65 posts and more
        cell = replace(CELL, scenario="maze", agents=10)
        assert 55 < len(config_of(cell, seed, drawn(cell, seed), 10).obstacles) <= MAX_OBSTACLES


def test_no_cluster_is_refused_in_words() -> None:
    with pytest.raises(StartError, match=r"--dask"):
        list(on_cluster([Trial(CELL, 1)], "127.0.0.1:1", broken))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--set", "separation.radious_m=1"], "did you mean 'radius_m'"),
        (["--set", "start.center_ned_m=[0, 0, -1]"], "'start.center_ned_m=[0, 0, -1]': write it without spaces"),
        (["--agents", "1"], "needs at least 2"),
        (["--scenario", "maze", "--agents", "60"], "would wait"),
        (["--quick", "--scenario", "maze"], "scenario: leave it out"),
        (["--set", "agent.rate_hz=30"], "a multiple of agent.rate_hz = 30"),
    ],
)
def test_cells_that_cannot_be_flown_are_refused_first(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path / "none")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_value_that_is_given_twice_is_flown_once() -> None:
    asked = _parser().parse_args(["--scenario", "swap,swap", "--agents", "2,2", "--loss", "0,0.0", "--trials", "3"])
    assert [(trial.cell.agents, trial.seed) for trial in _trials(asked)] == [(2, 1), (2, 2), (2, 3)]


def test_what_flies_a_trial_again_is_what_shells_take_and_exact() -> None:
    sets = "obstacles=[{center_ned_m=[0,0,-1]}]"
    cell = replace(CELL, delay_ms=50.0, loss=0.123456789, sets=sets)
    values = {name: getattr(cell, name) for name in CELL_FIELDS}
    arguments = shlex.split(again(values | {"seed": 7}))[2:]
    assert _trials(_parser().parse_args(arguments)) == [Trial(cell, 7)]
    assert "--delay 50 --loss 0.123456789 " in again(values | {"seed": 7})
    assert f" --set {shlex.quote(sets)} " in again(values | {"seed": 7}), "shells expand braces"


def test_a_partitioned_bus_delivers_nothing() -> None:
    now_us = 0
    hub = LocalHub(lambda: now_us)
    one, other = hub.connect(agent_name(0)), hub.connect(agent_name(1))
    hub.fail()
    one.publish(topics.PATH, b"lost")
    one.publish(topics.COMMAND, b"kept")
    now_us = LEASE_US - 1
    assert other.receive(topics.PATH) == other.receive(topics.COMMAND) == []
    assert one.alive() == {"agent-0", "agent-1"}
    now_us = LEASE_US
    assert one.alive() == frozenset()
    hub.recover()
    now_us += 1
    assert one.alive() == {"agent-0", "agent-1"}
    assert other.receive(topics.PATH) == []
    assert other.receive(topics.COMMAND) == [("agent-0", b"kept")]


def test_a_folder_that_can_not_be_made_is_3_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["--scenario", "swap", "--trials", "1", "--out", str(tmp_path / "file" / "out")]) == 3
    said = capsys.readouterr().err
    assert said == f"{tmp_path}/file/out: can't be written: Not a directory. Choose another with --out\n"
