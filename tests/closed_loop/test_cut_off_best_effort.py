"""Swarms of several computers that fly in best effort, and are cut off from each other amid a meeting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent import assembly
from swarmctl.bus.bus import agent_name
from swarmctl.config import load
from swarmctl.core.closest_pair import closest_pair_m
from tests.closed_loop.conftest import COARSE, mission_t_s

CUT_AT_S, CUT_S = 0.5, 5.0
SWAP = (
    *COARSE,
    "sitl.start=air",
    "swarm.agents=4",
    "start.positions_ned_m=[[3,0,0],[0,3,0],[-3,0,0],[0,-3,0]]",
    "mission.kind=swap",
    "mission.swap.travel_s=6",
    "mission.duration_s=60",
)


def hosts(*agents: tuple[int, ...]) -> str:
    listed = (f'{{name="h{i}",address="10.0.0.{i + 1}:7448",agents={list(own)}}}' for i, own in enumerate(agents))
    return f"hosts=[{','.join(listed)}]"


@dataclass(frozen=True)
class Flown:
    """What came of a flight, on true states."""

    least_m: float
    fastest_m_s: float  # when the cut ended, or 8 s after it began
    paused: tuple[bool, ...]  # who waited then
    left_m: float  # the longest way to a goal at the end


def fly(*apart: tuple[int, ...], lost: tuple[int, ...] = (), until_s: float = 16.0) -> Flown:
    """Fly a swap of hosts with these agents, whose links are all cut for a while, or of which one is lost for good."""
    flight = Lockstep(load(None, (*SWAP, hosts(*apart), "bus.relay=true")))
    least_m, is_cut = np.inf, False
    seen: tuple[float, tuple[bool, ...]] = (np.inf, ())  # speed, and who is paused
    goals_ned_m = -np.array(flight.config.starts_ned_m())
    while not mission_t_s(flight) > until_s:
        flight.step()
        t_s = mission_t_s(flight)
        if t_s >= CUT_AT_S and not is_cut:
            is_cut = True
            for agent in lost:
                flight.agents[agent] = None
                flight.hub.detach(agent_name(agent))
            if not lost:
                flight.hub.split([frozenset(map(agent_name, own)) for own in apart])
        truth = flight.world.truth_rows()
        if t_s < CUT_AT_S + CUT_S:  # until it ends
            fastest_m_s = float(np.linalg.norm(truth["vel_ned_m_s"], axis=1).max())
            living = [agent for agent in flight.agents if agent is not None]
            seen = fastest_m_s, tuple(agent._mission.interruptions.paused for agent in living)
        else:
            flight.hub.heal()
        least_m = min(least_m, float(closest_pair_m(truth["pos_ned_m"][np.newaxis])[0]))
    away_m = np.linalg.norm((truth["pos_ned_m"] - goals_ned_m)[:, :2], axis=1)
    left_m = float(max(away_m[i] for i in range(4) if i not in lost))
    return Flown(least_m, *seen, left_m)


def test_halves_that_do_not_hear_each_other_rest_until_they_do() -> None:
    flown = fly((0, 1), (2, 3))
    assert flown.least_m >= 0.8
    assert (flown.paused, flown.fastest_m_s < 0.1) == ((True,) * 4, True)
    assert flown.left_m < 0.4


def test_negative_control_halves_that_take_missing_tokens_for_deaths_come_too_close(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(assembly, "_quorum", lambda _: 1)
    assert fly((0, 1), (2, 3), until_s=7.0).least_m < 0.6


def test_a_majority_goes_on_and_keeps_clear_of_who_rests_cut_off() -> None:
    flown = fly((0,), (1, 2, 3), until_s=8.0)
    assert flown.least_m >= 0.75
    assert flown.paused == (True, False, False, False)


def test_a_majority_goes_on_without_a_host_that_is_lost() -> None:
    assert fly((0,), (1,), (2, 3), lost=(1,), until_s=6.0).paused == (False,) * 3


@pytest.mark.parametrize(("relay", "quorum"), [(True, 3), (False, 4)])
def test_without_relays_nobody_is_taken_for_dead(relay: bool, quorum: int) -> None:
    """Two hosts may each see a third one, and not each other."""
    config = load(None, (*SWAP, hosts((0, 1), (2, 3)), f"bus.relay={str(relay).lower()}"))
    assert assembly._quorum(config) == quorum
    assert assembly._quorum(load(None, SWAP)) == 1, "on one computer who has left is dead"
