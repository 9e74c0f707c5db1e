"""Tells when an agent misses its deadlines, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.failsafe.overload import Level, Overload, OverloadParams, SetpointStops

_SETPOINT_LOSS_S = 0.5  # time without setpoints after which an autopilot takes over, until it has told its own


class DeadlineWatch:
    """Judges the missed deadlines of every tick.

    Args:
        params: thresholds.
        rate_hz: of ticks.
        alerts: are told while too many are missed.
        note: receives the event `overload` when the response changes.
    """

    def __init__(self, params: OverloadParams, rate_hz: float, alerts: Alerts, note: Callable[..., None]) -> None:
        period_us = round(1e6 / rate_hz)
        self._overload, self._stops = Overload(params, period_us), SetpointStops(period_us)
        self._alerts, self._note = alerts, note

    @property
    def level(self) -> Level:
        """Return the response to missed deadlines."""
        return self._overload.level

    @property
    def missed_01(self) -> float:
        """Return the fraction of deadlines missed of late."""
        return self._overload.missed_01

    @property
    def margin_m(self) -> float:
        """Return by how much distances grow."""
        return self._overload.margin_m

    def update(self, now_us: int, missed: int, loss_s: float | None) -> None:
        """Begin a tick.

        Args:
            now_us: monotonic time.
            missed: deadlines missed since the start.
            loss_s: time without setpoints after which the autopilot takes over; None until it has told.
        """
        before = self._overload.level
        self._overload.update(now_us, missed, flew=self._stops.has_sent)
        self._stops.update(now_us, missed, _SETPOINT_LOSS_S if loss_s is None else loss_s)
        level = self._overload.level
        text = self._overload.text()
        if text:
            self._alerts.put("overload", text, now_us)
        if level is not before:
            self._note("overload", level=level.name, missed_01=round(self._overload.missed_01, 3))

    def sent(self, now_us: int) -> None:
        """Note that a setpoint has left in this tick."""
        self._stops.sent(now_us)

    def stop_cause(self, now_us: int) -> str:
        """Return that missed deadlines have stopped the setpoints, and for how long, or ""."""
        return self._stops.text(now_us)
