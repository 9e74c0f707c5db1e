"""Decides whether a vehicle is known to be disarmed, although HEARTBEATs lag behind arm requests.

An autopilot acknowledges arming at once and reports `armed` in its next HEARTBEAT, up to a second later. Until then the
newest HEARTBEAT says "disarmed" about a vehicle whose motors turn.
"""

from __future__ import annotations

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.types import VehicleState


class ArmingEvidence:
    """Accepts "disarmed" only from a HEARTBEAT that arrived after every arm request was settled.

    Attributes:
        requested: whether this agent has asked the autopilot to arm.
    """

    def __init__(self) -> None:
        self.requested = False
        self._open = False  # an arm request may still be on its way
        self._settled_us: int | None = None  # a HEARTBEAT before this time proves nothing

    def request(self) -> None:
        """Note that arming is requested now."""
        self.requested = self._open = True

    def update(self, inputs: PhaseInputs) -> None:
        """Advance by one tick, before this tick's requests.

        HEARTBEATs received before the first tick, or while an arm request is open, prove nothing.
        """
        if self._settled_us is None or self._open:
            self._settled_us = inputs.now_us
        self._open = self._open and inputs.busy

    def is_disarmed(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether a HEARTBEAT newer than every arm request reports the vehicle as disarmed."""
        if state.armed or self._open or self._settled_us is None:
            return False
        return inputs.armed_told_us > self._settled_us
