"""Output of a check: a table with a block per vehicle, a list of what to fix with the worst first, and JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from functools import partial

from rich.console import Console
from rich.table import Table
from rich.text import Text

from swarmctl.bus.bus import agent_name
from swarmctl.check.change import Change
from swarmctl.check.finding import COMPUTER, SWARM, Finding, worst_first
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.core.json_safe import json_safe
from swarmctl.core.text import printable
from swarmctl.core.verdict import Verdict

_LINE = 2000  # characters of one line of the list
_COLUMNS = ("vehicle", "what", "found", "wanted", "verdict")
_NO_VEHICLES = {SWARM: "swarm", COMPUTER: "computer"}
_STYLES = {Verdict.OK: "green", Verdict.NOTE: "yellow", Verdict.FIX: "bold red"}


def print_check(vehicles: Sequence[VehicleFacts], lines: Sequence[Finding], changes: Sequence[Change]) -> None:
    """Print to standard output: a drawn table on a terminal, tab-separated lines elsewhere."""
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(_drawn(lines))
    else:
        print("\t".join(_COLUMNS))
        for line in lines:
            print("\t".join(_cells(line)))
    for text in _after_table(vehicles, lines, changes):
        console.print(printable(text, _LINE), markup=False, soft_wrap=True)


def as_json(vehicles: Sequence[VehicleFacts], lines: Sequence[Finding], changes: Sequence[Change], code: int) -> str:
    """Return everything as JSON, findings in the order of the table."""
    as_named = partial(json_safe, enums_by_name=True)
    tree = {
        "exit_code": code,
        "vehicles": [as_named(dataclasses.asdict(v)) for v in vehicles],
        "findings": [as_named(dataclasses.asdict(line)) for line in lines],
        "changes": [as_named({**dataclasses.asdict(c), "done": c.done}) for c in changes],
    }
    return json.dumps(tree, indent=1, allow_nan=False) + "\n"


def _drawn(lines: Sequence[Finding]) -> Table:
    """Return a table with a section for each vehicle, and one for what is the same of several of them."""
    vehicles = {line.agent for line in lines} - _NO_VEHICLES.keys()
    alike: dict[tuple[str, ...], list[int]] = {}
    for line in lines:
        alike.setdefault(_cells(line)[1:], []).append(line.agent)
    sections: dict[str, dict[tuple[str, ...], Verdict]] = {}
    for line in lines:
        cells = _cells(line)[1:]
        who = alike[cells]
        name = "all" if len(who) > 1 and set(who) == vehicles else ", ".join(map(_who, who))
        sections.setdefault(name, {})[cells] = line.verdict
    table = Table(*_COLUMNS)
    for name, rows in sections.items():
        for number, ((*middle, verdict), judged) in enumerate(rows.items()):
            first = Text("" if number else name)  # not markup: a vehicle's text may contain "[...]"
            table.add_row(first, *map(Text, middle), Text(verdict, style=_STYLES[judged]))
        table.add_section()
    return table


def _cells(line: Finding) -> tuple[str, ...]:
    words = (line.topic, line.found, line.wanted, line.verdict.name.lower())
    return _who(line.agent), *(printable(word) for word in words)


def _who(agent: int) -> str:
    return _NO_VEHICLES.get(agent) or agent_name(agent)


def _after_table(
    vehicles: Sequence[VehicleFacts],
    lines: Sequence[Finding],
    changes: Sequence[Change],
) -> list[str]:
    texts = [f"{agent_name(change.agent)} {change.in_words()}" for change in changes]
    found = worst_first(lines)
    alike: dict[tuple[Verdict, str], list[str]] = {}  # one text with the names of all vehicles it applies to
    for line in found:
        said = f"{line.topic}: {line.found}. {line.advice}"
        alike.setdefault((line.verdict, said), []).append(_who(line.agent))
    texts += [f"{verdict.name.lower():4} {', '.join(who)} {said}" for (verdict, said), who in alike.items()]
    to_fix = sum(line.verdict is Verdict.FIX for line in found)
    reached = sum(v.reached for v in vehicles)
    rest = f"{to_fix} to fix" if to_fix else "nothing to fix"
    texts.append(f"{reached} of {len(vehicles)} vehicles reached, {rest}, {len(found) - to_fix} to know")
    return texts
