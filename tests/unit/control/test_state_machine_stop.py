"""Tests that no stop is lost and that "disarmed" needs a HEARTBEAT newer than the arm request."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.failsafe.decision import Escalation, Response
from swarmctl.control.failsafe.overload import Level
from swarmctl.control.phases.handover import withdrawn_verbs
from swarmctl.control.phases.inputs import PeerInputs
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.core.types import FlightMode, Mode, Phase, Verb
from tests.benches.state_machine_flight import IN_AIR, ON_GROUND, START, Flight, controlled


def asked_to_arm(busy: bool) -> Flight:
    """Return a flight in ARM with an open request, whose newest HEARTBEAT is older and says "disarmed"."""
    flight = Flight().until(Phase.ARM)
    flight.beat_us = flight.now_us - 100_000
    assert flight.run(0.1) == [Verb.ARM]
    flight.busy = busy
    return flight


@pytest.mark.parametrize("busy", [False, True], ids=["acknowledged", "not acknowledged"])
@pytest.mark.parametrize("verb", ["land", "rtl"])
def test_a_stop_between_the_acknowledgement_of_arming_and_its_heartbeat_disarms(busy: bool, verb: str) -> None:
    flight = asked_to_arm(busy)
    flight.ask(verb)
    flight.run(0.5)
    assert flight.at == "LAND", "the HEARTBEAT that says disarmed is older than the arm request"
    flight.busy = False
    assert Verb.DISARM in flight.run(1.0)
    assert flight.at == "LAND"
    flight.armed, flight.beat_us = True, flight.now_us  # now it tells
    assert Verb.DISARM in flight.run(2.0)
    assert flight.at == "LAND"
    flight.armed, flight.beat_us = False, flight.now_us
    flight.run(0.2)
    assert flight.at == "LAND", "a copy of the HEARTBEAT from before it was armed says the same"
    flight.beat_us = flight.now_us
    flight.run(0.2)
    assert (flight.at, flight.mission.outcome) == ("DONE", OPERATOR_STOP)


def test_a_heartbeat_proves_nothing_while_the_request_to_arm_is_open_however_late_in_a_tick_it_arrives() -> None:
    """It may arrive after the tick began, and still be from before the request."""
    flight = asked_to_arm(busy=True)
    flight.ask("land")
    for _ in range(5):
        flight.beat_us = flight.now_us + 1_000
        flight.step()
    assert flight.at == "LAND", "its motors may start yet"


def test_a_copy_of_a_heartbeat_from_before_it_was_armed_ends_no_take_off() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.run(0.3)
    flight.armed, flight.beat_us = False, flight.now_us
    flight.run(0.5)
    assert flight.at == "TAKEOFF"
    flight.armed, flight.beat_us = True, flight.now_us
    flight.run(0.5)
    assert flight.at == "TAKEOFF"
    flight.armed = False
    for _ in range(2):  # now it is disarmed indeed
        flight.beat_us = flight.now_us
        flight.run(0.5)
    assert (flight.at, flight.mission.outcome) == ("DONE", "disarmed before take-off")


def test_a_vehicle_that_stands_and_is_not_disarmed_by_its_autopilot_is_disarmed() -> None:
    flight = Flight().until(Phase.LAND)
    flight.flight_mode, flight.landed, flight.armed = FlightMode.LAND, IN_AIR, True
    assert flight.run(20.0) == []
    flight.landed = ON_GROUND
    assert flight.run(4.5) == [], "an autopilot disarms by itself"
    flight.landed = IN_AIR
    flight.run(0.2)
    flight.landed = ON_GROUND
    assert flight.run(4.5) == [], "it has to stand for as long as that"
    assert flight.run(1.0) == [Verb.DISARM]


def test_long_after_it_was_armed_one_heartbeat_suffices() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.run(6.0)
    flight.ask("land")
    flight.armed, flight.beat_us = False, flight.now_us
    flight.run(0.1)
    assert flight.at == "DONE"


def test_a_vehicle_that_is_disarmed_and_said_to_be_in_the_air_is_not_landed_for_ever() -> None:
    """The simulator's starts in the air hang there until they are flown; no autopilot lands what it does not arm."""
    flight = Flight()
    flight.landed, flight.unsettled = IN_AIR, "waits"
    flight.run(0.2)
    flight.ask("land")
    flight.run(3.0)
    assert flight.at == "LAND", "one that has just been disarmed may be falling, and is watched"
    flight.run(3.0)
    assert (flight.at, flight.mission.outcome) == ("DONE", OPERATOR_STOP)


def test_one_heartbeat_before_the_link_falls_silent_ends_no_landing() -> None:
    """It may be a copy of one from before the vehicle was armed."""
    flight = Flight().until(Phase.LAND)
    flight.flight_mode, flight.landed, flight.armed = FlightMode.LAND, IN_AIR, True
    flight.run(6.0)
    flight.armed, flight.beat_us = False, flight.now_us
    flight.run(30.0)
    assert flight.at == "LAND"


def test_a_vehicle_that_a_pilot_disarms_before_its_first_heartbeat_is_not_armed_again() -> None:
    flight = asked_to_arm(busy=False)
    flight.mission.arming.accepted = True
    assert flight.run(1.0) == []
    flight.beat_us = flight.now_us
    assert flight.run(1.0) == []
    assert flight.at == "ARM", "one HEARTBEAT may be older than the answer"
    flight.beat_us = flight.now_us
    assert Verb.ARM not in flight.run(0.2)
    assert (flight.at, flight.mission.outcome) == ("DONE", "disarmed before take-off")


def test_negative_control_a_request_that_was_not_accepted_is_repeated() -> None:
    assert Verb.ARM in asked_to_arm(busy=False).run(1.5)


@pytest.mark.parametrize(
    ("phase", "withdrawn"),
    [
        (Phase.ARM, set()),
        (Phase.TAKEOFF, set()),
        (Phase.GOTO_START, set()),
        (Phase.LAND, {Verb.ARM, Verb.TAKEOFF, Verb.EXTERNAL}),
        (Phase.DONE, {Verb.ARM, Verb.TAKEOFF, Verb.EXTERNAL}),
    ],
)
def test_what_leads_into_the_air_is_withdrawn_by_a_stop(phase: Phase, withdrawn: set[Verb]) -> None:
    flight = Flight().until(phase)
    assert withdrawn_verbs(flight.mission, flight.state) == withdrawn


def test_nothing_more_is_asked_of_a_vehicle_that_a_pilot_has() -> None:
    flight = controlled(Phase.TRACK)
    flight.flight_mode, flight.failsafe_mode = FlightMode.MANUAL, Mode.PILOT_OVERRIDE
    assert withdrawn_verbs(flight.mission, flight.state) == {Verb.EXTERNAL}, "in the tick that hears of it"
    flight.run(0.1)
    assert withdrawn_verbs(flight.mission, flight.state) >= {Verb.EXTERNAL, Verb.HOLD, Verb.LAND, Verb.DISARM}
    assert flight.ask("resume") == ""
    assert withdrawn_verbs(flight.mission, flight.state) == set(), "it is taken back from the pilot's mode"


def test_negative_control_one_that_is_armed_meanwhile_is_landed_for_as_long_as_it_takes() -> None:
    flight = Flight()
    flight.landed, flight.unsettled = IN_AIR, "waits"
    flight.run(0.2)
    flight.ask("land")
    flight.run(3.0)
    flight.armed = True
    flight.run(0.1)
    flight.armed = False
    flight.run(4.0)
    assert flight.at == "LAND", "the five seconds begin anew"
    flight.armed, flight.flight_mode = True, FlightMode.LAND
    flight.run(60.0)
    assert flight.at == "LAND"


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.MANUAL])
def test_a_refusal_after_an_arm_request_disarms_before_giving_up(mode: FlightMode) -> None:
    """PX4 is armed in the mode that it is in: on the ground that is no pilot's takeover."""
    flight = asked_to_arm(busy=False)
    flight.flight_mode = mode
    flight.refusal = "COM_OBL_RC_ACT = 7"
    assert Verb.DISARM in flight.run(1.0)
    assert flight.at == "LAND"
    flight.beat_us = flight.now_us
    flight.run(0.2)
    assert (flight.at, flight.mission.outcome) == ("DONE", "COM_OBL_RC_ACT = 7")


@pytest.mark.parametrize("verb", ["land", "rtl"])
def test_a_stop_before_the_first_vehicle_state_is_kept_until_there_is_one(verb: str) -> None:
    flight = Flight()
    flight.seen = False
    flight.ask(verb)
    flight.run(1.0)
    assert flight.at == "CONNECT"
    flight.seen = True
    assert Verb.ARM not in flight.run(5.0)
    assert (flight.at, flight.mission.outcome) == ("DONE", OPERATOR_STOP)


def test_a_stop_before_the_first_state_lands_a_vehicle_that_hovers_armed() -> None:
    """The case of an agent started beside a vehicle whose agent died."""
    flight = Flight()
    flight.seen = False
    flight.ask("land")
    flight.run(0.2)
    flight.seen, flight.armed, flight.landed, flight.pos = True, True, IN_AIR, START.copy()
    assert flight.run(1.0) == [Verb.LAND]
    flight.flight_mode = FlightMode.LAND
    assert flight.run(5.0) == []
    flight.landed = ON_GROUND
    flight.run(1.0)
    assert flight.at == "LAND", "it is still armed"
    flight.armed = False
    flight.run(0.2)
    assert flight.at == "DONE"


def test_a_heartbeat_from_before_the_process_proves_nothing() -> None:
    flight = Flight()
    flight.beat_us = -1  # buffered in the socket since before this process looked
    flight.ask("land")
    flight.run(1.0)
    assert flight.at == "LAND"
    flight.beat_us = flight.now_us
    flight.run(0.2)
    assert flight.at == "DONE"


def test_a_stop_while_the_state_is_lost_in_flight_begins_when_it_is_back() -> None:
    flight = Flight().until(Phase.TRACK)
    flight.seen = False
    flight.ask("land")
    flight.run(0.5)
    assert flight.at == "TRACK"
    flight.seen = True
    flight.run(0.2)
    assert flight.at == "GOTO_LAND"


def test_land_on_the_way_home_lands_here_and_repeating_it_does_not_begin_again() -> None:
    flight = Flight().until(Phase.TRACK)
    flight.pos = START + np.array([4.0, 0.0, 0.0])
    flight.ask("rtl")
    flight.run(0.5)
    target = flight.mission.trajectories.destination_ned_m.copy()
    flight.ask("land")
    flight.run(0.1)
    here = flight.mission.trajectories.destination_ned_m.copy()
    assert (target == START).all()
    assert abs(here[0] - flight.pos[0]) < 0.5
    flight.pos = flight.pos + np.array([1.0, 0.0, 0.0])
    flight.ask("land")
    flight.run(0.1)
    assert (flight.mission.trajectories.destination_ned_m == here).all()


def test_temporary_causes_are_waited_for_and_named_at_the_timeout() -> None:
    flight = Flight(start_timeout_s=20.0)
    flight.unsettled = "the estimator's accuracy to settle (now 14.10 m)"
    assert flight.run(19.0) == []
    assert flight.at == "STANDBY"
    flight.unsettled = ""
    assert Verb.ARM in flight.run(0.3)
    late = Flight(start_timeout_s=20.0)
    late.unsettled = "the estimator's accuracy to settle (now 14.10 m)"
    assert late.run(20.5) == []
    assert late.at == "DONE"
    assert "14.10 m" in late.mission.outcome


def test_who_has_waited_long_for_a_late_host_has_all_the_time_to_the_start() -> None:
    """It took off, and gave up in the air because it had waited on the ground; then so did all others."""
    flight = Flight(start_timeout_s=20.0)
    flight.peer(Phase.CONNECT)
    flight.run(19.0)
    flight.peer(Phase.STANDBY)
    flight.until(Phase.TAKEOFF)
    flight.run(15.0)
    assert (flight.at, flight.mission.outcome) == ("TAKEOFF", "")
    flight.run(6.0)
    assert flight.mission.outcome == "not tracking after 20 s (TAKEOFF)"


@pytest.mark.parametrize("slow", ["own", "peer", ""])
def test_nobody_takes_off_while_a_processor_has_yet_to_show_that_it_keeps_up(slow: str) -> None:
    """Half a swarm in the air would wait there for the other half."""
    flight = Flight(peers=1)
    flight.too_slow = "its processor to keep up" if slow == "own" else ""
    flight.peers[1] = PeerInputs(Phase.STANDBY, 0, True, keeps_up=slow != "peer")
    assert (Verb.ARM in flight.run(3.0)) == (slow == "")
    assert flight.mission.keeps_up == (slow != "own")
    if slow == "own":
        assert flight.mission.waits_for == "its processor to keep up"
    if slow == "peer":
        assert flight.mission.waits_for == "the processor of agent-1 to keep up"
        flight.peers[1] = PeerInputs(Phase.STANDBY, 0, True, keeps_up=True)
        assert Verb.ARM in flight.run(0.3)


def test_an_overloaded_agent_waits_on_the_ground_until_the_patience_with_the_start_ends() -> None:
    flight = Flight()
    flight.overload, flight.too_slow = Level.LAND, "its processor to keep up"
    flight.run(80.0)
    assert flight.mission.phase is Phase.STANDBY
    flight.run(12.0)
    assert flight.mission.outcome == "not tracking after 90 s (STANDBY): its processor to keep up"


@pytest.mark.parametrize("lands", [False, True], ids=["left", "an operator lands it"])
def test_a_vehicle_in_the_air_that_it_never_had_is_left_as_found_unless_an_operator_lands_it(
    lands: bool,
) -> None:
    """An agent that was started again waits for a peer that does not come."""
    flight = Flight()
    flight.armed, flight.landed, flight.pos = True, IN_AIR, START.copy()
    flight.peers = {}
    if lands:
        flight.run(10.0)
        assert flight.ask("land") == ""
    assert (Verb.LAND in flight.run(95.0)) is lands
    assert flight.at == ("LAND" if lands else "DONE")


def test_a_vehicle_left_in_offboard_is_put_on_hold_so_that_it_can_be_armed() -> None:
    flight = Flight()
    flight.flight_mode, flight.armable = FlightMode.EXTERNAL, False
    assert flight.run(3.0).count(Verb.HOLD) == 3
    assert "EXTERNAL" in flight.mission.waits_for
    flight.flight_mode, flight.armable = FlightMode.HOLD, True
    assert Verb.ARM in flight.run(0.3)
    armed = Flight()
    armed.flight_mode, armed.armable, armed.armed = FlightMode.EXTERNAL, False, True
    assert armed.run(3.0) == [], "another pilot controls it"


@pytest.mark.parametrize("phase", [Phase.GOTO_LAND, Phase.LAND, Phase.DONE])
def test_an_agent_waiting_for_the_beginning_goes_home_when_a_peer_gives_up(phase: Phase) -> None:
    flight = Flight().until(Phase.READY)
    flight.peer(phase)
    flight.run(0.3)
    assert flight.phase in (Phase.GOTO_LAND, Phase.LAND), "it stands on its landing place already"
    assert "gave up" in flight.mission.outcome


def test_an_operator_holds_it_where_it_waits_for_the_beginning_also_when_a_peer_gives_up() -> None:
    flight = Flight().until(Phase.READY)
    assert flight.ask("hold") == ""
    flight.peer(Phase.GOTO_LAND)
    flight.run(5.0)
    assert flight.at == "READY"
    assert flight.ask("resume") == ""
    flight.run(0.2)
    assert flight.phase >= Phase.GOTO_LAND


@pytest.mark.parametrize("phase", [Phase.GOTO_START, Phase.READY, Phase.TRACK])
def test_an_agent_that_is_cut_off_from_its_peers_lands_where_it_is(phase: Phase) -> None:
    flight = Flight().until(phase)
    flight.cut_off = "cut off from agent-1"
    flight.run(0.2)
    assert flight.phase >= Phase.GOTO_LAND
    assert flight.mission.outcome == "cut off from agent-1"


# -- while peers are silent --------------------------------------------------------------------------------------------


def paused(speed_m_s: float = 0.0, missed_01: float = 0.0) -> Flight:
    """Return a flight in the mission, 5 m from its start, that hears nobody any more."""
    flight = controlled(Phase.TRACK)
    flight.missed_01 = missed_01
    flight.pos, flight.vel = START + np.array([5.0, 0.0, 0.0]), np.array([speed_m_s, 0.0, 0.0])
    flight.failsafe_mode, flight.unresponsive_peer = Mode.TRACKING, True
    flight.run(0.1)
    return flight


def comes_to(flight: Flight) -> np.ndarray:
    return np.asarray(flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))[0][0])


@pytest.mark.parametrize("why", ["rtl", "battery"])
def test_who_has_to_fly_back_rests_until_peers_are_heard(why: str) -> None:
    flight = paused()
    if why == "rtl":
        assert flight.ask("rtl") == ""
    else:
        flight.escalation = Escalation(Response.RTL, "battery at 15 %")
    flight.run(1.0)
    assert (flight.at, flight.mission.landing.in_place) == ("GOTO_LAND", False)
    np.testing.assert_allclose(comes_to(flight), flight.pos)
    flight.unresponsive_peer = False
    flight.run(0.1)
    np.testing.assert_allclose(comes_to(flight), START)


def test_who_has_to_fly_back_and_hears_nobody_lands_where_it_rests() -> None:
    flight = paused()
    assert flight.ask("rtl") == ""
    assert Verb.LAND not in flight.run(20.0)
    assert Verb.LAND in flight.run(10.0)


@pytest.mark.parametrize("verb", ["hold", "land", "rtl"])
def test_an_order_does_not_make_the_stop_of_a_pause_softer(verb: str) -> None:
    flight = paused(speed_m_s=2.0)
    assert flight.ask(verb) == ""
    flight.run(0.1)
    np.testing.assert_allclose(comes_to(flight) - flight.pos, [1.0, 0.0, 0.0])  # at 2 m/s2


def test_who_misses_deadlines_does_not_stop_harder_than_it_can() -> None:
    flight = paused(speed_m_s=1.2, missed_01=0.5)
    np.testing.assert_allclose(comes_to(flight) - START, [6.2, 0.0, 0.0])  # at half of accel_m_s2


def test_who_rests_for_silent_peers_stays_where_it_has_been_driven_to() -> None:
    flight = paused()
    flight.run(1.0)
    for away_m, follows in ((0.2, False), (1.0, True)):
        flight.pos = START + np.array([5.0, away_m, 0.0])
        flight.run(0.2)
        assert np.allclose(comes_to(flight), flight.pos) == follows
