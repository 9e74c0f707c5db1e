"""Whether a vehicle is disarmed, by evidence: an arm request and the HEARTBEAT that shows its effect arrive apart.

An autopilot acknowledges arming at once and tells `armed` in its next HEARTBEAT, up to a second later. Until then the
newest HEARTBEAT says "disarmed" of a vehicle whose motors turn.
"""

from __future__ import annotations

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.types import VehicleState


class ArmingEvidence:
    """Judges `VehicleState.armed` by when the HEARTBEAT that told it arrived.

    Attributes:
        requested: this agent has asked the autopilot to arm.
    """

    def __init__(self) -> None:
        self.requested = False
        self._open = False  # an arm request may still be on its way
        self._settled_us: int | None = None  # a HEARTBEAT before this time proves nothing

    def request(self) -> None:
        """Note that arming is being asked for now."""
        self.requested = self._open = True

    def update(self, inputs: PhaseInputs) -> None:
        """Advance by one tick, before this tick's requests.

        What was received before this process looked is as old as an arm request still open in the command port.
        """
        if self._settled_us is None or self._open:
            self._settled_us = inputs.now_us
        self._open = self._open and inputs.busy

    def is_disarmed(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Whether a HEARTBEAT that is newer than every arm request says that the vehicle is disarmed."""
        if state.armed or self._open or self._settled_us is None:
            return False
        return inputs.armed_told_us > self._settled_us
