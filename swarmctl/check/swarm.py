"""Checks of all vehicles together: ids, positions against the start, and the complete list of findings. Pure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from swarmctl.check.finding import SWARM, Finding
from swarmctl.check.parameters import parameter_findings
from swarmctl.check.scan.link_facts import Ned, VehicleFacts
from swarmctl.check.services import service_findings
from swarmctl.check.vehicle.findings import vehicle_findings
from swarmctl.config import Config
from swarmctl.control.phases.departure import LEAST_CLIMB_M, is_beyond_reach
from swarmctl.core.types import Landed
from swarmctl.core.verdict import Verdict
from swarmctl.errors import EXIT_MISSION, EXIT_OK, EXIT_START

OK, NOTE, FIX = Verdict.OK, Verdict.NOTE, Verdict.FIX
_FAR_M = 30.0  # beside the start, or below it, that is worth a note: heights above the ellipsoid are 50 m off in Europe
_SLOPE_M = 5.0  # between the lowest and the highest place of a field
_SWAPPED_BY_M = 0.5  # least saving that reports two vehicles as swapped


def findings(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Return all findings: those of each vehicle in order, then those about all vehicles."""
    lines = [line for facts in vehicles for line in (*vehicle_findings(facts, config), *_own(facts, config))]
    return lines + [line for assess in _SWARM_ROWS for line in assess(vehicles, config)]


def exit_code(vehicles: Sequence[VehicleFacts], lines: Sequence[Finding]) -> int:
    """Return 0 when nothing is to fix, 3 when a vehicle was not reached, 4 when something is to fix."""
    if any(not facts.reached for facts in vehicles):
        return EXIT_START
    return EXIT_MISSION if any(line.verdict is FIX for line in lines) else EXIT_OK


def standing(vehicles: Sequence[VehicleFacts]) -> list[Finding]:
    """Return a finding for each vehicle that may not be flown now: armed, in the air, or of unknown state."""
    advice = "another program flies it, or has left it armed: land and disarm it first"
    return [
        Finding(
            agent=facts.agent,
            topic="to fly",
            verdict=FIX,
            found="armed" if facts.armed else facts.landed.name.lower(),
            wanted="on ground",
            advice=advice,
        )
        for facts in vehicles
        if facts.armed or facts.landed is not Landed.ON_GROUND
    ]


def _own(facts: VehicleFacts, config: Config) -> list[Finding]:
    return [*_start(facts, config), *service_findings(facts, config), *parameter_findings(facts, config)]


def _start(facts: VehicleFacts, config: Config) -> list[Finding]:
    """Compare the position of a vehicle with its start."""
    pos = facts.pos_ned_m
    if pos is None:
        return []
    start = config.starts_ned_m()[facts.agent]
    away_m, climb_m = math.dist(pos[:2], start[:2]), pos[2] - start[2]

    def line(verdict: Verdict, advice: str = "", weight: int = 0) -> list[Finding]:
        found = f"{away_m:.2f} m beside it, {climb_m:+.2f} m below"
        return [
            Finding(
                agent=facts.agent,
                topic="start",
                verdict=verdict,
                found=found,
                wanted=_place(start),
                advice=advice,
                weight=weight,
            )
        ]

    if facts.landed is Landed.ON_GROUND and climb_m < LEAST_CLIMB_M:
        advice = (
            f"its start is less than {LEAST_CLIMB_M} m above the ground it stands on: raise the start (NED, down is "
            "positive) or correct swarm.origin_alt_m"
        )
        return line(FIX, advice, 77)
    state_machine = config.agent.state_machine
    if is_beyond_reach(pos, start, state_machine):
        within = f"agent.state_machine.start_timeout_s = {state_machine.start_timeout_s:g}"
        advice = f"it can't get there within {within}: correct swarm.origin_*, or move it; it is not armed"
        return line(FIX, advice, 76)
    if climb_m > _FAR_M:
        return line(NOTE, "far below its start; is swarm.origin_alt_m right, above mean sea level?", 7)
    if away_m > _FAR_M:
        return line(NOTE, "far from its start; is the way there free?", 6)
    return line(OK)


def _volume(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Show the flight volume, and compare with it where vehicles stand and how well they know it."""
    volume = config.volume.flight_volume()
    if volume is None:
        return []
    params, topic = config.volume, "volume"
    north, east = (np.ptp([corner[axis] for corner in params.corners_ne_m]) for axis in (0, 1))
    high_m = float(volume.offsets_m[-2:].sum()) * -1.0
    wanted = f"{north:.1f} x {east:.1f} x {high_m:.1f} m, {volume.sides} sides; plans keep {params.margin_m:g} m inside"
    lines = []
    for facts in vehicles:
        if facts.pos_ned_m is None:
            continue
        level = np.array([*facts.pos_ned_m[:2], config.starts_ned_m()[facts.agent][2]])
        if (beyond_m := float(volume.beyond_m(level))) > 0.0:
            advice = "its autopilot would climb beside the volume before the agent flies it in: move the vehicle"
            found = f"{beyond_m:.1f} m beyond {volume.face(level)}"
            lines.append(
                Finding(
                    agent=facts.agent, topic=topic, verdict=FIX, found=found, wanted="inside", advice=advice, weight=78
                )
            )
    accuracy_m = max((v.pos_accuracy_m for v in vehicles if v.pos_accuracy_m is not None), default=0.0)
    found = f"estimates {accuracy_m:.2f} m off" if accuracy_m else "not told how far estimates are off"
    unsure = accuracy_m > params.margin_m
    advice = f"true positions may leave it: set volume.margin_m = {accuracy_m:.2f} or more" if unsure else ""
    verdict = NOTE if unsure else OK
    return [
        *lines,
        Finding(agent=SWARM, topic=topic, verdict=verdict, found=found, wanted=wanted, advice=advice, weight=8),
    ]


def _duplicates(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    lines = []
    for a, b in itertools.combinations([v for v in vehicles if v.reached], 2):
        if a.sysid == b.sysid:
            advice = f"agents {a.agent} and {b.agent} would command the same id: give each autopilot its own"
            lines.append(
                Finding(
                    agent=SWARM,
                    topic="system ids",
                    verdict=FIX,
                    found=f"{a.sysid} twice",
                    wanted="all different",
                    advice=advice,
                    weight=96,
                )
            )
        elif a.version and b.version and a.version.uid == b.version.uid and a.version.has_usb:
            advice = f"agents {a.agent} and {b.agent} are connected to the same board"
            lines.append(
                Finding(
                    agent=SWARM,
                    topic="system ids",
                    verdict=FIX,
                    found=f"uid {a.version.uid} twice",
                    wanted="all different",
                    advice=advice,
                    weight=96,
                )
            )
    return lines


def _origins(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Compare the local origins; agents convert between frames, so a spread of origins itself is harmless."""
    known = [v.origin_ned_m for v in vehicles if v.origin_ned_m is not None]
    if len(known) < 2:
        return []
    spread_m = max(math.dist(a, b) for a, b in itertools.combinations(known, 2))
    return [
        Finding(
            agent=SWARM,
            topic="origins",
            verdict=OK,
            found=f"up to {spread_m:.2f} m apart",
            wanted="any; agents convert",
        )
    ]


def _apart(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Check horizontal distances: autopilots climb vertically before the agents keep vehicles apart."""
    placed = [(v.agent, v.pos_ned_m) for v in vehicles if v.pos_ned_m is not None]
    if len(placed) < 2:
        return []
    radius_m = config.separation.radius_m
    pairs = [(math.dist(p[:2], q[:2]), i, j) for (i, p), (j, q) in itertools.combinations(placed, 2)]
    close = sorted(pair for pair in pairs if pair[0] < radius_m)
    wanted = f"separation.radius_m = {radius_m:g}"
    if not close:
        return [
            Finding(agent=SWARM, topic="distances", verdict=OK, found=f"least {min(pairs)[0]:.2f} m", wanted=wanted)
        ]
    return [
        Finding(
            agent=SWARM,
            topic="distances",
            verdict=FIX,
            found=f"agents {i} and {j}: {away_m:.2f} m",
            wanted=wanted,
            advice=f"vehicles of agents {i} and {j} stand closer than they may fly; move them apart",
            weight=80,
        )
        for away_m, i, j in close
    ]


def _heights(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Compare the heights at which vehicles stand: one that estimates another height passes peers as if far above."""
    placed = [(v.pos_ned_m[2], v.agent) for v in vehicles if v.pos_ned_m is not None and v.landed is Landed.ON_GROUND]
    if len(placed) < 2:
        return []
    (highest_m, i), (lowest_m, j) = min(placed), max(placed)
    apart_m, noted_m = lowest_m - highest_m, config.separation.budget.level_m

    def line(verdict: Verdict, advice: str = "", weight: int = 0) -> list[Finding]:
        return [
            Finding(
                agent=SWARM,
                topic="heights",
                verdict=verdict,
                found=f"up to {apart_m:.2f} m apart on the ground",
                wanted=f"half of separation.radius_m, {noted_m:.2f} m, on level ground",
                advice=advice,
                weight=weight,
            )
        ]

    if apart_m <= noted_m:
        return line(OK)
    advice = (
        f"the vehicle of agent {i} estimates to stand {apart_m:.1f} m above that of agent {j}: if it does not, they "
        "meet where they mean to pass above each other; give both the same height of the origin"
    )
    return line(FIX, advice, 78) if apart_m > _SLOPE_M else line(NOTE, advice, 8)


def _radius(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Compare the separation distance with what bodies, tracking and the least accurate estimator need."""
    told = [v.pos_accuracy_m for v in vehicles if v.pos_accuracy_m is not None]
    if len(vehicles) < 2 or not told:
        return []
    separation = config.separation
    least_m = math.ceil(separation.budget.required_m(max(told)) * 100) / 100
    found = f"separation.radius_m = {separation.radius_m:g}"
    wanted = (
        f"{least_m:.2f} m: body {separation.body_m:g}, tracking {separation.tracking_m:g}, estimator {max(told):.2f}"
    )
    if separation.radius_m >= least_m:
        return [Finding(agent=SWARM, topic="radius", verdict=OK, found=found, wanted=wanted)]
    advice = f"bodies may touch where estimates say they are apart: set separation.radius_m = {least_m:.2f}"
    if separation.allow_small_radius:
        return [Finding(agent=SWARM, topic="radius", verdict=NOTE, found=found, wanted=wanted, advice=advice, weight=9)]
    return [
        Finding(
            agent=SWARM,
            topic="radius",
            verdict=FIX,
            found=found,
            wanted=wanted,
            advice=f"{advice}; agents refuse to arm",
            weight=79,
        )
    ]


def _swapped(vehicles: Sequence[VehicleFacts], config: Config) -> list[Finding]:
    """Return the pairs whose paths to the start would be shorter if they changed places."""
    starts = config.starts_ned_m()
    placed = [(v.agent, v.pos_ned_m) for v in vehicles if v.pos_ned_m is not None]
    lines = []
    for (i, p), (j, q) in itertools.combinations(placed, 2):
        straight_m = math.dist(p[:2], starts[i][:2]) + math.dist(q[:2], starts[j][:2])
        crossed_m = math.dist(p[:2], starts[j][:2]) + math.dist(q[:2], starts[i][:2])
        if crossed_m + _SWAPPED_BY_M < straight_m:
            advice = f"vehicles of agents {i} and {j} stand nearer to each other's start: change their order, or place"
            lines.append(
                Finding(
                    agent=SWARM,
                    topic="order",
                    verdict=NOTE,
                    found=f"agents {i} and {j}",
                    wanted="each nearest its own start",
                    advice=advice,
                    weight=6,
                )
            )
    return lines


def _place(pos_ned_m: Ned) -> str:
    return "(" + ", ".join(f"{c:.1f}" for c in pos_ned_m) + ")"


_SWARM_ROWS: tuple[Callable[[Sequence[VehicleFacts], Config], list[Finding]], ...] = (
    _duplicates,
    _origins,
    _apart,
    _heights,
    _radius,
    _volume,
    _swapped,
)
