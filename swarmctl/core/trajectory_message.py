"""What agents tell each other of their intentions; the rules are in `swarmctl.control.commit.protocol`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from swarmctl.core.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Proposal:
    """What an agent would like to follow."""

    number: int  # counts up, 64 bit: never used again, not after a restart either
    made_utc_us: int
    agent: int
    trajectory: Trajectory

    @property
    def order(self) -> tuple[int, int]:
        """Earlier ones go first."""
        return self.made_utc_us, self.agent


@dataclass(frozen=True, slots=True)
class TrajectoryMessage:
    """All that an agent says of its intentions."""

    agent: int
    boot_id: int
    seq: int
    sent_utc_us: int
    is_committed: bool  # it follows what it has committed to; otherwise somebody else flies it
    committed: Trajectory
    proposal: Proposal | None
    acknowledged: Mapping[int, int]  # number of the proposal in the newest message taken in of each peer

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All that it speaks of."""
        return (self.committed,) if self.proposal is None else (self.committed, self.proposal.trajectory)

    @property
    def followed(self) -> tuple[Trajectory, ...]:
        """What the agent may follow from now on."""
        return self.trajectories if self.is_committed else self.trajectories[1:]
