"""Checks of one vehicle and its link, one function per row: facts and configuration in, one finding out. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable

from swarmctl.check.finding import Finding
from swarmctl.check.link_facts import VehicleFacts
from swarmctl.config import Config
from swarmctl.core.types import FlightMode
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.signing.refusals import HARMLESS, in_words
from swarmctl.mavlink.transport import parse_url

OK, NOTE, FIX = Verdict.OK, Verdict.NOTE, Verdict.FIX
_AUTOPILOTS = [dialect.name for dialect in DIALECTS.values()]
_CRITICAL = 5  # MAV_STATE
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
_PREARM = 1 << 28
_ESTIMATES = {0: "attitude", 1: "horizontal velocity", 2: "vertical velocity", 4: "horizontal position", 5: "height"}
_ESTIMATOR_FAULTS = {10: "GPS glitch", 11: "bad accelerometer"}  # bits of ESTIMATOR_STATUS.flags
_FIX_3D = 3
_BATTERY_LOW_01, _BATTERY_EMPTY_01 = 0.5, 0.25
_LOSS_NOTE_01, _LOSS_FIX_01 = 0.01, 0.05
# PX4's SIH runs 1 % slow on a busy machine, and agents follow far larger drifts. At 5 % the vehicle is a tenth of a
# second behind at the end of a plan, the tolerance of tracking.
_DRIFT_NOTE_PPM, _DRIFT_FIX_PPM = 20_000.0, 50_000.0
_ORIGIN_FAR_M = 1000.0  # local frames are rotated against each other, and the earth is curved
_LINK_SHARE_01 = 0.7  # usable share of a serial link's capacity
_LATCH = (
    "PX4 sends only to its first sender, for good: if that was another program, restart PX4, "
    "or use the port of that program"
)
_NO_KEY = (
    "the vehicle does not sign with its key in mavlink.signing_keys (swarmctl keys install), or its clock is more than "
    "a minute ahead of this computer's"
)
_BITS_A_BYTE = 10  # with start and stop bit
_MESSAGE_BYTES = {"ODOMETRY": 244, "LOCAL_POSITION_NED": 40, "ATTITUDE_QUATERNION": 44}
_SMALL_MESSAGE_BYTES = 40
_NAMES = {331: "ODOMETRY", 32: "LOCAL_POSITION_NED", 31: "ATTITUDE_QUATERNION"}


def vehicle_findings(facts: VehicleFacts, config: Config) -> list[Finding]:
    """Return the finding of every row that applies; for an unreached vehicle only that."""
    if not facts.reached:
        return [_unreached(facts)]
    return [line for assess in _ROWS if (line := assess(facts, config)) is not None]


def _unreached(facts: VehicleFacts) -> Finding:
    advice = f"no autopilot at {facts.url}: is it on, and does it send there?"
    if facts.url.startswith("udp"):
        advice += f" {_LATCH}"
    if facts.link.mavlink1 or facts.link.mavlink2:
        advice = f"something sends to {facts.url}, but no autopilot: check the address and the routing"
    if facts.link.refused:
        advice = _NO_KEY
    return Finding(
        agent=facts.agent,
        topic="link",
        verdict=FIX,
        found=facts.unreachable,
        wanted="an autopilot's heartbeat",
        advice=advice,
        weight=100,
    )


def _autopilot(facts: VehicleFacts, config: Config) -> Finding:
    def line(verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="autopilot",
            verdict=verdict,
            found=found,
            wanted=" or ".join(_AUTOPILOTS),
            advice=advice,
            weight=weight,
        )

    dialect = DIALECTS.get(facts.autopilot_number)
    if dialect is None:
        return line(FIX, f"MAV_AUTOPILOT {facts.autopilot_number}", f"swarmctl flies {' and '.join(_AUTOPILOTS)}", 95)
    version = facts.version
    if version is None:
        return line(NOTE, facts.autopilot, "it does not tell its version (AUTOPILOT_VERSION)")
    number = ".".join(map(str, version.firmware))
    found = " ".join(filter(None, (facts.autopilot, number, version.stage, version.git[:8])))
    if version.bytewise is not None and version.bytewise is not dialect.integers_bytewise:
        return line(
            FIX, found, "it encodes integer parameters otherwise than its kind does; values can't be trusted", 93
        )
    known = dialect.measured_version
    if version.firmware[:2] != known:
        return line(NOTE, found, f"behaviour was measured on {known[0]}.{known[1]}; fly it alone first")
    return line(OK, found)


def _board(facts: VehicleFacts, config: Config) -> Finding | None:
    if facts.version is None:
        return None
    return Finding(
        agent=facts.agent, topic="board", verdict=OK, found=f"{facts.version.board}, uid {facts.version.uid}"
    )


def _sysid(facts: VehicleFacts, config: Config) -> Finding:
    if facts.sysid == facts.wanted_sysid:
        return Finding(
            agent=facts.agent, topic="system id", verdict=OK, found=f"{facts.sysid}", wanted=f"{facts.wanted_sysid}"
        )
    dialect = DIALECTS.get(facts.autopilot_number)
    name = "its system id" if dialect is None else dialect.sysid_parameter
    advice = f"set {name} = {facts.wanted_sysid} and reboot, or correct the configuration: an agent ignores all others"
    return Finding(
        agent=facts.agent,
        topic="system id",
        verdict=FIX,
        found=f"{facts.sysid}",
        wanted=f"{facts.wanted_sysid}",
        advice=advice,
        weight=92,
    )


def _link(facts: VehicleFacts, config: Config) -> Finding:
    link = facts.link
    found = f"{link.frames_s:.0f} frames/s, {link.bytes_s / 1e3:.1f} kB/s"

    def line(verdict: Verdict, told: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="link",
            verdict=verdict,
            found=told,
            wanted="one autopilot, MAVLink 2",
            advice=advice,
            weight=weight,
        )

    if not link.mavlink2:
        dialect = DIALECTS.get(facts.autopilot_number)
        cure = "" if dialect is None else f": set {dialect.mavlink2_setting}"
        return line(FIX, "MAVLink 1 only", f"agents speak MAVLink 2{cure}", 94)
    if len(link.autopilots) > 1:
        ids = ", ".join(map(str, link.autopilots))
        return line(FIX, f"autopilots {ids}", "every vehicle needs a link of its own; give the others another port", 91)
    if link.senders > 1:
        told = f"{link.senders} senders"
        return line(FIX, told, "an agent takes the first one it hears for its vehicle; let only the vehicle send", 89)
    return line(OK, found)


def _state(facts: VehicleFacts, config: Config) -> Finding:
    words = (facts.mode.name, "armed" if facts.armed else "disarmed", facts.landed.name.lower().replace("_", " "))
    found = ", ".join(words)

    def line(verdict: Verdict, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="state",
            verdict=verdict,
            found=found,
            wanted="disarmed, on ground",
            advice=advice,
            weight=weight,
        )

    if facts.system_status >= _CRITICAL:
        return line(FIX, f"the autopilot reports a failsafe or emergency (MAV_STATE {facts.system_status})", 99)
    if facts.armed and facts.mode is FlightMode.EXTERNAL:
        return line(NOTE, "another program flies it by setpoints now; it is not changed", 9)
    if facts.armed:
        return line(NOTE, "it is armed; it is not changed", 8)
    return line(OK)


def _sensors(facts: VehicleFacts, config: Config) -> Finding:
    sensors = facts.sensors

    def line(verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="sensors",
            verdict=verdict,
            found=found,
            wanted="healthy, ready to arm",
            advice=advice,
            weight=weight,
        )

    if sensors is None:
        return line(NOTE, "not told", "SYS_STATUS does not come; the agent asks for it")
    ill = sensors.present & sensors.enabled & ~sensors.healthy & ~_PREARM
    if ill:
        names = ", ".join(_SENSOR_BITS.get(bit, f"bit {bit}") for bit in range(32) if ill >> bit & 1)
        return line(FIX, f"unhealthy: {names}", "see the autopilot's own messages; calibrate, repair or disable", 75)
    if not facts.armed and not sensors.healthy & _PREARM:
        advice = f"arming would be refused in {facts.mode.name} now; see the autopilot's messages, or change the mode"
        return line(FIX, "not ready to arm", advice, 72)
    return line(OK, "healthy" if facts.armed else "healthy, ready to arm")


def _battery(facts: VehicleFacts, config: Config) -> Finding:
    failsafe = config.agent.failsafe
    low_01 = max(_BATTERY_LOW_01, failsafe.battery_warn_01)
    empty_01 = max(_BATTERY_EMPTY_01, failsafe.battery_rtl_01)
    volts = facts.sensors.battery_v if facts.sensors else None
    left_01 = facts.sensors.battery_01 if facts.sensors else None

    def line(verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="battery",
            verdict=verdict,
            found=found,
            wanted=", ".join([f"over {low_01:.0%}", *failsafe.acts("battery")]),
            advice=advice,
            weight=weight,
        )

    told = "" if volts is None else f"{volts:.1f} V"
    if left_01 is None:
        return line(NOTE, told or "not told", "its charge is not known; measure it")
    found = f"{told} {left_01:.0%}".strip()
    if left_01 < empty_01:
        return line(FIX, found, "charge or change it", 65)
    if left_01 < low_01:
        return line(NOTE, found, "enough for a short flight only", 5)
    return line(OK, found)


def _estimator(facts: VehicleFacts, config: Config) -> Finding:
    estimator, gps = facts.estimator, facts.gps
    accuracy_m = facts.pos_accuracy_m
    told = "" if accuracy_m is None else f"{accuracy_m:.2f} m horizontal"
    fix = "" if gps is None else f"GPS fix {gps.fix_type}" + ("" if gps.satellites is None else f"/{gps.satellites}")
    found = ", ".join(filter(None, (told, fix)))

    def line(verdict: Verdict, what: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="estimator",
            verdict=verdict,
            found=what or "not told",
            wanted="all estimates",
            advice=advice,
            weight=weight,
        )

    if estimator is not None:
        missing = [name for bit, name in _ESTIMATES.items() if not estimator.flags >> bit & 1]
        faults = [name for bit, name in _ESTIMATOR_FAULTS.items() if estimator.flags >> bit & 1]
        if missing:
            return line(FIX, f"no {', '.join(missing)}", "wait for the estimator, or give it a position source", 74)
        if faults:
            return line(FIX, ", ".join(faults), "the estimator distrusts a sensor: find the cause before flight", 73)
    elif gps is not None and gps.fix_type < _FIX_3D:
        return line(FIX, found, "no position: wait for a 3-D fix, or feed another position source", 74)
    if accuracy_m is None:
        return line(NOTE, found, "it does not tell how accurate it is; the separation radius has to allow for it")
    return line(OK, found)


def _place(facts: VehicleFacts, config: Config) -> Finding:
    origin = facts.origin_ned_m

    def line(verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="origin",
            verdict=verdict,
            found=found,
            wanted="near swarm.origin_*",
            advice=advice,
            weight=weight,
        )

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


def _rates(facts: VehicleFacts, config: Config) -> Finding | None:
    dialect = DIALECTS.get(facts.autopilot_number)
    if dialect is None:
        return None
    asked_hz = config.agent.state_machine.state_rate_hz
    names = [_NAMES.get(number, f"message {number}") for number in dialect.state]
    rates = facts.link.rates_hz
    found = ", ".join(f"{name} {rates.get(name, 0.0):.0f} Hz" for name in names)
    wanted = f"{asked_hz:.0f} Hz, asked for at launch"
    endpoint = parse_url(facts.url) if facts.url.startswith("serial") else None
    if endpoint is not None:
        sizes = {name: _MESSAGE_BYTES.get(name, _SMALL_MESSAGE_BYTES) for name in names}
        more = sum(sizes[name] * max(0.0, asked_hz - rates.get(name, 0.0)) for name in names)
        more += sum(dialect.rates_hz.values()) * _SMALL_MESSAGE_BYTES
        planned, most = facts.link.bytes_s + more, endpoint.number / _BITS_A_BYTE * _LINK_SHARE_01
        if planned > most:
            advice = (
                f"{planned / 1e3:.1f} kB/s would be sent over a link for {most / 1e3:.1f}: raise the baud rate, "
                "lower agent.state_machine.state_rate_hz, or stop other streams"
            )
            return Finding(
                agent=facts.agent, topic="state rate", verdict=FIX, found=found, wanted=wanted, advice=advice, weight=68
            )
    return Finding(agent=facts.agent, topic="state rate", verdict=OK, found=found, wanted=wanted)


def _loss(facts: VehicleFacts, config: Config) -> Finding:
    lost_01, dropped = facts.link.lost_01, facts.link.dropped
    if lost_01 > _LOSS_NOTE_01:
        verdict = FIX if lost_01 > _LOSS_FIX_01 else NOTE
        advice = "frames are lost on the way: antennas, baud rate, or too much is sent"
    else:
        verdict = NOTE if dropped else OK
        advice = "this computer was too busy to take all that arrived: fly with less beside it" if dropped else ""
    failsafe = config.agent.failsafe
    acts = ", ".join(failsafe.acts("link"))
    return Finding(
        agent=facts.agent,
        topic="loss",
        verdict=verdict,
        found=f"{lost_01:.1%} on the way" + (f", {dropped} not taken by this computer" if dropped else ""),
        wanted=f"under {_LOSS_NOTE_01:.0%}"
        + (f"; in flight: {acts} of {failsafe.window_s:g} s without a new state" if acts else ""),
        advice=advice,
        weight=67,
    )


def _latency(facts: VehicleFacts, config: Config) -> Finding:
    trip = facts.link.round_trip
    tick_ms = 1e3 / config.agent.rate_hz
    oldest_ms = config.agent.failsafe.state_max_age_s * 1e3

    def line(verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=facts.agent,
            topic="round trip",
            verdict=verdict,
            found=found,
            wanted=f"p50 under {2 * tick_ms:.0f} ms",
            advice=advice,
            weight=weight,
        )

    if trip is None:
        return line(NOTE, "no answer", "it answers neither TIMESYNC nor PING: the link's delay is not known")
    found = f"p50 {trip.p50_ms:.1f}, p99 {trip.p99_ms:.1f} ms ({trip.answers} {trip.by})"
    if trip.p99_ms / 2 > oldest_ms:
        advice = f"states would be older than agent.failsafe.state_max_age_s = {oldest_ms / 1e3:g}: use a quicker link"
        return line(FIX, found, advice, 70)
    if trip.p50_ms / 2 > tick_ms:
        return line(NOTE, found, f"add {trip.p50_ms / 2e3:.3f} s of it to vehicle_model.delay_s", 7)
    return line(OK, found)


def _clock(facts: VehicleFacts, config: Config) -> Finding | None:
    time = facts.link.time
    if time is None:
        return None
    sure_ppm = max(0.0, abs(time.drift_ppm) - 3 * time.sigma_ppm)
    spread = f" (+-{time.sigma_ppm:.0f})" if math.isfinite(time.sigma_ppm) else " (too short to tell)"
    found = f"offset {time.offset_s:+.3f} s, drift {time.drift_ppm:+.0f}{spread} ppm"
    verdict = FIX if sure_ppm > _DRIFT_FIX_PPM else NOTE if sure_ppm > _DRIFT_NOTE_PPM else OK
    advice = "" if verdict is OK else "its clock runs off; a simulator short of CPU does so: give it more, or fly fewer"
    return Finding(
        agent=facts.agent,
        topic="clock",
        verdict=verdict,
        found=found,
        wanted=f"under {_DRIFT_NOTE_PPM:.0f} ppm",
        advice=advice,
        weight=55,
    )


def _signing(facts: VehicleFacts, config: Config) -> Finding | None:
    if facts.link.refused is None:
        return None
    found = {reason: count for reason, count in facts.link.refused.items() if reason not in HARMLESS}
    return Finding(
        agent=facts.agent,
        topic="signing",
        verdict=NOTE if found else OK,
        found=f"signed, {in_words(found)} refused" if found else "signed",
        wanted="all signed with one key",
        advice="somebody else sends to this link, or a part of the vehicle does not sign" if found else "",
        weight=40,
    )


_ROWS: tuple[Callable[[VehicleFacts, Config], Finding | None], ...] = (
    _autopilot,
    _board,
    _sysid,
    _state,
    _sensors,
    _battery,
    _estimator,
    _place,
    _link,
    _signing,
    _rates,
    _loss,
    _latency,
    _clock,
)
