"""Tests that agents which wait beside a silent peer do not fly to where it may be, from several starts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sitl.studies.campaign.conditions.layouts import nudged
from swarmctl.agent.sensing import world_model
from swarmctl.config import load
from swarmctl.control.collision import separation
from swarmctl.control.phases.trajectories import Trajectories
from tests.faults.matrix import ROWS
from tests.faults.simulated import SimulatedRow

APART_M = 0.85


def apart_m(tmp_path: Path, start: int) -> float:
    """Return how close vehicles come when one of four falls silent, from starts shifted by a millimetre."""
    row = ROWS["peer-silent"]
    assert isinstance(row, SimulatedRow)
    places = nudged(np.array(load(None, row.scene).starts_ned_m(), dtype=float), start)
    scene = (*row.scene, f"start.positions_ned_m={json.dumps(places.tolist())}")
    played = replace(row, scene=scene, apart_m=0.1).play(tmp_path / str(start))
    assert played.apart_m is not None
    return played.apart_m


@pytest.mark.parametrize("start", range(1, 6))
def test_those_who_wait_for_a_silent_peer_keep_apart_from_it(tmp_path: Path, start: int) -> None:
    """The worst of twelve starts is 0.89 m."""
    assert apart_m(tmp_path, start) >= APART_M


def test_negative_control_those_who_stop_softly_and_make_room_for_all_it_may_do_come_too_close(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From five starts they come to 0.76 to 0.85 m of it; with one of the two alone, from three, to 0.86 and 0.89 m."""
    made: Callable[..., object] = separation.keep_out_along
    stops: Callable[..., None] = Trajectories.stop

    def driven(*values: object, here_ned_m: object, **named: object) -> object:
        return made(*values, **named)

    monkeypatch.setattr(world_model, "keep_out_along", driven)
    monkeypatch.setattr(Trajectories, "stop", lambda now, now_us, state, **_: stops(now, now_us, state))
    assert any(apart_m(tmp_path, start) < APART_M for start in range(1, 6))
