"""Flight mode of a vehicle, the times when it is in doubt, and mode changes between two polls. Pure.

One setpoint brings PX4 back to OFFBOARD even after a pilot has taken over. So after a silence, of agent or link, the
mode is in doubt until the vehicle reports it again; a requested HEARTBEAT arrives within milliseconds. So it is when a
HEARTBEAT contradicts a CURRENT_MODE that has just arrived: it may be a copy from before the change. A mode or failsafe
that came and went between two polls is shown once, although it is not the newest.
"""

from __future__ import annotations

from swarmctl.core.mavlink_values import CRITICAL
from swarmctl.core.types import FlightMode

_GAP_US = 300_000  # length of a silence, of the agent or the link, that puts the mode in doubt
_TOLD_LATELY_US = 100_000  # a mode report this young at the end of our own pause was not delayed in a full buffer
_REQUEST_PERIOD_US = 60_000
_JUST_US = 200_000


class ModeWatch:
    """Watches the flight mode of one vehicle.

    Attributes:
        mode: newest reported mode.
        departures: number of departures from the mode that follows setpoints.
        told_us: arrival time of the message that reported the mode.
    """

    def __init__(self) -> None:
        self.mode = FlightMode.UNKNOWN
        self._status = 0  # MAV_STATE
        self.departures = self.told_us = 0
        self._left: FlightMode | None = None  # intermediate mode of a departure that was not shown yet
        self._alarmed = False  # a failsafe that was not shown yet
        self._shown_us: int | None = None
        self._polled_us: int | None = None
        self._received_us: int | None = None
        self._requested_us: int | None = None
        self._doubt_us: int | None = None  # a mode report must be newer than this
        self._changed_us = -_JUST_US  # arrival of the newest CURRENT_MODE

    @property
    def in_doubt(self) -> bool:
        """Whether the mode can't be known now."""
        return self._doubt_us is not None and self.told_us < self._doubt_us

    def poll(self, now_us: int) -> None:
        """Judge our own pause; called before received frames are handled."""
        if self._polled_us is not None and now_us - self._polled_us > _GAP_US:
            self._doubt_us = now_us - _TOLD_LATELY_US  # we paused: buffered frames may be old
        self._polled_us = now_us
        if self._shown_us is not None and now_us > self._shown_us:
            self._left, self._alarmed, self._shown_us = None, False, None

    def on_frame(self, arrived_us: int) -> None:
        """Note the arrival of a frame of the vehicle."""
        if self._received_us is not None and arrived_us - self._received_us > _GAP_US:
            self._doubt_us = arrived_us  # the link was silent: frames of that time are lost
        self._received_us = arrived_us

    def told(self, mode: FlightMode, arrived_us: int, *, by_heartbeat: bool) -> None:
        """Take the mode of a HEARTBEAT, or of a CURRENT_MODE, which is sent when it changes."""
        if not by_heartbeat:
            self._changed_us = arrived_us
        elif mode is not self.mode and arrived_us - self._changed_us < _JUST_US and not self.in_doubt:
            self._doubt_us = self.told_us + 1  # what follows it decides, also at once
            return
        if self.mode is FlightMode.EXTERNAL and mode is not FlightMode.EXTERNAL:
            self.departures += 1
            self._left = mode
        self.mode, self.told_us = mode, arrived_us

    def status(self, status: int) -> None:
        """Take the MAV_STATE of a HEARTBEAT, after its mode."""
        self._status = status
        self._alarmed |= self.failsafe

    @property
    def failsafe(self) -> bool:
        """Whether the autopilot's failsafe acts, by the newest HEARTBEAT and the newest mode.

        An autopilot that follows setpoints while its status is critical only warns. An operator's resume is told by
        CURRENT_MODE, up to a second before the next HEARTBEAT.
        """
        only_warns = self._status == CRITICAL and self.mode is FlightMode.EXTERNAL
        return self._status >= CRITICAL and not only_warns

    def asks(self, now_us: int) -> bool:
        """Whether to request a HEARTBEAT now."""
        if not self.in_doubt or (self._requested_us is not None and now_us - self._requested_us < _REQUEST_PERIOD_US):
            return False
        self._requested_us = now_us
        return True

    def show(self, now_us: int) -> tuple[FlightMode, bool]:
        """Return mode and failsafe for the state of this poll."""
        self._shown_us = now_us
        came_back = self.mode is FlightMode.EXTERNAL
        mode = self._left if came_back and self._left is not None else self.mode
        return mode, self.failsafe or self._alarmed
