"""How long a launch lets a flight last: until the mission, or the way back, should have ended, and some time more."""

from __future__ import annotations

import time
from functools import partial
from itertools import product
from pathlib import Path

import pytest

import swarmctl.ops.supervision.supervisor
from swarmctl.core.types import Phase
from swarmctl.ops.supervision.launch_result import LaunchResult
from tests.benches.at_once import at_once
from tests.benches.scripted_services import ScriptedServices, ends

pytestmark = pytest.mark.process

FLIES_S = 4.0


@pytest.fixture(autouse=True)
def short_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_BEYOND_MISSION_S", 1.0)


def flown(folder: Path, phase: Phase, *, ends_in_s: float | None = None, held: bool = False) -> LaunchResult:
    """Fly an agent that says for how long, or that an operator holds it, beyond a mission of a second."""
    folder.mkdir()
    services = ScriptedServices(folder, [ends(0, FLIES_S)])
    services.phase, services.held = phase, held
    services.ends_s = None if ends_in_s is None else time.monotonic() + ends_in_s
    return services.fly("mission.duration_s=1")


def test_a_flight_may_last_as_long_as_its_agents_say_and_no_longer(tmp_path: Path) -> None:
    """One that had climbed for an hour needed 330 s for the way back, and was ended as it touched down."""

    def judge(phase: Phase, ends_in_s: float, outcome: str) -> None:
        result = flown(tmp_path / f"{phase.name}-{outcome}", phase, ends_in_s=ends_in_s)
        assert result.outcome == outcome
        assert any("did not end within" in problem for problem in result.problems) == (outcome == "failed")

    cells = product((Phase.TRACK, Phase.GOTO_LAND), ((8.0, "completed"), (0.5, "failed")))
    at_once([partial(judge, phase, ends_in_s, outcome) for phase, (ends_in_s, outcome) in cells])


def test_who_waits_for_others_or_is_held_before_the_mission_may_wait(tmp_path: Path) -> None:
    """A host that waited for another one, with `start_timeout_s = 900`, was ended 325 s after its start."""

    def judge(phase: Phase) -> None:
        result = flown(tmp_path / phase.name, phase)
        assert (result.outcome, result.problems) == ("completed", [])

    at_once([partial(judge, phase) for phase in (Phase.STANDBY, Phase.GOTO_START)])


def test_an_operators_hold_has_no_end(tmp_path: Path) -> None:
    """After five minutes beyond the mission one was landed, and the flight had failed."""

    def judge(held: bool) -> None:
        result = flown(tmp_path / str(held), Phase.TRACK, ends_in_s=0.0, held=held)
        assert result.outcome == ("completed" if held else "failed")

    at_once([partial(judge, held) for held in (True, False)])


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
