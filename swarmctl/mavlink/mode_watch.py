"""Which flight mode a vehicle is in, when that is in doubt, and what happened between two polls. Pure.

One setpoint brings PX4 back to OFFBOARD, whoever has taken it over meanwhile. So after a silence, ours or the link's,
the mode is in doubt until the vehicle has told it again; asked for its HEARTBEAT, it does within milliseconds. And of
modes and failsafes between two polls it is not the newest that counts: one that came and went is shown once.
"""

from __future__ import annotations

from swarmctl.core.types import FlightMode

_GAP_US = 300_000  # a silence this long, ours or the link's
_TOLD_LATELY_US = 100_000  # a mode this young at the end of our own silence was not held up in a full buffer
_REQUEST_PERIOD_US = 60_000


class ModeWatch:
    """Of one vehicle.

    Attributes:
        mode: as told last.
        failsafe: likewise, whether its autopilot's failsafe acts.
        departures: how often the vehicle has left the mode in which it follows setpoints.
        told_us: arrival of the message that told the mode.
    """

    def __init__(self) -> None:
        self.mode = FlightMode.UNKNOWN
        self.failsafe = False
        self.departures = self.told_us = 0
        self._left: FlightMode | None = None  # mode it was in meanwhile, of a departure that was not shown yet
        self._alarmed = False  # a failsafe that was not shown yet
        self._shown_us: int | None = None
        self._polled_us: int | None = None
        self._heard_us: int | None = None
        self._requested_us: int | None = None
        self._doubt_us: int | None = None  # the mode has to be told after this

    @property
    def in_doubt(self) -> bool:
        """Whether nobody can know the mode now."""
        return self._doubt_us is not None and self.told_us < self._doubt_us

    def poll(self, now_us: int) -> None:
        """Called before what has arrived is taken in."""
        if self._polled_us is not None and now_us - self._polled_us > _GAP_US:
            self._doubt_us = now_us - _TOLD_LATELY_US  # we slept: what was buffered may end long ago
        self._polled_us = now_us
        if self._shown_us is not None and now_us > self._shown_us:
            self._left, self._alarmed, self._shown_us = None, False, None

    def heard(self, arrived_us: int) -> None:
        """Anything of the vehicle."""
        if self._heard_us is not None and arrived_us - self._heard_us > _GAP_US:
            self._doubt_us = arrived_us  # the link was silent: what was said meanwhile is lost
        self._heard_us = arrived_us

    def told(self, mode: FlightMode, arrived_us: int) -> None:
        """HEARTBEAT or CURRENT_MODE."""
        if self.mode is FlightMode.EXTERNAL and mode is not FlightMode.EXTERNAL:
            self.departures += 1
            self._left = mode
        self.mode, self.told_us = mode, arrived_us

    def alarm(self, failsafe: bool) -> None:
        """HEARTBEAT."""
        self.failsafe = failsafe
        self._alarmed |= failsafe

    def asks(self, now_us: int) -> bool:
        """Whether to ask the vehicle for its HEARTBEAT now."""
        if not self.in_doubt or (self._requested_us is not None and now_us - self._requested_us < _REQUEST_PERIOD_US):
            return False
        self._requested_us = now_us
        return True

    def show(self, now_us: int) -> tuple[FlightMode, bool]:
        """Mode and failsafe for the state of this poll."""
        self._shown_us = now_us
        came_back = self.mode is FlightMode.EXTERNAL
        mode = self._left if came_back and self._left is not None else self.mode
        return mode, self.failsafe or self._alarmed
