"""An agent amid others evades a silent vehicle, but to nothing that conflicts with what others propose."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.commitment_messages import decode_trajectory_message, encode_trajectory_message
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.collision.separation import SeparationParams, keep_out_of_commitment
from swarmctl.core.trajectory import Trajectory, resting
from swarmctl.core.trajectory_message import ANYWHERE, Proposal, Reach
from tests import builders
from tests.benches.agent_and_peer import HERE, RATE_HZ, SPEED_M_S, STRETCH_M, Bench

FROM, TO = HERE + np.array([0.0, 2.6, -1.2]), HERE + np.array([0.0, 0.0, -1.2])  # of a proposal of peer 2: above


class Amid(Bench):
    """Beside the peer, which is near and may fall silent, peers 2 and 3, which are always heard.

    Args:
        far_hz: rate at which those that are far are told.
        places: (3,) of peers 2 and 3, from the agent.
        far: whether these two are.
        rate_hz: of the ticks of all.
    """

    def __init__(
        self, far_hz: float, places: dict[int, np.ndarray], *, far: bool = False, rate_hz: float = RATE_HZ
    ) -> None:
        super().__init__(far_hz=far_hz, peers=(1, 2, 3), rate_hz=rate_hz)
        self.others = {agent: self.hub.connect(agent_name(agent)) for agent in places}
        self.alive |= {agent_name(agent) for agent in places}
        self.places, self.count = places, 0
        far_reach = Reach(far=frozenset((0, 1)), speed_m_s=SPEED_M_S, stretch_m=STRETCH_M)
        self.others_reach = far_reach if far else ANYWHERE
        self.tube_2_m = 0.16
        self.proposal: Proposal | None = None  # of peer 2
        self.acknowledges: dict[int, dict[int, int]] = {agent: {} for agent in places}
        self.said: dict[int, dict[int, tuple[int, int]]] = {agent: {} for agent in places}
        self.coordination._non_participants.without_setpoints = self.comes_closer  # type: ignore[method-assign]
        self.is_coming = False

    def comes_closer(self, agents: Set[int], t0_utc_us: int) -> KeepOuts:
        """Return where the autopilot of the silent vehicle flies it: past the agent."""
        if not agents or not self.is_coming:
            return KeepOuts()
        separation, steps = SeparationParams(), self.coordination._non_participants._steps + 1
        way = HERE + np.array([[max(-0.4, 1.6 - 0.1 * k), 0.0, 0.0] for k in range(steps)])
        return KeepOuts([keep_out_of_commitment(way, agent, separation, separation.budget) for agent in agents])

    def tell_others(self) -> None:
        self.count += 1
        utc_us = self.clock.utc_us()
        for agent, bus in self.others.items():
            for topic in (topics.TRAJECTORY, topics.FAR_TRAJECTORY):
                for sender, payload in bus.receive(topic):
                    heard = decode_trajectory_message(payload) if sender == agent_name(0) else None
                    if heard is not None:
                        self.said[agent] = {0: (heard.sent_utc_us, utc_us)}
                        self.acknowledges[agent] = {0: heard.proposal.number} if heard.proposal else {}
            place = HERE + self.places[agent]
            path = builders.predicted_path(
                agent=agent, seq=self.count, t0_utc_us=utc_us, dt_us=20_000, pos_ned_m=np.tile(place, (41, 1))
            )
            bus.publish(topics.PATH, encode_path(path))
            message = builders.trajectory_message(
                agent=agent,
                seq=self.count,
                sent_utc_us=utc_us,
                is_committed=self.count > 1,
                committed=resting(place, utc_us, 100_000),
                tube_m=self.tube_2_m if agent == 2 else 0.16,
                heard=self.said[agent],
                proposal=self.proposal if agent == 2 else None,
                acknowledged=self.acknowledges[agent],
            )
            payload = encode_trajectory_message(replace(message, reach=self.others_reach))
            bus.publish(topics.FAR_TRAJECTORY, payload)
            bus.publish(topics.TRAJECTORY, payload)

    def all_speak(self) -> None:
        self.send()
        self.tell_others()

    def evasions_while_the_peer_is_silent(self, seconds: float) -> int:
        before, self.is_coming = self.coordination.counts.evasive, True
        self.fly(seconds, each=self.tell_others)
        return self.coordination.counts.evasive - before


@pytest.mark.parametrize(("far_hz", "away_m"), [(0.0, 40.0), (4.0, 8.0), (4.0, 40.0)])
def test_a_silent_near_one_is_evaded_where_most_are_heard_though_they_are_far(far_hz: float, away_m: float) -> None:
    places = {2: np.array([away_m, 2.0, 0.0]), 3: np.array([-away_m, 2.0, 0.0])}
    agent = Amid(far_hz, places, far=bool(far_hz) and away_m > 20.0)
    agent.fly(2.0, each=agent.all_speak)
    assert agent.evasions_while_the_peer_is_silent(0.6) >= 1


@pytest.mark.parametrize(("rate_hz", "evades"), [(50.0, True), (10.0, False)])
def test_one_of_slow_ticks_whose_last_two_messages_were_lost_is_not_silent(rate_hz: float, evades: bool) -> None:
    """At 50 Hz so long a silence is of ten."""
    agent = Amid(0.0, {2: np.array([8.0, 2.0, 0.0]), 3: np.array([-8.0, 2.0, 0.0])}, rate_hz=rate_hz)
    agent.fly(3.0, each=agent.all_speak)
    assert (agent.evasions_while_the_peer_is_silent(0.3) > 0) is evades
    assert agent.evasions_while_the_peer_is_silent(0.6) > 0 or evades


def test_control_who_hears_nobody_may_be_cut_off_and_evades_nothing() -> None:
    agent = Amid(4.0, {2: np.array([40.0, 2.0, 0.0]), 3: np.array([-40.0, 2.0, 0.0])}, far=True)
    agent.fly(2.0, each=agent.all_speak)
    agent.fly(0.8)
    agent.is_coming = True
    agent.fly(0.6)
    assert agent.coordination.counts.evasive == 0


@pytest.mark.parametrize("tube_m", [0.16, 0.5])
def test_nothing_is_evaded_to_that_conflicts_with_a_proposal_even_of_one_that_is_not_relied_on(tube_m: float) -> None:
    """It has been acknowledged, and is committed to before the evasion is heard of."""
    agent = Amid(0.0, {2: FROM - HERE, 3: np.array([-8.0, -8.0, 0.0])})
    agent.fly(2.0, each=agent.all_speak)
    utc_us, eased_01 = agent.clock.utc_us(), np.linspace(0.0, 1.0, 21)
    pos = FROM + (TO - FROM) * (eased_01 * eased_01 * (3.0 - 2.0 * eased_01))[:, None]
    vel = 0.5 * (TO - FROM) * (6.0 * eased_01 * (1.0 - eased_01))[:, None]
    wanted = Trajectory(t0_utc_us=utc_us + 500_000, dt_us=100_000, pos_ned_m=pos, vel_ned_m_s=vel)
    agent.proposal = Proposal(number=99, made_utc_us=utc_us, agent=2, trajectory=wanted)
    agent.tube_2_m = tube_m
    agent.fly(0.1, each=agent.all_speak)
    agent.is_coming = True
    for _ in range(30):
        agent.fly(0.02, each=agent.tell_others)
        committed = agent.coordination._commitments.committed
        assert committed is not None
        planner, now_us = agent.coordination._commitments._planner, agent.clock.utc_us()
        assert agent.coordination.counts.evasive == 0 or not planner.conflicts(committed, now_us, [wanted])
