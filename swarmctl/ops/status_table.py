"""Status display of a launch: a live table on a terminal, one line per change of phase elsewhere."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from swarmctl.bus.json_messages import StatusMessage
from swarmctl.bus.peers import agent_name
from swarmctl.core.text import printable
from swarmctl.core.types import Mode, Phase

REFRESH_HZ = 4.0
_LINE = 2000  # longest printed line
_COLUMNS = ("agent", "phase", "mode", "error m", "separation m", "tick p99 ms", "missed", "staleness ms", "alert")


@dataclass(slots=True, kw_only=True)
class AgentView:
    """The launcher's view of one agent."""

    agent: int
    status: StatusMessage | None = None
    received_s: float = 0.0  # arrival of `status`, monotonic
    note: str = ""  # the launcher's own observation: how it ended, that it is silent


class Display(Protocol):
    """Output of a launch."""

    def print_line(self, text: str) -> None:
        """Print one line that stays."""

    def show(self, agents: Sequence[AgentView]) -> None:
        """Show the present state; cheap to call often."""

    def close(self) -> None:
        """Leave the last state on the screen."""


def open_display(stream: TextIO | None = None) -> Display:
    """Return a live table when `stream` (default: standard output) is a terminal, plain lines otherwise."""
    console = Console(file=stream or sys.stdout, highlight=False)
    return LiveTable(console) if console.is_terminal else PlainLines(stream or sys.stdout)


class LiveTable:
    """Redraws a table in place and prints lines above it. A lost terminal does not stop the flight."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: Live | None = None
        self._shown_s = 0.0

    def print_line(self, text: str) -> None:
        with contextlib.suppress(OSError):
            self._console.print(printable(text, _LINE), markup=False, soft_wrap=True)

    def show(self, agents: Sequence[AgentView]) -> None:
        now_s = time.monotonic()
        if now_s - self._shown_s < 1.0 / REFRESH_HZ:
            return
        self._shown_s = now_s
        with contextlib.suppress(OSError):
            if self._live is None:
                self._live = Live(console=self._console, auto_refresh=False)
                self._live.start()
            self._live.update(status_table(agents), refresh=True)

    def close(self) -> None:
        live, self._live = self._live, None
        with contextlib.suppress(OSError):
            if live is not None:
                live.stop()


class PlainLines:
    """Prints a line when an agent's phase or the launcher's note on it changes, for logs and pipes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._started_s = time.monotonic()
        self._last: dict[int, tuple[str, str]] = {}

    def print_line(self, text: str) -> None:
        with contextlib.suppress(OSError):  # the pipe is closed; the flight goes on
            print(printable(text, _LINE), file=self._stream, flush=True)

    def show(self, agents: Sequence[AgentView]) -> None:
        for view in agents:
            phase = "" if view.status is None else name_of(Phase, view.status.phase)
            if (phase, view.note) == self._last.get(view.agent, ("", "")):
                continue
            self._last[view.agent] = (phase, view.note)
            alert = view.note or (view.status.active_alert if view.status else "")
            elapsed_s = time.monotonic() - self._started_s
            self.print_line(f"{elapsed_s:7.1f} s  {agent_name(view.agent)}  {phase}{'  ' + alert if alert else ''}")

    def close(self) -> None:
        return


def print_statuses(agents: Sequence[AgentView]) -> None:
    """Print the statuses once: a table on a terminal, one line per agent elsewhere."""
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(status_table(agents))
        return
    for row in (_COLUMNS, *(status_cells(view) for view in agents)):
        print("\t".join(row))


def status_table(agents: Sequence[AgentView]) -> Table:
    """Return the table with one row per agent."""
    table = Table(*_COLUMNS)
    for view in agents:
        table.add_row(*map(Text, status_cells(view)))  # not markup: an agent's text may contain "[...]"
    return table


def status_cells(view: AgentView) -> tuple[str, ...]:
    """Return the cells of one agent, in the order of the columns."""
    status = view.status
    if status is None:
        return (agent_name(view.agent), *[""] * (len(_COLUMNS) - 2), printable(view.note) or "no status yet")
    return (
        agent_name(view.agent),
        name_of(Phase, status.phase),
        name_of(Mode, status.mode),
        _number(status.position_error_m, 3),
        _number(status.separation_m, 2),
        _number(status.tick_p99_ms, 1),
        f"{status.deadline_misses}/{status.ticks}",
        _number(status.plan_staleness_ms, 0),
        printable(view.note or status.active_alert),
    )


def name_of(kind: type[Phase] | type[Mode], number: int) -> str:
    """Return the name of an enum value from the bus; an unknown one as a number."""
    try:
        return kind(number).name
    except ValueError:
        return str(number)


def _number(value: float | None, digits: int) -> str:
    """Format a quantity that can't be negative; a negative value means that there is none."""
    return "-" if value is None or not math.isfinite(value) or value < 0 else f"{value:.{digits}f}"
