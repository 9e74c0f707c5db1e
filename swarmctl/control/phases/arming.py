"""Decides whether a vehicle is known to be disarmed, although HEARTBEATs lag behind arm requests.

An autopilot acknowledges arming at once and reports `armed` in its next HEARTBEAT, up to a second later. Until then the
newest HEARTBEAT says "disarmed" about a vehicle whose motors turn. A copy of that one may arrive even later, from a
queue or a second way: soon after "armed" a single "disarmed" proves nothing.
"""

from __future__ import annotations

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.types import VehicleState

_COPIES_US = 5_000_000  # from "armed" on, within which a HEARTBEAT of before may arrive again


class ArmingEvidence:
    """Accepts "disarmed" only from a HEARTBEAT that arrived after every arm request was settled.

    Attributes:
        requested: whether this agent has asked the autopilot to arm.
        accepted: whether the autopilot has agreed to the newest request: its motors turn before a HEARTBEAT tells.
    """

    def __init__(self) -> None:
        self.requested = self.accepted = False
        self._open = False  # an arm request may still be on its way
        self._settled_us: int | None = None  # a HEARTBEAT before this time proves nothing
        self._armed_us: int | None = None  # arrival of the HEARTBEAT that first told of being armed
        self._denied_us: int | None = None  # and of the first of those that tell the opposite since
        self._disarmed_us: int | None = None  # arrival of the first HEARTBEAT by which it is known to be disarmed
        self._told_us = 0  # and of the newest one

    def request(self) -> None:
        """Note that arming is requested now."""
        self.requested = self._open = True
        self.accepted = False

    def update(self, inputs: PhaseInputs) -> None:
        """Advance by one tick, before this tick's requests.

        HEARTBEATs received before the first tick, or while an arm request is open, prove nothing.
        """
        if inputs.state is not None:
            self._note(inputs.armed_told_us, is_armed=inputs.state.armed)
        if self._settled_us is None or self._open:
            self._settled_us = inputs.now_us
        self._open = self._open and inputs.busy
        self._told_us = inputs.armed_told_us
        if inputs.state is None or not self.is_disarmed(inputs, inputs.state):
            self._disarmed_us = None
        elif self._disarmed_us is None:
            self._disarmed_us = self._told_us

    @property
    def disarmed_for_us(self) -> int:
        """Time from the first HEARTBEAT by which the vehicle is known to be disarmed to the newest; 0 if it is not."""
        return 0 if self._disarmed_us is None else self._told_us - self._disarmed_us

    def is_disarmed(self, inputs: PhaseInputs, state: VehicleState) -> bool:
        """Return whether a HEARTBEAT newer than every arm request reports the vehicle as disarmed.

        Soon after it was told to be armed, two of them have to.
        """
        if state.armed or self._open or self._settled_us is None:
            return False
        if self._denied_us is not None and self._armed_us is not None and self._denied_us - self._armed_us < _COPIES_US:
            return inputs.armed_told_us > self._denied_us
        return inputs.armed_told_us > self._settled_us

    def _note(self, told_us: int, *, is_armed: bool) -> None:
        if is_armed:
            if self._armed_us is None or self._denied_us is not None:
                self._armed_us, self._denied_us = told_us, None
        elif self._armed_us is not None and self._denied_us is None:
            self._denied_us = told_us
