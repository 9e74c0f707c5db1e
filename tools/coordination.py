"""Prints how soon and how far apart agents swap places, for ways of solving: solvers, weights of the proximal term.

    python tools/coordination.py --starts 12
    python tools/coordination.py --flights swap4 --ways "osqp:0,daqp:5" --set controller.mpc.qp.scaling=2

A way is a solver and `controller.mpc.proximal_xy`. Flights: four that swap symmetrically, eight, four of which one is
silent on the bus from shortly before they meet, and four that run only one tick in five with all responses to that
switched off. Each starts from places of which all but the first set are shifted by up to a millimetre. Distances are of
true states; an x-y solve is one with keep-outs, by the processor time of its thread.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import swarmctl.kernels  # noqa: F401  # isort: skip  # before numpy, for the same flights everywhere
import numpy as np

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.layouts import nudged
from swarmctl.bus.bus import agent_name
from swarmctl.config import load
from swarmctl.control.mpc.condensed_qp.axes import AxesSolution
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.condensed_qp.prediction import Forecast
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Array, Phase

CONFIGS = Path(__file__).parents[1] / "configs"
ARRIVED_M = 0.1
CLOSE_M = 0.85
SILENT = 1
FOUR = ("swarm.agents=4", "sitl.start=air", "mission.duration_s=60")
CROSS = "start.positions_ned_m=[[3,0,0],[0,3,0],[-3,0,0],[0,-3,0]]"
UNPROTECTED = ("agent.overload.widen_01=1", "agent.overload.hold_01=1", "agent.overload.clear_01=1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """A kind of flight: what is flown, and what happens on the way."""

    sets: tuple[str, ...]
    limit_s: float
    happens_s: float = 0.0  # into the mission
    happens: Callable[[Lockstep], None] = lambda _: None


def silence(lockstep: Lockstep) -> None:
    """Carry nothing more of what one agent publishes."""
    for agent in set(range(lockstep.config.swarm.agents)) - {SILENT}:
        lockstep.hub.cut(agent_name(SILENT), agent_name(agent))


def starve(lockstep: Lockstep) -> None:
    """Run one tick in five."""
    lockstep.starved = dict.fromkeys(range(lockstep.config.swarm.agents), 5)


FLIGHTS = {
    "swap4": Flight(sets=(*FOUR, CROSS, "mission.swap.travel_s=6"), limit_s=25.0),
    "swap8": Flight(sets=(), limit_s=45.0),
    "silent": Flight(sets=(*FOUR, CROSS, "mission.swap.travel_s=6"), limit_s=9.0, happens_s=2.5, happens=silence),
    "starved": Flight(sets=(*FOUR, CROSS, *UNPROTECTED), limit_s=25.0, happens_s=0.5, happens=starve),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight to be flown."""

    flight: str
    way: str
    start: int
    more: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What came of one flight."""

    arrived_s: float  # into the mission, the limit if not all have
    separation_m: float
    solves: int
    solves_s: float


def fly(case: Case) -> Flown:
    """Fly one case until all have arrived."""
    flight, (solver, proximal) = FLIGHTS[case.flight], case.way.split(":")
    sets = (*flight.sets, f"controller.mpc.qp.solver={solver}", f"controller.mpc.proximal_xy={proximal}", *case.more)
    path = CONFIGS / "swap8.toml"
    starts = nudged(np.array(load(path, sets).starts_ned_m()), case.start)
    lockstep = Lockstep(load(path, (*sets, f"start.positions_ned_m={json.dumps(starts.tolist())}")))
    solved_ns = list[int]()
    solve = CondensedMpc.solve_from

    def timed(mpc: CondensedMpc, forecast: Forecast) -> AxesSolution:
        began_ns = time.thread_time_ns()
        found = solve(mpc, forecast)
        if forecast.half_spaces is not None:
            solved_ns.append(time.thread_time_ns() - began_ns)
        return found

    CondensedMpc.solve_from = timed  # type: ignore[method-assign, assignment]
    try:
        arrived_s = _until_arrived(lockstep, flight, -starts[:, :2])
    finally:
        CondensedMpc.solve_from = solve  # type: ignore[method-assign]
    apart_m = closest_pair_m(lockstep.truth.reshape(-1, len(starts))["pos_ned_m"])
    return Flown(
        arrived_s=arrived_s,
        separation_m=float(np.nanmin(apart_m)),
        solves=len(solved_ns),
        solves_s=1e-9 * sum(solved_ns),
    )


def _until_arrived(lockstep: Lockstep, flight: Flight, goals_ne_m: Array) -> float:
    """Step until all have arrived, or to the limit; return the time into the mission."""
    began_us, has_happened = 0, False
    while True:
        lockstep.step()
        now_us = lockstep.clock.now_us()
        if not began_us:
            began_us = now_us if int(lockstep.logs[0].rows[-1]["phase"][0]) == Phase.TRACK else 0
            continue
        into_s = 1e-6 * (now_us - began_us)
        if not has_happened and into_s >= flight.happens_s:
            flight.happens(lockstep)
            has_happened = True
        away_m = np.linalg.norm(lockstep.world.truth_rows()["pos_ned_m"][:, :2] - goals_ne_m, axis=1)
        if into_s >= flight.limit_s or lockstep.finished or away_m.max() < ARRIVED_M:
            return into_s


def row(case: tuple[str, str], flown: list[Flown]) -> str:
    """Return the line of one kind of flight and one way of solving."""
    arrived_s = np.array([one.arrived_s for one in flown])
    apart_m = np.array([one.separation_m for one in flown])
    solve_us = 1e6 * sum(one.solves_s for one in flown) / max(1, sum(one.solves for one in flown))
    close = int((apart_m < CLOSE_M).sum())
    return (
        f"{case[0]:8} {case[1]:10} {arrived_s.mean():7.2f} {arrived_s.max():6.1f}   {apart_m.mean():6.3f} "
        f"{apart_m.min():6.3f} {close:3d} of {len(flown):2d}   {solve_us:6.0f}"
    )


def main() -> None:
    """Fly every kind of flight in every way, from every start."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--flights", default=",".join(FLIGHTS), help="of these: " + ", ".join(FLIGHTS))
    parser.add_argument("--ways", default="osqp:0,daqp:0,daqp:5,osqp:5", help="SOLVER:WEIGHT, of the proximal term")
    parser.add_argument("--starts", type=int, default=12)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for every flight")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    print(f"flight   way        arrive    max     least   min   < {CLOSE_M} m   x-y us", flush=True)
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for flight, way in itertools.product(options.flights.split(","), options.ways.split(",")):
            case = partial(Case, flight=flight, way=way, more=tuple(options.set))
            print(row((flight, way), pool.map(fly, [case(start=k) for k in range(options.starts)])), flush=True)


if __name__ == "__main__":
    main()
