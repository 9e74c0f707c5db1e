"""Which agents of other computers have ended and left their vehicles on the ground.

Their hosts say so for as long as they run. Who is asked by an operator later has to have heard it.
"""

from __future__ import annotations

from collections.abc import Mapping, Set

from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.bus.peers.vouched_ends import VouchedEnds
from swarmctl.ops.supervision.bus_report import BusReport

_GONE_S = 3.0  # without a status: another process would have been heard


class EndsElsewhere:
    """Keeps what other computers have said of the ends of their agents' processes.

    Args:
        vouchers: agents of which each of them may say so.
    """

    def __init__(self, vouchers: Mapping[str, Set[int]]) -> None:
        self._agents = sorted(frozenset[int]().union(*vouchers.values()))
        self._ends = VouchedEnds(vouchers)
        self._heard: dict[int, tuple[int, float]] = {}  # boot id and time of the newest status

    def hear(self, status: StatusMessage, now_s: float) -> None:
        """Note which process of an agent speaks."""
        self._heard[status.agent] = status.boot_id, now_s

    def receive(self, report: BusReport) -> None:
        """Take in the ends that have arrived."""
        list(report.ends(self._ends))  # which are kept as they are read

    def down(self, now_s: float) -> tuple[int, ...]:
        """Return the agents that have ended with their vehicles down, and whom no other process speaks for."""
        never: tuple[int | None, float] = None, -_GONE_S
        heard = {agent: self._heard.get(agent, never) for agent in self._agents}
        return tuple(
            agent
            for agent, (boot_id, heard_s) in heard.items()
            if self._ends.is_down(agent, boot_id) and now_s - heard_s > _GONE_S
        )
