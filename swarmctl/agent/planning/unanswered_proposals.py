"""Which peers are heard, and leave all proposals of an agent unanswered. Pure: no bus, no clock.

Who takes an agent for ended, or has excluded it, acknowledges nothing of it any more. Where only one peer does, nobody
says so, and the agent rests where it is for as long as its battery lasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Set

from swarmctl.core.trajectory_message import Proposal, TrajectoryMessage

_LONG_US = 10_000_000  # a proposal is answered within a second or two, also on bad links


class UnansweredProposals:
    """Notes since when each peer has answered none.

    Args:
        agent: own number.
    """

    def __init__(self, agent: int) -> None:
        self._agent = agent
        self._since_us: dict[int, int] = {}

    def update(self, proposal: Proposal | None, asked: Set[int], newest: Mapping[int, TrajectoryMessage]) -> None:
        """Take in what peers say of the proposal of this tick.

        Args:
            proposal: the own one that is open, if there is any.
            asked: peers whose acknowledgements it takes.
            newest: message of each peer.
        """
        if proposal is None:
            return
        for peer in self._since_us.keys() - asked:
            del self._since_us[peer]
        for peer in asked:
            message = newest.get(peer)
            if message is not None and message.acknowledged.get(self._agent) == proposal.number:
                self._since_us.pop(peer, None)
            else:
                self._since_us.setdefault(peer, proposal.made_utc_us)

    def by(self, utc_us: int) -> set[int]:
        """Return the peers that have answered none for long."""
        return {peer for peer, since_us in self._since_us.items() if utc_us - since_us > _LONG_US}
