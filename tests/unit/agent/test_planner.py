"""Tests of what a planner forgets when its agent takes the vehicle over again."""

from __future__ import annotations

import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.controllers.kind import Controller


@pytest.mark.parametrize(("kind", "controllers"), [("dmpc", 1), ("open_loop", 2)])
def test_after_a_handover_no_controller_remembers_what_was_before(
    kind: str, controllers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    (agent,) = Lockstep(load(None, ["swarm.agents=1", f"controller.kind={kind}"])).agents
    assert agent is not None
    planner, forgot = agent._planner, list[Controller]()
    flown = {id(controller): controller for controller in (planner.controller, planner._transit)}
    for controller in flown.values():
        monkeypatch.setattr(controller, "reset", lambda controller=controller: forgot.append(controller))
    planner.reset()
    assert forgot == list(flown.values())
    assert len(forgot) == controllers
