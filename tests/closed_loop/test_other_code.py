"""Hosts whose agents fly other code than each other: another version of swarmctl, or other own modules."""

from __future__ import annotations

import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent import assembly
from swarmctl.config import Config, load
from swarmctl.core.types import Phase
from tests.closed_loop.conftest import COARSE
from tests.closed_loop.test_operator import fly_for, phase

HOSTS = (
    *COARSE,
    "swarm.agents=2",
    "start.positions_ned_m=[[0,0,-3],[4,0,-3]]",
    'hosts=[{name="alpha",address="10.20.0.1:7448",agents=[0]},{name="bravo",address="10.20.0.2:7448",agents=[1]}]',
)


def after_12_s() -> Lockstep:
    flight = Lockstep(load(None, HOSTS))
    fly_for(flight, 12.0)
    return flight


def test_hosts_of_other_code_stay_on_the_ground_and_name_both(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = iter(("swarmctl 1.0 (aaaaaaaa)", "swarmctl 1.1 (bbbbbbbb)"))
    monkeypatch.setattr(assembly, "shared_code", lambda config: next(codes))
    flight = after_12_s()
    for agent, told in enumerate(
        (
            "waits for agent-1 to fly the same code: swarmctl 1.1 (bbbbbbbb) there, swarmctl 1.0 (aaaaaaaa) here",
            "waits for agent-0 to fly the same code: swarmctl 1.0 (aaaaaaaa) there, swarmctl 1.1 (bbbbbbbb) here",
        )
    ):
        assert phase(flight, agent) is Phase.STANDBY
        alert = flight.agents[agent]._alerts.newest(flight.clock.now_us())  # type: ignore[union-attr]
        assert alert is not None
        assert alert.text == told


def test_negative_control_hosts_of_the_same_code_take_off() -> None:
    said = assembly.shared_code(load(None, HOSTS))
    assert said.startswith("swarmctl ")
    assert not assembly.shared_code(Config()), "one computer has one"
    flight = after_12_s()
    assert min(phase(flight, 0), phase(flight, 1)) > Phase.STANDBY
