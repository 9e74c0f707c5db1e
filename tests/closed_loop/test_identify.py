"""Tests of the flight of `swarmctl check --identify`: it identifies the vehicle, lands, and improves the circle.

The x500 responds as PX4 does and its estimator has PX4's errors; the agent begins with a model without lag and drag.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.estimation.identification import FlightSegment, Identified, identify, longest_segment
from swarmctl.core.types import Landed, Phase

CONFIG = Path(__file__).parents[2] / "configs" / "x500_circle.toml"
SEEDS = (1, 2, 3, 4)
DRAG_1_S, HOVER_01 = 1.0, 9.81 / 20.0  # of the x500: 1 N/(m/s), 1 kg, 20 N
ALONE = ("swarm.agents=1", "sitl.estimator=gps", "start.center_ned_m=[0, 0, -3]")
AIR = ("sitl.start=air", "agent.state_machine.arrive_m=1")
UNKNOWN = ("vehicle_model.delay_s=0.06", "vehicle_model.attitude_rad_s=0", "vehicle_model.drag_1_s=0")
STEPS = ("mission.kind=identify", "mission.identify.repeats=1", "mission.duration_s=27.5")
CIRCLE = ("start.center_ned_m=[5, 0, -3]", "mission.circle.climb_ned_m_s=0", "mission.duration_s=17")


def fly(*overrides: str, until: Phase = Phase.GOTO_LAND) -> Lockstep:
    flight = Lockstep(load(CONFIG, (*ALONE, *overrides)))
    while flight.clock.now_us() < 90e6 and not (
        len(flight.logs[0].rows) and flight.logs[0].rows[-1]["phase"][0] >= until
    ):
        flight.step()
    return flight


@functools.cache
def found(seed: int) -> Identified:
    flight = longest_segment(fly(*AIR, *UNKNOWN, *STEPS, f"seed={seed}").logs[0].ticks)
    assert isinstance(flight, FlightSegment), flight
    result = identify(flight)
    assert isinstance(result, Identified), result
    return result


@pytest.mark.parametrize("seed", SEEDS)
def test_drag_and_hover_thrust_are_found_whatever_the_estimators_errors(seed: int) -> None:
    assert found(seed).drag_1_s.value == pytest.approx(DRAG_1_S, rel=0.02)
    assert found(seed).hover_thrust_01.value == pytest.approx(HOVER_01, rel=0.003)


def test_the_interval_of_drag_holds_the_truth_and_is_narrow() -> None:
    drag = [found(seed).drag_1_s for seed in SEEDS]
    assert sum(f.low <= DRAG_1_S <= f.high for f in drag) >= len(SEEDS) - 1
    assert max(f.high - f.low for f in drag) < 0.05


def circle_rmse_m(*overrides: str) -> float:
    """Return the error of the reported position from 10 s on [m]."""
    ticks = fly(*AIR, *CIRCLE, *overrides).logs[0].ticks
    late = ticks[(ticks["phase"] == Phase.TRACK) & (ticks["mission_t_s"] >= 10.0)]
    assert len(late) > 330
    return float(np.sqrt(np.mean(np.sum((late["pos_ned_m"] - late["ref_pos_ned_m"]) ** 2, axis=1))))


def test_the_circle_is_flown_with_what_was_found_and_not_without() -> None:
    model = found(1).model(load(CONFIG).vehicle_model).model_dump()
    assert circle_rmse_m(*(f"vehicle_model.{name}={value}" for name, value in model.items())) <= 0.05
    assert circle_rmse_m(*UNKNOWN) > 0.1


@pytest.mark.parametrize(
    ("limit", "outcome"),
    [("mission.identify.speed_max_m_s=0.6", "speed_max_m_s is 0.6"), ("mission.identify.speed_max_m_s=5", "completed")],
)
def test_a_vehicle_that_is_too_fast_lands(limit: str, outcome: str) -> None:
    flight = fly(*STEPS, "mission.identify.hold_s=1", "mission.duration_s=11", limit, until=Phase.DONE)
    assert flight.agents[0] is not None
    assert outcome in flight.agents[0].outcome
    last = flight.logs[0].ticks[-1]
    assert (last["phase"], last["armed"]) == (Phase.DONE, 0)
    assert flight.agents[0]._ports.autopilot.landed is Landed.ON_GROUND
