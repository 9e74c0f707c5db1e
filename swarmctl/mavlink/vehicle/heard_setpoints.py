"""Which setpoint a vehicle flies: ATTITUDE_TARGET repeats its thrust, to the last bit, in PX4 and in ArduCopter.

A link may fail towards the vehicle alone. Its states go on to arrive, and look as if it followed, until its failsafe
acts half a second later or more. An ArduCopter repeats the last setpoint that it has heard, a PX4 each one once. In 11
flights 2811 of 2816 were among those sent, none older than the second newest; five were the autopilot's own.
"""

from __future__ import annotations

import itertools
import struct
from collections import deque

_KEPT = 128  # setpoints: longer than any autopilot waits for the next one
_REPEATED = 64  # of which the quickest tells the way there and back, if TIMESYNC has not, and the slowest how often
_FEW = 8  # repeated setpoints from which that is not known yet
_MISSED = 3  # setpoints in a row, which were sent long enough before: one or two are lost on any link
_SILENT_US = 80_000  # without a repeated setpoint, while the vehicle is heard
_TOLD_US = 300_000  # after which an old conclusion is none, and a longer pause is no interval
_STOPPED_US = 1_500_000  # without repeated setpoints, after which it does not repeat them any more
_THRUST = struct.Struct("<f")


class HeardSetpoints:
    """Concludes from what the vehicle repeats whether it hears its setpoints.

    Attributes:
        round_trip_us: time to the vehicle and back, as told last by an answered TIMESYNC.
    """

    def __init__(self) -> None:
        self.round_trip_us = 0
        self._sent: deque[tuple[int, float]] = deque(maxlen=_KEPT)  # host time and thrust, as the frame carries it
        self._took_us: deque[int] = deque(maxlen=_REPEATED)  # from sending a setpoint to its repetition
        self._intervals_us: deque[int] = deque(maxlen=_REPEATED)
        self._flown_us = 0  # when the setpoint was sent that was repeated last
        self._misses = False  # it was repeated although later ones were sent
        self._told_us = 0  # arrival of what was repeated last

    def sent(self, t_us: int, thrust_01: float) -> None:
        """Note a setpoint that is sent."""
        self._sent.append((t_us, _THRUST.unpack(_THRUST.pack(thrust_01))[0]))

    def repeated(self, thrust_01: float, arrived_us: int) -> None:
        """Take the thrust of the setpoint that the vehicle has flown, told by a frame that arrived at `arrived_us`.

        A thrust that was never sent is the autopilot's own. Where it flies by itself because it misses setpoints, those
        that it has not heard remain unheard.
        """
        flown_us = next((t_us for t_us, thrust in reversed(self._sent) if thrust == thrust_01), None)
        if flown_us is None:
            self._told_us = arrived_us if self._misses else self._told_us
            return
        if arrived_us - self._told_us <= _TOLD_US:
            self._intervals_us.append(arrived_us - self._told_us)
        self._took_us.append(arrived_us - flown_us)
        self._told_us, self._flown_us = arrived_us, flown_us
        self._misses = self._missed(arrived_us) >= _MISSED

    def unheard_since_us(self, now_us: int, state_us: int) -> int | None:
        """Return when the last setpoint was sent that the vehicle is known to fly, if it misses later ones.

        Args:
            now_us: host clock.
            state_us: time of the newest state: since then nothing speaks for the vehicle.
        """
        if self._misses:
            return self._flown_us if now_us - self._told_us <= _TOLD_US else None
        silent_us = state_us - self._told_us
        if len(self._intervals_us) < _FEW or not _SILENT_US < silent_us < _STOPPED_US:
            return None
        is_late = silent_us > 2 * max(self._intervals_us) and self._missed(state_us) >= _MISSED
        return self._flown_us if is_late else None

    def _missed(self, told_us: int) -> int:
        """Return how many setpoints the vehicle should have heard by now after that one, by what arrived at a time."""
        until_us = told_us - max(self.round_trip_us, min(self._took_us))
        later_us = itertools.takewhile(lambda t_us: t_us > self._flown_us, (t_us for t_us, _ in reversed(self._sent)))
        return sum(t_us <= until_us for t_us in later_us)
