"""What supervisors and stations say of the bus itself."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from swarmctl.bus.bus import Bus
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import encode_message
from swarmctl.bus.refusals import FORGED, IDENTITY, MALFORMED, REPLAYED, RefusedMessage
from swarmctl.bus.silence import REOPENED
from swarmctl.bus.topics import STATUS
from swarmctl.bus.traffic import CountedBus
from swarmctl.ops.supervision.bus_report import BusReport
from swarmctl.ops.supervision.status_table import AgentView
from tests import builders


class Scripted(CountedBus):
    """A bus that has refused messages and replaced sessions."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
        self.sessions = 0
        self.waiting: list[RefusedMessage] = []

    def refused(self) -> list[RefusedMessage]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def reopened(self) -> int:
        return self.sessions


class Said:
    """Takes events and lines."""

    def __init__(self) -> None:
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.lines: list[str] = []

    def note(self, event: str, **fields: Any) -> None:
        self.events.append((event, fields))

    def print_line(self, text: str) -> None:
        self.lines.append(text)

    def show(self, agents: Sequence[AgentView]) -> None:
        return

    def close(self) -> None:
        return


def test_each_session_that_was_replaced_is_an_event_and_the_first_one_a_line() -> None:
    bus, said = Scripted(LocalHub(lambda: 0).connect("alpha")), Said()
    report = BusReport(bus, said.note, said)
    for sessions in (0, 1, 1, 2):
        bus.sessions = sessions
        report.step()
    assert [fields["count"] for event, fields in said.events if event == REOPENED] == [1, 2]
    assert len(said.lines) == 1


def test_a_session_that_was_replaced_while_nobody_was_left_to_hear_is_not_told() -> None:
    """As at the end of a launch, which waits for seconds after the last agent has ended."""
    bus, said = Scripted(LocalHub(lambda: 0).connect("alpha")), Said()
    report = BusReport(bus, said.note, said)
    for sessions, anybody in ((0, True), (1, False), (1, True), (2, True)):
        bus.sessions = sessions
        report.step(anybody=anybody)
    assert [fields["count"] for event, fields in said.events if event == REOPENED] == [1]
    assert len(said.lines) == 1


def test_the_first_refused_message_of_a_kind_is_a_line_unless_it_is_harmless() -> None:
    bus, said = Scripted(LocalHub(lambda: 0).connect("alpha")), Said()
    report = BusReport(bus, said.note, said)
    for _ in range(2):
        bus.waiting = [RefusedMessage("agent-1", "status", reason) for reason in (FORGED, REPLAYED)]
        report.step()
    assert said.lines == ["status in the name of agent-1 refused: forged"]
    assert {fields["reason"] for event, fields in said.events if event == "refused"} == {FORGED, REPLAYED}


def test_only_statuses_by_the_agent_they_are_of_are_taken_and_the_others_counted() -> None:
    hub, said = LocalHub(itertools.count(1, 1_000_000).__next__), Said()
    bus = hub.connect("alpha", {STATUS: ["agent-0"]})
    agent = hub.connect("agent-0")
    report = BusReport(bus, said.note, said)
    for payload in (status_of(0), b"no status", status_of(1)):
        agent.publish(STATUS, payload)
    assert [status.agent for status in report.statuses()] == [0]
    report.step()
    assert {fields["reason"]: fields["count"] for _, fields in said.events} == {MALFORMED: 1, IDENTITY: 1}


def status_of(agent: int) -> bytes:
    return encode_message(builders.status_message(agent=agent))
