"""A link that loses, delays, duplicates, reorders and corrupts datagrams, seeded, each direction separately.

Without an impairment it passes everything unchanged. Late datagrams are released when the simulator next steps.
"""

from __future__ import annotations

import heapq
from dataclasses import astuple, dataclass

import numpy as np

from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.transport import Datagram, Transport

_OVERTAKEN_US = 100_000  # longest time that a datagram waits for another to overtake it
_SET_ATTITUDE_TARGET = 82
_NOTHING = (0.0,) * 6


@dataclass(kw_only=True)
class Impairments:
    """Impairments of one link direction; probabilities are per datagram."""

    loss_01: float = 0.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0  # largest extra delay, drawn uniformly for each datagram: some overtake others
    duplicate_01: float = 0.0
    reorder_01: float = 0.0
    corrupt_01: float = 0.0

    def any(self) -> bool:
        """Return whether any impairment is set."""
        return astuple(self) != _NOTHING


class LinkDirection:
    """One direction of a link.

    Attributes:
        clear: datagrams pass unchanged and none is waiting; a cached flag, because every datagram tests it.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.clear = True
        self.impairments = Impairments()
        self._rng = rng
        self._queue: list[tuple[int, int, bytes]] = []  # due, number, datagram
        self._overtaken: tuple[int, bytes] | None = None  # end of the wait, datagram
        self._number = 0

    def set_impairment(self, name: str, amount: float) -> None:
        """Set one of the impairments; 0 removes it."""
        setattr(self.impairments, name, amount)
        self._look()

    def offer(self, now_us: int, data: bytes) -> None:
        """Enter one datagram, which may be lost, delayed, repeated or damaged."""
        impairments, rng = self.impairments, self._rng
        if self._happens(impairments.loss_01):
            return
        if self._happens(impairments.corrupt_01) and data:
            spoilt = bytearray(data)
            spoilt[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            data = bytes(spoilt)
        if self._overtaken is None and self._happens(impairments.reorder_01):
            self._overtaken = now_us + _OVERTAKEN_US, data
            return
        due_us = now_us + round(impairments.delay_ms * 1e3)
        if impairments.jitter_ms > 0.0:
            due_us += int(rng.integers(round(impairments.jitter_ms * 1e3), endpoint=True))
        for _ in range(2 if self._happens(impairments.duplicate_01) else 1):
            self._push(due_us, data)
        if self._overtaken is not None:
            self._push(due_us, self._overtaken[1])
            self._overtaken = None

    def take(self, now_us: int) -> list[Datagram]:
        """Return every datagram that leaves by now, stamped with its own time."""
        if self._overtaken is not None and now_us >= self._overtaken[0]:
            self._push(*self._overtaken)
            self._overtaken = None
        out = []
        while self._queue and self._queue[0][0] <= now_us:
            due_us, _, data = heapq.heappop(self._queue)
            out.append(Datagram(due_us, data))
        self._look()
        return out

    def _look(self) -> None:
        self.clear = not (self._queue or self._overtaken or self.impairments.any())

    def _push(self, due_us: int, data: bytes) -> None:
        self._number += 1
        heapq.heappush(self._queue, (due_us, self._number, data))

    def _happens(self, probability_01: float) -> bool:
        """Draw only where it matters, so that one fault does not change the random numbers of another."""
        return probability_01 > 0.0 and float(self._rng.random()) < probability_01


class LossyLink:
    """A transport that impairs another one.

    Attributes:
        to_vehicle, from_vehicle: its two directions.
    """

    def __init__(self, inner: Transport, seed: tuple[int, ...]) -> None:
        self._inner = inner
        self._now_us = 0
        self._setpoints: int | None = None
        self.to_vehicle, self.from_vehicle = (
            LinkDirection(np.random.default_rng([*seed, direction])) for direction in (0, 1)
        )

    def send(self, data: bytes) -> None:
        direction = self.from_vehicle
        if direction.clear:
            self._inner.send(data)
            return
        direction.offer(self._now_us, data)
        self._release()

    def receive(self, now_us: int) -> list[Datagram]:
        self._now_us = now_us
        if not self.from_vehicle.clear:
            self._release()
        arrived = self._inner.receive(now_us)
        direction = self.to_vehicle
        if not direction.clear:
            for datagram in arrived:
                direction.offer(datagram.t_us, datagram.data)
            arrived = direction.take(now_us)
        if self._setpoints is not None:
            self._setpoints += sum(
                message_id(frame) == _SET_ATTITUDE_TARGET for datagram in arrived for frame in frames(datagram.data)
            )
        return arrived

    def setpoints(self) -> int:
        """Return the number of SET_ATTITUDE_TARGET frames that have come out since the first call."""
        self._setpoints = self._setpoints or 0
        return self._setpoints

    def close(self) -> None:
        self._inner.close()

    def _release(self) -> None:
        for datagram in self.from_vehicle.take(self._now_us):
            self._inner.send(datagram.data)
