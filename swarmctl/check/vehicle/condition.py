"""Whether a vehicle is fit to fly: its state, sensors, battery and estimate, one function per row. Pure."""

from __future__ import annotations

import math

from swarmctl.check.finding import Finding, line_of
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.config import Config
from swarmctl.core.mavlink_values import CRITICAL, GPS_FIX_3D, PREARM_CHECK
from swarmctl.core.types import FlightMode
from swarmctl.core.verdict import Verdict

OK, NOTE, FIX = Verdict.OK, Verdict.NOTE, Verdict.FIX
_SENSOR_BITS = {
    0: "gyro",
    1: "accelerometer",
    2: "magnetometer",
    3: "barometer",
    5: "GPS",
    6: "optical flow",
    7: "vision",
    12: "yaw control",
    13: "height control",
    14: "position control",
    15: "motors",
    16: "radio",
    20: "geofence",
    21: "attitude",
    24: "logging",
    25: "battery",
}  # MAV_SYS_STATUS_SENSOR
_ESTIMATES = {0: "attitude", 1: "horizontal velocity", 2: "vertical velocity", 4: "horizontal position", 5: "height"}
_ESTIMATOR_FAULTS = {10: "GPS glitch", 11: "bad accelerometer"}  # bits of ESTIMATOR_STATUS.flags
_BATTERY_LOW_01, _BATTERY_EMPTY_01 = 0.5, 0.25
_ORIGIN_FAR_M = 1000.0  # local frames are rotated against each other, and the earth is curved


def state(facts: VehicleFacts, config: Config) -> Finding:
    """Return the flight mode, and whether it is armed or lands."""
    words = (facts.mode.name, "armed" if facts.armed else "disarmed", facts.landed.name.lower().replace("_", " "))
    found = ", ".join(words)
    line = line_of(facts.agent, "state", "disarmed, on ground")
    if facts.system_status >= CRITICAL:
        return line(FIX, found, f"the autopilot reports a failsafe or emergency (MAV_STATE {facts.system_status})", 99)
    if facts.armed and facts.mode is FlightMode.EXTERNAL:
        return line(NOTE, found, "another program flies it by setpoints now; it is not changed", 9)
    if facts.armed:
        return line(NOTE, found, "it is armed; it is not changed", 8)
    return line(OK, found)


def sensors(facts: VehicleFacts, config: Config) -> Finding:
    """Return its sensors, and whether it may be armed."""
    sensors = facts.sensors
    line = line_of(facts.agent, "sensors", "healthy, ready to arm")
    if sensors is None:
        return line(NOTE, "not told", "SYS_STATUS does not come; the agent asks for it")
    ill = sensors.present & sensors.enabled & ~sensors.healthy & ~PREARM_CHECK
    if ill:
        names = ", ".join(_SENSOR_BITS.get(bit, f"bit {bit}") for bit in range(32) if ill >> bit & 1)
        return line(FIX, f"unhealthy: {names}", "see the autopilot's own messages; calibrate, repair or disable", 75)
    if not facts.armed and not sensors.healthy & PREARM_CHECK:
        advice = f"arming would be refused in {facts.mode.name} now; see the autopilot's messages, or change the mode"
        return line(FIX, "not ready to arm", advice, 72)
    return line(OK, "healthy" if facts.armed else "healthy, ready to arm")


def battery(facts: VehicleFacts, config: Config) -> Finding:
    """Return the charge."""
    failsafe = config.agent.failsafe
    low_01 = max(_BATTERY_LOW_01, failsafe.battery_warn_01)
    empty_01 = max(_BATTERY_EMPTY_01, failsafe.battery_rtl_01)
    volts = facts.sensors.battery_v if facts.sensors else None
    left_01 = facts.sensors.battery_01 if facts.sensors else None
    line = line_of(facts.agent, "battery", ", ".join([f"over {low_01:.0%}", *failsafe.acts("battery")]))
    told = "" if volts is None else f"{volts:.1f} V"
    if left_01 is None:
        return line(NOTE, told or "not told", "its charge is not known; measure it")
    found = f"{told} {left_01:.0%}".strip()
    if left_01 < empty_01:
        return line(FIX, found, "charge or change it", 65)
    if left_01 < low_01:
        return line(NOTE, found, "enough for a short flight only", 5)
    return line(OK, found)


def estimator(facts: VehicleFacts, config: Config) -> Finding:
    """Return the estimate and its accuracy."""
    estimator, gps = facts.estimator, facts.gps
    accuracy_m = facts.pos_accuracy_m
    told = "" if accuracy_m is None else f"{accuracy_m:.2f} m horizontal"
    fix = "" if gps is None else f"GPS fix {gps.fix_type}" + ("" if gps.satellites is None else f"/{gps.satellites}")
    found = ", ".join(filter(None, (told, fix))) or "not told"
    line = line_of(facts.agent, "estimator", "all estimates")
    if estimator is not None:
        missing = [name for bit, name in _ESTIMATES.items() if not estimator.flags >> bit & 1]
        faults = [name for bit, name in _ESTIMATOR_FAULTS.items() if estimator.flags >> bit & 1]
        if missing:
            return line(FIX, f"no {', '.join(missing)}", "wait for the estimator, or give it a position source", 74)
        if faults:
            return line(FIX, ", ".join(faults), "the estimator distrusts a sensor: find the cause before flight", 73)
    elif gps is not None and gps.fix_type < GPS_FIX_3D:
        return line(FIX, found, "no position: wait for a 3-D fix, or feed another position source", 74)
    if accuracy_m is None:
        return line(NOTE, found, "it does not tell how accurate it is; the separation radius has to allow for it")
    return line(OK, found)


def place(facts: VehicleFacts, config: Config) -> Finding:
    """Return where its local origin is."""
    origin = facts.origin_ned_m
    line = line_of(facts.agent, "origin", "near swarm.origin_*")
    if origin is None:
        advice = "it tells neither GPS_GLOBAL_ORIGIN nor a global position: it can't be placed among the others"
        return line(FIX, "not told", advice, 78)
    found = ", ".join(f"{c:+.2f}" for c in origin) + " m"
    away_m = math.dist(origin, (0.0, 0.0, 0.0))
    if away_m > _ORIGIN_FAR_M:
        advice = "set swarm.origin_lat_deg, origin_lon_deg and origin_alt_m to where the vehicles stand"
        return line(FIX, f"{away_m / 1e3:.1f} km off", advice, 79)
    if not facts.origin_told:
        return line(NOTE, found, "worked out from its global position, GPS_GLOBAL_ORIGIN does not come")
    return line(OK, found)
