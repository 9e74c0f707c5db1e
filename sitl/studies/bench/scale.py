"""`bench --scale`: how costs grow with neighbours, agents and hosts, with the fitted exponents and a plot.

Four questions, each with counts of its own:

- neighbours: the tick of one agent that has a row in its problem for each of them, as in `bench`;
- agents: a whole swarm in lockstep, hovering 3 m apart, where each agent has rows for its two nearest
  (`separation.max_neighbours`) but hears everybody;
- agents in groups: the same in groups of six that are out of each other's reach (`agent.path_sharing.far_hz`);
- hosts: the bus alone of twelve agents, in real time, with routers and processes as on so many computers.

Processor time counts all of it, the simulator included; bytes are what an agent gives to its bus, and what it hears.
Swarms in lockstep are measured for at least 2 s, a whole number of periods of their status.

An exponent is that of cost = a * count ** exponent, by least squares in logarithms: 0 is flat, 1 is linear.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from markupsafe import Markup
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from sitl.lockstep import Lockstep
from sitl.studies.bench.bus_over_hosts import bus_cost
from sitl.studies.bench.captured import settled_garbage, times_of
from sitl.studies.bench.output import json_rows, write_texts
from sitl.studies.bench.ticks import get_under_way, measure_ticks, tracks
from swarmctl.config import Config, load
from swarmctl.core.types import Array
from swarmctl.telemetry.report.charts import Line, agent_line, reference_line, time_chart
from swarmctl.telemetry.report.pages import render

_SPACING_M = 3.0
_HEIGHT_M = 3.0
_ENDLESS_S = 3600.0
_GROUP, _GROUPS_APART_M = 6, 40.0  # two rows of three
_ROWS = 2  # neighbours with rows in a swarm: as many at every count, from 3 agents on
_SETTLE_STEPS = 50  # after the last agent has begun to track
_LEAST_S, _STATUS_S = 2.0, 0.2
_HOSTS_S = 5.0
_SMALLEST = 2  # count that an exponent begins at: 0 has no logarithm, and 1 agent has nobody to share with


COLUMNS = (  # p50 (p99) of ticks and ages
    "tick [ms]",
    "x real time",
    "sent [B/s]",
    "heard [B/s]",
    "path age [ms]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleRow:
    """One line of `scale.json`; what a question does not ask is None."""

    question: str  # "neighbours", "agents", "agents in groups" or "hosts"
    solver: str
    count: int
    tick_p50_ms: float | None = None  # of one agent
    tick_p99_ms: float | None = None
    real_time_per_core: float | None = None  # flown seconds of agents, added up, in one second of a processor
    bytes_per_agent_s: float | None = None  # published on the bus
    heard_bytes_per_agent_s: float | None = None  # delivered by it
    path_age_p50_ms: float | None = None  # when a tick takes it from the bus
    path_age_p99_ms: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """A cost over a count, and what was fitted to it."""

    title: str
    over: str  # what is counted
    counts: Array  # (K,)
    costs: Array  # (K,)
    factor: float  # of the fitted power; NaN with fewer than two counts
    exponent: float  # of it

    @property
    def words(self) -> str:
        """The growth in words."""
        if math.isnan(self.exponent):
            return f"{self.title} over {self.over}"
        twice = 2.0**self.exponent
        return (
            f"{self.title} over {self.over}: exponent {self.exponent:.2f}, twice as many cost {twice:.2f} times as much"
        )


def neighbour_rows(counts: Sequence[int], solver: str, ticks: int, on_count: Callable[[], None]) -> list[ScaleRow]:
    """Measure the tick of one agent among so many neighbours, for each count."""
    rows = []
    for count in counts:
        times = times_of(measure_ticks(count, [solver], ticks)[solver][:, -1])
        rows.append(
            ScaleRow(
                question="neighbours",
                solver=solver,
                count=count,
                tick_p50_ms=round(times.p50_ms, 4),
                tick_p99_ms=round(times.p99_ms, 4),
            )
        )
        on_count()
    return rows


def agent_rows(counts: Sequence[int], solver: str, ticks: int, on_count: Callable[[], None]) -> list[ScaleRow]:
    """Measure swarms of so many agents in lockstep, each for at least `ticks` ticks of agents."""
    rows = []
    for question, swarm in _SWARMS.items():
        for count in counts:
            rows.append(_swarm_row(question, swarm, count, solver, ticks))
            on_count()
    return rows


def host_rows(counts: Sequence[int], solver: str, on_count: Callable[[], None]) -> list[ScaleRow]:
    """Measure the bus of a swarm on so many hosts, for each count."""
    rows = []
    for count in counts:
        cost = bus_cost(count, _HOSTS_S)
        rows.append(
            ScaleRow(
                question="hosts",
                solver=solver,
                count=count,
                real_time_per_core=round(cost.real_time_per_core, 3),
                heard_bytes_per_agent_s=round(cost.heard_bytes_per_agent_s, 1),
                path_age_p50_ms=round(cost.path_age_p50_ms, 3),
                path_age_p99_ms=round(cost.path_age_p99_ms, 3),
            )
        )
        on_count()
    return rows


def _swarm_row(question: str, swarm: Swarm, count: int, solver: str, ticks: int) -> ScaleRow:
    config = _hovering(swarm, count, solver)
    flight = Lockstep(config)
    get_under_way(f"{count} agents with {solver}", flight.step, lambda: all(tracks(flight, k) for k in range(count)))
    for _ in range(_SETTLE_STEPS):
        flight.step()
    period = round(_STATUS_S * config.agent.rate_hz)
    steps = period * math.ceil(max(ticks / count, _LEAST_S * config.agent.rate_hz) / period)
    bytes_before, tick_ms = _bus_bytes(flight), list[float]()
    with settled_garbage():
        began_s = time.process_time()
        for _ in range(steps):
            flight.step()
            tick_ms += [agent.timing.tick_ms for agent in flight.agents if agent is not None]
        spent_s = time.process_time() - began_s
    flown_s, times = steps * count / config.agent.rate_hz, times_of(np.array(tick_ms))
    sent, heard = (_bus_bytes(flight) - bytes_before) / flown_s
    return ScaleRow(
        question=question,
        solver=solver,
        count=count,
        tick_p50_ms=round(times.p50_ms, 4),
        tick_p99_ms=round(times.p99_ms, 4),
        real_time_per_core=round(flown_s / spent_s, 3),
        bytes_per_agent_s=round(sent, 1),
        heard_bytes_per_agent_s=round(heard, 1),
    )


def _hovering(swarm: Swarm, count: int, solver: str) -> Config:
    """Return agents that hover above their starts."""
    return load(
        None,
        [
            f"swarm.agents={count}",
            f"start.positions_ned_m={swarm.places_ned_m(count)}",
            "mission.kind=hover",
            f"separation.max_neighbours={_ROWS}",
            f"mission.duration_s={_ENDLESS_S}",
            f"controller.mpc.qp.solver='{solver}'",
            f"agent.path_sharing.far_hz={swarm.far_hz}",
            "sitl.start='air'",
        ],
    )


def _square(count: int, spacing_m: float) -> list[list[float]]:
    """Return places (count, 3), NED [m], in rows of a square."""
    side = math.ceil(math.sqrt(count))
    return [[spacing_m * (k % side), spacing_m * (k // side), -_HEIGHT_M] for k in range(count)]


def _groups(count: int) -> list[list[float]]:
    """Return places (count, 3), NED [m], in groups of at most `_GROUP`."""
    middles, places = _square(math.ceil(count / _GROUP), _GROUPS_APART_M), _square(_GROUP, _SPACING_M)
    places = [[p + q for p, q in zip(middle, place, strict=True)] for middle in middles for place in places]
    return places[:count]


@dataclass(frozen=True, slots=True, kw_only=True)
class Swarm:
    """A swarm that hovers."""

    places_ned_m: Callable[[int], list[list[float]]]  # of so many agents
    far_hz: float


_SWARMS = {
    "agents": Swarm(places_ned_m=partial(_square, spacing_m=_SPACING_M), far_hz=0.0),
    "agents in groups": Swarm(places_ned_m=_groups, far_hz=1.0),
}


SWARMS = len(_SWARMS)  # measured for each count of agents
_COSTS: dict[str, Callable[[ScaleRow], float | None]] = {
    "tick [ms]": lambda row: row.tick_p50_ms,
    "processor time for a second of one agent [s]": lambda row: row.real_time_per_core and 1.0 / row.real_time_per_core,
    "bytes published by one agent [1/s]": lambda row: row.bytes_per_agent_s,
    "bytes heard by one agent [1/s]": lambda row: row.heard_bytes_per_agent_s,
    "age of paths that are heard [ms]": lambda row: row.path_age_p50_ms,
}


def _bus_bytes(flight: Lockstep) -> Array:
    """Return the bytes that all agents have published and heard so far (2,)."""
    agents = [agent for agent in flight.agents if agent is not None]
    sent = sum(topic["bytes"] for agent in agents for topic in agent.sent.values())
    return np.array([sent, sum(agent.heard_bytes for agent in agents)], np.float64)


def growths(rows: Sequence[ScaleRow]) -> list[Growth]:
    """Return every cost over its count, with its exponent."""
    found = []
    for question in dict.fromkeys(row.question for row in rows):
        asked = [row for row in rows if row.question == question]
        for title, cost in _COSTS.items():
            costs = {row.count: value for row in asked if (value := cost(row))}
            found.append(_growth(title, question, costs))
    return [growth for growth in found if len(growth.counts)]


def _growth(title: str, over: str, costs: Mapping[int, float]) -> Growth:
    counts, values = np.array(list(costs), np.float64), np.array(list(costs.values()))
    factor, exponent = fitted_power(counts, values)
    return Growth(title=title, over=over, counts=counts, costs=values, factor=factor, exponent=exponent)


def fitted_power(counts: Array, costs: Array) -> tuple[float, float]:
    """Return a and e of costs (K,) = a * counts (K,) ** e by least squares in logarithms.

    They are NaN with fewer than two counts that are large enough.
    """
    fitted = counts >= _SMALLEST
    if np.count_nonzero(fitted) < 2:
        return math.nan, math.nan
    exponent, log_factor = np.polyfit(np.log(counts[fitted]), np.log(costs[fitted]), 1)
    return math.exp(log_factor), float(exponent)


def cells(row: ScaleRow) -> tuple[str, ...]:
    """Return the text of each of `COLUMNS`; what was not asked for is empty."""
    return (
        _pair(row.tick_p50_ms, row.tick_p99_ms, 2),
        _number(row.real_time_per_core, 1),
        _number(row.bytes_per_agent_s, 0),
        _number(row.heard_bytes_per_agent_s, 0),
        _pair(row.path_age_p50_ms, row.path_age_p99_ms, 1),
    )


def _number(value: float | None, decimals: int) -> str:
    return "" if value is None else f"{value:.{decimals}f}"


def _pair(p50: float | None, p99: float | None, decimals: int) -> str:
    return "" if p50 is None else f"{_number(p50, decimals)} ({_number(p99, decimals)})"


def write(rows: Sequence[ScaleRow], directory: Path) -> list[Path]:
    """Write `scale.json` and `scale.html` to `directory`, which is made if necessary, and return their paths.

    Raises:
        StartError: it can't be written.
    """
    page = render(
        __package__,
        "scale.html",
        columns=COLUMNS,
        rows=[(row, cells(row)) for row in rows],
        charts=[_chart(growth) for growth in growths(rows)],
    )
    return write_texts({"scale.json": json_rows(rows), "scale.html": page}, directory)


def _chart(growth: Growth) -> Markup:
    lines: list[Line] = [agent_line(0, growth.counts, growth.costs, label="measured", marks=True)]
    if math.isfinite(growth.exponent):
        counts = growth.counts[growth.counts >= _SMALLEST]
        lines.append(reference_line(counts, growth.factor * counts**growth.exponent, label="fitted"))
    shown = (0.0, float(growth.counts.max()) * 1.15)  # room for the name of the axis
    return time_chart(growth.words, lines, shown, from_zero=True, x_unit=growth.over)


def show(rows: Sequence[ScaleRow], console: Console) -> None:
    """Print the rows and what grows how."""
    console.print("p50 (p99) of ticks and of ages; times real time on one processor", markup=False)
    for question in dict.fromkeys(row.question for row in rows):
        asked = {row.count: cells(row) for row in rows if row.question == question}
        told = [place for place in range(len(COLUMNS)) if any(texts[place] for texts in asked.values())]
        table = Table(question, *(Column(Text(COLUMNS[place]), justify="right") for place in told), box=SIMPLE)
        for count, texts in asked.items():
            table.add_row(f"{count}", *(texts[place] for place in told))
        console.print(table)
    for growth in growths(rows):
        console.print(growth.words, markup=False, highlight=False)
