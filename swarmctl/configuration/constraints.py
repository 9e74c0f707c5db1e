"""Constraints between sections of a configuration: what is wrong with keys that are each right by themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from swarmctl.agent.setup import AgentParams
from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.bus.network.hosts import HostParams
from swarmctl.configuration.sections import LimitParams, SitlParams, StartParams, SwarmParams, VehicleParams
from swarmctl.control.collision.barrier import BarrierParams
from swarmctl.control.collision.separation import SeparationParams, radius_problem
from swarmctl.control.commit.commit_params import CommitParams, planning
from swarmctl.control.controllers.discovery import ControllerParams
from swarmctl.control.controllers.pid import PID, PidParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.reference.deadlock_params import DeadlockParams
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import FARTHEST_M
from swarmctl.mavlink.geofence import GeofenceParams
from swarmctl.mavlink.transport import Endpoint, parse_url

_PAIRS_SHOWN = 3
_ANY_URL = "udpin://127.0.0.1:1"  # in place of one that is missing or no text, which is said elsewhere
_SAME_TICK = 1e-3  # share by which two times between ticks may differ
_TINY_M = 1e-9
_HEARTBEATS = 4  # within the time after which a peer counts as silent: three may be missed in succession
_LEAST_FAR_COMMITTED_HZ = 2.0  # a round trip, one message of it lost, lasts less than a lease
_LEAST_FAR_HZ = 0.5  # two seconds, in which two vehicles may have come ten metres closer


def own_controller_problems(
    controller: ControllerParams, separation: SeparationParams, barrier: BarrierParams
) -> Iterator[str]:
    """Yield why an own controller is not flown."""
    if controller.is_own and not barrier.enabled:
        yield "agent.barrier.enabled = false: an own controller flies behind the safety filter only; set it to true"
    if controller.is_own and separation.mode == "guaranteed":
        yield (
            f"controller.kind = {controller.kind!r} with separation.mode = 'guaranteed': commitments are tracked"
            " by built-in controllers; set separation.mode = 'best_effort'"
        )


def is_tick(dt_s: float, rate_hz: float) -> bool:
    """Return whether a time is that between two ticks of an agent."""
    return abs(dt_s * rate_hz - 1.0) <= _SAME_TICK


def tick_problems(controller: ControllerParams, rate_hz: float) -> Iterator[str]:
    """Yield that the PID would take ticks to be longer or shorter than they are."""
    dt_s, tick_s = controller.section(PidParams).dt_s, 1.0 / rate_hz
    if controller.kind == PID.name and not is_tick(dt_s, rate_hz):
        ticks = f"ticks are {tick_s:.4g} s apart by agent.rate_hz = {rate_hz:g}"
        factor = f"a factor of {max(dt_s / tick_s, tick_s / dt_s):.2g}"
        off = f"its derivative and its integral would be off by {factor}; set it to {tick_s:.6g}"
        yield f"controller.pid.dt_s = {dt_s:g}: {ticks}: {off}"


def horizon_problems(controller: ControllerParams, commit: CommitParams, separation: SeparationParams) -> Iterator[str]:
    """Yield of which plans inputs would be chosen beyond their end, where nothing comes of them."""
    mpc, lengths = controller.mpc, list[tuple[str, int, str, int]]()
    if controller.plans:
        lengths += [
            ("controller.mpc.control_z", mpc.control_z, "controller.mpc.horizon_z", mpc.horizon_z),
            ("controller.mpc.control_xy", mpc.control_xy, "controller.mpc.horizon_xy", mpc.horizon_xy),
        ]
    if separation.mode == "guaranteed":
        lengths.append(("agent.commit.moves", commit.moves, "agent.commit.horizon", commit.horizon))
    for key, changes, horizon_key, steps in lengths:
        if changes > steps:
            yield (
                f"{key} = {changes}: more than the {steps} steps of a plan, {horizon_key}, after which inputs change"
                " nothing; lower it to that, or raise the horizon"
            )


def path_sharing_problems(sharing: PathSharingParams, separation: SeparationParams) -> Iterator[str]:
    """Yield which paths peers would hear too seldom, or which only peers within reach would hear all of."""
    longest_s = separation.lost_after_s / _HEARTBEATS
    if sharing.error_m and sharing.heartbeat_s > longest_s:
        yield (
            f"agent.path_sharing.heartbeat_s = {sharing.heartbeat_s:g}: largest allowed: {longest_s:g}, a quarter of "
            "separation.lost_after_s; with longer ones a few lost messages make a peer count as silent"
        )
    if 0.0 < sharing.far_hz < _LEAST_FAR_HZ:
        yield (
            f"agent.path_sharing.far_hz = {sharing.far_hz:g}: allowed: 0, or {_LEAST_FAR_HZ:g} to 25; who is heard "
            "less often comes within reach by silence"
        )
    elif 0.0 < sharing.far_hz < _LEAST_FAR_COMMITTED_HZ and separation.mode == "guaranteed":
        yield (
            f"agent.path_sharing.far_hz = {sharing.far_hz:g} with separation.mode = 'guaranteed': allowed: 0, or "
            f"{_LEAST_FAR_COMMITTED_HZ:g} to 25; who is heard less often has to acknowledge everything"
        )


def separation_problems(
    separation: SeparationParams, model: VehicleModelParams, limits: LimitParams, agents: int, drift_m: float
) -> Iterator[str]:
    """Yield which distances do not suffice, or can't be known."""
    if agents > 1 and (problem := radius_problem(separation, 0.0, drift_m)):
        yield problem
    hard_min_m, touch_m = separation.budget.hard_min_distance_m, separation.body_m
    if agents > 1 and hard_min_m < touch_m - _TINY_M and not separation.allow_small_radius:
        yield (
            f"separation.certify_slack_m = {separation.certify_slack_m:g}: plans down to {hard_min_m:.2f} m are flown "
            f"with separation.radius_m = {separation.radius_m:g}; bodies touch at separation.body_m = {touch_m:g}. "
            "Lower it, raise the radius, or set separation.allow_small_radius = true"
        )
    if separation.gust_m_s and not model.drag_1_s:
        yield (
            f"separation.gust_m_s = {separation.gust_m_s:g}: what a gust does to a vehicle follows from its "
            "drag; set vehicle_model.drag_1_s (swarmctl check --identify measures it)"
        )
    if separation.radius_m < limits.min_separation_m:
        yield (
            f"limits.min_separation_m = {limits.min_separation_m}: larger than separation.radius_m = "
            f"{separation.radius_m}; agents would be judged by more than they keep. Lower it or raise the radius"
        )


def speed_problems(
    models: Sequence[VehicleModelParams], state_machine: StateMachineParams, deadlock: DeadlockParams
) -> Iterator[str]:
    """Yield which speeds on ways of the agents' own are more than a vehicle may fly."""
    most_m_s = min(model.speed_max_m_s for model in models)
    speeds_m_s = {
        "agent.state_machine.speed_m_s": state_machine.speed_m_s,
        "agent.deadlock.speed_m_s": deadlock.speed_m_s,
    }
    for key, speed_m_s in speeds_m_s.items():
        if speed_m_s > most_m_s:
            yield f"{key} = {speed_m_s:g}: more than vehicle_model.speed_max_m_s = {most_m_s:g}; lower it to that"


def braking_problems(
    models: Sequence[VehicleModelParams], agent: AgentParams, separation: SeparationParams
) -> Iterator[str]:
    """Yield which braking is relied on that a vehicle does not have at the tilt it is allowed."""
    most_m_s2 = _tilted_m_s2(models)
    brakes_m_s2 = {
        "agent.barrier.brake_m_s2": agent.barrier.brake_m_s2,
        "agent.commit.brake_m_s2": agent.commit.brake_m_s2,
        "agent.state_machine.accel_m_s2": agent.state_machine.accel_m_s2,
        "separation.brake_m_s2": separation.brake_m_s2,
    }
    for key, brake_m_s2 in brakes_m_s2.items():
        if brake_m_s2 > most_m_s2:
            yield (
                f"{key} = {brake_m_s2:g}: more than the {most_m_s2:.2f} m/s2 that vehicle_model.tilt_max_rad allows; "
                "lower it, or allow more tilt"
            )


def planned_braking_problems(
    models: Sequence[VehicleModelParams],
    agent: AgentParams,
    separation: SeparationParams,
    controller: ControllerParams,
    volume: VolumeParams,
) -> Iterator[str]:
    """Yield which braking is relied on that plans do not have: they use less tilt, and less thrust, than vehicles.

    Own controllers are bound by the vehicle alone, and so is the PID.
    """
    mpc, limits = controller.mpc, f"controller.mpc.u_max = {controller.mpc.u_max:g} and thrust allow"
    most_m_s2 = min(mpc.accel_max_m_s2(model) for model in models)
    vertical_m_s2, left = _beside_weight(models, controller)
    if separation.mode == "guaranteed":
        committed_m_s2 = min(planning(mpc, agent.commit, model).accel_max_m_s2(model) for model in models)
        share = f"agent.commit.tilt_fraction_01 = {agent.commit.tilt_fraction_01:g} of {limits}"
        yield from _beyond("agent.commit.brake_m_s2", agent.commit.brake_m_s2, committed_m_s2, share)
    if controller.plans or not (controller.is_own or controller.follows_reference):
        yield from _beyond("agent.state_machine.accel_m_s2", agent.state_machine.accel_m_s2, most_m_s2, limits)
        yield from _beyond("agent.state_machine.accel_m_s2", agent.state_machine.accel_m_s2, vertical_m_s2, left)
    if controller.plans:
        yield from _beyond("separation.stop_m_s2", separation.stop_m_s2, most_m_s2, limits)
    if not volume.corners_ne_m:
        return
    if controller.is_own:
        most_m_s2 = _tilted_m_s2(models)
        limits = "vehicle_model.tilt_max_rad allows"
    yield from _beyond("volume.brake_m_s2", volume.brake_m_s2, most_m_s2, limits)
    yield from _beyond("volume.brake_z_m_s2", volume.brake_z_m_s2, vertical_m_s2, left)


def _beside_weight(models: Sequence[VehicleModelParams], controller: ControllerParams) -> tuple[float, str]:
    """Return the least vertical acceleration, up or down, that thrust has in level flight, and by which bounds."""
    mpc, ranges_m_s2 = controller.mpc, [model.thrust_range_m_s2() for model in models]
    ranges_m_s2 += [] if controller.is_own else [(mpc.thrust_min_m_s2, mpc.thrust_max_m_s2)]
    rises_m_s2 = min(most for _, most in ranges_m_s2) - GRAVITY_M_S2
    falls_m_s2 = GRAVITY_M_S2 - max(least for least, _ in ranges_m_s2)
    return min(rises_m_s2, falls_m_s2), "thrust (vehicle_model, controller.mpc) leaves beside the weight"


def _tilted_m_s2(models: Sequence[VehicleModelParams]) -> float:
    """Return the largest horizontal acceleration of level flight that the tilt of every model allows."""
    return GRAVITY_M_S2 * math.tan(min(model.tilt_max_rad for model in models))


def _beyond(key: str, brake_m_s2: float, most_m_s2: float, bounds: str) -> Iterator[str]:
    if brake_m_s2 > most_m_s2:
        yield f"{key} = {brake_m_s2:g}: more than the {most_m_s2:.2f} m/s2 that {bounds}; lower it, or allow more"


def volume_problems(
    volume: VolumeParams,
    geofence: GeofenceParams,
    controller: ControllerParams,
    separation: SeparationParams,
    starts_ned_m: Sequence[tuple[float, float, float]],
    drift_m: float,
) -> Iterator[str]:
    """Yield what does not go with the flight volume."""
    corners, fence = volume.corners_ne_m, geofence.area()
    yield from volume.problems(starts_ned_m, separation.tracking_m + drift_m)
    if corners and not (controller.keeps_volume or separation.mode == "guaranteed"):
        yield (
            f"controller.kind = {controller.kind!r} with a volume: it does not plan, and would fly out of it; "
            "use dmpc, dmpc3 or mpc"
        )
    beyond = [list(corner) for corner in corners if fence and not fence.contains(corner)]
    if beyond:
        yield f"volume.corners_ne_m: {beyond} are outside of geofence.corners_ne_m; move the corners or the fence"


def start_problems(start: StartParams, agents: int) -> Iterator[str]:
    """Yield why start positions are not known."""
    listed = len(start.positions_ned_m)
    if listed and listed < agents:
        yield f"start.positions_ned_m: {listed} positions for swarm.agents = {agents}; list one for each agent"
    if not listed and not any(start.direction_ned):
        yield "start.direction_ned = (0, 0, 0): give the line of start positions a direction"


def starts_apart(
    starts_ned_m: Sequence[tuple[float, float, float]], separation: SeparationParams, sitl: SitlParams
) -> Iterator[str]:
    """Yield which start positions are too close together, or in the ground."""
    pairs = ((math.dist(a, b), i, j) for (i, a), (j, b) in itertools.combinations(enumerate(starts_ned_m), 2))
    close = sorted(pair for pair in pairs if pair[0] < separation.radius_m)
    for distance_m, i, j in close[:_PAIRS_SHOWN]:
        yield (
            f"start: agents {i} and {j} would wait {distance_m:.2f} m apart; separation.radius_m is "
            f"{separation.radius_m}. Raise start.spacing_m or move them"
        )
    if len(close) > _PAIRS_SHOWN:
        yield f"start: {len(close) - _PAIRS_SHOWN} more pairs of agents would wait too close together"
    far = [i for i, start in enumerate(starts_ned_m) if max(map(abs, start)) > FARTHEST_M]
    if far:
        yield f"start: agents {far} wait more than {FARTHEST_M:g} m from the shared origin; move them or the origin"
    if sitl.enabled and sitl.start == "ground":
        for i, start in enumerate(starts_ned_m):
            if start[2] > sitl.ground_z_m - 0.5:
                yield (
                    f"start: agent {i} waits at z = {start[2]} m, less than 0.5 m above the ground at "
                    f"sitl.ground_z_m = {sitl.ground_z_m} (NED, down is positive)"
                )


def obstacle_problems(
    obstacles: Mapping[int, Obstacle],
    starts_ned_m: Sequence[Sequence[float]],
    goals_ned_m: Sequence[Sequence[float] | None],
    *,
    from_ground: bool,
) -> Iterator[str]:
    """Yield which agents would wait in an obstacle or take off through it, and whose goal is in one at rest.

    The obstacles are those by number.
    """
    for i, obstacle in obstacles.items():
        goals = () if obstacle.moves else goals_ned_m
        placed = [(f"agent {k} would wait", obstacle.distance_m(start)) for k, start in enumerate(starts_ned_m)]
        placed += [
            (f"the goal of agent {k} is", obstacle.distance_m(goal)) for k, goal in enumerate(goals) if goal is not None
        ]
        if from_ground and not obstacle.moves:
            placed += [
                (f"agent {k} would take off", obstacle.descent_distance_m(start))
                for k, start in enumerate(starts_ned_m)
                if obstacle.distance_m(start) >= obstacle.keep_out_m
            ]
        inside = [(said, away_m) for said, away_m in placed if away_m < obstacle.keep_out_m]
        middle = "axis" if obstacle.column else "centre"
        for said, away_m in inside[:_PAIRS_SHOWN]:
            distance = f"{away_m:.2f} m from its {middle}"
            yield f"obstacles.{i}: {said} {distance}; its keep_out_m is {obstacle.keep_out_m:g}. Move one of them"
        if len(inside) > _PAIRS_SHOWN:
            yield f"obstacles.{i}: {len(inside) - _PAIRS_SHOWN} more starts or goals are within its keep_out_m"


def vehicle_problems(
    vehicles: Sequence[VehicleParams], agents: int, *, simulated: bool, hosts: Sequence[HostParams]
) -> Iterator[str]:
    """Yield what is wrong with the list of vehicles to fly; each host has devices and ports of its own."""
    if not vehicles:
        if not simulated:
            yield "vehicles: empty while sitl.enabled = false; list one [[vehicles]] with sysid and url for each agent"
        return
    if simulated:
        yield (
            "vehicles: listed while sitl.enabled = true; set sitl.enabled = false to fly them, "
            "or remove them to fly the built-in simulator"
        )
    if len(vehicles) < agents:
        yield f"vehicles: {len(vehicles)} listed for swarm.agents = {agents}; list one for each agent"
    seen_sysids: dict[int, int] = {}
    host_of = {agent: host.name for host in hosts for agent in host.agents}
    links: list[Endpoint | None] = []
    for i, vehicle in enumerate(vehicles):
        try:
            link = parse_url(vehicle.url)
        except ValueError as error:
            yield f"vehicles.{i}.url = {error}"
            link = None
        beside = [(k, other) for k, other in enumerate(links) if host_of.get(k) == host_of.get(i)]
        rivals = [k for k, other in beside if link and other and _same_place(link, other)]
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


def one_place_at_two_hosts(vehicles: Sequence[VehicleParams], hosts: Sequence[HostParams]) -> tuple[int, int] | None:
    """Return two vehicles that are at one place by their links, each of another computer; None where there are none."""
    host_of = {agent: host.name for host in hosts for agent in host.agents}
    links = [(i, parse_url(vehicle.url)) for i, vehicle in enumerate(vehicles) if i in host_of]
    pairs = itertools.combinations(links, 2)
    return next(((i, k) for (i, a), (k, b) in pairs if host_of[i] != host_of[k] and _same_place(a, b)), None)


def forward_problems(urls: Sequence[str]) -> Iterator[str]:
    """Yield which ground stations can't be forwarded to."""
    for i, url in enumerate(urls):
        try:
            if parse_url(url).scheme != "udpout":
                raise ValueError(f"{url!r}: only udpout://HOST:PORT is forwarded to")
        except ValueError as error:
            yield f"mavlink.forward.{i} = {error}"


def address_problems(tree: Mapping[str, Any]) -> Iterator[str]:
    """Yield which addresses of a plain tree are none, whatever else is wrong with it."""
    vehicles, mavlink = tree.get("vehicles"), tree.get("mavlink")
    for i, vehicle in enumerate(vehicles if isinstance(vehicles, list) else ()):
        url = vehicle.get("url") if isinstance(vehicle, dict) else None
        try:
            parse_url(url if isinstance(url, str) else _ANY_URL)
        except ValueError as error:
            yield f"vehicles.{i}.url = {error}"
    urls = mavlink.get("forward") if isinstance(mavlink, dict) else None
    if isinstance(urls, list) and all(isinstance(url, str) for url in urls):
        yield from forward_problems(urls)


def shared_process_problems(swarm: SwarmParams, sitl: SitlParams) -> Iterator[str]:
    """Yield that real vehicles would share a process."""
    if swarm.agents_per_process > 1 and not sitl.enabled:
        yield (
            f"swarm.agents_per_process = {swarm.agents_per_process}: allowed: 1 without the built-in simulator; "
            "one agent's failure must not be that of other real vehicles"
        )


def simulated_speed_problems(sitl: SitlParams) -> Iterator[str]:
    """Yield that vehicles would fly by another time than agents."""
    if sitl.speed != 1.0:
        yield (
            f"sitl.speed = {sitl.speed}: agents fly on wall time and can't follow; leave it at 1. Faster than "
            "real time: swarmctl simulate, or python -m sitl --speed with clients of your own"
        )


def simulated_host_problems(hosts: Sequence[HostParams]) -> Iterator[str]:
    """Yield which hosts can't simulate the vehicles of their agents."""
    for i, host in enumerate(hosts):
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
