"""What a vehicle reports of its battery and its GPS: for the operator, and the charge for the failsafe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from swarmctl.core.mavlink_values import GPS_FIX_3D

_UNKNOWN_SATELLITES = 255


@dataclass(slots=True)
class VehicleHealth:
    """Holds the newest reports; None before the first one, and for what the vehicle does not know."""

    battery_01: float | None = None  # charge that remains
    gps_fix: int | None = None  # GPS_FIX_TYPE: 3 is 3D, 0 no GPS
    satellites: int | None = None
    fixed_us: int | None = None  # arrival of the newest report of a 3D fix
    fix_missing_s: float = 0.0  # between it and the newest report of none

    def sys_status(self, message: Any) -> None:
        """Take a SYS_STATUS."""
        self.battery_01 = message.battery_remaining * 0.01 if 0 <= message.battery_remaining <= 100 else None

    def gps(self, message: Any, arrived_us: int) -> None:
        """Take a GPS_RAW_INT, which arrived at this monotonic time."""
        self.gps_fix = message.fix_type
        if message.fix_type >= GPS_FIX_3D:
            self.fixed_us = arrived_us
        self.fix_missing_s = 0.0 if self.fixed_us is None else (arrived_us - self.fixed_us) * 1e-6
        self.satellites = None if message.satellites_visible == _UNKNOWN_SATELLITES else message.satellites_visible
