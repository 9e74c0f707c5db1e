"""Flies six agents on crossing lists of waypoints inside a flight volume of 10 x 10 x 4 m, in lockstep, seed by seed.

    python tools/volume_flights.py flights.jsonl --seeds 20 --wind 6

Every seed has lists of its own: from a ring across the middle to the other side, and on to another place on the ring,
at heights drawn anew; the wind comes from a direction of its own, with gusts. A flight is judged on true states, from
when all stand at their starts to the end of the mission: collisions (bodies touch), distances below
`limits.min_separation_m`, and how far outside of the volume somebody was (negative: inside). The same call again goes
on where it ended. `--without-rows` is the negative control: references lead a metre out of the sides, and no plan knows
of the volume; `--beyond` is the same with plans that know of it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import swarmctl.kernels  # noqa: F401  # isort: skip  # before numpy, for the same flights everywhere
import numpy as np

from sitl.lockstep import Lockstep
from swarmctl.config import Config, load
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.flight_volume import FlightVolume, VolumeParams
from swarmctl.core.types import Array, Phase, PlanStatus
from swarmctl.errors import ConfigError

AGENTS, RING_M, HEIGHTS_Z_M = 6, 3.6, (-4.0, -1.0)
VOLUME = {
    "corners_ne_m": ((-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0)),
    "floor_z_m": -0.5,
    "ceiling_z_m": -4.5,
}
_DRAWS = 100  # of lists, until the references of all stay inside
_OVER_S = 4.0  # of the mission beyond the longest reference
_GUSTS_01 = 0.3  # share of the wind that is the turbulence's wind at 6 m


def volume_flight(seed: int, wind_m_s: float, path: Path | None, overrides: Sequence[str]) -> Config:
    """Return the configuration of a seed.

    Raises:
        ConfigError: no draw of waypoints can be flown with the overrides.
    """
    rng = np.random.default_rng([seed, 17])
    towards = rng.uniform(0.0, 2.0 * math.pi)
    wind = [wind_m_s * math.cos(towards), wind_m_s * math.sin(towards), 0.0]
    for draw in range(_DRAWS):
        lists = _lists(rng)
        try:
            return load(path, [*_settings(seed, wind, lists), *overrides])
        except ConfigError:
            if draw == _DRAWS - 1:
                raise
    raise AssertionError


def _lists(rng: np.random.Generator) -> Array:
    """Return points (agents, points, 3): a place on the ring, near the middle, across, another place on the ring."""
    bearing = 2.0 * math.pi * (np.arange(AGENTS) + rng.uniform()) / AGENTS
    ring = RING_M * np.column_stack([np.cos(bearing), np.sin(bearing)])  # (agents, 2)
    last = rng.permutation(AGENTS)
    middle = rng.uniform(-1.0, 1.0, (AGENTS, 2))
    plane = np.stack([ring, middle, np.roll(ring, AGENTS // 2, axis=0), ring[last]], axis=1)
    return np.concatenate([plane, rng.uniform(*HEIGHTS_Z_M, (AGENTS, 4, 1))], axis=2)


def _settings(seed: int, wind: Sequence[float], lists: Array) -> list[str]:
    points = [{"points_ned_m": own.round(3).tolist()} for own in lists]
    distances_m = np.linalg.norm(np.diff(lists, axis=1), axis=2).sum(axis=1)
    return [
        f"seed={seed}",
        f"swarm.agents={AGENTS}",
        f"start.positions_ned_m={lists[:, 0].round(3).tolist()}",
        "mission.kind=waypoints",
        f"mission.duration_s={float(distances_m.max()) / 0.9 + _OVER_S:.2f}",
        "mission.waypoints.speed_m_s=1.5",
        "mission.waypoints.accel_m_s2=1.2",
        "mission.waypoints.lists=[" + ", ".join(f"{{points_ned_m={own['points_ned_m']}}}" for own in points) + "]",
        *(f"volume.{key}={json.dumps(value)}" for key, value in VOLUME.items()),
        "sitl.start=air",
        f"sitl.wind.mean_ned_m_s={list(wind)}",
        f"sitl.wind.turbulence_m_s={_GUSTS_01 * math.hypot(*wind)}",
    ]


def flown(config: Config, judged: FlightVolume) -> dict[str, Any]:
    """Fly a configuration until the mission is over, and return what happened."""
    lockstep, began_s = Lockstep(config), time.perf_counter()
    lockstep.run(Lockstep.mission_is_over)
    truth = lockstep.truth.reshape(-1, AGENTS)
    ticks = [log.ticks for log in lockstep.logs]
    tracked_us = max(int(rows["t_us"][rows["phase"] >= Phase.READY].min()) for rows in ticks)
    pos = truth["pos_ned_m"][truth["t_us"][:, 0] >= tracked_us]  # (T, agents, 3)
    beyond_m = judged.beyond_m(pos)
    goals = np.array([rows["ref_pos_ned_m"][rows["phase"] == Phase.TRACK][-1] for rows in ticks])
    statuses = np.concatenate([rows["plan_status"][rows["phase"] == Phase.TRACK] for rows in ticks])
    return {
        "min_separation_m": float(closest_pair_m(pos).min()),
        "beyond_m": float(beyond_m.max()),
        "from_goal_m": float(np.linalg.norm(pos[-1] - goals, axis=1).max()),
        "planned": len(statuses),
        "not_certified": int((statuses == PlanStatus.NOT_CERTIFIED).sum()),
        "solver_failed": int(np.isin(statuses, (PlanStatus.SOLVER_FAILED, PlanStatus.RESIDUAL)).sum()),
        "flown_s": float(len(pos) * 0.02),
        "outcomes": sorted({agent.outcome for agent in lockstep.agents if agent is not None}),
        "took_s": time.perf_counter() - began_s,
    }


def _beyond(config: Config, volume: VolumeParams) -> Config:
    """Return the same mission, its lists drawn out by a metre beyond the sides, flown by agents with `volume`."""
    waypoints = config.mission.flown()
    lists = getattr(waypoints, "lists", ())
    scale = (max(corner[0] for corner in config.volume.corners_ne_m) + 1.0) / RING_M
    wider = [
        own.model_copy(update={"points_ned_m": tuple((scale * n, scale * e, d) for n, e, d in own.points_ned_m)})
        for own in lists
    ]
    mission = config.mission.model_copy(update={"waypoints": waypoints.model_copy(update={"lists": tuple(wider)})})
    return config.model_copy(update={"mission": mission, "volume": volume})


def main() -> None:
    """Fly the seeds that are not in the file yet, and print what all of them came to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--wind", type=float, default=0.0, metavar="M_S")
    parser.add_argument("--config", type=Path, help="what everything else is taken from")
    parser.add_argument("--beyond", action="store_true", help="references lead out of the volume")
    parser.add_argument("--without-rows", action="store_true", help="likewise, and agents know of none")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], dest="sets")
    options = parser.parse_args()
    lines = options.file.read_text().splitlines() if options.file.exists() else []
    rows = [json.loads(line) for line in lines]
    same = {"wind_m_s": options.wind, "config": str(options.config), "sets": options.sets}
    same |= {"beyond": options.beyond, "without_rows": options.without_rows}
    rows = [row for row in rows if all(row[key] == value for key, value in same.items())]
    for seed in sorted(set(range(options.seeds)) - {row["seed"] for row in rows}):
        config = volume_flight(seed, options.wind, options.config, options.sets)
        judged = config.volume.flight_volume()
        assert judged is not None
        if options.beyond or options.without_rows:
            config = _beyond(config, VolumeParams() if options.without_rows else config.volume)
        row = {"seed": seed, **same, **flown(config, judged)}
        rows.append(row)
        with options.file.open("a") as file:
            file.write(json.dumps(row) + "\n")
    given = load(options.config)
    body_m, least_m = given.separation.body_m, given.limits.min_separation_m
    separation_m = [row["min_separation_m"] for row in rows]
    print(
        f"{len(rows)} flights, wind {options.wind:g} m/s: {sum(m < body_m for m in separation_m)} collisions, "
        f"{sum(m < least_m for m in separation_m)} below {least_m:g} m (least {min(separation_m):.3f} m), "
        f"{sum(row['beyond_m'] > 0.0 for row in rows)} left the volume "
        f"(nearest to it: {-max(row['beyond_m'] for row in rows):+.3f} m inside), "
        f"{sum(row['not_certified'] for row in rows)} of {sum(row['planned'] for row in rows)} plans not certified, "
        f"farthest from a goal at the end {max(row['from_goal_m'] for row in rows):.2f} m"
    )


if __name__ == "__main__":
    main()
