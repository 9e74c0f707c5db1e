"""Tests of the mission state machine under overrides, operators, lost plans, bus loss and vehicles found in the air."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.failsafe.decision import Escalation, Response
from swarmctl.control.phases.mission_state import TAKEN_OVER
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.control.phases.state_machine import REBOOTED
from swarmctl.control.reference.landing_places import Taken, landing_place_ned_m, nearest_in_plane_m
from swarmctl.core.types import FlightMode, Landed, Mode, Phase, Verb
from tests.benches.state_machine_flight import (
    CONTROLLED_PHASES,
    IN_AIR,
    ON_GROUND,
    START,
    UTC0_US,
    Flight,
    controlled,
    ready,
    verbs,
)

# -- pilot override ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", CONTROLLED_PHASES)
def test_after_a_pilot_override_nothing_is_requested(phase: Phase) -> None:
    flight = controlled(phase)
    flight.failsafe_mode, flight.flight_mode = Mode.PILOT_OVERRIDE, FlightMode.MANUAL
    assert flight.run(0.1) == []
    assert not flight.mission.had_control
    flight.failsafe_mode = Mode.PRIMING  # without control the failsafe sees no override any more
    assert flight.run(120.0) == []  # past every timeout
    flight.flight_mode = FlightMode.EXTERNAL  # not even when the pilot tries our mode
    assert flight.run(5.0) == []
    assert not flight.mission.had_control
    flight.armed, flight.landed = False, ON_GROUND
    assert flight.run(5.0) == []
    assert (flight.phase, flight.mission.outcome) == (Phase.DONE, "pilot or autopilot took over")


@pytest.mark.parametrize(("flown", "armed"), [(FlightMode.LAND, True), (FlightMode.EXTERNAL, False)])
@pytest.mark.parametrize("phase", CONTROLLED_PHASES)
def test_who_is_landed_without_a_position_is_done_and_has_not_completed(
    phase: Phase, flown: FlightMode, armed: bool
) -> None:
    flight = controlled(phase)
    flight.failsafe_mode = Mode.STATE_STALE
    flight.run(1.0)
    assert flight.mission.had_control, "it may come back"
    flight.flight_mode, flight.armed = flown, armed
    flight.run(1.0)
    flight.armed, flight.landed = False, ON_GROUND
    assert flight.run(120.0) == []
    assert (flight.phase, flight.mission.outcome) == (Phase.DONE, "pilot or autopilot took over")


@pytest.mark.parametrize("phase", CONTROLLED_PHASES)
def test_a_reboot_that_is_told_seconds_after_its_positions_ended_is_called_one(phase: Phase) -> None:
    flight = controlled(phase)
    flight.failsafe_mode = Mode.STATE_STALE
    for armed in (False, True, False):  # a copy of an old HEARTBEAT in between
        flight.armed = armed
        flight.run(2.0)
    assert flight.mission.had_control
    flight.boots = 1
    flight.run(2.0)
    assert flight.mission.outcome == REBOOTED


STOPPED = "overload: setpoints stopped 0.5 s (26 deadline misses, 2078 since the start)"


@pytest.mark.parametrize(("stopped", "control"), [(STOPPED, "FAILSAFE"), ("", "PILOT")])
def test_a_takeover_after_setpoints_stopped_is_called_overload(stopped: str, control: str) -> None:
    flight = controlled(Phase.TRACK)
    flight.setpoints_stopped = stopped
    flight.failsafe_mode, flight.flight_mode = Mode.PILOT_OVERRIDE, FlightMode.HOLD
    flight.run(0.1)
    told = f"{STOPPED}: the autopilot took over" if stopped else "pilot or autopilot took over"
    assert flight.mission.outcome == told
    assert flight.mission.control_mode(Mode.PILOT_OVERRIDE).name == control
    flight.setpoints_stopped, flight.failsafe_mode = "", Mode.PRIMING
    flight.run(10.0)
    assert flight.mission.outcome == told, "for as long as it lasts"
    flight.ask("resume")
    assert flight.mission.outcome == ""


@pytest.mark.parametrize("flown", [FlightMode.HOLD, FlightMode.MANUAL], ids=["by the autopilot", "by the pilot"])
def test_only_the_operator_resumes_and_then_offboard_is_requested(flown: FlightMode) -> None:
    flight = controlled(Phase.TRACK)
    flight.failsafe_mode, flight.flight_mode = Mode.PILOT_OVERRIDE, flown
    flight.run(1.0)
    flight.failsafe_mode = Mode.PRIMING
    flight.ask("resume")
    assert Verb.EXTERNAL in flight.run(1.5)
    flight.flight_mode = FlightMode.EXTERNAL
    flight.run(0.1)
    assert flight.mission.had_control


@pytest.mark.parametrize("verb", ["hold", "land", "rtl"])
def test_other_verbs_do_not_take_a_vehicle_from_its_pilot(verb: str) -> None:
    flight = controlled(Phase.TRACK)
    flight.failsafe_mode, flight.flight_mode = Mode.PILOT_OVERRIDE, FlightMode.MANUAL
    flight.run(0.5)
    flight.failsafe_mode = Mode.PRIMING
    flight.ask(verb)
    assert flight.run(10.0) == []


def test_a_pilot_override_during_the_landing_is_respected() -> None:
    flight = controlled(Phase.GOTO_LAND)
    flight.pos = START.copy()
    flight.until(Phase.LAND)
    flight._obey(flight.step())
    assert flight.flight_mode is FlightMode.LAND
    flight.landed, flight.armed = IN_AIR, True
    flight.run(1.0)
    flight.flight_mode = FlightMode.MANUAL
    assert flight.run(10.0) == []


@pytest.mark.parametrize("phase", [Phase.TAKEOFF, Phase.GOTO_START])
def test_a_pilot_in_control_before_the_mission_is_not_landed_by_the_timeout(phase: Phase) -> None:
    flight = Flight().until(phase)
    flight.flight_mode, flight.landed, flight.pos = FlightMode.MANUAL, IN_AIR, START.copy()
    assert flight.run(120.0) == []


def test_a_pilot_who_comes_before_the_agent_has_control_keeps_the_vehicle_in_a_hold_of_his_own() -> None:
    """From the autopilot's hold the agent asks for control: it must not be taken for that of its climb."""
    flight = Flight().until(Phase.GOTO_START)
    flight.flight_mode = FlightMode.MANUAL
    flight.run(1.0)
    flight.flight_mode = FlightMode.HOLD
    assert flight.run(5.0) == []
    assert flight.mission.outcome == TAKEN_OVER


def test_a_pilot_override_during_handback_in_the_air_is_not_put_on_hold() -> None:
    flight = airborne().until(Phase.LAND)
    flight.flight_mode = FlightMode.MANUAL
    assert flight.run(10.0) == []


# -- operator ---------------------------------------------------------------------------------------------------------


def test_hold_stops_where_it_is_and_resume_goes_on_with_the_mission() -> None:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.vel = np.array([4.0, 2.0, -2.0]), np.array([1.2, 0.0, 0.0])
    flight.ask("hold")
    pos, vel = flight.mission.reference(flight.utc_us, flight.now_us, np.array([0.0, 60.0]))
    np.testing.assert_allclose(pos[0], [4.0, 2.0, -2.0])
    np.testing.assert_allclose(vel, np.array([[1.2, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert pos[1, 0] == pytest.approx(4.0 + 1.2)  # v T / 2 with T = 2 v / a
    flight.run(30.0)
    assert flight.at == "TRACK"  # the mission does not end while held
    flight.ask("resume")
    flight.run(0.1)
    assert (flight.phase, flight.mission.outcome) == (Phase.GOTO_LAND, "completed")


@pytest.mark.parametrize(
    ("verb", "target"), [("land", np.array([4.0, 2.0, -2.0])), ("rtl", START)], ids=["land", "rtl"]
)
@pytest.mark.parametrize("phase", [Phase.GOTO_START, Phase.READY, Phase.TRACK])
def test_land_is_here_and_rtl_is_at_the_start(phase: Phase, verb: str, target: np.ndarray) -> None:
    flight = controlled(phase)
    flight.pos = np.array([4.0, 2.0, -2.0])
    flight.ask(verb)
    assert (flight.phase, flight.mission.outcome) == (Phase.GOTO_LAND, OPERATOR_STOP)
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([0.0, 60.0]))
    np.testing.assert_allclose(pos, np.array([np.array([4.0, 2.0, -2.0]), target]), atol=1e-9)
    flight.pos = target.copy()
    if verb == "land":  # it may still be pushed aside: first it has to have come to rest
        assert flight.run(1.0) == []
    assert Verb.LAND in flight.run(0.3 if verb == "rtl" else 3.0)


def test_stopping_on_the_ground_never_takes_off() -> None:
    standing = Flight().until(Phase.STANDBY)
    standing.ask("land")
    assert standing.run(0.1) == []
    assert standing.at == "DONE"
    armed = Flight().until(Phase.TAKEOFF)
    armed.ask("rtl")
    assert armed.at == "LAND"
    assert armed.run(0.5) == [Verb.DISARM]
    armed.armed = False
    armed.run(0.2)
    assert armed.at == "DONE"


def test_stopping_while_it_climbs_lands_it() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.landed, flight.flight_mode = IN_AIR, FlightMode.TAKEOFF
    flight.ask("land")
    assert flight.run(1.0) == [Verb.LAND]


@pytest.mark.parametrize("verb", ["hold", "resume", "land", "rtl"])
@pytest.mark.parametrize("phase", [Phase.LAND, Phase.DONE])
def test_during_the_landing_verbs_change_nothing(phase: Phase, verb: str) -> None:
    flight = controlled(Phase.GOTO_LAND)
    flight.pos = START.copy()
    flight.until(phase)
    before = flight.phase, flight.mission.outcome
    flight.ask(verb)
    assert (flight.phase, flight.mission.outcome) == before


# -- timeouts ---------------------------------------------------------------------------------------------------------


def test_a_start_that_takes_too_long_is_given_up_on_the_ground() -> None:
    flight = Flight(start_timeout_s=20.0)
    flight.armable = False
    flight.run(19.9)
    assert flight.at == "STANDBY"
    flight.run(0.5)
    assert flight.at == "DONE"
    assert "20 s" in flight.mission.outcome
    assert "STANDBY" in flight.mission.outcome


def test_a_start_that_takes_too_long_in_the_air_lands() -> None:
    flight = ready()
    assert flight.run(120.0).count(Verb.LAND) > 0
    assert flight.at == "LAND"
    assert "READY" in flight.mission.outcome


def test_a_landing_place_that_cannot_be_reached_is_given_up() -> None:
    flight = controlled(Phase.GOTO_LAND)  # 3 m from there, where it stays: 3.8 s at the acceleration of transits
    flight.run(22.0)
    assert flight.at == "GOTO_LAND"
    flight.run(3.0)
    assert flight.at == "LAND"


def test_a_way_home_may_take_as_long_as_it_is() -> None:
    flight = controlled(Phase.TRACK)
    flight.pos = START + np.array([150.0, 0.0, 0.0])  # 77 s at 2 m/s
    assert flight.ask("rtl") == ""
    flight.run(76.0)
    assert flight.at == "GOTO_LAND"
    assert 20.0 < flight.mission.ends_in_s(flight.now_us, flight.utc_us) < 23.0
    flight.run(25.0)
    assert flight.at == "LAND"


@pytest.mark.parametrize("phase", CONTROLLED_PHASES)
def test_no_plan_for_too_long_lands(phase: Phase) -> None:
    flight = controlled(phase)
    flight.failsafe_mode = Mode.LAND
    assert Verb.LAND in flight.run(0.3)
    assert flight.at == "LAND"
    assert flight.mission.outcome


# -- found in the air -------------------------------------------------------------------------------------------------


def airborne(landed_at_first: Landed = IN_AIR) -> Flight:
    flight = Flight()
    flight.armed, flight.pos, flight.landed = True, START.copy(), landed_at_first
    flight.run(0.2)
    flight.landed = IN_AIR
    return flight


@pytest.mark.parametrize("landed_at_first", [IN_AIR, Landed.UNKNOWN], ids=["known", "not yet known"])
def test_a_vehicle_found_in_the_air_is_handed_back_in_the_air(landed_at_first: Landed) -> None:
    flight = airborne(landed_at_first)
    asked: list[Verb] = []
    phases: set[Phase] = set()
    for _ in range(400):
        commands = flight.step()
        phases.add(flight.phase)
        asked += verbs(commands)
        flight._obey(commands)
        if Verb.HOLD in verbs(commands):
            flight.flight_mode = FlightMode.HOLD
    assert not {Verb.ARM, Verb.TAKEOFF, Verb.LAND, Verb.DISARM} & set(asked)
    assert asked[-1] is Verb.HOLD
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    np.testing.assert_allclose(pos[0], flight.pos, atol=1e-9)  # where the mission ends, not where it began
    assert (flight.phase, flight.mission.outcome) == (Phase.DONE, "completed")
    assert flight.armed


def stops_asked(flight: Flight) -> set[Verb]:
    """Return what of landing and holding is asked until the agent is done, or for a minute."""
    asked: set[Verb] = set()
    for _ in range(600):
        commands = flight.step()
        asked |= set(verbs(commands)) & {Verb.LAND, Verb.HOLD}
        flight._obey(commands)
        if Verb.HOLD in verbs(commands):
            flight.flight_mode = FlightMode.HOLD
        if flight.phase is Phase.DONE:
            break
    return asked


@pytest.mark.parametrize("why", ["land", "rtl", "battery"])
def test_a_vehicle_found_in_the_air_is_landed_by_what_ends_its_mission(why: str) -> None:
    """It hovered with no agent until its battery was empty."""
    flight = airborne().until(Phase.TRACK)
    if why == "battery":
        flight.failsafe_mode, flight.escalation = Mode.TRACKING, Escalation(Response.LAND, "battery at 6 %")
    else:
        assert flight.ask(why) == ""
    assert stops_asked(flight) == {Verb.LAND}
    assert (flight.at, flight.armed) == ("DONE", False)


def test_a_vehicle_found_in_the_air_is_landed_by_an_operator_also_after_its_mission() -> None:
    flight = airborne().until(Phase.GOTO_LAND)
    assert flight.mission.outcome == "completed"
    assert flight.ask("land") == ""
    assert stops_asked(flight) == {Verb.LAND}


def test_where_there_is_no_ground_a_vehicle_is_handed_back_whatever_ends_its_mission() -> None:
    (agent,) = Lockstep(load(None, ["swarm.agents=1", "sitl.start=air"])).agents
    (standing,) = Lockstep(load(None, ["swarm.agents=1"])).agents
    assert agent is not None
    assert standing is not None
    for mission in (agent._mission, standing._mission):
        mission.airborne, mission.outcome = True, OPERATOR_STOP
    assert agent._mission.handed_back
    assert not standing._mission.handed_back


def test_a_vehicle_found_in_the_air_is_not_flown_into_a_mission_that_has_begun() -> None:
    flight = Flight()
    flight.armed, flight.pos, flight.landed = True, START.copy(), IN_AIR
    flight.peer(Phase.TRACK, UTC0_US)
    assert flight.run(5.0) == []
    assert (flight.at, flight.mission.outcome) == ("DONE", "the mission has begun without it")


# -- bus loss ---------------------------------------------------------------------------------------------------------


def test_bus_loss_brings_it_to_rest_and_recovery_resumes_the_mission() -> None:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.vel, flight.unresponsive_peer = np.array([4.0, 2.0, -2.0]), np.array([1.2, 0.0, 0.0]), True
    flight.run(0.1)
    pos, vel = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    np.testing.assert_allclose(pos[0], [4.36, 2.0, -2.0])  # at 2 m/s2
    assert not vel.any()
    flight.run(60.0)
    assert flight.at == "TRACK"
    flight.unresponsive_peer = False
    flight.run(0.1)
    assert flight.at == "GOTO_LAND"  # its time was over meanwhile


def test_a_landing_in_place_stays_in_place_after_a_bus_loss() -> None:
    flight = controlled(Phase.TRACK)
    here = np.array([4.0, 2.0, -2.0])
    flight.pos = here.copy()
    flight.ask("land")
    flight.unresponsive_peer = True
    flight.run(1.0)
    flight.unresponsive_peer = False
    flight.run(0.1)
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    np.testing.assert_allclose(pos[0], here, atol=1e-9)


def test_a_land_command_during_bus_loss_lands_in_place() -> None:
    flight = controlled(Phase.TRACK)
    here = np.array([4.0, 2.0, -2.0])
    flight.pos, flight.unresponsive_peer = here.copy(), True
    flight.run(1.0)
    flight.ask("land")
    flight.unresponsive_peer = False
    flight.run(0.1)
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    np.testing.assert_allclose(pos[0], here, atol=1e-9)


def test_bus_loss_does_not_prevent_the_landing_on_the_way_home() -> None:
    flight = controlled(Phase.GOTO_LAND)
    flight.unresponsive_peer, flight.pos = True, START.copy()
    assert Verb.LAND in flight.run(25.0)


def test_during_bus_loss_no_agent_gets_ready_or_lands_among_others() -> None:
    on_its_way = controlled(Phase.GOTO_START)
    on_its_way.unresponsive_peer, on_its_way.pos = True, START.copy()
    on_its_way.run(5.0)
    assert on_its_way.at == "GOTO_START"
    on_its_way.unresponsive_peer = False
    on_its_way.run(0.2)
    assert on_its_way.at == "READY"
    home = controlled(Phase.GOTO_LAND)
    home.unresponsive_peer, home.pos = True, START.copy()
    home.run(0.1)  # braking ends where it is
    home.run(5.0)
    assert home.at == "GOTO_LAND"


def test_negative_control_taken_during_bus_loss_stays_in_place() -> None:
    flight = Flight().until(Phase.GOTO_START)
    flight.unresponsive_peer, flight.pos = True, START + np.array([3.0, 0.0, 0.0])
    flight.run(0.5)
    flight.flight_mode = FlightMode.EXTERNAL
    flight.run(0.2)
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    np.testing.assert_allclose(pos[0], START + np.array([3.0, 0.0, 0.0]), atol=1e-9)


# -- rebooted ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [Phase.ARM, Phase.TAKEOFF, *CONTROLLED_PHASES])
def test_after_a_reboot_of_the_autopilot_nothing_is_requested(phase: Phase) -> None:
    flight = controlled(phase) if phase in CONTROLLED_PHASES else Flight().until(phase)
    flight.boots, flight.seen = 1, False  # no position yet
    flight.run(0.2)
    assert flight.mission.outcome == REBOOTED
    flight.seen, flight.armed, flight.flight_mode = True, False, FlightMode.HOLD
    flight.landed = IN_AIR
    assert flight.run(5.0) == []
    flight.landed = ON_GROUND
    assert flight.run(5.0) == []
    assert (flight.at, flight.mission.outcome) == ("DONE", REBOOTED)


def test_a_reboot_before_anything_was_armed_costs_nothing() -> None:
    flight = Flight()
    flight.armable = False
    flight.run(0.3)
    flight.boots, flight.prepared, flight.armable = 1, False, True
    assert flight.run(2.0) == [], "its parameters are not set again yet"
    flight.prepared = True
    assert Verb.ARM in flight.run(0.5)


# -- before control ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "failsafe"),
    [(FlightMode.RTL, True), (FlightMode.LAND, True), (FlightMode.HOLD, True), (FlightMode.MANUAL, False)],
)
def test_no_setpoints_are_sent_to_a_vehicle_in_failsafe_or_with_a_pilot(mode: FlightMode, failsafe: bool) -> None:
    flight = airborne()
    flight.flight_mode, flight.failsafe = mode, failsafe
    assert flight.run(5.0) == []
    assert flight.phase < Phase.GOTO_START, "in which setpoints flow"
    assert flight.mission.pilot_override
    flight.ask("resume")
    assert Verb.EXTERNAL in flight.run(1.0)


# -- brake and make room before an autopilot takes over ---------------------------------------------------------------

CLOSE = START + np.array([0.6, 0.0, 0.0])


def taken(*others_ned_m: np.ndarray) -> list[Taken]:
    return [Taken(center_ned_m=other, apart_m=1.2) for other in others_ned_m]


def test_a_landing_in_place_moves_to_a_free_place_first() -> None:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.others = START.copy(), (CLOSE,)
    flight.failsafe_mode = Mode.TRACKING
    flight.ask("land")
    assert Verb.LAND not in flight.run(6.0)
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    assert np.linalg.norm((pos[0] - CLOSE)[:2]) == pytest.approx(0.9 + 0.2 + 0.1)
    assert pos[0][2] == START[2]
    flight.pos = pos[0]
    assert Verb.LAND in flight.run(6.0)


def test_stacked_vehicles_part_in_different_directions_before_landing() -> None:
    low, high = START.copy(), START - np.array([0.0, 0.0, 3.0])
    assert nearest_in_plane_m(low, [high]) == 0.0
    apart = [
        landing_place_ned_m(low, taken(high), own) - landing_place_ned_m(high, taken(low), own + 1) for own in range(4)
    ]
    assert min(np.linalg.norm(gap[:2]) for gap in apart) > 1.2
    crowd = [np.array([0.3 * k, 0.1 * k * k, -2.0]) for k in range(4)]
    place = landing_place_ned_m(np.array([0.2, 0.2, -2.0]), taken(*crowd), 5)
    assert nearest_in_plane_m(place, crowd) > 1.1
    np.testing.assert_array_equal(landing_place_ned_m(low, [], 0), low)


def test_after_the_timeout_it_lands_even_without_room() -> None:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.others = START.copy(), (CLOSE,)
    flight.ask("land")
    assert Verb.LAND not in flight.run(19.0)
    assert Verb.LAND in flight.run(3.0)


def test_a_start_given_up_at_speed_brakes_before_the_autopilot_lands_it() -> None:
    flight = controlled(Phase.GOTO_START)
    flight.failsafe_mode, flight.vel = Mode.TRACKING, np.array([2.0, 0.0, 0.0])
    while flight.phase is Phase.GOTO_START:
        flight.step()
    assert flight.at == "GOTO_LAND"
    _, vel = flight.mission.reference(flight.utc_us, flight.now_us, np.array([0.0, 60.0]))
    np.testing.assert_allclose(vel[1], 0.0)
    assert "not tracking" in flight.mission.outcome


def test_only_without_a_plan_it_is_landed_at_once() -> None:
    flight = controlled(Phase.TRACK)
    flight.others, flight.failsafe_mode = (CLOSE,), Mode.LAND
    assert Verb.LAND in flight.run(0.3)


def test_after_the_timeout_of_a_landing_place_it_lands_at_rest_and_with_room() -> None:
    flight = controlled(Phase.GOTO_LAND)
    flight.failsafe_mode, flight.vel = Mode.TRACKING, np.array([1.0, 0.0, 0.0])
    assert Verb.LAND not in flight.run(21.0)
    assert flight.at == "GOTO_LAND"
    flight.vel = np.zeros(3)
    assert Verb.LAND in flight.run(5.0)


def test_handed_back_in_the_air_among_others_it_holds_only_at_rest_and_alone_at_once() -> None:
    for others in (1, 0):
        flight = Flight(others)
        flight.armed, flight.pos, flight.landed = True, START.copy(), IN_AIR
        flight.until(Phase.TRACK)
        flight.failsafe_mode, flight.vel = Mode.TRACKING, np.array([2.0, 0.0, 0.0])
        asked = flight.run(11.0)
        assert (Verb.HOLD in asked) is (others == 0)
