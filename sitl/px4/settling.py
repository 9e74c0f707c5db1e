"""Settling of PX4's estimator after boot: its reported accuracy is first far too poor, then too good, then right."""

from __future__ import annotations

import numpy as np

_UNPLACED_M = 14.14  # horizontal 1 sigma of an assumed position: 10 m on either axis
_PLACED, _AIDED = 0.5, 0.83  # share of the time until arming: heading found, GPS used
_LEVELLED_FLAGS, _HEADED_FLAGS, _AIDED_FLAGS = 164, 229, 1023
_RISE_AT = (0.5, 0.8, 0.85, 0.95, 1.0, 1.15, 1.32, 1.55, 1.8, 2.0)  # of that time
_RISE_01 = (0.035, 0.055, 0.07, 0.15, 0.23, 0.40, 0.64, 0.80, 0.94, 1.0)  # of the reported accuracy once settled


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
