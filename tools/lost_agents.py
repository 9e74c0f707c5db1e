"""Prints how far apart vehicles stay when one agent of four ends, or freezes, while they turn around another.

    python tools/lost_agents.py --jobs 2
    python tools/lost_agents.py --ends killed --ways protected --set sitl.autopilot_kind=arducopter

Four swap places; each in turn is lost at each of six times, from places as they are (only these make all four meet at
2.9 s) and from some that are shifted by up to a millimetre. `protected`: peers expect a lost vehicle as its autopilot
flies it without setpoints; `on-path`: on the path that its agent has shared last. Distances are of true states.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
from dataclasses import dataclass

import swarmctl.kernels  # noqa: F401  # isort: skip  # before numpy, for the same flights everywhere
import numpy as np

import swarmctl.agent.sensing.world_model as world_model
from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.layouts import nudged
from swarmctl.config import load
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Phase

AGENTS = 4
SWAP = (
    *(f"swarm.agents={AGENTS}", "mission.kind=swap", "mission.swap.travel_s=6", "mission.duration_s=16"),
    *("sitl.start=air", "sitl.physics_hz=100"),
)
STARTS_NED_M = np.array([[3.0, 0, -3], [0, 3, -3], [-3, 0, -3], [0, -3, -3]])
TIMES_S = (2.4, 2.56, 2.72, 2.88, 3.04, 3.2)  # into the mission
FLOWN_S = 5.5  # of the mission
BOUNDS_M = (0.48, 0.75, 0.85)  # bodies touch, and two distances to be kept
ENDS = ("killed", "frozen")
WAYS = ("protected", "on-path")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight to be flown."""

    end: str
    way: str
    victim: int
    lost_s: float
    start: int
    more: tuple[str, ...]


def fly(case: Case) -> float:
    """Fly one case; return the least distance [m] of two vehicles."""
    if case.way == "on-path":
        world_model.without_setpoints = lambda path, **_: path  # type: ignore[attr-defined]
    starts = f"start.positions_ned_m={json.dumps(nudged(STARTS_NED_M, case.start).tolist())}"
    lockstep = Lockstep(load(None, (*SWAP, starts, *case.more)))
    began_us, is_lost = 0, False
    while True:
        lockstep.step()
        now_us = lockstep.clock.now_us()
        if not began_us:
            began_us = now_us if int(lockstep.logs[0].rows[-1]["phase"][0]) == Phase.TRACK else 0
            continue
        into_s = 1e-6 * (now_us - began_us)
        if not is_lost and into_s >= case.lost_s:
            is_lost = True
            lose(lockstep, case)
        if into_s >= FLOWN_S:
            return float(np.nanmin(closest_pair_m(lockstep.truth.reshape(-1, AGENTS)["pos_ned_m"])))


def lose(lockstep: Lockstep, case: Case) -> None:
    """Kill the agent, of which its launcher tells, or stop its process."""
    if case.end == "killed":
        lockstep.kill(case.victim)
    else:
        lockstep.frozen.add(case.victim)


def row(end: str, way: str, apart_m: list[float]) -> str:
    """Return the line of one kind of loss and one way of expecting the vehicle."""
    counts = "".join(f"{sum(a < bound_m for a in apart_m):12d}" for bound_m in BOUNDS_M)
    return f"{end:8} {way:10} {len(apart_m):8d}{counts} {min(apart_m):10.3f} m"


def main() -> None:
    """Fly every case and print a line for each kind of loss and way."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--ends", default=",".join(ENDS), help="of these: " + ", ".join(ENDS))
    parser.add_argument("--ways", default=",".join(WAYS), help="of these: " + ", ".join(WAYS))
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for every flight")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    print("lost     expected    flights" + "".join(f"   < {bound_m} m" for bound_m in BOUNDS_M) + "      least")
    cells = list(itertools.product(range(AGENTS), TIMES_S, range(options.starts)))
    for end, way in itertools.product(options.ends.split(","), options.ways.split(",")):
        cases = [
            Case(end=end, way=way, victim=victim, lost_s=lost_s, start=start, more=tuple(options.set))
            for victim, lost_s, start in cells
        ]
        with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
            print(row(end, way, pool.map(fly, cases, chunksize=1)), flush=True)


if __name__ == "__main__":
    main()
