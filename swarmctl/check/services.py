"""Checks of what MAVSDK was told by one vehicle: its own arming checks, and the geofence it stores. Pure."""

from __future__ import annotations

from functools import partial

import pymap3d

from swarmctl.check.finding import Finding
from swarmctl.check.scan.link_facts import FenceFacts, LatLon, VehicleFacts
from swarmctl.config import Config
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.discovery import DIALECTS

_SAME_DEG = 3e-7  # 3 cm; autopilots store 1e-7
_WEIGHT_ARMING, _WEIGHT_FENCE = 71, 66


def service_findings(facts: VehicleFacts, config: Config) -> list[Finding]:
    """Return the findings about one vehicle; none for one that is not reached."""
    if not facts.reached:
        return []
    return [_arming(facts), *([_fence(facts, config)] if config.geofence.corners_ne_m else [])]


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


def _arming(facts: VehicleFacts) -> Finding:
    line = partial(
        Finding,
        agent=facts.agent,
        topic="arming checks",
        wanted="no problem in the autopilot's own list",
        weight=_WEIGHT_ARMING,
    )
    problems = facts.arming_problems
    if problems is None and facts.has_metadata and not facts.armed:
        advice = "its component information did not come in time; see the sensors"
        return line(verdict=Verdict.NOTE, found="not told", advice=advice)
    if problems is None:
        return line(verdict=Verdict.OK, found="not told by this autopilot; see sensors")
    if blocking := [problem.text for problem in problems if problem.blocks]:
        advice = f"the autopilot refuses to arm in {facts.mode.name} because of it"
        return line(verdict=Verdict.FIX, found="; ".join(blocking), advice=advice)
    if problems:
        texts = "; ".join(problem.text for problem in problems)
        return line(verdict=Verdict.NOTE, found=texts, advice="the autopilot warns of it, and arms all the same")
    return line(verdict=Verdict.OK, found="no problem")


def _fence(facts: VehicleFacts, config: Config) -> Finding:
    wanted = f"{len(config.geofence.corners_ne_m)} corners (geofence.corners_ne_m)"
    line = partial(Finding, agent=facts.agent, topic="geofence", wanted=wanted, weight=_WEIGHT_FENCE)
    if not wants_fence(facts, config):
        advice = "no geofence is uploaded to this autopilot; give it one by hand"
        return line(verdict=Verdict.NOTE, found="not looked at", advice=advice)
    fence = facts.fence
    if fence is None:
        advice = "nothing is asked of a vehicle that is armed or another one"
        return line(verdict=Verdict.FIX, found="not told", advice=advice)
    if fence.problem:
        return line(verdict=Verdict.FIX, found=fence.problem, advice="the geofence can be neither read nor uploaded")
    found = f"{len(fence.corners_deg)} corners" + (f" and {fence.others} other areas" if fence.others else "")
    if has_fence(fence, config):
        return line(verdict=Verdict.OK, found=f"{found}, the same")
    found += ", not the same" if fence.corners_deg else ""
    return line(verdict=Verdict.FIX, found=found, advice="--apply uploads it")
