"""Landing detection and automatic disarming of one vehicle."""

from __future__ import annotations

from collections.abc import Callable

from sitl.net.mavlink_values import Severity
from sitl.px4.parameters import Parameters
from swarmctl.core.types import Landed

LANDED_AFTER_US = 500_000  # time of continuous ground contact


class LandDetector:
    """PX4's land detector, from ground contact.

    Attributes:
        landed: MAV_LANDED_STATE.
    """

    def __init__(self, parameters: Parameters, send_text: Callable[[Severity, str], None], *, airborne: bool) -> None:
        self._parameters = parameters
        self._send_text = send_text
        self._airborne = airborne
        self.reset()

    def reset(self) -> None:
        """Reset to the state after boot."""
        self.landed = Landed.IN_AIR if self._airborne else Landed.ON_GROUND
        self._contact_us: int | None = None
        self._armed_us = self._landed_us = 0
        self._flown = False

    def arm(self, now_us: int) -> None:
        """Begin a new flight."""
        self._armed_us = self._landed_us = now_us
        self._flown = self._airborne

    def update(self, on_ground: bool, in_the_air: Landed, now_us: int) -> None:
        """Update every tick; `in_the_air` is the state reported in flight."""
        if self._airborne:
            return
        if not on_ground:
            self._contact_us = None
            if self.landed == Landed.ON_GROUND:
                self._send_text(Severity.INFO, "Takeoff detected\t")
            self._flown = True
            self.landed = in_the_air
            return
        if self._contact_us is None:
            self._contact_us = now_us
        if self.landed != Landed.ON_GROUND and now_us - self._contact_us >= LANDED_AFTER_US:
            self.landed, self._landed_us = Landed.ON_GROUND, now_us
            self._send_text(Severity.INFO, "Landing detected\t")

    def disarm_text(self, now_us: int) -> str:
        """Return why an armed vehicle should disarm now; empty while it need not."""
        if self.landed != Landed.ON_GROUND:
            return ""
        real = self._parameters.real
        if self._flown:
            limit_s, extra_s, since_us = real("COM_DISARM_LAND"), 0.0, self._landed_us
            text = "Disarmed by landing\t"
        else:
            limit_s, extra_s, since_us = real("COM_DISARM_PRFLT"), real("COM_SPOOLUP_TIME"), self._armed_us
            text = "Disarmed by auto preflight disarming\t"
        return text if limit_s > 0 and now_us - since_us >= (limit_s + extra_s) * 1e6 else ""
