"""An operator's orders to real autopilots: a climb that is held, a flight to a point, the mission again, a landing."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from swarmctl.errors import EXIT_INTERRUPTED
from tests.real.autopilots import ARDUCOPTER, PX4, Kind
from tests.real.conftest import Field, Fielder
from tests.real.test_flights import ARDUPILOT_CONFIG, END_S, GROUND_S, LONE_PX4, PX4_CONFIG, booted

pytestmark = [pytest.mark.process, pytest.mark.timeout(900)]

CLIMBED_M = 0.5
STOPPED_S = {PX4.variable: 1.5, ARDUCOPTER.variable: 4.0}  # from the order until it hovers, its way included
RESTED_S = 4.0
DRIFT_M = 0.5
NEAR_M = 1.0  # true positions are up to 0.6 m off the estimate


def height_m(here: Field) -> float:
    return here.witness.vehicles[0].height_m()


def place(here: Field) -> np.ndarray:
    return np.array(here.witness.vehicles[0].pos_ned_m[-1])


@pytest.mark.parametrize("kind", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_a_climb_is_held_then_flown_on_and_a_point_is_flown_to(field: Fielder, kind: Kind) -> None:
    here = field(PX4, 1) if kind is PX4 else booted(field, 1)
    launched = here.launch(*((PX4_CONFIG, *LONE_PX4) if kind is PX4 else (ARDUPILOT_CONFIG,)))
    launched.until_phase("TAKEOFF", 1)
    here.witness.wait(lambda: height_m(here) > CLIMBED_M, 30.0, "climbing")
    held = launched.verb("hold")
    assert held.returncode == 0, held.stderr
    time.sleep(STOPPED_S[kind.variable])
    held_m = height_m(here)
    time.sleep(RESTED_S)
    assert height_m(here) == pytest.approx(held_m, abs=DRIFT_M), "it hovers where the climb was held"
    assert launched.events("phase")[-1]["phase"] == "TAKEOFF"
    assert launched.verb("resume").returncode == 0
    launched.until_phase("TRACK", 1)
    north_m, east_m, down_m = 3.0, -2.0, -4.0
    sent = launched.verb("goto", "0", f"{north_m},{east_m},{down_m}", "--speed", "2")
    assert sent.returncode == 0, sent.stderr
    here.witness.wait(
        lambda: math.dist(place(here)[:2], (north_m, east_m)) < NEAR_M, 20.0, "at the point that it was sent to"
    )
    landed = launched.verb("land")
    assert landed.returncode == 0, landed.stderr
    assert launched.end(END_S) == EXIT_INTERRUPTED, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")
