"""Tests that missions which can't be flown are refused with the first second that is wrong, and others are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swarmctl.config import load
from swarmctl.errors import EXIT_USAGE, ConfigError

LINE = "mission.kind=line"


def refusals(*overrides: str) -> list[str]:
    try:
        load(None, overrides)
    except ConfigError as error:
        assert error.exit_code == EXIT_USAGE
        return list(error.problems)
    return []


def two(*lists: str) -> tuple[str, ...]:
    return ("swarm.agents=2", "mission.kind=waypoints", f"mission.waypoints.lists=[{', '.join(lists)}]")


BOX = (
    "volume.corners_ne_m=[[-4, -4], [6, -4], [6, 4], [-4, 4]]",
    "volume.floor_z_m=1",
    "volume.ceiling_z_m=-4",
)
CROSSING = ("[[-4, 0, -1], [4, 0, -1]]", "[[0, -4, -1], [0, 4, -1]]")
GOTO = ("mission.kind=goto", "mission.goto.goals_ned_m=[[49, 0, 0], [50, 0, 0], [51, 0, 0]]")
TIMES = "times_s=[0.0, 8.0]"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((LINE, "mission.line.velocity_ned_m_s=[25.0, 0, 0]"), ("agent 0", "at 0.00 s", "25.00 m/s", "speed_max")),
        ((LINE, "mission.line.velocity_ned_m_s=[0, 0, 0.5]"), ("at 7.40 s", "z = 1.70", "above the ground")),
        (("mission.circle.omega_rad_s=1.3",), ("accelerates by 8.45", "tilt_max_rad = 0.6")),
        (
            ("mission.kind=helix", "mission.helix.height_m=6", "mission.helix.rise_s=2", "mission.helix.radius_m=0"),
            ("thrust over mass of", "thrust_max_01"),
        ),
        (  # from 2 m in the north on at 1 m/s; plans keep 0.3 m inside
            (*BOX, LINE, "mission.line.velocity_ned_m_s=[1.0, 0, 0]"),
            ("agent 0", "at 3.72 s", "0.02 m outside of the flight volume", "volume.margin_m = 0.3"),
        ),
        (
            (*BOX, "mission.kind=steps", "mission.steps.rows=[[0.0, 0, 0, -1], [3.0, 5.8, 0, -1]]"),
            ("agent 0", "at 3.00 s", "0.10 m outside of the flight volume"),
        ),
        (two(*(f"{{points_ned_m={p}, {TIMES}}}" for p in CROSSING)), ("agents 0 and 1", "m apart", "radius_m = 0.9")),
        (  # 50 m on at up to 2 m/s take 1.875 * 25 s
            (*GOTO, "mission.duration_s=4"),
            ("mission.duration_s = 4", "up to 49.7 m short of goals", "take 46.9 s", "speed_m_s"),
        ),
    ],
)
def test_what_can_not_be_flown_is_refused_with_the_second_and_the_value(
    overrides: tuple[str, ...], words: tuple[str, ...]
) -> None:
    problems = refusals(*overrides)
    assert problems
    assert [word for word in words if word not in problems[0]] == []


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        (LINE, "mission.line.velocity_ned_m_s=[19.0, 0, 0]"),
        (*BOX, LINE, "mission.line.velocity_ned_m_s=[1.0, 0, 0]", "mission.duration_s=3.6"),  # ends inside
        (LINE, "mission.line.velocity_ned_m_s=[0, 0, 0.5]", "mission.duration_s=7"),  # ends before the ground
        ("mission.circle.omega_rad_s=1.1",),
        ("mission.kind=steps",),  # jumps on purpose
        (*GOTO, "mission.duration_s=43"),  # 0.25 m before the goals
        (*GOTO, "mission.duration_s=8.7", "mission.goto.speed_m_s=18", "mission.goto.accel_m_s2=4"),
        ("mission.kind=swap", "mission.duration_s=2"),  # whose time is a key itself
        two(*(f"{{points_ned_m={p}}}" for p in CROSSING)),  # not fixed in time: the controllers resolve it
        two(f"{{points_ned_m={CROSSING[0]}, {TIMES}}}", "{points_ned_m=[[0, -4, -3], [0, 4, -3]], times_s=[0, 8]}"),
    ],
)
def test_negative_control_what_can_be_flown_is_not_refused(overrides: tuple[str, ...]) -> None:
    assert refusals(*overrides) == []


def test_agents_meet_at_the_second_that_is_told() -> None:
    """Two straight flights of least snap cross at their middle, at 4 s; 0.9 m apart each is 0.64 m before it."""
    lists = tuple(f"{{points_ned_m={p}, {TIMES}}}" for p in CROSSING)
    (problem,) = refusals(*two(*lists))
    second = float(problem.partition("at ")[2].partition(" s")[0])
    peak_m_s = 2.1875 * 8.0 / 8.0  # of a flight of degree 7 from rest to rest
    assert second == pytest.approx(4.0 - 0.9 / np.sqrt(2.0) / peak_m_s, abs=0.03)


def test_a_file_that_stops_dead_is_refused_unless_the_mission_ends_there(tmp_path: Path) -> None:
    path = tmp_path / "line.csv"
    path.write_text("t,x,y,z\n0,0,0,-1\n1,1,0,-1\n2,2,0,-1\n")
    flown = ("swarm.agents=1", "mission.kind=csv", f"mission.csv.files=['{path}']")
    assert "accelerates by" in refusals(*flown, "mission.duration_s=3")[0]
    assert refusals(*flown, "mission.duration_s=2") == []


def test_only_a_few_are_listed() -> None:
    problems = refusals(LINE, "mission.line.velocity_ned_m_s=[25.0, 0, 0]", "swarm.agents=6")
    assert len(problems) == 4
    assert problems[-1].startswith("mission: 3 more")
