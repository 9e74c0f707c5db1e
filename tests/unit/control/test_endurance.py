"""What wears out asks for more and more: a warning, the way back, a landing; each can be switched off."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swarmctl.config import load
from swarmctl.control.failsafe.decision import Escalation, FailsafeParams, Response, escalate
from swarmctl.control.failsafe.endurance import UNKNOWN, Endurance
from swarmctl.core.types import Mode, Phase
from swarmctl.errors import ConfigError
from tests.benches.state_machine_flight import START, Flight, controlled
from tests.unit.control.test_failsafe import GOOD

PARAMS = FailsafeParams(link_rtl_01=0.4, link_land_01=0.7)
NONE, WARN, RTL, LAND = Response
SECOND = 1_000_000


def response(params: FailsafeParams = PARAMS, **changes: Any) -> Response:
    return escalate(replace(GOOD, **changes), params).response


@pytest.mark.parametrize(
    ("battery_01", "expected"),
    [
        (1.0, NONE),
        (0.3, NONE),
        (0.29, WARN),
        (0.2, WARN),
        (0.19, RTL),
        (0.1, RTL),
        (0.09, LAND),
        (0.0, LAND),
        (-1.0, NONE),
    ],
)
def test_a_battery_escalates_and_an_unknown_one_does_not(battery_01: float, expected: Response) -> None:
    assert response(battery_01=battery_01) is expected


@pytest.mark.parametrize(("lost_01", "expected"), [(0.0, NONE), (0.2, NONE), (0.21, WARN), (0.5, RTL), (0.8, LAND)])
def test_a_link_escalates(lost_01: float, expected: Response) -> None:
    assert response(link_lost_01=lost_01) is expected


def test_the_strongest_of_all_rows_counts_and_says_why() -> None:
    worn = replace(GOOD, battery_01=0.25, link_lost_01=0.5)
    assert escalate(worn, PARAMS) == Escalation(RTL, "no state of the vehicle in 50 % of the time")
    assert escalate(replace(worn, battery_01=0.05), PARAMS) == Escalation(LAND, "battery at 5 %")


def test_negative_control_limits_that_are_off_ask_for_nothing() -> None:
    off = FailsafeParams(battery_warn_01=0, battery_rtl_01=0, battery_land_01=0, link_warn_01=1)
    assert response(off, battery_01=0.0, link_lost_01=1.0) is NONE
    assert off.acts("battery") == off.acts("link") == []
    assert PARAMS.acts("battery") == ["warns at 30%", "returns at 20%", "lands at 10%"]


@pytest.mark.parametrize(
    "overrides", [("battery_rtl_01=0.4",), ("battery_land_01=0.25",), ("link_rtl_01=0.1",), ("battery_land_01=0.5",)]
)
def test_limits_that_do_not_escalate_are_refused(overrides: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="do not escalate"):
        load(None, [f"agent.failsafe.{override}" for override in overrides])
    load(None, ["agent.failsafe.battery_rtl_01=0"])  # what is off has no place in the order


def test_a_sag_or_a_single_gap_does_not_count() -> None:
    endurance = Endurance(5.0)
    for tick in range(500):  # 10 s
        sags, gap = 400 <= tick < 450, 100 <= tick < 150  # for a second each
        endurance.update(tick * 20_000, 0.15 if sags else 0.5, gap)
        assert endurance.battery_01 == 0.5
        assert endurance.link_lost_01 <= 0.2 + 1e-6
    for tick in range(500, 800):
        endurance.update(tick * 20_000, 0.15, True)
    assert endurance.battery_01 == 0.15
    assert endurance.link_lost_01 == pytest.approx(1.0, abs=0.01)


def test_what_a_vehicle_does_not_know_is_unknown() -> None:
    endurance = Endurance(5.0)
    assert endurance.battery_01 == UNKNOWN
    endurance.update(0, 0.5, False)
    endurance.update(SECOND, None, False)
    assert endurance.battery_01 == UNKNOWN


# -- the mission ------------------------------------------------------------------------------------------------------


def away(phase: Phase) -> Flight:
    """Return a flight whose plans are flown, 3 m from its start."""
    flight = controlled(phase)
    flight.pos, flight.failsafe_mode = START + np.array([3.0, 0.0, 0.0]), Mode.TRACKING
    return flight


def worn(flight: Flight, asked: Response) -> Flight:
    flight.escalation = Escalation(asked, "battery at 15 %")
    flight.run(0.2)
    return flight


@pytest.mark.parametrize("phase", [Phase.GOTO_START, Phase.READY, Phase.TRACK], ids=lambda phase: phase.name)
@pytest.mark.parametrize("held", [False, True])
def test_an_agent_flies_back_or_lands_where_it_is(phase: Phase, held: bool) -> None:
    for asked, in_place in ((RTL, False), (LAND, True)):
        flight = away(phase)
        if held:
            flight.ask("hold")
        worn(flight, asked)
        assert flight.phase is Phase.GOTO_LAND
        assert flight.mission.landing.in_place is in_place
        assert flight.mission.outcome.startswith("battery at 15 %")
        assert not flight.mission.held


def test_on_the_way_back_it_lands_where_it_is_once_it_has_to() -> None:
    flight = worn(away(Phase.TRACK), RTL)
    worn(flight, RTL)
    assert not flight.mission.landing.in_place
    worn(flight, LAND)
    assert flight.mission.landing.in_place


def test_a_warning_changes_nothing() -> None:
    flight = worn(away(Phase.TRACK), WARN)
    assert flight.phase is Phase.TRACK
    assert flight.mission.outcome == ""


@pytest.mark.parametrize("asked", [RTL, LAND])
def test_nothing_is_armed_with_a_battery_that_would_return_at_once(asked: Response) -> None:
    flight = worn(Flight(), asked)
    flight.run(10.0)
    assert flight.phase is Phase.DONE
    assert not flight.mission.arming.requested
    assert flight.mission.outcome == "battery at 15 %"


def test_a_pilot_is_left_alone() -> None:
    flight = controlled(Phase.TRACK)
    flight.failsafe_mode = Mode.PILOT_OVERRIDE
    flight.run(0.2)
    worn(flight, LAND)
    assert flight.phase is Phase.TRACK
    assert flight.mission.pilot_override
