"""Runs agents once more over what they have received in a recorded run, and compares what they decide.

The vehicles fly as they flew: a decision has no effect on what comes next, so that every tick is compared by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.agent.assembly import make_agent
from swarmctl.bus.bus import agent_name
from swarmctl.bus.traffic import CountedBus
from swarmctl.config import Config
from swarmctl.core.recorded.records import TICK_DTYPE
from swarmctl.core.types import Array, Phase, Plan, PlanStatus
from swarmctl.errors import ConfigError
from swarmctl.files import read_file
from swarmctl.ops.decide.deliveries import Recording, deliveries
from swarmctl.ops.decide.inputs import RecordedBus, RecordedLink, RecordedTime, frames_of
from swarmctl.telemetry.recording.file_names import frames_file

DIFFERS_RAD, DIFFERS_01 = 0.01, 0.01  # attitude and thrust: far more than rounding
_MOST_TLOG_BYTES = 2**30
_MERGE_S = 0.5  # differences that are closer in time are one
_BOOT = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A stretch of time in which an agent decides otherwise."""

    from_s: float  # since the run's first tick
    to_s: float
    ticks: int
    tilt_rad: float  # largest angle between both attitudes sent
    thrust_01: float  # largest difference of both thrusts
    was: str  # phase and plan status at its begin
    now: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Decisions:
    """What one agent has decided, and decides now."""

    agent: int
    compared: int  # ticks
    phases_differ: int
    plans_differ: int  # status of the plan
    tilt_rad: Mapping[str, float]  # p50, p99, max of the angle between both attitudes
    thrust_01: Mapping[str, float]
    differences: Sequence[Difference]


class _Rows:
    """Keeps the ticks of an agent; its events are not compared."""

    def __init__(self) -> None:
        self.rows: list[NDArray[np.void]] = []

    def tick(self, row: NDArray[np.void], flown: Plan | None) -> None:
        self.rows.append(row)

    def received(self, rows: bytes) -> None:
        """Forget it."""

    def event(self, name: str, t_us: int, utc_us: int, **fields: Any) -> None:
        """Forget it."""


def recorded_frames(directory: Path, agent: int) -> list[tuple[int, bytes]]:
    """Return the frames that an agent's vehicle has sent, each with its UTC [us], as far as its `.tlog` is readable.

    Raises:
        ConfigError: it can't be read, or holds none.
    """
    path = directory / frames_file(agent)
    try:
        frames = list(frames_of(read_file(path, _MOST_TLOG_BYTES)))
    except OSError as error:
        raise ConfigError(str(path), [f"can't be read: {error.strerror or error}"]) from error
    if not frames:
        raise ConfigError(str(path), ["holds no frames of a vehicle"])
    return frames


def decide_again(directory: Path, config: Config, recording: Recording, agent: int) -> NDArray[np.void]:
    """Return the ticks (T,) of an agent that receives what it has received, by a configuration that may be another.

    Raises:
        ConfigError: the run lacks what is needed.
    """
    if config.separation.mode == "guaranteed":
        raise ConfigError("--decide", ["separation.mode = 'guaranteed': what agents committed to is not recorded"])
    frames = recorded_frames(directory, agent)
    clock, link = RecordedTime(), RecordedLink()
    ticks = recording.run.ticks
    bus = RecordedBus(frozenset(agent_name(number) for number in ticks))
    sink, rows = _Rows(), ticks[agent]
    clock.t_us, clock.utc = int(rows["t_us"][0]), int(rows["utc_us"][0])
    flown = make_agent(
        config,
        agent,
        _BOOT,
        link,
        bus=CountedBus(bus),
        clock=clock,
        sink=sink,
        on_frame=lambda _: None,
        stopwatch_ns=lambda: 0,
    )
    for row, delivery in zip(rows, deliveries(config, agent, recording, frames), strict=True):
        clock.t_us, clock.utc = int(row["t_us"]), delivery.begin_utc_us
        link.offer(delivery.datagrams)
        for _, topic, sender, payload in delivery.messages:
            bus.offer(topic, sender, payload)
        flown.tick(clock.t_us, int(row["deadline_misses"]))
    return np.concatenate(sink.rows) if sink.rows else np.zeros(0, TICK_DTYPE)


def compare(was: NDArray[np.void], now: NDArray[np.void], agent: int) -> Decisions:
    """Compare what an agent has decided with what it decides now, ticks (T,) each."""
    tilt_rad = _angle_rad(was["setpoint_q_nb"], now["setpoint_q_nb"])
    was_01: NDArray[np.float32] = was["setpoint_thrust_01"]
    now_01: NDArray[np.float32] = now["setpoint_thrust_01"]
    thrust_01 = np.abs(was_01 - now_01)
    one_alone = np.isnan(was_01) != np.isnan(now_01)
    phases, plans = was["phase"] != now["phase"], was["plan_status"] != now["plan_status"]
    differ = phases | plans | one_alone | (tilt_rad > DIFFERS_RAD) | (thrust_01 > DIFFERS_01)
    return Decisions(
        agent=agent,
        compared=len(was),
        phases_differ=int(phases.sum()),
        plans_differ=int(plans.sum()),
        tilt_rad=_percentiles(tilt_rad),
        thrust_01=_percentiles(thrust_01),
        differences=[_difference(was, now, tilt_rad, thrust_01, stretch) for stretch in _stretches(was, differ)],
    )


def _stretches(rows: NDArray[np.void], differ: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the ticks that differ, those that are close in time together."""
    found = np.flatnonzero(differ)
    apart = np.flatnonzero(np.diff(rows["t_us"][found]) > _MERGE_S * 1e6) + 1
    return [part for part in np.split(found, apart) if len(part)]


def _difference(
    was: NDArray[np.void], now: NDArray[np.void], tilt_rad: Array, thrust_01: Array, ticks: NDArray[np.intp]
) -> Difference:
    first, last = ticks[0], ticks[-1]
    since_s = (was["t_us"][[first, last]] - was["t_us"][0]) * 1e-6
    return Difference(
        from_s=float(since_s[0]),
        to_s=float(since_s[1]),
        ticks=len(ticks),
        tilt_rad=_largest(tilt_rad[ticks]),
        thrust_01=_largest(thrust_01[ticks]),
        was=_words(was[first]),
        now=_words(now[first]),
    )


def _words(row: NDArray[np.void]) -> str:
    sent = "" if np.isfinite(row["setpoint_thrust_01"]) else ", no setpoint"
    return f"{Phase(int(row['phase'])).name}, plan {PlanStatus(int(row['plan_status'])).name}{sent}"


def _angle_rad(a: NDArray[np.floating], b: NDArray[np.floating]) -> Array:
    """Return the angles (T,) between quaternions (T, 4); NaN where one of both is."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))  # q and -q are one attitude
    angles: Array = 4.0 * np.arcsin(np.minimum(0.5 * apart, 1.0))
    return angles


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else 0.0


def _percentiles(values: Array) -> dict[str, float]:
    known = values[np.isfinite(values)]
    p50, p99 = np.percentile(known, [50, 99]) if len(known) else (0.0, 0.0)
    return {"p50": float(p50), "p99": float(p99), "max": _largest(values)}
