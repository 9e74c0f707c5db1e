"""Findings about one vehicle and its link: a table of rows, each a function of facts and configuration. Pure."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.check.finding import Finding
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.check.vehicle import condition, identity, link
from swarmctl.config import Config
from swarmctl.core.verdict import Verdict

_LATCH = (
    "PX4 sends only to its first sender, for good: if that was another program, restart PX4, "
    "or use the port of that program"
)
_NO_KEY = (
    "the vehicle does not sign with its key in mavlink.signing_keys (swarmctl keys install), or its clock is more than "
    "a minute ahead of this computer's"
)

_ROWS: tuple[Callable[[VehicleFacts, Config], Finding | None], ...] = (
    identity.autopilot,
    identity.board,
    identity.sysid,
    condition.state,
    condition.sensors,
    condition.battery,
    condition.estimator,
    condition.place,
    link.senders,
    identity.signing,
    link.rates,
    link.loss,
    link.latency,
    link.clock,
)


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
    if not facts.opened:
        advice = f"vehicles.{facts.agent}.url names a link that this computer can't open"
    return Finding(
        agent=facts.agent,
        topic="link",
        verdict=Verdict.FIX,
        found=facts.unreachable,
        wanted="an autopilot's heartbeat",
        advice=advice,
        weight=100,
    )
