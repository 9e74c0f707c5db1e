"""Flies the circle and two swaps with each way of sharing paths, and prints bytes, tracking errors and distances.

    python tools/path_traffic.py --flights circle
    python tools/path_traffic.py --flights swap3,swap8 --links 0:0,50:0.2,100:0.3 --seeds 4 --json rows.json

A row is one flight, one kind of link and one way of sharing, over all seeds: each shifts the starts by up to a
millimetre and draws other losses. Distances are of true states. Bytes are those of predicted paths while agents track.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import swarmctl.kernels  # noqa: F401  # isort: skip  # before numpy, for the same flights everywhere
import numpy as np
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.layouts import nudged
from swarmctl.config import load
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Phase, PlanStatus

CONFIGS = Path(__file__).parents[1] / "configs"
PATH_TOPICS = ("path", "far_path")
FLIGHTS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "circle": (None, ("mission.duration_s=25",)),
    "swap3": (
        "swap8.toml",
        (
            "swarm.agents=3",
            "start.positions_ned_m=[[3.0,0.0,0.0],[-1.5,2.6,0.0],[-1.5,-2.6,0.0]]",
            "mission.swap.travel_s=6",
            "mission.duration_s=10",
        ),
    ),
    "swap8": ("swap8.toml", ("mission.duration_s=12",)),
}
SHARING = {
    "float32": "{compact=false,error_m=0}",
    "compact": "{compact=true,error_m=0}",
    "event": "{compact=true,error_m=0.002}",
    "event-60ms": "{compact=true,error_m=0.001,heartbeat_s=0.06}",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight to be flown."""

    flight: str
    delay_ms: float
    loss_01: float
    sharing: str
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What came of one flight."""

    messages_01: float  # per tick
    bytes_per_agent_s: float
    index_m: float  # sum of the agents' mean distances to their references
    separation_m: float  # smallest one of true states
    plans_failed: int
    unresponsive: int  # times that a peer counted as silent
    incomplete: tuple[str, ...]  # missions that did not end as they should


def fly(case: Case) -> Flown:
    """Fly one case to the end of its mission."""
    config, sets = FLIGHTS[case.flight]
    path = CONFIGS / config if config else None
    sharing = f"agent.path_sharing={SHARING[case.sharing]}"
    links = (f"bus.delay_ms={case.delay_ms}", f"bus.loss_01={case.loss_01}", f"seed={case.seed}")
    sets = (*sets, *links, sharing, "sitl.start=air")
    starts = nudged(np.array(load(path, sets).starts_ned_m()), case.seed)
    flight = Lockstep(load(path, (*sets, f"start.positions_ned_m={starts.tolist()}")))
    sent: Counter[str] = Counter()
    tracked = 0
    while not flight.mission_is_over():
        before = _sent(flight)
        tracks = [_phase(flight, agent) == Phase.TRACK for agent in range(len(flight.agents))]
        flight.step()
        if all(tracks):
            sent.update(_sent(flight) - before)
            tracked += len(tracks)
    return _judged(flight, sent, tracked)


def _phase(flight: Lockstep, agent: int) -> int:
    rows = flight.logs[agent].rows
    return int(rows[-1]["phase"][0]) if rows else -1


def _sent(flight: Lockstep) -> Counter[str]:
    """Return the messages and bytes of paths that all agents have sent."""
    found: Counter[str] = Counter()
    for agent in flight.agents:
        for topic in PATH_TOPICS:
            found.update(agent.sent.get(topic, {}) if agent is not None else {})
    return found


def _mean_error_m(flight: Lockstep, agent: int) -> float:
    truth = flight.truth.reshape(-1, len(flight.agents))
    rows = flight.logs[agent].ticks
    rows = rows[rows["phase"] == Phase.TRACK]
    t_us: NDArray[np.int64] = truth["t_us"][:, 0]
    pos_ned_m: NDArray[np.float64] = truth["pos_ned_m"][:, agent]
    true = [np.interp(rows["t_us"], t_us, pos_ned_m[:, axis]) for axis in range(3)]
    return float(np.linalg.norm(np.stack(true, axis=1) - rows["ref_pos_ned_m"], axis=1).mean())


def _judged(flight: Lockstep, sent: Counter[str], tracked: int) -> Flown:
    agents = len(flight.agents)
    events = [event["event"] for log in flight.logs for event in log.events if event.get("begins", True)]
    tracking = [rows[rows["phase"] == Phase.TRACK] for rows in (log.ticks for log in flight.logs)]
    outcomes = [agent.outcome for agent in flight.agents if agent is not None]
    return Flown(
        messages_01=sent["messages"] / tracked,
        bytes_per_agent_s=sent["bytes"] / tracked * flight.config.agent.rate_hz,
        index_m=sum(_mean_error_m(flight, agent) for agent in range(agents)),
        separation_m=float(closest_pair_m(flight.truth["pos_ned_m"].reshape(-1, agents, 3)).min()),
        plans_failed=sum(int((rows["plan_status"] != PlanStatus.OK).sum()) for rows in tracking),
        unresponsive=events.count("unresponsive"),
        incomplete=tuple(outcome for outcome in outcomes if outcome != "completed"),
    )


def show(cases: Sequence[Case], flown: Sequence[Flown]) -> None:
    """Print a row for each flight, link and way of sharing."""
    print("flight   delay loss  sharing     messages  bytes/s   index  separation (mean)  no plan  silent  incomplete")
    groups: dict[Case, list[Flown]] = {}
    for case, found in zip(cases, flown, strict=True):
        groups.setdefault(replace(case, seed=0), []).append(found)
    for case, rows in groups.items():
        apart_m = [row.separation_m for row in rows]
        means = np.mean(
            [(r.messages_01, r.bytes_per_agent_s, r.index_m, r.plans_failed, r.unresponsive) for r in rows], axis=0
        )
        messages_01, bytes_s, index_m, failed, silent = means.tolist()
        print(
            f"{case.flight:8}{case.delay_ms:6.0f}{case.loss_01:5.0%}  {case.sharing:11}{messages_01:9.1%}{bytes_s:9.0f}"
            f"{index_m:8.4f}{min(apart_m):11.3f} ({np.mean(apart_m):.3f}){failed:9.1f}{silent:8.1f}"
            f"{sum(bool(row.incomplete) for row in rows):12d}"
        )


def main() -> None:
    """Fly every combination and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--flights", default=",".join(FLIGHTS), help=f"of {', '.join(FLIGHTS)}")
    parser.add_argument("--sharing", default=",".join(SHARING), help=f"of {', '.join(SHARING)}")
    parser.add_argument("--links", default="0:0", help="delay [ms] and share of messages lost, as 0:0,50:0.2")
    parser.add_argument("--seeds", type=int, default=1, help="flights of each row")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", type=Path, help="file for the result of every flight")
    options = parser.parse_args()
    links = [link.split(":") for link in options.links.split(",")]
    cases = [
        Case(flight=flight, delay_ms=float(delay_ms), loss_01=float(loss_01), sharing=sharing, seed=seed)
        for flight in options.flights.split(",")
        for delay_ms, loss_01 in links
        for sharing in options.sharing.split(",")
        for seed in range(1, options.seeds + 1)
    ]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        flown = pool.map(fly, cases, chunksize=1)
    if options.json:
        rows = [{**asdict(case), **asdict(found)} for case, found in zip(cases, flown, strict=True)]
        options.json.write_text(json.dumps(rows, indent=1))
    show(cases, flown)


if __name__ == "__main__":
    main()
