"""Reads and validates `summary.json`, as far as the report needs it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

Outcome = Literal["completed", "failed", "interrupted"]
_Figure = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]  # range that can be printed and drawn
_Square = Annotated[float, msgspec.Meta(ge=0.0, le=1e18)]  # of a figure
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]


class _Percentiles(msgspec.Struct):
    p50: _Figure | None = None
    p99: _Figure | None = None
    max: _Figure | None = None


class _Tracked(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1000)]
    mse_m2: list[_Square | None]
    mean_distance_m: _Figure | None = None
    rmse_m: _Figure | None = None
    steady_rmse_m: _Figure | None = None


class _Tracking(msgspec.Struct):
    agents: list[_Tracked]
    index_m: _Figure | None = None
    index_after_10s_m: _Figure | None = None


class _Separation(msgspec.Struct):
    required_m: _Figure
    min_m: _Figure | None = None


class _Obstacles(msgspec.Struct):
    min_clearance_m: _Figure | None = None
    required_m: _Figure | None = None


class _WorstAgent(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1000)]
    due_ticks: _Count
    late_ticks: _Count


class _Timing(msgspec.Struct):
    ticks: _Count
    late_ticks: _Count
    tick_ms: _Percentiles
    solve_ms: _Percentiles
    speed_factor: _Figure | None = None
    due_ticks: _Count = 0  # missing in older folders, as is the next
    worst_agent: _WorstAgent | None = None


class _Solver(msgspec.Struct):
    name: str
    failed: _Count
    not_certified: _Count
    max_residual_m: _Figure | None = None
    safety_filter_ticks: _Count = 0
    retry: str = ""  # missing in older folders


class _Unresponsive(msgspec.Struct):
    count: _Count = 0
    longest_s: _Figure | None = None
    agent: Annotated[int, msgspec.Meta(ge=0, lt=1000)] | None = None


class _Comms(msgspec.Struct):
    path_age_ms: _Percentiles
    rejected: dict[str, _Count]
    unresponsive: _Unresponsive | None = None  # missing in older folders


class _Deadlocks(msgspec.Struct):
    count: _Count = 0
    longest_s: _Figure | None = None
    unresolved: _Count = 0


class _AtGoal(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1000)]
    reached_at_s: _Figure | None = None
    left_m: _Figure | None = None


class _Goals(msgspec.Struct):
    reached: _Count
    of: _Count
    agents: list[_AtGoal]


class _OwnController(msgspec.Struct):
    name: str
    flown_ticks: _Count
    mission_ticks: _Count


class _Clock(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1000)]
    ahead_s: Annotated[float, msgspec.Meta(ge=-1e14, le=1e14)] | None = None  # also of one that begins in 1970


class _SeenLate(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1000)]
    phase: str
    from_s: _Figure | None = None


class _Summary(msgspec.Struct):
    outcome: Outcome
    violations: list[str]
    agents: _Count
    mode: str
    separation: _Separation
    obstacles: _Obstacles
    timing: _Timing
    tracking: _Tracking
    solver: _Solver
    comms: _Comms
    duration_s: _Figure | None = None
    version: str = ""  # missing in older folders, as are the next
    deadlocks: _Deadlocks = msgspec.field(default_factory=_Deadlocks)
    goals: _Goals | None = None
    own_controllers: list[_OwnController] = []
    clocks: list[_Clock] | None = None
    seen_late: list[_SeenLate] | None = None


def decode_summary(content: bytes) -> dict[str, Any]:
    """Return the part of a summary that the report needs.

    Raises:
        ValueError: it is not JSON, or a key is missing or has another type; the text says which.
    """
    try:
        summary: dict[str, Any] = msgspec.to_builtins(msgspec.json.decode(content, type=_Summary))
    except msgspec.MsgspecError as error:
        raise ValueError(str(error)) from error
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    return summary
