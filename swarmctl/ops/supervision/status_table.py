"""Status display of a launch: a live table on a terminal, one line per change elsewhere.

The table fits 80 columns and 24 lines: a row of short cells for each agent, and below them the alerts, in whole words.
A wider terminal has more columns. Where it has too few lines, those agents have rows that need somebody.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.core.text import printable
from swarmctl.core.types import ControlMode, FlightMode, Phase
from swarmctl.telemetry.recording.event_log import EventLog

REFRESH_HZ = 4.0
_LINE = 2000  # longest printed line
_AROUND_ROWS = 5  # lines of a terminal: title, head, and what a live table leaves free
_OF_ALERTS = 4  # part of the lines that rows leave to alerts
_WIDE = 117  # columns of a terminal that has room for everything
_SILENT_S = 2.0  # without a status for so long an agent is lost to the operator
_OPERATORS_MATTER = ("HOLD", "GOTO", "WAIT", "PILOT", "FAILSAFE", "LOST")  # whose beginning and end are lines
_WAITS = "waits for "  # begins an alert on the ground, or before the mission
_NOW = re.compile(r" \(now [^)]*\)")  # the present figure in it, which changes all the time
_FIX = {0: "no", 1: "no", 2: "2D", 3: "3D", 4: "DGPS", 5: "float", 6: "RTK"}  # GPS_FIX_TYPE


@dataclass(slots=True, kw_only=True)
class AgentView:
    """The launcher's view of one agent."""

    agent: int
    status: StatusMessage | None = None
    received_s: float = 0.0  # arrival of `status`, monotonic
    note: str = ""  # the launcher's own observation: how it ended, that it is silent

    @property
    def silent_s(self) -> float:
        """Return for how long no status has arrived; 0 where arrivals are not noted."""
        return max(0.0, time.monotonic() - self.received_s) if self.received_s else 0.0

    @property
    def control(self) -> str:
        """Return what the vehicle is doing, as far as is known."""
        if self.status is None:
            return ""
        lost = self.silent_s > _SILENT_S and self.status.phase != Phase.DONE  # what is done may end
        return ControlMode.LOST.name if lost else printable(self.status.control, 8)

    @property
    def alert(self) -> str:
        """Return the launcher's note, or the agent's active alert and since when."""
        if self.note or self.status is None:
            return printable(self.note) or "no status yet"
        age = f" ({self.status.alert_age_s:.0f} s)" if self.status.alert_age_s >= 0.0 else ""
        return f"{printable(self.status.active_alert)}{age}" if self.status.active_alert else ""


class Display(Protocol):
    """Output of a launch."""

    def print_line(self, text: str) -> None:
        """Print one line that stays."""

    def show(self, agents: Sequence[AgentView]) -> None:
        """Show the present state; cheap to call often."""

    def close(self) -> None:
        """Leave the last state on the screen."""


def tell(log: EventLog, display: Display, event: str, text: str, **fields: Any) -> None:
    """Record an event, and show its text."""
    log.write(event, text=text, **fields)
    display.print_line(text)


def open_display(stream: TextIO | None = None, run: str = "") -> Display:
    """Return a live table of a run when `stream` (default: standard output) is a terminal, plain lines otherwise."""
    console = Console(file=stream or sys.stdout, highlight=False)
    return LiveTable(console, run) if console.is_terminal else PlainLines(stream or sys.stdout)


class LiveTable:
    """Redraws a table in place and prints lines above it. A lost terminal does not stop the flight."""

    def __init__(self, console: Console, run: str = "") -> None:
        self._console, self._run = console, run
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
            self._live.update(status_table(agents, *self._console.size, run=self._run), refresh=True)

    def close(self) -> None:
        live, self._live = self._live, None
        with contextlib.suppress(OSError):
            if live is not None:
                live.stop()


class PlainLines:
    """Prints a line when an agent's phase, what it waits for, a hold or the launcher's note on it changes, for logs."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._started_s = time.monotonic()
        self._last: dict[int, tuple[str, str, str]] = {}
        self._waited: dict[int, str] = {}  # for what, without present figures, by agent

    def print_line(self, text: str) -> None:
        with contextlib.suppress(OSError):  # the pipe is closed; the flight goes on
            print(printable(text, _LINE), file=self._stream, flush=True)

    def show(self, agents: Sequence[AgentView]) -> None:
        for view in agents:
            phase = "" if view.status is None else name_of(Phase, view.status.phase)
            control = view.control if view.control in _OPERATORS_MATTER and not view.note else ""
            alert = view.note or (view.status.active_alert if view.status else "")
            what = _NOW.sub("", alert)
            waits = alert.startswith(_WAITS) and what != self._waited.get(view.agent)
            if not waits and (phase, control, view.note) == self._last.get(view.agent, ("", "", "")):
                continue
            self._last[view.agent] = (phase, control, view.note)
            self._waited |= {view.agent: what} if waits else {}
            elapsed_s = time.monotonic() - self._started_s
            words = "  ".join(word for word in (agent_name(view.agent), phase, control, alert) if word)
            self.print_line(f"{elapsed_s:7.1f} s  {words}")

    def close(self) -> None:
        return


def print_statuses(agents: Sequence[AgentView], run: str = "") -> None:
    """Print the statuses of a run once: a table on a terminal, one line per agent elsewhere."""
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(status_table(agents, console.width, run=run))
        return
    print("\t".join([*(f"{column.title} {column.unit}".rstrip() for column in COLUMNS), "alert"]))
    for view in agents:
        print("\t".join(status_cells(view)))


def headline(agents: Sequence[AgentView]) -> str:
    """Return the mission clock, and what ends when."""
    known = [view.status for view in agents if view.status is not None]
    phases, numbers = [status.phase for status in known], [status.agent for status in known if status.held]
    ends_s = [status.ends_in_s for status in known if status.ends_in_s >= 0.0]
    held = f"; without an end: {', '.join(map(str, numbers))} (held)" if numbers else ""
    if not known:
        return "no status yet"
    if Phase.TRACK in phases:
        clock_s = max(status.mission_t_s for status in known)
        return f"mission {clock_s:.0f} s" + (f", ends in {max(ends_s):.0f} s" if ends_s else "") + held
    if min(phases) < Phase.TRACK:
        waits = f"mission not begun, {phases.count(Phase.READY)} of {len(agents)} agents ready"
        return waits + (f", given up in {min(ends_s):.0f} s" if ends_s else "") + held
    landing = f", latest landing in {max(ends_s):.0f} s" if ends_s else ""
    return ("mission over" if min(phases) == Phase.DONE else f"mission over, landing{landing}") + held


def status_table(agents: Sequence[AgentView], width: int = 80, height: int | None = None, *, run: str = "") -> Group:
    """Return the mission clock, the table with one row per agent, and the alerts below it.

    Args:
        agents: what is known of each.
        width: columns of the terminal.
        height: its lines; None: as many as there are.
        run: name of the run, if it is to be shown.
    """
    columns = [column for column in COLUMNS if width >= _WIDE or not column.only_wide]
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in columns:
        table.add_column(f"{column.title}\n{column.unit}", justify=column.justify, min_width=column.width, no_wrap=True)
    shown, others = _chosen(agents, height)
    for view in shown:
        table.add_row(*(Text(column.cell_of(view)) for column in columns))  # not markup: agents' texts may have "[...]"
    room = None if height is None else max(1, height - len(shown) - bool(others) - _AROUND_ROWS)
    title = _one_line(": ".join(word for word in (run, headline(agents)) if word))
    rest = [_one_line(_summed_up(others))] if others else []
    return Group(title, table, *rest, *(Text(line) for line in _alert_lines(agents, width, room)))


def _chosen(agents: Sequence[AgentView], height: int | None) -> tuple[list[AgentView], list[AgentView]]:
    """Return the agents that have rows, and the others: where not all fit, those come first that need somebody."""
    if height is None:
        return list(agents), []
    most = max(1, height - _AROUND_ROWS - min(height // _OF_ALERTS, sum(bool(view.alert) for view in agents)))
    if len(agents) <= most:
        return list(agents), []
    first = sorted(agents, key=lambda view: not (view.alert or view.control in _OPERATORS_MATTER))
    return sorted(first[: most - 1], key=lambda view: view.agent), first[most - 1 :]


def _summed_up(agents: Sequence[AgentView]) -> str:
    """Return what agents without a row are doing."""
    doing = Counter(f"{name_of(Phase, view.status.phase)} {view.control}" for view in agents if view.status is not None)
    return f"{len(agents)} more: " + ", ".join(f"{count} {what}" for what, count in doing.most_common())


def _one_line(text: str) -> Text:
    return Text(text, no_wrap=True, overflow="ellipsis")


def _alert_lines(agents: Sequence[AgentView], width: int, room: int | None) -> list[str]:
    """Return the alerts, each in as many lines as it needs; those that do not fit are counted."""
    alerts = [(view.agent, view.alert) for view in agents if view.alert]
    lines: list[str] = []
    for shown, (agent, alert) in enumerate(alerts):
        more = textwrap.wrap(f"{agent:>2}: {alert}", max(8, width), subsequent_indent="    ")
        if room is not None and len(lines) + len(more) > room - (shown < len(alerts) - 1):
            return [*lines, f"{len(alerts) - shown} more alerts: swarmctl status"]
        lines += more
    return lines


def status_cells(view: AgentView) -> tuple[str, ...]:
    """Return the cells of one agent, in the order of `COLUMNS`, and its alert."""
    return (*(column.cell_of(view) for column in COLUMNS), view.alert)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """Describes one column: its title, its unit below, and its cell of an agent that has published a status."""

    title: str
    width: int  # at least, so that the live table does not jump
    cell: Callable[[AgentView, StatusMessage], str]
    unit: str = ""
    justify: Literal["left", "right"] = "right"
    only_wide: bool = False

    def cell_of(self, view: AgentView) -> str:
        """Return the cell of an agent; without a status only its number is known."""
        if view.status is None:
            return str(view.agent) if self.title == "id" else ""
        return self.cell(view, view.status)


COLUMNS = (
    Column(title="id", width=2, cell=lambda v, s: str(v.agent)),
    Column(title="phase", width=10, cell=lambda v, s: name_of(Phase, s.phase), justify="left"),
    Column(title="control", width=8, cell=lambda v, s: v.control, justify="left"),
    Column(title="flight", width=8, unit="mode", cell=lambda v, s: name_of(FlightMode, s.flight_mode), justify="left"),
    Column(title="arm", width=3, cell=lambda v, s: _armed(s), justify="left"),
    Column(title="alt", width=5, unit="m", cell=lambda v, s: _altitude(s)),
    Column(title="m/s", width=4, cell=lambda v, s: _number(s.ground_speed_m_s, 1, 4)),
    Column(title="bat", width=3, unit="%", cell=lambda v, s: _number(100.0 * s.battery_01, 0, 3)),
    Column(title="est", width=4, unit="m", cell=lambda v, s: _number(s.pos_accuracy_m, 2, 4)),
    Column(title="link", width=4, unit="s", cell=lambda v, s: _link(v, s)),
    Column(title="sep", width=5, unit="m", cell=lambda v, s: _number(s.separation_m, 2, 5)),
    Column(title="error", width=5, unit="m", cell=lambda v, s: _number(s.position_error_m, 2, 5)),
    Column(title="miss", width=5, cell=lambda v, s: _number(s.deadline_misses, 0, 5)),
    Column(title="ticks", width=7, cell=lambda v, s: _number(s.ticks, 0, 7), only_wide=True),
    Column(title="p99", width=5, unit="ms", cell=lambda v, s: _number(s.tick_p99_ms, 1, 5), only_wide=True),
    Column(
        title="stale",
        width=5,
        unit="ms",
        cell=lambda v, s: _number(s.plan_staleness_ms, 0, 5),
        only_wide=True,
    ),
    Column(title="clock", width=5, unit="s", cell=lambda v, s: _number(s.mission_t_s, 0, 5), only_wide=True),
    Column(title="ends", width=5, unit="s", cell=lambda v, s: _number(s.ends_in_s, 0, 5), only_wide=True),
    Column(title="gps", width=7, unit="sat", cell=lambda v, s: _gps(s), justify="left", only_wide=True),
)


def _armed(status: StatusMessage) -> str:
    """Return whether it is armed; a vehicle that was not heard has not told."""
    return "-" if status.flight_mode == FlightMode.UNKNOWN else "yes" if status.armed else "no"


def _altitude(status: StatusMessage) -> str:
    return "-" if status.ground_speed_m_s < 0 else _fits(status.altitude_m, 1, 5)


def _link(view: AgentView, status: StatusMessage) -> str:
    """Return the age of what is known of the vehicle [s]: of its newest message, and of the status that told it."""
    return "-" if status.link_age_ms < 0 else _number(status.link_age_ms * 1e-3 + view.silent_s, 1, 4)


def _gps(status: StatusMessage) -> str:
    if status.gps_fix < 0:
        return "-"
    satellites = f" {status.satellites}" if status.satellites >= 0 else ""
    return f"{_FIX.get(status.gps_fix, '3D')}{satellites}"


def name_of(kind: type[Phase] | type[FlightMode], number: int) -> str:
    """Return the name of an enum value from the bus; an unknown one as a number."""
    try:
        return kind(number).name
    except ValueError:
        return str(number)


def _number(value: float, digits: int, width: int) -> str:
    """Format a quantity that can't be negative; a negative value means that there is none."""
    return "-" if not math.isfinite(value) or value < 0 else _fits(value, digits, width)


def _fits(value: float, digits: int, width: int) -> str:
    """Format a number with as many digits as fit into `width` characters, never with a cut one, nor as -0."""
    texts = (f"{value:z.{places}f}" for places in range(digits, -1, -1))
    return next((text for text in texts if len(text) <= width), f"{value:.0e}")
