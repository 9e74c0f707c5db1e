"""What is doubtful about a valid configuration, in words: it is flown, and may not be what was meant."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from swarmctl.config import Config
from swarmctl.configuration.constraints import is_tick
from swarmctl.control.collision.budget import SeparationBudget
from swarmctl.control.phases.trajectories import way_home
from swarmctl.control.reference.kinds.csv_table import CsvParams
from swarmctl.control.reference.mission import MissionReference
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.goal import REACHED_M
from swarmctl.core.text import point_text
from swarmctl.core.types import Array
from swarmctl.mavlink.geofence import Geofence
from swarmctl.telemetry.evaluation.referee import Rules

_BEGINS_M = 0.5  # a reference that begins nearer to where its agent waits is as good as there
_SHOWN = 3
_SAMPLES = 2000  # of a mission
_BEHIND_M = 0.5  # by acceleration that is lacking: short peaks cost less
_SAME_M = 1e-6  # distances that differ by less are the same but for rounding
_STEEP_RAD = 0.75  # a real PX4 has yawed at 44 degrees, and had no thrust left at 55
_FALLS_HARDER = 1.25  # times what a vehicle falls by: 0.3 m of a plan of 0.8 s are not worth a word, 0.6 m are
_ZERO = np.zeros(1)
_HOMEWARD, _ON_THE_WAY = 120, 60  # times of a mission from which, and places at which, straight ways home are looked at
_FINE_S = 0.06  # between two points of plans among which swaps of four and six keep their distance


def config_warnings(config: Config) -> list[str]:
    """Return what is doubtful about a configuration that can be flown."""
    unused = config.mission.unused_sections()
    kind = config.mission.kind
    found = [f"mission.{name} is set, mission.kind is {kind!r}: it is not flown" for name in unused]
    references = config.mission.references(np.array(config.starts_ned_m()), config.separation.budget.planned_m)
    flown = [text for about in _ABOUT_REFERENCES for text in about(config, references)]
    judged = (*_judged_by_more_than_is_kept(config), *_stand_above_each_other(config))
    vehicles = (*_turned_by_steep_tilt(config), *_planned_to_fall(config), *_planned_too_coarsely(config))
    return [*found, *flown, *judged, *vehicles, *_counts_by_other_ticks(config)]


def warning_lines(config: Config) -> list[str]:
    """Return the same as lines to print."""
    return _as_lines(config_warnings(config))


def launch_warning_lines(config: Config) -> list[str]:
    """Return the lines to print before a launch, which has no links in lockstep."""
    return _as_lines([*config_warnings(config), *unplayed(config)])


def _as_lines(texts: Iterable[str]) -> list[str]:
    return [f"warning: {text}" for text in texts]


def unplayed(config: Config) -> Iterator[str]:
    """Yield what a launch does not do to its links, since only flights in lockstep play it."""
    played = {f"bus.{name}": getattr(config.bus, name) for name in ("delay_ms", "loss_01", "burst_01", "jitter_ms")}
    played["sitl.link_latency_ms"] = config.sitl.link_latency_ms
    if asked := [f"{key} = {value:g}" for key, value in played.items() if value]:
        yield f"{', '.join(asked)}: of lockstep only (`swarmctl simulate`); a launch flies with its links as they are"


def _begin_elsewhere(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield whose own reference begins away from where the agent waits, so that it has to catch up with it.

    References that agents share begin where they like.
    """
    found = []
    for agent, (reference, start) in enumerate(zip(references, np.array(config.starts_ned_m()), strict=True)):
        begin = reference.sample(_ZERO)[0][0]
        away_m = float(np.linalg.norm(begin - start))
        if reference.fixed_in_time and not reference.jumps and away_m > _BEGINS_M:
            places = f"{point_text(begin.round(2))}, start {point_text(start.round(2))}"
            found.append(f"agent {agent}: the reference begins {away_m:.2f} m from its start (at {places})")
    added = config.mission.kind == "csv" and config.mission.section(CsvParams).from_start
    hint = "; mission.csv.from_start adds positions to the start: begin at 0, 0, 0" if added else ""
    yield from _first([f"{text}{hint}" for text in found], "references begin away from the agents' starts")


def _cut_short(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield which references end, away from where they are then, after the mission: the rest is not flown."""
    found, duration_s = [], config.mission.duration_s
    for agent, reference in enumerate(references):
        ends_s = duration_s if reference.ends_s is None else reference.ends_s
        now, end = reference.sample(np.array([duration_s, ends_s]))[0]
        left_m = float(np.linalg.norm(end - now))
        if ends_s > duration_s and left_m > REACHED_M:
            left = f"{left_m:.1f} m from where it ends, after {ends_s:.1f} s"
            found.append(f"mission.duration_s = {duration_s:g}: the reference of agent {agent} is then {left}")
    yield from _first(found, "references are cut short")


def _same_goals(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield which agents are meant to arrive nearer to each other than plans keep, so that not all of them can."""
    found, apart_m = [], config.separation.radius_m
    goals = [(agent, reference.goal) for agent, reference in enumerate(references)]
    for (i, a), (j, b) in itertools.combinations(goals, 2):
        if a is None or b is None:
            continue
        away = a.pos_ned_m - b.pos_ned_m
        away_m = float(np.linalg.norm(away / [1.0, 1.0, config.separation.downwash]))
        if away_m < apart_m - _SAME_M:
            found.append(f"the goals of agents {i} and {j} are {away_m:.2f} m apart; separation.radius_m = {apart_m:g}")
    yield from _first([f"{text}: not both arrive" for text in found], "pairs of goals are as near")


def _crosses_notches(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield whose start and mission are in the fence, but not all that is between them, where it is dented."""
    found, fence = [], config.geofence.area()
    if fence is None:
        return
    t_s = np.linspace(0.0, config.mission.duration_s, _HOMEWARD)
    for agent, (reference, start) in enumerate(zip(references, np.array(config.starts_ned_m()), strict=True)):
        beyond_m = _beyond_on_way_m(fence, reference.sample(t_s)[0], start)
        if beyond_m.max() > _SAME_M:
            way = f"agent {agent}: from {t_s[np.argmax(beyond_m > _SAME_M)]:.0f} s on, its straight way home"
            leads = f"(after the mission, by rtl, by a low battery) leads up to {beyond_m.max():.1f} m outside"
            found.append(f"{way} {leads} of geofence.corners_ne_m; move the start, the mission, or the corners")
    yield from _first(found, "straight ways home lead out of the fence")


def _beyond_on_way_m(fence: Geofence, pos_ned_m: Array, home_ned_m: Array) -> Array:
    """Return how far (K,) outside of a fence the straight ways from places (K, 3) to one (3,) lead at most."""
    parts_01 = np.linspace(0.0, 1.0, _ON_THE_WAY)[:, None, None]
    ways_ned_m = home_ned_m + parts_01 * (pos_ned_m - home_ned_m)
    beyond_m = fence.beyond_m(ways_ned_m[..., :2].reshape(-1, 2))
    return np.asarray(beyond_m.reshape(_ON_THE_WAY, len(pos_ned_m)).max(axis=0))


def _swings_out(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield whose way home leaves the fence: a mission that ends fast carries a vehicle beyond its end.

    Where even a straight one does, that is told of elsewhere.
    """
    found, fence, params = [], config.geofence.area(), config.agent.state_machine
    if fence is None:
        return
    for agent, (reference, start) in enumerate(zip(references, np.array(config.starts_ned_m()), strict=True)):
        pos, vel = reference.sample(np.array([config.mission.duration_s]))
        if _beyond_on_way_m(fence, pos, start).max() > _SAME_M:
            continue
        brake_m_s2 = min(config.separation.brake_m_s2, config.controller.mpc.accel_max_m_s2(config.model_of(agent)))
        limits = {"speed_m_s": params.speed_m_s, "accel_m_s2": params.accel_m_s2, "brake_m_s2": brake_m_s2}
        way = way_home(pos[0], vel[0], start, **limits)
        beyond_m = float(fence.beyond_m(way.sample(np.linspace(0.0, way.travel_s, _SAMPLES))[0][:, :2]).max())
        if beyond_m > _SAME_M:
            leads = f"agent {agent}: after the mission, at {np.linalg.norm(vel[0]):.1f} m/s, its way home leads"
            found.append(
                f"{leads} {beyond_m:.1f} m outside of geofence.corners_ne_m; end it slower, or move the corners"
            )
    yield from _first(found, "ways home lead out of the fence")


def _left_behind(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield whose reference accelerates for longer than the controller may tilt for, although the vehicle could."""
    if not config.controller.plans and config.separation.mode != "guaranteed":
        return  # `u_max` bounds nothing that is flown
    mpc, t_s = config.controller.mpc, np.linspace(0.0, config.mission.duration_s, _SAMPLES)[:-1]  # then it may end
    for agent, reference in enumerate(references):
        model = config.model_of(agent)
        if reference.jumps or mpc.u_max >= model.u_max():
            continue
        motion, has_m_s2 = reference.motion(t_s), mpc.accel_max_m_s2(model)
        needed_m_s2 = np.abs(motion.accel_ned_m_s2 + model.drag_1_s * motion.vel_ned_m_s)[:, :2]
        if max(_falls_behind_m(t_s[1], axis - has_m_s2) for axis in needed_m_s2.T) > _BEHIND_M:
            asks = f"agent {agent}: the reference asks for up to {needed_m_s2.max():.2f} m/s2 along an axis"
            gives = f"controller.mpc.u_max = {mpc.u_max:g} gives {has_m_s2:.2f}: the vehicle is left behind"
            yield f"{asks}, {gives}. Raise it, or make the mission slower or larger"
            return


def _falls_behind_m(step_s: float, lacking_m_s2: Array) -> float:
    """Return how far a vehicle falls behind, at most, in one stretch of time in which it lacks acceleration (K,)."""
    speed_m_s, behind_m, most_m = 0.0, 0.0, 0.0
    for lacking in lacking_m_s2.tolist():
        speed_m_s = speed_m_s + lacking * step_s if lacking > 0.0 else 0.0
        behind_m = behind_m + speed_m_s * step_s if lacking > 0.0 else 0.0
        most_m = max(most_m, behind_m)
    return most_m


def _first(found: Sequence[str], others: str) -> Iterator[str]:
    """Yield the first few of the texts found, and how many more there are, in words."""
    yield from found[:_SHOWN]
    if len(found) > _SHOWN:
        yield f"{len(found) - _SHOWN} more {others}"


def _judged_by_more_than_is_kept(config: Config) -> Iterator[str]:
    """Yield that commitments keep less from vehicles, or from obstacles, than the flight is judged by."""
    if config.separation.mode != "guaranteed":
        yield from _first(list(_certified_inside(config)), "obstacles are certified to be flown into")
        return
    budget, limit_m = config.separation.budget, config.limits.min_separation_m
    if config.swarm.agents > 1 and budget.committed_m < limit_m - _SAME_M:
        keeps = f"separation.radius_m = {budget.radius_m:g}: commitments keep {budget.committed_m:.2f} m"
        fails = f"the flight fails below limits.min_separation_m = {limit_m:g}"
        enough_m = math.ceil(100.0 * budget.radius_that_commits_m(limit_m) - 1e-6) / 100.0
        yield f"{keeps}, and {fails}; {enough_m:.2f} m keeps that"
    yield from _first(list(_obstacles_judged_by_more(config.rules(), budget)), "obstacles are judged by more")


def _certified_inside(config: Config) -> Iterator[str]:
    """Yield the obstacles whose keep-outs, less the slack of certificates, begin inside of them."""
    slack_m, budget = config.separation.certify_slack_m, config.separation.budget
    for number, obstacle in enumerate(config.obstacles):
        kept_m = budget.certified_obstacle_m(obstacle.keep_out_m)
        if kept_m < obstacle.radius_m - _SAME_M:
            keeps = f"obstacles.{number}.keep_out_m = {obstacle.keep_out_m:g}: plans down to {kept_m:.2f} m are flown"
            inside = f"which is inside of it (radius_m = {obstacle.radius_m:g})"
            yield f"{keeps}, {inside}; {obstacle.radius_m + slack_m:g} m keeps them out"


def _obstacles_judged_by_more(rules: Rules, budget: SeparationBudget) -> Iterator[str]:
    """Yield the obstacles from which commitments keep less than the flight is judged by."""
    for judged in rules.obstacles:
        obstacle, required_m = judged.obstacle, judged.required_m(rules.obstacle_margin_m)
        kept_m = budget.certified_obstacle_m(obstacle.keep_out_m)
        if kept_m < required_m - _SAME_M:
            keeps = f"obstacles.{judged.number}.keep_out_m = {obstacle.keep_out_m:g}: commitments keep {kept_m:.2f} m"
            by_that = f"limits.obstacle_margin_m = {budget.certify_slack_m:g} judges by that"
            enough = f"{obstacle.radius_m + budget.certify_slack_m:g} m keeps that"
            fix = by_that if kept_m >= obstacle.radius_m - _SAME_M else enough
            yield f"{keeps}, and the flight fails below {required_m:.2f} m; {fix}"


def _stand_above_each_other(config: Config) -> Iterator[str]:
    """Yield which starts are apart by their heights alone, of vehicles that stand on the ground before and after."""
    if config.sitl.enabled and config.sitl.start == "air":
        return
    limit_m, found = config.limits.min_separation_m, []
    for (i, a), (j, b) in itertools.combinations(enumerate(config.starts_ned_m()), 2):
        level_m = math.dist(a[:2], b[:2])
        if level_m < limit_m - _SAME_M:
            near = f"agents {i} and {j} start {level_m:.2f} m apart in the plane, and stand as near on the ground"
            found.append(f"{near}: the flight fails below limits.min_separation_m = {limit_m:g}")
    yield from _first(found, "pairs of agents stand as near")


def _seen_too_late(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield which obstacles on the way are seen too late for a stop before their keep-outs begin.

    With guaranteed separation, that is later than the agent commits to fly there: it leaves a commitment only as far as
    those of its peers allow.
    """
    t_s = np.append(np.zeros(_ON_THE_WAY), np.linspace(0.0, config.mission.duration_s, _SAMPLES))
    flown = [_flown_to_and_on(config, *one, t_s[_ON_THE_WAY:]) for one in enumerate(references) if config.obstacles]
    commits = config.separation.mode == "guaranteed"
    for number, obstacle in enumerate(config.obstacles):
        room_m, center_ned_m = obstacle.visibility_m - obstacle.keep_out_m, obstacle.center_after(t_s[:, None])
        for agent, (pos_ned_m, vel_ned_m_s) in enumerate(flown):
            sees = np.linalg.norm((pos_ned_m - center_ned_m)[:, : obstacle.axes], axis=1) < obstacle.visibility_m
            towards_m_s = sees * np.linalg.norm(vel_ned_m_s - np.array(obstacle.vel_ned_m_s), axis=1)
            speed_m_s = float(towards_m_s.max())
            stop_m = speed_m_s**2 / (2.0 * config.controller.mpc.accel_max_m_s2(config.model_of(agent)))
            ahead_m = config.agent.commit.stretch_m(speed_m_s) if commits else stop_m
            if ahead_m > room_m:
                seen = f"obstacles.{number}: agent {agent} sees it {room_m:.2f} m before its keep-out"
                stops = (
                    f"by when it has committed to {ahead_m:.2f} m"
                    if commits
                    else f"from which it stops in {stop_m:.2f} m"
                )
                joins = towards_m_s.argmax() < _ON_THE_WAY
                speed = f"{speed_m_s:.1f} m/s{' as it catches up with its reference' if joins else ''}"
                yield f"{seen}, at {speed}, {stops}; raise visibility_m{', or start nearer' if joins else ''}"
                break


def _flown_to_and_on(config: Config, agent: int, reference: MissionReference, t_s: Array) -> tuple[Array, Array]:
    """Return positions and velocities (K, 3) on an agent's straight way to where its reference begins, then on that.

    To one that begins away from it, an agent accelerates for half of the way, and brakes for the other half.
    """
    start, model = np.array(config.starts_ned_m()[agent]), config.model_of(agent)
    pos, vel = reference.sample(t_s)
    way = pos[0] - start
    away_m, done_01 = float(np.linalg.norm(way)), np.linspace(0.0, 1.0, _ON_THE_WAY)
    if away_m < _BEGINS_M:
        return np.vstack([np.tile(start, (_ON_THE_WAY, 1)), pos]), np.vstack([np.zeros((_ON_THE_WAY, 3)), vel])
    nearer_m = away_m * np.minimum(done_01, 1.0 - done_01)
    speed_m_s = np.sqrt(2.0 * config.controller.mpc.accel_max_m_s2(model) * nearer_m)
    joining = np.minimum(speed_m_s, model.speed_max_m_s)[:, None] * way / away_m
    return np.vstack([start + done_01[:, None] * way, pos]), np.vstack([joining, vel])


def _kept_apart_by_nobody(config: Config, references: Sequence[MissionReference]) -> Iterator[str]:
    """Yield whose references meet others, or obstacles, under a controller that keeps clear of neither."""
    if config.controller.keeps_clear or config.separation.mode == "guaranteed":
        return
    t_s, limit_m, found = np.linspace(0.0, config.mission.duration_s, _SAMPLES), config.limits.min_separation_m, []
    flown = [reference.sample(t_s)[0] for reference in references]
    for (i, a), (j, b) in itertools.combinations(enumerate(flown), 2):
        near_m = float(np.linalg.norm(a - b, axis=1).min())
        if near_m < limit_m - _SAME_M:
            fails = f"the flight fails below limits.min_separation_m = {limit_m:g}"
            found.append(f"the references of agents {i} and {j} come to {near_m:.2f} m, and {fails}")
    for number, obstacle in enumerate(config.obstacles):
        center_ned_m = obstacle.center_after(t_s[:, None])
        for agent, pos_ned_m in enumerate(flown):
            away_m = np.linalg.norm((pos_ned_m - center_ned_m)[:, : obstacle.axes], axis=1)
            if away_m.min() < obstacle.keep_out_m - config.limits.obstacle_margin_m - _SAME_M:
                found.append(f"the reference of agent {agent} leads into the keep_out_m of obstacles.{number}")
    keeps = f"controller.kind = {config.controller.kind!r} keeps clear of nothing but a touch"
    fix = "fly 'dmpc', separation.mode = 'guaranteed', or elsewhere"
    yield from _first([f"{keeps}: {text}; {fix}" for text in found], "references meet others or obstacles")


_ABOUT_REFERENCES = (
    _begin_elsewhere,
    _cut_short,
    _same_goals,
    _crosses_notches,
    _swings_out,
    _left_behind,
    _seen_too_late,
    _kept_apart_by_nobody,
)


def _turned_by_steep_tilt(config: Config) -> Iterator[str]:
    """Yield that real vehicles may fly as steep as none of them can keep the yaw of Euler angles."""
    model = config.vehicle_model
    if config.vehicles and model.heading == "euler" and model.tilt_max_rad > _STEEP_RAD:
        steep = f"vehicle_model.heading = 'euler' with tilt_max_rad = {model.tilt_max_rad:g}"
        yield f"{steep}: a tilt that goes round costs real vehicles yaw, then thrust; set it to 'swing_twist'"


def _planned_to_fall(config: Config) -> Iterator[str]:
    """Yield that plans fall harder than a vehicle whose motors keep turning, which is above where it is expected then.

    A negative bound, as the thesis', counts as none: no rotor pulls.
    """
    key, planned_m_s2 = "controller.mpc.thrust_min_m_s2", config.controller.mpc.thrust_min_m_s2
    least_m_s2, least_01 = max((model.thrust_range_m_s2()[0], model.thrust_min_01) for model in config.vehicle_models)
    falls_m_s2, has_m_s2 = GRAVITY_M_S2 - max(0.0, planned_m_s2), GRAVITY_M_S2 - least_m_s2
    if config.controller.plans and falls_m_s2 > _FALLS_HARDER * has_m_s2:
        falls = f"{key} = {planned_m_s2:g}: plans fall by up to {falls_m_s2:.2f} m/s2"
        has = f"vehicle_model.thrust_min_01 = {least_01:g} leaves {has_m_s2:.2f}"
        yield f"{falls}, {has}: the vehicle is above what it has told others. Raise it to {least_m_s2:.2f}"


def _planned_too_coarsely(config: Config) -> Iterator[str]:
    """Yield that the tilt of plans changes so seldom that several agents take turns in refusing each other's plans.

    Commitments are planned by `agent.commit.dt_s`.
    """
    dt_s = config.controller.mpc.dt_s
    several = config.swarm.agents > 1 and config.separation.mode != "guaranteed"
    if several and config.controller.plans and dt_s > _FINE_S + _SAME_M:
        coarse = f"controller.mpc.dt_s = {dt_s:g}: agents that meet others do not keep their distance"
        flown = f"by 0.08 s four that swap places have come to 0.32 m, by {_FINE_S:g} s to 0.88 m"
        yield f"{coarse}; {flown}. Lower it, and raise the horizons instead"


def _counts_by_other_ticks(config: Config) -> Iterator[str]:
    """Yield that an own controller, asked once a tick, would take its plan's step for the time between two ticks."""
    dt_s, tick_s = config.controller.mpc.dt_s, 1.0 / config.agent.rate_hz
    if config.controller.is_own and not is_tick(dt_s, config.agent.rate_hz):
        asked = f"agent.rate_hz = {config.agent.rate_hz:g}: {config.controller.kind} is asked every {tick_s:.4g} s"
        yield f"{asked}, and its dt_s is controller.mpc.dt_s = {dt_s:g}: integrals and differences by that are off"
