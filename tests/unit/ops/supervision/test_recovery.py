"""Whose vehicle counts as down when its agent ends, whose is recovered, and whose is named as left: as it was heard."""

from __future__ import annotations

import signal
import time
from typing import cast

import msgspec
import pytest

from swarmctl.core.types import FlightMode, Landed, Phase
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, EXIT_START, StartError
from swarmctl.ops.processes import Child
from swarmctl.ops.supervision.recovery import RECOVERY_S, Recovery, handed_over
from swarmctl.ops.supervision.status_table import AgentView
from tests import builders

KILLED = 128 + signal.SIGKILL
CHILD = cast(Child, object())


def seen(phase: Phase = Phase.TRACK, agent: int = 1) -> AgentView:
    return AgentView(agent=agent, status=builders.status_message(agent=agent, phase=phase))


def recovering() -> tuple[Recovery, AgentView]:
    found, view = Recovery(lambda _: CHILD, (1, 2, 3)), seen()
    assert found.begin(view, KILLED) is CHILD
    return found, view


@pytest.mark.parametrize("code", [EXIT_MISSION, KILLED, 1])
@pytest.mark.parametrize("phase", [phase for phase in Phase if phase is not Phase.DONE])
def test_the_vehicle_of_an_agent_that_dies_before_it_is_done_is_recovered(phase: Phase, code: int) -> None:
    """In any phase: an autopilot may be armed by a pilot, or before the agent has told of it."""
    started: list[int] = []

    def start(agent: int) -> Child:
        started.append(agent)
        return CHILD

    found = Recovery(start, (1, 2, 3))
    assert not found.leaves_down(seen(phase), code)
    assert found.begin(seen(phase), code) is CHILD
    assert started == [1] and found.is_on(1) and not found.is_on(0)
    assert found.left([seen(phase)]) == []


@pytest.mark.parametrize("code", [EXIT_OK, EXIT_INTERRUPTED, EXIT_START])
def test_an_agent_that_ends_so_leaves_its_vehicle_down(code: int) -> None:
    found = Recovery(lambda _: CHILD, (1, 2, 3))
    assert found.leaves_down(seen(), code)
    assert found.begin(seen(), code) is None
    assert not found.is_on(1) and found.left([seen()]) == []


@pytest.mark.parametrize("code", [EXIT_OK, EXIT_INTERRUPTED, EXIT_START, EXIT_MISSION, KILLED])
def test_an_agent_that_was_done_on_the_ground_leaves_its_vehicle_down_however_it_ends(code: int) -> None:
    found, view = Recovery(lambda _: CHILD, (1, 2, 3)), seen(Phase.DONE)
    assert found.leaves_down(view, code)
    assert handed_over(view) == ""


@pytest.mark.parametrize("code", [EXIT_OK, EXIT_INTERRUPTED, EXIT_START, EXIT_MISSION, KILLED])
@pytest.mark.parametrize(
    ("armed", "landed", "words"),
    [
        (True, Landed.IN_AIR, "armed, not known to be on the ground"),
        (False, Landed.IN_AIR, "disarmed, not known to be on the ground"),
        (True, Landed.ON_GROUND, "armed, on the ground"),
        (False, Landed.UNKNOWN, "disarmed, not known to be on the ground"),
    ],
)
def test_who_was_done_with_a_vehicle_that_is_not_down_vouches_for_nothing_and_takes_it_from_nobody(
    code: int, *, armed: bool, landed: Landed, words: str
) -> None:
    """As one that was found in the air and handed back in a hold, or one that a pilot has armed again since."""
    found, view = Recovery(lambda _: CHILD, (1, 2, 3)), seen(Phase.DONE)
    assert view.status is not None
    view.status = msgspec.structs.replace(view.status, armed=armed, landed=landed, flight_mode=FlightMode.HOLD)
    assert not found.leaves_down(view, code)
    assert found.begin(view, code) is None
    assert handed_over(view) == (
        f"vehicle 2 (agent-1) was left to its autopilot, or to who flies it: {words}, in HOLD. No agent lands it"
    )


def test_of_a_vehicle_that_was_handed_over_in_the_air_it_is_told_when_all_is_killed() -> None:
    found, view = Recovery(lambda _: CHILD, (1, 2, 3)), seen(Phase.DONE)
    assert view.status is not None
    view.status = msgspec.structs.replace(view.status, armed=True, landed=Landed.IN_AIR)
    found.give_up([view])
    assert len(found.left([view])) == 1


def test_of_an_agent_that_was_never_heard_nothing_is_recovered_and_nothing_claimed() -> None:
    found, view = Recovery(lambda _: CHILD, (1, 2, 3)), AgentView(agent=1)
    assert not found.leaves_down(view, KILLED)
    assert found.begin(view, KILLED) is None
    assert found.left([view]) == []


@pytest.mark.parametrize("code", [EXIT_START, EXIT_MISSION, KILLED])
def test_a_vehicle_whose_recovery_fails_is_named_and_not_recovered_again(code: int) -> None:
    """One that could not start has found the vehicle's link taken, or no vehicle: it may be in the air."""
    found, view = recovering()
    assert not found.leaves_down(view, code)
    assert found.begin(view, code) is None
    [words] = found.left([view, seen(agent=2)])
    assert words.startswith("vehicle 2 (agent-1) may be armed or in the air")


@pytest.mark.parametrize(("armed", "words"), [(True, "it was armed, in TRACK"), (False, "not yet told to be armed")])
def test_what_was_heard_last_of_a_vehicle_that_is_left_is_told(armed: bool, words: str) -> None:
    found, view = Recovery(lambda _: CHILD, (1, 2, 3)), seen()
    assert view.status is not None
    view.status = msgspec.structs.replace(view.status, armed=armed)
    for _ in range(2):
        found.begin(view, KILLED)
    assert words in found.left([view])[0]


def test_a_vehicle_that_was_recovered_is_not_named() -> None:
    found, view = recovering()
    assert found.begin(view, EXIT_INTERRUPTED) is None
    assert found.left([view]) == []


def test_a_recovery_that_can_not_be_started_leaves_the_vehicle_named() -> None:
    def refuses(_: int) -> Child:
        raise StartError("no such program")

    found, view = Recovery(refuses, (1, 2, 3)), seen()
    with pytest.raises(StartError):
        found.begin(view, KILLED)
    assert len(found.left([view])) == 1


def test_a_recovery_is_overdue_after_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    found, view = recovering()
    now_s += RECOVERY_S - 0.1
    assert not found.is_overdue(view.agent)
    now_s += 0.2
    assert found.is_overdue(view.agent) and not found.is_overdue(0)


def test_of_agents_that_are_killed_in_flight_the_vehicles_are_named() -> None:
    found = Recovery(lambda _: CHILD, (1, 2, 3, 4))
    views = [
        seen(Phase.STANDBY, 0),
        seen(Phase.ARM, 1),
        seen(Phase.LAND, 2),
        seen(Phase.DONE, 3),
    ]
    found.give_up([*views, AgentView(agent=3)])
    assert [words.split()[1] for words in found.left(views)] == ["2", "3"]


def flown(seconds_ago: float = 40.0) -> AgentView:
    """Return an agent that was last heard in flight."""
    status = builders.status_message(phase=Phase.TRACK)
    return AgentView(agent=0, status=status, received_s=time.monotonic() - seconds_ago)


def recovered(view: AgentView, phase: Phase | None) -> Recovery:
    """Return a recovery of its vehicle; the process that lands it has said that it is in a phase, or nothing."""
    recovery = Recovery(lambda _: CHILD, (7,))
    recovery.begin(view, KILLED)
    view.received_s = time.monotonic()  # as the supervisor does, from when on it waits for that process
    if phase is not None:
        heard = builders.status_message(phase=phase)
        view.status = msgspec.structs.replace(heard, boot_id=2, armed=Phase.CONNECT < phase < Phase.DONE)
    return recovery


def left(view: AgentView, phase: Phase | None) -> str:
    recovery = recovered(view, phase)
    recovery.begin(view, EXIT_START)
    (words,) = recovery.left([view])
    return words


def test_a_vehicle_that_was_not_heard_again_is_told_as_it_was_last_heard() -> None:
    for phase in (None, Phase.CONNECT):
        words = left(flown(), phase)
        assert "vehicle 7 (agent-0) may be armed or in the air: it was armed, in TRACK, 40 s ago" in words
        assert "not heard" in words
        assert "not yet told to be armed" not in words


def test_a_vehicle_that_was_heard_again_is_told_as_it_was_then() -> None:
    words = left(flown(), Phase.LAND)
    assert "it was armed, in LAND, 0 s ago" in words
    assert "not heard" not in words


def test_a_vehicle_whose_landing_is_killed_before_it_was_heard_is_left() -> None:
    """As by a second Ctrl-C, three seconds after its agent was killed."""
    for phase in (None, Phase.CONNECT, Phase.LAND):
        view = flown()
        recovery = recovered(view, phase)
        recovery.give_up([view])
        assert len(recovery.left([view])) == 1, phase


def test_a_vehicle_that_was_seen_to_be_down_is_not_left() -> None:
    view = flown()
    recovery = recovered(view, Phase.DONE)
    recovery.give_up([view])
    assert recovery.left([view]) == []
