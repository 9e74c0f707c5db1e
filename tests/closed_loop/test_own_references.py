"""Tests that references from files and through points are flown as they are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from swarmctl.core.types import Mode, Phase
from swarmctl.telemetry.evaluation.referee import evaluate
from tests.closed_loop.conftest import FINE, Flight, Fly, fly_now

PERIOD_S, LENGTH_M, WIDTH_M = 12.0, 2.0, 1.0


@pytest.fixture(scope="module")
def figure_8(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a figure-8 of twelve seconds whose heading follows its course, north east down, ten rows a second."""
    t_s = np.arange(0.0, PERIOD_S + 0.05, 0.1)
    w = 2.0 * np.pi / PERIOD_S
    north, east = LENGTH_M * np.sin(w * t_s), WIDTH_M * np.sin(2.0 * w * t_s)
    course = np.arctan2(2.0 * WIDTH_M * np.cos(2.0 * w * t_s), LENGTH_M * np.cos(w * t_s))
    yaw = np.angle(np.exp(1j * course))  # jumps from pi to -pi
    path = tmp_path_factory.mktemp("own") / "figure_8.csv"
    rows = np.stack([t_s, north, east, np.full(len(t_s), -1.5), yaw], axis=1)
    np.savetxt(path, rows, delimiter=",", header="t,x,y,z,yaw", comments="", fmt="%.5f")
    return path


def own(path: Path) -> tuple[str, ...]:
    return (
        FINE,
        "mission.kind=csv",
        f"mission.csv.files=['{path}']",
        f"mission.duration_s={PERIOD_S}",
        "swarm.agents=1",
        "start.center_ned_m=[0, 0, -1.5]",
        "sitl.start=air",
    )


@pytest.fixture(scope="module")
def flown(figure_8: Path) -> Flight:
    return fly_now(*own(figure_8), until=Lockstep.mission_is_over)


def test_a_figure_8_from_a_file_is_flown(flown: Flight) -> None:
    ticks, error = flown.tracked(0)
    late = ticks["mission_t_s"] > 2.0
    rmse_m = float(np.sqrt(np.mean(np.sum(error[late] ** 2, axis=1))))
    assert rmse_m <= 0.03
    assert np.ptp(flown.pos_ned_m[:, 0, 0]) >= 1.9 * LENGTH_M, "both loops"
    assert flown.modes(0, Phase.TRACK) == {Mode.TRACKING}


def test_the_heading_follows_the_file(flown: Flight) -> None:
    truth = flown.lockstep.truth
    w, x, y, z = truth["q_nb"].T
    yaw = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    assert np.abs(yaw - yaw[0]).max() > 2.0, "it turns with the course"


def written_ned_m(figure_8: Path, mission_t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    rows = np.loadtxt(figure_8, delimiter=",", skiprows=1)
    return np.stack([np.interp(mission_t_s, rows[:, 0], rows[:, c + 1]) for c in range(3)], axis=1)


def test_the_reference_is_that_of_the_file(flown: Flight, figure_8: Path) -> None:
    ticks, _ = flown.tracked(0)
    assert np.abs(written_ned_m(figure_8, ticks["mission_t_s"]) - ticks["ref_pos_ned_m"]).max() < 0.01


def test_the_error_counts_from_the_file_while_an_operator_holds_and_on_the_way_back(fly: Fly, figure_8: Path) -> None:
    """An agent that is held follows a stop, then a way to where its mission is by now."""
    orders = {2.0: lambda it: it.command("hold"), 4.5: lambda it: it.command("resume")}
    held = fly(*own(figure_8), at=orders, until=Lockstep.mission_is_over)
    rows = held.ticks(0)
    ticks = rows[(rows["phase"] == Phase.TRACK) & np.isfinite(rows["mission_t_s"])]
    written = written_ned_m(figure_8, ticks["mission_t_s"])
    assert np.abs(written - ticks["ref_pos_ned_m"]).max() < 0.01
    away_m = np.linalg.norm(ticks["pos_ned_m"] - written, axis=1)
    assert away_m.max() > 1.0, "it stood while the reference went on"
    assert away_m[ticks["mission_t_s"] > PERIOD_S - 1.0].max() < 0.1, "and is back"
    summary = evaluate(held.lockstep.recorded(), held.config.rules("lockstep"), "completed", ())
    assert summary["tracking"]["index_m"] == pytest.approx(float(away_m.mean()), abs=0.02)


def test_negative_control_a_controller_without_authority_does_not_fly_it(fly: Fly, figure_8: Path) -> None:
    weakly = ("controller.mpc.u_max=0.02", "agent.state_machine.accel_m_s2=0.19", "separation.stop_m_s2=0.19")
    weak = fly(*own(figure_8), *weakly, "mission.duration_s=5", until=Lockstep.mission_is_over)
    ticks, error = weak.tracked(0)
    assert float(np.sqrt(np.mean(np.sum(error[ticks["mission_t_s"] > 2.0] ** 2, axis=1)))) > 0.2
