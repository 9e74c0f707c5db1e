"""What limits how long a vehicle can be flown: the charge of its battery, and gaps of its link. Pure."""

from __future__ import annotations

from collections import deque

UNKNOWN = -1.0
_SAMPLE_US = 100_000


class Endurance:
    """Judges both over a window of time, so that neither a sag of the voltage nor a single gap counts.

    Args:
        window_s: length of the window.

    Attributes:
        battery_01: highest charge that was reported in the window; `UNKNOWN` without a report.
        link_lost_01: share of the window in which the newest state was stale.
    """

    def __init__(self, window_s: float) -> None:
        self._window_us = round(window_s * 1e6)
        self._seen: deque[tuple[int, float, bool]] = deque()  # time, charge, whether the state was stale
        self.battery_01, self.link_lost_01 = UNKNOWN, 0.0

    def update(self, now_us: int, battery_01: float | None, is_stale: bool) -> None:
        """Take in a tick, of which ten a second count.

        Until a window has passed, charge is what was highest so far, and a link counts as having been good before.

        Args:
            now_us: monotonic time.
            battery_01: newest report of the charge; None if the vehicle does not know it.
            is_stale: whether the newest state of the vehicle is too old.
        """
        if self._seen and now_us - self._seen[-1][0] < _SAMPLE_US:
            return
        self._seen.append((now_us, UNKNOWN if battery_01 is None else battery_01, is_stale))
        while now_us - self._seen[0][0] > self._window_us:
            self._seen.popleft()
        self.battery_01 = UNKNOWN if battery_01 is None else max(charge for _, charge, _ in self._seen)
        times = [at_us for at_us, _, _ in self._seen]
        lost_us = sum(until - since for (since, _, stale), until in zip(self._seen, times[1:], strict=False) if stale)
        self.link_lost_01 = min(1.0, lost_us / self._window_us)
