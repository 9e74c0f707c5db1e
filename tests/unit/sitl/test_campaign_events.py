"""Scenario events that begin and end: when they act on a flight, and what the agents then receive and see."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.events import Freeze, Restart, ScenarioEvent, Split
from swarmctl.bus.bus import agent_name
from swarmctl.bus.topics import OPERATOR
from swarmctl.config import load

NAMES = [agent_name(i) for i in range(3)]
EVERYBODY = {*NAMES, OPERATOR}


class Flight:
    """Three agents in flight."""

    def __init__(self, event: ScenarioEvent) -> None:
        self.lockstep = Lockstep(load(None, ["sitl.start=air"]))
        self._event = event

    def until(self, t_s: float) -> None:
        """Fly on; mission time is the flight's."""
        while (now_s := self.lockstep.clock.now_us() * 1e-6) < t_s:
            self._event.step(self.lockstep, now_s, np.zeros((3, 3)), np.zeros((3, 3)))
            self.lockstep.step()

    def alive(self, agent: int) -> frozenset[str]:
        return self.lockstep.hub.alive(agent_name(agent))

    def heard_us(self, agent: int, peer: int) -> int:
        """Return the age of the newest status that an agent has of a peer, as its clock tells."""
        flown = self.lockstep.agents[agent]
        assert flown is not None
        stamp_us: int = flown._world_model.statuses._newest[peer].utc_us
        return self.lockstep.clock.utc_us() - stamp_us

    def ticks(self, agent: int) -> int:
        return len(self.lockstep.logs[agent].rows)


def test_a_split_parts_the_groups_and_heals() -> None:
    flight = Flight(Split([{0, 1}, {2}], 1.0, 2.0))
    flight.until(1.0)
    assert flight.heard_us(0, 2) < 300_000
    flight.until(2.9)
    assert flight.heard_us(0, 1) < 300_000
    assert flight.heard_us(0, 2) > 1_800_000 and flight.heard_us(2, 1) > 1_800_000
    assert flight.alive(0) == {NAMES[0], NAMES[1], OPERATOR}
    assert flight.alive(2) == {NAMES[2], OPERATOR}
    flight.until(3.5)
    assert flight.heard_us(0, 2) < 300_000
    assert flight.alive(0) == flight.alive(2) == EVERYBODY


def test_a_split_of_infinite_length_never_heals() -> None:
    flight = Flight(Split([{0}, {1, 2}], 1.0, math.inf))
    flight.until(6.0)
    assert flight.alive(0) == {NAMES[0], OPERATOR}
    assert flight.heard_us(1, 0) > 4_500_000


@pytest.mark.parametrize(("for_s", "after"), [(1.0, 50), (math.inf, 0)])
def test_a_frozen_agent_stops_ticking_and_stays_on_the_bus(for_s: float, after: int) -> None:
    flight = Flight(Freeze(1, 1.0, for_s))
    flight.until(1.0)
    before = flight.ticks(1)
    flight.until(2.0)
    assert flight.ticks(1) == before
    assert flight.ticks(0) == before + 50
    assert flight.alive(0) == EVERYBODY
    flight.until(3.0)
    assert flight.ticks(1) == before + after


def test_a_process_that_dies_is_started_again_as_another_one() -> None:
    flight = Flight(Restart(1, 4.0, 1.0))
    flight.until(3.9)
    before = flight.lockstep.agents[1]
    assert before is not None and NAMES[1] in flight.alive(0)
    flight.until(4.9)
    assert flight.lockstep.agents[1] is None and NAMES[1] not in flight.alive(0)
    flight.until(6.0)
    assert flight.lockstep.agents[1] not in (None, before) and NAMES[1] in flight.alive(0)
    assert flight.heard_us(0, 1) < 300_000
