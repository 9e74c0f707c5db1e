"""Commitments keep apart whatever happens to the messages; negative controls break the rules one by one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import TrajectoryMessage
from tests.benches.committing_agents import HARD_MIN_M, Crowd, Network

NETWORKS = {
    "ideal": Network(),
    "300 ms": Network(delay_us=(300_000, 300_000)),
    "0 to 400 ms, out of order, 30 % lost": Network(delay_us=(0, 400_000), loss_01=0.3),
    "2 s of silence": Network(delay_us=(20_000, 60_000), loss_01=0.1, dark_us=(1_500_000, 3_500_000)),
}


@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS.keys())
def test_commitments_keep_the_hard_minimum_distance(network: Network) -> None:
    crowd = Crowd(4, network)
    assert crowd.run(6.0) >= HARD_MIN_M - 1e-3
    assert crowd.committed >= 8, "they do move"


class ByTheirOwnClocks(Crowd):
    """Agents whose clocks differ, and who take them for equal, give or take an error.

    Args:
        ahead_us: by which the clock of each is ahead.
        error_us: to which each knows the clocks of the others.
    """

    def __init__(self, ahead_us: list[int], error_us: int) -> None:
        super().__init__(len(ahead_us), Network(delay_us=(20_000, 20_000)))
        self._ahead_us, self._error_us = ahead_us, error_us
        self._seen: dict[int, tuple[Trajectory, Trajectory]] = {}  # as sent, and as received; by the former's identity

    def clock_us(self, agent: int) -> int:
        return self.now_us + self._ahead_us[agent]

    def received(self, message: TrajectoryMessage) -> TrajectoryMessage:
        proposal = message.proposal
        if proposal is not None:
            proposal = replace(proposal, trajectory=self._as_received(proposal.trajectory))
        return replace(message, committed=self._as_received(message.committed), proposal=proposal)

    def _as_received(self, sent: Trajectory) -> Trajectory:
        return self._seen.setdefault(id(sent), (sent, replace(sent, clock_error_us=self._error_us)))[1]


@pytest.mark.parametrize(("error_us", "kept"), [(150_000, True), (0, False)], ids=["", "control: no margin"])
def test_commitments_keep_apart_by_clocks_that_differ_within_their_error(error_us: int, kept: bool) -> None:
    crowd = ByTheirOwnClocks([0, 150_000, 0, 150_000], error_us)
    least_m = crowd.run(5.0)
    assert (least_m >= HARD_MIN_M - 1e-3) is kept
    assert (least_m < HARD_MIN_M - 0.05) is not kept
    assert crowd.committed >= 8, "they do move"


class Relaying(Crowd):
    """Agents 0 and 2 never hear each other; the others pass on what is missed, if they `relay`."""

    def __init__(self, relay: bool) -> None:
        super().__init__(4, Network(delay_us=(20_000, 60_000), loss_01=0.2))
        self._relay = relay

    def step(self) -> None:
        super().step()
        if not self._relay:
            return
        for by in (1, 3):
            for of, to in ((0, 2), (2, 0)):
                if of in self.known[by]:
                    self.network.send(self.now_us, to, self.known[by][of])


@pytest.mark.parametrize("relay", [True, False], ids=["", "control: nobody relays"])
def test_two_that_never_hear_each_other_commit_by_relays(relay: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = Relaying(relay)
    send = crowd.network.send

    def cut(now_us: int, receiver: int, message: TrajectoryMessage) -> None:
        is_direct = message.sent_utc_us == now_us and message.seq == crowd.seq
        if not (is_direct and {receiver, message.agent} == {0, 2}):
            send(now_us, receiver, message)

    monkeypatch.setattr(crowd.network, "send", cut)
    assert crowd.run(4.0) >= HARD_MIN_M - 1e-3
    assert [crowd.agents[i].counts.committed > 0 for i in (0, 2)] == [relay, relay]


class Careless(Crowd):
    """Agents that commit without waiting for acknowledgements."""

    def step(self) -> None:
        super().step()
        for i, agent in enumerate(self.agents):
            if agent.proposal is not None:
                everybody = dict(self.known[i])
                agent.update(self.now_us, everybody, set())


def test_negative_control_commitments_without_acknowledgements_conflict() -> None:
    assert Careless(4, Network(delay_us=(300_000, 300_000))).run(6.0) < HARD_MIN_M - 0.1


def test_without_messages_all_agents_come_to_rest_and_stay_apart() -> None:
    crowd = Crowd(4, Network(delay_us=(20_000, 20_000), dark_us=(1_500_000, 10**9)))
    crowd.run(1.6)
    committed = crowd.committed
    crowd.run(4.0)  # 2 s of plan and the braking after it
    assert crowd.committed - committed <= 4, "what was acknowledged before may still be flown"
    for agent in crowd.agents:
        assert agent.committed is not None
        assert agent.committed.end_utc_us < crowd.now_us
