"""Findings of a check: one line each with the found value, the wanted value and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from swarmctl.core.verdict import Verdict

SWARM = -1  # agent of a finding about all vehicles together
COMPUTER = -2  # of one about the computer that the check runs on


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One line of a check."""

    agent: int  # agent id, SWARM or COMPUTER
    topic: str
    verdict: Verdict
    found: str
    wanted: str = ""
    advice: str = ""  # what it means and what to do; never empty unless the verdict is OK
    weight: int = 0  # orders findings of the same verdict; the heaviest is the worst


def worst_first(found: Iterable[Finding]) -> list[Finding]:
    """Return all findings that are not OK, the worst first."""
    open_ones = [finding for finding in found if finding.verdict is not Verdict.OK]
    return sorted(open_ones, key=lambda f: (-f.verdict, -f.weight, f.agent))


class Line(Protocol):
    """Makes the finding of one row, whose topic and wanted value are given."""

    def __call__(self, verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding: ...


def line_of(agent: int, topic: str, wanted: str = "") -> Line:
    """Return what makes the finding of a row that tells one of several things."""

    def line(verdict: Verdict, found: str, advice: str = "", weight: int = 0) -> Finding:
        return Finding(
            agent=agent, topic=topic, verdict=verdict, found=found, wanted=wanted, advice=advice, weight=weight
        )

    return line
