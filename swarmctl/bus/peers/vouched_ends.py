"""The ends of agents' processes, as who runs them has seen and says, and an operator by his word. Pure.

Each end names a process by its boot id. So it may be told again, and late: it says nothing of the process that follows.
"""

from __future__ import annotations

from collections.abc import Mapping, Set

from swarmctl.bus.messages.json_messages import EndedMessage, decode_ended
from swarmctl.bus.refusals import IDENTITY, MALFORMED, SEQUENCE

_MOST_PROCESSES = 64  # of one agent in one flight


class VouchedEnds:
    """Keeps the ends that were vouched for.

    Args:
        vouchers: agents of which each sender may say that they have ended.
    """

    def __init__(self, vouchers: Mapping[str, Set[int]]) -> None:
        self._vouchers = vouchers
        self._is_down: dict[int, dict[int | None, bool]] = {}  # by agent and boot id, the newest end last

    def take(self, sender: str, payload: bytes) -> tuple[EndedMessage | None, str]:
        """Return the end that a message tells, if it is news, and "" or why it is refused."""
        ended = decode_ended(payload)
        if ended is None or ended.agent not in self._vouchers.get(sender, ()):
            return None, MALFORMED if ended is None else IDENTITY
        known = self._is_down.setdefault(ended.agent, {})
        if known.get(ended.boot_id) is ended.is_down:
            return None, ""
        if ended.boot_id not in known and len(known) >= _MOST_PROCESSES:
            return None, SEQUENCE
        known.pop(ended.boot_id, None)
        known[ended.boot_id] = ended.is_down
        return ended, ""

    def vouch(self, agent: int, boot_id: int | None) -> None:
        """Believe that this process of an agent has ended; None: one that was never heard."""
        self._is_down.setdefault(agent, {}).setdefault(boot_id, False)

    def has_ended(self, agent: int, boot_id: int | None) -> bool:
        """Return whether this process of an agent has ended; None: of an agent that was never heard, any has."""
        known = self._is_down.get(agent, {})
        return boot_id in known or (boot_id is None and bool(known))

    def is_down(self, agent: int, boot_id: int | None) -> bool:
        """Return whether this process has ended, and the newest that has left the vehicle on the ground, disarmed."""
        return self.has_ended(agent, boot_id) and next(reversed(self._is_down[agent].values()))
