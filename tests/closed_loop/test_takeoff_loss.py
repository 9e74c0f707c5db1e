"""Tests that PX4's data-link failsafe lands a vehicle whose agent dies before OFFBOARD."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.core.types import FlightMode, Phase
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.dialects.px4 import PX4
from swarmctl.mavlink.vehicle import autopilot
from tests.closed_loop.conftest import COARSE

PHASES = [Phase.ARM, Phase.TAKEOFF]


def died_in(phase: Phase) -> Lockstep:
    """Return a flight after the only agent of the vehicle died in the given phase: disarmed, or forty seconds later."""
    flight = Lockstep(load(None, (*COARSE, "swarm.agents=1", "mission.duration_s=5")))
    entered_us: int | None = None
    while entered_us is None or flight.clock.now_us() < entered_us + (2_000_000 if phase is Phase.TAKEOFF else 60_000):
        flight.step()
        rows = flight.logs[0].rows
        if entered_us is None and rows and rows[-1]["phase"][0] == phase:
            entered_us = flight.clock.now_us()
    flight.kill(0)
    until_us = flight.clock.now_us() + 40_000_000
    armed = flight.world.truth_rows()["armed"]
    while flight.clock.now_us() < until_us and (armed[0] or phase is Phase.ARM):
        flight.step()
        armed = flight.world.truth_rows()["armed"]
    return flight


@pytest.mark.parametrize("phase", PHASES)
def test_a_vehicle_whose_agent_dies_before_offboard_is_disarmed_within_forty_seconds(phase: Phase) -> None:
    flight = died_in(phase)
    assert flight.truth["armed"].any() or phase is Phase.ARM
    assert not flight.truth["armed"][-1]


def test_negative_control_without_the_data_link_failsafe_it_hovers_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    unprotected = replace(PX4, given={}, rules=())
    monkeypatch.setattr(autopilot, "DIALECTS", {**DIALECTS, 12: unprotected})
    flight = died_in(Phase.TAKEOFF)
    assert flight.truth["armed"][-1]
    assert flight.truth["pos_ned_m"][-1][2] < flight.truth["pos_ned_m"][0][2] - 1.5
    assert flight.truth["flight_mode"][-1] == FlightMode.HOLD
