"""Agents that commit, and crowds of them on networks that delay and lose."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.protocol import Commitments, acknowledgements
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.reference.quintic import quintic_to
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.trajectory_message import TrajectoryMessage
from swarmctl.core.types import Array
from tests import builders

UTC_US = 1_700_000_000_000_000
TICK_US = 40_000
SEPARATION = SeparationParams(radius_m=0.9)
HARD_MIN_M = SEPARATION.radius_m - SEPARATION.certify_slack_m


def committing(agent: int, *, max_keep_outs: int, separation: SeparationParams = SEPARATION) -> Commitments:
    params = CommitParams()
    planner = TrajectoryPlanner(
        agent,
        params,
        MpcParams(u_max=0.25),
        VehicleModelParams(),
        separation,
        max_keep_outs=max_keep_outs,
        stopwatch_ns=lambda: 0,
    )
    return Commitments(agent, params, planner)


def grid_steps(agent: Commitments) -> int:
    """Return the number of steps that keep-outs in `Situation.others` cover."""
    assert isinstance(agent._planner, TrajectoryPlanner)
    return agent._planner.steps


@dataclass(kw_only=True)
class Network:
    """A network with seeded delays and losses, and an outage."""

    delay_us: tuple[int, int] = (0, 0)
    loss_01: float = 0.0
    dark_us: tuple[int, int] = (0, 0)
    seed: int = 3
    _under_way: list[tuple[int, int, TrajectoryMessage]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def send(self, now_us: int, receiver: int, message: TrajectoryMessage) -> None:
        if self._random.random() >= self.loss_01 and not self.dark_us[0] <= now_us - UTC_US < self.dark_us[1]:
            self._under_way.append((now_us + 1 + self._random.randint(*self.delay_us), receiver, message))

    def arrived(self, now_us: int, receiver: int) -> list[TrajectoryMessage]:
        mine = [m for m in self._under_way if m[1] == receiver and m[0] <= now_us]
        self._under_way = [m for m in self._under_way if not (m[1] == receiver and m[0] <= now_us)]
        return [message for _, _, message in sorted(mine, key=lambda m: m[0])]


class Crowd:
    """Agents that track commitments exactly, from a ring through its middle to the other side."""

    def __init__(self, count: int, network: Network) -> None:
        angle = 2.0 * np.pi * np.arange(count) / count
        self.starts = np.stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), np.full(count, -2.0)], axis=1)
        self.agents = [committing(i, max_keep_outs=count) for i in range(count)]
        self.known: list[dict[int, TrajectoryMessage]] = [{} for _ in range(count)]
        self.network, self.now_us, self.seq = network, UTC_US, 0
        for agent, start in zip(self.agents, self.starts, strict=True):
            agent.begin(start, np.zeros(3), UTC_US)

    def step(self) -> None:
        self.now_us += TICK_US
        self.seq += 1
        ids = range(len(self.agents))
        for i in ids:
            for message in self.network.arrived(self.now_us, i):
                if message.agent not in self.known[i] or message.seq > self.known[i][message.agent].seq:
                    self.known[i][message.agent] = self.received(message)
        for i, agent in enumerate(self.agents):
            now_us = self.clock_us(i)
            agent.update(now_us, self.known[i], set(ids) - {i})
            if agent.is_due(now_us):
                begin_us = now_us + agent.lead_us
                desired = DesiredReference(partial(self.wanted, i))
                agent.propose(
                    builders.situation(
                        utc_us=now_us, begin_us=begin_us, desired=desired, peers=self.known[i], others=()
                    )
                )
        for i, agent in enumerate(self.agents):
            assert agent.committed is not None
            message = builders.trajectory_message(
                agent=i,
                seq=self.seq,
                sent_utc_us=self.now_us,
                committed=agent.committed,
                proposal=agent.proposal,
                acknowledged=acknowledgements(self.known[i], set()),
            )
            for j in ids:
                if j != i:
                    self.network.send(self.now_us, j, message)

    def clock_us(self, agent: int) -> int:
        """UTC by the clock of an agent."""
        return self.now_us

    def received(self, message: TrajectoryMessage) -> TrajectoryMessage:
        """Return a message as it is decoded."""
        return message

    def wanted(self, agent: int, offsets_s: Array) -> tuple[Array, Array]:
        goal = self.starts[agent] * np.array([-1.0, -1.0, 1.0])
        t_s = (self.now_us - UTC_US) * 1e-6 + offsets_s
        return quintic_to(self.starts[agent], np.zeros(3), goal, 1.5, accel_m_s2=1.0).sample(t_s)

    def committed_m(self) -> float:
        """Smallest distance, from now to their ends, of any two trajectories that are followed now."""
        followed = {i: agent.committed for i, agent in enumerate(self.agents) if agent.committed is not None}
        end_us = max(self.now_us, *(trajectory.end_utc_us for trajectory in followed.values()))
        ahead_us = np.arange(0, end_us - self.now_us + 50_001, 50_000)
        places = [each.sample(self.clock_us(i) + ahead_us)[0] for i, each in followed.items()]
        return float(closest_pair_m(np.stack(places, axis=1)).min())

    def run(self, seconds: float) -> float:
        """Run for some time and return the smallest distance between commitments [m]."""
        least = np.inf
        for _ in range(round(seconds * 1e6 / TICK_US)):
            self.step()
            least = min(least, self.committed_m())
        return float(least)

    @property
    def committed(self) -> int:
        return sum(agent.counts.committed for agent in self.agents)
