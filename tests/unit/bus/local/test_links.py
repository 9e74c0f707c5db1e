"""Impaired links of the bus in memory: bad periods and jitter, over many draws."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.local.links import Impairments
from swarmctl.bus.topics import COMMAND, PATH, TICK, Topic
from swarmctl.core.clock import SimClock

STEP_US = 20_000
HOUR = 3600 * 50  # steps


class Traffic:
    """Agents that publish in every step, or seldom, and what of it arrives.

    Attributes:
        arrived: (sender, receiver) -> (step of sending, time of arrival since then [us]), in the order of arrival.
    """

    def __init__(
        self,
        steps: int,
        *,
        order: Sequence[int] = (0, 1),
        senders: Sequence[int] = (0, 1, 2),
        topic: Topic = PATH,
        every: int = 1,
        seed: int = 5,
        **impairments: Any,
    ) -> None:
        clock = SimClock()
        hub = LocalHub(clock.now_us, seed, Impairments(**impairments))
        buses = {i: hub.connect(agent_name(i)) for i in order}
        self.arrived: dict[tuple[str, str], list[tuple[int, int]]] = {
            (agent_name(i), agent_name(j)): [] for i, j in itertools.permutations(sorted(order), 2)
        }
        for step in range(steps):
            for i in order:
                for sender, payload in buses[i].receive(topic):
                    sent = int(payload)
                    age_us = clock.now_us() - sent * STEP_US
                    self.arrived[sender, agent_name(i)].append((sent, age_us))
                if step % every == 0 and i in senders:
                    buses[i].publish(topic, str(step).encode())
            clock.advance(STEP_US)

    def steps(self, sender: int = 0, receiver: int = 1) -> list[int]:
        return [step for step, _ in self.arrived[agent_name(sender), agent_name(receiver)]]

    def gaps_s(self) -> Iterator[float]:
        """Yield the lengths of the runs of lost messages."""
        for before, after in itertools.pairwise(self.steps()):
            if after > before + 1:
                yield (after - before - 1) * STEP_US * 1e-6


@pytest.mark.parametrize(("burst_01", "burst_s"), [(0.1, 1.0), (0.6, 0.5)])
def test_a_link_is_bad_for_the_asked_share_of_time_in_periods_of_the_asked_length(
    burst_01: float, burst_s: float
) -> None:
    traffic = Traffic(HOUR, senders=[0], burst_01=burst_01, burst_s=burst_s)
    assert 1.0 - len(traffic.steps()) / HOUR == pytest.approx(burst_01, rel=0.15)
    assert np.mean(list(traffic.gaps_s())) == pytest.approx(burst_s, rel=0.15)


def test_bad_periods_are_independent_per_direction() -> None:
    traffic = Traffic(HOUR, burst_01=0.3)
    both_good = set(traffic.steps(0, 1)) & set(traffic.steps(1, 0))
    assert len(both_good) / HOUR == pytest.approx(0.7**2, rel=0.1)


def test_a_link_may_be_bad_from_the_first_message_on() -> None:
    first = [0 in Traffic(3, seed=seed, burst_01=0.5).steps() for seed in range(200)]
    assert 0.4 < np.mean(first) < 0.6


def test_bad_periods_do_not_depend_on_how_often_is_sent_nor_on_the_loss() -> None:
    every_step = set(Traffic(5000, burst_01=0.4).steps())
    assert Traffic(5000, every=50, burst_01=0.4).steps() == [step for step in range(0, 5000, 50) if step in every_step]
    without_bursts = set(Traffic(5000, loss_01=0.3).steps())
    assert set(Traffic(5000, burst_01=0.4, loss_01=0.3).steps()) == every_step & without_bursts


def test_reliable_topics_are_spared() -> None:
    assert Traffic(500, topic=COMMAND, burst_01=0.9).steps() == list(range(499))


def test_jitter_is_uniform_on_top_of_the_delay_and_reorders_messages() -> None:
    traffic = Traffic(20_000, topic=TICK, delay_us=40_000, jitter_us=200_000)
    ages_ms = 1e-3 * np.array([age_us for _, age_us in traffic.arrived["agent-0", "agent-1"]])
    assert (ages_ms.min(), ages_ms.max()) == (40.0 + 20.0, 240.0), "rounded up to the receiver's next step"
    shares = [float(np.mean(ages_ms == bin_ms)) for bin_ms in range(60, 241, 20)]
    assert shares == pytest.approx([0.1] * 10, abs=0.015)
    steps = traffic.steps()
    assert steps != sorted(steps)
    assert len(set(steps)) == len(steps) > 20_000 - 15, "none is lost"


def test_jitter_does_not_reorder_reliable_messages() -> None:
    steps = Traffic(2000, topic=COMMAND, jitter_us=200_000).steps()
    assert steps == list(range(len(steps)))
    assert len(steps) > 2000 - 15


def test_every_link_draws_its_own_jitter() -> None:
    traffic = Traffic(200, order=(0, 1, 2), jitter_us=100_000)
    ages = {tuple(sorted(arrived)) for arrived in traffic.arrived.values()}
    assert len(ages) == 6


ALL: dict[str, Any] = {"delay_us": 30_000, "loss_01": 0.1, "burst_01": 0.3, "burst_s": 0.5, "jitter_us": 90_000}


def test_a_seed_gives_the_same_deliveries_in_whatever_order_agents_tick() -> None:
    flown = Traffic(2000, order=(0, 1, 2), **ALL)
    assert Traffic(2000, order=(2, 0, 1), **ALL).arrived == flown.arrived
    assert Traffic(2000, order=(0, 1, 2), seed=6, **ALL).arrived != flown.arrived


def test_what_a_participant_listens_to_does_not_change_what_it_loses() -> None:
    heard = []
    for subscriptions in (None, {PATH: None}, {PATH: [agent_name(0)]}):
        clock = SimClock()
        hub = LocalHub(clock.now_us, 5, Impairments(loss_01=0.3, jitter_us=9_000))
        sender, receiver = hub.connect(agent_name(0)), hub.connect(agent_name(1), subscriptions)
        arrived = []
        for step in range(300):
            sender.publish(TICK, b"")
            sender.publish(PATH, str(step).encode())
            clock.advance(STEP_US)
            arrived += receiver.receive(PATH)
        assert 100 < len(arrived) < 250
        assert bool(receiver.receive(TICK)) == (subscriptions is None)
        heard.append(arrived)
    assert heard[0] == heard[1] == heard[2]
