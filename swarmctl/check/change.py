"""Parameter changes of `swarmctl check --apply`, and their results."""

from __future__ import annotations

import math
from dataclasses import dataclass

from swarmctl.check.finding import Finding
from swarmctl.check.parameters import Number
from swarmctl.core.verdict import Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """One parameter that was to be changed."""

    agent: int
    name: str
    before: Number
    wanted: Number
    after: Number | None  # value read back
    refused: str  # why the change was not tried, or ""

    @property
    def done(self) -> bool:
        return self.after is not None and math.isclose(self.after, self.wanted, rel_tol=1e-6, abs_tol=1e-9)

    def in_words(self) -> str:
        """Return the values before and after as text."""
        if self.done:
            return f"{self.name}: {self.before:g} -> {self.after:g}"
        return f"{self.name}: {self.before:g}, not changed to {self.wanted:g} ({self._why()})"

    def finding(self) -> Finding:
        """Return the finding for a change that was not made."""
        found = "not told" if self.after is None else f"{self.after:g}"
        advice = f"--apply did not set it: {self._why()}"
        return Finding(
            agent=self.agent,
            topic=f"apply {self.name}",
            verdict=Verdict.FIX,
            found=found,
            wanted=f"{self.wanted:g}",
            advice=advice,
            weight=98,
        )

    def _why(self) -> str:
        return self.refused or "the autopilot kept its own value"
