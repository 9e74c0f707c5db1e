"""A battery that runs low in flight: the agent flies back under its own plan, before its autopilot acts by itself."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.core.types import Mode, Phase
from tests.closed_loop.conftest import Flight, fly_now

PAIR = (
    "swarm.agents=2",
    "start.center_ned_m=[0, 0, -1]",
    "start.spacing_m=2",
    "sitl.start=air",
    "mission.kind=line",
    "mission.line.velocity_ned_m_s=[0.0, 0.6, 0.0]",
    "mission.line.goal_assignment=true",
    "mission.duration_s=5",
    "agent.failsafe.window_s=1",
    "sitl.battery.capacity_mah=3000",
)


def drained(charge_01: float, *overrides: str) -> Flight:
    """Fly a pair; in the first seconds of the mission the battery of vehicle 0 is down to a charge."""
    drain = f"sitl.faults=[{{kind='battery', vehicle=0, value={charge_01}, at_s=3.5}}]"
    return fly_now(*PAIR, drain, *overrides, until=None if not overrides else Lockstep.mission_is_over)


def responses(flight: Flight, agent: int) -> list[str]:
    return [event["response"] for event in flight.lockstep.logs[agent].events if event["event"] == "escalation"]


@pytest.fixture(scope="module")
def low() -> Flight:
    return drained(0.15)


def test_a_low_battery_brings_the_vehicle_back_under_its_own_plan(low: Flight) -> None:
    agent, peer = low.lockstep.agents
    assert agent is not None and peer is not None
    assert agent.outcome == "battery at 15 %: flew back"
    assert peer.outcome == "completed"
    assert responses(low, 0)[:1] == ["RTL"]
    assert responses(low, 1) == []
    assert low.modes(0, Phase.GOTO_LAND) == {Mode.TRACKING}
    tracked, others = (rows[rows["phase"] == Phase.TRACK] for rows in (low.ticks(0), low.ticks(1)))
    assert len(tracked) < len(others) - 100, "it did not fly on to the end"
    assert low.separation_m() >= 0.85
    assert np.abs(low.pos_ned_m[-1, 0, :2] - [-1.0, 0.0]).max() < 0.1


def test_negative_control_with_the_actions_off_it_flies_on() -> None:
    flight = drained(0.15, "agent.failsafe.battery_rtl_01=0", "agent.failsafe.battery_land_01=0", "swarm.agents=1")
    assert flight.outcomes == {"completed"}
    assert responses(flight, 0) == ["WARN"]
