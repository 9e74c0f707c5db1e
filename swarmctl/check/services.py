"""Checks of what MAVSDK was told by one vehicle: its own arming checks, and the geofence it stores. Pure."""

from __future__ import annotations

import pymap3d

from swarmctl.check.finding import Finding
from swarmctl.check.link_facts import FenceFacts, LatLon, VehicleFacts
from swarmctl.config import Config
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.registry import DIALECTS

_SAME_DEG = 3e-7  # 3 cm; autopilots store 1e-7
_WEIGHT_ARMING, _WEIGHT_FENCE = 71, 66


def service_findings(facts: VehicleFacts, config: Config) -> list[Finding]:
    """Return the findings about one vehicle; none for one that is not reached."""
    return [*_arming(facts), *_fence(facts, config)] if facts.reached else []


def corners_deg(config: Config) -> tuple[LatLon, ...]:
    """Return the corners of the configured geofence; empty without one."""
    swarm = config.swarm
    shared = swarm.origin_lat_deg, swarm.origin_lon_deg, swarm.origin_alt_m
    placed = (pymap3d.ned2geodetic(north, east, 0.0, *shared) for north, east in config.geofence.corners_ne_m)
    return tuple((float(lat), float(lon)) for lat, lon, _ in placed)


def wants_fence(facts: VehicleFacts, config: Config) -> bool:
    """Return whether a geofence is configured, and this vehicle is one that is given it."""
    dialect = DIALECTS.get(facts.autopilot_number)
    return bool(config.geofence.corners_ne_m) and dialect is not None and bool(dialect.fence_checks)


def has_fence(fence: FenceFacts, config: Config) -> bool:
    """Return whether a vehicle stores exactly the configured geofence."""
    wanted = corners_deg(config)
    return (
        not fence.problem
        and fence.others == 0
        and len(fence.corners_deg) == len(wanted)
        and all(
            abs(stored - asked) <= _SAME_DEG
            for corner, wished in zip(fence.corners_deg, wanted, strict=True)
            for stored, asked in zip(corner, wished, strict=True)
        )
    )


def _arming(facts: VehicleFacts) -> list[Finding]:
    def line(verdict: Verdict, found: str, advice: str = "") -> list[Finding]:
        return [
            Finding(
                agent=facts.agent,
                topic="arming checks",
                verdict=verdict,
                found=found,
                wanted="no problem in the autopilot's own list",
                advice=advice,
                weight=_WEIGHT_ARMING,
            )
        ]

    problems = facts.arming_problems
    if problems is None and facts.has_metadata and not facts.armed:
        return line(Verdict.NOTE, "not told", "its component information did not come in time; see the sensors")
    if problems is None:
        return line(Verdict.OK, "not told by this autopilot; see sensors")
    if blocking := [problem.text for problem in problems if problem.blocks]:
        return line(
            Verdict.FIX, "; ".join(blocking), f"the autopilot refuses to arm in {facts.mode.name} because of it"
        )
    if problems:
        texts = "; ".join(problem.text for problem in problems)
        return line(Verdict.NOTE, texts, "the autopilot warns of it, and arms all the same")
    return line(Verdict.OK, "no problem")


def _fence(facts: VehicleFacts, config: Config) -> list[Finding]:
    wanted = f"{len(config.geofence.corners_ne_m)} corners (geofence.corners_ne_m)"

    def line(verdict: Verdict, found: str, advice: str = "") -> list[Finding]:
        return [
            Finding(
                agent=facts.agent,
                topic="geofence",
                verdict=verdict,
                found=found,
                wanted=wanted,
                advice=advice,
                weight=_WEIGHT_FENCE,
            )
        ]

    if not config.geofence.corners_ne_m:
        return []
    if not wants_fence(facts, config):
        return line(Verdict.NOTE, "not looked at", "no geofence is uploaded to this autopilot; give it one by hand")
    fence = facts.fence
    if fence is None:
        return line(Verdict.FIX, "not told", "nothing is asked of a vehicle that is armed or another one")
    if fence.problem:
        return line(Verdict.FIX, fence.problem, "the geofence can be neither read nor uploaded")
    found = f"{len(fence.corners_deg)} corners" + (f" and {fence.others} other areas" if fence.others else "")
    if has_fence(fence, config):
        return line(Verdict.OK, f"{found}, the same")
    return line(Verdict.FIX, f"{found}, not the same" if fence.corners_deg else found, "--apply uploads it")
