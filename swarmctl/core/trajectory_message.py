"""The message by which agents exchange commitments; the rules are in `swarmctl.control.commit.protocol`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from swarmctl.core.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Holds a trajectory to which an agent wants to commit."""

    number: int  # increasing, 64 bit; never reused, not even after a restart
    made_utc_us: int
    agent: int
    trajectory: Trajectory
    asks_far: bool = False  # whether the acknowledgements of those that are far are required, too

    @property
    def order(self) -> tuple[int, int]:
        """Return the sort key by which earlier proposals have priority."""
        return self.made_utc_us, self.agent


@dataclass(frozen=True, slots=True, kw_only=True)
class Exclusions:
    """Holds what an agent publishes about silent peers; the rules are in `swarmctl.control.commit.membership`."""

    suspected: frozenset[int] = frozenset()  # not heard for long
    promised: frozenset[int] = frozenset()  # to be excluded; they get no acknowledgement any more


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """Holds how far an agent may get unseen by those it is far from; the rules are in `swarmctl.control.commit.reach`.

    Args:
        far: peers whose acknowledgement it may do without.
        speed_m_s: bound of the speed of what it commits to.
        stretch_m: bound of the way from where it is to the end of that.
    """

    far: frozenset[int] = frozenset()
    speed_m_s: float = math.inf
    stretch_m: float = math.inf


ANYWHERE = Reach()  # of an agent that requires the acknowledgements of all others


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryMessage:
    """Holds the committed trajectory, proposal and acknowledgements of one agent."""

    agent: int
    boot_id: int
    seq: int
    sent_utc_us: int
    is_committed: bool  # the agent follows `committed`; otherwise a pilot or the autopilot flies
    committed: Trajectory
    tube_m: float  # bound within which the vehicle is flown around `committed`, or around `proposal` once that is
    proposal: Proposal | None
    acknowledged: Mapping[int, int]  # by peer: number of the proposal in its newest message
    exclusions: Exclusions
    heard: Mapping[int, tuple[int, int]]  # by peer: stamp of its newest message, and when that arrived by the own clock
    reach: Reach = ANYWHERE

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Return the committed trajectory, and the proposed one if there is one."""
        return (self.committed,) if self.proposal is None else (self.committed, self.proposal.trajectory)

    @property
    def followed(self) -> tuple[Trajectory, ...]:
        """Return the trajectories that the agent may follow from now on."""
        return self.trajectories if self.is_committed else self.trajectories[1:]
