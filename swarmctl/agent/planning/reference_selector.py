"""Selects the reference an agent follows: its mission's, or a detour around what it is deadlocked by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from swarmctl.agent.setup import AgentSetup
from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.control.reference.approach import Approach
from swarmctl.control.reference.deadlock import Deadlock, DeadlockRecovery
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, Phase, Reference, Sampled


class ReferenceSelector:
    """Chooses between the mission's reference and a detour, and reports deadlocks.

    Args:
        setup: parameters of the agent.
        mission: source of the mission's reference.
        ahead_s: (N,) times from now of the references that are asked for.
        note: receives the event `deadlock` when one begins and when it ends.
    """

    def __init__(self, setup: AgentSetup, mission: MissionState, ahead_s: Array, note: Callable[..., None]) -> None:
        self._mission, self._note, self._yaw_rad = mission, note, setup.mission.yaw_rad
        self._recovery = DeadlockRecovery(
            setup.params.deadlock, setup.agent, setup.separation.budget.radius_m, setup.volume
        )
        self._ahead_s, self._now_and_ahead_s = ahead_s, np.concatenate([[0.0], ahead_s])
        self._approach = Approach(setup.controller.mpc, setup.vehicle_model, plans=setup.controller.plans)
        self._mission_ned = np.zeros((len(ahead_s) + 1, 3)), np.zeros((len(ahead_s) + 1, 3))  # positions, velocities
        self._left_ned: tuple[Array, Array] | None = None  # the mission's own, (1, 3) each, while that is not followed
        self._reported: Deadlock | None = None

    @property
    def followed_z_m(self) -> float:
        """Return the down coordinate now of what the agent follows: its mission, or what interrupts it.

        On the way back it is the mission's own, for that way begins where the vehicle may have sunk to. Commitments are
        left out likewise: a vehicle that sinks commits anew from where it is.
        """
        left_ned = self._left_ned if self._mission.follows_mission else None  # on the way back
        pos, _ = left_ned or self._mission_ned
        return float(pos[0, 2])

    def heading_rad(self, utc_us: int) -> float | None:
        """Return the heading [rad] to turn to: the operator's, the mission's while it is followed, or that of the
        configuration before and after it; None while the mission is interrupted: the present one.
        """
        asked_rad = self._mission.yaw_rad
        if asked_rad is None:
            asked_rad = self._mission.mission_yaw_rad(utc_us)
        if asked_rad is None and self._mission.phase is not Phase.TRACK:
            return self._yaw_rad
        return asked_rad

    def look_ahead(self, now_us: int, utc_us: int) -> None:
        """Take in what the mission asks for from this tick on."""
        self._mission_ned = self._mission.reference(utc_us, now_us, self._now_and_ahead_s)
        self._left_ned = self._mission.reference_left(utc_us, now_us)

    def update(
        self,
        now_us: int,
        utc_us: int,
        pos_ned_m: Array,
        known: Sequence[KeepOut],
        *,
        landmarks: Callable[[], Sequence[Obstacle]],
    ) -> Deadlock | None:
        """Check progress and plan a detour if there is none; returns the deadlock that the agent is in.

        Args:
            now_us, utc_us: monotonic time and UTC, those of `look_ahead`.
            pos_ned_m: own position (3,).
            known: regions to keep out of.
            landmarks: returns the obstacles seen so far, which a detour leads around.
        """
        wanted_ned_m, mission = self._mission_ned[0][0], self._follows(now_us, utc_us)
        self._recovery.step(now_us, pos_ned_m, wanted_ned_m, mission, known, obstacles=landmarks)
        return self._report(now_us)

    def reset(self, now_us: int) -> None:
        """Forget progress and detour: the agent does not control the vehicle."""
        self._recovery.reset()
        self._report(now_us)

    def reference(self, pos_ned_m: Array, vel_ned_m_s: Array) -> tuple[Reference, Reference]:
        """Return the reference at the times asked for, (N, 3) each, and the mission's own one now, (1, 3).

        The first, where it is far away, is approached from the own position (3,), with the own velocity (3,), no faster
        than the vehicle may fly and can stop from.
        The mission's own one is that which agents share, without the own place around it; before and after the mission
        it is the one that is followed.
        """
        pos, vel = self._mission_ned
        own_ned, own_m_s = (pos[:1], vel[:1]) if self._left_ned is None else self._left_ned
        now_ref = Reference(own_ned - self._mission.place_offset_ned_m, own_m_s, self._yaw_rad)
        if self._recovery.active:
            return Reference(*self._recovery.sample(self._ahead_s), self._yaw_rad), now_ref
        near = self._approach.reference(pos[1:], vel[1:], self._ahead_s, own_ned_m=pos_ned_m, own_ned_m_s=vel_ned_m_s)
        return Reference(*near, self._yaw_rad), now_ref

    def desired(self, now_us: int, utc_us: int) -> DesiredReference:
        """Return the same reference as a function of time, for a planner with another time grid and start."""
        if self._recovery.active:
            return DesiredReference(self._recovery.sample, follows_path=True)
        return DesiredReference(self._follows(now_us, utc_us))

    def _follows(self, now_us: int, utc_us: int) -> Sampled:
        return partial(self._mission.reference, utc_us, now_us)

    def _report(self, now_us: int) -> Deadlock | None:
        reported, self._reported = self._reported, self._recovery.deadlock
        if reported is None and self._reported is not None:
            self._note("deadlock", begins=True, by=self._reported.by)
        if reported is not None and self._reported is None:
            self._note("deadlock", begins=False, lasted_s=(now_us - reported.since_us) * 1e-6)
        return self._reported
