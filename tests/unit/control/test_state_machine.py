"""Tests of the mission state machine up to the common beginning: requests to the autopilot and their times."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.phases.inputs import PeerInputs
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Command, FlightMode, Mode, Phase, Verb
from tests.benches.state_machine_flight import IN_AIR, SECOND, START, UTC0_US, Flight, ready

# -- transit to the start ---------------------------------------------------------------------------------------------


def test_a_whole_flight_requests_each_command_once_and_in_order() -> None:
    flight, asked = Flight(), []
    phases: list[Phase] = []
    for _ in range(600):
        commands = flight.step()
        asked += [c.verb for c in commands if c.verb not in (Verb.RATE, Verb.MESSAGE, Verb.PARAM_INT, Verb.PARAM_FLOAT)]
        flight._obey(commands)
        if not phases or phases[-1] is not flight.phase:
            phases.append(flight.phase)
    assert asked == [Verb.ARM, Verb.TAKEOFF, Verb.EXTERNAL, Verb.LAND]
    assert phases == list(Phase)[1:]
    assert (flight.mission.finished, flight.mission.outcome) == (True, "completed")


def test_without_a_vehicle_or_link_setup_nothing_is_requested() -> None:
    flight = Flight()
    flight.seen = flight.prepared = False
    assert flight.run(3.0) == []
    assert flight.at == "CONNECT"
    flight.seen = True
    assert flight.run(3.0) == []
    assert flight.at == "CONNECT", "peers would arm if it stood by, and it may have to refuse"
    flight.prepared = True
    assert Verb.ARM in flight.run(0.3)


@pytest.mark.parametrize("phase", [Phase.CONNECT, Phase.STANDBY, Phase.ARM])
def test_a_refusal_to_arm_ends_the_mission_with_its_reason(phase: Phase) -> None:
    flight = Flight()
    flight.prepared, flight.armable = phase is not Phase.CONNECT, phase is Phase.ARM
    flight.run(0.3)
    assert flight.phase is phase
    flight.prepared, flight.refusal = True, "COM_OBL_RC_ACT can't be read"
    assert flight.run(5.0) == []
    assert (flight.at, flight.mission.outcome) == ("DONE", "COM_OBL_RC_ACT can't be read")
    flight.refusal = ""
    assert flight.run(5.0) == []


def test_when_a_peer_gives_up_on_the_ground_no_agent_takes_off() -> None:
    flight = Flight()
    flight.peer(Phase.DONE)
    assert flight.run(5.0) == []
    assert (flight.at, flight.mission.outcome) == ("DONE", "a peer gave up before take-off")


@pytest.mark.parametrize("phase", [Phase.TRACK, Phase.GOTO_LAND, Phase.LAND])
def test_who_comes_after_the_mission_has_begun_stays_on_the_ground(phase: Phase) -> None:
    flight = Flight()
    flight.peer(phase)
    assert flight.run(5.0) == []
    assert flight.at == "DONE"
    began = phase is Phase.TRACK
    outcome = "the mission has begun without it" if began else "a peer gave up before take-off"
    assert flight.mission.outcome == outcome


def test_who_waits_says_for_whom() -> None:
    flight = Flight(peers=6)
    flight.peers = {1: PeerInputs(Phase.STANDBY, 0, True), 2: PeerInputs(Phase.CONNECT, 0, True)}
    flight.run(1.0)
    assert flight.at == "STANDBY"
    assert flight.mission.waits_for == "agent-2, agent-3, agent-4, agent-5 and 1 more to stand by"


def test_who_has_never_come_and_is_excluded_is_not_waited_for() -> None:
    flight = Flight(peers=3)
    del flight.peers[3]
    flight.run(1.0)
    assert (flight.at, flight.mission.waits_for) == ("STANDBY", "agent-3 to stand by")
    flight.excused = frozenset({3})
    flight.until(Phase.READY)
    flight.run(1.0)
    assert flight.mission.waits_for == "agent-1, agent-2 to reach the start"
    flight.peers |= dict.fromkeys((1, 2), PeerInputs(Phase.READY, flight.utc_us, True))
    flight.run(2.0)
    assert flight.at == "TRACK"


def test_arducopter_is_guided_before_it_is_armed_and_takes_off_in_that_mode() -> None:
    flight = Flight()
    flight.arm_in, flight.flight_mode = FlightMode.EXTERNAL, FlightMode.MANUAL
    flight.until(Phase.ARM)
    assert flight.run(1.0) == [Verb.EXTERNAL]
    flight.flight_mode = FlightMode.MANUAL  # STABILIZE again while it boots
    assert flight.run(1.0) == [Verb.EXTERNAL]
    flight.flight_mode = FlightMode.EXTERNAL
    assert flight.run(1.0) == [Verb.ARM]
    flight.armed = True
    assert flight.run(0.3) == [Verb.TAKEOFF]
    flight.landed, flight.vel = IN_AIR, np.array([0.0, 0.0, -1.0])
    assert flight.run(1.0) == []
    assert (flight.at, flight.mission.had_control) == ("TAKEOFF", False), "it climbs by itself"
    flight.pos, flight.vel = START.copy(), np.zeros(3)
    flight.run(0.8)
    assert not flight.mission.had_control, "its hover thrust is being learned"
    flight.run(0.5)
    assert flight.mission.had_control


@pytest.mark.parametrize("missing", ["armable", "answers", "peer", "peer alive", "peer vehicle"])
def test_no_agent_arms_before_all_stand_by(missing: str) -> None:
    flight = Flight()
    flight.armable = missing != "armable"
    flight.busy = missing == "answers"
    if missing == "peer":
        flight.peers = {}
    elif missing == "peer alive":
        flight.peer(Phase.STANDBY, alive=False)
    elif missing == "peer vehicle":
        flight.peer(Phase.CONNECT)
    assert Verb.ARM not in flight.run(5.0)
    assert flight.at == "STANDBY"
    flight.armable, flight.busy = True, False
    flight.peer(Phase.STANDBY)
    assert Verb.ARM in flight.run(0.3)


@pytest.mark.parametrize("comes", ["a peer gives up", "the mission begins", "a vehicle beside", "an obstacle above"])
def test_what_comes_after_all_have_stood_by_still_keeps_a_vehicle_from_being_armed(comes: str) -> None:
    flight = Flight().until(Phase.ARM)
    if comes == "a vehicle beside":
        flight.unsettled = "1.20 m to the next vehicle (now 0.40 m)"
    elif comes == "an obstacle above":
        flight.obstacles = (Obstacle(center_ned_m=tuple(START.tolist()), radius_m=1.0, keep_out_m=1.2),)
    else:
        flight.peer(Phase.GOTO_LAND if comes == "a peer gives up" else Phase.TRACK, UTC0_US)
    assert flight.run(5.0) == []


@pytest.mark.parametrize(("ground_z_m", "is_armed"), [(-2.4, True), (-2.6, True), (-2.8, False), (-8.0, False)])
def test_who_stands_as_high_as_its_start_is_not_armed(ground_z_m: float, is_armed: bool) -> None:
    flight = Flight(peers=0)
    flight.mission.mission_reference = MissionReference(MissionParams(kind="hover"), START[None, :], 0)
    flight.pos = np.array([1.0, 0.0, ground_z_m])
    assert (Verb.ARM in flight.run(3.0)) == is_armed
    if not is_armed:
        assert flight.phase is Phase.DONE
        assert f"its start is {3.0 + ground_z_m:.2f} m above the ground" in flight.mission.outcome


def test_arming_is_requested_once_a_second_and_never_while_a_command_is_open() -> None:
    flight = Flight().until(Phase.ARM)
    assert flight.run(3.0).count(Verb.ARM) == 3
    flight.busy = True
    assert flight.run(3.0) == []


def test_takeoff_height_is_from_the_ground_it_stands_on() -> None:
    flight = Flight()
    flight.pos = np.array([1.0, 0.0, 0.5])
    flight.until(Phase.TAKEOFF)
    (command,) = flight.step()
    assert command == Command(verb=Verb.TAKEOFF, value=3.5)


def told_to_fly_to(down_m: float) -> Flight:
    """Return a flight on the ground, at z = 0, of a mission that ends at a height, NED z."""
    flight = Flight()
    goto = {"goals_ned_m": [(10.0, 0.0, down_m)], "goal_assignment": False}
    told = MissionParams.model_validate({"kind": "goto", "goto": goto})
    flight.mission.mission_reference = MissionReference(told, START[None, :], 0)
    return flight


def test_a_mission_that_leads_below_the_place_of_the_take_off_is_not_begun() -> None:
    """The ground of real vehicles is known once they stand on it; a height was given as positive upwards."""
    flight = told_to_fly_to(2.0)
    assert Verb.ARM not in flight.run(3.0)
    assert flight.at == "DONE"
    assert "the reference is at z = 0.2" in flight.mission.outcome
    assert "below the place of the take-off at z = 0.00; give heights as NED" in flight.mission.outcome


@pytest.mark.parametrize("down_m", [-1.0, 0.0, 0.2])
def test_a_mission_that_ends_on_the_ground_as_far_as_that_is_known_is_flown(down_m: float) -> None:
    told_to_fly_to(down_m).until(Phase.TAKEOFF)


def test_takeoff_is_over_when_it_hovers_at_its_height() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.landed, flight.flight_mode, flight.pos = IN_AIR, FlightMode.TAKEOFF, START.copy()
    flight.run(1.0)
    assert flight.at == "TAKEOFF"
    flight.flight_mode, flight.vel = FlightMode.HOLD, np.array([0.0, 0.0, -0.5])
    flight.run(1.0)
    assert flight.at == "TAKEOFF"
    flight.vel, flight.pos = np.zeros(3), START + np.array([0.0, 0.0, 0.5])
    flight.run(1.0)
    assert flight.at == "TAKEOFF"
    flight.pos = START.copy()
    flight.run(0.1)
    assert flight.at == "GOTO_START"


def test_disarmed_on_the_ground_it_is_never_armed_again() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.run(0.2)
    flight.armed = False  # disarmed by a pilot, or by the autopilot after a timeout
    assert flight.run(20.0) == []
    assert flight.at == "DONE"


def test_offboard_is_not_taken_from_a_pilot_in_control() -> None:
    flight = Flight().until(Phase.GOTO_START)
    flight.flight_mode = FlightMode.MANUAL
    assert Verb.EXTERNAL not in flight.run(5.0)


def test_ready_means_at_the_start_and_at_rest() -> None:
    flight = Flight().until(Phase.GOTO_START)
    flight.flight_mode, flight.pos = FlightMode.EXTERNAL, START + np.array([0.5, 0.0, 0.0])
    flight.run(1.0)
    assert (flight.phase, flight.mission.had_control) == (Phase.GOTO_START, True)
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([-10.0, 60.0]))
    np.testing.assert_allclose(pos, [START + np.array([0.5, 0.0, 0.0]), START], atol=1e-9)
    flight.pos, flight.vel = START.copy(), np.array([0.5, 0.0, 0.0])
    flight.run(0.5)
    assert flight.at == "GOTO_START"
    flight.vel = np.zeros(3)
    ready_us = flight.utc_us
    flight.run(0.1)
    assert (flight.phase, flight.mission.ready_utc_us) == (Phase.READY, ready_us)


def test_nobody_is_ready_where_no_position_is_known() -> None:
    flight = Flight().until(Phase.GOTO_START)
    flight.flight_mode, flight.pos = FlightMode.EXTERNAL, START.copy()
    flight.failsafe_mode = Mode.STATE_STALE
    flight.run(2.0)
    assert flight.at == "GOTO_START"
    flight.failsafe_mode = Mode.TRACKING
    flight.run(0.1)
    assert flight.at == "READY"


# -- the common beginning ---------------------------------------------------------------------------------------------


def test_all_wait_for_the_last_agent_and_begin_a_second_later() -> None:
    flight = ready()
    flight.run(30.0)
    assert flight.at == "READY"
    late_us = flight.utc_us - 50_000
    flight.peer(Phase.READY, late_us)
    flight.run(0.9)
    assert (flight.phase, flight.mission.begin_utc_us) == (Phase.READY, late_us + SECOND)
    flight.run(0.2)
    assert flight.at == "TRACK"


def test_all_agents_compute_the_same_beginning() -> None:
    one, other = ready(), ready()
    one.mission.ready_utc_us, other.mission.ready_utc_us = UTC0_US + 7, UTC0_US + 99
    one.peer(Phase.READY, UTC0_US + 99)
    other.peer(Phase.TRACK, UTC0_US + 7)
    one.run(0.1)
    other.run(0.1)
    assert one.mission.begin_utc_us == other.mission.begin_utc_us == UTC0_US + 99 + SECOND


def test_one_of_two_peers_is_not_enough() -> None:
    flight = ready(2)
    flight.peer(Phase.READY, UTC0_US + 5)
    flight.run(20.0)
    assert (flight.phase, flight.mission.begin_utc_us) == (Phase.READY, None)


def test_a_peer_lost_before_the_beginning_sends_all_home() -> None:
    flight = ready()
    flight.peer(Phase.READY, 0, alive=False)
    flight.run(0.1)
    assert flight.at == "GOTO_LAND"
    assert "was lost before the mission began" in flight.mission.outcome


def test_the_reference_runs_on_the_common_clock_and_only_while_tracking() -> None:
    flight = ready()
    assert math.isnan(flight.mission.mission_t_s(flight.utc_us))
    flight.until(Phase.TRACK)
    begin_us = flight.mission.begin_utc_us
    assert begin_us is not None
    pos, vel = flight.mission.reference(begin_us + 2 * SECOND, 0, np.array([0.0, 1.0]))
    np.testing.assert_allclose(pos, [[5.0, 3.4, -2.2], [6.5, 4.1, -2.3]])
    np.testing.assert_allclose(vel, [[1.5, 0.7, -0.1]] * 2)
    assert flight.mission.mission_t_s(begin_us + 2 * SECOND) == 2.0
