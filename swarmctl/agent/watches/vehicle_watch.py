"""Tells what a vehicle's link reveals besides the state: refused requests and frames, jumps, setpoints that stopped."""

from __future__ import annotations

from swarmctl.agent.ports import Ports
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.estimation.accuracy import AccuracyLoss
from swarmctl.core.types import Verb
from swarmctl.mavlink.commands import CommandResult

_NO_ORIGIN_US = 3_000_000  # it is requested until it is there: that it is refused for a while is nothing to tell


class VehicleWatch:
    """Reports events of the vehicle's link.

    Args:
        ports: the vehicle; receives events of its requests, its words, its estimate, setpoints and frames.
        alerts: are told what an operator should know of them.

    Attributes:
        accuracy: what the estimate has lost of its accuracy in flight.
    """

    accuracy: AccuracyLoss

    def __init__(self, ports: Ports, alerts: Alerts) -> None:
        self._ports, self._alerts, self.accuracy = ports, alerts, AccuracyLoss()
        self._gaps = self._jumps = 0  # already reported
        self._is_lost = self._is_deaf = False  # as reported
        self._no_origin_us: int | None = None  # since when the vehicle does not tell its origin

    def on_result(self, result: CommandResult, now_us: int) -> None:
        """Report how the autopilot has answered a request."""
        asked = result.asked
        if result.command.verb is Verb.MESSAGE:
            self._report_origin(result, now_us)
        elif result.ok:
            self._alerts.clear(asked)
        else:
            self._alerts.put(asked, f"{asked} refused: {result.text}", now_us)
        self._ports.note("command", verb=asked, ok=result.ok, text=result.text)

    def _report_origin(self, result: CommandResult, now_us: int) -> None:
        """Report that the vehicle can't be placed among the others, because it has not told its origin for a while."""
        if result.ok or self._ports.autopilot.frame.offset_ned_m is not None:
            self._no_origin_us = None
            self._alerts.clear("origin")
            return
        self._no_origin_us = now_us if self._no_origin_us is None else self._no_origin_us
        if now_us - self._no_origin_us > _NO_ORIGIN_US:
            self._alerts.put("origin", f"waits for the vehicle's origin ({result.asked}: {result.text})", now_us)

    def report_text(self) -> None:
        """Record what the autopilot tells its operator, one message a tick: a flood must not fill the disk."""
        if (said := self._ports.autopilot.next_text()) is not None:
            self._ports.note("autopilot_text", severity=said.severity, text=said.text)

    def report_jump(self, now_us: int) -> None:
        """Report a jump of the vehicle's estimate, if there was one."""
        frame = self._ports.autopilot.frame
        if frame.jumps == self._jumps:
            return
        self._jumps = frame.jumps
        text = f"estimate jumped by {frame.jump_m:.1f} m: peers keep that much more away"
        self._alerts.put("jump", text, now_us)
        self._ports.note("estimate_jumped", metres=frame.jump_m)

    def report_accuracy(self, now_us: int, *, is_standing: bool) -> None:
        """Report that the vehicle's estimate has become inaccurate in flight, while it is."""
        accuracy_m, missing_s = self._ports.autopilot.pos_accuracy_m, self._ports.autopilot.health.fix_missing_s
        self.accuracy.update(now_us, accuracy_m, is_standing=is_standing, fix_missing_s=missing_s)
        if accuracy_m is not None and self.accuracy.margin_m:
            text = f"estimate is {accuracy_m:.1f} m off (rms): peers keep {self.accuracy.margin_m:.1f} m more away"
            self._alerts.put("accuracy", text, now_us)

    def report_loss(self, now_us: int) -> None:
        """Report that the vehicle's estimator has lost its position, or has found it again."""
        is_lost = self._ports.autopilot.states.is_lost
        if is_lost:
            self._alerts.put("lost", "the estimator has lost its position: the autopilot lands", now_us)
        if is_lost != self._is_lost:
            self._is_lost = is_lost
            self._ports.note("position_lost", lost=is_lost)

    def report_unheard(self, now_us: int) -> None:
        """Report that the vehicle does not hear its setpoints, although they are sent and its states are heard."""
        is_deaf = self._ports.autopilot.unheard_since_us(now_us) is not None
        if is_deaf:
            self._alerts.put("unheard", "the vehicle does not hear its setpoints: its link fails one way", now_us)
        if is_deaf != self._is_deaf:
            self._is_deaf = is_deaf
            self._ports.note("setpoints_unheard", unheard=is_deaf)

    def report_gap(self, now_us: int, cause: str) -> None:
        """Report that setpoints had stopped for too long, if they had; the cause is "" where it is not known."""
        sent = self._ports.autopilot.setpoints
        if sent.gaps == self._gaps:
            return
        self._gaps, gap_s = sent.gaps, sent.gap_s
        stopped = cause or f"setpoints had stopped for {gap_s:.2f} s"
        self._alerts.put("gap", f"{stopped}: the autopilot's failsafe may have acted", now_us)
        self._ports.note("setpoint_gap", seconds=gap_s)

    def report_refused_frames(self, now_us: int) -> None:
        """Report the vehicle's frames that were refused."""
        refusals, utc_us = self._ports.autopilot.refusals, self._ports.clock.utc_us()
        refusals.report(utc_us, self._ports.note)
        if text := refusals.alert(utc_us):
            self._alerts.put("signing", text, now_us)
