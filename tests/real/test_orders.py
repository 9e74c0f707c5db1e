"""An operator's orders to real autopilots: a climb that is held, a flight to a point, the mission again, a landing."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from swarmctl.core.types import Phase
from swarmctl.errors import EXIT_INTERRUPTED
from tests.real.autopilots import ARDUCOPTER, PX4, Kind
from tests.real.conftest import Field, Fielder
from tests.real.test_flights import ARDUPILOT_CONFIG, BODIES_M, END_S, GROUND_S, LONE_PX4, PX4_CONFIG, booted

pytestmark = [pytest.mark.process, pytest.mark.timeout(900)]

CLIMBED_M = 0.5
STOPPED_S = {PX4.variable: 1.5, ARDUCOPTER.variable: 4.0}  # from the order until it hovers, its way included
RESTED_S = 4.0
DRIFT_M = 0.5
FLOWN_S = 12.0
FIGURE_8 = f"""
[mission]
kind = "lemniscate"
duration_s = {FLOWN_S}

[mission.lemniscate]
center_ned_m = [0.0, 0.0, -4.0]
length_m = 4.0
width_m = 2.0
omega_rad_s = 0.5
"""
TOGETHER_US = 1000
LONG_M = 60.0
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


@pytest.mark.parametrize("kind", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_a_long_goto_takes_as_long_as_its_speed_and_is_not_flown_past(field: Fielder, kind: Kind) -> None:
    """60 m at 2 m/s were one swing of 56 s; with a cruise they are 32 s, and a few more out of a moving mission."""
    here = field(PX4, 1) if kind is PX4 else booted(field, 1)
    launched = here.launch(*((PX4_CONFIG, *LONE_PX4) if kind is PX4 else (ARDUPILOT_CONFIG,)))
    launched.until_phase("TRACK", 1)
    from_m, sent_s = place(here)[0], time.monotonic()
    to_m = round(from_m + LONG_M)
    sent = launched.verb("goto", "0", f"{to_m},0,-5", "--speed", "2")
    assert sent.returncode == 0, sent.stderr
    here.witness.wait(lambda: abs(place(here)[0] - to_m) < NEAR_M, 50.0, "at the point that it was sent to")
    took_s = time.monotonic() - sent_s
    time.sleep(RESTED_S)
    north_m = np.array(here.witness.vehicles[0].pos_ned_m)[:, 0]
    print(f"{to_m - from_m:.1f} m in {took_s:.1f} s, then {north_m.max() - north_m[-1]:.2f} m past")
    assert took_s < 45.0
    assert north_m.max() - north_m[-1] < DRIFT_M
    landed = launched.verb("land")
    assert landed.returncode == 0, landed.stderr
    assert launched.end(END_S) == EXIT_INTERRUPTED, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")


def test_another_mission_is_begun_by_all_at_one_time(field: Fielder, tmp_path: Path) -> None:
    here = field(PX4, 3)
    launched = here.launch(PX4_CONFIG)
    launched.until_phase("TRACK", 3)
    time.sleep(4.0)
    file = tmp_path / "figure_8.toml"
    file.write_text(FIGURE_8)
    changed = launched.verb("mission", "set", str(file))
    assert changed.returncode == 0, changed.stderr
    assert launched.end(END_S) == 0, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")
    begun_us, flown_s = list[int](), list[float]()
    for agent in range(3):
        table = pq.read_table(launched.run_dir / f"agent-{agent}.parquet", columns=["utc_us", "phase", "mission_t_s"])
        utc_us, phase, mission_s = (table.column(name).to_numpy() for name in table.column_names)
        tracks = phase == Phase.TRACK
        (back,) = np.flatnonzero(np.diff(mission_s[tracks]) < 0.0)
        begun_us.append(round(utc_us[tracks][back + 1] - 1e6 * mission_s[tracks][back + 1]))
        flown_s.append(float(mission_s[tracks][-1]))
    print(f"begun within {max(begun_us) - min(begun_us)} us; {here.witness.min_separation_m():.2f} m at least")
    assert max(begun_us) - min(begun_us) < TOGETHER_US
    assert min(flown_s) == pytest.approx(FLOWN_S, abs=0.5)
    assert here.witness.min_separation_m() > BODIES_M
