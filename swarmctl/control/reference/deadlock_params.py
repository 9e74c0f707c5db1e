"""Parameters of deadlock recovery."""

from __future__ import annotations

from pydantic import Field

from swarmctl.core.params import Params


class DeadlockParams(Params):
    """Sets when an agent counts as deadlocked, and how it recovers."""

    enabled: bool = True  # false: deadlocks are only reported
    behind_m: float = Field(0.2, gt=0, le=100)  # an agent nearer to its reference has arrived
    moved_m: float = Field(0.2, gt=0, le=10)  # an agent that moves less in `patience_s` makes no progress
    patience_s: float = Field(1.5, gt=0.1, le=60)  # time without progress after which an agent counts as deadlocked
    near_m: float = Field(0.4, gt=0, le=10)  # beyond the distance to keep; nearer keep-outs can block
    speed_m_s: float = Field(1.0, gt=0, le=20)  # speed along the way round what blocks it
