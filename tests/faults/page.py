"""The page of the matrix: what is printed by `python -m tests.faults --page`."""

from __future__ import annotations

from collections.abc import Iterator

from tests.faults.elsewhere import ElsewhereRow
from tests.faults.launched import LaunchedRow
from tests.faults.matrix import PARTS, ROWS
from tests.faults.row import Row

PAGE = "docs/faults.md"
_KINDS = {ElsewhereRow: "test", LaunchedRow: "processes"}
_HEAD = """# Fault matrix

What may fail, what the swarm does then and how soon, and the protection without which that row fails. The rows are in
`tests/faults/`, and this page is written from them (`--page`). The hazards behind them are in the [safety
case](safety_case.md).

`python -m tests.faults` plays every row, as root, because some fill a disk of their own; `--off` plays each without its
protection, which must fail, `--only 'clock*'` some of them, and `--plays 10` all of them ten times.

In every row, by true states, two vehicles stay 0.8 m apart (or what the row says), none that was disarmed is armed
again, and none that its autopilot or a pilot has taken follows setpoints again unasked; no process, socket or note is
left, and the run folder can be read. Rows are flown in lockstep, are launches of real *processes*, or are a *test* of
`tests/` whose negative control is the row without its protection. The tests play a sample. Networks of several hosts
are flown by `tools/hosts_flight.py` ([hosts](hosts.md)), stops in every phase by `tools/stop_matrix.py`.
"""


def page() -> str:
    """Return the page."""
    return "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    yield _HEAD.rstrip("\n")
    yield ""
    yield f"{len(ROWS)} rows."
    for title, rows in PARTS:
        yield from ("", f"## {title}", "")
        yield "| row | event | reaction | within | protection |"
        yield "|---|---|---|---|---|"
        yield from map(_line, rows)


def _line(row: Row) -> str:
    kind = _KINDS.get(type(row))
    name = f"{row.name} ({kind})" if kind else row.name
    return f"| {name} | {row.event} | {row.reaction} | {row.within_s:g} s | {row.protection} |"
