"""ArduCopter's MAVLink interface, as measured on 4.6.3: acks, texts, heartbeats, streams, parameters, boot."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.arducopter.parameters import DEFAULTS
from swarmctl.core.types import Landed
from tests.benches.arducopter_bench import (
    ACCEPTED,
    DENIED,
    FAILED,
    GUIDED,
    LAND,
    STABILIZE,
    UNSUPPORTED,
    Bench,
    of,
)

NAN = math.nan
PLACES = ("HOME_POSITION", "GPS_GLOBAL_ORIGIN")
ARM, SET_MODE, TAKEOFF, INTERVAL, REQUEST, CAPABILITIES, HOME = 400, 176, 22, 511, 512, 520, 410


def booted() -> Bench:
    return Bench().booted()


def armed() -> Bench:
    bench = booted()
    assert (bench.mode(GUIDED), bench.arm()) == (ACCEPTED, ACCEPTED)
    return bench


def flying() -> Bench:
    return Bench().airborne(2.0)


def after(seconds: float) -> Callable[[], Bench]:
    """So long after the start of an ArduCopter that boots as slowly as the real one."""

    def start() -> Bench:
        bench = Bench(ekf_ready_s=23.7, physics_hz=50)
        bench.run(seconds)
        return bench

    return start


@dataclass(frozen=True, kw_only=True)
class Row:
    """One request: the vehicle's state, a COMMAND_LONG, its result (None: no ack), new texts, new messages."""

    name: str
    state: Callable[[], Bench]
    command: tuple[float, ...]
    result: int | None
    texts: tuple[tuple[int, str], ...] = ()
    sent: tuple[str, ...] = ()
    target: tuple[int, int] = (1, 1)


ROWS = (
    Row(name="unknown command", state=booted, command=(12345,), result=UNSUPPORTED),
    Row(name="arm with p1 = 5", state=booted, command=(ARM, 5), result=UNSUPPORTED),
    Row(name="arm with p1 = NaN", state=booted, command=(ARM, NAN), result=UNSUPPORTED),
    Row(name="arm", state=booted, command=(ARM, 1), result=ACCEPTED, texts=((6, "Arming motors"),), sent=PLACES),
    Row(name="arm when armed", state=armed, command=(ARM, 1), result=ACCEPTED),
    Row(name="disarm", state=armed, command=(ARM, 0), result=ACCEPTED, texts=((6, "Disarming motors"),)),
    Row(name="disarm when disarmed", state=booted, command=(ARM, 0), result=ACCEPTED),
    Row(name="disarm in the air", state=flying, command=(ARM, 0), result=FAILED),
    Row(
        name="forced disarm in the air",
        state=flying,
        command=(ARM, 0, 21196),
        result=ACCEPTED,
        texts=((6, "Disarming motors"),),
    ),
    Row(name="terminate", state=flying, command=(185, 1), result=ACCEPTED, texts=((6, "Disarming motors"),)),
    Row(
        name="arm before initialisation",
        state=after(2.0),
        command=(ARM, 1),
        result=FAILED,
        texts=((2, "Arm: System not initialised"),),
    ),
    Row(
        name="arm before sensors agree",
        state=after(5.0),
        command=(ARM, 1),
        result=FAILED,
        texts=((2, "Arm: Accels inconsistent"), (2, "Arm: Gyros inconsistent"), (2, "Arm: EKF attitude is bad")),
    ),
    Row(
        name="arm before the origin",
        state=after(15.0),
        command=(ARM, 1),
        result=FAILED,
        texts=((2, "Arm: EKF attitude is bad"),),
    ),
    Row(
        name="arm before the EKF is used",
        state=after(22.0),
        command=(ARM, 1),
        result=FAILED,
        texts=((2, "Arm: AHRS: not using configured AHRS type"),),
    ),
    Row(
        name="forced arm before the EKF is used",
        state=after(22.0),
        command=(ARM, 1, 2989),
        result=ACCEPTED,
        texts=((6, "Arming motors"),),
        sent=PLACES,
    ),
    Row(name="take-off disarmed", state=booted, command=(TAKEOFF, 0, 0, 0, 0, 0, 0, 5), result=FAILED),
    Row(name="take-off armed in GUIDED", state=armed, command=(TAKEOFF, 0, 0, 0, 0, 0, 0, 5), result=ACCEPTED),
    Row(name="take-off downwards", state=armed, command=(TAKEOFF, 0, 0, 0, 0, 0, 0, -1), result=FAILED),
    Row(name="take-off to NaN", state=armed, command=(TAKEOFF, 0, 0, 0, 0, 0, 0, NAN), result=FAILED),
    Row(name="take-off in the air", state=flying, command=(TAKEOFF, 0, 0, 0, 0, 0, 0, 9), result=FAILED),
    Row(name="GUIDED", state=booted, command=(SET_MODE, 1, GUIDED), result=ACCEPTED, texts=(), sent=("HEARTBEAT",)),
    Row(
        name="GUIDED, early",
        state=after(1.2),
        command=(SET_MODE, 1, GUIDED),
        result=ACCEPTED,
        texts=(),
        sent=("HEARTBEAT",),
    ),
    Row(name="STABILIZE in STABILIZE", state=booted, command=(SET_MODE, 1, STABILIZE), result=ACCEPTED),
    Row(name="no such mode", state=booted, command=(SET_MODE, 1, 99), result=FAILED, texts=((4, "No such mode 99"),)),
    Row(name="custom flag missing", state=booted, command=(SET_MODE, 0, GUIDED), result=DENIED),
    Row(name="mode NaN", state=booted, command=(SET_MODE, 1, NAN), result=DENIED),
    Row(
        name="a mode without its mission",
        state=booted,
        command=(SET_MODE, 1, 3),
        result=FAILED,
        texts=((4, "Mode change to AUTO failed: init failed"),),
    ),
    Row(name="NAV_LAND", state=flying, command=(21,), result=ACCEPTED, texts=(), sent=("HEARTBEAT",)),
    Row(name="NAV_RETURN_TO_LAUNCH", state=flying, command=(20,), result=ACCEPTED, texts=(), sent=("HEARTBEAT",)),
    Row(name="interval", state=booted, command=(INTERVAL, 31, 20000), result=ACCEPTED),
    Row(
        name="interval of an unknown id",
        state=booted,
        command=(INTERVAL, 9999, 1e4),
        result=DENIED,
        texts=((6, "No ap_message for mavlink id (9999)"),),
    ),
    Row(
        name="interval of ODOMETRY",
        state=booted,
        command=(INTERVAL, 331, 1e4),
        result=DENIED,
        texts=((6, "No ap_message for mavlink id (331)"),),
    ),
    Row(name="interval NaN", state=booted, command=(INTERVAL, 31, NAN), result=DENIED),
    Row(
        name="request AUTOPILOT_VERSION",
        state=booted,
        command=(REQUEST, 148),
        result=ACCEPTED,
        texts=(),
        sent=("AUTOPILOT_VERSION",),
    ),
    Row(
        name="request HOME_POSITION",
        state=booted,
        command=(REQUEST, 242),
        result=ACCEPTED,
        texts=(),
        sent=("HOME_POSITION",),
    ),
    Row(
        name="request GPS_GLOBAL_ORIGIN",
        state=booted,
        command=(REQUEST, 49),
        result=ACCEPTED,
        texts=(),
        sent=("GPS_GLOBAL_ORIGIN",),
    ),
    Row(name="request of an unknown id", state=booted, command=(REQUEST, 9999), result=FAILED),
    Row(
        name="capabilities",
        state=booted,
        command=(CAPABILITIES, 1),
        result=ACCEPTED,
        texts=(),
        sent=("AUTOPILOT_VERSION",),
    ),
    Row(name="home", state=booted, command=(HOME,), result=ACCEPTED, texts=(), sent=PLACES),
    Row(name="home before there is one", state=after(15.0), command=(HOME,), result=FAILED),
    Row(
        name="to component 250",
        state=booted,
        command=(ARM, 1),
        result=ACCEPTED,
        texts=((6, "Arming motors"),),
        sent=PLACES,
        target=(1, 250),
    ),
    Row(
        name="to everybody",
        state=booted,
        command=(ARM, 1),
        result=ACCEPTED,
        texts=((6, "Arming motors"),),
        sent=PLACES,
        target=(0, 0),
    ),
    Row(name="to another system", state=booted, command=(ARM, 1), result=None, texts=(), sent=(), target=(2, 1)),
)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_row(row: Row) -> None:
    bench = row.state()
    bench.got.clear()
    number, *params = row.command
    assert bench.command(int(number), *params, target=row.target) == row.result
    assert tuple((m.severity, m.text) for m in of("STATUSTEXT", bench.got)) == row.texts
    news = {m.get_type() for m in bench.got} - {"COMMAND_ACK", "STATUSTEXT"}
    assert set(row.sent) <= news and news - {"HEARTBEAT"} == set(row.sent) - {"HEARTBEAT"}, "HEARTBEAT may be due"


def test_acks_go_to_the_sender_and_carry_nothing_else() -> None:
    bench = booted()
    bench.command(12345)
    (ack,) = of("COMMAND_ACK", bench.got)
    assert (ack.progress, ack.result_param2, ack.target_system, ack.target_component) == (0, 0, 255, 190)


def test_arming_is_refused_in_land() -> None:
    bench = booted()
    bench.mode(LAND)
    assert bench.arm() == FAILED
    assert "Arm: LAND mode not armable" in bench.texts()


def test_command_int_and_set_mode() -> None:
    bench = booted()
    (ack,) = of("COMMAND_ACK", bench.ask(mav.MAVLink_set_mode_message(1, 1, GUIDED)))
    assert (ack.command, ack.result) == (11, ACCEPTED)
    arm = mav.MAVLink_command_int_message(1, 1, 0, ARM, 0, 0, 1.0, 0, 0, 0, 0, 0, 0)
    assert of("COMMAND_ACK", bench.ask(arm))[0].result == ACCEPTED
    for frame, result in ((mav.MAV_FRAME_GLOBAL, DENIED), (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, ACCEPTED)):
        climb = mav.MAVLink_command_int_message(1, 1, frame, TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 0, 3.0)
        assert of("COMMAND_ACK", bench.ask(climb))[0].result == result


# --- heartbeat and landed state ---


@pytest.mark.parametrize(
    ("state", "mode", "base", "status", "landed"),
    [
        (booted, STABILIZE, 81, 3, Landed.ON_GROUND),
        (after(1.2), STABILIZE, 81, 1, Landed.ON_GROUND),
        (armed, GUIDED, 217, 3, Landed.ON_GROUND),
        (flying, GUIDED, 217, 4, Landed.IN_AIR),
    ],
)
def test_heartbeat(state: Callable[[], Bench], mode: int, base: int, status: int, landed: Landed) -> None:
    bench = state()
    bench.command(INTERVAL, 245, 100000)
    got = bench.run(1.1)
    beat = of("HEARTBEAT", got)[-1]
    assert (beat.type, beat.autopilot, beat.mavlink_version) == (2, 3, 3)
    assert (beat.base_mode, beat.custom_mode, beat.system_status) == (base, mode, status)
    assert of("EXTENDED_SYS_STATE", got)[-1].landed_state == landed


def test_other_base_modes() -> None:
    bench = booted()
    assert bench.arm() == ACCEPTED
    assert of("HEARTBEAT", bench.run(1.1))[-1].base_mode == 209, "STABILIZE, armed"
    bench.command(ARM, 0)
    bench.mode(GUIDED)
    assert of("HEARTBEAT", bench.run(1.1))[-1].base_mode == 89, "GUIDED, disarmed"
    bench = flying()
    assert of("HEARTBEAT", bench.run(1.1, {}))[-1].base_mode == 209, "an attitude is flown: no position controller"


def test_a_mode_change_is_sent_at_once_and_arming_waits_for_the_tick() -> None:
    bench = booted()
    bench.run(1.0 - bench.t_s % 1.0 + 0.2)
    bench.got.clear()
    bench.mode(GUIDED)
    assert [m.custom_mode for m in of("HEARTBEAT", bench.got)] == [GUIDED]
    bench.got.clear()
    bench.arm()
    assert not of("HEARTBEAT", bench.run(0.4))
    assert of("HEARTBEAT", bench.run(0.6))[0].base_mode == 217


# --- streams ---


def test_only_heartbeat_and_timesync_flow_until_asked() -> None:
    got = [m for m in booted().run(11.0) if m.get_type() != "STATUSTEXT"]
    assert {m.get_type() for m in got} == {"HEARTBEAT", "TIMESYNC"}
    assert len(of("HEARTBEAT", got)) == 11 and len(of("TIMESYNC", got)) == 1


GROUPS = {
    2: {"SYS_STATUS", "GPS_RAW_INT"},
    3: {"SERVO_OUTPUT_RAW"},
    6: {"LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"},
    10: {"ATTITUDE"},
    11: {"VFR_HUD"},
    12: {"SYSTEM_TIME", "BATTERY_STATUS", "EKF_STATUS_REPORT"},
}


@pytest.mark.parametrize("group", [0, *GROUPS])
def test_request_data_stream(group: int) -> None:
    bench = booted()
    wanted = GROUPS[group] if group else set().union(*GROUPS.values())
    bench.ask(mav.MAVLink_request_data_stream_message(1, 1, group, 10, 1))
    got = bench.run(2.0)
    assert {m.get_type() for m in got} - {"HEARTBEAT"} == wanted
    assert all(len(of(kind, got)) == 20 for kind in wanted), "10 Hz asked, 10 Hz got"
    bench.ask(mav.MAVLink_request_data_stream_message(1, 1, group, 10, 0))
    assert {m.get_type() for m in bench.run(1.1)} == {"HEARTBEAT"}


@pytest.mark.parametrize(("interval_us", "per_second"), [(10000, 100), (20000, 50), (-1, 0), (0, 0), (1, 250)])
def test_message_intervals(interval_us: int, per_second: int) -> None:
    bench = booted()
    bench.command(INTERVAL, 32, 100000)
    assert bench.command(INTERVAL, 32, interval_us) == ACCEPTED
    assert len(of("LOCAL_POSITION_NED", bench.run(1.0))) == per_second


def test_state_is_sampled_together_on_the_agents_grid_attitude_first() -> None:
    bench = booted()
    for message in (32, 31):
        bench.command(INTERVAL, message, 20000)
    got = [m for m in bench.run(0.5) if m.get_type() in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")]
    assert [m.get_type() for m in got[:4]] == ["ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"] * 2
    assert all(m.time_boot_ms % 20 == 0 for m in got)


def test_messages_by_interval_tell_the_target() -> None:
    bench = flying()
    for message in (83, 193):
        bench.command(INTERVAL, message, 100000)
    got = bench.run(1.0, {"roll_deg": 5.0})
    target = of("ATTITUDE_TARGET", got)[-1]
    assert target.q[1] == pytest.approx(math.sin(math.radians(2.5)), abs=1e-6) and target.type_mask == 0
    assert 0.3 < target.thrust < 0.45
    assert of("EKF_STATUS_REPORT", got)[-1].flags == 0x33F


def test_timesync_and_silence_to_ping() -> None:
    bench = booted()
    (reply,) = of("TIMESYNC", bench.ask(mav.MAVLink_timesync_message(0, 123456)))
    assert reply.ts1 == 123456
    assert reply.tc1 == (bench.world.since_boot_us - bench.step_us) * 1000, "when it arrived, before the step"
    assert not of("PING", bench.ask(mav.MAVLink_ping_message(1, 2, 0, 0)))


# --- version, health, frames ---


def test_version() -> None:
    bench = booted()
    bench.command(REQUEST, 148)
    (version,) = of("AUTOPILOT_VERSION", bench.got)
    assert (version.capabilities, version.flight_sw_version) == (64495, 0x040603FF)
    assert not version.capabilities & 16, "parameters are not bytewise"


def test_prearm_bit_follows_the_boot() -> None:
    bench = after(21.0)()
    bench.command(INTERVAL, 1, 500000)
    healths = {m.onboard_control_sensors_health & 1 << 28 for m in of("SYS_STATUS", bench.run(2.0))}
    assert healths == {0}
    bench.run(1.0)
    assert of("SYS_STATUS", bench.run(1.0))[-1].onboard_control_sensors_health & 1 << 28


def test_home_moves_to_the_arming_point_and_the_origin_stays() -> None:
    bench = Bench().airborne(3.0)
    first, origin = of("HOME_POSITION", bench.got)[-1], of("GPS_GLOBAL_ORIGIN", bench.got)[-1]
    bench.run(3.0, {"roll_deg": 5.0})
    bench.mode(LAND)
    while bench.pilot.armed:
        bench.run(0.5)
    bench.mode(GUIDED)
    bench.got.clear()
    assert bench.arm() == ACCEPTED
    (home,), (again,) = of("HOME_POSITION", bench.got), of("GPS_GLOBAL_ORIGIN", bench.got)
    assert home.y - first.y > 1.0, "metres east"
    assert (again.latitude, again.longitude, again.altitude) == (origin.latitude, origin.longitude, origin.altitude)
    assert home.longitude - first.longitude == pytest.approx((home.y - first.y) / 0.0075, rel=0.02)


# --- parameters: C-cast ---


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("GUID_TIMEOUT", 9, 3.0),
        ("GUID_OPTIONS", 6, 0),
        ("MOT_THST_HOVER", 9, 0.39),
        ("MOT_THST_EXPO", 9, 0.65),
        ("ANGLE_MAX", 4, 3000),
        ("ATC_ANG_RLL_P", 9, 4.5),
        ("WPNAV_SPEED_UP", 9, 250),
        ("SYSID_MYGCS", 4, 255),
        ("FS_GCS_ENABLE", 2, 0),
        ("FS_GCS_TIMEOUT", 9, 5),
        ("DISARM_DELAY", 2, 10),
        ("SYSID_THISMAV", 4, 1),
    ],
)
def test_values(name: str, kind: int, value: float) -> None:
    (got,) = of("PARAM_VALUE", booted().ask(mav.MAVLink_param_request_read_message(1, 1, name.encode(), -1)))
    assert (got.param_id, got.param_type, got.param_index) == (name, kind, 65535)
    assert got.param_value == pytest.approx(value, rel=1e-6)


def test_integers_are_cast_not_carried_as_bits() -> None:
    bench = booted()
    (got,) = of("PARAM_VALUE", bench.ask(mav.MAVLink_param_set_message(1, 1, b"GUID_OPTIONS", 8.0, 6)))
    assert got.param_value == 8.0 and bench.pilot.parameters.integer("GUID_OPTIONS") == 8
    bits = struct.unpack("<f", struct.pack("<i", 8))[0]
    (got,) = of("PARAM_VALUE", bench.ask(mav.MAVLink_param_set_message(1, 1, b"GUID_OPTIONS", bits, 6)))
    assert got.param_value == 0.0, "what a PX4 client would send sets 0"


@pytest.mark.parametrize(("sent", "stored"), [(2.6, 3), (300.0, 127), (-300.0, -128), (NAN, 10), (math.inf, 10)])
def test_integers_are_rounded_limited_and_kept_finite(sent: float, stored: int) -> None:
    bench = booted()
    got = of("PARAM_VALUE", bench.ask(mav.MAVLink_param_set_message(1, 1, b"DISARM_DELAY", sent, 2)))
    assert bench.pilot.parameters.integer("DISARM_DELAY") == stored
    assert [m.param_value for m in got] == ([stored] if math.isfinite(sent) else [])


def test_unknown_parameters_are_met_with_silence() -> None:
    bench = booted()
    assert not bench.ask(mav.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 1.0, 9))
    assert not bench.ask(mav.MAVLink_param_request_read_message(1, 1, b"COM_OF_LOSS_T", -1))
    assert not bench.ask(mav.MAVLink_param_request_read_message(1, 1, b"", 20000))


def test_the_whole_list() -> None:
    bench = booted()
    bench.ask(mav.MAVLink_param_request_list_message(1, 1))
    bench.run(0.1)
    got = of("PARAM_VALUE", bench.got)
    assert [m.param_id for m in got] == sorted(DEFAULTS)
    assert [m.param_index for m in got] == list(range(len(DEFAULTS)))


# --- boot ---


def test_boot_timeline() -> None:
    bench = Bench(ekf_ready_s=23.7, physics_hz=50)
    assert not bench.run(1.02) and bench.mode(GUIDED) is None, "not a word before 1.05 s, and deaf"
    assert of("HEARTBEAT", bench.run(0.06))
    assert bench.mode(GUIDED) == ACCEPTED
    assert of("HEARTBEAT", bench.got)[-1].custom_mode == GUIDED
    bench.got.clear()
    bench.run(2.4 - bench.t_s)
    assert all(m.custom_mode == GUIDED for m in of("HEARTBEAT", bench.got))
    assert of("HEARTBEAT", bench.run(0.1))[-1].custom_mode == STABILIZE, "at 2.45 s, by itself"
    bench.command(INTERVAL, 32, 100000)
    assert not of("LOCAL_POSITION_NED", bench.run(19.9 - bench.t_s)) and not bench.texts()
    got = bench.run(0.2)
    assert bench.texts() == ["EKF3 IMU0 origin set"] and of("LOCAL_POSITION_NED", got)
    assert of("HOME_POSITION", got) and of("GPS_GLOBAL_ORIGIN", got)
    bench.run(23.6 - bench.t_s)
    assert bench.arm() == FAILED
    bench.run(0.2)
    assert bench.arm() == ACCEPTED


def test_boot_is_scaled_by_when_it_can_be_armed() -> None:
    bench = Bench(ekf_ready_s=1.0)
    boot = bench.pilot.boot_times
    assert (boot.armable_us, boot.heartbeat_us) == (1_000_000, 44_304)
    bench.run(0.98)
    assert bench.arm() == FAILED
    bench.run(0.04)
    assert bench.arm() == ACCEPTED


def test_mavlink_1_is_understood_too() -> None:
    bench = booted()
    old = mav.MAVLink(None, srcSystem=255, srcComponent=190)
    bench.link.send(mav.MAVLink_set_mode_message(1, 1, GUIDED).pack(old, force_mavlink1=True))
    assert of("COMMAND_ACK", bench.run(0.004))[0].result == ACCEPTED


@pytest.mark.parametrize("frame", [b"", b"\xfd", b"\xfd\xff" * 20, bytes(range(64))])
def test_junk_is_ignored(frame: bytes) -> None:
    bench = booted()
    bench.link.send(frame)
    assert bench.mode(GUIDED) == ACCEPTED


# --- reboot, second link ---


def test_reboot_is_refused_armed_and_else_starts_everything_again() -> None:
    bench = armed()
    assert bench.command(246, 1) == FAILED
    bench.command(ARM, 0)
    bench.mode(LAND)
    bench.command(INTERVAL, 32, 20000)
    bench.pilot.parameters.assign("GUID_TIMEOUT", 1.0)
    stamp_ms = of("LOCAL_POSITION_NED", bench.run(2.0))[-1].time_boot_ms
    assert bench.command(246, 1) == ACCEPTED
    got = bench.run(0.3)
    assert of("LOCAL_POSITION_NED", got), "the ack has left first"
    assert not bench.run(1.2), "down"
    got = bench.run(1.0)
    assert of("HEARTBEAT", got)[0].custom_mode == STABILIZE
    assert not of("LOCAL_POSITION_NED", got), "rates are forgotten"
    bench.command(INTERVAL, 32, 20000)
    assert of("LOCAL_POSITION_NED", bench.run(0.1))[-1].time_boot_ms < stamp_ms, "its clock began again"
    assert bench.pilot.parameters.real("GUID_TIMEOUT") == 1.0, "parameters are not"


def test_a_reboot_in_the_air_moves_the_local_origin_and_stops_the_motors() -> None:
    bench = Bench().airborne(10.0)
    before = of("GPS_GLOBAL_ORIGIN", bench.got)[-1]
    bench.world.reboot(0, bench.world.since_boot_us)
    bench.run(0.5)
    assert bench.climb_m_s < -4.0 and not bench.pilot.armed
    bench.run(3.0)
    after_it = of("GPS_GLOBAL_ORIGIN", bench.got)[-1]
    assert after_it.altitude - before.altitude == pytest.approx(10_000, abs=300), "it was 10 m up"


def test_a_ground_stations_link_is_its_own() -> None:
    bench = Bench(gcs=True)
    bench.booted()
    bench.command(INTERVAL, 32, 20000)
    bench.arm()
    bench.run(1.0)
    heard = {m.get_type() for m in bench.got_by_gcs()}
    assert {"HEARTBEAT", "STATUSTEXT", "HOME_POSITION"} <= heard, "news go everywhere"
    assert not {"LOCAL_POSITION_NED", "COMMAND_ACK"} & heard, "rates and acks to whom asked"
