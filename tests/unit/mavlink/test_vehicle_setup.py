"""Setup of a link: rates, origin and parameters, also after a reboot, and the refusals."""

from __future__ import annotations

import json
import re
import struct
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.clock import SimClock
from swarmctl.core.json_safe import to_json
from swarmctl.core.types import AttitudeSetpoint, Command, FlightMode, GeoOrigin, Landed, Verb
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.commands import CommandPort, CommandResult
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.mavlink.vehicle.autopilot import Autopilot
from swarmctl.mavlink.vehicle_setup import VehicleSetup

HOME = GeoOrigin(47.397742, 8.545594, 489.4)
PX4, ARDUCOPTER = 12, 3
LEVEL = [1.0, 0.0, 0.0, 0.0]


PX4_WITHOUT_AGENT = {"COM_OBL_RC_ACT": 4, "COM_OF_LOSS_T": 1.0, "NAV_DLL_ACT": 3, "COM_DL_LOSS_T": 5}
PX4_THRUST = {"MPC_THR_HOVER": 0.45, "THR_MDL_FAC": 0.0, "MPC_THR_MIN": 0.1, "MPC_THR_MAX": 1}
TAKEOFF_M = 2.5  # of a PX4 that has not flown for an agent
COPTER_WITHOUT_AGENT = {"FS_GCS_ENABLE": 5, "FS_GCS_TIMEOUT": 2.0, "ATC_ANGLE_BOOST": 0, "SYSID_MYGCS": 255}


class Vehicle:
    """A scripted autopilot at the far end: answers commands and parameters, streams the requested messages."""

    def __init__(self, autopilot: int = PX4, **params: float) -> None:
        defaults = {
            PX4: {**PX4_WITHOUT_AGENT, **PX4_THRUST, "MIS_TAKEOFF_ALT": TAKEOFF_M},
            ARDUCOPTER: {"GUID_OPTIONS": 8, "GUID_TIMEOUT": 3.0, "MOT_THST_HOVER": 0.35, **COPTER_WITHOUT_AGENT},
        }
        self.kind = mavlink.MAV_TYPE_QUADROTOR
        self.autopilot, self.params = autopilot, {**defaults[autopilot], **params}
        self.clock = SimClock()
        self.ours, self.theirs = pipe_pair(self.clock.now_us)
        self.codec = Codec(1, 1)
        self.read_only = False
        self.talks = self.answers_origin = True
        self.boot()
        self.pilot = Autopilot(self.ours, Codec(1, 191), 1, HOME, on_frame=lambda frame: None)
        self.port = CommandPort(self.pilot.send_frame, Codec(1, 191), 1, lambda: self.pilot.dialect)
        self.pilot.connect(self.port)
        self.originals: dict[str, int | float] = {}  # that the next agent is told
        self.noted: list[tuple[str, dict[str, Any], dict[str, float]]] = []  # and the parameters at that moment
        self.set_up()

    def boot(self) -> None:
        self.booted_us = self.clock.now_us()
        self.rates_hz: dict[int, float] = {}
        self.asked: list[tuple[int, float]] = []

    def set_up(self, **setup: int | float) -> Vehicle:
        self.vehicle_setup = VehicleSetup(
            self.pilot, self.port, setup, 1, state_rate_hz=50.0, note=self._note, originals=self.originals
        )
        return self

    def _note(self, name: str, **fields: Any) -> None:
        self.noted.append((name, fields, dict(self.params)))

    @property
    def stamp_us(self) -> int:
        return self.clock.now_us() - self.booted_us + 1_000_000

    def run(self, seconds: float) -> Vehicle:
        for _ in range(round(seconds * 50)):
            self._tick()
            self.pilot.poll(self.clock.now_us())
            self.port.step(self.clock.now_us())
            for result in self.port.results():
                self.vehicle_setup.on_result(result)
            self.vehicle_setup.step(self.clock.now_us())
            self.clock.advance(20_000)
        return self

    def say(self, message: Any) -> None:
        if self.talks:
            self.theirs.send(self.codec.encode(message))

    def _tick(self) -> None:
        for datagram in self.theirs.receive(self.clock.now_us()):
            for frame in frames(datagram.data):
                self._hear(self.codec.decode(frame))
        if self.clock.now_us() % 1_000_000 == 0:
            self.say(mavlink.MAVLink_heartbeat_message(self.kind, self.autopilot, 1, 4 << 16 | 3 << 24, 3, 3))
        nothing = [0.0] * 21
        boot_ms = self.stamp_us // 1000
        if 331 in self.rates_hz:
            self.say(
                mavlink.MAVLink_odometry_message(
                    self.stamp_us, 1, 1, 0, 0, 0, LEVEL, 0, 0, 0, 0, 0, 0, nothing, nothing, 0, 2, 90
                )
            )
        if 31 in self.rates_hz:
            self.say(mavlink.MAVLink_attitude_quaternion_message(boot_ms, *LEVEL, 0, 0, 0))
        if 32 in self.rates_hz:
            self.say(mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, 0, 0, 0, 0))

    def _hear(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "COMMAND_LONG":
            self.asked.append((message.command, message.param1))
            if message.command == 511:
                self.rates_hz[int(message.param1)] = message.param2
            self.say(mavlink.MAVLink_command_ack_message(message.command, 0))
            if message.command == 512 and message.param1 == 49 and self.answers_origin:
                lat, lon, alt = round(HOME.lat_deg * 1e7), round(HOME.lon_deg * 1e7), round(HOME.alt_m * 1e3)
                self.say(mavlink.MAVLink_gps_global_origin_message(lat, lon, alt))
        elif kind == "PARAM_SET" and message.param_id in self.params:
            if not self.read_only:
                self.params[message.param_id] = self._from_wire(message.param_id, message.param_value)
            self._tell(message.param_id)
        elif kind == "PARAM_REQUEST_READ" and message.param_id in self.params:
            self._tell(message.param_id)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self.say(mavlink.MAVLink_timesync_message(self.stamp_us * 1000, message.ts1))

    def _from_wire(self, name: str, value: float) -> float:
        if self.autopilot == PX4 and isinstance(self.params[name], int):
            return int(struct.unpack("<i", struct.pack("<f", value))[0])
        return type(self.params[name])(value)

    def _tell(self, name: str) -> None:
        value = self.params[name]
        whole = isinstance(value, int)
        wire = struct.unpack("<f", struct.pack("<i", value))[0] if whole and self.autopilot == PX4 else float(value)
        self.say(mavlink.MAVLink_param_value_message(name.encode(), wire, 6 if whole else 9, 1, 0))


def rates(vehicle: Vehicle) -> set[int]:
    return {int(first) for command, first in vehicle.asked if command == 511}


def test_px4_is_set_up_in_two_seconds_and_left_alone_then() -> None:
    vehicle = Vehicle(COM_OBL_RC_ACT=0).set_up(COM_OBL_RC_ACT=4).run(2.0)
    assert vehicle.vehicle_setup.ready
    assert vehicle.vehicle_setup.refusal == ""
    assert rates(vehicle) == {331, 83, 245, 436, 230, 30, 31, 33, 105}
    assert vehicle.params["COM_OBL_RC_ACT"] == vehicle.pilot.params["COM_OBL_RC_ACT"] == 4
    assert vehicle.pilot.hover_thrust_01 == pytest.approx(0.45)
    assert vehicle.pilot.offset_ned_m is not None
    vehicle.asked.clear()
    vehicle.run(10.0)
    assert vehicle.asked == []


@pytest.mark.parametrize(("autopilot", "loss_s", "landing_s"), [(PX4, 1.0, 1.0), (ARDUCOPTER, 3.0, 2.0)])
def test_when_the_vehicle_flies_by_itself_is_read_also_where_nothing_sets_it(
    autopilot: int, loss_s: float, landing_s: float
) -> None:
    pilot = Vehicle(autopilot).set_up().run(4.0).pilot
    assert (pilot.setpoint_loss_s, pilot.landing_delay_s) == (loss_s, landing_s)


def test_setpoints_are_to_be_repeated_as_fast_as_they_come_from_the_first_one_on() -> None:
    vehicle = Vehicle().set_up().run(3.0)
    assert vehicle.rates_hz[83] == pytest.approx(200_000.0)
    now_us = vehicle.clock.now_us()
    level = AttitudeSetpoint(q_nb=np.array(LEVEL), thrust_01=0.5, valid_until_us=now_us + 100_000)
    assert vehicle.pilot.send(level, now_us) == ""
    vehicle.asked.clear()
    vehicle.run(5.0)
    assert vehicle.asked == [(511, 83.0)]
    assert vehicle.rates_hz[83] == pytest.approx(20_000.0)


def test_arducopter_is_asked_for_every_message_the_bridge_needs() -> None:
    vehicle = Vehicle(ARDUCOPTER, GUID_OPTIONS=0).set_up(GUID_OPTIONS=8).run(30.0)  # unknown ones are met by silence
    assert vehicle.vehicle_setup.ready
    assert vehicle.vehicle_setup.refusal == ""
    assert rates(vehicle) == {1, 24, 31, 32, 33, 83, 245}
    assert vehicle.pilot.params["GUID_OPTIONS"] == 8.0
    assert vehicle.params["SYSID_MYGCS"] == 1, "its link-loss failsafe heeds the agent's heartbeats"
    assert vehicle.pilot.hover_thrust_01 == pytest.approx(0.35)
    assert vehicle.pilot.poll(vehicle.clock.now_us()) is not None


@pytest.mark.parametrize(
    ("vehicle", "why"),
    [
        (Vehicle(COM_OBL_RC_ACT=7).set_up(), "COM_OBL_RC_ACT = 7: motors would stop"),
        (
            Vehicle(ARDUCOPTER, GUID_OPTIONS=0).set_up(),
            r"GUID_OPTIONS = 0: .*set agent\.autopilot_params\.GUID_OPTIONS = 8",
        ),
        (Vehicle(ARDUCOPTER, GUID_TIMEOUT=60.0).set_up(), "GUID_TIMEOUT = 60"),
        (Vehicle(ARDUCOPTER, FS_GCS_ENABLE=0).set_up(), "FS_GCS_ENABLE = 0: .*drift"),
        (Vehicle(ARDUCOPTER, FS_GCS_TIMEOUT=30.0).set_up(), "FS_GCS_TIMEOUT = 30"),
        (Vehicle(ARDUCOPTER, ATC_ANGLE_BOOST=1).set_up(), "ATC_ANGLE_BOOST = 1"),
    ],
    ids=["motors stop", "climb rate", "flies on", "drifts on", "drifts long", "boost"],
)
def test_what_a_parameter_would_do_in_flight_is_refused_before_it(vehicle: Vehicle, why: str) -> None:
    vehicle.run(12.0)
    assert vehicle.vehicle_setup.ready
    assert re.search(why, vehicle.vehicle_setup.refusal)


@pytest.mark.parametrize("autopilot", [PX4, ARDUCOPTER])
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (mavlink.MAV_TYPE_FIXED_WING, "fixed wing"),
        (mavlink.MAV_TYPE_GROUND_ROVER, "ground rover"),
        (mavlink.MAV_TYPE_VTOL_TILTROTOR, "vtol tiltrotor"),
        (250, "250"),
        (mavlink.MAV_TYPE_HEXAROTOR, ""),
        (mavlink.MAV_TYPE_GENERIC, ""),
    ],
)
def test_only_what_hovers_is_flown(autopilot: int, kind: int, said: str) -> None:
    """ArduPlane and ArduRover name the autopilot of ArduCopter, and number other modes by its numbers."""
    vehicle = Vehicle(PX4, COM_DL_LOSS_T=10) if autopilot == PX4 else Vehicle(ARDUCOPTER, GUID_TIMEOUT=1.0)
    vehicle.kind, before = kind, dict(vehicle.params)
    refusal = vehicle.set_up().run(12.0).vehicle_setup.refusal
    assert vehicle.vehicle_setup.ready
    assert (vehicle.params == before) == bool(said), "nothing is set of a vehicle that is not flown"
    assert refusal == (f"it says to be of MAV_TYPE {said}, and only multirotors are flown" if said else "")


def test_an_offboard_loss_action_that_could_not_be_set_or_read_is_refused() -> None:
    stubborn = Vehicle(COM_OBL_RC_ACT=0)
    stubborn.read_only = True
    stubborn.set_up(COM_OBL_RC_ACT=4).run(4.0)
    assert stubborn.vehicle_setup.refusal == "COM_OBL_RC_ACT could not be set to 4: stays at 0"
    silent = Vehicle()
    del silent.params["COM_OBL_RC_ACT"]
    silent.set_up().run(6.0)
    assert silent.vehicle_setup.refusal.startswith("COM_OBL_RC_ACT can't be read")
    harmless = Vehicle().set_up(MPC_LAND_SPEED=0.5).run(6.0)
    assert (harmless.vehicle_setup.ready, harmless.vehicle_setup.refusal) == (True, ""), "only what matters refuses"


def test_a_whole_number_in_the_configuration_is_set_in_the_type_that_the_vehicle_keeps() -> None:
    vehicle = Vehicle(COM_OF_LOSS_T=1.0, COM_OBL_RC_ACT=0).set_up(COM_OF_LOSS_T=10, COM_OBL_RC_ACT=4.0).run(4.0)
    assert (vehicle.vehicle_setup.ready, vehicle.vehicle_setup.refusal) == (True, "")
    assert (vehicle.params["COM_OF_LOSS_T"], vehicle.params["COM_OBL_RC_ACT"]) == (10.0, 4)


def test_nothing_is_armed_when_a_parameter_that_is_there_could_not_be_set() -> None:
    vehicle = Vehicle(MPC_LAND_SPEED=0.7)
    vehicle.read_only = True
    vehicle.set_up(MPC_LAND_SPEED=0.5).run(4.0)
    assert vehicle.vehicle_setup.refusal == "MPC_LAND_SPEED could not be set to 0.5: stays at 0.7"


def test_px4_that_would_hover_for_ever_without_its_agent_is_refused() -> None:
    assert "hover for ever" in Vehicle().set_up(NAV_DLL_ACT=0).run(4.0).vehicle_setup.refusal
    assert "COM_DL_LOSS_T = 60" in Vehicle().set_up(COM_DL_LOSS_T=60).run(4.0).vehicle_setup.refusal
    stubborn = Vehicle(NAV_DLL_ACT=0)
    stubborn.read_only = True
    assert "NAV_DLL_ACT could not be set to 3" in stubborn.set_up().run(4.0).vehicle_setup.refusal
    vehicle = Vehicle(NAV_DLL_ACT=0, COM_DL_LOSS_T=60).set_up().run(4.0)
    assert (vehicle.params["NAV_DLL_ACT"], vehicle.params["COM_DL_LOSS_T"], vehicle.vehicle_setup.refusal) == (3, 5, "")


@pytest.mark.parametrize(
    ("autopilot", "wanted", "came_with"),
    [
        (PX4, {"NAV_DLL_ACT": 3, "COM_OBL_RC_ACT": 4}, {"NAV_DLL_ACT": 0, "COM_OBL_RC_ACT": 4}),
        (ARDUCOPTER, {"FS_GCS_ENABLE": 5}, {"FS_GCS_ENABLE": 0, "SYSID_MYGCS": 255}),
    ],
    ids=["PX4", "ArduCopter"],
)
def test_after_the_flight_parameters_are_what_they_were(
    autopilot: int, wanted: dict[str, int], came_with: dict[str, int]
) -> None:
    vehicle = Vehicle(autopilot, **came_with).set_up(**wanted).run(30.0)
    assert wanted.items() <= vehicle.params.items()
    assert not vehicle.vehicle_setup.restored
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(3.0)
    assert vehicle.vehicle_setup.restored
    assert came_with.items() <= vehicle.params.items()
    assert vehicle.vehicle_setup.left_changed == {}


def test_px4_is_left_alone_while_it_may_be_saving_its_parameters_after_a_disarm() -> None:
    vehicle = Vehicle(NAV_DLL_ACT=0).set_up(NAV_DLL_ACT=3).run(4.0)
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(0.95)
    assert (vehicle.params["NAV_DLL_ACT"], vehicle.vehicle_setup.restored) == (3, False)
    vehicle.run(0.5)
    assert (vehicle.params["NAV_DLL_ACT"], vehicle.vehicle_setup.restored) == (0, True)
    unchanged = Vehicle()
    del unchanged.params["MIS_TAKEOFF_ALT"]  # which every climb sets
    unchanged.set_up().run(6.0)
    unchanged.vehicle_setup.restore(unchanged.clock.now_us())
    assert unchanged.run(0.1).vehicle_setup.restored  # nothing to restore: nothing to wait for


def test_a_parameter_that_could_not_be_set_back_is_named_with_its_value() -> None:
    vehicle = Vehicle(NAV_DLL_ACT=0).set_up(NAV_DLL_ACT=3).run(4.0)
    vehicle.read_only = True
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(6.0)
    assert (vehicle.vehicle_setup.restored, vehicle.vehicle_setup.left_changed) == (True, {"NAV_DLL_ACT": 0})


@pytest.mark.parametrize(
    ("autopilot", "came_with"),
    [
        (PX4, {"NAV_DLL_ACT": 0, "COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 4}),
        (ARDUCOPTER, {"FS_GCS_ENABLE": 0, "SYSID_MYGCS": 255, "FS_GCS_TIMEOUT": 9.0, "GUID_OPTIONS": 8}),
    ],
    ids=["PX4", "ArduCopter"],
)
def test_what_an_agent_changes_is_noted_before_and_set_back_by_another(
    autopilot: int, came_with: dict[str, float]
) -> None:
    wanted: dict[str, float] = {"COM_OF_LOSS_T": 0.5} if autopilot == PX4 else {"FS_GCS_ENABLE": 5, "FS_GCS_TIMEOUT": 2}
    vehicle = Vehicle(autopilot, **came_with).set_up(**wanted).run(30.0)
    ((name, fields, params),) = vehicle.noted
    assert (name, came_with.items() <= params.items()) == ("parameters_changed", True), "before the first was set"
    changed = {name: value for name, value in came_with.items() if vehicle.params[name] != value}
    changed |= {"MIS_TAKEOFF_ALT": TAKEOFF_M} if autopilot == PX4 else {}
    assert fields["were"] == changed
    assert len(changed) >= 2
    vehicle.originals = json.loads(to_json(fields["were"]))
    again = vehicle.set_up(**wanted)  # the first is killed
    vehicle.run(30.0)
    assert len(vehicle.noted) == 1, "nothing was to be changed"
    again.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(4.0)
    assert came_with.items() <= vehicle.params.items()
    assert (again.vehicle_setup.restored, again.vehicle_setup.left_changed) == (True, {})


def test_another_agent_sets_back_also_what_it_has_had_no_time_to_read() -> None:
    vehicle = Vehicle(NAV_DLL_ACT=3, COM_OF_LOSS_T=0.5)
    vehicle.originals = {"NAV_DLL_ACT": 0, "COM_OF_LOSS_T": 1.0}
    vehicle.set_up()
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())  # the vehicle is on the ground and disarmed
    assert vehicle.vehicle_setup.left_changed == {"NAV_DLL_ACT": 0, "COM_OF_LOSS_T": 1.0}
    vehicle.run(3.0)
    assert (vehicle.params["NAV_DLL_ACT"], vehicle.params["COM_OF_LOSS_T"]) == (0, 1.0)
    assert vehicle.vehicle_setup.left_changed == {}


def test_a_reboot_while_parameters_are_set_back_leaves_none_changed() -> None:
    vehicle = Vehicle(NAV_DLL_ACT=0, COM_DL_LOSS_T=10).set_up().run(4.0)
    assert (vehicle.params["NAV_DLL_ACT"], vehicle.params["COM_DL_LOSS_T"]) == (3, 5)
    vehicle.boot()
    vehicle.rates_hz = {331: 30.0}
    while vehicle.pilot.clock.boots == 0:  # which ends the mission
        vehicle._tick()
        vehicle.pilot.poll(vehicle.clock.now_us())
        vehicle.clock.advance(20_000)
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(4.0)
    assert vehicle.vehicle_setup.restored
    assert (vehicle.params["NAV_DLL_ACT"], vehicle.params["COM_DL_LOSS_T"]) == (0, 10)
    assert vehicle.vehicle_setup.left_changed == {}


def test_only_what_was_set_back_counts_as_restored() -> None:
    vehicle = Vehicle(NAV_DLL_ACT=0).set_up().run(4.0)
    setup = vehicle.vehicle_setup
    setup.restore(vehicle.clock.now_us())
    wanted = Command(verb=Verb.PARAM_INT, number=3, name="NAV_DLL_ACT")
    for command in (Command(verb=Verb.PARAM_GET, name="NAV_DLL_ACT"), wanted):
        setup._open = command  # asked before, and answered now
        setup.on_result(CommandResult(command, True, "3"))
        assert setup.left_changed["NAV_DLL_ACT"] == 0


def climbed(vehicle: Vehicle) -> Vehicle:
    """The vehicle after its agent has set it up and asked it to take off to another height than its own."""
    vehicle.set_up().run(4.0)
    vehicle.port.request(Command(verb=Verb.TAKEOFF, value=7.0))
    vehicle.run(1.0)
    assert vehicle.params["MIS_TAKEOFF_ALT"] == 7.0
    return vehicle


def test_the_height_that_a_climb_sets_is_set_back_after_the_flight() -> None:
    vehicle = climbed(Vehicle())
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(3.0)
    assert vehicle.params["MIS_TAKEOFF_ALT"] == TAKEOFF_M
    assert (vehicle.vehicle_setup.restored, vehicle.vehicle_setup.left_changed) == (True, {})


def test_the_height_that_a_climb_has_set_is_not_taken_for_the_original_after_a_reboot() -> None:
    vehicle = climbed(Vehicle())
    vehicle.boot()  # it keeps its parameters
    vehicle.rates_hz = {331: 30.0}
    vehicle.run(5.0)
    assert (vehicle.pilot.clock.boots, vehicle.pilot.params["MIS_TAKEOFF_ALT"]) == (1, 7.0)
    vehicle.vehicle_setup.restore(vehicle.clock.now_us())
    vehicle.run(3.0)
    assert vehicle.params["MIS_TAKEOFF_ALT"] == TAKEOFF_M


def test_the_height_that_a_climb_has_set_is_set_back_by_the_agent_that_lands_it() -> None:
    vehicle = climbed(Vehicle())  # and its agent is killed
    ((_, fields, _),) = vehicle.noted
    vehicle.originals = json.loads(to_json(fields["were"]))
    again = vehicle.set_up().run(4.0).vehicle_setup
    again.restore(vehicle.clock.now_us())
    vehicle.run(3.0)
    assert (vehicle.params["MIS_TAKEOFF_ALT"], again.left_changed) == (TAKEOFF_M, {})


def test_after_a_reboot_everything_is_asked_for_again() -> None:
    vehicle = Vehicle(COM_OBL_RC_ACT=0).set_up(COM_OBL_RC_ACT=4).run(3.0)
    vehicle.boot()
    vehicle.params["COM_OBL_RC_ACT"] = 0
    vehicle.rates_hz = {331: 30.0}  # PX4 streams by itself; its clock begins again
    rebooted_us = vehicle.clock.now_us()
    while vehicle.pilot.clock.boots == 0:
        vehicle.run(0.02)
    assert vehicle.clock.now_us() - rebooted_us <= 600_000
    assert not vehicle.vehicle_setup.ready
    assert vehicle.pilot.clock.boots == 1
    assert (vehicle.pilot.landed, vehicle.pilot.offset_ned_m) == (Landed.UNKNOWN, None)
    vehicle.run(3.0)
    assert vehicle.vehicle_setup.ready
    assert rates(vehicle) == {331, 83, 245, 436, 230, 30, 31, 33, 105}
    assert vehicle.params["COM_OBL_RC_ACT"] == 4
    assert vehicle.pilot.mode is FlightMode.HOLD


def test_lost_rates_are_requested_again_but_not_from_a_silent_vehicle() -> None:
    vehicle = Vehicle().set_up().run(5.0)
    vehicle.talks = False
    vehicle.run(24.0)  # what was asked at the very beginning of the silence is asked four times
    vehicle.asked.clear()
    vehicle.run(10.0)
    assert vehicle.asked == []
    vehicle.talks = True
    vehicle.rates_hz.clear()  # back, without its rates and without a reboot
    vehicle.run(9.0)
    assert 331 in rates(vehicle)
    assert vehicle.pilot.clock.boots == 0


def test_the_origin_is_requested_until_it_is_reported() -> None:
    vehicle = Vehicle()
    vehicle.answers_origin = False
    vehicle.set_up().run(6.0)
    assert vehicle.asked.count((512, 49.0)) >= 4
    vehicle.answers_origin = True
    vehicle.run(1.5)
    assert vehicle.pilot.offset_ned_m is not None
    vehicle.asked.clear()
    vehicle.run(5.0)
    assert vehicle.asked == []


def test_vehicle_setup_requests_one_thing_at_a_time_and_only_on_an_idle_port() -> None:
    vehicle = Vehicle().set_up()
    vehicle.run(0.1)
    vehicle.port.request(Command(verb=Verb.LAND))
    vehicle.run(0.2)
    assert (21, 0.0) in [(command, 0.0) for command, _ in vehicle.asked[-6:]]
