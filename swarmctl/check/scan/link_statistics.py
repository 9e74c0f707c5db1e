"""Statistics of a link: message rates, lost frames, round trips and the vehicle's clock. Pure; times are arguments."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarmctl.check.scan.link_facts import RoundTrip, VehicleTime

_REORDERED = 128  # a sequence number this far behind belongs to a late frame, not to a gap
_REMEMBERED = (1 << _REORDERED + 1) - 1  # of the newest sequence number, and those that far behind
_CLOCK_ANSWERS, _CLOCK_SPAN_S = 8, 0.8  # fewer answers or a shorter span give no drift


@dataclass(frozen=True, slots=True)
class Answer:
    """Records when a request was sent and when its answer arrived, host clock."""

    sent_us: int
    arrived_us: int
    vehicle_us: float  # vehicle clock at the answer; NaN when not reported


class FrameStatistics:
    """Counts the frames and messages of one component."""

    def __init__(self) -> None:
        self.frames = 0
        self.bytes = 0
        self.lost = 0
        self._last_seq: int | None = None
        self._come = 0  # a bit for each sequence number that has come, the newest in the lowest
        self._count: Counter[str] = Counter()
        self._first_us: dict[str, int] = {}
        self._last_us: dict[str, int] = {}

    def frame(self, seq: int, size: int) -> None:
        """Count a frame with a valid checksum or of unknown type: both take a sequence number."""
        self.frames += 1
        self.bytes += size
        ahead = 1 if self._last_seq is None else (seq - self._last_seq) % 256
        if 0 < ahead < _REORDERED:
            self.lost += ahead - 1
            self._last_seq, self._come = seq, (self._come << ahead | 1) & _REMEMBERED
            return
        late = 1 << -ahead % 256
        if not self._come & late:  # else it has come twice, as where two ways lead here
            self.lost = max(0, self.lost - 1)  # counted before
            self._come |= late

    def message(self, name: str, t_us: int) -> None:
        self._count[name] += 1
        self._first_us.setdefault(name, t_us)
        self._last_us[name] = t_us

    def rates_hz(self, listened_s: float) -> dict[str, float]:
        """Return the rate of every message seen, from first to last arrival where there are three or more."""
        rates = {}
        for name, count in self._count.items():
            span_s = (self._last_us[name] - self._first_us[name]) * 1e-6
            rates[name] = (count - 1) / span_s if count > 2 and span_s > 0 else count / max(listened_s, 1e-6)
        return rates

    def lost_01(self, dropped: int) -> float:
        """Return the share of frames lost on the way.

        Args:
            dropped: frames that reached this computer and were lost there.
        """
        lost = max(0, self.lost - dropped)
        return lost / (lost + self.frames) if self.frames else 0.0


def round_trip(answers: Sequence[Answer], by: str) -> RoundTrip | None:
    """Return median and 99th percentile of the answers, or None without any."""
    if not answers:
        return None
    duration_ms = np.array([a.arrived_us - a.sent_us for a in answers]) * 1e-3  # (answers,)
    return RoundTrip(
        p50_ms=float(np.percentile(duration_ms, 50)),
        p99_ms=float(np.percentile(duration_ms, 99)),
        answers=len(answers),
        by=by,
    )


def vehicle_time(answers: Sequence[Answer]) -> VehicleTime | None:
    """Return offset and drift of the vehicle's clock, from the faster half of the answers; None without any.

    The vehicle's time is assigned to the middle of the round trip: a constant asymmetry of the link is not seen.
    """
    told = [a for a in answers if np.isfinite(a.vehicle_us)]
    if not told:
        return None
    took_us = np.array([a.arrived_us - a.sent_us for a in told])
    quick = took_us <= np.median(took_us)
    middle_s = np.array([(a.sent_us + a.arrived_us) * 0.5e-6 for a in told])[quick]
    offset_s = np.array([a.vehicle_us * 1e-6 for a in told])[quick] - middle_s
    t_s = middle_s - middle_s.mean()
    if len(t_s) < _CLOCK_ANSWERS or float(np.ptp(t_s)) < _CLOCK_SPAN_S:
        return VehicleTime(float(offset_s.mean()), 0.0, float("inf"))
    spread = float(t_s @ t_s)
    drift = float(t_s @ offset_s) / spread
    residual_s = offset_s - offset_s.mean() - drift * t_s
    sigma = float(np.sqrt(residual_s @ residual_s / max(1, len(t_s) - 2) / spread))
    return VehicleTime(float(offset_s.mean()), drift * 1e6, sigma * 1e6)
