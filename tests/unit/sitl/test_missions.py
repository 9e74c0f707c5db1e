"""Missions: transfer, refusals, flight; geofences, battery, link and position failsafes."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.net.mavlink_values import Result
from sitl.px4.modes import MavState, MissionState, Px4Mode
from swarmctl.core.types import Landed
from tests.benches.px4_bench import COARSE, NAN, Bench, taken_off

RELATIVE = 6  # GLOBAL_RELATIVE_ALT_INT
ACK, REQUEST, COUNT, ITEM, CURRENT, REACHED, TEXT = 47, 51, 44, 73, 42, 46, 253
MISSION, FENCE = 0, 1
HOLD, RTL, LAND = Px4Mode.AUTO_LOITER, Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND
Place = tuple[float, float]


def item(
    bench: Bench,
    seq: int,
    command: int,
    place: Place = (0.0, 0.0),
    height_m: float = 5.0,
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, NAN),
    kind: int = MISSION,
    frame: int = RELATIVE,
) -> Any:
    """MISSION_ITEM_INT at metres north and east of the vehicle's origin."""
    origin = bench.pilot.boot.origin
    assert origin is not None
    lat_e7, lon_e7 = origin.to_geo_e7(*place)
    return mav.MAVLink_mission_item_int_message(
        1, 1, seq, frame, command, 0, 1, *params, lat_e7, lon_e7, height_m, kind
    )


def upload(bench: Bench, items: list[Any], kind: int = MISSION) -> int:
    """Result of a transfer."""
    bench.forget()
    bench.send(mav.MAVLink_mission_count_message(1, 1, len(items), kind))
    for _ in range(len(items) + 2):
        bench.run(0.01)
        if bench.said(ACK):
            break
        asked = bench.said(REQUEST)[-1]
        bench.send(items[asked.seq])
    (ack,) = bench.said(ACK)
    assert ack.mission_type == kind
    return int(ack.type)


def circle(bench: Bench, radius_m: float, *, keep_in: bool = True) -> list[Any]:
    command = mav.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION if keep_in else mav.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION
    return [item(bench, 0, command, params=(radius_m, 0, 0, 0), kind=FENCE)]


def square(bench: Bench, half_m: float) -> list[Any]:
    command = mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
    corners = ((half_m, half_m), (half_m, -half_m), (-half_m, -half_m), (-half_m, half_m))
    return [item(bench, i, command, c, params=(4, 0, 0, 0), kind=FENCE) for i, c in enumerate(corners)]


# --- transfer ---


@pytest.mark.parametrize(
    ("change", "result"),
    [
        ({"command": 16, "frame": 1}, 2),  # LOCAL_NED
        ({"command": 30000}, 3),
        ({"command": 5003, "params": (5.0, 0, 0, 0)}, 3),  # a fence item in a mission
        ({"command": 16, "height_m": NAN}, 12),
        ({"command": 5003, "kind": FENCE, "params": (-1.0, 0, 0, 0)}, 6),
        ({"command": 5001, "kind": FENCE, "params": (2.0, 0, 0, 0)}, 6),
        ({"command": 16, "kind": FENCE}, 3),
    ],
)
def test_what_px4_refuses_is_refused_and_the_old_mission_stays(change: dict[str, Any], result: int) -> None:
    bench = Bench()
    assert upload(bench, [item(bench, 0, 16)]) == 0
    kind = change.get("kind", MISSION)
    assert upload(bench, [item(bench, 0, **change)], kind) == result
    assert [i.command for i in bench.pilot.store.mission] == [16]


def test_transfers_that_can_not_be() -> None:
    bench = Bench()
    for message, result in (
        (mav.MAVLink_mission_count_message(1, 1, 60000, MISSION), 4),
        (mav.MAVLink_mission_count_message(1, 1, 1, 77), 3),
        (item(bench, 0, 16), 1),  # nobody asked for it
    ):
        bench.forget()
        bench.send(message)
        bench.run(0.01)
        assert [m.type for m in bench.said(ACK)] == [result]


def test_an_upload_asks_again_and_gives_up() -> None:
    bench = Bench()
    bench.send(mav.MAVLink_mission_count_message(1, 1, 2, MISSION))
    bench.run(1.0)
    assert {m.seq for m in bench.said(REQUEST)} == {0}
    assert 3 <= len(bench.said(REQUEST)) <= 5
    bench.run(5.0)
    bench.forget()
    bench.run(1.0)
    assert not bench.said(REQUEST)


# --- flight ---


def test_a_mission_is_flown_item_by_item() -> None:
    """Take-off, a waypoint, a stay, a speed, a landing elsewhere: where it is when, and what is told of it."""
    bench = Bench("x500", **COARSE)
    stay = item(bench, 2, 19, (8.0, 6.0), 4.0, (2.0, 0, 0, NAN))
    speed = item(bench, 3, 178, params=(1.0, 3.0, -1.0, 0.0), frame=2)
    parts = [item(bench, 0, 22, height_m=4.0), item(bench, 1, 16, (8.0, 0.0), 4.0), stay, speed]
    assert upload(bench, [*parts, item(bench, 4, 21, (3.0, 6.0), 0.0)]) == 0
    assert bench.pilot.store.progress(flying=False, finished=False).state == MissionState.NOT_STARTED
    assert bench.command(300, 0, 0) == Result.ACCEPTED
    assert (bench.pilot.armed, bench.pilot.mode) == (True, Px4Mode.AUTO_MISSION)
    bench.forget()
    at: dict[int, tuple[float, float, float]] = {}
    for _ in range(600):
        bench.run(0.1)
        for m in bench.said(REACHED):
            truth = bench.world.truth_rows()[0]["pos_ned_m"]
            at.setdefault(m.seq, (float(truth[0]) - 1.0, float(truth[1]) - 2.0, bench.height_m))
        if not bench.pilot.armed:
            break
    assert list(at) == [0, 1, 2, 3, 4]
    assert at[0][2] == pytest.approx(4.0, abs=0.3)
    assert at[1][:2] == pytest.approx((8.0, 0.0), abs=2.1)  # NAV_ACC_RAD
    assert at[2][:2] == pytest.approx((8.0, 6.0), abs=2.1)
    assert at[4] == pytest.approx((3.0, 6.0, 0.0), abs=0.5)
    assert bench.pilot.landed == Landed.ON_GROUND
    assert {m.mission_state for m in bench.said(CURRENT)} >= {MissionState.ACTIVE, MissionState.COMPLETE}


def test_the_current_item_can_be_chosen_in_flight() -> None:
    bench = taken_off("x500")
    assert upload(bench, [item(bench, 0, 16, (30.0, 0.0)), item(bench, 1, 16, (0.0, 12.0))]) == 0
    assert bench.mode(4, 4) == Result.ACCEPTED
    bench.run(1.0)
    assert bench.command(224, 1) == Result.ACCEPTED
    assert bench.command(224, 7) == Result.DENIED
    bench.run(8.0)
    truth = bench.world.truth_rows()[0]["pos_ned_m"]
    assert float(truth[1]) - 2.0 == pytest.approx(12.0, abs=1.0)
    bench.run(4.0)
    assert bench.pilot.mode == Px4Mode.AUTO_MISSION  # flown out, it holds there
    assert bench.pilot.flight.mission_finished


def test_no_mission_no_mission_mode() -> None:
    bench = taken_off().as_ground_station()
    assert bench.mode(4, 4) == Result.TEMPORARILY_REJECTED
    assert "Switching to Mission is currently not available\t" in bench.texts()
    assert bench.command(300, 0, 0) == Result.DENIED
    grounded = Bench()
    assert grounded.mode(4, 4) == Result.ACCEPTED  # disarmed any mode will do
    assert grounded.arm() == Result.TEMPORARILY_REJECTED


def test_a_jump_repeats_as_often_as_told() -> None:
    bench = taken_off("x500")
    jump = item(bench, 2, 177, params=(0.0, 2.0, 0.0, 0.0), frame=2)
    assert upload(bench, [item(bench, 0, 16, (2.5, 0.0)), item(bench, 1, 16, (-2.5, 0.0)), jump]) == 0
    bench.mode(4, 4)
    bench.run(25.0)
    assert [m.seq for m in bench.said(REACHED)] == [0, 1, 0, 1, 0, 1, 2]


def test_a_return_in_a_mission_changes_the_mode() -> None:
    bench = taken_off("x500")
    assert upload(bench, [item(bench, 0, 16, (2.5, 0.0)), item(bench, 1, 20, frame=2)]) == 0
    bench.mode(4, 4)
    bench.run(6.0)
    assert bench.pilot.mode == bench.pilot.intended == RTL
    assert [m.seq for m in bench.said(REACHED)] == [0]


def test_reposition_flies_there_and_holds() -> None:
    bench = taken_off("x500")
    origin = bench.pilot.boot.origin
    assert origin is not None
    lat_e7, lon_e7 = origin.to_geo_e7(6.0, -4.0)
    amsl_m = origin.alt_mm / 1e3 + 5.0
    goal = mav.MAVLink_command_int_message(1, 1, 0, 192, 0, 0, -1.0, 1.0, 0, NAN, lat_e7, lon_e7, amsl_m)
    bench.send(goal)
    bench.run(9.0)
    truth = bench.world.truth_rows()[0]["pos_ned_m"]
    assert (float(truth[0]) - 1.0, float(truth[1]) - 2.0) == pytest.approx((6.0, -4.0), abs=0.3)
    assert bench.height_m == pytest.approx(5.0, abs=0.2)
    assert bench.pilot.mode == HOLD


@pytest.mark.parametrize(("return_alt_m", "highest_m"), [(12.0, 12.0), (4.0, 4.0)])
def test_return_climbs_to_its_parameter(return_alt_m: float, highest_m: float) -> None:
    bench = taken_off("x500")
    bench.pilot.parameters.assign("RTL_RETURN_ALT", return_alt_m)
    bench.world.plant.state[10, 0] += 25.0  # carried away, beyond the cone
    bench.run(0.02)
    assert bench.mode(4, 5) == Result.ACCEPTED
    bench.run(0.1)
    assert any(t.startswith("RTL: start return at") for t in bench.texts())
    highest = 0.0
    for _ in range(200):
        bench.run(0.1)
        highest = max(highest, bench.height_m)
    assert highest == pytest.approx(highest_m, abs=0.6)


# --- failsafes ---


@pytest.mark.parametrize(("action", "mode"), [(0, HOLD), (1, HOLD), (2, HOLD), (3, RTL), (5, LAND)])
@pytest.mark.parametrize("fence", ["circle", "square", "distance", "height"])
def test_a_fence_acts_as_told(fence: str, action: int, mode: Px4Mode) -> None:
    if fence != "circle" and action != 3:
        return  # every action once, every fence once
    bench = taken_off("x500")
    bench.pilot.parameters.assign("GF_ACTION", action)
    bench.pilot.parameters.assign("COM_FAIL_ACT_T", 1.0)
    uploads = {"circle": lambda: circle(bench, 3.0), "square": lambda: square(bench, 3.0)}
    if fence in uploads:
        assert upload(bench, uploads[fence](), FENCE) == 0
    else:
        bench.pilot.parameters.assign("GF_MAX_HOR_DIST" if fence == "distance" else "GF_MAX_VER_DIST", 3.0)
    bench.run(0.3)
    assert not bench.pilot.failsafe  # inside: nothing
    bench.world.plant.state[12 if fence == "height" else 11, 0] += -1.5 if fence == "height" else 8.0
    bench.run(0.5)
    assert bench.pilot.failsafe == (action > 1)
    assert bench.pilot.mode == HOLD  # first time for the pilot
    bench.run(1.2)
    assert bench.pilot.mode == mode
    assert bench.pilot.system_status(0) == (MavState.CRITICAL if action > 1 else MavState.ACTIVE)
    assert any(t.startswith("Geofence:") for t in bench.texts()) == (action > 0)
    if action == 3:
        assert bench.mode(4, 3) == Result.ACCEPTED  # taken over; still outside, it does not act again
        bench.run(0.5)
        assert not bench.pilot.failsafe


def test_a_fence_may_terminate_and_keeps_from_arming() -> None:
    bench = taken_off("x500")
    bench.pilot.parameters.assign("GF_ACTION", 4)
    assert upload(bench, circle(bench, 3.0, keep_in=False), FENCE) == 0
    bench.run(0.2)
    assert bench.pilot.system_status(0) == MavState.TERMINATION
    grounded = Bench()
    assert upload(grounded, circle(grounded, 3.0, keep_in=False), FENCE) == 0
    grounded.run(0.2)
    assert grounded.arm() == Result.TEMPORARILY_REJECTED
    grounded.send(mav.MAVLink_mission_clear_all_message(1, 1, FENCE))
    grounded.run(0.2)
    assert grounded.arm() == Result.ACCEPTED


@pytest.mark.parametrize(
    ("action", "charge_01", "mode"),
    [(0, 0.01, HOLD), (1, 0.06, RTL), (2, 0.06, LAND), (3, 0.06, RTL), (3, 0.01, LAND), (2, 0.12, HOLD)],
)
def test_a_low_battery_acts_as_told(action: int, charge_01: float, mode: Px4Mode) -> None:
    bench = taken_off("x500")
    bench.pilot.parameters.assign("COM_LOW_BAT_ACT", action)
    bench.pilot.parameters.assign("COM_FAIL_ACT_T", 1.0)
    bench.pilot.battery_01 = charge_01
    bench.run(0.2)
    assert bench.pilot.battery_warning == (1 if charge_01 > 0.1 else 2 if charge_01 > 0.05 else 3)
    assert bench.pilot.mode == HOLD
    bench.run(1.1)
    assert bench.pilot.mode == mode
    bench.pilot.battery_01 = 1.0
    bench.run(0.2)
    assert bench.pilot.battery_warning > 0  # never taken back in flight


def test_the_circuit_breaker_takes_the_battery_out() -> None:
    bench = Bench()
    bench.pilot.battery_01 = 0.01
    bench.run(0.2)
    assert bench.arm() == Result.TEMPORARILY_REJECTED
    bench.pilot.parameters.assign("CBRK_SUPPLY_CHK", 894281)
    bench.run(0.2)
    assert bench.arm() == Result.ACCEPTED


@pytest.mark.parametrize(("action", "mode"), [(0, HOLD), (1, HOLD), (2, RTL), (3, LAND)])
def test_a_lost_ground_station_acts_as_told(action: int, mode: Px4Mode) -> None:
    bench = taken_off("x500")
    for name, value in (("NAV_DLL_ACT", action), ("COM_DL_LOSS_T", 2), ("COM_FAIL_ACT_T", 0.0)):
        bench.pilot.parameters.assign(name, value)
    beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    bench.pilot.watch.on_gcs_heartbeat(bench.clock.now_us())
    bench.run(1.8)
    assert not bench.pilot.failsafe
    bench.run(0.5)
    assert (bench.pilot.mode, bench.pilot.failsafe) == (mode, action > 0)
    bench.forget()
    bench.send(beat)
    bench.run(0.3)
    texts = [m.text for m in bench.said(TEXT)]
    assert "Connection to ground station lost\t" in texts
    assert "GCS connection regained\t" in texts


def test_without_a_position_auto_descends_and_offboard_goes_on() -> None:
    bench = taken_off("x500").as_ground_station()
    bench.pilot.position_ok = False
    bench.run(1.0)
    assert (bench.pilot.mode, bench.pilot.failsafe) == (LAND, True)
    assert float(bench.world.plant.vel_ned_m_s[2, 0]) == pytest.approx(0.7, abs=0.15)
    assert bench.mode(4, 3) == Result.TEMPORARILY_REJECTED
    assert "Switching to Hold is currently not available\t" in bench.texts()
    bench.setpoint()
    assert bench.mode(6) == Result.ACCEPTED
    bench.run(1.0, 50)
    assert (bench.pilot.mode, bench.pilot.failsafe) == (Px4Mode.OFFBOARD, False)
    bench.run(1.3)  # the stream stops: no RTL without a position
    assert bench.pilot.mode == LAND
    control = taken_off("x500")
    control.run(1.0)
    assert control.pilot.mode == HOLD


def test_auto_goes_on_when_the_position_is_back() -> None:
    bench = taken_off("x500")
    bench.pilot.position_ok = False
    bench.run(0.5)
    bench.pilot.position_ok = True
    bench.run(0.3)
    assert (bench.pilot.mode, bench.pilot.failsafe) == (HOLD, False)
    assert math.isfinite(bench.height_m)
