"""The agents' processes that have ended: their supervisor says so again and again.

The news names a process, so it is the same however often it is told, and whoever comes late or was cut off has it
after a second.
"""

from __future__ import annotations

import time

from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.json_messages import EndedMessage, encode_message
from swarmctl.bus.topics import ENDED

_REPEAT_S = 1.0


class EndedProcesses:
    """Keeps the ends that a supervisor has seen, and repeats them for as long as it lives.

    Args:
        bus: carries them.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._ended: dict[tuple[int, int | None], EndedMessage] = {}  # by agent and boot id
        self._said_s = 0.0

    def tell(self, ended: EndedMessage) -> None:
        """Tell the end of a process now, and from now on."""
        self._ended[ended.agent, ended.boot_id] = ended
        self._bus.publish(ENDED, encode_message(ended))

    def repeat(self) -> None:
        """Tell all ends again if it is time."""
        now_s = time.monotonic()
        if now_s - self._said_s >= _REPEAT_S:
            self._said_s = now_s
            for ended in self._ended.values():
                self._bus.publish(ENDED, encode_message(ended))
