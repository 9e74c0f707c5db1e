"""Whose acknowledgement an agent requires when a peer falls silent. Pure: no bus, no clock.

Silence proves nothing: a silent peer may have died, or be frozen, or be cut off and think the same of this agent. If
both excluded each other, both would commit without the other's acknowledgement. So a silent peer stays a participant,
at rest at the end of its last commitment, which it cannot leave without this agent's acknowledgement (one that has
declared this agent far can for as long as its lease lasts, see `swarmctl.control.commit.reach`), until

- somebody who knows vouches for the end of its agent (the launcher that has seen its process end, or the operator), or
  its own vehicle has been heard landed and disarmed; or
- a majority of all agents has agreed to exclude it:

1. Each agent publishes which peers it *suspects*, because it has not heard them for long, and takes that back when it
   hears them.
2. An agent *promises* to exclude a set of peers when all others, a majority of all agents, suspect every one of the
   set; or when one of those others has promised it. A promise is published, only grows, and is never taken back: from
   then on the agent acknowledges no proposal of the set.
3. An agent *excludes* the set when all others, a majority of all agents, have promised exactly this set.

*No two agents ever exclude each other this way.* Proof: let A exclude the set a with B in it, and B the set b with A in
it. Both majorities share an agent C, which has promised exactly a and exactly b, at different times. Promises only
grow, so one set contains the other. If a contains b, A is in a, but A has promised a, and no agent promises to exclude
itself. Likewise if b contains a.

*Who is excluded commits to nothing new*: it cannot have excluded the agents that exclude it, so it requires their
acknowledgements, which they don't give. What it may still commit to it has proposed, and they have acknowledged, before
their promise: it is in the newest of its messages that they know.

A minority stays at rest, as do two halves. An agent that has been started again amid a flight has lost its promises and
makes no others: it might contradict them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Set

from swarmctl.core.trajectory_message import Exclusions

_NOBODY: frozenset[int] = frozenset()


class Membership:
    """Applies the rules above for one agent.

    Args:
        agent: own number.
        peers: numbers of all other agents.

    Attributes:
        excluded: peers whose acknowledgement is no longer required.
        excluded_by: peers that have promised to exclude this agent.
    """

    def __init__(self, agent: int, peers: Collection[int]) -> None:
        self._agent, self._peers = agent, frozenset(peers)
        self._promised = self._suspected = _NOBODY
        self.excluded: frozenset[int] = _NOBODY
        self.excluded_by: list[int] = []

    @property
    def exclusions(self) -> Exclusions:
        """Return what is to be published."""
        return Exclusions(suspected=self._suspected, promised=self._promised)

    @property
    def may_be_excluded(self) -> bool:
        """Return whether peers could ever exclude this agent: in a swarm of two the other one is no majority."""
        return 2 * len(self._peers) > len(self._peers) + 1

    def update(
        self, suspected: Set[int], told: Mapping[int, Exclusions], ended: Set[int], *, votes: bool = True
    ) -> None:
        """Apply the rules to what is known now.

        Args:
            suspected: peers that this agent has not heard for long.
            told: newest exclusions published by each peer.
            ended: peers that take no part any more by evidence; they have no vote.
            votes: whether this agent has kept all its promises since the flight began.
        """
        promising = {agent: exclusions for agent, exclusions in told.items() if exclusions.promised}
        self.excluded_by = sorted(agent for agent, said in promising.items() if self._agent in said.promised)
        if not votes:
            return
        self._suspected = frozenset(suspected)
        if not suspected and not self._promised and not promising:
            return  # as nearly always
        for agent in sorted(told):
            others = told[agent].promised
            if agent not in self._promised and self._agent not in others:
                self._promise(self._promised | others, ended)
        wanted = self._promised | self._suspected
        voters = self._voters(wanted, ended)
        if all(i in told and wanted <= told[i].suspected | told[i].promised for i in voters):
            self._promise(wanted, ended)
        voters = self._voters(self._promised, ended)
        if self._is_majority(voters) and all(i in told and told[i].promised == self._promised for i in voters):
            self.excluded = self._promised

    def _voters(self, without: Set[int], ended: Set[int]) -> frozenset[int]:
        return self._peers - without - ended

    def _is_majority(self, voters: Collection[int]) -> bool:
        return 2 * (len(voters) + 1) > len(self._peers) + 1

    def _promise(self, wanted: frozenset[int], ended: Set[int]) -> None:
        if self._is_majority(self._voters(wanted, ended)):
            self._promised = wanted
