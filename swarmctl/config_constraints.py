"""Constraints between sections of a configuration: what is wrong with keys that are each right by themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from swarmctl.bus.json_messages import MAX_OBSTACLES
from swarmctl.bus.network.hosts import host_problems
from swarmctl.control.collision.separation import radius_problem
from swarmctl.control.reference.feasibility import FlightLimits, infeasible
from swarmctl.core.own import OwnError
from swarmctl.errors import ConfigError
from swarmctl.mavlink.geofence import is_inside
from swarmctl.mavlink.parameter_names import parameter_problems
from swarmctl.mavlink.transport import Endpoint, parse_url
from swarmctl.signing_keys import key_problems

if TYPE_CHECKING:
    from swarmctl.config import Config

_PAIRS_SHOWN = 3


def constraint_problems(config: Config, only_agents: Collection[int] | None) -> Iterator[str]:
    """Yield problems between keys and sections, and of files.

    Args:
        config: each of its keys is right by itself.
        only_agents: the agents that are to run on this computer, which has their vehicles' signing keys; None: all.
    """
    agents = config.swarm.agents
    yield from _start_problems(config)
    yield from _vehicle_problems(config)
    yield from host_problems(config.hosts, agents)
    yield from _simulated_host_problems(config)
    yield from _forward_problems(config)
    yield from key_problems(config.mavlink.signing_keys, agents, only_agents)
    if len(config.obstacles) > MAX_OBSTACLES:
        yield f"obstacles: {len(config.obstacles)} are listed, agents keep {MAX_OBSTACLES} at most"
    yield from parameter_problems(config.agent.autopilot_params)
    yield from config.agent.failsafe.problems()
    if config.sitl.speed != 1.0:
        yield (
            f"sitl.speed = {config.sitl.speed}: agents fly on wall time and can't follow; leave it at 1. Faster than "
            "real time: swarmctl simulate, or python -m sitl --speed with clients of your own"
        )
    yield from config.mission.problems(agents)
    yield from _own_controller_problems(config)
    yield from _separation_problems(config)


def reference_problems(config: Config) -> Iterator[str]:
    """Yield why the references of a configuration without other problems can't be flown."""
    separation = config.separation
    limits = FlightLimits(
        duration_s=config.mission.duration_s,
        apart_m=separation.radius_m,
        downwash=separation.downwash,
        ground_z_m=config.sitl.ground_z_m if config.sitl.enabled else None,
        volume=config.volume.flight_volume(),
    )
    try:
        references = config.mission.references(np.array(config.starts_ned_m()), separation.budget.planned_m)
    except OwnError as error:
        yield f"mission.kind = {config.mission.kind!r}: {error}"
        return
    yield from infeasible(references, [config.model_of(i) for i in range(len(references))], limits)


def _start_problems(config: Config) -> Iterator[str]:
    agents, listed = config.swarm.agents, len(config.start.positions_ned_m)
    if listed and listed < agents:
        yield f"start.positions_ned_m: {listed} positions for swarm.agents = {agents}; list one for each agent"
    if not listed and not any(config.start.direction_ned):
        yield "start.direction_ned = (0, 0, 0): give the line of start positions a direction"
    elif not (listed and listed < agents):
        yield from _starts_apart(config)
        yield from config.geofence.problems(config.starts_ned_m())
        yield from _volume_problems(config)
        try:
            config.simulator()
        except ConfigError as error:
            yield from (f"sitl.{problem}" for problem in error.problems)


def _own_controller_problems(config: Config) -> Iterator[str]:
    if config.controller.is_own and not config.agent.barrier.enabled:
        yield "agent.barrier.enabled = false: an own controller flies behind the safety filter only; set it to true"
    if config.controller.is_own and config.separation.mode == "guaranteed":
        yield (
            f"controller.kind = {config.controller.kind!r} with separation.mode = 'guaranteed': commitments are tracked"
            " by built-in controllers; set separation.mode = 'best_effort'"
        )


def _separation_problems(config: Config) -> Iterator[str]:
    if config.swarm.agents > 1 and (problem := radius_problem(config.separation, 0.0, config.drift_m)):
        yield problem
    if config.separation.gust_m_s and not config.vehicle_model.drag_1_s:
        yield (
            f"separation.gust_m_s = {config.separation.gust_m_s:g}: what a gust does to a vehicle follows from its "
            "drag; set vehicle_model.drag_1_s (swarmctl check --identify measures it)"
        )
    if config.separation.radius_m < config.limits.min_separation_m:
        yield (
            f"limits.min_separation_m = {config.limits.min_separation_m}: larger than separation.radius_m = "
            f"{config.separation.radius_m}; agents would be judged by more than they keep. Lower it or raise the radius"
        )


def _volume_problems(config: Config) -> Iterator[str]:
    """Yield what does not go with the flight volume."""
    corners, fence = config.volume.corners_ne_m, config.geofence.corners_ne_m
    yield from config.volume.problems(config.starts_ned_m(), config.separation.tracking_m + config.drift_m)
    if corners and not (config.controller.keeps_volume or config.separation.mode == "guaranteed"):
        yield (
            f"controller.kind = {config.controller.kind!r} with a volume: it does not plan, and would fly out of it; "
            "use dmpc, dmpc3 or mpc"
        )
    beyond = [list(corner) for corner in corners if fence and not is_inside(corner, fence)]
    if beyond:
        yield f"volume.corners_ne_m: {beyond} are outside of geofence.corners_ne_m; move the corners or the fence"


def _starts_apart(config: Config) -> Iterator[str]:
    starts = config.starts_ned_m()
    pairs = ((math.dist(a, b), i, j) for (i, a), (j, b) in itertools.combinations(enumerate(starts), 2))
    close = sorted(pair for pair in pairs if pair[0] < config.separation.radius_m)
    for distance_m, i, j in close[:_PAIRS_SHOWN]:
        yield (
            f"start: agents {i} and {j} would wait {distance_m:.2f} m apart; separation.radius_m is "
            f"{config.separation.radius_m}. Raise start.spacing_m or move them"
        )
    if len(close) > _PAIRS_SHOWN:
        yield f"start: {len(close) - _PAIRS_SHOWN} more pairs of agents would wait too close together"
    if config.sitl.enabled and config.sitl.start == "ground":
        for i, start in enumerate(starts):
            if start[2] > config.sitl.ground_z_m - 0.5:
                yield (
                    f"start: agent {i} waits at z = {start[2]} m, less than 0.5 m above the ground at "
                    f"sitl.ground_z_m = {config.sitl.ground_z_m} (NED, down is positive)"
                )


def _vehicle_problems(config: Config) -> Iterator[str]:
    agents = config.swarm.agents
    if not config.vehicles:
        if not config.sitl.enabled:
            yield "vehicles: empty while sitl.enabled = false; list one [[vehicles]] with sysid and url for each agent"
        return
    if config.sitl.enabled:
        yield (
            "vehicles: listed while sitl.enabled = true; set sitl.enabled = false to fly them, "
            "or remove them to fly the built-in simulator"
        )
    if len(config.vehicles) < agents:
        yield f"vehicles: {len(config.vehicles)} listed for swarm.agents = {agents}; list one for each agent"
    seen_sysids: dict[int, int] = {}
    links: list[Endpoint | None] = []
    for i, vehicle in enumerate(config.vehicles):
        try:
            link = parse_url(vehicle.url)
        except ValueError as error:
            yield f"vehicles.{i}.url = {error}"
            link = None
        rivals = [k for k, other in enumerate(links) if link and other and _same_place(link, other)]
        links.append(link)
        if rivals:
            yield (
                f"vehicles.{i}.url = {vehicle.url!r}: same port as vehicles.{rivals[0]}; "
                "every vehicle needs a link of its own"
            )
        if vehicle.sysid in seen_sysids:
            yield (
                f"vehicles.{i}.sysid = {vehicle.sysid}: same as vehicles.{seen_sysids[vehicle.sysid]}; "
                "give every autopilot its own MAV_SYS_ID"
            )
        seen_sysids.setdefault(vehicle.sysid, i)


def _forward_problems(config: Config) -> Iterator[str]:
    for i, url in enumerate(config.mavlink.forward):
        try:
            if parse_url(url).scheme != "udpout":
                raise ValueError(f"{url!r}: only udpout://HOST:PORT is forwarded to")
        except ValueError as error:
            yield f"mavlink.forward.{i} = {error}"


def _simulated_host_problems(config: Config) -> Iterator[str]:
    for i, host in enumerate(config.hosts if config.sitl.enabled else ()):
        if list(host.agents) != list(range(host.agents[0], host.agents[0] + len(host.agents))):
            yield (
                f"hosts.{i}.agents = {list(host.agents)}: a host simulates vehicles that follow one another; "
                "list numbers without gaps"
            )


def _same_place(a: Endpoint, b: Endpoint) -> bool:
    """Return whether two links share a serial device, a local port or a remote address."""
    if a.scheme != b.scheme:
        return False
    if a.scheme == "serial":
        return a.where == b.where
    if a.scheme == "udpin" and "0.0.0.0" in (a.where, b.where):
        return a.number == b.number
    return (a.where, a.number) == (b.where, b.number)
