"""What an operator is told of requests that an autopilot refuses."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from swarmctl.agent.ports import Ports
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.agent.watches.vehicle_watch import VehicleWatch
from swarmctl.core.types import Command, Verb
from swarmctl.mavlink.commands import CommandResult
from swarmctl.mavlink.dialects.dialect import GPS_GLOBAL_ORIGIN

SECOND = 1_000_000
ORIGIN = Command(verb=Verb.MESSAGE, number=GPS_GLOBAL_ORIGIN)


class Watched:
    """A watch over a vehicle whose origin is unknown, and what it has told."""

    def __init__(self) -> None:
        self.events: list[dict[str, Any]] = []
        self.frame = SimpleNamespace(offset_ned_m=None)
        self.ports = SimpleNamespace(
            autopilot=SimpleNamespace(frame=self.frame), note=lambda name, **fields: self.events.append(fields)
        )
        self.alerts = Alerts()
        self.watch = VehicleWatch(cast(Ports, self.ports), self.alerts)

    def answer(self, command: Command, ok: bool, text: str, now_us: int) -> str:
        """Take in the answer to a request; returns the alert."""
        self.watch.on_result(CommandResult(command, ok, text), now_us)
        newest = self.alerts.newest(now_us)
        return "" if newest is None else newest.text


def test_an_origin_that_is_not_there_yet_is_no_alert_and_is_recorded() -> None:
    watched = Watched()
    assert watched.answer(ORIGIN, False, "denied", 0) == ""
    assert watched.answer(ORIGIN, False, "denied", 2 * SECOND) == ""
    assert watched.answer(ORIGIN, True, "accepted", 3 * SECOND) == ""
    assert watched.events[0] == {"verb": "message GPS_GLOBAL_ORIGIN", "ok": False, "text": "denied"}


def test_an_origin_that_does_not_come_is_told_until_it_is_there() -> None:
    watched = Watched()
    for second in range(4):
        assert watched.answer(ORIGIN, False, "denied", second * SECOND) == ""
    told = watched.answer(ORIGIN, False, "denied", 4 * SECOND)
    assert told == "waits for the vehicle's origin (message GPS_GLOBAL_ORIGIN: denied)"
    watched.frame.offset_ned_m = np.zeros(3)  # worked out from its positions
    assert watched.answer(ORIGIN, False, "denied", 5 * SECOND) == ""


def test_what_else_is_refused_is_named_at_once_until_it_is_accepted() -> None:
    watched = Watched()
    rate = Command(verb=Verb.RATE, number=331, value=50.0)
    assert watched.answer(rate, False, "failed", 0) == "rate ODOMETRY refused: failed"
    assert watched.answer(rate, True, "accepted", SECOND) == ""
    assert watched.answer(Command(verb=Verb.ARM), False, "temporarily rejected", SECOND) == (
        "arm refused: temporarily rejected"
    )


def test_setpoints_that_the_vehicle_does_not_hear_are_told_while_they_are_not() -> None:
    watched = Watched()
    since_us: list[int | None] = [None]
    watched.ports.autopilot.unheard_since_us = lambda now_us: since_us[0]
    for now_us, unheard in ((0, None), (SECOND, 900_000), (SECOND + 20_000, 900_000), (2 * SECOND, None)):
        since_us[0] = unheard
        watched.watch.report_unheard(now_us)
    assert watched.events == [{"unheard": True}, {"unheard": False}]
    newest = watched.alerts.newest(SECOND + 20_000)
    assert newest is not None
    assert newest.text == "the vehicle does not hear its setpoints: its link fails one way"
