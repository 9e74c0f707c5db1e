"""A vehicle that a ground station moves in its autopilot's hold, past agents that hover in their mission."""

from __future__ import annotations

import json
import math

import pymap3d
import pytest
from pymavlink.dialects.v20 import development as mavlink

from sitl.lockstep import Lockstep
from swarmctl.control.estimation.constant_velocity import StopJudge
from swarmctl.core.types import Phase
from swarmctl.mavlink.codec import Codec
from tests.closed_loop.conftest import COARSE, Fly, closer_than

STARTS_NED_M = [[0.0, 0.0, -5.0], [0.0, 1.1, -5.0], [0.0, -1.1, -5.0], [6.0, 0.05, -5.0]]
MOVED, BEYOND_NED_M, SPEED_M_S = 3, (-6.0, 0.05, -5.0), 2.0
SCENE = (
    *COARSE,
    "sitl.start=air",
    "swarm.agents=4",
    f"start.positions_ned_m={json.dumps(STARTS_NED_M)}",
    "mission.kind=hover",
    "mission.duration_s=12",
)
TAKEN_S, MOVED_S = 0.5, 1.0  # mission time
TOO_CLOSE_M = 0.65


def say(running: Lockstep, message: mavlink.MAVLink_message) -> None:
    """Send a message of a ground station to the vehicle."""
    running.links[MOVED][0].send(Codec(255, 190).encode(message))


def take(running: Lockstep) -> None:
    """Set HOLD."""
    numbers = (1.0, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0)
    say(running, mavlink.MAVLink_command_long_message(MOVED + 1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, *numbers))


def move(running: Lockstep) -> None:
    """Have the vehicle fly to a point beyond the others, at a speed."""
    swarm = running.config.swarm
    lat_deg, lon_deg, alt_m = pymap3d.ned2geodetic(
        *BEYOND_NED_M, swarm.origin_lat_deg, swarm.origin_lon_deg, swarm.origin_alt_m
    )
    params = (SPEED_M_S, 1.0, 0.0, math.nan, round(lat_deg * 1e7), round(lon_deg * 1e7), alt_m)
    frame, command = mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION
    say(running, mavlink.MAVLink_command_int_message(MOVED + 1, 1, frame, command, 0, 0, *params))


def others_are_done(running: Lockstep) -> bool:
    """Return whether no other is in the mission any more: who was moved stays in hold, and nobody lands it."""
    return all(len(log.rows) and log.rows[-1]["phase"][0] > Phase.TRACK for log in running.logs[:MOVED])


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_others_keep_away_from_who_is_moved_in_hold(fly: Fly, mode: str) -> None:
    flight = fly(*SCENE, f"separation.mode={mode}", at={TAKEN_S: take, MOVED_S: move}, until=others_are_done)
    assert flight.separation_m() >= 0.85
    way_m = flight.pos_ned_m[:, MOVED, 0]
    assert way_m.min() < -4.0, "it has passed them"


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_negative_control_who_is_taken_to_stop_all_the_time_comes_close(
    fly: Fly, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setattr(StopJudge, "update", lambda self, state: True)
    at = {TAKEN_S: take, MOVED_S: move}
    assert fly(*SCENE, f"separation.mode={mode}", at=at, until=closer_than(TOO_CLOSE_M)).separation_m() < TOO_CLOSE_M
