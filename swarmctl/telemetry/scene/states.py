"""States of agents: bars of phase, mode and plan, lines of the event view, and the table of the newest values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmctl.core.types import Mode, Phase, PlanStatus
from swarmctl.telemetry.palette import MODE_RGB, PHASE_RGB, PLAN_RGB
from swarmctl.telemetry.scene.stream import Stream, Times

KINDS: Mapping[str, tuple[str, Any, Mapping[str, tuple[int, int, int]]]] = {  # of a bar: field, enumeration, colours
    "phase": ("phase", Phase, PHASE_RGB),
    "mode": ("mode", Mode, MODE_RGB),
    "plan": ("plan_status", PlanStatus, PLAN_RGB),
}
TABLE = "status"  # entity of the table
_REPEAT_US = 2_000_000  # period of repeated states, because the server's buffer drops rare data first
_PROBLEMS = {
    PlanStatus.SOLVER_FAILED: "solver failed",
    PlanStatus.RESIDUAL: "residual too large",
    PlanStatus.NOT_CERTIFIED: "plan would violate true distances",
}
_WARN_MODES = (Mode.REPLAY, Mode.BRAKE, Mode.PILOT_OVERRIDE)


class States:
    """Sends changes of state of one agent, and its bars also every two seconds."""

    def __init__(self, stream: Stream, agent: int) -> None:
        self._stream, self._agent = stream, agent
        self._before: Any = None  # newest row, of TICK_DTYPE
        self._sent_us: int | None = None
        for kind, (_, _, colors) in KINDS.items():
            stream.static(f"state/{agent}/{kind}", _state_style(colors))

    def take(self, t_us: Times, rows: NDArray[np.void]) -> None:
        """Send what has changed in rows (T,) at times `t_us` (T,)."""
        repeat = self._sent_us is None or t_us[-1] - self._sent_us >= _REPEAT_US
        if repeat:
            self._sent_us = int(t_us[-1])
        for kind, (field, enum, _) in KINDS.items():
            changed = _changes(rows[field], -1 if self._before is None else int(self._before[field]))
            picked = sorted({*changed, *([len(rows) - 1] if repeat else [])})
            names = [_name(enum, int(rows[field][k])) for k in picked]
            self._stream.states(f"state/{self._agent}/{kind}", t_us[picked], names)
        lines = sorted(self._lines(rows))
        self._stream.lines(
            f"agent-{self._agent}", t_us[[k for k, _, _ in lines]], [(level, text) for _, level, text in lines]
        )
        self._before = rows[-1]

    def _lines(self, rows: NDArray[np.void]) -> Iterator[tuple[int, str, str]]:
        """Yield (row, log level, text) of every change."""
        for kind, (field, enum, _) in KINDS.items():
            values = rows[field]
            for k in _changes(values, int(values[0] if self._before is None else self._before[field])):
                value = int(values[k])
                if kind != "plan":
                    yield k, _level(kind, value), f"{kind} {_name(enum, value)}"
                elif value in _PROBLEMS:
                    yield k, "WARN", f"plan refused: {_PROBLEMS[PlanStatus(value)]}"


def status_table(newest: Mapping[int, Any]) -> rr.TextDocument:
    """Return a table with the newest tick of each agent, rows of `TICK_DTYPE`."""
    head = "| agent | phase | mode | plan | height m | m/s | battery | nearest m | stale ms | misses |"
    lines = [head, "|" + "--:|" + ":--|" * 3 + "--:|" * 6]
    for agent, row in sorted(newest.items()):
        speed_m_s = float(np.linalg.norm(row["vel_ned_m_s"]))
        cells = [f"**{agent}**", *(_name(enum, int(row[field])) for field, enum, _ in KINDS.values())]
        cells += [_number(-row["pos_ned_m"][2], 1), _number(speed_m_s, 1), _number(100 * row["battery_01"], 0, " %")]
        cells += [_number(row["nearest_peer_m"], 2), _number(row["plan_staleness_ms"], 0)]
        lines.append(f"| {' | '.join(cells)} | {row['deadline_misses']} |")
    return rr.TextDocument("\n".join(lines) + "\n", media_type="text/markdown")


def _changes(values: NDArray[Any], before: int) -> list[int]:
    """Return the indices of values (T,) that differ from the one before."""
    changed: list[int] = np.flatnonzero(np.diff(values.astype(int), prepend=before)).tolist()
    return changed


def _level(kind: str, value: int) -> str:
    if kind == "mode" and value == Mode.STATE_STALE:
        return "ERROR"
    return "WARN" if kind == "mode" and value in _WARN_MODES else "INFO"


def _name(enum: Any, value: int) -> str:
    return str(enum(value).name) if value in list(enum) else str(value)


def _number(value: float, digits: int, unit: str = "") -> str:
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "-"


def _state_style(colors: Mapping[str, tuple[int, int, int]]) -> Any:
    packed = np.array([(r << 24) | (g << 16) | (b << 8) | 0xFF for r, g, b in colors.values()], np.uint32)
    return rr.StateConfiguration(values=list(colors), labels=list(colors), colors=packed)
