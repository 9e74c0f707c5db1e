"""MAVSDK 4.1, an independent client, flies the simulator as it would fly PX4.

Connect, healthy, parameters, arm, take off, go somewhere, land; upload a mission, fly it, be home again.
"""

from __future__ import annotations

import asyncio
import json

import pytest
from mavsdk import Configuration, Mavsdk
from mavsdk import asyncio as mavsdk_asyncio
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.mission import MissionAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.mission import Mission, MissionItem, MissionPlan
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry
from mavsdk.system import System

from tests.conformance.simulator_process import simulator, wait_for

pytestmark = pytest.mark.process

TAKEOFF_ALTITUDE_M = 1.2
OWN_SYSID = 245
NORTH_6_M = 6.0 / 111_200  # degrees
NAN = float("nan")
BEYOND_PYMAVLINK = ("ESC_INFO", "ESC_STATUS", "LINK_NODE_STATUS", "TIME_ESTIMATE_TO_TARGET", "CURRENT_EVENT_SEQUENCE")


def waypoint(latitude_deg: float, longitude_deg: float, up_m: float) -> MissionItem:
    return MissionItem(
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        relative_altitude_m=up_m,
        speed_m_s=3.0,
        is_fly_through=True,
        gimbal_pitch_deg=NAN,
        gimbal_yaw_deg=NAN,
        camera_action=MissionItem.CameraAction.NONE,
        loiter_time_s=NAN,
        camera_photo_interval_s=NAN,
        acceptance_radius_m=1.0,
        yaw_deg=NAN,
        camera_photo_distance_m=NAN,
        vehicle_action=MissionItem.VehicleAction.NONE,
    )


@pytest.mark.parametrize("preset", ["thesis", "x500"])
def test_mavsdk_sync_walk(preset: str) -> None:
    with simulator(preset) as port:
        sdk = Mavsdk(Configuration.create_manual(OWN_SYSID, 190, True))
        try:
            sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = sdk.first_autopilot(10.0)
            assert system is not None, "MAVSDK found no autopilot"
            assert system.get_system_id() == 1
            telemetry = Telemetry(system)
            wait_for(telemetry.health_all_ok, 10.0, "health_all_ok")
            parameters_are_read_and_written(system)
            messages_are_read_that_others_lack(system)
            fly_there_and_land(system, telemetry)
            if preset == "x500":
                fly_a_mission(system, telemetry)
        finally:
            sdk.destroy()


def parameters_are_read_and_written(system: System) -> None:
    param = Param(system)
    assert param.get_param_int("COM_OBL_RC_ACT") == 0
    param.set_param_int("COM_OBL_RC_ACT", 4)
    assert param.get_param_int("COM_OBL_RC_ACT") == 4
    everything = param.get_all_params()
    assert len(everything.int_params) + len(everything.float_params) > 40
    assert Info(system).get_version().flight_sw_major == 1


def messages_are_read_that_others_lack(system: System) -> None:
    """PX4's messages that pymavlink's dialect does not have, by MAVSDK's own definitions."""
    direct, read = MavlinkDirect(system), dict[str, str]()
    for name in BEYOND_PYMAVLINK:
        direct.subscribe_message(name, lambda m, _=None: read.setdefault(m.message_name, m.fields_json))
    wait_for(lambda: len(read) == len(BEYOND_PYMAVLINK), 3.0, f"{set(BEYOND_PYMAVLINK)}")
    escs = json.loads(read["ESC_INFO"])
    assert (escs["count"], escs["failure_flags"]) == (4, [0] * 4)
    assert json.loads(read["ESC_STATUS"])["rpm"] == [0] * 4


def fly_there_and_land(system: System, telemetry: Telemetry) -> None:
    action = Action(system)
    action.set_takeoff_altitude(TAKEOFF_ALTITUDE_M)
    assert action.get_takeoff_altitude() == pytest.approx(TAKEOFF_ALTITUDE_M)
    action.arm()
    wait_for(telemetry.armed, 3.0, "armed")
    action.takeoff()
    wait_for(lambda: telemetry.flight_mode().name == "TAKEOFF", 3.0, "takeoff mode")
    wait_for(lambda: telemetry.flight_mode().name == "HOLD", 12.0, "hold after takeoff")
    assert telemetry.in_air()
    here = telemetry.position()
    assert here.relative_altitude_m == pytest.approx(TAKEOFF_ALTITUDE_M, abs=0.35)
    north_deg = here.latitude_deg + NORTH_6_M
    action.goto_location(north_deg, here.longitude_deg, here.absolute_altitude_m + 1.0, NAN)
    wait_for(
        lambda: (
            abs(telemetry.position().latitude_deg - north_deg) < NORTH_6_M / 10
            and abs(telemetry.position().absolute_altitude_m - here.absolute_altitude_m - 1.0) < 0.3
        ),
        8.0,
        "arrived",
    )
    action.land()
    wait_for(lambda: telemetry.flight_mode().name == "LAND", 3.0, "land mode")
    wait_for(lambda: not telemetry.armed(), 10.0, "disarmed after landing")
    assert telemetry.landed_state().name == "ON_GROUND"


def fly_a_mission(system: System, telemetry: Telemetry) -> None:
    mission, action = Mission(system), Action(system)
    home = telemetry.position()
    plan = [waypoint(home.latitude_deg + k * NORTH_6_M, home.longitude_deg, 3.0) for k in (0, 1)]
    mission.set_return_to_launch_after_mission(False)
    mission.upload_mission(MissionPlan(plan))
    assert [item.latitude_deg for item in mission.download_mission().mission_items] == pytest.approx(
        [item.latitude_deg for item in plan], abs=1e-7
    )
    action.arm()
    mission.start_mission()
    wait_for(lambda: telemetry.flight_mode().name == "MISSION", 3.0, "mission mode")
    wait_for(mission.is_mission_finished, 12.0, "mission finished")
    assert telemetry.position().latitude_deg == pytest.approx(plan[-1].latitude_deg, abs=NORTH_6_M / 4)
    action.return_to_launch()
    wait_for(lambda: telemetry.flight_mode().name == "RETURN_TO_LAUNCH", 3.0, "return mode")


def test_mavsdk_asyncio_walk() -> None:
    with simulator() as port:
        asyncio.run(asyncio.wait_for(fly_with_asyncio(port), 45.0))


async def fly_with_asyncio(port: int) -> None:
    async with mavsdk_asyncio.Mavsdk(Configuration.create_manual(OWN_SYSID, 190, True)) as sdk:
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await sdk.first_autopilot(timeout_s=10.0)
        assert system is not None, "MAVSDK found no autopilot"
        action, telemetry, mission = ActionAsync(system), TelemetryAsync(system), MissionAsync(system)
        async for healthy in telemetry.subscribe_health_all_ok():
            if healthy:
                break
        param = ParamAsync(system)
        await param.set_param_float("COM_OF_LOSS_T", 0.75)
        assert await param.get_param_float("COM_OF_LOSS_T") == pytest.approx(0.75)
        await action.set_takeoff_altitude(TAKEOFF_ALTITUDE_M)
        home = await telemetry.position()
        plan = [waypoint(home.latitude_deg + k * NORTH_6_M, home.longitude_deg, 2.0) for k in (1, 0)]
        await mission.upload_mission(MissionPlan(plan))
        await action.arm()
        await action.takeoff()
        async for position in telemetry.subscribe_position():
            if position.relative_altitude_m > TAKEOFF_ALTITUDE_M - 0.25:
                break
        assert await telemetry.in_air()
        await mission.start_mission()
        async for progress in mission.subscribe_mission_progress():
            if progress.current == progress.total > 0:
                break
        await action.hold()
        await action.land()
        async for armed in telemetry.subscribe_armed():
            if not armed:
                break
        assert not await telemetry.in_air()
