"""Explores every order and fate of messages among three agents, breadth first, until two commitments conflict.

A message may be lost, delayed, repeated or overtaken. The bus sees to it that an older one never replaces a newer one,
so in each tick an agent knows any of the messages that each other has sent, and never an older one than before. States
that differ only in what can't matter any more are one: messages that all have heard newer ones than are left out, and
an agent hears no more in a tick than what it does there takes, because it may hear the rest in its next.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from sitl.studies.protocol.agent import AGENTS, RESTARTS, Agent, Process, Rules, Said, Scope
from sitl.studies.protocol.symbols import in_conflict

_UNHEARD = -1
_PEERS = tuple(tuple(j for j in range(AGENTS) if j != i) for i in range(AGENTS))
_Item = TypeVar("_Item", bound=Hashable)

Heard = tuple[int, ...]  # of each peer, in order, the index of the newest message heard among those it has sent
Move = tuple[str, int, int, Heard]  # what an agent has done, its process and message after that, what it had heard


class Swarm(NamedTuple):
    """One state: what each agent is, what it has said, and what it has heard; processes and messages by number."""

    processes: tuple[int, ...]
    said: tuple[tuple[int, ...], ...]
    heard: tuple[Heard, ...]
    interruptions: int  # that are left


@dataclass(frozen=True, kw_only=True)
class Explored:
    """What an exploration has found.

    Args:
        states: that were reached.
        depth: so many ticks of agents lead to no other states, or to the conflict.
        is_complete: whether no other state can be reached.
        violation: what happened, one tick after another, until two commitments conflicted; empty if none did.
    """

    states: int
    depth: int
    is_complete: bool
    violation: tuple[str, ...]


class _Numbered(Generic[_Item]):
    """Numbers items in the order in which they are first seen."""

    def __init__(self) -> None:
        self.items: list[_Item] = []
        self._numbers: dict[_Item, int] = {}

    def number(self, item: _Item) -> int:
        """Return the number of an item."""
        found = self._numbers.setdefault(item, len(self.items))
        if found == len(self.items):
            self.items.append(item)
        return found


class Explorer:
    """Explores what may happen within a scope.

    Args:
        scope, rules: see there.
    """

    def __init__(self, scope: Scope, rules: Rules | None = None) -> None:
        self._scope, self._rules = scope, rules or Rules()
        self._agents = [Agent(i, self._scope, self._rules) for i in range(AGENTS)]
        self._processes, self._messages = _Numbered[Process](), _Numbered[Said]()
        self._outcomes: dict[tuple[object, ...], list[tuple[str, int, int]]] = {}  # by all they depend on
        self._moves: dict[tuple[object, ...], list[Move]] = {}

    def explore(self, depth: int, max_states: int = 10**9) -> Explored:
        """Explore all states that so many ticks lead to, unless there are too many of them."""
        beginning = self.beginning()
        came_from: dict[Swarm, tuple[Swarm, str] | None] = {beginning: None}
        edge, reached = [beginning], 0
        while edge and reached < depth:
            found = list[Swarm]()
            for swarm in edge:
                for after, name in self.successors(swarm):
                    if after in came_from:
                        continue
                    came_from[after] = swarm, name
                    found.append(after)
                    if after.processes != swarm.processes and self.is_violated(after):
                        return _explored(came_from, reached + 1, after)
                    if len(came_from) >= max_states:
                        return Explored(states=len(came_from), depth=reached, is_complete=False, violation=())
            edge, reached = found, reached + bool(found)
        return Explored(states=len(came_from), depth=reached, is_complete=not edge, violation=())

    def beginning(self) -> Swarm:
        """Return the state in which all have taken off and have heard each other before."""
        processes = [agent.beginning for agent in self._agents]
        return Swarm(
            tuple(map(self._processes.number, processes)),
            tuple((self._messages.number(process.begins),) for process in processes),
            ((0,) * (AGENTS - 1),) * AGENTS,
            self._scope.interruptions,
        )

    def successors(self, swarm: Swarm) -> Iterator[tuple[Swarm, str]]:
        """Yield every state after one tick of one agent, and what that was."""
        processes = self._processes.items
        dead = frozenset(i for i, process in enumerate(swarm.processes) if not processes[process].is_alive)
        for number in range(AGENTS):
            if number not in dead:
                for move in self._moves_of(swarm, number, dead):
                    after = self._moved(swarm, number, move, dead)
                    yield after, f"agent {number} {move[0]}"
                if swarm.interruptions and number in self._scope.interrupted:
                    yield from self._interrupted(swarm, number, dead)

    def _moves_of(self, swarm: Swarm, number: int, dead: frozenset[int]) -> list[Move]:
        """Return what an agent may do next, with as little heard for it as possible."""
        first = swarm.heard[number] if self._rules.in_order else tuple(min(0, i) for i in swarm.heard[number])
        news = tuple(swarm.said[peer][max(0, i) :] for peer, i in zip(_PEERS[number], first, strict=True))
        starts = tuple(min(0, i) for i in first)
        key = number, swarm.processes[number], swarm.said[number][-1], news, starts, dead
        if key not in self._moves:
            self._moves[key] = list(self._new_moves(number, swarm, news, starts, dead))
        return self._moves[key]

    def _new_moves(
        self, number: int, swarm: Swarm, news: tuple[tuple[int, ...], ...], starts: Heard, dead: frozenset[int]
    ) -> Iterator[Move]:
        """Yield moves; messages heard are counted from the one that was heard before."""
        last = swarm.processes[number], swarm.said[number][-1]
        seen: dict[tuple[int, int], list[Heard]] = {last: [starts]}
        for heard in itertools.product(*(range(at, len(new)) for at, new in zip(starts, news, strict=True))):
            known = tuple(_UNHEARD if i == _UNHEARD else new[i] for i, new in zip(heard, news, strict=True))
            for name, after, message in self._ticks(number, last[0], known, dead):
                less = seen.setdefault((after, message), [])
                if not any(old[0] <= heard[0] and old[1] <= heard[1] for old in less):
                    less.append(heard)
                    yield name, after, message, heard

    def _ticks(
        self, number: int, process: int, known: tuple[int, ...], dead: frozenset[int]
    ) -> list[tuple[str, int, int]]:
        """Return what a tick may lead to in which the agent knows these messages, one of each peer."""
        key = number, process, known, dead
        if key not in self._outcomes:
            told = zip(_PEERS[number], known, strict=True)
            messages = {peer: self._messages.items[message] for peer, message in told if message != _UNHEARD}
            found = self._agents[number].ticks(self._processes.items[process], messages, dead)
            processes, said = self._processes, self._messages
            outcomes = [(name, processes.number(after), said.number(message)) for name, after, message in found]
            self._outcomes[key] = list(dict.fromkeys(outcomes))
        return self._outcomes[key]

    def _interrupted(self, swarm: Swarm, number: int, dead: frozenset[int]) -> Iterator[tuple[Swarm, str]]:
        left = swarm._replace(interruptions=swarm.interruptions - 1)
        told = zip(_PEERS[number], swarm.heard[number], strict=True)
        known = {peer: self._messages.items[swarm.said[peer][i]] for peer, i in told if i != _UNHEARD}
        for name, process, message in self._agents[number].interruptions(
            self._processes.items[swarm.processes[number]], known
        ):
            if name not in self._scope.kinds:
                continue
            said = self._messages.number(message)
            move = name, self._processes.number(process), said, (0,) * (AGENTS - 1)
            after = self._moved(left, number, move, dead)
            if name == RESTARTS:
                after = after._replace(heard=_with(after.heard, number, (_UNHEARD,) * (AGENTS - 1)))
            yield after, f"agent {number} {name}"

    def _moved(self, swarm: Swarm, number: int, move: Move, dead: frozenset[int]) -> Swarm:
        _, process, message, more = move
        said, heard, processes = swarm.said, swarm.heard, swarm.processes
        if process != processes[number]:
            processes = _with(processes, number, process)
        if message != said[number][-1]:
            said = _with(said, number, (*said[number], message))
        if self._rules.in_order:
            heard = _with(heard, number, tuple(max(0, i) + j for i, j in zip(heard[number], more, strict=True)))
        moved = Swarm(processes, said, heard, swarm.interruptions)
        is_old_lost = self._rules.in_order and not swarm.interruptions  # who is started again may hear any
        return _without_old_messages(moved, dead) if is_old_lost else moved

    def is_violated(self, swarm: Swarm) -> bool:
        """Tell whether two agents are committed to trajectories in conflict."""
        processes = [self._processes.items[number] for number in swarm.processes]
        committed = [process.committed for process in processes if process.is_committed]
        return any(in_conflict(*pair) for pair in itertools.combinations(committed, 2))


def _without_old_messages(swarm: Swarm, dead: frozenset[int]) -> Swarm:
    """Return the state without messages that nobody can hear any more."""
    (a, b), (c, d), (e, f) = swarm.heard  # of 1 and 2 by 0, of 0 and 2 by 1, of 0 and 1 by 2
    if dead:
        new = tuple(len(messages) - 1 for messages in swarm.said)
        a, b = (new[1], new[2]) if 0 in dead else (a, b)
        c, d = (new[0], new[2]) if 1 in dead else (c, d)
        e, f = (new[0], new[1]) if 2 in dead else (e, f)
    old = min(c, e), min(a, f), min(b, d)
    if min(old) == _UNHEARD or (old == (0, 0, 0) and not dead):
        return swarm
    said = tuple(messages[i:] for messages, i in zip(swarm.said, old, strict=True))
    heard = ((a - old[1], b - old[2]), (c - old[0], d - old[2]), (e - old[0], f - old[1]))
    return swarm._replace(said=said, heard=heard)


def _with(items: tuple[_Item, ...], number: int, item: _Item) -> tuple[_Item, ...]:
    return (*items[:number], item, *items[number + 1 :])


def _explored(came_from: dict[Swarm, tuple[Swarm, str] | None], depth: int, violated: Swarm) -> Explored:
    story, at = list[str](), came_from[violated]
    while at is not None:
        story.append(at[1])
        at = came_from[at[0]]
    return Explored(states=len(came_from), depth=depth, is_complete=False, violation=tuple(reversed(story)))
