"""Who is excluded when agents fall silent, whatever happens to messages: explored exhaustively, and by chance.

A message may be lost, delayed or overtaken: an agent has heard any of the messages that each other has sent, and never
an older one after a newer one, as the bus sees to. Anybody may suspect anybody at any time, so in the model all
are taken to suspect all others, which allows more than can happen. Every rule is broken once, and a mutual exclusion is
found.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass

import pytest

from sitl.studies.protocol.removed_rules import TakesBack, TrustsSuspicion, VotesWithoutMajority
from swarmctl.control.commit.membership import Membership
from swarmctl.core.trajectory_message import Exclusions

NOBODY: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Agent:
    """One agent's state: what it has promised one after the other, whom it has heard, and whom it has excluded."""

    said: tuple[frozenset[int], ...] = (NOBODY,)
    heard: tuple[int, ...] = ()  # number of the newest message of each agent; -1: none yet
    excluded: frozenset[int] = NOBODY

    def acts(
        self,
        number: int,
        agents: Sequence[Agent],
        heard: tuple[int, ...],
        suspected: frozenset[int],
        *,
        rules: type[Membership],
    ) -> Agent:
        """Hears messages, suspects, decides, and publishes."""
        everybody = frozenset(range(len(agents)))
        membership = rules(number, everybody - {number})
        membership._promised, membership.excluded = self.said[-1], self.excluded
        told = {
            peer: Exclusions(suspected=everybody - {peer}, promised=agents[peer].said[heard[peer]])
            for peer in everybody - {number}
            if heard[peer] >= 0
        }
        membership.update(suspected, told, NOBODY)
        promised = membership.exclusions.promised
        said = self.said if promised == self.said[-1] else (*self.said, promised)
        return Agent(said, heard, membership.excluded)


Swarm = tuple[Agent, ...]


def beginning(count: int) -> Swarm:
    return (Agent(heard=(-1,) * count),) * count


def mutual(swarm: Swarm) -> bool:
    """Whether two agents have excluded each other, and so fly on without each other's acknowledgement."""
    pairs = itertools.combinations(range(len(swarm)), 2)
    return any(a in swarm[b].excluded and b in swarm[a].excluded for a, b in pairs)


def subsets(agents: Sequence[int]) -> list[frozenset[int]]:
    sizes = range(len(agents) + 1)
    return [frozenset(chosen) for size in sizes for chosen in itertools.combinations(agents, size)]


def successors(swarm: Swarm, messages: int, rules: type[Membership]) -> Iterator[Swarm]:
    """Every state after one agent has acted, as long as it has sent at most so many different messages."""
    for number, agent in enumerate(swarm):
        fates = [
            [agent.heard[number]] if sender == number else range(agent.heard[sender], len(other.said))
            for sender, other in enumerate(swarm)
        ]
        suspects = subsets([peer for peer in range(len(swarm)) if peer != number])
        for heard, suspected in itertools.product(itertools.product(*fates), suspects):
            acted = agent.acts(number, swarm, heard, suspected, rules=rules)
            if len(acted.said) <= messages:
                yield (*swarm[:number], acted, *swarm[number + 1 :])


def explored(agents: int, messages: int, rules: type[Membership] = Membership) -> tuple[int, int, bool]:
    """All reachable states, the most events that lead to one, and whether there is a mutual exclusion among them."""
    reached = edge = {beginning(agents)}
    depth = 0
    while edge:
        edge = {after for swarm in edge for after in successors(swarm, messages, rules)} - reached
        reached = reached | edge
        depth += bool(edge)
        if any(map(mutual, edge)):
            return len(reached), depth, True
    return len(reached), depth, False


def test_no_order_of_messages_lets_three_agents_exclude_each_other() -> None:
    """Of three, one is excluded at most, so nobody promises twice: the search is complete."""
    states, depth, found = explored(3, 3)
    assert not found
    assert (states, depth) == (3052, 6)


@pytest.mark.parametrize("rules", [VotesWithoutMajority, TakesBack, TrustsSuspicion])
def test_negative_control_without_one_rule_they_do(rules: type[Membership]) -> None:
    assert explored(3, 3, rules)[2]


def by_chance(agents: int, seed: int, rules: type[Membership] = Membership) -> tuple[bool, bool]:
    """Whether there was a mutual exclusion, and whether there was any exclusion, in a random walk."""
    draw, swarm, any_excluded = random.Random(seed), beginning(agents), False
    for _ in range(40 * agents):
        number = draw.randrange(agents)
        agent = swarm[number]
        heard = tuple(
            old if sender == number or draw.random() < 0.5 else draw.randint(max(old, 0), len(other.said) - 1)
            for sender, (old, other) in enumerate(zip(agent.heard, swarm, strict=True))
        )
        peers = [peer for peer in range(agents) if peer != number]
        suspected = frozenset(draw.sample(peers, draw.randint(0, agents // 2)))
        acted = agent.acts(number, swarm, heard, suspected, rules=rules)
        swarm = (*swarm[:number], acted, *swarm[number + 1 :])
        any_excluded |= bool(acted.excluded)
        if mutual(swarm):
            return True, any_excluded
    return False, any_excluded


@pytest.mark.parametrize("agents", [4, 5, 6, 7])
def test_nor_do_more_agents_by_chance(agents: int) -> None:
    walks = [by_chance(agents, seed) for seed in range(200)]
    assert not any(found for found, _ in walks)
    assert sum(excluded for _, excluded in walks) > 20, "walks that exclude nobody show nothing"


@pytest.mark.parametrize("rules", [VotesWithoutMajority, TakesBack, TrustsSuspicion])
def test_negative_control_by_chance(rules: type[Membership]) -> None:
    assert any(by_chance(5, seed, rules)[0] for seed in range(200))


# -- liveness: what the rules are for ---------------------------------------------------------------------------------


def settled(agents: int, heard_by: Mapping[int, Set[int]], ended: Set[int] = NOBODY) -> list[frozenset[int]]:
    """Whom each agent excludes after a while, if it hears these others and suspects all that it does not hear."""
    everybody = frozenset(range(agents))
    all_memberships = {i: Membership(i, everybody - {i}) for i in sorted(everybody - ended)}
    for _ in range(6):
        said = {i: membership.exclusions for i, membership in all_memberships.items()}
        for i, membership in all_memberships.items():
            told = {peer: said[peer] for peer in heard_by[i] & said.keys()}
            membership.update(everybody - heard_by[i] - {i} - ended, told, ended)
    return [all_memberships[i].excluded if i in all_memberships else NOBODY for i in sorted(everybody)]


def test_a_frozen_agent_is_excluded_by_all_others() -> None:
    others = {i: frozenset(range(5)) - {i} for i in range(6)}
    assert settled(6, others | {5: NOBODY}, ended=NOBODY)[:5] == [frozenset({5})] * 5


@pytest.mark.parametrize(
    ("groups", "excluded"),
    [
        ([{0, 1, 2, 3}, {4, 5}], [{4, 5}] * 4 + [set(), set()]),
        ([{0, 1, 2}, {3, 4, 5}], [set()] * 6),
        ([{0, 1}, {2, 3}, {4, 5}], [set()] * 6),
    ],
    ids=["four and two", "halves", "thirds"],
)
def test_of_a_split_swarm_only_a_majority_goes_on(groups: list[set[int]], excluded: list[set[int]]) -> None:
    heard_by = {i: frozenset(group - {i}) for group in groups for i in group}
    assert settled(6, heard_by) == excluded


def test_who_is_known_to_have_ended_needs_no_exclusion_and_has_no_vote() -> None:
    heard_by = {i: frozenset({0, 1, 2, 3}) - {i} for i in range(4)}
    assert settled(6, heard_by, ended=frozenset({4, 5})) == [NOBODY] * 6
    heard_by = {i: frozenset({0, 1, 2}) - {i} for i in range(3)} | {3: NOBODY}
    assert settled(6, heard_by, ended=frozenset({4, 5})) == [NOBODY] * 6, "three of six are no majority"


def test_an_agent_started_amid_a_flight_promises_nothing() -> None:
    membership = Membership(0, [1, 2])
    told = {1: Exclusions(suspected=frozenset({2}), promised=frozenset({2}))}
    membership.update({2}, told, NOBODY, votes=False)
    assert membership.exclusions == Exclusions()
    membership.update({2}, told, NOBODY)
    assert membership.exclusions.promised == {2}


@pytest.mark.parametrize("peers", [1, 2, 3])
def test_who_is_one_of_two_is_never_excluded(peers: int) -> None:
    """The only peer is no majority, however long it does not hear this agent; two that agree are one."""
    agent = Membership(0, range(1, peers + 1))
    others = {i: Membership(i, {0, *range(1, peers + 1)} - {i}) for i in range(1, peers + 1)}
    for _ in range(3):
        told = {i: other.exclusions for i, other in others.items()}
        for i, other in others.items():
            other.update({0}, {j: told[j] for j in told.keys() - {i}}, NOBODY)
    assert agent.may_be_excluded is any(0 in other.excluded for other in others.values()) is (peers > 1)
