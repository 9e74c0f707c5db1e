"""What a supervisor and a station report of the bus itself."""

from __future__ import annotations

import time

from swarmctl.bus.peers import Bus
from swarmctl.bus.refusals import HARMLESS, Refusals
from swarmctl.ops.status_table import Display


def report_refused(bus: Bus, refusals: Refusals, display: Display) -> None:
    """Report what the bus did not deliver, because its seal was not by its sender; the first of each kind in words."""
    utc_us = time.time_ns() // 1000
    for sender, topic, reason in bus.refused():
        if refusals.add(sender, topic, reason, utc_us) == 1 and reason not in HARMLESS:
            display.print_line(f"{topic} in the name of {sender} refused: {reason}")
    refusals.report(utc_us)
