"""Two agents on a line that commit, far from each other at first, by links that are cut at random in either direction.

They fly to and fro at random, mostly towards each other, and are flown exactly.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.protocol import Commitments, acknowledgements
from swarmctl.control.commit.reach import FarPeers
from swarmctl.control.commit.situation import DesiredReference, Situation
from swarmctl.core.trajectory import Trajectory, ending_at_rest, joined, stopping
from swarmctl.core.trajectory_message import TrajectoryMessage
from swarmctl.core.types import Array
from tests import builders

UTC_US = 1_700_000_000_000_000
TICK_US = 100_000
SPEED_M_S = 2.0
APART_M = 1.0
PARAMS = CommitParams(lead_min_s=0.1)
STRETCH_M = (
    SPEED_M_S * (PARAMS.horizon * PARAMS.dt_s + 0.2) + 0.5 * SPEED_M_S**2 / PARAMS.brake_m_s2
)  # as long as they are
_FAR_US = 300_000
_CUT_01 = 0.02  # in a tick
_CUTS_S = (0.4, 1.2, 2.0, 12.0)
_WAYS = ((0,), (1,), (0, 1), (0, 1))  # senders whose link is cut
_STILL = np.zeros(3)


class LinePlanner:
    """Proposes to go on along the line at a random speed for a random time."""

    def __init__(self, towards: float, dice: random.Random) -> None:
        self._towards, self._dice = towards, dice
        self.dt_us, self.steps = TICK_US, 1
        self.speed_m_s = SPEED_M_S * dice.choice((1.0, 1.0, 2.0))

    def proposal(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """Return a proposal that is clear of what is known."""
        north_m_s = self._towards * self.speed_m_s * self._dice.choice((1.0,) * 8 + (0.5, -1.0))
        steps, begin = self._dice.choice((3,) + (PARAMS.horizon,) * 3), np.array(committed.at(now.begin_us)[0])
        vel = np.tile([north_m_s, 0.0, 0.0], (steps + 1, 1))
        pos = begin + 1e-6 * self.dt_us * np.arange(steps + 1)[:, None] * vel
        leaving = ending_at_rest(now.begin_us, self.dt_us, pos, vel, brake_m_s2=PARAMS.brake_m_s2)
        found = joined(committed, leaving, now.utc_us)
        return None if self.conflicts(found, now.utc_us, now.followed) else found

    def conflicts(self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory]) -> bool:
        """Tell whether two are closer than `APART_M` at some time."""
        return any(least_m(trajectory, other, utc_us) < APART_M for other in known)

    def is_clear(self, trajectory: Trajectory, now: Situation) -> bool:
        return True

    def stopping_from(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> Trajectory:
        return stopping(pos_ned_m, vel_ned_m_s, utc_us, self.dt_us, brake_m_s2=PARAMS.brake_m_s2)

    def stopping_candidate(self, committed: Trajectory, brake_us: int, utc_us: int) -> Trajectory:
        return committed

    def evasive_trajectory(self, committed: Trajectory, now: Situation, *, apart: bool = False) -> Trajectory | None:
        return None

    def may_halt_later(self, committed: Trajectory, now: Situation) -> bool:
        return False

    def halting(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        return None


class LineAgent:
    """One of the two."""

    def __init__(self, agent: int, north_m: float, dice: random.Random, far_peers: type[FarPeers]) -> None:
        self.agent, self.peer = agent, 1 - agent
        self.planner = LinePlanner(1.0 if agent == 0 else -1.0, dice)
        self.commitments = Commitments(agent, PARAMS, self.planner)
        self.commitments.begin(np.array([north_m, 0.0, -2.0]), _STILL, UTC_US)
        self.far_peers = far_peers(
            [self.peer], speed_m_s=SPEED_M_S, stretch_m=STRETCH_M, apart_m=APART_M + 0.05, ahead_us=lambda _: 0
        )
        self.known: dict[int, TrajectoryMessage] = {}
        self.confirmed_us: dict[int, int] = {}
        self._spared: frozenset[int] = frozenset()
        self.spared_times = self._seq = self._due_us = 0

    def hear(self, message: TrajectoryMessage) -> None:
        """Take in a message, unless a newer one was heard."""
        if message.agent in self.known and message.seq <= self.known[message.agent].seq:
            return
        self.known[message.agent] = message
        if self.agent in message.heard:
            self.confirmed_us[message.agent] = message.heard[self.agent][0]

    def step(self, utc_us: int) -> None:
        """Apply rules 2 to 4, in the order of `swarmctl.agent.planning.coordination`."""
        commitments = self.commitments
        self.far_peers.update(commitments.trajectories, self.known, utc_us)
        if commitments.proposal is not None:
            trajectory = commitments.proposal.trajectory
            self._spared = spared = self.far_peers.still_spared(self._spared, trajectory, self.known, utc_us)
            before = commitments.counts.committed
            commitments.update(utc_us, {a: i for a, i in self.known.items() if a not in spared}, {self.peer} - spared)
            self.spared_times += bool(spared) * (commitments.counts.committed - before)
        if not commitments.is_due(utc_us):
            return
        near = {a: i for a, i in self.known.items() if a in self.far_peers.near}
        commitments.propose(
            Situation(
                utc_us=utc_us,
                begin_us=utc_us + commitments.lead_us,
                desired=DesiredReference(lambda offsets_s: (np.zeros((len(offsets_s), 3)),) * 2),
                peers=near,
                others=(),
                disturbance_ned_m_s2=_STILL,
            )
        )
        if commitments.proposal is not None:
            trajectory = commitments.proposal.trajectory
            self._spared = spared = self.far_peers.spared(trajectory, self.known, self.confirmed_us, utc_us)
            rest = {a: i for a, i in self.known.items() if a not in near and a not in spared}
            commitments.keep_clear_of(rest, utc_us)

    def says(self, utc_us: int) -> tuple[TrajectoryMessage, bool]:
        """Return the message of this tick, and whether one that is far hears it, too."""
        commitments = self.commitments
        assert commitments.committed is not None
        self._seq += 1
        for_all = utc_us >= self._due_us
        if for_all:
            self._due_us = utc_us + _FAR_US
        reach = self.far_peers.reach(commitments.trajectories, away_m=0.0, speed_m_s=0.0, stops_m=0.0)
        self.far_peers.published(reach, utc_us, for_all=for_all)
        heard = {agent: (message.sent_utc_us, utc_us) for agent, message in self.known.items()}
        message = builders.trajectory_message(
            agent=self.agent,
            seq=self._seq,
            sent_utc_us=utc_us,
            committed=commitments.committed,
            proposal=commitments.proposal,
            acknowledged=acknowledgements(self.known, set()),
            heard=heard,
        )
        return replace(message, reach=reach), for_all


class FarPair:
    """Both, and the links between them."""

    def __init__(self, seed: int, apart_m: float, far_peers: type[FarPeers] = FarPeers) -> None:
        self._dice = dice = random.Random(seed)
        self.agents = [LineAgent(i, i * apart_m, random.Random(seed + i), far_peers) for i in range(2)]
        self._under_way: list[tuple[int, int, TrajectoryMessage]] = []  # arrival, receiver
        self._cut_until_us, self._delay_us = [0, 0], dice.choice((0, 0, 200_000, 600_000))
        self.now_us = UTC_US

    def fly(self, seconds: float) -> float:
        """Fly for some time; return the least distance of two commitments [m]."""
        least = np.inf
        for _ in range(round(1e6 * seconds / TICK_US)):
            self.now_us += TICK_US
            if self._dice.random() < _CUT_01:
                until_us = self.now_us + round(1e6 * self._dice.choice(_CUTS_S))
                for sender in self._dice.choice(_WAYS):
                    self._cut_until_us[sender] = max(until_us, self._cut_until_us[sender])
            for i, agent in enumerate(self.agents):
                self._deliver(i, agent)
                agent.step(self.now_us)
                self._send(agent)
            one, other = (agent.commitments.committed for agent in self.agents)
            assert one is not None and other is not None
            least = min(least, least_m(one, other, self.now_us))
        return float(least)

    def _deliver(self, number: int, agent: LineAgent) -> None:
        now_us = self.now_us
        for _, _, message in sorted(
            (m for m in self._under_way if m[0] <= now_us and m[1] == number), key=lambda m: m[0]
        ):
            agent.hear(message)
        self._under_way = [m for m in self._under_way if m[0] > now_us or m[1] != number]

    def _send(self, agent: LineAgent) -> None:
        message, for_all = agent.says(self.now_us)
        peer = self.agents[agent.peer]
        hears = for_all or agent.agent in peer.far_peers.near or agent.peer not in message.reach.far
        if hears and self.now_us >= self._cut_until_us[agent.agent]:
            arrival_us = self.now_us + self._dice.randint(0, self._delay_us)
            self._under_way.append((arrival_us, agent.peer, message))


def least_m(one: Trajectory, other: Trajectory, utc_us: int) -> float:
    """Return the least distance of two trajectories from now on, which both end at rest [m]."""
    end_us = max(one.end_utc_us, other.end_utc_us, utc_us + 1)
    times = np.append(np.arange(utc_us, end_us, TICK_US // 2), end_us)
    return float(np.abs(one.sample(times)[0][:, 0] - other.sample(times)[0][:, 0]).min())
