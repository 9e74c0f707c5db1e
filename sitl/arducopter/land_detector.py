"""Landing detection, lift-off and automatic disarming of an ArduCopter."""

from __future__ import annotations

from sitl.arducopter.parameters import CopterParameters
from sitl.plant.sensors import Estimate

LANDED_AFTER_US = 1_000_000  # time of continuous ground contact at low throttle
LANDED_THROTTLE = 0.5  # share of hover throttle
ARMING_DELAY_US = 2_000_000  # before motors spin up
TAKEOFF_SLEW_1_S = 0.5  # throttle rate of NAV_TAKEOFF after the spin-up: TKOFF_SLEW_TIME of 2 s
LIFTS_AT = 0.95  # share of hover throttle


class LandDetector:
    """Landing detector of one vehicle.

    Args:
        parameters: of the autopilot.
        hover_01: throttle that hovers.
        everywhere_air: there is no ground at all.

    Attributes:
        landed: ArduCopter's land_complete.
    """

    def __init__(self, parameters: CopterParameters, hover_01: float, everywhere_air: bool) -> None:
        self._parameters = parameters
        self._low_01 = LANDED_THROTTLE * hover_01
        self._lifting_01 = LIFTS_AT * hover_01
        self._everywhere_air = everywhere_air
        self.landed = not everywhere_air
        self._contact_us: int | None = None
        self._quiet_us = 0  # since when nothing has been requested on the ground
        self._armed_us = 0
        self._rising_us: int | None = None  # begin of the spin-up for a take-off

    def armed_at(self, now_us: int) -> None:
        """Note that the motors have been armed."""
        self._armed_us = self._quiet_us = now_us
        self._rising_us = None

    def stay(self) -> None:
        """Cancel a requested take-off."""
        self._rising_us = None

    def watch(self, estimate: Estimate, throttle_01: float, armed: bool, now_us: int) -> None:
        """Run one tick of the detector."""
        if self._everywhere_air:
            return
        if not armed:
            self.landed = self.landed or estimate.on_ground
        elif not estimate.on_ground:
            self._contact_us, self.landed = None, False
        elif throttle_01 > self._low_01:
            self._contact_us = None
        elif self._contact_us is None:
            self._contact_us = now_us
        elif not self.landed and now_us - self._contact_us >= LANDED_AFTER_US:
            self.landed, self._quiet_us, self._rising_us = True, now_us, None

    def takeoff_throttle_01(self, now_us: int) -> float:
        """Return the throttle of a NAV_TAKEOFF on the ground: 0 while motors spin up, then rising."""
        if self._rising_us is None:
            return 0.0
        since_s = (now_us - self._rising_us) * 1e-6 - self._parameters.real("MOT_SPOOL_TIME")
        return max(0.0, since_s * TAKEOFF_SLEW_1_S)

    def lifts_off(self, now_us: int, *, slowly: bool) -> bool:
        """Request a take-off; return whether the motors have spun up for it. True once, which also ends `landed`.

        `slowly`: NAV_TAKEOFF raises the throttle first; a setpoint is flown as it is.
        """
        self._quiet_us = now_us
        if self._rising_us is None:
            self._rising_us = max(now_us, self._armed_us + ARMING_DELAY_US)
        if now_us - self._rising_us < self._parameters.real("MOT_SPOOL_TIME") * 1e6:
            return False
        if slowly and self.takeoff_throttle_01(now_us) < self._lifting_01:
            return False
        self.landed, self._contact_us, self._rising_us = False, None, None
        return True

    def disarms(self, at_once: bool, now_us: int) -> bool:
        """Return whether to disarm: after DISARM_DELAY on the ground, or at once where the mode ends there."""
        if not self.landed:
            return False
        delay_s = self._parameters.real("DISARM_DELAY")
        return at_once or (delay_s > 0 and now_us - self._quiet_us >= delay_s * 1e6)
