"""Data of a campaign: cells, trials and the table row of a flown trial."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa


@dataclass(frozen=True, slots=True, order=True, kw_only=True)
class Cell:
    """One combination of conditions, flown with many seeds."""

    scenario: str  # of sitl.studies.campaign.conditions.scenarios.SCENARIOS
    agents: int
    delay_ms: float  # of every message on the bus, on top of one tick
    loss: float  # 0..1, probability that one receiver misses one message of an unreliable topic
    noise: str  # of sitl.studies.campaign.conditions.factors.NOISES
    wind_m_s: float  # steady, from the west, with Dryden turbulence of as much
    protections: str  # of sitl.studies.campaign.conditions.factors.PROTECTIONS
    airframe: str = "own"  # of sitl.studies.campaign.conditions.scenarios.AIRFRAMES
    disturbance: str = "none"  # of sitl.studies.campaign.conditions.disturbances.DISTURBANCES, perhaps with :strength
    sets: str = ""  # further key=value settings, separated by spaces


@dataclass(frozen=True, slots=True, order=True)
class Trial:
    """Describes one flight of a campaign."""

    cell: Cell
    seed: int


CELL_FIELDS = (
    "scenario",
    "agents",
    "delay_ms",
    "loss",
    "noise",
    "wind_m_s",
    "protections",
    "airframe",
    "disturbance",
    "sets",
)

# One row per run. What can't be known is null: of a run that was not flown everything, but that it did not arrive.
SCHEMA = pa.schema(
    [
        pa.field("scenario", pa.string()),
        pa.field("agents", pa.int32()),
        pa.field("delay_ms", pa.float64()),
        pa.field("loss", pa.float64()),
        pa.field("seed", pa.int64()),
        pa.field("protections", pa.string()),
        pa.field("collided", pa.bool_()),  # in truth: two bodies touched, or a body and an obstacle
        pa.field("min_separation_m", pa.float64()),  # smallest true distance of two centres at any time
        pa.field("arrived", pa.bool_()),  # all expected vehicles, for good, without collision; null if none is
        pa.field("flight_time_s", pa.float64()),  # from the begin of the mission to the last arrival
        pa.field("noise", pa.string()),
        pa.field("wind_m_s", pa.float64()),
        pa.field("airframe", pa.string()),
        pa.field("disturbance", pa.string()),
        pa.field("sets", pa.string()),
        pa.field("deadlocked", pa.bool_()),  # time ran out, and a vehicle that has not arrived stands still
        pa.field("outcome", pa.string()),  # see docs/data_formats.md
        pa.field("min_clearance_m", pa.float64()),  # smallest true distance of a body's hull to an obstacle's surface
        pa.field("arrived_agents", pa.int32()),
        pa.field("unconstrained_time_s", pa.float64()),  # of the longest way, flown alone and undisturbed
        pa.field("goal_sum_m", pa.float64()),  # sum of all distances to the goals at the end
        pa.field("least_sum_m", pa.float64()),  # the least that sum can be (same goal)
        pa.field("plans_failed", pa.int64()),  # ticks of all agents without a certified plan
        pa.field("commits_refused", pa.int64()),  # plans of all agents not flown after others were heard
        pa.field("safety_filter_acted", pa.int64()),  # ticks of all agents in which the safety filter changed the input
        pa.field("simulated_s", pa.float64()),
        pa.field("cpu_s", pa.float64()),  # processor time, the only column that is not a function of the trial
        pa.field("code", pa.string()),  # of the sources that flew it
    ]
)

Row = dict[str, Any]
_NOT_FLOWN = "not flown: "  # begins the outcome of a trial that an error ended


def row_of_error(identity: Row, names: Sequence[str], error: str, code: str) -> Row:
    """Return the row of a flight of which nothing is known, because an error ended it.

    Args:
        identity: columns that tell what was to be flown.
        names: of all columns; the others are null.
        error: in words.
        code: digest of the sources that met it.
    """
    return dict.fromkeys(names) | identity | {"outcome": _NOT_FLOWN + error, "code": code}


def is_flown(row: Row) -> bool:
    """Return whether a row is the result of a flight, and not of an error that ended it."""
    return not str(row["outcome"]).startswith(_NOT_FLOWN)


def cells(
    scenarios: Sequence[str],
    agents: Sequence[int],
    delays_ms: Sequence[float],
    losses: Sequence[float],
    *,
    noises: Sequence[str],
    winds_m_s: Sequence[float],
    protections: Sequence[str],
    airframes: Sequence[str] = ("own",),
    disturbances: Sequence[str] = ("none",),
    sets: str = "",
) -> Iterator[Cell]:
    """Every combination, in order."""
    axes = (scenarios, agents, delays_ms, losses, noises, winds_m_s, protections, airframes, disturbances)
    for scenario, count, delay_ms, loss, noise, wind_m_s, *others in itertools.product(*axes):
        protection, airframe, disturbance = others
        yield Cell(
            scenario=scenario,
            agents=count,
            delay_ms=delay_ms,
            loss=loss,
            noise=noise,
            wind_m_s=wind_m_s,
            protections=protection,
            airframe=airframe,
            disturbance=disturbance,
            sets=sets,
        )


def cell_of(row: Row) -> Cell:
    """The cell that a row belongs to."""
    return Cell(**{name: row[name] for name in CELL_FIELDS})


def unflown(trial: Trial, error: str, code: str) -> Row:
    """Return the row of a trial that an error ended; it has not arrived."""
    cell = {name: getattr(trial.cell, name) for name in CELL_FIELDS}
    return row_of_error(cell | {"seed": trial.seed, "arrived": False}, SCHEMA.names, error, code)


def trial_of(row: Row) -> Trial:
    """The trial that a row is the result of."""
    return Trial(cell_of(row), row["seed"])
