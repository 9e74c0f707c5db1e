"""Converts the messages of a scan to `VehicleFacts`: units, bits and frames, without judgement."""

from __future__ import annotations

import math
from typing import Any

import pymap3d

from swarmctl.check.scan.link_facts import (
    Estimator,
    Gps,
    LinkFacts,
    Ned,
    Sensors,
    VehicleFacts,
    Version,
)
from swarmctl.check.scan.link_statistics import FrameStatistics, round_trip, vehicle_time
from swarmctl.check.scan.scanner import VehicleScan
from swarmctl.core.mavlink_values import ARMED_FLAG
from swarmctl.core.types import FlightMode, GeoOrigin, Landed
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.signing.refusals import in_words
from swarmctl.mavlink.vehicle.plausibility import kind_problem

_BYTEWISE, _C_CAST = 1 << 4, 1 << 17  # MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_*
_ENOUGH_ANSWERS = 3
_STAGES = ((255, "release"), (192, "rc"), (128, "beta"), (64, "alpha"), (0, "dev"))  # FIRMWARE_VERSION_TYPE
_UNKNOWN_8, _UNKNOWN_16 = 255, 65535


def unreached(agent: int, url: str, wanted_sysid: int, why: str) -> VehicleFacts:
    """Return the facts of a vehicle whose link could not be opened."""
    link = LinkFacts(
        listened_s=0.0,
        rates_hz={},
        frames_s=0.0,
        bytes_s=0.0,
        lost_01=0.0,
        mavlink1=0,
        mavlink2=0,
        autopilots=(),
        senders=0,
        round_trip=None,
        time=None,
    )
    return VehicleFacts(agent=agent, url=url, wanted_sysid=wanted_sysid, unreachable=why, link=link, opened=False)


def facts_of(
    scan: VehicleScan, agent: int, url: str, wanted_sysid: int, *, shared: GeoOrigin, now_us: int
) -> VehicleFacts:
    """Return everything that a scan has received until `now_us`.

    Args:
        scan: the scan of this vehicle.
        agent, url, wanted_sysid: values of the configuration.
        shared: origin of the shared frame.
        now_us: monotonic time.
    """
    link = _link(scan, scan.listened_s(now_us))
    beat = scan.message("HEARTBEAT")
    if beat is None:
        return VehicleFacts(agent=agent, url=url, wanted_sysid=wanted_sysid, unreachable=_silence(scan), link=link)
    dialect = DIALECTS.get(beat.autopilot)
    pos, origin, told = _place(scan, shared)
    return VehicleFacts(
        agent=agent,
        url=url,
        wanted_sysid=wanted_sysid,
        unreachable="",
        link=link,
        sysid=scan.sysid,
        autopilot="" if dialect is None else dialect.name,
        autopilot_number=beat.autopilot,
        kind_problem=kind_problem(beat.type),
        version=_version(scan.message("AUTOPILOT_VERSION")),
        mode=FlightMode.UNKNOWN if dialect is None else dialect.mode(beat.custom_mode),
        custom_mode=beat.custom_mode,
        armed=bool(beat.base_mode & ARMED_FLAG),
        landed=_landed(scan.message("EXTENDED_SYS_STATE")),
        system_status=beat.system_status,
        sensors=_sensors(scan.message("SYS_STATUS")),
        estimator=_estimator(scan.message("ESTIMATOR_STATUS")),
        gps=_gps(scan.message("GPS_RAW_INT")),
        pos_ned_m=pos,
        origin_ned_m=origin,
        origin_told=told,
        parameters={} if scan.parameters is None else scan.parameters.facts(),
        has_metadata=scan.has_metadata,
    )


def _silence(scan: VehicleScan) -> str:
    if not scan.senders:
        refused = in_words(scan.listener.refused or {})
        return f"frames are refused: {refused}" if refused else "nothing is heard"
    return "frames are heard, but no autopilot's heartbeat"


def _link(scan: VehicleScan, listened_s: float) -> LinkFacts:
    statistics = scan.statistics.get(scan.sysid, FrameStatistics())
    by = "TIMESYNC" if len(scan.answers["TIMESYNC"]) >= _ENOUGH_ANSWERS else "PING"
    span_s = max(listened_s, 1e-6)
    return LinkFacts(
        listened_s=listened_s,
        rates_hz=statistics.rates_hz(listened_s),
        frames_s=statistics.frames / span_s,
        bytes_s=statistics.bytes / span_s,
        lost_01=statistics.lost_01(scan.dropped_frames),
        dropped=scan.listener.dropped,
        refused=scan.listener.refused,
        mavlink1=scan.mavlink1,
        mavlink2=scan.mavlink2,
        autopilots=scan.autopilots(),
        senders=len(scan.senders),
        round_trip=round_trip(scan.answers[by], by),
        time=vehicle_time(scan.answers["TIMESYNC"]),
    )


def _version(message: Any | None) -> Version | None:
    if message is None:
        return None
    flight = message.flight_sw_version
    stage = next(name for least, name in _STAGES if flight & 0xFF >= least)
    git = bytes(message.flight_custom_version)
    text = git.rstrip(b"\0")
    readable = text.decode("ascii") if text and all(chr(c) in "0123456789abcdef" for c in text) else git[::-1].hex()
    uid = bytes(message.uid2).rstrip(b"\0").hex() or "0"
    capabilities = message.capabilities
    return Version(
        firmware=(flight >> 24 & 0xFF, flight >> 16 & 0xFF, flight >> 8 & 0xFF),
        stage=stage,
        git=readable.strip("0") and readable,
        board=message.board_version,
        uid=uid,
        bytewise=True if capabilities & _BYTEWISE else False if capabilities & _C_CAST else None,
        vendor=message.vendor_id,
    )


def _landed(message: Any | None) -> Landed:
    if message is None or message.landed_state > Landed.LANDING:
        return Landed.UNKNOWN
    return Landed(message.landed_state)


def _sensors(message: Any | None) -> Sensors | None:
    if message is None:
        return None
    return Sensors(
        present=message.onboard_control_sensors_present,
        enabled=message.onboard_control_sensors_enabled,
        healthy=message.onboard_control_sensors_health,
        battery_v=None if message.voltage_battery in (0, _UNKNOWN_16) else message.voltage_battery * 1e-3,
        battery_01=None if message.battery_remaining < 0 else message.battery_remaining * 1e-2,
    )


def _estimator(message: Any | None) -> Estimator | None:
    if message is None:
        return None
    return Estimator(message.flags, _told(message.pos_horiz_accuracy))


def _told(value: float) -> float | None:
    """Return an accuracy, or None when it is zero, negative or not finite."""
    return float(value) if math.isfinite(value) and value > 0 else None


def _gps(message: Any | None) -> Gps | None:
    if message is None:
        return None
    satellites = None if message.satellites_visible == _UNKNOWN_8 else message.satellites_visible
    return Gps(message.fix_type, satellites, message.h_acc * 1e-3 if message.h_acc else None)


def _place(scan: VehicleScan, shared: GeoOrigin) -> tuple[Ned | None, Ned | None, bool]:
    """Return position and local origin in the shared frame, and whether the vehicle reported its origin itself."""
    local = scan.message("LOCAL_POSITION_NED") or scan.message("ODOMETRY")
    world = scan.message("GLOBAL_POSITION_INT")
    zero = scan.message("GPS_GLOBAL_ORIGIN")
    here = None if local is None else _ned(local.x, local.y, local.z)
    if zero is not None:
        origin = _in_shared(zero.latitude, zero.longitude, zero.altitude, shared)
        return None if here is None else _sum(origin, here), origin, True
    if world is None or (world.lat == 0 and world.lon == 0):
        return None, None, False
    pos = _in_shared(world.lat, world.lon, world.alt, shared)
    return pos, None if here is None else _sum(pos, here, -1.0), False


def _in_shared(lat_e7: int, lon_e7: int, alt_mm: int, shared: GeoOrigin) -> Ned:
    north, east, down = pymap3d.geodetic2ned(
        lat_e7 * 1e-7, lon_e7 * 1e-7, alt_mm * 1e-3, shared.lat_deg, shared.lon_deg, shared.alt_m
    )
    return float(north), float(east), float(down)


def _ned(x: float, y: float, z: float) -> Ned | None:
    return (x, y, z) if all(math.isfinite(c) for c in (x, y, z)) else None


def _sum(a: Ned, b: Ned, scale: float = 1.0) -> Ned:
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]
