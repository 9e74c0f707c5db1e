"""What an agent has changed is read from its events, in the types of the vehicle, or refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarmctl.core.json_safe import to_json
from swarmctl.telemetry.recording.changed_parameters import decode_originals, read_originals
from swarmctl.telemetry.recording.recorder import Recorder

WERE = {"NAV_DLL_ACT": 0, "COM_OF_LOSS_T": 1.0}


def test_the_newest_event_of_an_agent_tells(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 1)
    recorder.event("state", 1, 1, reason="parameters_changed")
    recorder.event("parameters_changed", 1, 1, were={"NAV_DLL_ACT": 0})
    recorder.event("parameters_changed", 2, 2, were=WERE)
    recorder.event("command", 3, 3, verb="param_int NAV_DLL_ACT", ok=True, text="set")
    recorder.close()
    were = read_originals(tmp_path, "agent-1")
    assert were == WERE
    assert [type(value) for value in were.values()] == [int, float]
    assert decode_originals(to_json(were)) == were
    assert [type(value) for value in decode_originals(to_json(were)).values()] == [int, float]


def test_without_such_an_event_nothing_was_changed(tmp_path: Path) -> None:
    (tmp_path / "agent-0.events.jsonl").write_text('{"event":"state","phase":"STANDBY"}\n')
    assert read_originals(tmp_path, "agent-0") == {}
    with pytest.raises(FileNotFoundError):
        read_originals(tmp_path, "agent-1")


@pytest.mark.parametrize(
    "were", ['{"A": true}', '{"A": "1"}', '{"A NAME": 1}', '{"A": 4000000000}', '{"A": 1e39}', "[]", '{"A": 1', "{"]
)
def test_what_no_vehicle_has_is_refused(tmp_path: Path, were: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        decode_originals(were)
    (tmp_path / "agent-0.events.jsonl").write_text(f'{{"event":"parameters_changed","were":{were}}}\n')
    with pytest.raises(ValueError, match=r"agent-0\.events\.jsonl"):
        read_originals(tmp_path, "agent-0")
