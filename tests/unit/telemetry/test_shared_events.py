"""Events of agents reach a station as they were recorded, under the name of who has sent them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.refusals import IDENTITY, MALFORMED
from swarmctl.bus.topics import EVENT, TOO_LONG
from swarmctl.telemetry.recording.recorder import Recorder
from swarmctl.telemetry.recording.run_files import read_events
from swarmctl.telemetry.recording.shared_events import SharedEvents, taken_event


def shared(folder: Path, name: str, **fields: Any) -> tuple[list[dict[str, Any]], list[bytes]]:
    """Return what agent 1 records of an event, and what a station hears of it."""
    now_us = 0
    hub = LocalHub(lambda: now_us)
    station, recorder = hub.connect("station", {EVENT: ["agent-1"]}), Recorder(folder, 1)
    SharedEvents(recorder, hub.connect("agent-1"), 1).event(name, 5, 6, **fields)
    recorder.close(5.0)
    now_us = 1
    return read_events(folder), [payload for _, payload in station.receive(EVENT)]


def test_an_event_is_published_as_it_is_recorded(tmp_path: Path) -> None:
    (recorded,), (sent,) = shared(tmp_path, "deadlock", by=[2], lasted_s=float("nan"))
    assert recorded == json.loads(sent)
    assert recorded == {
        "utc_us": 6,
        "t_us": 5,
        "source": "agent-1",
        "event": "deadlock",
        "by": [2],
        "lasted_s": None,
    }


def test_a_long_event_goes_without_its_longest_fields(tmp_path: Path) -> None:
    fields = {"duration_s": 5.0, "goal_ned_m": [1.0, 2.0, -3.0], "mission": "x" * EVENT.max_bytes, "more": "y" * 4090}
    (recorded,), (sent,) = shared(tmp_path, "mission_changed", **fields)
    assert {key: recorded[key] for key in fields} == fields
    assert len(sent) <= EVENT.max_bytes
    heard = json.loads(sent)
    assert (heard["duration_s"], heard["goal_ned_m"]) == (5.0, [1.0, 2.0, -3.0])
    assert (heard["left_out"], "mission" in heard, "more" in heard) == (["mission", "more"], False, False)


def test_an_event_that_stays_too_long_is_not_published(tmp_path: Path) -> None:
    (recorded,), sent = shared(tmp_path, "x" * EVENT.max_bytes, text="y")
    assert (len(recorded["event"]), sent) == (EVENT.max_bytes, [])


def test_an_event_is_of_who_has_sent_it_whoever_it_names() -> None:
    sent = {"utc_us": 6, "t_us": 5, "source": "agent-0", "event": "mission_changed", "duration_s": 5.0}
    taken = taken_event("agent-1", json.dumps(sent).encode())
    assert taken.refusal == ""
    assert json.loads(taken.line) == sent | {"source": "agent-1"}
    unnamed = json.loads(taken_event("agent-1", b'{"utc_us": 6, "t_us": 5, "event": "\\n"}').line)
    assert (unnamed["source"], unnamed["event"]) == ("agent-1", "\n")
    assert b"\n" not in taken_event("agent-1", b'{"utc_us": 6, "t_us": 5, "event": "\\n"}').line


@pytest.mark.parametrize(
    "payload",
    [
        TOO_LONG,
        b"\xff",
        b"[]",
        b'"state"',
        b'{"utc_us": 6, "t_us": 5}',
        b'{"utc_us": 6, "t_us": 5, "event": 3}',
        b'{"event": "state"}',
        b'{"utc_us": 6.0, "t_us": 5, "event": "state"}',
        b'{"utc_us": true, "t_us": 5, "event": "state"}',
        b'{"utc_us": 9223372036854775808, "t_us": 5, "event": "state"}',
        b'{"utc_us": 6, "t_us": 5, "event": "\\ud800"}',
        b'{"utc_us": 6, "t_us": 5, "event": "state", "x": ' + b"[" * 2000 + b"]" * 2000 + b"}",
        b'{"utc_us": 6, "t_us": 5, "event": "state", "x": ' + b"9" * 4050 + b"}x",
    ],
)
def test_what_is_no_event_is_refused(payload: bytes) -> None:
    assert taken_event("agent-1", payload) == (b"", MALFORMED)


@pytest.mark.parametrize("name", ["started", "obstacles", "flown_without", "sender_clock"])
def test_no_agent_tells_the_judge_what_only_a_station_knows(name: str) -> None:
    payload = json.dumps({"utc_us": 6, "t_us": 5, "event": name}).encode()
    assert taken_event("agent-1", payload) == (b"", IDENTITY)
