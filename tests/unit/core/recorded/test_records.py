"""The byte layout of tick records: nothing is lost on the way, and a cut message is refused."""

from __future__ import annotations

import math
import re
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.core.recorded.records import TICK_DTYPE, TRUTH_DTYPE, pack_tick, tick_row, unpack_tick
from swarmctl.core.recorded.tick_record import COLUMNS
from tests.benches.tick_records import PLAN, tick_record

RECORDED: dict[str, Any] = {
    "t_us": 9_000_000_000_001,
    "utc_us": 1_700_000_000_000_002,
    "seq": 4_000_000_003,
    "mission_t_s": 21.5,
    "phase": 6,
    "mode": 3,
    "flight_mode": 7,
    "armed": 1,
    "state_age_ms": 4.5,
    "pos_ned_m": [1.1, -2.2, -3.3],
    "vel_ned_m_s": [0.1, -0.2, 0.3],
    "q_nb": [0.5, -0.5, 0.25, 0.75],
    "ref_pos_ned_m": [7.0, 8.0, 9.0],
    "setpoint_q_nb": [1.0, 0.0, 0.125, 0.0],
    "setpoint_thrust_01": 0.625,
    "hover_thrust_01": 0.375,
    "disturbance_ned_m_s2": [0.0625, -0.5, 2.0],
    "nearest_peer_m": math.inf,
    "nearest_obstacle_m": 3.5,
    "plan_staleness_ms": 12.5,
    "peers": 513,
    "rejected": 70_000,
    "plan_status": 3,
    "slack_m": 0.03125,
    "residual_m": 0.015625,
    "iterations": 1_500,
    "solve_ms": 1.25,
    "tick_ms": 2.75,
    "deadline_misses": 65_537,
    "safety_filter_acted": 1,
}
# of a tick without state, reference, plan and setpoint
UNKNOWN: dict[str, Any] = {
    "state_age_ms": math.nan,
    "pos_ned_m": [math.nan] * 3,
    "vel_ned_m_s": [math.nan] * 3,
    "q_nb": [math.nan] * 4,
    "ref_pos_ned_m": [math.nan] * 3,
    "setpoint_q_nb": [math.nan] * 4,
    "setpoint_thrust_01": math.nan,
    "plan_status": 4,
    "slack_m": 0.0,
    "residual_m": 0.0,
    "iterations": 0,
}
TICK_BYTES = TICK_DTYPE.itemsize


def packed(**changed: Any) -> bytes:
    record = tick_record(**changed)
    return pack_tick(tick_row(record), record.flown)


def test_every_value_survives_the_bus() -> None:
    unpacked = unpack_tick(packed())
    assert unpacked is not None
    row, plan = unpacked
    for name, value in RECORDED.items():
        np.testing.assert_allclose(row[0][name], value, rtol=1e-7, err_msg=name)
    np.testing.assert_array_equal(plan, PLAN.pos_ned_m)
    assert plan.dtype == np.float64


def test_what_a_tick_does_not_know_is_not_recorded_as_zero() -> None:
    (row,) = tick_row(tick_record(state=None, reference=None, plan=None, flown=None, setpoint=None))
    for name, value in (RECORDED | UNKNOWN).items():
        np.testing.assert_allclose(row[name], value, rtol=1e-7, err_msg=name)


def test_what_a_controller_of_somebody_else_calls_a_number_is_recorded_too() -> None:
    odd = replace(PLAN, iterations=7.0, slack_m=np.float32(0.5), residual_m=1e300)  # type: ignore[arg-type]
    (row,) = tick_row(tick_record(plan=odd, safety_filter_acted=np.bool_(True), nearest_peer_m=4e38))
    assert (row["iterations"], row["slack_m"], row["residual_m"]) == (7, 0.5, math.inf)
    assert (row["safety_filter_acted"], row["nearest_peer_m"]) == (1, math.inf)
    np.testing.assert_array_equal(row["pos_ned_m"], RECORDED["pos_ned_m"])


def test_every_column_is_described_and_named_once() -> None:
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)
    for column in COLUMNS:
        assert len(column.text) > 3, column.name
        unit = re.search(r"_(m_s2|m_s|us|ms|s|m)$", column.name)
        assert column.unit == (unit[1].replace("m_s", "m/s") if unit else "0..1" if "_01" in column.name else "")
        assert isinstance(column.view, str) or not column.size, "a curve is of a scalar"


def test_bytes_are_little_endian_packed_and_of_fixed_place() -> None:
    payload = packed()
    assert struct.unpack_from("<qqI", payload) == (9_000_000_000_001, 1_700_000_000_000_002, 4_000_000_003)
    assert payload[28:32] == bytes([6, 3, 7, 1])  # phase TRACK, mode REPLAY, EXTERNAL, armed
    assert struct.unpack_from("<3d", payload, 36) == (1.1, -2.2, -3.3)
    # 20 header, 8 mission, 4 bytes, 4 age, 48 pos vel, 16 q, 24 ref, 16 q, 8, 12, 12, 2 + 4, 1, 8, 4, 8, 4, 1
    assert TICK_DTYPE.fields is not None
    assert TICK_DTYPE.fields["safety_filter_acted"][1] == 203  # later columns follow: older ones keep their places
    assert payload[TICK_BYTES : TICK_BYTES + 2] == b"\x04\x00"
    assert struct.unpack_from("<3f", payload, TICK_BYTES + 2) == (-2.5, -1.5, -0.5)
    assert len(payload) == TICK_BYTES + 2 + 4 * 12
    assert TRUTH_DTYPE.itemsize == 8 + 2 + 24 + 24 + 16 + 3


def test_no_plan_is_an_empty_plan() -> None:
    unpacked = unpack_tick(packed(flown=None))
    assert unpacked is not None
    assert unpacked[1].shape == (0, 3)


def test_every_truncation_and_every_extra_byte_is_refused() -> None:
    payload = packed()
    for length in range(len(payload)):
        assert unpack_tick(payload[:length]) is None, length
    assert unpack_tick(payload + b"\x00") is None


@pytest.mark.parametrize("points", [0, 3, 5, 65_535])
def test_a_count_that_does_not_fit_its_points_is_refused(points: int) -> None:
    payload = bytearray(packed())
    payload[TICK_BYTES : TICK_BYTES + 2] = struct.pack("<H", points)
    assert unpack_tick(bytes(payload)) is None


@given(st.binary(max_size=400))
def test_hostile_bytes_never_raise(payload: bytes) -> None:
    unpacked = unpack_tick(payload)
    assert unpacked is None or len(payload) == TICK_BYTES + 2 + 12 * len(unpacked[1])


def test_rows_of_a_file_are_an_array() -> None:
    rows = np.frombuffer(tick_row(tick_record()).tobytes() * 3, TICK_DTYPE)
    assert rows.shape == (3,)
    assert rows["deadline_misses"].tolist() == [65_537] * 3
