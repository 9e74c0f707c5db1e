"""One line of a check: what was found, what is wanted, and what to do about it."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass

SWARM = -1  # a finding about all vehicles together


class Verdict(enum.IntEnum):
    """How a line is judged; the largest of all lines is that of the check."""

    OK = 0
    NOTE = 1  # worth knowing; flies
    FIX = 2  # does not fly, or not safely


@dataclass(frozen=True, slots=True)
class Finding:
    """One line."""

    agent: int  # or SWARM
    topic: str
    verdict: Verdict
    found: str
    wanted: str = ""
    advice: str = ""  # what it means and what to do; always there unless the verdict is OK
    weight: int = 0  # of those with the same verdict the heaviest is the worst


def worst_first(found: Iterable[Finding]) -> list[Finding]:
    """All that are not OK, the worst first."""
    open_ones = [finding for finding in found if finding.verdict is not Verdict.OK]
    return sorted(open_ones, key=lambda f: (-f.verdict, -f.weight, f.agent))
