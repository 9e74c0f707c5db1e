"""Impaired links of a bus in memory: delay, loss, bad periods and jitter of one direction between two participants.

Every kind of fault draws from a stream of its own, seeded by the two names, so that what happens on a link depends on
its own messages and on time only, and one fault does not change the draws of another.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

_LOSS_STREAM, _BURST_STREAM, _JITTER_STREAM = 1, 2, 3  # keys of the random streams


@dataclass(frozen=True, slots=True, kw_only=True)
class Impairments:
    """Impairments of every link of a bus. All but the delays spare reliable topics."""

    delay_us: int = 0
    loss_01: float = 0.0  # probability that one receiver misses one message
    burst_01: float = 0.0  # fraction of time in which a link is bad and loses everything, < 1
    burst_s: float = 2.0  # mean length of a bad period
    jitter_us: int = 0  # largest extra delay, drawn uniformly for each message and link


PERFECT = Impairments()


class Link:
    """The messages from one participant to another.

    Args:
        impairments: see there.
        seed: seed of the bus.
        sender, receiver: their names.
        began_us: time from which bad periods are drawn, the same for all links.

    Attributes:
        draws: every message draws random numbers.
    """

    def __init__(self, impairments: Impairments, seed: int, sender: str, receiver: str, began_us: int) -> None:
        key = [seed, zlib.crc32(sender.encode()), zlib.crc32(receiver.encode())]
        self._impairments = impairments
        self._travel_us = max(1, impairments.delay_us)
        self._losses, bursts, self._jitters = (
            np.random.default_rng([*key, stream]) for stream in (_LOSS_STREAM, _BURST_STREAM, _JITTER_STREAM)
        )
        self._bad_periods = _BadPeriods(impairments, bursts, began_us)
        self._reliable_us = 0  # arrival of the newest reliable message
        self.draws = impairments.loss_01 > 0.0 or impairments.jitter_us > 0
        self._never_fails = not self.draws and impairments.burst_01 <= 0.0

    def arrival_us(self, now_us: int, *, reliable: bool) -> int | None:
        """Return when a message sent now arrives; None if it is lost. Reliable messages never overtake each other."""
        arrival_us = now_us + self._travel_us
        if self._never_fails:
            return arrival_us
        if self._impairments.jitter_us > 0:
            arrival_us += int(self._jitters.integers(self._impairments.jitter_us, endpoint=True))
        if reliable:
            self._reliable_us = max(self._reliable_us, arrival_us)
            return self._reliable_us
        loss_01 = self._impairments.loss_01
        lost = loss_01 > 0.0 and float(self._losses.random()) < loss_01
        return None if lost or self._bad_periods.include(now_us) else arrival_us


class _BadPeriods:
    """The Gilbert-Elliott model in continuous time: good and bad periods alternate, both of exponential length."""

    def __init__(self, impairments: Impairments, rng: np.random.Generator, began_us: int) -> None:
        bad_01, bad_s = impairments.burst_01, impairments.burst_s
        self._never = bad_01 <= 0.0
        if self._never:
            return
        self._rng = rng
        self._mean_us = {True: 1e6 * bad_s, False: 1e6 * bad_s * (1.0 - bad_01) / bad_01}
        self._bad = float(rng.random()) < bad_01  # in equilibrium from the beginning
        self._until_us = began_us + rng.exponential(self._mean_us[self._bad])

    def include(self, now_us: int) -> bool:
        """Return whether the link is bad now; `now_us` never decreases."""
        if self._never:
            return False
        while now_us >= self._until_us:
            self._bad = not self._bad
            self._until_us += self._rng.exponential(self._mean_us[self._bad])
        return self._bad
