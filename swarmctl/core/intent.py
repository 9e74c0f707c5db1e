"""What agents tell each other of their intentions; the rules are in `swarmctl.control.commit`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from swarmctl.core.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Proposal:
    """What an agent would like to follow."""

    number: int  # counts up
    made_utc_us: int
    agent: int
    trajectory: Trajectory

    @property
    def order(self) -> tuple[int, int]:
        """Earlier ones go first."""
        return self.made_utc_us, self.agent


@dataclass(frozen=True, slots=True)
class Intent:
    """All that an agent says of its intentions."""

    agent: int
    boot_id: int
    seq: int
    promised: bool  # it follows what it has committed to; otherwise somebody else flies it
    committed: Trajectory
    proposal: Proposal | None
    heard: Mapping[int, int]  # newest proposal number taken in of each peer
