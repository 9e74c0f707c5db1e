"""A vehicle that a ground station moves in its autopilot's hold, past agents that hover in their mission."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pymap3d
import pytest
from pymavlink.dialects.v20 import development as mavlink

from sitl.lockstep import Lockstep
from swarmctl.agent.sharing import path_publisher
from swarmctl.control.estimation import flown_by_others
from swarmctl.mavlink.codec import Codec
from tests.closed_loop.conftest import COARSE, Fly, closer_than, mission_t_s
from tests.closed_loop.test_failures import PASSING

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
Point = tuple[float, float, float]
Leg = tuple[float, dict[str, Any]]  # mission time of the order, and what `move` takes


def say(running: Lockstep, message: mavlink.MAVLink_message) -> None:
    """Send a message of a ground station to the vehicle."""
    running.links[MOVED][0].send(Codec(255, 190).encode(message))


def take(running: Lockstep) -> None:
    """Set HOLD."""
    numbers = (1.0, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0)
    say(running, mavlink.MAVLink_command_long_message(MOVED + 1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, *numbers))


def move(
    running: Lockstep,
    *,
    to_ned_m: Point = BEYOND_NED_M,
    towards: Callable[[Lockstep], Point] | None = None,
    speed_m_s: float = SPEED_M_S,
) -> None:
    """Have the vehicle fly to a point, beyond the others if it is not named, at a speed."""
    swarm, to_ned_m = running.config.swarm, to_ned_m if towards is None else towards(running)
    lat_deg, lon_deg, alt_m = pymap3d.ned2geodetic(
        *to_ned_m, swarm.origin_lat_deg, swarm.origin_lon_deg, swarm.origin_alt_m
    )
    params = (speed_m_s, 1.0, 0.0, math.nan, round(lat_deg * 1e7), round(lon_deg * 1e7), alt_m)
    frame, command = mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION
    say(running, mavlink.MAVLink_command_int_message(MOVED + 1, 1, frame, command, 0, 0, *params))


PASSED_M = -4.0  # north of who was moved


def has_passed(running: Lockstep) -> bool:
    return bool(running.world.truth_rows()["pos_ned_m"][MOVED, 0] < PASSED_M)


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_others_keep_away_from_who_is_moved_in_hold(fly: Fly, mode: str) -> None:
    flight = fly(*SCENE, f"separation.mode={mode}", at={TAKEN_S: take, MOVED_S: move}, until=has_passed)
    assert flight.separation_m() >= 0.85


def steered(
    fly: Fly, settings: tuple[str, ...], legs: list[Leg], *, taken_s: float = TAKEN_S, too_close_m: float = 0.0
) -> float:
    """Take the vehicle, and move it along legs; return the least separation [m] until 3 s after the last one.

    After the last one the flight ends when two are too close.
    """
    too_close = closer_than(too_close_m)

    def is_over(running: Lockstep) -> bool:
        after_s = mission_t_s(running) - legs[-1][0]
        return after_s > 3.0 or (after_s > 0.1 and too_close(running))

    at = {taken_s: take, **{at_s: functools.partial(move, **leg) for at_s, leg in legs}}
    return fly(*settings, at=at, until=is_over).separation_m()


def taken_to_stop(monkeypatch: pytest.MonkeyPatch, *, for_us: int = 1 << 62) -> None:
    """Take the vehicle to brake for so long in hold, and leave no room for who steers it."""
    monkeypatch.setattr(flown_by_others, "_ENTERS_US", for_us)
    for module in (flown_by_others, path_publisher):
        monkeypatch.setattr(module, "is_steered", lambda state: False)


def beyond_another(running: Lockstep) -> Point:
    """Return the point 6 m beyond vehicle 0, seen from the one that is moved."""
    pos = running.world.truth_rows()["pos_ned_m"]
    north, east, _ = pos[0] + 6.0 * (pos[0] - pos[MOVED]) / np.linalg.norm(pos[0] - pos[MOVED])
    return float(north), float(east), float(pos[MOVED, 2])


def test_who_is_flown_at_another_as_soon_as_it_is_taken_is_not_taken_to_brake(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pilot takes one of four that turn around each other, and flies it at its neighbour at 3 m/s."""
    at_once: list[Leg] = [(2.44, {"towards": beyond_another, "speed_m_s": 3.0})]
    scene = (*COARSE, *PASSING)
    assert steered(fly, scene, at_once, taken_s=2.4) >= 0.75
    taken_to_stop(monkeypatch)
    assert steered(fly, scene, at_once, taken_s=2.4, too_close_m=0.65) < 0.65, "negative control"


def test_guaranteed_who_is_flown_past_others_as_soon_as_it_is_taken_is_not_taken_to_brake(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It hovers beside them when a pilot takes it."""
    starts = json.dumps([[0.0, 0.0, -5.0], [0.0, 1.2, -5.0], [0.0, -1.2, -5.0], [1.2, 0.6, -5.0]])
    scene = (*SCENE, f"start.positions_ned_m={starts}", "separation.mode=guaranteed")
    at_once: list[Leg] = [(TAKEN_S + 0.04, {"to_ned_m": (-4.0, 3.7, -5.0), "speed_m_s": 3.0})]
    assert steered(fly, scene, at_once) >= 0.85
    taken_to_stop(monkeypatch)
    assert steered(fly, scene, at_once, too_close_m=0.7) < 0.7, "negative control"


def test_who_slows_down_in_its_turns_does_not_stop(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    """A zigzag at 2 m/s towards the others, with a turn every 1.1 s."""
    turns: list[Leg] = [
        (TAKEN_S + 0.04 + 1.1 * i, {"to_ned_m": (3.0 - i if i < 5 else -4.0, 1.5 * (-1) ** (i + 1), -5.0)})
        for i in range(6)
    ]
    assert steered(fly, SCENE, turns) >= 0.85
    taken_to_stop(monkeypatch, for_us=1_000_000)
    assert steered(fly, SCENE, turns, too_close_m=0.75) < 0.75, "negative control"
