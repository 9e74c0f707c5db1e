"""How long a launch lets a flight last: until the mission, or the way back, should have ended, and some time more."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

import swarmctl.ops.supervision.supervisor
from swarmctl.core.types import Phase
from tests.benches.scripted_services import ScriptedServices, ends

pytestmark = pytest.mark.process


@pytest.mark.parametrize("phase", [Phase.TRACK, Phase.GOTO_LAND])
@pytest.mark.parametrize(("ends_in_s", "outcome"), [(8.0, "completed"), (0.5, "failed")])
def test_a_flight_may_last_as_long_as_its_agents_say_and_no_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: Phase, ends_in_s: float, outcome: str
) -> None:
    """One that had climbed for an hour needed 330 s for the way back, and was ended as it touched down."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_BEYOND_MISSION_S", 1.0)
    services = ScriptedServices(tmp_path, [ends(0, 4.0)])
    services.phase, services.ends_s = phase, time.monotonic() + ends_in_s
    result = services.fly("mission.duration_s=1")
    assert result.outcome == outcome
    assert any("did not end within" in problem for problem in result.problems) == (outcome == "failed")


@pytest.mark.parametrize("phase", [Phase.STANDBY, Phase.GOTO_START])
def test_who_waits_for_others_or_is_held_before_the_mission_may_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: Phase
) -> None:
    """A host that waited for another one, with `start_timeout_s = 900`, was ended 325 s after its start."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_BEYOND_MISSION_S", 1.0)
    services = ScriptedServices(tmp_path, [ends(0, 4.0)])
    services.phase = phase
    result = services.fly("mission.duration_s=1")
    assert (result.outcome, result.problems) == ("completed", [])


@pytest.mark.parametrize("held", [True, False])
def test_an_operators_hold_has_no_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: bool) -> None:
    """After five minutes beyond the mission one was landed, and the flight had failed."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_BEYOND_MISSION_S", 1.0)
    services = ScriptedServices(tmp_path, [ends(0, 4.0)])
    services.held, services.ends_s = held, time.monotonic()
    result = services.fly("mission.duration_s=1")
    assert result.outcome == ("completed" if held else "failed")


@pytest.mark.parametrize(("connect_timeout_s", "outcome"), [(15.0, "completed"), (0.5, "failed")])
def test_an_agent_may_wait_for_its_vehicle_as_long_as_it_is_told_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, connect_timeout_s: float, outcome: str
) -> None:
    """With `connect_timeout_s = 300` a launch ended after 90 s."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_VEHICLE_S", 1.0)
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_SET_UP_S", 0.5)
    services = ScriptedServices(tmp_path, [ends(0, 4.0)])
    services.phase = Phase.CONNECT
    result = services.fly(f"agent.connect_timeout_s={connect_timeout_s}")
    assert result.outcome == outcome
    assert any("hears no vehicle at the built-in SITL after 1 s" in text for text in result.problems) == (
        outcome == "failed"
    )
