"""ArduCopter's RTL up to the landing: climb, fly home, wait above it."""

from __future__ import annotations

import enum
import math

from sitl.arducopter.navigator import CopterNavigator
from sitl.arducopter.parameters import CopterParameters
from sitl.plant.sensors import Estimate
from swarmctl.core.types import Array

CLIMBED_M = 0.2
ARRIVED_M = 0.5
Position = tuple[float, float, float]


class ReturnStage(enum.Enum):
    """Names the stages of RTL, in the order in which they are flown."""

    CLIMB = "climb"
    RETURN = "return"
    WAIT = "wait"
    LAND = "land"


class ReturnHome:
    """RTL of one vehicle; `begin`, then `fly` every tick until `stage` is LAND."""

    def __init__(self, parameters: CopterParameters, navigator: CopterNavigator) -> None:
        self._parameters = parameters
        self._navigator = navigator
        self.stage = ReturnStage.CLIMB
        self._z_m = 0.0
        self._arrived_us = 0

    def begin(self, estimate: Estimate, home_ned_m: Position) -> None:
        """Choose the height: RTL_ALT above home, less when near (RTL_CONE_SLOPE), never lower than now."""
        self.stage = ReturnStage.CLIMB
        x_m, y_m, z_m = estimate.pos_ned_m
        height_m = home_ned_m[2] - z_m
        slope = self._parameters.real("RTL_CONE_SLOPE")
        cone_m = slope * math.hypot(x_m - home_ned_m[0], y_m - home_ned_m[1]) if slope > 0 else math.inf
        self._z_m = home_ned_m[2] - max(height_m, min(self._parameters.metres("RTL_ALT"), cone_m))

    def fly(self, estimate: Estimate, home_ned_m: Position, now_us: int, dt_s: float) -> tuple[Array, float]:
        """Return attitude (4,) and throttle of this tick."""
        x_m, y_m, z_m = estimate.pos_ned_m
        throttle = self._navigator.to_height(estimate, self._z_m, dt_s)
        if self.stage is ReturnStage.CLIMB:
            if abs(z_m - self._z_m) < CLIMBED_M:
                self.stage = ReturnStage.RETURN
            return self._navigator.hold(estimate, dt_s), throttle
        if self.stage is ReturnStage.RETURN and math.hypot(x_m - home_ned_m[0], y_m - home_ned_m[1]) < ARRIVED_M:
            self.stage, self._arrived_us = ReturnStage.WAIT, now_us
        waited_us = now_us - self._arrived_us
        if self.stage is ReturnStage.WAIT and waited_us >= self._parameters.real("RTL_LOIT_TIME") * 1e3:
            self.stage = ReturnStage.LAND
        return self._navigator.go_to(estimate, home_ned_m[:2], dt_s), throttle
