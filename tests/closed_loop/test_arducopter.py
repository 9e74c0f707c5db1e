"""Tests of the default circle on simulated ArduCopters: GUIDED, C-cast parameters, streams on request only."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from sitl.arducopter.autopilot import ArduCopter
from sitl.lockstep import Lockstep
from swarmctl.core.types import FlightMode, Landed, Mode, Phase
from tests.closed_loop.conftest import Flight, fly_now

CONFIG = "ardupilot_sitl.toml"


@pytest.fixture(scope="module")
def circle() -> Iterator[Flight]:
    """Fly three agents for 10 s, from the ground and back."""
    yield fly_now("mission.duration_s=10", config=CONFIG)


def pilots(lockstep: Lockstep) -> list[ArduCopter]:
    return [pilot for pilot in lockstep.world.autopilots if isinstance(pilot, ArduCopter)]


def test_whole_mission_is_flown_and_landed(circle: Flight) -> None:
    assert circle.problems == []
    last = circle.lockstep.truth[-3:]
    assert (last["landed"] == Landed.ON_GROUND).all() and not last["armed"].any()
    assert (last["flight_mode"] == FlightMode.LAND).all(), "landed by ArduCopter's LAND, which it stays in"
    starts = np.array(circle.config.starts_ned_m())
    assert np.linalg.norm((circle.pos_ned_m[-1] - starts)[:, :2], axis=1).max() < 0.3


def test_true_separation_is_kept_throughout(circle: Flight) -> None:
    assert circle.separation_m() >= 0.85


def test_the_circle_is_tracked_with_every_plan_good(circle: Flight) -> None:
    assert circle.summed_mean_error_m(after_s=5.0) <= 1.8, "theoretical lower bound: 1.56"
    for agent in range(3):
        assert circle.modes(agent, Phase.TRACK) == {Mode.TRACKING}


def test_setpoints_were_taken_as_thrust_and_all_accepted(circle: Flight) -> None:
    for agent, pilot in enumerate(pilots(circle.lockstep)):
        assert not pilot.refused
        assert pilot.parameters.integer("GUID_OPTIONS") == 0, "after the flight it is what it was"
        ticks, _ = circle.tracked(agent)
        assert float(np.median(ticks["setpoint_thrust_01"])) == pytest.approx(0.3645, abs=0.02)


def test_negative_control_without_the_option_nothing_is_armed() -> None:
    flight = fly_now("swarm.agents=1", "agent.autopilot_params.GUID_OPTIONS=0", config=CONFIG)
    (agent,) = flight.lockstep.agents
    assert agent is not None and "GUID_OPTIONS" in agent.outcome
    assert not flight.lockstep.truth["armed"].any()


# -- an agent that dies -----------------------------------------------------------------------------------------------


def test_the_vehicle_of_a_dead_agent_lands_and_the_other_keeps_clear() -> None:
    def is_down(running: Lockstep) -> bool:
        return running.agents[0] is None and running.world.truth_rows()[0]["landed"] == Landed.ON_GROUND

    died = {4.0: lambda running: running.kill(0)}
    flight = fly_now("swarm.agents=2", "mission.duration_s=10", config=CONFIG, at=died, until=is_down)
    assert pilots(flight.lockstep)[0].flight_mode() is FlightMode.LAND
    assert flight.lockstep.truth[-2]["landed"] == Landed.ON_GROUND
    assert flight.separation_m() >= 0.85


def test_negative_control_without_its_failsafe_it_would_never_be_armed() -> None:
    flight = fly_now("swarm.agents=1", "agent.autopilot_params.FS_GCS_ENABLE=0", config=CONFIG)
    (agent,) = flight.lockstep.agents
    assert agent is not None and "FS_GCS_ENABLE" in agent.outcome
    assert not flight.lockstep.truth["armed"].any()
