"""What an estimator's reported accuracy says: before the start whether it has settled, in flight what it has lost.

While a filter settles its figure means nothing. PX4 reports 14 m one second after boot, 0.01 m at two, and rises to
0.29 m by nine seconds, where it stays (simulated GPS). The accuracy used is the largest figure of a window in which it
has hardly changed. In flight a PX4 whose GPS has failed goes on by its inertial sensors: 0.5 m after 1.5 s, 1 m
after 3.5 s, and 2 m after 5.5 s, when its flags say that it has no position (measured).
"""

from __future__ import annotations

from collections import deque

_WINDOW_US = 4_000_000
_SETTLED_CHANGE_01 = 0.25  # largest relative change within a window; a change of satellites alone is less
_SETTLED_CHANGE_M = 0.02
# By how many standard deviations a vehicle may be away from where it is estimated: real PX4s on a circle were 2.7 m off
# 4 s after their newest fix, and reported 1.2 m.
_SIGMAS = 4.0
_WIDEN_M_S = 3.0  # growth of the margin: peers have to make room, and some autopilots report 100 m at once
_NO_CLAIM_TIMEOUT_US = 3_000_000  # a vehicle that reports its accuracy at all has done so by then


class AccuracyMonitor:
    """Monitors the reported accuracy of the horizontal position, 1-sigma [m]; times are monotonic."""

    def __init__(self) -> None:
        self._claims: deque[tuple[int, float]] = deque()
        self._since_us: int | None = None

    def update(self, now_us: int, claim_m: float | None) -> None:
        """Update with the newest reported accuracy [m], None while there is none."""
        self._since_us = now_us if self._since_us is None else self._since_us
        if claim_m is None:
            self._claims.clear()
            return
        if not self._claims:
            self._since_us = now_us
        self._claims.append((now_us, claim_m))
        while now_us - self._claims[0][0] > _WINDOW_US:
            self._claims.popleft()

    @property
    def worst_m(self) -> float | None:
        """Largest accuracy figure of the window [m]; None while the vehicle reports none."""
        return max((claim for _, claim in self._claims), default=None)

    def unsettled(self, now_us: int) -> str:
        """Return what has to happen before the accuracy can be used, or ""."""
        waited_us = 0 if self._since_us is None else now_us - self._since_us
        if not self._claims:
            return "" if waited_us >= _NO_CLAIM_TIMEOUT_US else "the estimator to tell its accuracy"
        claims_m = [claim for _, claim in self._claims]
        if waited_us < _WINDOW_US or max(claims_m) > min(claims_m) * (1.0 + _SETTLED_CHANGE_01) + _SETTLED_CHANGE_M:
            steady = (
                f"{_SETTLED_CHANGE_01 * 100:.0f} % and {_SETTLED_CHANGE_M * 100:.0f} cm for {_WINDOW_US * 1e-6:.0f} s"
            )
            return f"the estimator's accuracy to settle, within {steady} (now {claims_m[-1]:.2f} m)"
        return ""


class AccuracyLoss:
    """Judges what an estimate has lost of the accuracy that it had when its vehicle started.

    The accuracy at the start is part of the separation; what settling allows for is no loss.

    Attributes:
        margin_m: distance by which the vehicle may be farther from its estimate than the separation allows for.
        dead_reckoning_s: for how long the estimate has been going on without GPS: a fix that it had is missing, and it
            becomes less accurate. With another source of positions it does not.
    """

    def __init__(self) -> None:
        self.margin_m = self.dead_reckoning_s = 0.0
        self._start_m: float | None = None
        self._updated_us: int | None = None

    def update(self, now_us: int, accuracy_m: float | None, *, is_standing: bool, fix_missing_s: float = 0.0) -> None:
        """Update in every tick; an agent that is started in flight takes the first figure as that of the start.

        Args:
            now_us: monotonic time.
            accuracy_m: newest reported accuracy, 1-sigma; None while there is none.
            is_standing: whether the vehicle still stands before its flight.
            fix_missing_s: for how long GPS has reported no fix, after one.
        """
        since_s = 0.0 if self._updated_us is None else (now_us - self._updated_us) * 1e-6
        self._updated_us = now_us
        if accuracy_m is None:
            return
        if is_standing or self._start_m is None:
            self._start_m = accuracy_m
        settled_m = self._start_m * (1.0 + _SETTLED_CHANGE_01) + _SETTLED_CHANGE_M
        wanted_m = _SIGMAS * max(0.0, accuracy_m - settled_m)
        self.margin_m = min(wanted_m, self.margin_m + _WIDEN_M_S * since_s)
        self.dead_reckoning_s = fix_missing_s if wanted_m else 0.0
