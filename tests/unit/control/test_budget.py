"""The distances of a configuration: their order, what they add up, and the page that lists them."""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path

import pytest

from swarmctl.config import load
from swarmctl.control.collision.barrier import BarrierParams
from swarmctl.control.collision.budget import SeparationBudget
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.phases.state_machine_params import StateMachineParams

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "separation.md").read_text()
CONFIGS = sorted((ROOT / "configs").glob("*.toml"))
MARGIN_M = BarrierParams().margin_m


def in_order_m(params: SeparationParams) -> dict[str, float]:
    """Return the distances of the page's first table, least first."""
    budget = params.budget
    return {
        "body_m": budget.body_m,
        "barrier_m": budget.barrier_m(MARGIN_M),
        "hard_min_distance_m": budget.hard_min_distance_m,
        "committed_m": budget.committed_m,
        "radius_m": budget.radius_m,
        "planned_m": budget.planned_m,
        "landing_m": budget.landing_m(StateMachineParams().apart_m),
    }


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_each_layer_acts_before_the_next_one_has_to(path: Path) -> None:
    distances_m = list(in_order_m(load(path).separation).values())
    assert distances_m == sorted(distances_m)


def test_the_page_lists_every_distance_and_its_numbers() -> None:
    rows = {name: cells for name, *cells in re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \|", PAGE, re.MULTILINE)}
    default, x500 = in_order_m(SeparationParams()), in_order_m(load(ROOT / "configs" / "x500_circle.toml").separation)
    assert rows == {name: [f"{default[name]:.2f}", f"{x500[name]:.2f}"] for name in default}
    public = [name for name, _ in inspect.getmembers(SeparationBudget) if name.endswith("_m")]
    assert all(f"`{name}`" in PAGE for name in public)


def test_commitments_leave_room_for_tracking_however_large_the_slack_is() -> None:
    """Four fifths of the distance beyond touching bodies remain, a half of them for each of two vehicles."""
    budget = SeparationParams(radius_m=0.9, body_m=0.65, certify_slack_m=5.0).budget
    assert budget.committed_m == pytest.approx(0.85)
    assert budget.tube_m == pytest.approx(0.1)
    assert SeparationParams(radius_m=0.5, body_m=0.6).budget.committed_m == 0.5, "there is none to use up"


@pytest.mark.parametrize("slack_m", [0.02, 0.1, 5.0])
@pytest.mark.parametrize("committed_m", [0.7, 0.9, 2.0])
def test_the_radius_that_commits_a_distance_is_the_least_that_does(committed_m: float, slack_m: float) -> None:
    params = SeparationParams(body_m=0.48, certify_slack_m=slack_m)
    radius_m = params.budget.radius_that_commits_m(committed_m)
    assert params.model_copy(update={"radius_m": radius_m}).budget.committed_m == pytest.approx(committed_m)
    assert params.model_copy(update={"radius_m": radius_m - 0.01}).budget.committed_m < committed_m - 0.005


@pytest.mark.parametrize("accuracy_m", [0.0, 0.05, 0.2, 0.5])
def test_who_stands_a_radius_apart_is_not_waited_for_and_who_touches_is(accuracy_m: float) -> None:
    """By estimates that are off by twice the rms of their difference, two that stand apart seem that much closer."""
    budget = SeparationParams(radius_m=2.0, body_m=0.48, tracking_m=0.05).budget
    error_m = 2.0 * math.sqrt(2.0) * accuracy_m
    assert budget.standing_m(accuracy_m) <= budget.radius_m - budget.certify_slack_m - error_m + 1e-9
    assert budget.standing_m(accuracy_m) <= budget.required_m(accuracy_m), "more than a radius needs is not asked for"
    if accuracy_m <= 0.2:
        assert budget.standing_m(accuracy_m) - error_m >= 0.53 - 1e-9, "bodies that stand so far apart do not touch"


def test_a_vehicle_lands_at_home_beside_one_whose_estimate_has_wandered_but_not_onto_it() -> None:
    """Starts are a radius apart; a third of that may be lost on the way."""
    assert SeparationParams(radius_m=1.5, body_m=0.48, tracking_m=0.05).budget.home_m == pytest.approx(1.0)
    assert SeparationParams(radius_m=0.6, body_m=0.48, tracking_m=0.05).budget.home_m == pytest.approx(0.53)


def test_margins_of_a_peer_add_up_in_every_layer() -> None:
    budget = SeparationParams(tracking_m=0.05).budget
    assert budget.planned_peer_m(0.2, 0.3) == pytest.approx(budget.planned_m + 0.5)
    assert budget.barrier_peer_m(0.05, 0.2, 0.3) == pytest.approx(budget.barrier_m(0.05) + 0.5)
    assert budget.certified_peer_m(0.2) == pytest.approx(budget.hard_min_distance_m + 0.2)
    assert budget.certified_obstacle_m(1.0) == pytest.approx(0.9)
    assert budget.planned_beyond_hard_min_m == pytest.approx(budget.planned_m - budget.hard_min_distance_m)
    assert budget.barrier_obstacle_m(0.05) == pytest.approx(0.29)


def test_the_margin_of_age_grows_up_to_a_limit_and_not_for_a_landed_peer() -> None:
    budget = SeparationParams(age_accel_m_s2=4.0, age_margin_max_m=1.0).budget
    assert [budget.age_margin_m(age_s, parked=False) for age_s in (0.0, 0.5, 10.0)] == [0.0, 0.5, 1.0]
    assert budget.age_margin_m(10.0, parked=True) == 0.0
