"""One agent of the explorer: a state that can be compared, and all that may follow from it in one tick.

What follows is computed by the code that flies: `Commitments`, `Membership` and `acknowledgements` are set to the
state, given what the agent has heard, and read out again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sitl.studies.protocol.symbols import (
    ANYWHERE,
    NOWHERE,
    WORLDS,
    SymbolicPlanner,
    in_conflict,
    places_of,
    trajectory_of,
)
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.collision.separation import SeparationParams, keep_out_of_commitment
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.membership import Membership
from swarmctl.control.commit.protocol import Commitments, acknowledgements
from swarmctl.control.commit.situation import Situation
from swarmctl.core.trajectory_message import Exclusions, Proposal, TrajectoryMessage

AGENTS = 3
NOBODY: frozenset[int] = frozenset()
NOTHING: frozenset[str] = frozenset()
DIES, RESTARTS, TAKEN_OVER = "dies", "restarts", "is taken over"
INTERRUPTIONS = frozenset({DIES, RESTARTS, TAKEN_OVER})
_PARAMS = CommitParams()
_SOMEBODY = KeepOuts(  # the planner of symbols does not look where
    [keep_out_of_commitment(np.zeros((2, 3)), AGENTS, SeparationParams(), SeparationParams().budget)]
)


@dataclass(frozen=True)
class Rules:
    """The rules that agents follow; the defaults are those that fly, `removed_rules` replaces them one by one."""

    commitments: type[Commitments] = Commitments
    membership: type[Membership] = Membership
    planner: type[SymbolicPlanner] = SymbolicPlanner
    refuse_promised: bool = True  # who is promised to be excluded gets no acknowledgement
    remember_silent: bool = True  # what excluded and ended peers have said last still counts
    restarted_abstain: bool = True  # an agent started again amid a flight promises nothing
    numbers_grow: bool = True  # numbers of proposals are never used again, not even after a restart
    in_order: bool = True  # an older message never replaces a newer one


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Bounds what may happen, so that there is an end to it."""

    world: str = "crossing"  # of `WORLDS`
    readings: tuple[tuple[int, ...], ...] = ((1, 2),) * AGENTS  # of each agent's clock, at which it may propose once
    suspects: frozenset[int] = NOBODY  # agents that the others may suspect, however well they hear them
    interruptions: int = 0  # how many of the following there may be, of all agents together
    interrupted: frozenset[int] = frozenset(range(AGENTS))  # agents that they may befall
    kinds: frozenset[str] = INTERRUPTIONS
    doubts: frozenset[int] = NOBODY  # agents that may doubt others at any time, and stop before them
    leaves: frozenset[int] = NOBODY  # those of them that may leave their own places for that


class Said(NamedTuple):
    """What a message says."""

    is_committed: bool
    committed: str
    proposal: tuple[int, int, str] | None  # number, time, trajectory
    acknowledged: tuple[tuple[int, int], ...]
    promised: frozenset[int]


class Process(NamedTuple):
    """What one agent knows, beside the messages it has heard, and whether its process runs."""

    committed: str
    proposal: tuple[int, int, str] | None = None
    is_committed: bool = True
    is_alive: bool = True
    cleared: frozenset[str] = NOTHING  # of those it takes not to conflict with the proposal, those that do
    clock: int = 0  # reading at the newest proposal, and the number of that
    promised: frozenset[int] = NOBODY
    excluded: frozenset[int] = NOBODY
    ended: frozenset[int] = NOBODY  # peers whose end somebody has vouched for
    votes: bool = True

    @property
    def begins(self) -> Said:
        """Return the first message."""
        return Said(self.is_committed, self.committed, None, (), NOBODY)


Known = Mapping[int, Said]
Outcome = tuple[str, Process, Said]  # what has happened, and the message then published


class Agent:
    """Knows what one agent may do.

    Args:
        number: of the agent.
        scope, rules: see there.
    """

    def __init__(self, number: int, scope: Scope, rules: Rules) -> None:
        self._number, self._scope, self._rules = number, scope, rules
        self._choices = WORLDS[scope.world][number]
        self._peers = frozenset(range(AGENTS)) - {number}
        doubted = sorted(scope.suspects & self._peers)
        self._suspects = [frozenset(some) for k in range(AGENTS) for some in itertools.combinations(doubted, k)]
        self.beginning = Process(self._choices[0])

    def ticks(self, before: Process, known: Known, dead: frozenset[int]) -> Iterator[Outcome]:
        """Yield the outcomes of one tick in which the agent knows these messages; some may be equal."""
        vouched = [before.ended] + [before.ended | {peer} for peer in dead - before.ended]
        for ended in vouched:
            for suspected in self._suspects:
                yield from self._tick(before._replace(ended=ended), known, suspected)

    def interruptions(self, before: Process, known: Known) -> Iterator[Outcome]:
        """Yield what may befall the agent once in a while."""
        dead = before._replace(is_alive=False, proposal=None, cleared=NOTHING)
        yield DIES, dead, self._says(before, known)
        begun = Process(
            before.committed,
            is_committed=before.is_committed,
            clock=before.clock if self._rules.numbers_grow else 0,
            votes=not self._rules.restarted_abstain,
        )
        yield RESTARTS, begun, begun.begins
        if before.is_committed:
            commitments = self._commitments(before, self._choices[0])
            commitments.end(None, before.clock)
            after = self._read(before._replace(is_committed=False), commitments)
            yield TAKEN_OVER, after, self._says(after, known)

    def _tick(self, before: Process, known: Known, suspected: frozenset[int]) -> Iterator[Outcome]:
        """Yield the outcomes of one tick, in the order of `swarmctl.agent.planning.coordination`."""
        membership = self._rules.membership(self._number, self._peers)
        membership._promised, membership.excluded = before.promised, before.excluded
        others = frozenset(range(AGENTS))
        told = {peer: Exclusions(suspected=others - {peer}, promised=said.promised) for peer, said in known.items()}
        membership.update(suspected, told, before.ended, votes=before.votes)
        member = before._replace(promised=membership.exclusions.promised, excluded=membership.excluded)
        if not member.is_committed:
            yield "listens", member, self._says(member, known)
            commitments = self._commitments(member, self._choices[0])
            commitments.begin(NOWHERE, NOWHERE, member.clock)
            begun = self._read(member._replace(is_committed=True), commitments)
            yield "begins", begun, self._says(begun, known)
            return
        for after in self._flown(member, known):
            yield self._name(before, after), after, self._says(after, known)

    def _flown(self, before: Process, known: Known) -> Iterator[Process]:
        required = self._peers - before.excluded - before.ended
        heard = {peer: said for peer, said in known.items() if self._rules.remember_silent or peer in required}
        messages = {peer: _message(peer, said) for peer, said in heard.items()}
        if before.proposal is not None:
            commitments = self._commitments(before, "")
            commitments.update(before.proposal[1] + commitments.lead_us + 1, messages, required)
            yield self._read(before, commitments)
        for wanted, reading in self._wishes(before):
            commitments = self._commitments(before, wanted)
            commitments.update(before.clock, messages, required)
            assert commitments.committed is not None
            is_new = reading and places_of(commitments.committed) != wanted
            if is_new and commitments.is_due(reading):
                commitments.propose(_situation(reading, messages))
            yield self._read(before, commitments)
        if self._number in self._scope.doubts and known.keys() == self._peers:  # who is silent has been heard
            for wanted in self._choices:
                commitments = self._commitments(before, wanted, doubts=True)
                commitments.update(before.clock, messages, required)
                leaves = self._number in self._scope.leaves
                commitments.stop_before(_situation(before.clock, messages), _SOMEBODY, leaves=leaves)
                yield self._read(before, commitments)

    def _wishes(self, before: Process) -> Iterator[tuple[str, int]]:
        """Yield what may be wanted, and the clock's reading then; 0: nothing."""
        yield "", 0
        for reading in self._scope.readings[self._number]:
            if reading > before.clock:
                yield from ((wanted, reading) for wanted in self._choices)

    def _commitments(self, state: Process, wanted: str, *, doubts: bool = False) -> Commitments:
        planner = self._rules.planner(self._choices[0], wanted, doubts)
        commitments = self._rules.commitments(self._number, _PARAMS, planner)
        commitments.committed = trajectory_of(state.committed)
        commitments.proposal = _proposal(self._number, state.proposal)
        commitments._number = state.clock
        commitments._cleared = {id(t): t for t in map(trajectory_of, state.cleared)}
        return commitments

    def _read(self, before: Process, commitments: Commitments) -> Process:
        assert commitments.committed is not None
        after = before._replace(committed=places_of(commitments.committed), proposal=None, cleared=NOTHING)
        if (proposal := commitments.proposal) is None:
            return after
        places = places_of(proposal.trajectory)
        cleared = frozenset(map(places_of, commitments._cleared.values()))
        return after._replace(
            proposal=(proposal.number, proposal.made_utc_us, places),
            clock=proposal.made_utc_us,
            cleared=frozenset(other for other in cleared if in_conflict(places, other)),
        )

    def _says(self, state: Process, known: Known) -> Said:
        without = state.ended | (state.promised if self._rules.refuse_promised else NOBODY)
        acknowledged = acknowledgements({peer: _message(peer, said) for peer, said in known.items()}, without)
        return Said(
            state.is_committed, state.committed, state.proposal, tuple(sorted(acknowledged.items())), state.promised
        )

    @staticmethod
    def _name(before: Process, after: Process) -> str:
        done = [f"commits to {after.committed}"] * (after.committed != before.committed)
        if after.proposal and after.proposal != before.proposal:
            done.append(f"proposes {after.proposal[2]} at {after.proposal[1]}")
        elif before.proposal and not after.proposal and not done:
            done.append("withdraws")
        if after.excluded != before.excluded:
            done.append(f"excludes {sorted(after.excluded)}")
        elif after.promised != before.promised:
            done.append(f"promises to exclude {sorted(after.promised)}")
        return " and ".join(done) or "listens"


def _situation(utc_us: int, peers: Mapping[int, TrajectoryMessage]) -> Situation:
    return Situation(
        utc_us=utc_us, begin_us=utc_us, desired=ANYWHERE, peers=peers, others=(), disturbance_ned_m_s2=NOWHERE
    )


def _proposal(agent: int, made: tuple[int, int, str] | None) -> Proposal | None:
    if made is None:
        return None
    number, utc_us, places = made
    return Proposal(number=number, made_utc_us=utc_us, agent=agent, trajectory=trajectory_of(places))


def _message(agent: int, said: Said) -> TrajectoryMessage:
    return TrajectoryMessage(
        agent=agent,
        boot_id=0,
        seq=0,
        sent_utc_us=0,
        is_committed=said.is_committed,
        committed=trajectory_of(said.committed),
        tube_m=0.0,
        proposal=_proposal(agent, said.proposal),
        acknowledged=dict(said.acknowledged),
        exclusions=Exclusions(promised=said.promised),
        heard={},
    )
