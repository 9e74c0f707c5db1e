"""Accuracy that PX4's estimator reports: after boot far too poor, too good, then right; without GPS it grows."""

from __future__ import annotations

import numpy as np

_UNPLACED_M = 14.14  # horizontal 1 sigma of an assumed position: 10 m on either axis
_PLACED, _AIDED = 0.5, 0.83  # share of the time until arming: heading found, GPS used
_LEVELLED_FLAGS, _HEADED_FLAGS, _AIDED_FLAGS = 164, 229, 1023
_RISE_AT = (0.5, 0.8, 0.85, 0.95, 1.0, 1.15, 1.32, 1.55, 1.8, 2.0)  # of that time
_RISE_01 = (0.035, 0.055, 0.07, 0.15, 0.23, 0.40, 0.64, 0.80, 0.94, 1.0)  # of the reported accuracy once settled
_UNAIDED_S = (0.0, 0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 9.5, 14.5, 19.5)  # since the newest fix of GPS
_UNAIDED_M = (0.0, 0.04, 0.18, 0.41, 0.71, 1.08, 1.78, 2.7, 4.0, 8.1, 17.4)  # what has been added to it (measured)


def claimed(horizontal_m: float, share: float) -> tuple[float, int]:
    """Return the horizontal accuracy [m] and flags of ESTIMATOR_STATUS.

    Args:
        horizontal_m: 1 sigma once it has settled.
        share: time since boot over the time until it can be armed; settling takes twice that time.
    """
    if share < _PLACED:
        return _UNPLACED_M, _LEVELLED_FLAGS
    accuracy_m = horizontal_m * float(np.interp(share, _RISE_AT, _RISE_01))
    return accuracy_m, _HEADED_FLAGS if share < _AIDED else _AIDED_FLAGS


def unaided_m(since_s: float) -> float:
    """Return what the reported horizontal accuracy [m] has grown by, so long after the newest position by GPS."""
    return float(np.interp(since_s, _UNAIDED_S, _UNAIDED_M))
