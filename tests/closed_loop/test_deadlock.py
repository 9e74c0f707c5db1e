"""Tests that deadlocks are resolved: exact symmetry, one goal for all, a corridor too narrow to pass each other."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.layouts import least_sum_m, nudged, ring
from sitl.studies.campaign.conditions.scenarios import layout_of
from swarmctl.config import load
from swarmctl.control.reference.kinds import goto
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Array
from tests.closed_loop.conftest import AT_100_HZ

SMALL = (  # bodies of 15 cm that keep 30 cm
    "sitl.preset=crazyflie",
    "vehicle_model={delay_s=0.04,attitude_rad_s=20.0,drag_1_s=0.25,hover_thrust_01=0.43}",
    "separation={radius_m=0.3,body_m=0.15}",
    "limits.min_separation_m=0.15",
)


ARRIVED_M = 0.05


class Flown:
    """The mission of a flight, until all agents have arrived or the time is up."""

    def __init__(self, starts: Array, goals: Array, seconds: float, *sets: str) -> None:
        config = load(
            None,
            [
                AT_100_HZ,
                "sitl.start=air",
                f"swarm.agents={len(starts)}",
                f"start.positions_ned_m={json.dumps(starts.tolist())}",
                "mission.kind=goto",
                f"mission.goto.goals_ned_m={json.dumps(goals.tolist())}",
                f"mission.duration_s={seconds + 1.0}",
                *sets,
            ],
        )
        lockstep = Lockstep(config)
        logs, path = lockstep.logs, []
        self._second_ticks = round(config.agent.rate_hz)
        t_s, here = -math.inf, starts
        while not t_s >= seconds and not (t_s > 1.0 and np.linalg.norm(here - goals, axis=1).max() < ARRIVED_M):
            lockstep.step()
            here, t_s = lockstep.world.truth_rows()["pos_ned_m"], float(logs[0].rows[-1]["mission_t_s"][0])
            if t_s >= 0.0:
                path.append(here)
        self.pos_ned_m = np.array(path)  # (T, N, 3)
        self.distance_m = np.linalg.norm(self.pos_ned_m[-1] - goals, axis=1)
        self.noted: list[dict[str, Any]] = [e for log in logs for e in log.events if e["event"] == "deadlock"]

    @property
    def separation_m(self) -> float:
        return float(closest_pair_m(self.pos_ned_m).min())

    @property
    def moved_m(self) -> float:
        """Return the largest distance of any agent, in the last second, from its final position."""
        return float(np.linalg.norm(self.pos_ned_m[-self._second_ticks :] - self.pos_ned_m[-1], axis=2).max())


def corridor() -> str:
    """Two walls that leave 0.12 m to fly in, 1.2 m long, with walls at both ends that it is a long way round."""
    half_m = 0.06 + 0.375
    posts = [(x, side * half_m) for x in (-0.6, -0.3, 0.0, 0.3, 0.6) for side in (-1, 1)]
    posts += [(x, side * (half_m + 0.3 * k)) for x in (-0.6, 0.6) for side in (-1, 1) for k in range(1, 5)]
    size = "column=true,radius_m=0.15,keep_out_m=0.375,visibility_m=2.0"
    return "obstacles=[" + ",".join(f"{{center_ned_m=[{x:.2f},{y:.3f},0.0],{size}}}" for x, y in posts) + "]"


ENDS = np.array([[-1.5, 0.0, -1.0], [1.5, 0.0, -1.0]])


@pytest.fixture(scope="module")
def met() -> Flown:
    """Two come from opposite ends of the corridor."""
    return Flown(ENDS, -ENDS, 25.0, corridor(), *SMALL, "mission.goto.speed_m_s=1.0")


def test_two_that_meet_in_a_corridor_get_by(met: Flown) -> None:
    assert met.distance_m.max() < ARRIVED_M
    assert met.separation_m > 0.25


def test_the_deadlock_is_reported(met: Flown) -> None:
    begun = [e for e in met.noted if e["begins"]]
    assert any(set(e["by"]) & {0, 1} for e in begun)
    assert all(e["lasted_s"] >= 1.5 for e in met.noted if not e["begins"])
    assert len(begun) == len(met.noted) / 2, "every deadlock has ended"


def test_negative_control_without_the_rule_they_do_not_get_by() -> None:
    """They stand or push each other to and fro, which is the luck of a rounding; whether that is noticed as well."""
    flown = Flown(ENDS, -ENDS, 13.0, corridor(), *SMALL, "mission.goto.speed_m_s=1.0", "agent.deadlock.enabled=false")
    assert flown.distance_m.min() > 1.0


def test_two_exactly_above_each_other_swap_heights_in_space() -> None:
    """With `dmpc3` they stood in front of each other for good: no plan led sideways."""
    heights = np.array([[0.0, 0.0, -3.0], [0.0, 0.0, -8.0]])
    flown = Flown(heights, heights[::-1], 8.0, "controller.kind=dmpc3")
    assert flown.distance_m.max() < ARRIVED_M
    assert flown.separation_m > 0.85


TRIANGLE = ring(3, 3.0, 0.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_three_sent_to_one_point_come_to_rest_round_it(seed: int) -> None:
    flown = Flown(nudged(TRIANGLE, seed), np.zeros((1, 3)), 6.0)
    assert flown.distance_m.sum() < 1.1 * least_sum_m(3, 0.9)
    assert flown.moved_m < 0.02
    assert flown.separation_m > 0.85


def test_negative_control_without_places_of_their_own_they_push() -> None:
    """Whether one gets to the middle or they circle round it is the luck of a rounding, but none comes to rest."""
    flown = Flown(nudged(TRIANGLE, 1), np.zeros((1, 3)), 6.0, "mission.goto.goal_assignment=false")
    assert flown.moved_m > 0.1


UNDAMPED = "controller.mpc.proximal_xy=0"


def ten_to_one_point(*sets: str) -> Flown:
    """Fly them at half the rate, as `COARSE`: from four starts they rest within 6 % of the least sum."""
    starts_ned_m = layout_of("same_goal", 8, 10).starts_ned_m
    flown = Flown(starts_ned_m, np.zeros((1, 3)), 6.5, "agent.rate_hz=25", *sets)
    assert flown.separation_m > 0.85
    return flown


@pytest.mark.parametrize("sets", [(), (UNDAMPED,)], ids=["", "undamped"])
def test_ten_sent_to_one_point_get_inside_before_the_ring_closes(sets: tuple[str, ...]) -> None:
    """Damped plans let who is inside pass also without delays, from all of 14 starts of nine, ten and twelve."""
    flown = ten_to_one_point(*sets)
    assert flown.moved_m < 0.02
    assert flown.distance_m.sum() < 1.1 * least_sum_m(10, 0.9)


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_ten_that_go_at_the_same_time_close_the_ring(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goto, "OUTER_DELAY_S_M", 0.0)
    flown = ten_to_one_point(UNDAMPED)
    assert flown.moved_m >= 0.02
    assert flown.distance_m.sum() >= 1.1 * least_sum_m(10, 0.9)


@pytest.mark.usefixtures("configured_starts")
def test_an_exactly_symmetric_swap_never_stops() -> None:
    starts = ring(4, 2.5, math.pi / 4)
    flown = Flown(starts, -starts, 9.0)
    assert flown.noted == []
    assert flown.distance_m.max() < ARRIVED_M
    assert flown.separation_m > 0.85
