"""Paths and messages survive encoding; anything else decodes to None and never raises."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.bus import topics
from swarmctl.bus.messages import path_messages
from swarmctl.bus.messages.commitment_messages import MAX_PEERS, MAX_POINTS, encode_trajectory_message
from swarmctl.bus.messages.json_messages import (
    MAX_OBSTACLES,
    MAX_REASON,
    AnswerMessage,
    CommandMessage,
    EndedMessage,
    StatusMessage,
    decode_answer,
    decode_command,
    decode_ended,
    decode_obstacles,
    decode_status,
    encode_message,
    first_list,
)
from swarmctl.bus.messages.path_messages import decode_path, encode_path
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import OPERATOR_VERBS, OperatorVerb, Order, VerbArgument
from swarmctl.core.recorded.records import TICK_DTYPE
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, Proposal
from swarmctl.core.types import MAX_MARGIN_M, MAX_SPEED_M_S, MAX_STEP_US, MIN_STEP_US, PredictedPath
from tests import builders

POINTS = np.array([[1.5, -2.25, -3.0], [1.625, -2.0, -3.5], [1.75, -1.75, -4.0]])
UTC_US = 1_700_000_000_123_456
ALL_DECODERS = (decode_path, decode_status, decode_command, decode_answer, decode_ended, decode_obstacles)

STATUS = StatusMessage(
    agent=2,
    boot_id=9,
    sysid=3,
    phase=6,
    mode=2,
    flight_mode=7,
    armed=True,
    landed=2,
    held=True,
    control="TRACKING",
    altitude_m=5.0,
    ground_speed_m_s=1.5,
    battery_01=0.75,
    pos_accuracy_m=0.25,
    gps_fix=3,
    satellites=10,
    link_age_ms=8.5,
    ready_utc_us=UTC_US,
    mission_t_s=12.5,
    ends_in_s=25.25,
    outcome="",
    position_error_m=0.25,
    separation_m=-1.0,
    tick_p99_ms=3.5,
    ticks=1000,
    deadline_misses=2,
    plan_staleness_ms=41.5,
    solver_failed=1,
    active_alert="plan residual",
    alert_age_s=2.5,
    uses_commitments=False,
    utc_us=UTC_US,
)
ANSWER = AnswerMessage(
    agent=2, boot_id=9, verb="hold", number=2**53, accepted=False, reason="it is in STANDBY", utc_us=UTC_US
)


def path(points: np.ndarray = POINTS, dt_us: int = 20_000, margin_m: float = 0.5) -> PredictedPath:
    return builders.predicted_path(
        agent=4, boot_id=0xFFFFFFFF, seq=123_456, t0_utc_us=UTC_US, dt_us=dt_us, margin_m=margin_m, pos_ned_m=points
    )


def test_a_path_survives_encoding() -> None:
    decoded = decode_path(encode_path(path()))
    assert decoded is not None
    assert (decoded.agent, decoded.boot_id, decoded.seq) == (4, 0xFFFFFFFF, 123_456)
    assert (decoded.t0_utc_us, decoded.dt_us, decoded.margin_m) == (UTC_US, 20_000, 0.5)
    np.testing.assert_array_equal(decoded.pos_ned_m, POINTS)
    assert decoded.pos_ned_m.dtype == np.float64


def test_bytes_of_a_path_parsed_by_hand() -> None:
    payload = encode_path(path())
    assert payload[:4] == b"SP\x03\x00"
    assert struct.unpack_from("<III", payload, 4) == (4, 0xFFFFFFFF, 123_456)
    assert struct.unpack_from("<q", payload, 16) == (UTC_US,)
    assert struct.unpack_from("<if", payload, 24) == (20_000, 0.5)
    assert payload[32:36] == bytes([3, 42, 0, 0])
    assert payload[36:42] == bytes(6)
    assert struct.unpack_from("<9f", payload, 42) == tuple(POINTS.ravel())
    assert len(payload) == 42 + 9 * 4


def test_an_acceleration_follows_as_a_flag_says() -> None:
    payload = encode_path(replace(path(), setpoint_accel_ned_m_s2=np.array([1.0, -2.0, 0.5])))
    assert payload[3] == 1
    assert struct.unpack_from("<3h", payload, 36) == (1024, -2048, 512)


def changed(offset: int, code: str, value: float) -> bytes:
    payload = bytearray(encode_path(path()))
    struct.pack_into(code, payload, offset, value)
    return bytes(payload)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("number", range(9))
def test_a_number_that_is_not_finite_is_refused(number: int, bad: float) -> None:
    assert decode_path(changed(42 + 4 * number, "<f", bad)) is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        encode_path(path())[:41],
        encode_path(path())[:-1],
        encode_path(path()) + b"\x00",
        changed(0, "<B", ord("X")),
        changed(2, "<B", 5),  # a version from the future
        changed(24, "<i", 0),  # dt
        changed(24, "<i", -20_000),
        changed(24, "<i", MIN_STEP_US - 1),
        changed(24, "<i", MAX_STEP_US + 1),
        changed(42 + 3 * 4, "<f", POINTS[0, 0] + 1.01 * MAX_SPEED_M_S * 0.02),  # in the second point
        changed(42 + 8 * 4, "<f", POINTS[1, 2] - 1.01 * MAX_SPEED_M_S * 0.02),
        changed(28, "<f", math.nan),  # radius
        changed(28, "<f", math.inf),
        changed(28, "<f", -0.5),
        changed(28, "<f", MAX_MARGIN_M + 0.01),
        changed(32, "<B", 2),  # count
        changed(32, "<B", 4),
        changed(33, "<B", 41),  # header length
        changed(33, "<B", 0),
        changed(32, "<H", 4 | 30 << 8),  # four points from within the header: the length would fit
        encode_path(path(POINTS[:1])),
        encode_path(path(np.zeros((251, 3)))),
    ],
)
def test_malformed_paths_are_refused(payload: bytes) -> None:
    assert decode_path(payload) is None


@pytest.mark.parametrize("count", [2, 250])
def test_limits_of_the_number_of_points_are_inclusive(count: int) -> None:
    decoded = decode_path(encode_path(path(np.full((count, 3), 1.0))))
    assert decoded is not None
    assert len(decoded.pos_ned_m) == count


def test_a_longer_header_of_a_later_minor_version_is_skipped() -> None:
    payload = changed(33, "<B", 50)
    decoded = decode_path(payload[:42] + b"\xff" * 8 + payload[42:])
    assert decoded is not None
    np.testing.assert_array_equal(decoded.pos_ned_m, POINTS)


@given(st.binary(max_size=200))
def test_hostile_bytes_give_none(payload: bytes) -> None:
    for decode in ALL_DECODERS:
        assert decode(payload) is None


@given(st.binary(min_size=74, max_size=74), st.integers(0, 40))
def test_hostile_bodies_behind_a_good_beginning_give_a_sane_path_or_none(tail: bytes, keep: int) -> None:
    good = encode_path(path())
    decoded = decode_path(good[: 4 + keep] + tail[: len(good) - 4 - keep])
    if decoded is not None:
        assert np.isfinite(decoded.pos_ned_m).all()
        assert decoded.dt_us > 0
        assert math.isfinite(decoded.margin_m)
        assert decoded.margin_m >= 0.0


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=6,
)


@given(st.sampled_from(STATUS.__struct_fields__), json_values)
def test_a_status_with_one_hostile_field_is_none_or_well_typed(name: str, value: object) -> None:
    tree = msgspec.to_builtins(STATUS) | {name: value}
    try:
        payload = msgspec.json.encode(tree)
    except (OverflowError, UnicodeEncodeError, msgspec.MsgspecError):
        return
    decoded = decode_status(payload)
    if decoded is not None:
        for field in STATUS.__struct_fields__:
            found = getattr(decoded, field)
            assert type(found) is type(getattr(STATUS, field))
            assert not isinstance(found, float) or math.isfinite(found)


@pytest.mark.parametrize("decode", [decode_status, decode_command, decode_answer, decode_ended, decode_obstacles])
@pytest.mark.parametrize(
    "payload",
    [
        b'{"verb":"\xff\xfe","agent":1,"utc_us":1}',  # not UTF-8 where text is compared
        b'{"outcome":"\xff\xfe"}',
        b'{"x":' + b"[" * 100_000,  # an unknown key, deeper than any parser's stack
        b'{"x":' * 100_000,
    ],
    ids=["not utf-8 verb", "not utf-8 outcome", "deep lists", "deep objects"],
)
def test_hostile_text_gives_none_and_never_raises(decode: object, payload: bytes) -> None:
    assert callable(decode)
    assert decode(payload) is None


def test_messages_survive_encoding() -> None:
    assert decode_status(encode_message(STATUS)) == STATUS
    for command in (CommandMessage("rtl", -1, UTC_US), CommandMessage("rtl", 2, UTC_US, {}, 2**62)):
        assert decode_command(encode_message(command)) == command
    assert decode_answer(encode_message(ANSWER)) == ANSWER
    for ended in (EndedMessage(agent=2, boot_id=boot_id, is_down=True) for boot_id in (9, None)):
        assert decode_ended(encode_message(ended)) == ended
    obstacle = Obstacle(
        center_ned_m=(9.5, 5.5, -2.3), radius_m=1.0, keep_out_m=1.75, visibility_m=3.0, vel_ned_m_s=(0.0, -0.5, 0.0)
    )
    obstacles = first_list((obstacle, obstacle), UTC_US, version=3)
    assert decode_obstacles(encode_message(obstacles)) == obstacles


CLIMB = OperatorVerb(
    help="Climb.",
    phases=frozenset({"TRACK"}),
    arguments=(
        VerbArgument(name="height_m", option="--height", help="Height [m].", least=0.5, most=20.0),
        VerbArgument(name="speed_m_s", option="--speed", help="Speed [m/s].", least=0.0, most=3.0),
    ),
)


def climb(arguments: object) -> bytes:
    return msgspec.json.encode({"verb": "climb", "agent": -1, "utc_us": 1, "arguments": arguments})


def test_arguments_of_an_order_arrive_in_bounds_or_not_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(OPERATOR_VERBS, "climb", CLIMB)
    message = decode_command(climb({"height_m": 20, "speed_m_s": 0.0}))
    assert message is not None
    assert message.order == Order("climb", {"height_m": 20.0, "speed_m_s": 0.0})
    assert decode_command(encode_message(message)) == message
    refused: list[object] = [{}, None, [], {"height_m": 2.0}, {"height_m": 2.0, "speed_m_s": 1.0, "yaw_rad": 0.0}]
    refused += [{"height_m": value, "speed_m_s": 1.0} for value in (0.49, 20.1, 1e308, "2", True, None, [2.0])]
    for arguments in refused:
        assert decode_command(climb(arguments)) is None, arguments
    for text in (b"1e999", b"NaN", b"-1e400"):
        assert decode_command(climb({"height_m": 7, "speed_m_s": 1.0}).replace(b"7", text)) is None
    assert decode_command(climb({f"k{k}": 0.0 for k in range(9)})) is None
    assert decode_command(climb({"k" * 33: 0.0})) is None


@pytest.mark.parametrize(
    ("verb", "names", "fits"),
    [
        ("v" * 32, ["n" * 32], True),
        ("v" * 33, [], False),
        ("climb", ["n" * 33], False),
        ("climb", [f"n{k}" for k in range(8)], True),
        ("climb", [f"n{k}" for k in range(9)], False),
    ],
)
def test_words_and_arguments_of_an_order_are_bounded_whatever_verbs_there_are(
    monkeypatch: pytest.MonkeyPatch, verb: str, names: list[str], fits: bool
) -> None:
    arguments = tuple(VerbArgument(name=name, option="--x", help="x", least=0.0, most=1.0) for name in names)
    monkeypatch.setitem(OPERATOR_VERBS, verb, OperatorVerb(help="x", phases=frozenset(), arguments=arguments))
    body = {"verb": verb, "agent": -1, "utc_us": 1, "arguments": dict.fromkeys(names, 0.5)}
    assert (decode_command(msgspec.json.encode(body)) is not None) is fits


def test_verbs_without_arguments_take_none() -> None:
    for verb in ("hold", "resume", "land", "rtl"):
        body = {"verb": verb, "agent": -1, "utc_us": 1}
        assert decode_command(msgspec.json.encode(body)) is not None, "of an operator before there were arguments"
        assert decode_command(msgspec.json.encode(body | {"arguments": {"height_m": 1.0}})) is None


@pytest.mark.parametrize("verb", ["disarm", "kill", "", "LAND"])
def test_only_verbs_of_the_operator_are_known(verb: str) -> None:
    assert decode_command(msgspec.json.encode({"verb": verb, "agent": -1, "utc_us": 1})) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [("phase", 10), ("phase", -1), ("mode", 99), ("mode", -1), ("flight_mode", 99), ("flight_mode", -1)],
)
def test_a_status_of_a_phase_or_mode_that_does_not_exist_is_refused(name: str, value: int) -> None:
    # the agent makes `Phase(status.phase)` of it within the tick
    assert decode_status(msgspec.json.encode(msgspec.to_builtins(STATUS) | {name: value})) is None


def obstacles(**fields: object) -> bytes:
    good = {"center_ned_m": [0, 0, 0], "radius_m": 1.0, "keep_out_m": 1.75, "visibility_m": 3.0}
    listed = {"number": 0, "since_utc_us": UTC_US, "obstacle": good | fields}
    return msgspec.json.encode({"version": 1, "utc_us": UTC_US, "next_number": 1, "obstacles": [listed]})


@pytest.mark.parametrize(
    "fields",
    [
        {"radius_m": None},
        {"center_ned_m": [0.0, 0.0]},
        {"center_ned_m": [0.0, 0.0, 0.0, 0.0]},
        {"keep_out_m": "1.75"},
        {"keep_out_m": -1.0},
        {"radius_m": -1.0},
        {"visibility_m": -1.0},
    ],
)
def test_obstacles_that_make_no_sense_are_refused(fields: dict[str, object]) -> None:
    assert decode_obstacles(obstacles()) is not None
    assert decode_obstacles(obstacles(**fields)) is None


@pytest.mark.parametrize("key", ["center_ned_m", "radius_m", "keep_out_m", "visibility_m"])
def test_no_size_of_an_obstacle_is_made_up_for_its_sender(key: str) -> None:
    message = msgspec.json.decode(obstacles())
    del message["obstacles"][0]["obstacle"][key]
    assert decode_obstacles(msgspec.json.encode(message)) is None
    assert decode_obstacles(obstacles(height_m=3.0)) is None, "an unknown key"


def test_numbers_beyond_a_double_are_refused() -> None:
    assert decode_obstacles(obstacles().replace(b"1.75", b"1e999")) is None
    assert decode_obstacles(obstacles().replace(b"1.75", b"NaN")) is None


def test_every_topic_has_its_own_name_and_few_old_paths_are_kept() -> None:
    assert len({topic.name for topic in topics.TOPICS}) == len(topics.TOPICS)
    assert max(topics.PATH.ring, topics.STATUS.ring, topics.TRAJECTORY.ring) <= 8
    assert topics.OBSTACLES.ring <= 4
    assert topics.COMMAND.reliable
    assert topics.OBSTACLES.reliable


def test_lists_and_numbers_from_outside_are_bounded() -> None:
    ball = Obstacle(center_ned_m=(9.5, 5.5, -2.3))
    most = first_list((ball,) * MAX_OBSTACLES, UTC_US)
    assert decode_obstacles(encode_message(most)) == most
    assert len(encode_message(most)) <= topics.OBSTACLES.max_bytes
    assert decode_obstacles(encode_message(first_list((ball,) * (MAX_OBSTACLES + 1), UTC_US))) is None
    for fields in ({"center_ned_m": [0, 0, 1e5]}, {"vel_ned_m_s": [-1e5, 0, 0]}, {"keep_out_m": 1e5}):
        assert decode_obstacles(obstacles(**fields)) is None
    for fields in ({"radius_m": 1.76}, {"keep_out_m": 0.9}, {"keep_out_m": 3.0}, {"visibility_m": 1.75}):
        assert decode_obstacles(obstacles(**fields)) is None
    for name in ("agent", "boot_id", "ticks", "ready_utc_us", "utc_us", "deadline_misses", "solver_failed"):
        assert decode_status(status(name, -1)) is decode_status(status(name, 10**30)) is None
    for name in ("sysid", "landed", "gps_fix", "satellites"):
        assert decode_status(status(name, -1)) is not None, "unknown"
        assert all(decode_status(status(name, value)) is None for value in (2**31, -(2**31) - 1, 10**400))
    assert decode_command(encode_message(CommandMessage("hold", -1, UTC_US)).replace(b"-1", b"1" + 400 * b"0")) is None


def status(name: str, value: int) -> bytes:
    return msgspec.json.encode(msgspec.to_builtins(STATUS)).replace(
        f'"{name}":{getattr(STATUS, name)}'.encode(), f'"{name}":{value}'.encode()
    )


def test_the_longest_good_message_of_every_topic_fits() -> None:
    path = builders.predicted_path(
        agent=0, boot_id=0, seq=0, dt_us=MIN_STEP_US, pos_ned_m=np.zeros((path_messages.MAX_POINTS, 3))
    )
    assert len(encode_path(path)) <= topics.PATH.max_bytes
    trajectory = Trajectory(
        t0_utc_us=0, dt_us=MIN_STEP_US, pos_ned_m=np.zeros((MAX_POINTS, 3)), vel_ned_m_s=np.zeros((MAX_POINTS, 3))
    )
    acknowledged = dict.fromkeys(range(MAX_PEERS), 2**60)
    message = builders.trajectory_message(
        agent=0,
        boot_id=0,
        seq=0,
        committed=trajectory,
        proposal=Proposal(number=1, made_utc_us=0, agent=0, trajectory=trajectory),
        acknowledged=acknowledged,
        exclusions=Exclusions(suspected=frozenset(range(MAX_PEERS)), promised=frozenset(range(MAX_PEERS))),
    )
    assert len(encode_trajectory_message(message)) <= topics.TRAJECTORY.max_bytes
    assert TICK_DTYPE.itemsize + 12 * path_messages.MAX_POINTS <= topics.TICK.max_bytes
    status = msgspec.structs.replace(STATUS, outcome="x" * 4000, active_alert="\u20ac" * 4000)
    assert len(encode_message(status)) <= topics.STATUS.max_bytes
    assert len(encode_message(CommandMessage("resume", -1, 2**62, {}, 2**62))) <= topics.COMMAND.max_bytes
    answer = msgspec.structs.replace(ANSWER, verb="\u20ac" * 32, reason="\U0001f6f8" * MAX_REASON)
    assert decode_answer(encode_message(answer)) == answer
    assert len(encode_message(answer)) <= topics.ANSWER.max_bytes
    longer = msgspec.structs.replace(ANSWER, reason="x" * (MAX_REASON + 1))
    assert decode_answer(encode_message(longer)) is None


def test_the_table_of_topics_is_all_that_the_router_loads_of_messages() -> None:
    """It passes payloads on unread: validation and numpy would be a third of its memory."""
    code = "import sys, swarmctl.bus.network.router; print({'pydantic', 'numpy', 'msgspec'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


HOSTILE = "\x1b]0;owned\x07\x9b2J\u202e"


def test_text_of_others_controls_no_terminal() -> None:
    status = msgspec.structs.replace(STATUS, outcome=HOSTILE, active_alert=HOSTILE, control="\x9b2J")
    received = decode_status(encode_message(status))
    assert received is not None
    assert received.outcome == received.active_alert == r"\x1b]0;owned\x07\x9b2J\u202e"
    assert received.control == r"\x9b2J"
    answer = decode_answer(encode_message(msgspec.structs.replace(ANSWER, reason=HOSTILE)))
    assert answer is not None
    assert answer.reason == received.outcome


def test_two_obstacles_of_one_number_are_refused() -> None:
    good = first_list((Obstacle(center_ned_m=(9.5, 5.5, -2.3)),) * 2, UTC_US)
    for number in (0, 2):  # twice, and one that a later one would get
        last = msgspec.structs.replace(good.obstacles[1], number=number)
        wrong = msgspec.structs.replace(good, obstacles=(good.obstacles[0], last))
        assert decode_obstacles(encode_message(wrong)) is None


def test_an_obstacle_is_listed_where_it_is_at_the_time() -> None:
    (item,) = first_list([Obstacle(center_ned_m=(1.0, 2.0, -3.0), vel_ned_m_s=(0.5, 0.0, -0.1))], UTC_US).obstacles
    assert item.at(UTC_US + 4_000_000).center_ned_m == pytest.approx((3.0, 2.0, -3.4))
    still = first_list([Obstacle(center_ned_m=(1.0, 2.0, -3.0))], UTC_US).obstacles[0]
    assert still.at(0) is still.obstacle
