"""How well a vehicle's link carries what agents need, one function per row. Pure."""

from __future__ import annotations

import math

from swarmctl.check.finding import Finding, line_of
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.config import Config
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.transport import parse_url

OK, NOTE, FIX = Verdict.OK, Verdict.NOTE, Verdict.FIX
_LOSS_NOTE_01, _LOSS_FIX_01 = 0.01, 0.05
# PX4's SIH runs 1 % slow on a busy machine, and agents follow far larger drifts. At 5 % the vehicle is a tenth of a
# second behind at the end of a plan, the tolerance of tracking.
_DRIFT_NOTE_PPM, _DRIFT_FIX_PPM = 20_000.0, 50_000.0
_LINK_SHARE_01 = 0.7  # usable share of a serial link's capacity
_BITS_A_BYTE = 10  # with start and stop bit
_MESSAGE_BYTES = {"ODOMETRY": 244, "LOCAL_POSITION_NED": 40, "ATTITUDE_QUATERNION": 44}
_SMALL_MESSAGE_BYTES = 40
_NAMES = {331: "ODOMETRY", 32: "LOCAL_POSITION_NED", 31: "ATTITUDE_QUATERNION"}


def senders(facts: VehicleFacts, config: Config) -> Finding:
    """Return who speaks on the link, and how much."""
    link = facts.link
    found = f"{link.frames_s:.0f} frames/s, {link.bytes_s / 1e3:.1f} kB/s"
    line = line_of(facts.agent, "link", "one autopilot, MAVLink 2")
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


def rates(facts: VehicleFacts, config: Config) -> Finding | None:
    """Return the rates of its state, and whether a serial link can carry them."""
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


def loss(facts: VehicleFacts, config: Config) -> Finding:
    """Return the frames that are lost."""
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


def latency(facts: VehicleFacts, config: Config) -> Finding:
    """Return the round trip."""
    trip = facts.link.round_trip
    tick_ms = 1e3 / config.agent.rate_hz
    oldest_ms = config.agent.failsafe.state_max_age_s * 1e3
    line = line_of(facts.agent, "round trip", f"p50 under {2 * tick_ms:.0f} ms")
    if trip is None:
        return line(NOTE, "no answer", "it answers neither TIMESYNC nor PING: the link's delay is not known")
    found = f"p50 {trip.p50_ms:.1f}, p99 {trip.p99_ms:.1f} ms ({trip.answers} {trip.by})"
    if trip.p99_ms / 2 > oldest_ms:
        advice = f"states would be older than agent.failsafe.state_max_age_s = {oldest_ms / 1e3:g}: use a quicker link"
        return line(FIX, found, advice, 70)
    if trip.p50_ms / 2 > tick_ms:
        return line(NOTE, found, f"add {trip.p50_ms / 2e3:.3f} s of it to {config.model_key(facts.agent)}.delay_s", 7)
    return line(OK, found)


def clock(facts: VehicleFacts, config: Config) -> Finding | None:
    """Return how far its clock runs off."""
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
