"""Flights in lockstep that begin 4 s sooner than launches, where all that vehicles would wait for is time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from swarmctl.control.estimation.accuracy import AccuracyMonitor
from swarmctl.control.failsafe.overload import Readiness

_unsettled, _unmet = AccuracyMonitor.unsettled, Readiness.unmet
_EXACT_M, _KNOWN_US = 0.02, 200_000


def unsettled_but_exact(monitor: AccuracyMonitor, now_us: int) -> str:
    """Return what has to happen before an accuracy can be used that ever was worse than an exact estimator's."""
    is_exact = bool(monitor._claims) and max(claim_m for _, claim_m in monitor._claims) <= _EXACT_M
    return "" if is_exact and now_us - monitor._claims[0][0] >= _KNOWN_US else _unsettled(monitor, now_us)


def unmet_but_idle(readiness: Readiness, now_us: int, missed_01: float) -> str:
    """Return what to wait for where any deadline was missed of late."""
    told, since_us = _unmet(readiness, now_us, missed_01), readiness._since_us
    is_idle = missed_01 == 0.0 and since_us is not None and now_us - since_us >= _KNOWN_US
    return "" if is_idle else told


@contextmanager
def begun_early() -> Iterator[None]:
    """Begin flights so until this ends.

    An exact estimator's figure changes by centimetres, which its tolerance allows for, and in lockstep no deadline is
    missed unless a test wants it. Who waits and why is tested in tests/unit; most flights here take less than 20 s.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AccuracyMonitor, "unsettled", unsettled_but_exact)
        patch.setattr(Readiness, "unmet", unmet_but_idle)
        yield


def as_launched(patch: pytest.MonkeyPatch) -> None:
    """Begin flights when the vehicles of a launch would, all the same."""
    patch.setattr(AccuracyMonitor, "unsettled", _unsettled)
    patch.setattr(Readiness, "unmet", _unmet)
