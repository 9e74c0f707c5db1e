"""When the parts of an ArduCopter start to work, and why it does not arm before."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class BootTimes:
    """Times of the boot steps after start [us]; in the measured order and proportions, with wiped parameters."""

    heartbeat_us: int
    initialised_us: int  # the mode is STABILIZE again
    origin_us: int
    armable_us: int

    @classmethod
    def armable_after(cls, armable_us: int) -> BootTimes:
        """Return the measured boot (1.05, 2.45, 20.0, 23.7 s), scaled to be armable at `armable_us`."""
        heartbeat_us, initialised_us, origin_us = (round(armable_us * at_s / 23.7) for at_s in (1.05, 2.45, 20.0))
        return cls(heartbeat_us=heartbeat_us, initialised_us=initialised_us, origin_us=origin_us, armable_us=armable_us)


_CONSISTENT_AFTER = 0.5  # share of the boot time: only the order of these texts was measured
_NOT_READY = (
    "Arm: Accels inconsistent",
    "Arm: Gyros inconsistent",
)


def arming_refusals(times: BootTimes, now_us: int) -> tuple[str, ...]:
    """Return why arming is refused at this time after start; empty once it is not."""
    if now_us < times.initialised_us:
        return ("Arm: System not initialised",)
    if now_us < times.armable_us * _CONSISTENT_AFTER:
        return (*_NOT_READY, "Arm: EKF attitude is bad")
    if now_us < times.origin_us:
        return ("Arm: EKF attitude is bad",)
    if now_us < times.armable_us:
        return ("Arm: AHRS: not using configured AHRS type",)
    return ()
