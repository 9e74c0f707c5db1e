"""What a vehicle is, and whether it is the one that is meant, one function per row. Pure."""

from __future__ import annotations

from swarmctl.check.finding import Finding, line_of
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.config import Config
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.signing.refusals import HARMLESS, in_words

OK, NOTE, FIX = Verdict.OK, Verdict.NOTE, Verdict.FIX
_AUTOPILOTS = [dialect.name for dialect in DIALECTS.values()]


def autopilot(facts: VehicleFacts, config: Config) -> Finding:
    """Return which autopilot it is, and whether it is known."""
    line = line_of(facts.agent, "autopilot", " or ".join(_AUTOPILOTS))
    dialect = DIALECTS.get(facts.autopilot_number)
    if dialect is None:
        return line(FIX, f"MAV_AUTOPILOT {facts.autopilot_number}", f"swarmctl flies {' and '.join(_AUTOPILOTS)}", 95)
    if facts.kind_problem:
        return line(FIX, facts.autopilot, f"{facts.kind_problem}: it is not armed", 94)
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


def board(facts: VehicleFacts, config: Config) -> Finding | None:
    """Return the board it runs on."""
    if facts.version is None:
        return None
    return Finding(
        agent=facts.agent, topic="board", verdict=OK, found=f"{facts.version.board}, uid {facts.version.uid}"
    )


def sysid(facts: VehicleFacts, config: Config) -> Finding:
    """Return its system id."""
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


def signing(facts: VehicleFacts, config: Config) -> Finding | None:
    """Return whether frames of others were refused, on a signed link."""
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
