"""Vehicles whose agents freeze where nobody can tell who is cut off: one of two, and two of four."""

from __future__ import annotations

import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent.planning.separation_policy import Guaranteed
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.commit.membership import Membership
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.commit.situation import Situation
from tests.closed_loop.conftest import Flight, fly_now, mission_t_s

PASSED_S = 4.4
SWAP = ("agent.rate_hz=25", "sitl.start=air", "separation.mode=guaranteed", "mission.kind=swap")
TWO = (*SWAP, "swarm.agents=2", "start.positions_ned_m=[[-2.9475,0.1762,-3],[3.0374,-0.2306,-3]]")
HEAD_ON = (*SWAP, "swarm.agents=2", "start.positions_ned_m=[[2.5862,1.5048,-3],[-2.6043,-1.5153,-3]]")
FOUR = (
    *(*SWAP, "swarm.agents=4"),
    "start.positions_ned_m=[[-2.3554,-1.9327,-3],[1.8384,-2.3011,-3],[2.3737,1.8975,-3],[-1.8638,2.3367,-3]]",
)


def frozen(sets: tuple[str, ...], agents: set[int], at_s: float) -> Flight:
    """Fly ArduCopters that swap places, some of whose agents freeze; theirs fly on for 2 s, as they were told last."""
    return fly_now(
        *(*sets, "mission.swap.travel_s=6", "mission.duration_s=60"),
        config="ardupilot_sitl.toml",
        at={at_s: lambda running: running.frozen.update(agents)},
        until=lambda running: mission_t_s(running) > PASSED_S,
    )


def evasions(running: Lockstep) -> int:
    """Return how many commitments have been changed without acknowledgement."""
    policies = [agent._separation for agent in running.agents if agent is not None]
    return sum(policy._coordination.counts.evasive for policy in policies if isinstance(policy, Guaranteed))


@pytest.mark.parametrize("at_s", [0.6, 1.0])
@pytest.mark.usefixtures("configured_starts")
def test_one_of_two_stops_before_the_vehicle_of_the_other(monkeypatch: pytest.MonkeyPatch, at_s: float) -> None:
    assert frozen(TWO, {1}, at_s).separation_m() >= 0.85
    monkeypatch.setattr(Commitments, "stop_before", lambda *_, **__: None)
    assert frozen(TWO, {1}, at_s).separation_m() < 0.48, "negative control: bodies touch"


@pytest.mark.usefixtures("configured_starts")
def test_one_of_two_leaves_its_places_where_the_other_flies_at_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert frozen(HEAD_ON, {1}, 1.0).separation_m() >= 0.85
    stop_before = Commitments.stop_before

    def only_stops(self: Commitments, now: Situation, doubted: KeepOuts, *, leaves: bool) -> None:
        stop_before(self, now, doubted, leaves=False)

    monkeypatch.setattr(Commitments, "stop_before", only_stops)
    assert frozen(HEAD_ON, {1}, 1.0).separation_m() < 0.48, "negative control: by stops alone bodies touch"


@pytest.mark.usefixtures("configured_starts")
def test_who_may_be_excluded_flies_on_as_it_has_committed_to(monkeypatch: pytest.MonkeyPatch) -> None:
    """If it was cut off, the others would exclude it, and rely on it to rest where its commitment ends."""
    assert evasions(frozen(FOUR, {0, 2}, 0.6).lockstep) == 0
    monkeypatch.setattr(Membership, "may_be_excluded", property(lambda _: False))
    assert evasions(frozen(FOUR, {0, 2}, 0.6).lockstep) > 0, "negative control"
