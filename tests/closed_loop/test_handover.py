"""Tests of handovers between agent, autopilot and pilot; control is never retaken without a command.

Each protection is tested beside the same flight without it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from sitl.lockstep import Lockstep
from swarmctl.agent.agent import Agent
from swarmctl.config import load
from swarmctl.control.phases import handover, obeyed_orders
from swarmctl.control.phases.mission_state import TAKEN_OVER, MissionState
from swarmctl.control.phases.state_machine import REBOOTED
from swarmctl.control.reference.heading import Heading
from swarmctl.core.frames import euler_from_quat
from swarmctl.core.types import FlightMode, Mode, Phase
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.commands import CommandPort
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.transport import PipeTransport
from swarmctl.mavlink.vehicle import mode_watch, state_samples
from swarmctl.simulator_config import FaultParams
from tests.closed_loop.conftest import AT_100_HZ, COARSE, FINE, Fly, closer_than, mission_t_s

SETPOINT = 82  # SET_ATTITUDE_TARGET
SLEEP_S = 1.62  # the first tick afterwards receives a state but no mode

# four agents cross one point closely and fast, and are commanded to land there
CROSSING = (
    "swarm.agents=4",
    "start.positions_ned_m=[[3.0,0.0,0.0],[-3.0,0.1,0.0],[0.1,3.0,0.0],[0.0,-3.0,0.0]]",
    "mission.kind=swap",
    "mission.swap.travel_s=2.5",
    "mission.duration_s=12",
)
LAND_NOW: dict[float, Callable[[Lockstep], None]] = {1.3: lambda running: running.command("land")}


def test_a_landing_at_speed_among_others_brakes_and_moves_apart_first(fly: Fly) -> None:
    flight = fly(*CROSSING, at=LAND_NOW)
    assert flight.separation_m() >= 0.85
    final = flight.pos_ned_m[-1]
    apart = min(np.linalg.norm(final[i] - final[j]) for i in range(4) for j in range(i))
    assert apart >= 1.0, "on the ground: radius 0.9 and 0.2 to spare, less what the autopilot drifts while it lands"
    for agent in range(4):
        ticks = flight.ticks(agent)
        handed = ticks[int(np.argmax(ticks["phase"] == Phase.LAND))]
        assert np.linalg.norm(handed["vel_ned_m_s"]) < 0.2


def test_negative_control_an_autopilot_that_lands_at_speed_among_others_comes_too_close(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    def land_at_once(mission: MissionState, *_: object) -> None:
        if mission.stop_verb:
            mission.outcome, mission.phase = "stopped", Phase.LAND

    monkeypatch.setattr(obeyed_orders, "apply_stop", land_at_once)
    assert fly(*CROSSING, at=LAND_NOW, until=closer_than(0.75)).separation_m() < 0.75


# -- PX4 returns to OFFBOARD by itself when setpoints resume ----------------------------------------------------------

ALONE = (AT_100_HZ, "swarm.agents=1", "mission.duration_s=8")


class Watched:
    """One agent and its vehicle; records when setpoints leave and when the vehicle is armed in OFFBOARD."""

    def __init__(self, *overrides: str) -> None:
        self.run = Lockstep(load(None, (*ALONE, *overrides)))
        self.setpoints_us: list[int] = []
        self.offboard_us: list[int] = []
        self._listen()

    @property
    def now_us(self) -> int:
        return self.run.clock.now_us()

    @property
    def agent(self) -> Agent:
        agent = self.run.agents[0]
        assert agent is not None
        return agent

    def step_for(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds * self.run.config.agent.rate_hz))):
            self.run.step()
            truth = self.run.world.truth_rows()[0]
            if truth["armed"] and truth["flight_mode"] == FlightMode.EXTERNAL:
                self.offboard_us.append(self.now_us)

    def until_mission(self, t_s: float) -> Watched:
        while mission_t_s(self.run) < t_s:
            self.step_for(0.02)
            assert self.now_us < 60_000_000
        return self

    def restart_agent(self) -> None:
        """Start a new agent process beside the same vehicle."""
        self.run.agents[0] = self.run._agent(0)

    def _listen(self) -> None:
        link = self.run.links[0][0]

        def send(data: bytes) -> None:
            self.setpoints_us += [self.now_us for frame in frames(data) if message_id(frame) == SETPOINT]
            PipeTransport.send(link, data)

        link.send = send  # type: ignore[method-assign]


def asleep_past_the_loss() -> Watched:
    """Stop the agent's process; its socket keeps half a second of datagrams and drops the rest, as UDP does."""
    flight = Watched().until_mission(2.0)
    ours, vehicles = flight.run.links[0]
    flight.run.frozen.add(0)

    def send(data: bytes) -> None:
        if 0 not in flight.run.frozen or len(ours._inbox) < 75:
            PipeTransport.send(vehicles, data)

    vehicles.send = send  # type: ignore[method-assign]
    flight.step_for(SLEEP_S)
    flight.setpoints_us.clear()
    flight.offboard_us.clear()
    flight.run.frozen.discard(0)
    flight.step_for(3.0)
    return flight


def test_an_agent_stopped_past_the_loss_does_not_retake_control() -> None:
    flight = asleep_past_the_loss()
    assert flight.setpoints_us == flight.offboard_us == []
    assert flight.agent.outcome.startswith("overload: setpoints stopped")


def test_negative_control_without_doubting_the_mode_it_returns_to_offboard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mode_watch, "_GAP_US", 10**12)
    flight = asleep_past_the_loss()
    assert flight.setpoints_us
    assert flight.offboard_us


def restarted_while_the_autopilot_flies_home(switched_off: Callable[[], None] = lambda: None) -> Watched:
    """Use PX4's default action for the loss of setpoints."""
    flight = Watched("agent.autopilot_params.COM_OBL_RC_ACT=3").until_mission(3.0)
    switched_off()
    flight.run.kill(0)
    flight.step_for(1.5)
    assert flight.run.world.truth_rows()[0]["flight_mode"] == FlightMode.RTL
    flight.offboard_us.clear()
    flight.setpoints_us.clear()
    flight.restart_agent()
    flight.step_for(4.0)  # until it has shown that it keeps up
    return flight


def test_a_restarted_agent_leaves_control_to_an_active_failsafe() -> None:
    flight = restarted_while_the_autopilot_flies_home()
    assert flight.setpoints_us == flight.offboard_us == []
    flight.run.command("resume")  # the operator's explicit command
    flight.step_for(1.0)
    assert flight.setpoints_us
    assert flight.offboard_us


def test_negative_control_streaming_to_a_vehicle_that_is_not_ours_takes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def switch_off() -> None:
        monkeypatch.setattr(handover, "is_under_other_control", lambda state: False)
        monkeypatch.setattr(handover, "request_control", lambda *_, **__: [])  # streaming is enough

    flight = restarted_while_the_autopilot_flies_home(switch_off)
    assert flight.setpoints_us
    assert flight.offboard_us


def test_after_a_reboot_in_flight_nothing_is_armed_again_and_the_outcome_says_why() -> None:
    flight = Watched().until_mission(2.0)
    asked_before = len(flight.run.logs[0].events)
    flight.setpoints_us.clear()
    flight.run.world.reboot(0, flight.now_us)
    flight.step_for(12.0)
    since = flight.run.logs[0].events[asked_before:]
    verbs = [event["verb"] for event in since if event["event"] == "command"]
    assert not {"arm", "external", "takeoff"} & set(verbs)
    assert {"rate ODOMETRY", "param_int COM_OBL_RC_ACT", "message GPS_GLOBAL_ORIGIN"} <= set(verbs), (
        "set up again, or set back"
    )
    assert (flight.agent.finished, flight.agent.outcome) == (True, REBOOTED)


# -- A request whose answer is lost is repeated, but not against a pilot -----------------------------------------------

ACK = 77  # COMMAND_ACK


def taken_while_a_request_is_unanswered() -> Watched:
    """The vehicle obeys the request for control, its answer is lost, and a ground station takes it at once."""
    flight = Watched("sitl.start=air")
    vehicles = flight.run.links[0][1]

    def send(data: bytes) -> None:
        kept = [frame for frame in frames(data) if message_id(frame) != ACK or flight.agent._mission.phase < Phase.ARM]
        if kept:
            PipeTransport.send(vehicles, b"".join(kept))

    vehicles.send = send  # type: ignore[method-assign]
    while not flight.offboard_us:
        flight.step_for(0.02)
        assert flight.now_us < 60_000_000
    hold = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1.0, 4.0, 3.0, 0, 0, 0, 0)
    PipeTransport.send(flight.run.links[0][0], Codec(255, 190).encode(hold))
    flight.step_for(0.1)
    flight.offboard_us.clear()
    flight.step_for(3.0)
    return flight


def test_control_is_not_asked_for_again_once_somebody_else_has_taken_it() -> None:
    flight = taken_while_a_request_is_unanswered()
    assert flight.offboard_us == []
    assert flight.agent.outcome == TAKEN_OVER


def test_negative_control_a_repeated_request_takes_the_vehicle_from_its_pilot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommandPort, "withdraw", lambda *_: None)
    assert taken_while_a_request_is_unanswered().offboard_us


# -- ArduCopter -------------------------------------------------------------------------------------------------------

COPTER = (
    "sitl.autopilot_kind=arducopter",
    "agent.autopilot_params={GUID_OPTIONS=8, FS_GCS_ENABLE=5, FS_GCS_TIMEOUT=2.0, ATC_ANGLE_BOOST=0}",
)


def test_arducopter_is_flown_in_its_own_dialect_until_a_pilot_chooses_another_mode() -> None:
    flight = Watched(*COPTER).until_mission(4.0)
    ticks = flight.run.logs[0].ticks
    ready = ticks[ticks["phase"] == Phase.READY]
    assert np.abs(ready["pos_ned_m"][:, 2]).max() < 0.2, "the hover thrust was learned before: no sag"
    assert ready["hover_thrust_01"][0] == pytest.approx(0.49, abs=0.02), "of the plant; its parameter says 0.39"
    loiter = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1.0, 5.0, 0, 0, 0, 0, 0)
    PipeTransport.send(flight.run.links[0][0], Codec(255, 190).encode(loiter))
    flight.step_for(0.5)
    flight.setpoints_us.clear()
    flight.step_for(4.0)
    assert flight.setpoints_us == []
    assert flight.agent.outcome == TAKEN_OVER
    flight.run.command("resume")
    flight.step_for(1.5)
    assert flight.setpoints_us
    while not flight.agent.finished and flight.now_us < 90_000_000:
        flight.run.step()
    assert (flight.agent.finished, flight.agent.outcome) == (True, "completed")


def given_back_and_never_obeyed() -> tuple[Watched, list[int]]:
    """A flight whose autopilot hears no request for another mode since `resume`, and when these were sent."""
    flight = Watched(*COPTER, *COARSE).until_mission(4.0)
    loiter = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1.0, 5.0, 0, 0, 0, 0, 0)
    link, reader, asked_us = flight.run.links[0][0], Codec(255, 190), list[int]()
    PipeTransport.send(link, reader.encode(loiter))
    flight.step_for(0.5)

    def send(data: bytes) -> None:
        for frame in frames(data):
            message = reader.decode(frame)
            flight.setpoints_us += [flight.now_us] if message_id(frame) == SETPOINT else []
            if message is not None and message.get_type() == "COMMAND_LONG" and message.command == loiter.command:
                asked_us.append(flight.now_us)
            else:
                PipeTransport.send(link, frame)

    link.send = send  # type: ignore[method-assign]
    flight.run.command("resume")
    flight.step_for(3.0)
    flight.run.command("rtl")
    flight.step_for(42.0)
    return flight, asked_us


def test_an_autopilot_that_never_follows_again_keeps_the_vehicle_until_another_resume() -> None:
    flight, asked_us = given_back_and_never_obeyed()
    assert 28e6 < asked_us[-1] - asked_us[0] < 31e6
    assert flight.setpoints_us[-1] - asked_us[-1] < 2_000_000, "PX4 would follow setpoints without being asked"
    assert flight.agent.outcome == "no control 30 s after resume: it stays in HOLD"
    del flight.run.links[0][0].send  # now it hears them
    flight.run.command("resume")
    flight.step_for(40.0)
    assert (flight.agent.finished, flight.agent.outcome) == (True, "stopped by the operator")
    assert np.linalg.norm(flight.run.world.truth_rows()[0]["pos_ned_m"][:2]) < 0.3, "flown home, as was ordered"


def test_negative_control_without_an_end_it_is_asked_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MissionState, "asks_in_vain", lambda *_: False)
    flight, asked_us = given_back_and_never_obeyed()
    assert asked_us[-1] - asked_us[0] > 42e6
    assert flight.setpoints_us[-1] - asked_us[0] > 42e6


def without_attitudes() -> tuple[Watched, int]:
    """A flight whose vehicle has stopped to send its attitude 1.5 s ago, and when it did."""
    flight = Watched(*COPTER).until_mission(4.0)
    stop = mavlink.MAVLink_command_long_message(
        1, 1, 511, 0, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, -1.0, *[0.0] * 5
    )
    PipeTransport.send(flight.run.links[0][0], Codec(255, 190).encode(stop))
    stopped_us = flight.now_us
    flight.setpoints_us.clear()
    flight.step_for(1.5)
    return flight, stopped_us


def test_no_setpoint_is_made_from_an_old_attitude_of_an_arducopter_and_new_ones_are_asked_for() -> None:
    flight, stopped_us = without_attitudes()
    assert 0.2 < (flight.setpoints_us[-1] - stopped_us) * 1e-6 < 0.35, "0.1 s from position to attitude, 0.2 s old"
    asked_before = len(flight.run.logs[0].events)
    flight.step_for(4.0)
    asked = [event["verb"] for event in flight.run.logs[0].events[asked_before:] if event["event"] == "command"]
    assert "rate ATTITUDE_QUATERNION" in asked


def test_negative_control_with_an_attitude_of_any_age_an_arducopter_is_flown_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(state_samples, "_APART_US", 10**12)
    flight, stopped_us = without_attitudes()
    assert flight.setpoints_us[-1] - stopped_us > 1_400_000


def test_an_arducopter_whose_thrust_would_be_a_climb_rate_is_not_armed() -> None:
    flight = Watched(COPTER[0], "agent.autopilot_params={}")
    flight.step_for(3.0)
    assert flight.agent.finished
    assert "set agent.autopilot_params.GUID_OPTIONS = 8" in flight.agent.outcome
    assert not flight.run.world.truth_rows()[0]["armed"]


# -- a vehicle that stands at another heading than the mission's ------------------------------------------------------


X500 = (FINE, "sitl.preset=x500", "vehicle_model={attitude_rad_s=9.5,drag_1_s=0.3,hover_thrust_01=0.49}")


def turned_rad_s() -> float:
    """Return the fastest turn of a vehicle that faces north and whose mission faces 115 degrees."""
    flight, yaws = Watched("mission.yaw_rad=2.0", *X500), []
    while mission_t_s(flight.run) < 2.0:
        flight.step_for(0.02)
        assert flight.now_us < 60_000_000
        yaws.append(euler_from_quat(flight.run.world.truth_rows()[0]["q_nb"])[2])
    assert abs(yaws[0]) < 0.1
    return float(np.abs(np.diff(np.unwrap(yaws))).max() * 50.0)


def test_at_the_handover_it_turns_from_its_own_heading_at_a_bounded_rate() -> None:
    assert turned_rad_s() < 1.6


def test_negative_control_without_its_own_heading_it_is_turned_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Heading, "begin", lambda *_: None)
    assert turned_rad_s() > 2.3


@pytest.mark.parametrize("after_s", [1.3, 1.7, 2.1])
def test_resume_takes_back_a_vehicle_that_its_failsafe_has_landed(after_s: float) -> None:
    """Its status stays critical until the next HEARTBEAT, up to a second after it follows setpoints again."""
    in_air = ("swarm.agents=1", "mission.duration_s=60", "sitl.start=air", "swarm.origin_alt_m=470")
    flight = Lockstep(load(None, (*COARSE, *in_air)))
    while not mission_t_s(flight) > 3.0:
        flight.step()
    loss = FaultParams(kind="link_loss", vehicle=0, value=1.0, for_s=1.0)
    flight.world.faults.begin(loss, flight.world.since_boot_us)
    for _ in range(round(after_s * 25)):
        flight.step()
    assert flight.logs[0].rows[-1][0]["mode"] == Mode.PILOT_OVERRIDE
    flight.command("resume", 0)
    for _ in range(4 * 25):
        flight.step()
    assert flight.logs[0].rows[-1][0]["mode"] == Mode.TRACKING
