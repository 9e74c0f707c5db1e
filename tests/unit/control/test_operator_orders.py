"""The matrix of verbs and phases: each verb has its effect in its phases, and is refused with a reason in others."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from swarmctl.control.phases.mission_state import TAKEN_OVER
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP, ORDERS, outcome_of
from swarmctl.control.phases.trajectories import OfferedMission
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.flight_volume import FlightVolume, VolumeParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import BEGIN, EXCLUDE, FAR_M, GOTO, MISSION, OPERATOR_VERBS, Order, order_problem
from swarmctl.core.types import Array, FlightMode, Landed, Mode, Phase, Verb
from tests.benches.state_machine_flight import IN_AIR, START, Flight, controlled, in_phase

ABOUT_THE_VEHICLE = [name for name in OPERATOR_VERBS if name != EXCLUDE]
AIRBORNE = (Phase.TAKEOFF, Phase.GOTO_START, Phase.READY, Phase.TRACK, Phase.GOTO_LAND)
LONG_S = 120.0  # past every timeout


def place(flight: Flight, after_s: float = 60.0) -> Array:
    """Return the reference `after_s` from now."""
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([after_s]))
    return pos.ravel()


def is_held(flight: Flight) -> bool:
    """Whether it stays in its phase and place past every timeout, and only the autopilot's hold is asked for."""
    before, asked = flight.phase, set(flight.run(5.0))
    allowed = {Verb.HOLD} if before is Phase.TAKEOFF else set()
    if before is Phase.TAKEOFF:
        flight.flight_mode = FlightMode.HOLD  # as asked
    asked |= set(flight.run(LONG_S))
    went_on = flight.phase is not before and (before, flight.phase) != (Phase.READY, Phase.TRACK)
    rests = before is Phase.TAKEOFF or np.linalg.norm(place(flight) - flight.pos) < 1.0
    return flight.mission.held and asked <= allowed and not went_on and bool(rests)


def goes_on(flight: Flight) -> bool:
    """Whether nothing holds it."""
    return not flight.mission.held


def ends(flight: Flight) -> bool:
    """Whether it is on its way to land, or has landed."""
    return flight.phase >= Phase.GOTO_LAND and flight.mission.outcome in (OPERATOR_STOP, "completed")


def goes_there(flight: Flight) -> bool:
    """Whether it is on its way to the point, and stays there past every timeout."""
    flight.run(LONG_S)
    return flight.mission.held and bool(np.allclose(place(flight), THERE))


def flies_it(flight: Flight) -> bool:
    """Whether it flies the mission that is offered, to its end, and no other."""
    if flight.phase is Phase.TRACK:
        pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([OFFERED.duration_s - 0.1]))
    else:
        pos = flight.mission.mission_reference.sample(np.array([OFFERED.duration_s]))[0]
    return bool(np.allclose(pos.ravel(), ELSEWHERE)) and flight.mission.duration_us == OFFERED.duration_s * 1e6


ELSEWHERE = (9.0, 9.0, -3.0)
OFFERED = OfferedMission(
    reference=MissionReference(
        MissionParams.model_validate({"kind": "goto", "goto": {"goals_ned_m": [ELSEWHERE], "goal_assignment": False}}),
        np.array([START]),
        0,
    ),
    duration_s=77.0,
    text="",
)
THERE = np.array([3.0, -2.0, -4.0])
POINT = dict(zip(("north_m", "east_m", "down_m"), THERE.tolist(), strict=True))
ARGUMENTS: dict[str, dict[str, float]] = {GOTO: POINT, MISSION: {MISSION: 1.0, BEGIN: 0.0}}
EFFECTS: dict[str, Callable[[Flight], bool]] = {
    "hold": is_held,
    "resume": goes_on,
    "land": ends,
    "rtl": ends,
    GOTO: goes_there,
    MISSION: flies_it,
}


@pytest.mark.parametrize("phase", Phase, ids=lambda phase: phase.name)
@pytest.mark.parametrize("verb", ABOUT_THE_VEHICLE)
def test_each_verb_in_each_phase_has_its_effect_or_is_refused_with_a_reason(verb: str, phase: Phase) -> None:
    flight = in_phase(phase)
    mission = flight.mission
    mission.offered = OFFERED
    before = mission.phase, mission.held, mission.outcome
    arguments = dict(ARGUMENTS.get(verb, {}))
    if BEGIN in arguments:
        arguments[BEGIN] = flight.utc_us * 1e-6
    refusal = flight.ask(verb, **arguments)
    if phase.name in OPERATOR_VERBS[verb].phases:
        assert refusal == ""
        assert EFFECTS[verb](flight)
    else:
        assert refusal.startswith(f"it is in {phase.name}; {verb} is obeyed in ")
        assert (mission.phase, mission.held, mission.outcome) == before


@pytest.mark.parametrize("sinks_m_s", [0.2, 1.5])
def test_a_mission_is_refused_into_which_a_vehicle_would_sink_too_near_to_the_ground(sinks_m_s: float) -> None:
    flight = controlled(Phase.TRACK)
    flight.mission.offered = OFFERED
    flight.pos, flight.vel = np.array([1.0, 0.0, -0.5]), np.array([0.0, 0.0, sinks_m_s])
    refusal = flight.ask(MISSION, **{MISSION: 1.0, BEGIN: flight.utc_us * 1e-6})
    assert ("the way into the mission leads down to z = " in refusal) is (sinks_m_s > 1.0)


def test_every_verb_about_the_vehicle_is_a_stop_or_handled() -> None:
    assert {name for name in ABOUT_THE_VEHICLE if not OPERATOR_VERBS[name].is_stop} == ORDERS.keys()


def test_verbs_of_flight_are_obeyed_wherever_the_agent_decides_and_nothing_interrupts_a_landing() -> None:
    names = {phase.name for phase in Phase}
    for name in ABOUT_THE_VEHICLE:
        assert OPERATOR_VERBS[name].phases <= names
        assert "LAND" not in OPERATOR_VERBS[name].phases or name in ("land", "resume")
    for name in ("hold", "resume", "land", "rtl"):
        assert {phase.name for phase in AIRBORNE} <= OPERATOR_VERBS[name].phases


@pytest.mark.parametrize("phase", AIRBORNE, ids=lambda phase: phase.name)
@pytest.mark.parametrize("verb", ["hold", "resume"])
def test_without_a_vehicle_state_what_needs_one_is_refused(verb: str, phase: Phase) -> None:
    flight = in_phase(phase)
    flight.seen = False
    assert flight.ask(verb) == "nothing is known of its vehicle now"


@pytest.mark.parametrize("verb", ["hold", "land", "rtl"])
def test_a_vehicle_that_its_pilot_flies_refuses_all_but_resume(verb: str) -> None:
    flight = controlled(Phase.TRACK)
    flight.failsafe_mode, flight.flight_mode = Mode.PILOT_OVERRIDE, FlightMode.MANUAL
    flight.run(0.5)
    assert "has taken over and flies it in MANUAL; take it back with: resume" in flight.ask(verb)
    assert (flight.phase, flight.mission.outcome) == (Phase.TRACK, TAKEN_OVER)
    assert flight.ask("resume") == ""
    assert not flight.mission.pilot_override


def test_a_climb_that_a_pilot_flies_is_not_held() -> None:
    flight = in_phase(Phase.TAKEOFF)
    flight.flight_mode = FlightMode.MANUAL
    assert flight.ask("hold") == "its pilot or autopilot flies it in MANUAL"
    assert Verb.HOLD not in flight.run(3.0)


def test_a_hold_on_the_way_up_is_asked_of_the_autopilot_at_once_and_ends_at_the_start() -> None:
    flight = in_phase(Phase.TAKEOFF)
    flight.ask("hold")
    assert flight.run(0.1) == [Verb.HOLD]
    flight.flight_mode = FlightMode.HOLD
    assert flight.run(LONG_S) == []
    assert flight.at == "TAKEOFF"
    assert flight.ask("resume") == ""
    flight.run(0.2)
    assert flight.at == "GOTO_START"
    flight.flight_mode = FlightMode.EXTERNAL
    flight.pos = START + np.array([2.0, 0.0, 1.5])
    flight.run(0.1)
    np.testing.assert_allclose(place(flight), START + np.array([2.0, 0.0, 0.0]), atol=1e-9)  # first up
    flight.pos = START + np.array([2.0, 0.0, 0.0])
    flight.run(0.2)
    np.testing.assert_allclose(place(flight), START, atol=1e-9)
    flight.pos = START.copy()
    flight.run(0.1)
    assert flight.at == "READY"


def test_a_hold_just_after_another_request_does_not_wait_for_its_repetition() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    assert flight.run(0.1) == [Verb.TAKEOFF]
    flight.pos, flight.landed, flight.flight_mode = START + np.array([0.0, 0.0, 2.0]), IN_AIR, FlightMode.TAKEOFF
    flight.ask("hold")
    assert flight.run(0.1) == [Verb.HOLD]


def test_a_hold_before_the_climb_keeps_it_on_the_ground() -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.ask("hold")
    assert Verb.TAKEOFF not in flight.run(LONG_S)
    flight.ask("resume")
    assert flight.run(0.1) == [Verb.TAKEOFF]
    assert not flight.mission.climb.cut_short
    guided = Flight()
    guided.arm_in = FlightMode.EXTERNAL
    guided.until(Phase.TAKEOFF)
    guided.ask("hold")
    guided.flight_mode = FlightMode.HOLD
    guided.ask("resume")
    assert guided.run(0.1) == [Verb.EXTERNAL], "ArduCopter takes off in GUIDED only"


@pytest.mark.parametrize("phase", [Phase.GOTO_START, Phase.READY, Phase.GOTO_LAND], ids=lambda phase: phase.name)
def test_resume_goes_on_to_where_the_transit_led(phase: Phase) -> None:
    flight = controlled(phase)
    if phase is not Phase.READY:
        flight.pos = START + np.array([2.0, 0.0, 0.0])
    flight.ask("hold")
    assert np.linalg.norm(place(flight) - flight.pos) < 1e-9
    flight.run(LONG_S)
    flight.unresponsive_peer = True  # a pause during the hold ends at the same place
    flight.run(0.3)
    flight.unresponsive_peer = False
    flight.run(0.3)
    assert np.linalg.norm(place(flight) - flight.pos) < 1e-9
    assert flight.ask("resume") == ""
    if flight.phase is not Phase.TRACK:  # from READY the mission has begun meanwhile
        np.testing.assert_allclose(place(flight), START, atol=1e-9)


def test_a_hold_while_waiting_for_the_others_holds_when_the_mission_begins() -> None:
    flight = controlled(Phase.READY)
    flight.ask("hold")
    flight.until(Phase.TRACK)
    flight.run(3.0)
    np.testing.assert_allclose(place(flight), START, atol=1e-9)
    assert flight.mission.held


@pytest.mark.parametrize("verb", ["land", "rtl"])
@pytest.mark.parametrize("phase", AIRBORNE, ids=lambda phase: phase.name)
def test_a_stop_ends_a_hold_in_every_phase(phase: Phase, verb: str) -> None:
    flight = in_phase(phase)
    flight.ask("hold")
    flight.run(1.0)
    assert flight.ask(verb) == ""
    assert not flight.mission.held
    assert flight.phase >= Phase.GOTO_LAND


def test_a_stop_is_sticky_held_and_resumed_it_goes_on_to_land() -> None:
    flight = controlled(Phase.TRACK)
    flight.ask("land")
    flight.ask("hold")
    flight.run(LONG_S)
    assert flight.at == "GOTO_LAND"
    assert "landing where it is" in flight.ask("rtl")
    flight.ask("resume")
    assert Verb.LAND in flight.run(10.0)


def test_what_must_not_wait_ends_a_hold_on_the_way_to_land() -> None:
    flight = controlled(Phase.GOTO_LAND)
    flight.ask("hold")
    flight.cut_off = "cut off from agent-1"
    flight.run(0.2)
    assert not flight.mission.held


def test_a_stop_of_what_has_landed_is_done_already_but_not_of_what_was_handed_back_in_the_air() -> None:
    flight = in_phase(Phase.DONE)
    for verb in ("land", "rtl"):
        assert flight.ask(verb) == ""
    flight.landed = IN_AIR
    for verb in ("land", "rtl"):
        assert "in the air" in flight.ask(verb)


def test_only_who_was_sent_home_is_shown_as_such() -> None:
    """On its way to its landing place after the mission it returns; nobody has said `rtl`."""
    flights = {"": in_phase(Phase.GOTO_LAND), "rtl": controlled(Phase.TRACK)}
    for verb, flight in flights.items():
        assert not verb or flight.ask(verb) == ""
        flight.until(Phase.GOTO_LAND)
    shown = {verb: flight.mission.control_mode(Mode.TRACKING).name for verb, flight in flights.items()}
    assert shown == {"": "RETURN", "rtl": "RTL"}


def test_the_time_of_a_hold_does_not_count_as_time_to_the_start() -> None:
    flight = Flight(start_timeout_s=20.0)
    flight.until(Phase.TAKEOFF)
    flight.pos, flight.landed, flight.flight_mode = START + np.array([0.0, 0.0, 1.0]), Landed.IN_AIR, FlightMode.HOLD
    flight.ask("hold")
    flight.run(LONG_S)
    flight.ask("resume")
    flight.run(5.0)
    assert flight.phase in (Phase.GOTO_START, Phase.READY)


@pytest.mark.parametrize("phase", [Phase.GOTO_START, Phase.READY, Phase.TRACK], ids=lambda phase: phase.name)
def test_a_pause_on_the_way_to_a_point_goes_on_to_it_and_hold_stops_it(phase: Phase) -> None:
    flight = controlled(phase)
    assert flight.ask(GOTO, **POINT, speed_m_s=1.0, yaw_deg=90.0) == ""
    assert flight.mission.yaw_rad == pytest.approx(np.pi / 2)
    flight.unresponsive_peer = True
    flight.run(0.5)
    assert np.linalg.norm(place(flight) - flight.pos) < 1e-9
    assert "rests" in flight.ask(GOTO, **POINT)
    flight.unresponsive_peer = False
    flight.run(0.5)
    np.testing.assert_allclose(place(flight), THERE)
    assert flight.ask("hold") == ""
    assert np.linalg.norm(place(flight) - flight.pos) < 1e-9
    flight.unresponsive_peer = True
    flight.run(0.5)
    flight.unresponsive_peer = False
    flight.run(0.5)
    assert np.linalg.norm(place(flight) - flight.pos) < 1e-9
    assert flight.mission.yaw_rad is None


def test_the_speed_of_a_goto_is_its_peak_speed() -> None:
    flight = controlled(Phase.TRACK)
    for speed_m_s in (0.5, 1.5):
        flight.ask(GOTO, north_m=float(flight.pos[0]) + 30.0, east_m=0.0, down_m=-4.0, speed_m_s=speed_m_s)
        _, vel = flight.mission.reference(flight.utc_us, flight.now_us, np.linspace(0.0, 150.0, 1000))
        assert np.linalg.norm(vel, axis=1).max() == pytest.approx(speed_m_s, rel=0.02)


@pytest.mark.parametrize("verb", ["land", "rtl"])
def test_a_stop_ends_a_goto_and_none_begins_after_one(verb: str) -> None:
    flight = controlled(Phase.TRACK)
    flight.pos = START + np.array([2.0, 0.0, 0.0])
    flight.ask(GOTO, **POINT, yaw_deg=10.0)
    assert flight.ask(verb) == ""
    assert flight.mission.yaw_rad is None
    assert "GOTO_LAND" in flight.ask(GOTO, **POINT)


def test_a_point_in_the_ground_or_a_way_out_of_the_fence_is_refused() -> None:
    flight = controlled(Phase.TRACK)
    assert "too low: -0.50 at most" in flight.ask(GOTO, **POINT | {"down_m": -0.4})
    assert flight.ask(GOTO, **POINT | {"down_m": -0.6}) == ""
    fenced = controlled(Phase.TRACK)
    fenced.mission.contains = lambda at_ne_m: not 4.0 < at_ne_m[0] < 6.0  # the straight way north leaves it
    assert fenced.ask(GOTO, **POINT | {"north_m": 3.9}) == ""
    held_at = place(fenced)
    for north_m in (5.0, 9.0):
        assert "outside of the geofence" in fenced.ask(GOTO, **POINT | {"north_m": north_m})
    np.testing.assert_allclose(place(fenced), held_at)


def test_a_point_far_away_is_flown_to_only_if_that_is_said() -> None:
    flight = controlled(Phase.TRACK)
    held_at = place(flight)
    away = POINT | {"north_m": float(flight.pos[0]) + FAR_M + 1.0}
    assert flight.ask(GOTO, **away).endswith(" is 501 m away; beyond 500 m say --far")
    assert flight.ask(GOTO, **away, far=0.0)
    np.testing.assert_allclose(place(flight), held_at)
    assert flight.ask(GOTO, **POINT | {"north_m": float(flight.pos[0]) + FAR_M - 1.0}) == ""
    assert flight.ask(GOTO, **away, far=1.0) == ""
    np.testing.assert_allclose(place(flight, after_s=3000.0), list(away.values()))


def test_what_a_goto_comes_to_is_said_and_of_other_orders_nothing() -> None:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.vel = np.array([3.0, -2.0, -2.0]), np.zeros(3)
    flight.ask(GOTO, **POINT)
    assert outcome_of(Order(GOTO, POINT), flight.mission) == "flies to 3, -2, -4: 2.0 m, 3 s"
    flight.ask(GOTO, **POINT | {"north_m": 403.0}, speed_m_s=1.0)
    assert outcome_of(Order(GOTO, POINT), flight.mission) == "flies to 403, -2, -4: 400 m, 7 min"
    assert outcome_of(Order("hold"), flight.mission) == ""


def test_a_point_outside_of_the_flight_volume_is_refused_with_its_reason() -> None:
    flight = controlled(Phase.TRACK)
    held_at = place(flight)
    corners = ((-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0))
    flight.mission.volume = FlightVolume(VolumeParams(corners_ne_m=corners, floor_z_m=-1.0, ceiling_z_m=-6.0))
    for changed, face in (({"north_m": 4.9}, "side"), ({"down_m": -8.0}, "ceiling"), ({"down_m": -1.2}, "floor")):
        refusal = flight.ask(GOTO, **POINT | changed)
        assert "outside of the flight volume less volume.margin_m = 0.3" in refusal
        assert face in refusal
    np.testing.assert_allclose(place(flight), held_at)
    assert flight.ask(GOTO, **POINT | {"north_m": 4.6}) == ""


def test_a_point_in_the_keep_out_of_an_obstacle_is_refused_with_its_number() -> None:
    flight = controlled(Phase.TRACK)
    held_at = place(flight)
    ball = Obstacle(center_ned_m=(3.0, -2.0, -5.0), keep_out_m=1.75)
    flight.obstacles = (ball.model_copy(update={"center_ned_m": (50.0, 0.0, 0.0)}), ball)
    said = "3, -2, -4 is in the keep-out of obstacle 1, 1.00 m from its centre (keep_out_m = 1.75)"
    assert flight.ask(GOTO, **POINT).startswith(said)
    np.testing.assert_allclose(place(flight), held_at)
    assert flight.ask(GOTO, **POINT | {"down_m": -3.2}) == ""
    flight.obstacles = (ball.model_copy(update={"column": True}),)
    assert "2.00" not in (refusal := flight.ask(GOTO, **POINT | {"down_m": -3.2})), refusal
    assert "0.00 m from its axis" in refusal


def test_where_the_ground_is_unknown_nothing_lower_than_the_start_is_flown_to() -> None:
    flight = controlled(Phase.TRACK)
    flight.mission.airborne = True
    assert "too low: -3.00 at most" in flight.ask(GOTO, **POINT | {"down_m": -2.9})


def test_before_it_has_control_nothing_is_flown_to() -> None:
    flight = Flight().until(Phase.GOTO_START)
    assert flight.ask(GOTO, **POINT) == "its autopilot still flies it"


def test_optional_arguments_may_be_left_out_and_no_others() -> None:
    assert order_problem(GOTO, POINT) == ""
    assert order_problem(GOTO, POINT | {"yaw_deg": 90.0, "speed_m_s": 2.0}) == ""
    assert "allowed: 0.1 to 20" in order_problem(GOTO, POINT | {"speed_m_s": 0.0})
    assert "goto takes north_m" in order_problem(GOTO, {"north_m": 1.0, "yaw_deg": 90.0})
    assert "goto takes north_m" in order_problem(GOTO, POINT | {"height_m": 1.0})
    assert "nan" in order_problem(GOTO, POINT | {"east_m": float("nan")})


def test_what_is_no_order_is_named() -> None:
    assert order_problem("hold", {}) == ""
    assert order_problem("fly", {}) == f"'fly' is no verb; known are {', '.join(OPERATOR_VERBS)}"
    assert order_problem("hold", {"height_m": 1.0}) == "hold takes no arguments"


def test_it_is_known_when_the_mission_or_what_precedes_it_ends_unless_it_is_held() -> None:
    flight = controlled(Phase.TRACK)
    mission = flight.mission
    left_s = mission.ends_in_s(flight.now_us, flight.utc_us)
    assert left_s == pytest.approx(mission.duration_us * 1e-6 - mission.mission_t_s(flight.utc_us))
    flight.run(1.0)
    assert mission.ends_in_s(flight.now_us, flight.utc_us) == pytest.approx(left_s - 1.0)
    flight.ask("hold")
    assert math.isnan(mission.ends_in_s(flight.now_us, flight.utc_us))
    flight = controlled(Phase.GOTO_START)
    patience_s = flight.mission.params.start_timeout_s
    assert 0.0 < flight.mission.ends_in_s(flight.now_us, flight.utc_us) < patience_s
