"""What agents do without one rule of the protocol or of membership, and where that is enough for a conflict."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Set
from dataclasses import dataclass, replace

from sitl.studies.protocol.agent import RESTARTS, TAKEN_OVER, Rules, Scope
from sitl.studies.protocol.symbols import SymbolicPlanner
from swarmctl.control.commit.membership import Membership
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.commit.situation import Situation
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, TrajectoryMessage

Peers = Mapping[int, TrajectoryMessage]
Told = Mapping[int, Exclusions]


class IgnoresCommitted(Commitments):
    """Rule 2: keeps a proposal that a peer's committed trajectory conflicts with."""

    def update(self, utc_us: int, peers: Peers, required: Set[int]) -> None:
        super().update(utc_us, {i: replace(m, is_committed=False) for i, m in peers.items()}, required)


class IgnoresEarlier(Commitments):
    """Rule 2: keeps a proposal that an earlier one conflicts with."""

    def update(self, utc_us: int, peers: Peers, required: Set[int]) -> None:
        super().update(utc_us, {i: replace(m, proposal=None) for i, m in peers.items()}, required)


class OrdersByOwnClock(Commitments):
    """Rule 2: orders proposals by their arrival, so that each side may take its own for the earlier one."""

    def update(self, utc_us: int, peers: Peers, required: Set[int]) -> None:
        super().update(utc_us, {i: _arrived_later(m) for i, m in peers.items()}, required)


class WaitsForNobody(Commitments):
    """Rule 3: commits without acknowledgements."""

    def update(self, utc_us: int, peers: Peers, required: Set[int]) -> None:
        super().update(utc_us, peers, frozenset())


class WaitsForAnybody(Commitments):
    """Rule 3: commits once one peer has acknowledged."""

    def update(self, utc_us: int, peers: Peers, required: Set[int]) -> None:
        for peer in required or {self._agent}:
            super().update(utc_us, peers, required & {peer})


class TakesAnyNumber(Commitments):
    """Rule 3: takes an acknowledgement of an earlier proposal for one of this."""

    def update(self, utc_us: int, peers: Peers, required: Set[int]) -> None:
        number = 0 if self.proposal is None else self.proposal.number
        super().update(utc_us, {i: _acknowledging(m, number) for i, m in peers.items()}, required)


class ProposesBesideProposals(Commitments):
    """Rule 4: proposes what conflicts with known proposals."""

    def propose(self, now: Situation) -> None:
        super().propose(replace(now, peers={i: replace(m, proposal=None) for i, m in now.peers.items()}))


class ProposesBlindly(SymbolicPlanner):
    """Rule 4: proposes what conflicts with anything known."""

    def proposal(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        return super().proposal(committed, replace(now, peers={}))


class StopsAnywhere(SymbolicPlanner):
    """Stops where others pass at other times."""

    def halting(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        return super().halting(committed, replace(now, peers={}))


class StopsBesideProposals(SymbolicPlanner):
    """Stops where others, of which it may have acknowledged that, are about to commit to pass."""

    def halting(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        peers = {i: replace(m, proposal=None) for i, m in now.peers.items()}
        return super().halting(committed, replace(now, peers=peers))


class VotesWithoutMajority(Membership):
    """Excludes, although those that agree are no majority."""

    def _is_majority(self, voters: Collection[int]) -> bool:
        return True


class TakesBack(Membership):
    """Forgets what it has promised, until it excludes."""

    def update(self, suspected: Set[int], told: Told, ended: Set[int], *, votes: bool = True) -> None:
        self._promised = self.excluded
        super().update(suspected, told, ended, votes=votes)


class TrustsSuspicion(Membership):
    """Excludes as soon as all others suspect, before they have promised."""

    def update(self, suspected: Set[int], told: Told, ended: Set[int], *, votes: bool = True) -> None:
        super().update(suspected, told, ended, votes=votes)
        self.excluded = self._promised


@dataclass(frozen=True, kw_only=True)
class Removed:
    """A rule, what agents do without it, and where that shows.

    Args:
        rule: in words.
        rules: without it.
        scope: small, in which a conflict is found.
        is_needed: whether one is found; otherwise the rule is there for another reason.
    """

    rule: str
    rules: Rules
    scope: Scope
    is_needed: bool = True


_ONCE = ((1,), (1,), ())  # two agents propose, once each
_LATER = ((2,), (1,), ())  # that of the second is earlier, whenever it is made
_TWICE = ((1, 2), (1, 2), ())
_PAIR = Scope(world="pair", readings=_ONCE)
_EXCLUDING = replace(_PAIR, suspects=frozenset({0}))
_SPLIT = replace(_PAIR, suspects=frozenset({0, 1}))
_RESTARTING = replace(_PAIR, interruptions=1, kinds=frozenset({RESTARTS}))
_STOPPING = Scope(world="turns", readings=_ONCE, doubts=frozenset({0, 1}), leaves=frozenset({0}))
REMOVED = (
    Removed(
        rule="only the newest message counts",
        rules=Rules(in_order=False),
        scope=_EXCLUDING,
    ),
    Removed(
        rule="withdraw before what a peer has committed to",
        rules=Rules(commitments=IgnoresCommitted),
        scope=replace(_RESTARTING, interrupted=frozenset({1})),
    ),
    Removed(
        rule="withdraw before an earlier proposal",
        rules=Rules(commitments=IgnoresEarlier),
        scope=_PAIR,
    ),
    Removed(
        rule="both sides order proposals alike",
        rules=Rules(commitments=OrdersByOwnClock),
        scope=_PAIR,
    ),
    Removed(
        rule="wait for acknowledgements",
        rules=Rules(commitments=WaitsForNobody),
        scope=_PAIR,
    ),
    Removed(
        rule="wait for those of all participants",
        rules=Rules(commitments=WaitsForAnybody),
        scope=_PAIR,
    ),
    Removed(
        rule="an acknowledgement is of one proposal",
        rules=Rules(commitments=TakesAnyNumber),
        scope=replace(_PAIR, readings=_TWICE),
    ),
    Removed(
        rule="no number is used again",
        rules=Rules(numbers_grow=False),
        scope=replace(_RESTARTING, interrupted=frozenset({0})),
    ),
    Removed(
        rule="propose what is clear of all that is known",
        rules=Rules(planner=ProposesBlindly),
        scope=_PAIR,
    ),
    Removed(
        rule="proposals of peers are known, too",
        rules=Rules(commitments=ProposesBesideProposals),
        scope=replace(_EXCLUDING, readings=_LATER),
    ),
    Removed(
        rule="what the excluded have said still counts",
        rules=Rules(remember_silent=False),
        scope=_EXCLUDING,
    ),
    Removed(
        rule="stop unasked only where nobody else passes, whenever that is",
        rules=Rules(planner=StopsAnywhere),
        scope=_STOPPING,
    ),
    Removed(
        rule="stop unasked only where nobody is about to commit to pass",
        rules=Rules(planner=StopsBesideProposals),
        scope=_STOPPING,
    ),
    Removed(
        rule="only one of two leaves its places unasked",
        rules=Rules(),
        scope=replace(_STOPPING, leaves=frozenset({0, 1})),
    ),
    Removed(
        rule="stop unasked only where nobody may exclude who has stopped",
        rules=Rules(),
        scope=replace(_STOPPING, suspects=frozenset({0})),
    ),
    Removed(
        rule="only a majority excludes",
        rules=Rules(membership=VotesWithoutMajority),
        scope=replace(_PAIR, suspects=frozenset({0, 1, 2})),
    ),
    Removed(
        rule="who takes control again does so where nobody else goes",
        rules=Rules(),
        scope=Scope(world="follow", readings=((1,), (), ()), interruptions=1, kinds=frozenset({TAKEN_OVER})),
    ),
    Removed(
        rule="a promise is never taken back",
        rules=Rules(membership=TakesBack),
        scope=_SPLIT,
    ),
    Removed(
        rule="exclude only once all have promised",
        rules=Rules(membership=TrustsSuspicion),
        scope=_SPLIT,
    ),
    Removed(
        rule="who is started again amid a flight has no vote",
        rules=Rules(restarted_abstain=False),
        scope=replace(_RESTARTING, interrupted=frozenset({2}), suspects=frozenset({0, 1})),
    ),
    Removed(
        rule="acknowledge nobody who is promised to be excluded",
        rules=Rules(refuse_promised=False),
        scope=_EXCLUDING,
        is_needed=False,  # who is excluded is to stop soon, whoever hears it; whoever acknowledges also keeps clear
    ),
)


def _arrived_later(message: TrajectoryMessage) -> TrajectoryMessage:
    made = message.proposal
    return message if made is None else replace(message, proposal=replace(made, made_utc_us=made.made_utc_us + 1))


def _acknowledging(message: TrajectoryMessage, number: int) -> TrajectoryMessage:
    return replace(message, acknowledged=dict.fromkeys(message.acknowledged, number))
