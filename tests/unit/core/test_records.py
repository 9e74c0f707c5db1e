"""The byte layout of tick records: nothing is lost on the way, and a cut message is refused."""

from __future__ import annotations

import math
import struct
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.core.records import TICK_DTYPE, TRUTH_DTYPE, pack_tick, tick_row, unpack_tick
from swarmctl.core.types import FlightMode, Mode, Phase, PlanStatus, TickRecord

PLAN = np.arange(12.0).reshape(4, 3) - 2.5


def record(plan: np.ndarray = PLAN) -> TickRecord:
    """Every number different, so that swapped fields are noticed."""
    return TickRecord(
        t_us=9_000_000_000_001,
        utc_us=1_700_000_000_000_002,
        seq=4_000_000_003,
        mission_t_s=math.nan,
        phase=Phase.TRACK,
        mode=Mode.REPLAY,
        flight_mode=FlightMode.EXTERNAL,
        armed=True,
        state_age_ms=4.5,
        pos_ned_m=np.array([1.1, -2.2, -3.3]),
        vel_ned_m_s=np.array([0.1, -0.2, 0.3]),
        q_nb=np.array([0.5, -0.5, 0.25, 0.75]),
        ref_pos_ned_m=np.array([7.0, 8.0, 9.0]),
        setpoint_q_nb=np.array([1.0, 0.0, 0.125, 0.0]),
        setpoint_thrust_01=0.625,
        hover_thrust_01=0.375,
        disturbance_ned_m_s2=np.array([0.0625, -0.5, 2.0]),
        nearest_peer_m=math.inf,
        nearest_obstacle_m=3.5,
        plan_staleness_ms=12.5,
        peers=513,
        rejected=70_000,
        plan_status=PlanStatus.NOT_CERTIFIED,
        slack_m=0.03125,
        residual_m=0.015625,
        iterations=1_500,
        solve_ms=1.25,
        tick_ms=2.75,
        deadline_misses=65_537,
        safety_filter_acted=True,
        plan_pos_ned_m=plan,
    )


def test_every_field_survives_the_bus() -> None:
    unpacked = unpack_tick(pack_tick(record()))
    assert unpacked is not None
    row, plan = unpacked
    for field in fields(TickRecord):
        if field.name != "plan_pos_ned_m":
            np.testing.assert_allclose(row[0][field.name], getattr(record(), field.name), rtol=1e-7, err_msg=field.name)
    np.testing.assert_array_equal(plan, PLAN)
    assert plan.dtype == np.float64


def test_every_field_of_a_record_is_in_the_table() -> None:
    assert {field.name for field in fields(TickRecord)} == {*(TICK_DTYPE.names or ()), "plan_pos_ned_m"}


def test_bytes_are_little_endian_packed_and_of_fixed_place() -> None:
    payload = pack_tick(record())
    assert struct.unpack_from("<qqI", payload) == (9_000_000_000_001, 1_700_000_000_000_002, 4_000_000_003)
    assert payload[28:32] == bytes([6, 3, 7, 1])  # phase TRACK, mode REPLAY, EXTERNAL, armed
    assert struct.unpack_from("<3d", payload, 36) == (1.1, -2.2, -3.3)
    # 20 header, 8 mission, 4 bytes, 4 age, 48 pos vel, 16 q, 24 ref, 16 q, 8, 12, 12, 2 + 4, 1, 8, 4, 8, 4, 1
    assert TICK_DTYPE.itemsize == 204
    assert payload[204:206] == b"\x04\x00"
    assert struct.unpack_from("<3f", payload, 206) == (-2.5, -1.5, -0.5)
    assert len(payload) == 204 + 2 + 4 * 12
    assert TRUTH_DTYPE.itemsize == 8 + 2 + 24 + 24 + 16 + 3


def test_no_plan_is_an_empty_plan() -> None:
    unpacked = unpack_tick(pack_tick(record(np.empty((0, 3)))))
    assert unpacked is not None
    assert unpacked[1].shape == (0, 3)


def test_every_truncation_and_every_extra_byte_is_refused() -> None:
    payload = pack_tick(record())
    for length in range(len(payload)):
        assert unpack_tick(payload[:length]) is None, length
    assert unpack_tick(payload + b"\x00") is None


@pytest.mark.parametrize("points", [0, 3, 5, 65_535])
def test_a_count_that_does_not_fit_its_points_is_refused(points: int) -> None:
    payload = bytearray(pack_tick(record()))
    payload[204:206] = struct.pack("<H", points)
    assert unpack_tick(bytes(payload)) is None


@given(st.binary(max_size=400))
def test_hostile_bytes_never_raise(payload: bytes) -> None:
    unpacked = unpack_tick(payload)
    assert unpacked is None or len(payload) == 205 + 12 * len(unpacked[1])


def test_rows_of_a_file_are_an_array() -> None:
    rows = np.frombuffer(tick_row(record()).tobytes() * 3, TICK_DTYPE)
    assert rows.shape == (3,)
    assert rows["deadline_misses"].tolist() == [65_537] * 3
