"""Findings of a check: every row of the table is triggered by one fact, and by none of a healthy vehicle."""

from __future__ import annotations

import dataclasses
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink
from rich.console import Console

from swarmctl.check.change import Change
from swarmctl.check.computer import priority_finding
from swarmctl.check.finding import SWARM, Finding, worst_first
from swarmctl.check.parameters import changes, names_to_read, unchangeable
from swarmctl.check.scan.link_facts import (
    ArmingProblem,
    Estimator,
    FenceFacts,
    Gps,
    LinkFacts,
    Parameter,
    RoundTrip,
    Sensors,
    VehicleFacts,
    VehicleTime,
    Version,
)
from swarmctl.check.scan.scan_facts import unreached
from swarmctl.check.services import corners_deg, has_fence
from swarmctl.check.swarm import exit_code, findings, standing
from swarmctl.check.table import _drawn, as_json, print_check
from swarmctl.config import Config, load
from swarmctl.control.failsafe.decision import FailsafeParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.mavlink_values import RC_RECEIVER
from swarmctl.core.types import FlightMode, Landed
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.arducopter import ARDUCOPTER
from swarmctl.mavlink.dialects.dialect import LAND, ODOMETRY, Dialect, LongCommand, Rule
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.dialects.parameter_check import Opinion, ParameterCheck
from swarmctl.mavlink.dialects.px4 import PX4
from swarmctl.mavlink.vehicle.plausibility import kind_problem

OK, NOTE, FIX = Verdict.OK, Verdict.NOTE, Verdict.FIX
URLS = ("udpin://127.0.0.1:14540", "udpin://127.0.0.1:14541")
ALL_SENSORS = 0x0200C02F
PX4_VALUES: dict[str, float | int] = {
    "COM_OBL_RC_ACT": 4,
    "COM_OF_LOSS_T": 0.5,
    "MAV_FWDEXTSP": 1,
    "COM_RCL_EXCEPT": 0,
    "COM_RC_IN_MODE": 1,
    "NAV_RCL_ACT": 2,
    "NAV_DLL_ACT": 0,
    "COM_DL_LOSS_T": 10,
    "MPC_THR_HOVER": 0.5,
    "THR_MDL_FAC": 0.0,
    "MAV_SYS_ID": 1,
}
COPTER_VALUES: dict[str, float | int] = {
    "GUID_OPTIONS": 8,
    "GUID_TIMEOUT": 1.0,
    "FS_GCS_ENABLE": 5,
    "FS_GCS_TIMEOUT": 2.0,
    "ATC_ANGLE_BOOST": 0,
    "FS_THR_ENABLE": 0,
    "FS_EKF_ACTION": 1,
    "ARMING_CHECK": 1,
    "ANGLE_MAX": 4500,
    "MOT_THST_HOVER": 0.45,
    "SYSID_THISMAV": 1,
    "SYSID_MYGCS": 255,
}
LINK = LinkFacts(
    listened_s=3.0,
    rates_hz={"ODOMETRY": 30.0, "HEARTBEAT": 1.0},
    frames_s=430.0,
    bytes_s=25000.0,
    lost_01=0.0,
    mavlink1=0,
    mavlink2=1300,
    autopilots=(1,),
    senders=1,
    round_trip=RoundTrip(p50_ms=2.0, p99_ms=9.0, answers=60, by="TIMESYNC"),
    time=VehicleTime(-12.0, 40.0, 30.0),
)


def parameters(values: dict[str, float | int], **changed: float | int | None) -> dict[str, Parameter]:
    merged: dict[str, Any] = {**values, **changed}
    return {name: Parameter(name=name, value=value) for name, value in merged.items()}


HEALTHY = VehicleFacts(
    agent=0,
    url=URLS[0],
    wanted_sysid=1,
    unreachable="",
    link=LINK,
    sysid=1,
    autopilot="PX4",
    autopilot_number=12,
    version=Version(firmware=(1, 18, 0), stage="beta", git="83c4f4e5", board=1, uid="0", bytewise=True),
    mode=FlightMode.HOLD,
    custom_mode=0x03040000,
    landed=Landed.ON_GROUND,
    system_status=3,
    sensors=Sensors(
        present=ALL_SENSORS, enabled=ALL_SENSORS | RC_RECEIVER, healthy=0x1320C83F, battery_v=16.2, battery_01=1.0
    ),
    estimator=Estimator(1023, 0.1),
    gps=Gps(3, 10, 0.9),
    pos_ned_m=(0.0, 0.0, 0.0),
    origin_ned_m=(0.1, 0.0, 0.0),
    origin_told=True,
    parameters=parameters(PX4_VALUES),
)
COPTER = dataclasses.replace(
    HEALTHY,
    autopilot="ArduCopter",
    autopilot_number=3,
    version=Version(firmware=(4, 6, 3), stage="release", git="92b0cd78", board=1, uid="0", bytewise=None),
    parameters=parameters(COPTER_VALUES),
)
SECOND = dataclasses.replace(
    HEALTHY, agent=1, url=URLS[1], wanted_sysid=2, sysid=2, pos_ned_m=(3.0, 0.0, 0.0), origin_ned_m=(0.0, 0.2, 0.0)
)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    vehicles = "".join(f'[[vehicles]]\nsysid={i + 1}\nurl="{url}"\n' for i, url in enumerate(URLS))
    path = tmp_path_factory.mktemp("check") / "two.toml"
    path.write_text(
        "[swarm]\nagents=2\n[start]\npositions_ned_m=[[0,0,-2.0],[3.0,0,-2.0]]\n[sitl]\nenabled=false\n" + vehicles
    )
    return load(path)


def with_params(config: Config, **wanted: float) -> Config:
    """The same with other `agent.autopilot_params`."""
    agent = config.agent.model_copy(update={"autopilot_params": wanted})
    return config.model_copy(update={"agent": agent})


def line_of(lines: Sequence[Finding], topic: str, agent: int = 0) -> Finding:
    [found] = [line for line in lines if line.topic == topic and line.agent == agent]
    return found


def changed(facts: VehicleFacts, **fields: Any) -> VehicleFacts:
    """With other facts; `link_x` replaces a field of the link."""
    link = {k.removeprefix("link_"): v for k, v in fields.items() if k.startswith("link_")}
    own = {k: v for k, v in fields.items() if not k.startswith("link_")}
    return dataclasses.replace(facts, link=dataclasses.replace(facts.link, **link), **own)


def test_a_healthy_pair_has_nothing_to_fix_and_nothing_to_know(config: Config) -> None:
    lines = findings([HEALTHY, SECOND_OK], config)
    assert worst_first(lines) == []
    assert exit_code([HEALTHY, SECOND_OK], lines) == 0


@pytest.mark.parametrize(
    ("told", "verdict", "word"),
    [
        ({}, Verdict.OK, "not told by this autopilot"),
        ({"has_metadata": True}, Verdict.NOTE, "not told"),
        ({"arming_problems": ()}, Verdict.OK, "no problem"),
        ({"arming_problems": (ArmingProblem("No sticks", False),)}, Verdict.NOTE, "No sticks"),
        (
            {"arming_problems": (ArmingProblem("No sticks", False), ArmingProblem("Compass 0 uncalibrated", True))},
            Verdict.FIX,
            "Compass 0 uncalibrated",
        ),
    ],
)
def test_the_autopilots_own_arming_checks(config: Config, told: dict[str, Any], verdict: Verdict, word: str) -> None:
    line = line_of(findings([changed(HEALTHY, **told)], config), "arming checks")
    assert line.verdict is verdict
    assert word in line.found
    assert ("No sticks" in line.found) is (word == "No sticks"), "what blocks is not hidden among warnings"


SQUARE_NE_M = [[20.0, 20.0], [20.0, -20.0], [-20.0, -20.0], [-20.0, 20.0]]


def fenced(corners_ne_m: list[list[float]] = SQUARE_NE_M) -> Config:
    return load(None, ["sitl.enabled=true", f"geofence.corners_ne_m={corners_ne_m}"])


def test_the_corners_are_north_and_east_of_the_shared_origin() -> None:
    (lat, lon), (_, west), *_ = corners_deg(fenced())
    assert (lat - 47.397742) * 111_180 == pytest.approx(20.0, abs=0.05)
    assert (lon - 8.545594) * 111_320 * math.cos(math.radians(lat)) == pytest.approx(20.0, abs=0.1)
    assert west < 8.545594 < lon


@pytest.mark.parametrize("of", ["same", "rounded", "none", "moved", "more", "refused", "doubtful", "not asked"])
def test_a_geofence_is_exactly_the_configured_one(of: str) -> None:
    config = fenced()
    corners = corners_deg(config)
    fence = {
        "same": FenceFacts(corners_deg=corners),
        "rounded": FenceFacts(corners_deg=tuple((round(lat, 7), round(lon, 7)) for lat, lon in corners)),
        "none": FenceFacts(),
        "moved": FenceFacts(corners_deg=((corners[0][0] + 1e-5, corners[0][1]), *corners[1:])),
        "more": FenceFacts(corners_deg=corners, others=1),
        "refused": FenceFacts(problem="timeout"),
        "doubtful": FenceFacts(corners_deg=corners, problem="timeout"),
        "not asked": None,
    }[of]
    line = line_of(findings([changed(HEALTHY, fence=fence)], config), "geofence")
    assert fence is None or has_fence(fence, config) is (of in ("same", "rounded"))
    assert line.verdict is (Verdict.OK if of in ("same", "rounded") else Verdict.FIX)


@pytest.mark.parametrize(("action", "verdict"), [(0, "FIX"), (1, "FIX"), (2, "OK"), (3, "FIX"), (4, "FIX"), (5, "OK")])
def test_at_a_configured_geofence_the_vehicle_holds_or_lands(action: int, verdict: str) -> None:
    facts = changed(HEALTHY, parameters=parameters(PX4_VALUES, GF_ACTION=action))
    assert line_of(findings([facts], fenced()), "GF_ACTION").verdict.name == verdict
    assert changes(facts, fenced()).get("GF_ACTION") == (None if verdict == "OK" else 2)
    assert not [line for line in findings([facts], load(None)) if line.topic == "GF_ACTION"], "without one nobody cares"


def test_a_healthy_copter_has_nothing_to_fix(config: Config) -> None:
    lines = findings([COPTER], with_params(config, GUID_OPTIONS=8))
    assert worst_first(lines) == []


SECOND_OK = changed(SECOND, link_autopilots=(2,), parameters=parameters(PX4_VALUES, MAV_SYS_ID=2))
_RADIO = Sensors(
    present=ALL_SENSORS | RC_RECEIVER,
    enabled=ALL_SENSORS | RC_RECEIVER,
    healthy=0x1320C83F | RC_RECEIVER,
    battery_v=16.2,
    battery_01=1.0,
)

# topic, what is changed in a healthy PX4 vehicle, verdict, a word of the advice
PX4_CASES: list[tuple[str, dict[str, Any], Verdict, str]] = [
    ("autopilot", {"autopilot": "", "autopilot_number": 4}, FIX, "flies ArduCopter and PX4"),
    (
        "autopilot",
        {"version": Version(firmware=(1, 14, 0), stage="release", git="", board=1, uid="0", bytewise=True)},
        NOTE,
        "measured on 1.18",
    ),
    (
        "autopilot",
        {"version": Version(firmware=(1, 18, 0), stage="beta", git="", board=1, uid="0", bytewise=False)},
        FIX,
        "encodes integer",
    ),
    ("autopilot", {"version": None}, NOTE, "version"),
    ("system id", {"sysid": 7}, FIX, "MAV_SYS_ID = 1"),
    ("state", {"armed": True}, NOTE, "not changed"),
    ("state", {"armed": True, "mode": FlightMode.EXTERNAL}, NOTE, "another program flies"),
    ("state", {"system_status": 5}, FIX, "failsafe"),
    ("sensors", {"sensors": None}, NOTE, "SYS_STATUS"),
    (
        "sensors",
        {
            "sensors": Sensors(
                present=ALL_SENSORS, enabled=ALL_SENSORS, healthy=0x1320C83F & ~4, battery_v=16.2, battery_01=1.0
            )
        },
        FIX,
        "calibrate",
    ),
    (
        "sensors",
        {
            "sensors": Sensors(
                present=ALL_SENSORS, enabled=ALL_SENSORS, healthy=0x0320C83F, battery_v=16.2, battery_01=1.0
            )
        },
        FIX,
        "refused in HOLD",
    ),
    (
        "battery",
        {
            "sensors": Sensors(
                present=ALL_SENSORS, enabled=ALL_SENSORS, healthy=0x1320C83F, battery_v=14.0, battery_01=0.1
            )
        },
        FIX,
        "charge",
    ),
    (
        "battery",
        {
            "sensors": Sensors(
                present=ALL_SENSORS, enabled=ALL_SENSORS, healthy=0x1320C83F, battery_v=15.0, battery_01=0.4
            )
        },
        NOTE,
        "short flight",
    ),
    (
        "battery",
        {
            "sensors": Sensors(
                present=ALL_SENSORS, enabled=ALL_SENSORS, healthy=0x1320C83F, battery_v=None, battery_01=None
            )
        },
        NOTE,
        "not known",
    ),
    ("estimator", {"estimator": Estimator(1023 & ~16, 0.3)}, FIX, "position source"),
    ("estimator", {"estimator": Estimator(1023 | 1024, 0.3)}, FIX, "distrusts"),
    ("estimator", {"estimator": None, "gps": Gps(2, 4, 9.0)}, FIX, "3-D fix"),
    ("estimator", {"estimator": None, "gps": Gps(3, 10, None)}, NOTE, "how accurate"),
    ("origin", {"origin_ned_m": None}, FIX, "can't be placed"),
    ("origin", {"origin_ned_m": (9000.0, 0.0, 0.0)}, FIX, "swarm.origin_lat_deg"),
    ("origin", {"origin_told": False}, NOTE, "worked out"),
    ("link", {"link_mavlink2": 0, "link_mavlink1": 50}, FIX, "MAV_PROTO_VER = 2"),
    ("link", {"link_autopilots": (1, 4)}, FIX, "link of its own"),
    ("link", {"link_senders": 2}, FIX, "only the vehicle send"),
    ("state rate", {"url": "serial:///dev/ttyX:57600", "link_bytes_s": 3000.0}, FIX, "state_rate_hz"),
    ("loss", {"link_lost_01": 0.02}, NOTE, "lost on the way"),
    ("loss", {"link_lost_01": 0.2}, FIX, "lost on the way"),
    ("loss", {"link_dropped": 40}, NOTE, "this computer was too busy"),
    ("loss", {"link_lost_01": 0.2, "link_dropped": 40}, FIX, "lost on the way"),
    ("round trip", {"link_round_trip": None}, NOTE, "neither"),
    ("round trip", {"link_round_trip": RoundTrip(p50_ms=90.0, p99_ms=120.0, answers=60, by="PING")}, NOTE, "0.045 s"),
    (
        "round trip",
        {"link_round_trip": RoundTrip(p50_ms=90.0, p99_ms=900.0, answers=60, by="PING")},
        FIX,
        "state_max_age_s",
    ),
    ("clock", {"link_time": VehicleTime(0.0, -30000.0, 100.0)}, NOTE, "short of CPU"),
    ("clock", {"link_time": VehicleTime(0.0, 60000.0, 100.0)}, FIX, "short of CPU"),
    ("autopilot", {"kind_problem": kind_problem(mavlink.MAV_TYPE_FIXED_WING)}, FIX, "MAV_TYPE fixed wing"),
    ("start", {"pos_ned_m": (0.0, 0.0, -1.8)}, FIX, "origin_alt_m"),
    ("start", {"pos_ned_m": (500.0, 0.0, 0.0)}, FIX, "start_timeout_s"),
    ("start", {"pos_ned_m": (0.0, 0.0, 489.0)}, FIX, "swarm.origin_"),
    ("start", {"pos_ned_m": (50.0, 0.0, 0.0)}, NOTE, "far"),
    ("start", {"pos_ned_m": (0.0, 0.0, 45.0)}, NOTE, "mean sea level"),
    ("COM_OF_LOSS_T", {"parameters": parameters(PX4_VALUES, COM_OF_LOSS_T=3.0)}, FIX, "set 1.0"),
    ("COM_OF_LOSS_T", {"parameters": parameters(PX4_VALUES, COM_OF_LOSS_T=0.05)}, FIX, "set 0.5"),
    ("COM_OF_LOSS_T", {"parameters": parameters(PX4_VALUES, COM_OF_LOSS_T=None)}, NOTE, "not judged"),
    ("COM_OBL_RC_ACT", {"parameters": parameters(PX4_VALUES, COM_OBL_RC_ACT=0)}, NOTE, "the agent sets it"),
    ("COM_OBL_RC_ACT", {"parameters": parameters(PX4_VALUES, COM_OBL_RC_ACT=None)}, FIX, "no such parameter"),
    ("MAV_FWDEXTSP", {"parameters": parameters(PX4_VALUES, MAV_FWDEXTSP=0)}, FIX, "not flown"),
    ("COM_RCL_EXCEPT", {"parameters": parameters(PX4_VALUES, COM_RC_IN_MODE=0)}, FIX, "NAV_RCL_ACT = 2"),
    ("NAV_DLL_ACT", {"parameters": parameters(PX4_VALUES, NAV_DLL_ACT=None)}, FIX, "can't be read"),
    ("MPC_THR_HOVER", {"parameters": parameters(PX4_VALUES, MPC_THR_HOVER=0.3)}, NOTE, "hover_thrust_01 = 0.3"),
    ("MAV_SYS_ID", {"parameters": parameters(PX4_VALUES, MAV_SYS_ID=9)}, FIX, "reboot"),
    (
        "THR_MDL_FAC",
        {
            "version": Version(
                firmware=(1, 18, 0), stage="release", git="", board=50, uid="3a91", bytewise=True, vendor=0x3185
            )
        },
        NOTE,
        "calibrate",
    ),
]
COPTER_CASES: list[tuple[str, dict[str, Any], Verdict, str]] = [
    ("GUID_OPTIONS", {"parameters": parameters(COPTER_VALUES, GUID_OPTIONS=0)}, FIX, "climb rate"),
    ("GUID_OPTIONS", {"parameters": parameters(COPTER_VALUES, GUID_OPTIONS=None)}, FIX, "can't be read"),
    ("GUID_TIMEOUT", {"parameters": parameters(COPTER_VALUES, GUID_TIMEOUT=3.0)}, NOTE, "set 1"),
    ("GUID_TIMEOUT", {"parameters": parameters(COPTER_VALUES, GUID_TIMEOUT=30.0)}, FIX, "last attitude"),
    ("FS_GCS_ENABLE", {"parameters": parameters(COPTER_VALUES, FS_GCS_ENABLE=1)}, FIX, "drift on"),
    ("FS_THR_ENABLE", {"parameters": parameters(COPTER_VALUES, FS_THR_ENABLE=1)}, NOTE, "no radio"),
    ("FS_EKF_ACTION", {"parameters": parameters(COPTER_VALUES, FS_EKF_ACTION=2)}, NOTE, "does not land"),
    ("ARMING_CHECK", {"parameters": parameters(COPTER_VALUES, ARMING_CHECK=0)}, NOTE, "nothing is checked"),
    ("ANGLE_MAX", {"parameters": parameters(COPTER_VALUES, ANGLE_MAX=3000)}, NOTE, "tilt_max_rad = 0.52"),
    ("MOT_THST_HOVER", {"parameters": parameters(COPTER_VALUES, MOT_THST_HOVER=0.2)}, NOTE, "hover_thrust_01 = 0.2"),
    ("SYSID_THISMAV", {"parameters": parameters(COPTER_VALUES, SYSID_THISMAV=4)}, FIX, "reboot"),
    ("link", {"link_mavlink2": 0, "link_mavlink1": 50}, FIX, "SERIALx_PROTOCOL"),
    ("system id", {"sysid": 7}, FIX, "SYSID_THISMAV = 1"),
]


@pytest.mark.parametrize(
    ("topic", "fields", "verdict", "word"), PX4_CASES, ids=lambda v: v if isinstance(v, str) else ""
)
def test_px4_rows(config: Config, topic: str, fields: dict[str, Any], verdict: Verdict, word: str) -> None:
    healthy = line_of(findings([HEALTHY], config), topic)
    assert healthy.verdict is OK and not healthy.advice
    plain = with_params(config, COM_OBL_RC_ACT=4)  # the timeout is the autopilot's own
    found = line_of(findings([changed(HEALTHY, **fields)], plain), topic)
    assert found.verdict is verdict
    assert word in found.advice


@pytest.mark.parametrize(
    ("topic", "fields", "verdict", "word"), COPTER_CASES, ids=lambda v: v if isinstance(v, str) else ""
)
def test_arducopter_rows(config: Config, topic: str, fields: dict[str, Any], verdict: Verdict, word: str) -> None:
    plain = with_params(config)
    assert line_of(findings([COPTER], plain), topic).verdict is OK
    found = line_of(findings([changed(COPTER, **fields)], plain), topic)
    assert found.verdict is verdict
    assert word in found.advice


def test_a_vehicle_with_a_model_of_its_own_is_compared_with_that(config: Config) -> None:
    second = config.vehicles[1].model_copy(update={"model": VehicleModelParams(hover_thrust_01=0.3, tilt_max_rad=0.4)})
    own = with_params(config.model_copy(update={"vehicles": (config.vehicles[0], second)}))
    facts = [dataclasses.replace(COPTER, agent=agent) for agent in (0, 1)]
    lines = findings(facts, own)
    assert line_of(lines, "MOT_THST_HOVER", 0).wanted.startswith("vehicle_model.hover_thrust_01 = 0.5")
    hover = line_of(lines, "MOT_THST_HOVER", 1)
    assert hover.wanted.startswith("vehicles.1.model.hover_thrust_01 = 0.3")
    assert hover.advice == "first guesses differ; set vehicles.1.model.hover_thrust_01 = 0.45"
    assert line_of(lines, "ANGLE_MAX", 1).wanted.startswith("at least 2292 (vehicles.1.model.tilt_max_rad)")


def test_a_parameter_of_other_vehicles_autopilots_is_not_to_be_removed(config: Config) -> None:
    both = with_params(config, COM_OBL_RC_ACT=4, GUID_OPTIONS=8)
    advice = line_of(findings([HEALTHY], both), "GUID_OPTIONS").advice
    assert advice.endswith("remove agent.autopilot_params.GUID_OPTIONS, unless it is for other vehicles")


def test_every_judged_parameter_has_a_case() -> None:
    tested = {topic for topic, *_ in (*PX4_CASES, *COPTER_CASES)}
    shown_only = {"COM_RC_IN_MODE"}
    assert {check.name for dialect in (PX4, ARDUCOPTER) for check in dialect.checks} - tested == shown_only


def test_a_radio_that_is_there_or_not_needed_is_no_finding(config: Config) -> None:
    expected = changed(HEALTHY, parameters=parameters(PX4_VALUES, COM_RC_IN_MODE=0))
    excepted = changed(HEALTHY, parameters=parameters(PX4_VALUES, COM_RC_IN_MODE=0, COM_RCL_EXCEPT=4))
    there = changed(expected, sensors=_RADIO)
    verdicts = [line_of(findings([f], config), "COM_RCL_EXCEPT").verdict for f in (expected, excepted, there)]
    assert verdicts == [FIX, OK, OK]


def test_what_the_configuration_wants_is_refused_when_it_would_stop_the_motors(config: Config) -> None:
    falls = with_params(config, COM_OBL_RC_ACT=7)
    facts = changed(HEALTHY, parameters=parameters(PX4_VALUES, COM_OBL_RC_ACT=7))
    assert "motors would stop" in line_of(findings([facts], falls), "COM_OBL_RC_ACT").advice
    assert changes(HEALTHY, falls) == {}


def test_the_built_in_simulator_needs_no_fixing_of_what_the_agent_sets_itself() -> None:
    config = load(None)
    facts = changed(HEALTHY, parameters=parameters(PX4_VALUES, COM_OBL_RC_ACT=0))
    assert line_of(findings([facts], config), "COM_OBL_RC_ACT").verdict is NOTE
    assert changes(facts, config) == {"COM_OBL_RC_ACT": 4}


@pytest.mark.parametrize(
    ("topic", "second", "verdict", "word"),
    [
        ("system ids", {"sysid": 1}, FIX, "own"),
        ("distances", {"pos_ned_m": (0.5, 0.0, 0.0)}, FIX, "apart"),
        ("heights", {"pos_ned_m": (1.0, 0.0, -0.6)}, NOTE, "above that of agent 0"),
        ("heights", {"pos_ned_m": (1.0, 0.0, -6.0)}, FIX, "6.0 m above that of agent 0"),
    ],
)
def test_swarm_rows(config: Config, topic: str, second: dict[str, Any], verdict: Verdict, word: str) -> None:
    healthy = [line for line in findings([HEALTHY, SECOND_OK], config) if line.topic == topic]
    assert all(line.verdict is OK for line in healthy)
    found = line_of(findings([HEALTHY, changed(SECOND_OK, **second)], config), topic, SWARM)
    assert found.verdict is verdict
    assert word in found.advice


def test_the_radius_has_to_cover_body_tracking_and_estimator(config: Config) -> None:
    vague = changed(SECOND_OK, estimator=Estimator(1023, 0.3))
    told = config.model_copy(update={"separation": config.separation.model_copy(update={"allow_small_radius": True})})
    lines = [
        line_of(findings(vehicles, given), "radius", SWARM)
        for vehicles, given in (([HEALTHY, SECOND_OK], config), ([HEALTHY, vague], config), ([HEALTHY, vague], told))
    ]
    assert [line.verdict for line in lines] == [OK, FIX, NOTE]
    assert "separation.radius_m = 1.33" in lines[1].advice  # 0.48 + 2 sqrt(2) 0.3
    alone = load(None, ["swarm.agents=1"])
    single = changed(HEALTHY, estimator=vague.estimator)
    assert not [line for line in findings([single], alone) if line.topic == "radius"]


def test_limits_of_battery_and_link_are_shown_and_the_return_is_one_of_them(config: Config) -> None:
    lines = findings([HEALTHY, SECOND_OK], config)
    assert line_of(lines, "battery").wanted == "over 50%, warns at 30%, returns at 20%, lands at 10%"
    assert line_of(lines, "loss").wanted == "under 1%; in flight: warns at 20% of 5 s without a new state"
    strict = FailsafeParams(battery_warn_01=0.8, battery_rtl_01=0.7)
    agent = config.agent.model_copy(update={"failsafe": strict})
    low = changed(
        HEALTHY,
        sensors=Sensors(present=ALL_SENSORS, enabled=ALL_SENSORS, healthy=0x1320C83F, battery_v=15.6, battery_01=0.65),
    )
    assert line_of(findings([low, SECOND_OK], config), "battery").verdict is OK
    within = config.model_copy(update={"agent": agent})
    assert line_of(findings([low, SECOND_OK], within), "battery").verdict is FIX


def test_the_flight_volume_is_shown_and_who_stands_beside_it_is_found(config: Config) -> None:
    corners = ((-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0))
    volume = VolumeParams(corners_ne_m=corners, floor_z_m=-0.5, ceiling_z_m=-30.0)
    within = config.model_copy(update={"volume": volume})
    (shown,) = (line for line in findings([HEALTHY, SECOND], within) if line.topic == "volume")
    assert (shown.agent, shown.verdict) == (SWARM, NOTE if shown.advice else OK)
    assert "18.0 x 18.0 x 29.5 m" in shown.wanted
    away = changed(SECOND, pos_ned_m=(0.0, 11.0, 0.0))
    beside = line_of(findings([HEALTHY, away], within), "volume", 1)
    assert beside.verdict is FIX
    assert "2.0 m beyond side" in beside.found
    assert not [line for line in findings([HEALTHY, away], config) if line.topic == "volume"]


def test_a_parameter_of_another_kind_of_autopilot_is_only_a_note(config: Config) -> None:
    line = line_of(findings([COPTER], with_params(config, COM_OBL_RC_ACT=4)), "COM_OBL_RC_ACT")
    assert line.verdict is NOTE and "no such parameter" in line.advice


@pytest.mark.parametrize(
    ("refused", "begins"), [(True, "this autopilot has no such"), (False, "not answered: look at")]
)
def test_a_parameter_that_was_not_answered_may_exist(config: Config, refused: bool, begins: str) -> None:
    """On a link that loses requests it is no reason to take the parameter out of the configuration."""
    stored = {**parameters(PX4_VALUES), "MPC_XY_CRUISE": Parameter(name="MPC_XY_CRUISE", value=None, refused=refused)}
    asked = with_params(config, MPC_XY_CRUISE=3.0)
    line = line_of(findings([changed(HEALTHY, parameters=stored)], asked), "MPC_XY_CRUISE")
    assert line.advice.startswith(begins)


def test_one_board_under_two_urls_is_found_and_two_simulators_are_not_one_board(config: Config) -> None:
    same = Version(firmware=(1, 18, 0), stage="release", git="", board=50, uid="3a91", bytewise=True, vendor=0x3185)
    lines = findings([changed(HEALTHY, version=same), changed(SECOND_OK, version=same)], config)
    assert "same board" in line_of(lines, "system ids", SWARM).advice
    assert not [line for line in findings([HEALTHY, SECOND_OK], config) if line.topic == "system ids"]


@pytest.mark.parametrize("uid", ["0", "01", "02"])
def test_a_simulator_is_not_told_to_calibrate_whatever_its_uid(config: Config, uid: str) -> None:
    """PX4's simulator has its instance for a uid, and two hosts may fly the same instance."""
    simulated = Version(firmware=(1, 18, 0), stage="beta", git="83c4f4e5", board=1, uid=uid, bytewise=True)
    lines = findings([changed(HEALTHY, version=simulated), changed(SECOND_OK, version=simulated)], config)
    assert worst_first(lines) == []


def test_a_clock_one_percent_slow_is_no_finding(config: Config) -> None:
    slow = changed(HEALTHY, link_time=VehicleTime(0.0, -11_000.0, 100.0))
    assert line_of(findings([slow], config), "clock").verdict is OK


@pytest.mark.parametrize("url", (*URLS, "udpout://10.0.0.5:14580"))
def test_silence_over_udp_names_the_first_sender_and_the_cure(config: Config, url: str) -> None:
    silent = changed(unreached(0, url, 1, "nothing is heard"), opened=True)
    advice = line_of(findings([silent], config), "link").advice
    assert "to its first sender" in advice
    assert "restart PX4" in advice
    serial = line_of(findings([changed(silent, url="serial:///dev/ttyACM0:921600")], config), "link")
    assert "is it on" in serial.advice
    assert "to its first sender" not in serial.advice


@pytest.mark.parametrize("url", (*URLS, "serial:///dev/ttyACM0:921600"))
def test_a_link_that_this_computer_cannot_open_is_no_matter_of_the_vehicle(config: Config, url: str) -> None:
    line = line_of(findings([unreached(0, url, 1, "it is not there")], config), "link")
    assert line.found == "it is not there"
    assert line.advice == "vehicles.0.url names a link that this computer can't open"


def test_the_spread_of_origins_is_shown_and_harmless(config: Config) -> None:
    line = line_of(findings([HEALTHY, SECOND_OK], config), "origins", SWARM)
    assert line.verdict is OK
    assert f"{math.hypot(0.1, 0.2):.2f} m" in line.found


def test_vehicles_in_each_others_place_are_found(config: Config) -> None:
    crossed = [changed(HEALTHY, pos_ned_m=(3.0, 0.0, 0.0)), changed(SECOND_OK, pos_ned_m=(0.0, 0.0, 0.0))]
    assert line_of(findings(crossed, config), "order", SWARM).verdict is NOTE
    assert not [line for line in findings([HEALTHY, SECOND_OK], config) if line.topic == "order"]


def test_a_vehicle_that_is_not_reached_is_the_worst_and_the_exit_code(config: Config) -> None:
    missing = unreached(1, URLS[1], 2, "udp 127.0.0.1:14541 can't be bound")
    ill = changed(HEALTHY, sysid=7)
    lines = findings([ill, missing], config)
    assert worst_first(lines)[0].agent == 1
    assert exit_code([ill, missing], lines) == 3
    assert exit_code([ill], findings([ill], config)) == 4


def test_a_fix_comes_before_any_note(config: Config) -> None:
    ill = changed(HEALTHY, armed=True, link_lost_01=0.02, parameters=parameters(PX4_VALUES, MAV_FWDEXTSP=0))
    assert [line.verdict for line in worst_first(findings([ill], config))] == [FIX, NOTE, NOTE]


def test_apply_sets_what_is_wrong_and_nothing_else(config: Config) -> None:
    wrong = parameters(PX4_VALUES, COM_OBL_RC_ACT=0, COM_OF_LOSS_T=9.0, MAV_FWDEXTSP=0, NAV_DLL_ACT=0, MAV_SYS_ID=9)
    assert changes(changed(HEALTHY, parameters=wrong), config) == {
        "COM_OBL_RC_ACT": 4,
        "COM_OF_LOSS_T": 0.5,
        "MAV_FWDEXTSP": 1,
    }
    assert changes(HEALTHY, config) == {}
    copter = changed(COPTER, parameters=parameters(COPTER_VALUES, GUID_OPTIONS=5, GUID_TIMEOUT=3.0))
    assert changes(copter, with_params(config)) == {"GUID_OPTIONS": 13, "GUID_TIMEOUT": 1.0}


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"armed": True}, "armed"),
        ({"landed": Landed.IN_AIR}, "air"),
        ({"sysid": 3}, "vehicle 3"),
        ({"unreachable": "nothing is heard"}, "not reached"),
        ({}, ""),
    ],
)
def test_which_vehicles_parameters_may_be_changed(fields: dict[str, Any], word: str) -> None:
    assert word in unchangeable(changed(HEALTHY, **fields))
    assert bool(unchangeable(changed(HEALTHY, **fields))) == bool(word)


def test_only_known_names_are_asked_for_and_each_once(config: Config) -> None:
    names = names_to_read(PX4, config)
    assert len(set(names)) == len(names)
    assert {check.name for check in PX4.checks} <= set(names)
    assert set(ARDUCOPTER.to_read()) <= set(names_to_read(ARDUCOPTER, config))
    assert all(len(name) <= 16 for name in names)


MINIMAL: dict[str, Any] = {
    "name": "Third",
    "number": 99,
    "measured_version": (1, 0),
    "sysid_parameter": "ID",
    "mavlink2_setting": "PROTO = 2",
    "modes": {7: FlightMode.HOLD},
    "external": (1.0,),
    "hold": (2.0,),
    "land": LongCommand(LAND, ()),
    "takeoff_parameter": "",
    "arm_in": None,
    "integers_bytewise": False,
    "state": (ODOMETRY,),
    "rates_hz": {},
    "rules": (Rule("RULED", lambda value: value == 1, "set 1"),),
    "given": {"GIVEN": 1},
    "hover_parameter": "HOVER",
    "thrust_parameters": (),
    "horizontal_accuracy": "GPS_RAW_INT",
    "checks": (ParameterCheck("CHECKED", "why", lambda value, seen: Opinion(verdict=NOTE, wanted="2", advice="two")),),
    "also_read": (),
    "fence_checks": (),
    "log_suffix": ".log",
    "loss_parameter": "LOSS",
    "landing_parameter": "LANDING",
}


def test_no_parameter_of_a_plane_is_judged_or_set(config: Config) -> None:
    plane = changed(HEALTHY, kind_problem="it is a plane", parameters=parameters(PX4_VALUES, COM_OF_LOSS_T=3.0))
    assert changes(plane, with_params(config)) == {}
    assert exit_code([plane], findings([plane], with_params(config))) == 4


def test_a_new_dialect_needs_nothing_but_itself(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    dialect = Dialect(**MINIMAL)
    values: dict[str, float | int] = {"RULED": 0, "CHECKED": 1, "GIVEN": 0}
    third = changed(COPTER, autopilot="Third", autopilot_number=99, parameters=parameters(values))
    assert "swarmctl flies" in line_of(findings([third], with_params(config)), "autopilot").advice, "not yet"
    monkeypatch.setitem(DIALECTS, 99, dialect)
    assert names_to_read(dialect, with_params(config)) == ("RULED", "HOVER", "LOSS", "LANDING", "CHECKED")
    found = findings([third], with_params(config))
    assert "1.0" in line_of(found, "autopilot").advice
    assert line_of(found, "RULED").verdict is FIX
    assert (line_of(found, "CHECKED").advice, line_of(found, "CHECKED").wanted) == ("two", "2: why")
    assert "set ID" in line_of(findings([changed(third, sysid=9)], config), "system id").advice
    assert "PROTO = 2" in line_of(findings([changed(third, link_mavlink2=0)], config), "link").advice


@pytest.mark.parametrize("missing", MINIMAL)
def test_an_incomplete_dialect_is_refused(missing: str) -> None:
    with pytest.raises(TypeError, match=missing):
        Dialect(**{key: value for key, value in MINIMAL.items() if key != missing})


def test_every_module_of_an_autopilot_is_a_dialect_of_its_own() -> None:
    assert dict(DIALECTS) == {12: PX4, 3: ARDUCOPTER}


def test_a_change_that_was_not_done_is_to_fix() -> None:
    done, kept = (
        Change(agent=0, name="A", before=0, wanted=4, after=4, refused=""),
        Change(agent=0, name="A", before=0, wanted=4, after=0, refused=""),
    )
    assert done.done and "0 -> 4" in done.in_words()
    assert not kept.done and "not changed to 4" in kept.in_words()
    assert Change(agent=0, name="A", before=0.1, wanted=0.2, after=0.2 + 1e-9, refused="").done
    assert kept.finding().verdict is FIX
    assert "it is armed" in Change(agent=0, name="A", before=0, wanted=4, after=0, refused="it is armed").in_words()


def test_the_json_is_json_and_the_table_one_line_a_row(
    config: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = changed(HEALTHY, link_time=VehicleTime(1.0, 0.0, math.inf))
    lines = findings([facts], config)
    change = Change(agent=0, name="COM_OBL_RC_ACT", before=0, wanted=4, after=4, refused="")
    tree = json.loads(as_json([facts], lines, [change], 0))
    assert tree["vehicles"][0]["link"]["time"]["sigma_ppm"] is None
    assert tree["vehicles"][0]["mode"] == "HOLD"
    assert tree["changes"][0]["done"] is True
    print_check([facts], lines, [change])
    printed = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("agent-0\t") for line in printed) == len(lines)
    assert "agent-0 COM_OBL_RC_ACT: 0 -> 4" in printed
    assert printed[-1] == "1 of 1 vehicles reached, nothing to fix, 0 to know"


def test_what_a_vehicle_says_steers_no_terminal(config: Config, capsys: pytest.CaptureFixture[str]) -> None:
    hostile = "\x1b]0;owned\x07\x9b2J\u202e\r\nDONE"
    facts = changed(
        HEALTHY, version=Version(firmware=(1, 18, 0), stage="beta", git=hostile, board=1, uid=hostile, bytewise=True)
    )
    print_check(
        [facts],
        [
            *findings([facts], config),
            Finding(agent=0, topic="x", verdict=FIX, found=hostile, wanted=hostile, advice=hostile),
        ],
        [],
    )
    shown = capsys.readouterr().out
    assert "DONE" in shown
    assert all(c.isprintable() or c in "\n\t" for c in shown)
    assert not any(line.startswith("DONE") for line in shown.splitlines())


def test_what_a_vehicle_says_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    said = "refused [/bold] [red]"
    finding = Finding(agent=0, topic="x", verdict=FIX, found=said, wanted=said, advice=said)
    print_check([], [finding], [])
    assert capsys.readouterr().out.count(said) == 4, "the row has two, and the list below it two"
    drawn = io.StringIO()
    Console(file=drawn, width=200).print(_drawn([finding]))
    assert drawn.getvalue().count(said) == 2


@pytest.mark.parametrize(
    ("facts", "found"),
    [
        (HEALTHY, []),
        (dataclasses.replace(HEALTHY, armed=True), ["armed"]),
        (dataclasses.replace(HEALTHY, landed=Landed.IN_AIR), ["in_air"]),
        (unreached(0, URLS[0], 1, "no heartbeat"), ["unknown"]),
    ],
)
def test_only_a_vehicle_disarmed_on_the_ground_may_be_flown(facts: VehicleFacts, found: list[str]) -> None:
    lines = standing([facts])
    assert [line.found for line in lines] == found
    assert exit_code([facts], lines) == (0 if not found else 3 if facts.unreachable else 4)


def test_a_terminal_shows_once_what_is_the_same_of_several_vehicles(
    config: Config, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = findings([HEALTHY, SECOND_OK], config)
    print_check([HEALTHY, SECOND_OK], lines, ())
    assert capsys.readouterr().out.count("\tok\n") == sum(x.verdict is OK for x in lines), "a line each, for programs"
    drawn = io.StringIO()
    Console(file=drawn, width=300).print(_drawn(lines))
    cells = [[cell.strip() for cell in row.split("│")[1:-1]] for row in drawn.getvalue().splitlines() if row[0] == "│"]
    whose = [name for name, *_ in cells if name]
    assert {"all", "agent-0", "agent-1"} <= set(whose)
    assert len(whose) == len(set(whose)), "one section each"
    shown = {tuple(row[1:]) for row in cells}
    assert {(x.topic, x.found, x.wanted, x.verdict.name.lower()) for x in lines} == shown, "nothing is lost"
    assert len(cells) < 0.7 * len(lines)


@pytest.mark.parametrize(
    ("is_wanted", "is_permitted", "verdict"), [(True, True, OK), (True, False, NOTE), (False, False, OK)]
)
def test_a_computer_that_lets_setpoints_wait_is_told_of(
    capsys: pytest.CaptureFixture[str], is_wanted: bool, is_permitted: bool, verdict: Verdict
) -> None:
    finding = priority_finding(is_wanted=is_wanted, is_permitted=is_permitted)
    assert finding.verdict is verdict
    print_check([HEALTHY], [finding], [])
    printed = capsys.readouterr().out
    assert printed.splitlines()[1].startswith("computer\treal-time priority\t")
    assert ("rtprio" in printed) == (verdict is NOTE)
