"""A supervisor tells which processes have ended, at once and then for as long as it lives."""

from __future__ import annotations

import time

import pytest

from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import EndedMessage, decode_ended
from swarmctl.bus.topics import ENDED
from swarmctl.ops.supervision.ended_processes import EndedProcesses


def test_ends_are_told_at_once_and_again_every_second_the_corrected_ones_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    hub = LocalHub(lambda: round(now_s * 1e6))
    ended, heard = EndedProcesses(hub.connect("alpha")), hub.connect("agent-2")
    ended.repeat()

    def told() -> list[EndedMessage | None]:
        nonlocal now_s
        now_s += 0.01
        return [decode_ended(payload) for _, payload in heard.receive(ENDED)]

    dead, other = EndedMessage(agent=0, boot_id=7, is_down=False), EndedMessage(agent=1, boot_id=None, is_down=True)
    for one in (dead, other):
        ended.tell(one)
    assert told() == [dead, other]
    now_s = 100.9
    ended.repeat()
    assert told() == []
    recovered = EndedMessage(agent=0, boot_id=7, is_down=True)
    ended.tell(recovered)
    assert told() == [recovered]
    for later_s in (101.5, 102.6):
        now_s = later_s
        ended.repeat()
        assert told() == [recovered, other]
