"""How well the own vehicle follows what it has committed to, and what is done about it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.commit.situation import DesiredReference, slowed
from swarmctl.control.commit.tube import Grip, Tube
from swarmctl.core.types import MAX_MARGIN_M, VehicleState


class CommitmentTracking:
    """Compares one vehicle with its commitment, which waits for it, or is replaced where it is lost.

    Args:
        commitments: what the vehicle has committed to.
        tube_m: radius of the tube that all distances leave room for.
        note: is told `tracking_violation` when the vehicle leaves its tube, when that has another consequence, and when
            it is held again.

    Attributes:
        grip: how well the vehicle follows.
    """

    def __init__(self, commitments: Commitments, tube_m: float, note: Callable[..., None]) -> None:
        self._commitments, self._tube_m, self._note = commitments, tube_m, note
        self._tube, self._error_m = Tube(tube_m), 0.0
        self.grip = Grip.HELD

    @property
    def worst_m(self) -> float:
        """Return how far the vehicle has been off what it had committed to, at most."""
        return self._tube.worst_m

    @property
    def margin_m(self) -> float:
        """Return by how much the own tube is wider than distances leave room for."""
        return self._tube.radius_m - self._tube_m

    def told_m(self, unsure_m: float) -> float:
        """Return the radius of the tube that peers are told, where the vehicle may be off its estimate by more."""
        return max(self._tube.radius_m, min(MAX_MARGIN_M, self._error_m + unsure_m))

    def watch(self, utc_us: int, since_us: int, state: VehicleState, state_utc_us: int) -> None:
        """Commit anew, from the measured state, when the commitment is lost; report how well it is held.

        Args:
            utc_us, since_us: now, and since the last call.
            state, state_utc_us: of the own vehicle, and when it was there.
        """
        commitments = self._commitments
        commitments.wait_for(state.pos_ned_m, state_utc_us, since_us, self._tube_m)
        assert commitments.committed is not None and commitments.flown is not None
        state_utc_us = max(state_utc_us, commitments.committed.t0_utc_us)  # before it begins it is as if at rest
        pos, vel = map(np.array, commitments.committed.at(state_utc_us))
        self._error_m = error_m = float(np.linalg.norm(state.pos_ned_m - pos))
        error_m_s = float(np.linalg.norm(state.vel_ned_m_s - vel))
        late_m = math.dist(pos, commitments.flown.at(state_utc_us)[0])
        speed_m_s = float(np.linalg.norm(state.vel_ned_m_s))
        if self._tube.update(utc_us, error_m, error_m_s, late_m, speed_m_s=speed_m_s):
            commitments.restart(state.pos_ned_m, state.vel_ned_m_s, state_utc_us)
        before, self.grip = self.grip, self._tube.grip(utc_us)
        if self.grip is not before:
            is_off, grip = self.grip is not Grip.HELD, self.grip.name
            self._note("tracking_violation", begins=is_off, error_m=error_m, allowed_m=self._tube_m, grip=grip)

    def paced(self, desired: DesiredReference, begin_us: int) -> DesiredReference:
        """Return the desired motion, or a slower one from where the next plan begins while the tube is left far."""
        if self._tube.pace_01 == 1.0:
            return desired
        assert self._commitments.flown is not None
        return slowed(desired, np.array(self._commitments.flown.at(begin_us)[0]), self._tube.pace_01)
