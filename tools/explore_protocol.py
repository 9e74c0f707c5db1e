"""Explores the protocol of guaranteed separation exhaustively among three agents, and with each rule removed.

    python tools/explore_protocol.py --depth 6

Every order and fate of messages is explored, with the code that flies and symbols in place of trajectories. The first
table has the rules as they are: no two commitments may conflict. The second has one rule less in each row, and the
first conflict there is; the last of these rules is not needed for that. Ends with 1 unless that is what was found.
"""

from __future__ import annotations

import argparse
import sys
import time

from rich.console import Console
from rich.table import Table

from sitl.studies.protocol.explorer import Explored, Explorer
from sitl.studies.protocol.removed_rules import REMOVED
from sitl.studies.protocol.scopes import SCOPES

_UNTIL_FOUND = 99


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depth", type=int, default=6, help="ticks of agents, one after another (default: 6)")
    parser.add_argument("--max-states", type=int, default=100_000, help="of each scope (default: 100000)")
    parser.add_argument("--scope", choices=sorted(SCOPES), help="only this one (default: all)")
    parser.add_argument("--no-removed", action="store_true", help="leave out the second table")
    arguments = parser.parse_args()
    console = Console()
    names = [arguments.scope] if arguments.scope else list(SCOPES)
    kept = _table("the rules as they are", "scope")
    conflicts = [_row(kept, name, Explorer(SCOPES[name]), arguments.depth, arguments.max_states) for name in names]
    console.print(kept)
    as_expected = not any(conflicts)
    if not arguments.no_removed:
        without = _table("without one rule", "rule left out")
        for each in REMOVED:
            bounds = (_UNTIL_FOUND,) if each.is_needed else (arguments.depth, arguments.max_states)
            conflict = _row(without, each.rule, Explorer(each.scope, each.rules), *bounds)
            as_expected &= bool(conflict) is each.is_needed
        console.print(without)
    return int(not as_expected)


def _table(title: str, what: str) -> Table:
    return Table(what, "states", "depth", "complete", "time [s]", "conflict", title=title)


def _row(
    table: Table, name: str, explorer: Explorer, depth: int = _UNTIL_FOUND, max_states: int = 10**9
) -> tuple[str, ...]:
    """Add what was found, and return the conflict."""
    began_s = time.perf_counter()
    found: Explored = explorer.explore(depth, max_states)
    took_s = time.perf_counter() - began_s
    story = "; ".join(found.violation) or "none"
    complete = "yes" if found.is_complete else "no"
    table.add_row(name, f"{found.states:,}", str(found.depth), complete, f"{took_s:.1f}", story)
    return found.violation


if __name__ == "__main__":
    sys.exit(main())
