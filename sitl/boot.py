"""An autopilot's own clock and local frame: both restart at a reboot, while the simulation goes on."""

from __future__ import annotations

from dataclasses import replace

from sitl.plant.sensors import Estimate, LocalOrigin

BOOT_US = 1_300_000  # from power to the first HEARTBEAT, when the estimator takes its 4 s
_BOOT_SHARE = 0.325  # share of the estimator's time, when that is shorter


class Boot:
    """Time and place at which one autopilot has started.

    Attributes:
        at_us: on the clock of the simulation.
        quiet_us: since boot, until its links work.
        origin: of its local frame; None until the world has set one.
    """

    def __init__(self, ekf_ready_us: int = 0) -> None:
        """Set `ekf_ready_us` since boot: links start after a share of it, or at once where it is 0."""
        self.at_us = 0
        self.quiet_us = min(BOOT_US, round(_BOOT_SHARE * ekf_ready_us))
        self.origin: LocalOrigin | None = None
        self._shift_ned_m = (0.0, 0.0, 0.0)

    def since_us(self, now_us: int) -> int:
        """Return the time since boot; negative while it starts."""
        return now_us - self.at_us

    def again(self, now_us: int, where: Estimate | None) -> None:
        """Restart at `now_us`; the local frame begins at the vehicle's place, `where` in the old one."""
        self.at_us = now_us + BOOT_US - self.quiet_us
        origin = self.origin
        if origin is None or where is None:
            return
        x_m, y_m, z_m = where.pos_ned_m
        lat_e7, lon_e7 = origin.to_geo_e7(x_m, y_m)
        alt_mm = origin.alt_mm - round(z_m * 1e3)
        dx_m, dy_m = origin.to_xy_m(lat_e7, lon_e7)
        old = self._shift_ned_m
        self._shift_ned_m = old[0] + dx_m, old[1] + dy_m, old[2] + (origin.alt_mm - alt_mm) / 1e3
        self.origin = replace(origin, lat_e7=lat_e7, lon_e7=lon_e7, alt_mm=alt_mm)

    def local(self, estimate: Estimate) -> Estimate:
        """Convert an estimate of the simulation to this clock and this frame."""
        if self.at_us == 0:
            return estimate
        (x_m, y_m, z_m), (dx_m, dy_m, dz_m) = estimate.pos_ned_m, self._shift_ned_m
        moved = x_m - dx_m, y_m - dy_m, z_m - dz_m
        return estimate._replace(t_us=self.since_us(estimate.t_us), pos_ned_m=moved)
