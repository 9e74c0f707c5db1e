"""Compact paths: bytes, how far points are rounded, what is encoded as float32 all the same, and what is refused."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.bus.messages.path_messages import (
    COMPACT_VERSION,
    FLOAT_VERSION,
    MAX_POINTS,
    decode_path,
    encode_path,
    longest_step_m,
    stamp_us,
)
from swarmctl.core.types import MAX_MARGIN_M, MIN_STEP_US, Array, PredictedPath
from tests import builders

STEP_S = 0.02
UTC_US = 1_800_000_000_000_000
COARSEST_M = 2.0**-10
MARGIN_M = 0.1
FLOAT32_M = 1e-7  # rounding of the margin


def flown(accel_ned_m_s2: Array, vel_ned_m_s: Array, pos_ned_m: Array) -> Array:
    """Points (K+2, 3) of a flight under accelerations (K, 3)."""
    steps = np.cumsum(np.vstack([vel_ned_m_s * STEP_S, accel_ned_m_s2 * STEP_S**2]), axis=0)
    return pos_ned_m + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def path(points: Array, margin_m: float = MARGIN_M) -> PredictedPath:
    return builders.predicted_path(
        agent=4, boot_id=7, seq=9, t0_utc_us=UTC_US, dt_us=20_000, margin_m=margin_m, pos_ned_m=points
    )


ANGLE = np.arange(41) * 0.02
CIRCLE = np.column_stack([5.0 * np.cos(ANGLE), 5.0 * np.sin(ANGLE), -3.0 - 0.5 * ANGLE])  # 5 m/s
EAST = np.outer(np.arange(41) * 0.1, [0.0, 1.0, 0.0])


def version(points: Array) -> int:
    return encode_path(path(points), compact=True)[2]


def sent(points: Array, margin_m: float = MARGIN_M) -> PredictedPath:
    """The path that receivers of a compact one have."""
    payload = encode_path(path(points, margin_m), compact=True)
    assert payload[2] == COMPACT_VERSION
    decoded = decode_path(payload)
    assert decoded is not None
    return decoded


@pytest.mark.parametrize("compact", [False, True])
def test_what_a_setpoint_asks_for_is_told_in_both_ways(compact: bool) -> None:
    asked = np.array([-3.2, 0.0004, 11.7])
    told = replace(path(CIRCLE), setpoint_accel_ned_m_s2=asked)
    payload = encode_path(told, compact=compact)
    decoded = decode_path(payload)
    assert decoded is not None and decoded.setpoint_accel_ned_m_s2 is not None
    np.testing.assert_allclose(decoded.setpoint_accel_ned_m_s2, asked, atol=2.0**-11)
    as_recorded = replace(told, setpoint_accel_ned_m_s2=asked.astype(np.float32))
    assert encode_path(as_recorded, compact=compact) == payload
    without = decode_path(encode_path(path(CIRCLE), compact=compact))
    assert without is not None and without.setpoint_accel_ned_m_s2 is None


def test_an_acceleration_beyond_what_fits_is_told_as_the_largest() -> None:
    decoded = decode_path(encode_path(replace(path(CIRCLE), setpoint_accel_ned_m_s2=np.array([-90.0, 90.0, 0.0]))))
    assert decoded is not None and decoded.setpoint_accel_ned_m_s2 is not None
    np.testing.assert_allclose(decoded.setpoint_accel_ned_m_s2, [-32.0, 32.0, 0.0], atol=0.01)


def rounded_m(points: Array, decoded: PredictedPath) -> float:
    return float(np.linalg.norm(decoded.pos_ned_m - points, axis=1).max())


def test_forty_steps_take_less_than_two_hundred_bytes() -> None:
    assert len(encode_path(path(CIRCLE), compact=True)) == 183
    assert len(encode_path(path(CIRCLE))) == 534


@pytest.mark.parametrize("compact", [True, False])
def test_points_that_agents_of_a_process_share_can_not_be_changed(compact: bool) -> None:
    payload = encode_path(path(CIRCLE), compact=compact)
    one, other = decode_path(payload), decode_path(payload)
    assert one is other and one is not None
    with pytest.raises(ValueError, match="read-only"):
        one.pos_ned_m[0] = 0.0


def test_all_but_points_and_margin_are_sent_as_they_are() -> None:
    decoded = sent(CIRCLE)
    assert (decoded.agent, decoded.boot_id, decoded.seq) == (4, 7, 9)
    assert (decoded.t0_utc_us, decoded.dt_us) == (UTC_US, 20_000)
    assert decoded.pos_ned_m.shape == CIRCLE.shape and decoded.pos_ned_m.dtype == np.float64


@given(
    st.lists(st.tuples(*[st.floats(-50.0, 50.0)] * 3), min_size=1, max_size=MAX_POINTS - 2),
    st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    st.tuples(*[st.floats(-10_000.0, 10_000.0)] * 3),
)
def test_peers_keep_as_much_more_as_points_are_rounded(
    accel: list[tuple[float, ...]], vel: tuple[float, ...], pos: tuple[float, ...]
) -> None:
    points = flown(np.array(accel), np.array(vel), np.array(pos))
    decoded = sent(points)
    assert MARGIN_M < decoded.margin_m < MARGIN_M + COARSEST_M
    assert rounded_m(points, decoded) <= decoded.margin_m - MARGIN_M + FLOAT32_M


def test_gentle_paths_are_rounded_less() -> None:
    assert rounded_m(CIRCLE, sent(CIRCLE)) < 2.0**-14
    assert rounded_m(EAST + 0.3 * 2.0**-16, sent(EAST)) < 2.0**-16


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("offset", [0.0, 0.25, 0.49, 0.51, 0.75])
def test_the_sharpest_bend_that_is_compact_fits_wherever_its_points_lie(sign: float, offset: float) -> None:
    bends = sign * 124.99 * COARSEST_M * (-1.0) ** np.arange(39)
    points = flown(np.outer(bends / STEP_S**2, np.ones(3)), np.zeros(3), np.full(3, offset * COARSEST_M))
    assert rounded_m(points, sent(points)) <= COARSEST_M


def test_the_margin_stays_within_its_limit() -> None:
    assert sent(CIRCLE, MAX_MARGIN_M).margin_m == MAX_MARGIN_M


def bent(by_m: float) -> Array:
    points = EAST.copy()
    points[20:, 0] += by_m
    return points


@pytest.mark.parametrize(
    "points",
    [
        bent(126.0 * COARSEST_M),
        bent(-126.0 * COARSEST_M),
        EAST + 2.0**14,
        EAST - 2.0**14,
        EAST[:2],
        np.full((41, 3), np.nan),
    ],
    ids=["bends too much", "to the other side", "too far away", "too far south", "two points", "not a number"],
)
def test_what_can_not_be_compact_is_sent_as_float32(points: Array) -> None:
    assert encode_path(path(points), compact=True) == encode_path(path(points))
    assert version(points) == FLOAT_VERSION


@pytest.mark.parametrize("points", [bent(124.0 * COARSEST_M), EAST + 2.0**14 - 5.0, EAST[:3]])
def test_what_is_just_within_the_limits_is_compact(points: Array) -> None:
    assert version(points) == COMPACT_VERSION


def changed(offset: int, code: str, value: int) -> bytes:
    payload = bytearray(encode_path(path(CIRCLE), compact=True))
    struct.pack_into(code, payload, offset, value)
    return bytes(payload)


@pytest.mark.parametrize(
    "payload",
    [
        encode_path(path(CIRCLE), compact=True)[:-1],
        encode_path(path(CIRCLE), compact=True) + b"\x00",
        changed(2, "<B", FLOAT_VERSION),
        changed(2, "<B", COMPACT_VERSION + 1),
        changed(32, "<B", 40),  # points
        changed(32, "<B", 42),
        changed(33, "<B", 35),  # header length
        changed(33, "<B", 41)[:-1],  # of which the body begins within the header, and has the right length
        changed(34, "<b", -17),  # exponent
        changed(34, "<b", -9),
        changed(34, "<b", 127),
        changed(24, "<i", MIN_STEP_US - 1),
        changed(42 + 12, "<i", 2**20),  # first step
        changed(32, "<B", 2)[: 42 + 24],
    ],
)
def test_malformed_compact_paths_are_refused(payload: bytes) -> None:
    assert decode_path(payload) is None


def test_a_longer_header_of_a_later_minor_version_is_skipped() -> None:
    payload = changed(33, "<B", 45)
    decoded = decode_path(payload[:42] + b"new" + payload[42:])
    assert decoded is not None
    np.testing.assert_array_equal(decoded.pos_ned_m, sent(CIRCLE).pos_ned_m)


@pytest.mark.parametrize(("flags", "is_told"), [(0, False), (1, True), (2, False), (3, True), (254, False)])
def test_flags_of_a_later_version_tell_of_no_acceleration(flags: int, is_told: bool) -> None:
    """What is not told must not be read as a setpoint that asks for none: peers expect the vehicle elsewhere."""
    decoded = decode_path(changed(3, "<B", flags))
    assert decoded is not None
    assert (decoded.setpoint_accel_ned_m_s2 is not None) is is_told


def test_the_time_of_a_path_is_read_without_the_path() -> None:
    """Paths of two topics are put into the order of their times before they are checked."""
    payload = encode_path(path(CIRCLE), compact=True)
    assert stamp_us(payload) == stamp_us(encode_path(path(CIRCLE))) == stamp_us(payload[:42]) == UTC_US
    assert [stamp_us(payload[:size]) for size in (0, 1, 41)] == [0, 0, 0]


def test_the_longest_step_is_how_far_a_vehicle_may_come_between_two_points() -> None:
    """In space, whatever the other steps are; a path that is none goes nowhere."""
    points = np.outer(np.arange(5), [0.25, 0.0, 0.0])
    points[3:] += (0.5, -1.0, 0.25)  # one step of (0.75, -1, 0.25)
    assert longest_step_m(encode_path(path(points))) == pytest.approx(np.linalg.norm((0.75, -1.0, 0.25)))
    assert longest_step_m(encode_path(path(points))[:-1]) == 0.0


@given(st.binary(min_size=24 + 117, max_size=24 + 117))
def test_hostile_bodies_give_a_finite_path_or_none(body: bytes) -> None:
    decoded = decode_path(encode_path(path(CIRCLE), compact=True)[:42] + body)
    assert decoded is None or np.isfinite(decoded.pos_ned_m).all()
