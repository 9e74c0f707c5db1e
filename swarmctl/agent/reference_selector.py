"""What an agent would like: to be where its mission has it, or on a way round what it is deadlocked by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from swarmctl.agent.setup import AgentSetup
from swarmctl.control.collision.separation import KeepOut
from swarmctl.control.commit.trajectory_planner import Wish
from swarmctl.control.phases.state_machine import MissionStateMachine
from swarmctl.control.reference.deadlock import Deadlock, Detour
from swarmctl.core.types import Array, Obstacle, Reference, Sampled


class ReferenceSelector:
    """See the module.

    Args:
        setup: of the agent.
        state_machine: knows the mission's reference.
        note: is reported `deadlock`, when one begins and when it is over.
    """

    def __init__(self, setup: AgentSetup, state_machine: MissionStateMachine, note: Callable[..., None]) -> None:
        self._state_machine, self._note, self._yaw_rad = state_machine, note, setup.mission.yaw_rad
        self._detour = Detour(setup.params.detour, setup.agent, setup.separation.radius_m)
        self._reported: Deadlock | None = None

    def update(
        self,
        now_us: int,
        utc_us: int,
        pos_ned_m: Array,
        known: Sequence[KeepOut],
        landmarks: Callable[[], Sequence[Obstacle]],
    ) -> Deadlock | None:
        """Whether the agent, at (3,), gets on among what is known; returns a deadlock that begins."""
        self._detour.step(now_us, pos_ned_m, self._mission(now_us, utc_us), known, landmarks)
        return self._report(now_us)

    def reset(self, now_us: int) -> None:
        """Somebody else flies."""
        self._detour.reset()
        self._report(now_us)

    def reference(self, now_us: int, utc_us: int, ahead_s: Array) -> tuple[Reference, Reference]:
        """At times (N,) from now, (N, 3) each; and the mission's, now."""
        pos, vel = self._state_machine.reference(utc_us, now_us, np.concatenate([[0.0], ahead_s]))
        now_ref = Reference(pos[:1], vel[:1], self._yaw_rad)
        if self._detour.active:
            return Reference(*self._detour.sample(ahead_s), self._yaw_rad), now_ref
        return Reference(pos[1:], vel[1:], self._yaw_rad), now_ref

    def wish(self, now_us: int, utc_us: int) -> Wish:
        """The same, for whoever plans on another grid."""
        if self._detour.active:
            return Wish(self._detour.sample, is_way=True)
        return Wish(self._mission(now_us, utc_us))

    def _mission(self, now_us: int, utc_us: int) -> Sampled:
        return partial(self._state_machine.reference, utc_us, now_us)

    def _report(self, now_us: int) -> Deadlock | None:
        reported, self._reported = self._reported, self._detour.deadlock
        if reported is None and self._reported is not None:
            self._note("deadlock", begins=True, by=self._reported.by)
            return self._reported
        if reported is not None and self._reported is None:
            self._note("deadlock", begins=False, lasted_s=(now_us - reported.since_us) * 1e-6)
        return None
