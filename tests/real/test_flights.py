"""Whole missions on real autopilots, launched as a user launches them, judged on true states."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from swarmctl.core.types import Phase
from tests.benches.launches import Launched
from tests.benches.standstill import STILL_S, stood_still_s
from tests.real.autopilots import ARDUCOPTER, PX4, Kind
from tests.real.conftest import Field, Fielder
from tests.real.witness import Seen

pytestmark = [pytest.mark.process, pytest.mark.timeout(900)]

PX4_CONFIG, ARDUPILOT_CONFIG = "configs/px4_udp.toml", "configs/ardupilot_udp.toml"
LONE_PX4 = ("--set", "swarm.agents=1", "--set", 'vehicles=[{sysid=1, url="udpin://127.0.0.1:14540"}]')
TAKEOFF_HEIGHT = "MIS_TAKEOFF_ALT"  # of a PX4
END_S = 240.0
FAR_M = 30.0
MOST_REPEATED = 2  # flights that do not count
PLACED_S = 120.0
BODIES_M = 0.65  # tip to tip
GROUND_S = 40.0  # from the end of a launch until the last vehicle has disarmed itself
THREE_ARDUCOPTERS = str(Path(__file__).with_name("three_arducopters.toml"))


def flown(field: Field, *arguments: str) -> Launched:
    """Return a launch that completes, and whose vehicles are on the ground and disarmed after it."""
    return completed(field, ended(field, *arguments))


def flown_in_time(field: Field, *arguments: str) -> Launched:
    """Return a launch as `flown` does; one in which the machine stood still has measured the machine, and is repeated.

    Whether it counts is decided before anything else of it is looked at.
    """
    launched = ended(field, *arguments)
    for _ in range(MOST_REPEATED):
        still_s = stood_still_s(launched.run_dir, field.fleet.count)
        if still_s < STILL_S:
            break
        warnings.warn(f"the machine stood still for {still_s:.3f} s; flown again", stacklevel=2)
        field.witness.wait(field.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
        field.witness.judge_from_now()
        launched = ended(field, *arguments)
    return completed(field, launched)


def ended(field: Field, *arguments: str) -> Launched:
    """Return a launch that has ended, well or not."""
    launched = field.launch(*arguments)
    launched.end(END_S)
    return launched


def completed(field: Field, launched: Launched) -> Launched:
    """Check that a launch has completed, and that its vehicles have flown and are on the ground and disarmed."""
    assert launched.process.returncode == 0, launched.text()
    field.witness.wait(field.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    assert all(field.witness.highest_m(i) > 1.0 for i in range(field.fleet.count)), "they flew"
    return launched


def true_rmse_m(launched: Launched, seen: Seen, agent: int = 0) -> float:
    """Return the RMSE of the true position against the reference, from 10 s of the mission on."""
    table = pq.read_table(Path(launched.run_dir) / f"agent-{agent}.parquet")
    rows = {name: table.column(name).to_numpy() for name in ("t_us", "phase", "mission_t_s")}
    wanted = np.stack([table.column(f"ref_pos_ned_m_{axis}").to_numpy() for axis in "xyz"], axis=1)
    late = (rows["phase"] == Phase.TRACK) & (rows["mission_t_s"] >= 10.0)
    assert late.sum() > 450
    error = seen.at(rows["t_us"][late] * 1e-6) - wanted[late]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def test_a_lone_px4_tracks_its_circle(field: Fielder) -> None:
    here = field(PX4, 1, is_alone=True)
    takeoff_m = here.witness.read_parameter(0, TAKEOFF_HEIGHT)
    launched = flown(here, PX4_CONFIG, *LONE_PX4)
    assert here.witness.read_parameter(0, TAKEOFF_HEIGHT) == takeoff_m, "its climb had another height"
    assert launched.summary()["tracking"]["agents"][0]["steady_rmse_m"] < 0.08
    assert true_rmse_m(launched, here.witness.vehicles[0]) < 0.8  # its estimate is 0.3 to 0.6 m off


def beyond_m(launched: Launched, seen: Seen) -> float:
    """Return how far a vehicle was flown past a reference that stands `FAR_M` north of the origin."""
    table = pq.read_table(Path(launched.run_dir) / "agent-0.parquet")
    tracked_s = table.column("t_us").to_numpy()[table.column("phase").to_numpy() == Phase.TRACK] * 1e-6
    north_m = seen.at(tracked_s)[:, 0]
    assert north_m[-1] == pytest.approx(FAR_M, abs=1.0), "it got there"
    assert np.polyfit(tracked_s[:100] - tracked_s[0], north_m[:100], 1)[0] > 1.0, "at once"
    return float(north_m.max() - north_m[-1])


@pytest.mark.parametrize(("kind", "config"), [(PX4, (PX4_CONFIG, *LONE_PX4)), (ARDUCOPTER, (ARDUPILOT_CONFIG,))])
def test_a_reference_far_away_is_not_flown_past(field: Fielder, kind: Kind, config: tuple[str, ...]) -> None:
    """Plans alone brake 3.4 m too late."""
    here = booted(field, 1) if kind is ARDUCOPTER else field(kind, 1, is_alone=True)
    points = f"mission.waypoints.lists=[{{points_ned_m=[[{FAR_M},0,-4],[{FAR_M},0.5,-4]]}}]"
    there = ("--set", "start.positions_ned_m=[[0,0,-4]]", "--set", "mission.kind=waypoints", "--set", points)
    assert beyond_m(flown_in_time(here, *config, *there, "--duration", "20"), here.witness.vehicles[0]) < 0.5


@pytest.mark.parametrize("after_boot_s", [0, 2, 5, 20])
def test_three_px4_fly_twice_as_they_are_however_early_they_are_launched(field: Fielder, after_boot_s: float) -> None:
    here = field(PX4, 3, is_alone=True)
    time.sleep(after_boot_s)
    for _ in range(2):
        launched = flown(here, PX4_CONFIG, "--duration", "12")
        assert launched.summary()["violations"] == []
    assert here.witness.min_separation_m() > BODIES_M


def test_three_px4_fly_the_built_in_mission(field: Fielder) -> None:
    here = field(PX4, 3, is_alone=True)
    launched = flown(here, PX4_CONFIG)
    assert launched.summary()["violations"] == []
    assert here.witness.min_separation_m() > BODIES_M


def booted(field: Fielder, count: int) -> Field:
    """ArduCopters with a position, in real time."""
    here = field(ARDUCOPTER, count, is_alone=True)
    here.witness.wait(here.witness.all_placed, PLACED_S, "a position")
    for index in range(count):
        here.witness.set_parameter(index, "SIM_SPEEDUP", 1.0)
    return here


def test_a_lone_arducopter_hovers_in_its_built_in_mission(field: Fielder) -> None:
    here = booted(field, 1)
    launched = flown(here, ARDUPILOT_CONFIG)
    assert launched.summary()["tracking"]["agents"][0]["steady_rmse_m"] < 0.1
    assert true_rmse_m(launched, here.witness.vehicles[0]) < 0.3


def test_three_arducopters_fly_a_circle_close_together(field: Fielder) -> None:
    here = booted(field, 3)
    summary = flown_in_time(here, THREE_ARDUCOPTERS).summary()
    assert summary["violations"] == []
    assert summary["tracking"]["index_after_10s_m"] < 1.75
    assert here.witness.min_separation_m() > 0.8


def test_a_second_launch_flies_the_same_arducopters(field: Fielder) -> None:
    here = booted(field, 1)
    for _ in range(2):
        flown(here, ARDUPILOT_CONFIG, "--duration", "8")
