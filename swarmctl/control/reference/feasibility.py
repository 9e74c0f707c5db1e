"""Checks before a flight whether references can be flown: finite, within the vehicles' limits, above ground, in the
flight volume and the geofence, apart, and long enough to arrive.

Pure. A reference is sampled over the whole mission; what is refused is told with the first second at which it is wrong.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.model import VehicleModelParams
from swarmctl.control.reference.mission import MissionReference, Motion
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.frames import GRAVITY_NED_M_S2
from swarmctl.core.goal import REACHED_M
from swarmctl.core.types import Array

_STEP_S = 0.02  # time between samples
_MAX_SAMPLES = 200_000  # of all agents together; long missions of many are sampled more coarsely
_JUMP_M = 0.02  # difference of positions that velocities need not explain
LEAST_HEIGHT_M = 0.3  # least height of a reference: bodies have legs
_ESTIMATED_M = 0.25  # by which heights of the place of a take-off are wrong
_GROUND_SAMPLES = 5000  # of a mission that is checked against that place, within a part of a tick
_OUTSIDE_M = 1e-6  # of flight volume and geofence: rounding
_SHOWN = 3  # problems


class Fence(Protocol):
    """An area that vehicles stay in, of any height."""

    @property
    def span(self) -> str:
        """Return in words from where to where it reaches."""

    def beyond_m(self, at_ne_m: Array) -> Array:
        """Return how far (K,) positions north and east (K, 2) are outside of it, 0 inside."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLimits:
    """Holds what references are checked against, beside the model of each vehicle."""

    duration_s: float
    apart_m: float  # distance that references fixed in time keep
    downwash: float  # ratio of height to width of the ellipsoid that is kept free
    ground_z_m: float | None  # NED z of the ground; None where it is not known
    volume: FlightVolume | None  # that plans keep to
    fence: Fence | None = None  # that autopilots keep their vehicles in
    ground: str = "sitl.ground_z_m"  # what tells the ground's z, for who reads that a reference is below it


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rule:
    """Says where (K,) a reference breaks a rule, and in words how."""

    broken: NDArray[np.bool_]
    said: str  # with {} for the value
    values: Array  # (K,)


def infeasible(
    references: Sequence[MissionReference],
    models: Sequence[VehicleModelParams],
    limits: FlightLimits,
    most_samples: int = _MAX_SAMPLES,
) -> Iterator[str]:
    """Yield why a mission can't be flown: for each agent and each pair of agents the first second that is wrong."""
    samples = min(most_samples // len(references), max(3, round(limits.duration_s / _STEP_S) + 1))
    t_s = np.linspace(0.0, limits.duration_s, samples)
    motions = [reference.motion(t_s) for reference in references]
    found = []
    for i, (reference, motion, model) in enumerate(zip(references, motions, models, strict=True)):
        rules = _rules(t_s, reference, motion, model, limits)
        found += [f"mission: agent {i}: {first}" for first in _first(t_s, rules)]
    if not found and references and references[0].fixed_in_time:
        for (i, a), (j, b) in itertools.combinations(enumerate(motions), 2):
            found += [f"mission: agents {i} and {j}: {first}" for first in _first(t_s, [_apart(a, b, limits)])]
    yield from _cut_short(references, limits.duration_s)
    yield from found[:_SHOWN]
    if len(found) > _SHOWN:
        yield f"mission: {len(found) - _SHOWN} more agents or pairs of agents have references that can't be flown"


def below_ground(reference: MissionReference, duration_s: float, ground_z_m: float) -> str:
    """Return where a mission leads below the place of a take-off, which is known once a vehicle stands there, or "".

    A show may end on the ground, and heights are estimates.

    Args:
        reference: of one agent.
        duration_s: of the mission.
        ground_z_m: down coordinate of the place.
    """
    t_s = np.linspace(0.0, duration_s, _GROUND_SAMPLES)
    down_m = reference.sample(t_s)[0][:, 2]
    below = f"the reference is at z = {{}} m, below the place of the take-off at z = {ground_z_m:.2f}"
    said = f"{below}; give heights as NED, down is positive, or correct swarm.origin_alt_m"
    found = _first(t_s, [_Rule(broken=down_m > ground_z_m + _ESTIMATED_M, said=said, values=down_m)])
    return f"mission: {found[0]}" if found else ""


def _cut_short(references: Sequence[MissionReference], duration_s: float) -> Iterator[str]:
    """Yield that the mission ends before agents can be at their goals."""
    left_m, needed_s = [], 0.0
    for reference in references:
        if reference.goal is not None and reference.goal.needs_s > duration_s:
            end_ned_m = reference.sample(np.array([duration_s]))[0][0]
            left_m.append(float(np.linalg.norm(end_ned_m - reference.goal.pos_ned_m)))
            needed_s = max(needed_s, reference.goal.needs_s)
    if max(left_m, default=0.0) > REACHED_M:
        yield (
            f"mission.duration_s = {duration_s:g}: it ends up to {max(left_m):.1f} m short of goals that take "
            f"{needed_s:.1f} s at the mission's speed and acceleration. Give it more time, or raise speed_m_s and "
            "accel_m_s2"
        )


def _first(t_s: Array, rules: Sequence[_Rule]) -> list[str]:
    """Return the rule that is broken first, in words; empty when all are kept."""
    first = [(int(np.argmax(rule.broken)), rule) for rule in rules if rule.broken.any()]
    if not first:
        return []
    at, rule = min(first, key=lambda found: found[0])
    return [f"at {t_s[at]:.2f} s {rule.said.format(f'{rule.values[at]:.2f}')}"]


def _rules(
    t_s: Array, reference: MissionReference, motion: Motion, model: VehicleModelParams, limits: FlightLimits
) -> list[_Rule]:
    pos, vel = motion.pos_ned_m, motion.vel_ned_m_s
    all_values = np.column_stack([pos, vel, motion.accel_ned_m_s2, motion.yaw_rad])
    finite = np.isfinite(all_values).all(axis=1)
    rules = [
        _Rule(
            broken=np.logical_not(finite),
            said="the reference is {}, not a finite number",
            values=all_values.sum(axis=1),
        )
    ]
    if limits.ground_z_m is not None:
        low = pos[:, 2] > limits.ground_z_m - LEAST_HEIGHT_M
        below = f"less than {LEAST_HEIGHT_M:g} m above the ground at {limits.ground} = {limits.ground_z_m:.4g} (NED)"
        ground = f"the reference is at z = {{}} m, {below}"
        rules.append(_Rule(broken=low & finite, said=ground, values=pos[:, 2]))
    if limits.volume is not None:
        beyond = limits.volume.beyond_plans_m(pos)
        kept = f"volume.margin_m = {limits.volume.params.margin_m:g}"
        leaves = f"the reference is {{}} m outside of the flight volume less {kept}"
        rules.append(_Rule(broken=(beyond > _OUTSIDE_M) & finite, said=leaves, values=beyond))
    if limits.fence is not None:
        beyond = limits.fence.beyond_m(pos[:, :2])
        leaves = f"the reference is {{}} m outside of geofence.corners_ne_m ({limits.fence.span})"
        said = f"{leaves}; move the mission or the corners"
        rules.append(_Rule(broken=(beyond > _OUTSIDE_M) & finite, said=said, values=beyond))
    if reference.jumps or not finite.all():
        return rules
    speed = np.linalg.norm(vel, axis=1)
    limit = f"the reference flies {{}} m/s; vehicle_model.speed_max_m_s = {model.speed_max_m_s:g}"
    rules.append(_Rule(broken=speed > model.speed_max_m_s, said=limit, values=speed))
    return rules + _motion_rules(t_s, motion, model)


def _motion_rules(t_s: Array, motion: Motion, model: VehicleModelParams) -> list[_Rule]:
    """Return the rules about jumps, tilt and thrust; changes of velocity between samples count as acceleration."""
    pos, vel, accel = motion.pos_ned_m, motion.vel_ned_m_s, motion.accel_ned_m_s2
    step_s = float(t_s[1] - t_s[0])
    between = np.diff(vel, axis=0, append=vel[-1:]) / step_s
    harder = np.linalg.norm(between, axis=1) > np.linalg.norm(accel, axis=1)
    accel = np.where(harder[:, None], between, accel)
    accel[-1] = accel[-2]  # the mission ends here, and the reference may
    least, most = model.thrust_range_m_s2()
    unexplained = np.diff(pos, axis=0) - 0.5 * step_s * (vel[1:] + vel[:-1])
    jump = np.append(np.linalg.norm(unexplained, axis=1), 0.0)
    force = GRAVITY_NED_M_S2 - accel - model.drag_1_s * vel  # thrust over mass, up positive
    tilt = np.arctan2(np.linalg.norm(force[:, :2], axis=1), force[:, 2])
    thrust, harsh = np.linalg.norm(force, axis=1), np.linalg.norm(accel, axis=1)
    tilts = f"which needs more tilt than vehicle_model.tilt_max_rad = {model.tilt_max_rad:g}"
    turns = f"the reference accelerates by {{}} m/s2, {tilts}"
    has = f"vehicle_model.thrust_min_01 and thrust_max_01 give {least:.2f} to {most:.2f}"
    pulls = f"the reference needs a thrust over mass of {{}} m/s2; {has}"
    leaps = "the reference jumps by {} m, which its velocity does not explain"
    return [
        _Rule(broken=jump > _JUMP_M + 0.25 * most * step_s**2, said=leaps, values=jump),
        _Rule(broken=tilt > model.tilt_max_rad, said=turns, values=harsh),
        _Rule(broken=(thrust > most) | (thrust < least), said=pulls, values=thrust),
    ]


def _apart(a: Motion, b: Motion, limits: FlightLimits) -> _Rule:
    apart = a.pos_ned_m - b.pos_ned_m
    apart[:, 2] /= limits.downwash
    distance = np.linalg.norm(apart, axis=1)
    said = f"the references are {{}} m apart; separation.radius_m = {limits.apart_m:g}"
    return _Rule(broken=distance < limits.apart_m, said=said, values=distance)
