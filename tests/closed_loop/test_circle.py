"""Tests of the default mission: three agents share a climbing circle (thesis 4.3)."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.control.mpc import attempts
from swarmctl.core.types import Landed, Mode, Phase, PlanStatus
from tests.closed_loop.conftest import FINE, Flight, Fly, closer_than, mission_t_s

ALONE = (FINE, "sitl.start=air", "swarm.agents=1", "mission.duration_s=15")


def test_whole_mission_is_flown_and_landed(circle: Flight) -> None:
    assert circle.problems == []
    last = circle.lockstep.truth[-3:]
    assert (last["landed"] == Landed.ON_GROUND).all() and not last["armed"].any()
    for agent in range(3):
        phases = circle.ticks(agent)["phase"]
        assert np.all(np.diff(phases.astype(int)) >= 0), "phases only move forward"
        assert phases[-1] == Phase.DONE


def test_true_separation_is_kept_throughout(circle: Flight) -> None:
    assert circle.separation_m() >= 0.85


def test_summed_mean_tracking_error(circle: Flight) -> None:
    assert circle.summed_mean_error_m() <= 2.19, "thesis Table 19 at 3 x 0.3 m"
    assert circle.summed_mean_error_m(after_s=10.0) <= 1.07 * np.sqrt(3) * 0.9, "the lower bound, and up to 7 %"


def test_without_more_room_for_who_comes_closer_the_error_is_within_3_percent_of_its_lower_bound(fly: Fly) -> None:
    """Agents in a formation swing by centimetres, for which `separation.approach_01` keeps room: 2 to 3 %."""
    a_period = "mission.duration_s=22.6"  # of the circle, after the first 10 s
    flight = fly(FINE, "separation.approach_01=0", "sitl.start=air", a_period, until=Lockstep.mission_is_over)
    assert flight.summed_mean_error_m(after_s=10.0) <= 1.03 * np.sqrt(3) * 0.9


def test_no_plan_fails(circle: Flight) -> None:
    for agent in range(3):
        ticks, _ = circle.tracked(agent)
        assert not np.isin(ticks["plan_status"], (PlanStatus.SOLVER_FAILED, PlanStatus.RESIDUAL)).any()
        assert circle.modes(agent, Phase.TRACK) == {Mode.TRACKING}


def test_the_safety_filter_never_acts(circle: Flight) -> None:
    assert not any(circle.ticks(agent)["safety_filter_acted"].any() for agent in range(3))


def test_the_charge_that_autopilots_report_is_recorded(circle: Flight) -> None:
    for agent in range(3):
        ticks, _ = circle.tracked(agent)
        assert ((ticks["battery_01"] > 0.5) & (ticks["battery_01"] <= 1.0)).all()


def test_vehicles_come_down_a_metre_apart(circle: Flight) -> None:
    down = circle.pos_ned_m[-1]
    starts = np.array(circle.config.starts_ned_m())
    assert np.linalg.norm((down - starts)[:, :2], axis=1).max() < 0.3


def test_negative_control_agents_that_ignore_each_other_collide(fly: Fly) -> None:
    unaware = ("controller.kind='mpc'", "agent.barrier.enabled=false")
    alone = fly(*unaware, "sitl.start=air", "mission.duration_s=5", until=closer_than(0.3))
    assert alone.separation_m() < 0.3


def test_compact_paths_shared_by_event_cost_a_tenth_of_the_traffic_and_no_separation(circle: Flight, fly: Fly) -> None:
    sparing = "agent.path_sharing={error_m=0.002,compact=true}"
    by_event = fly(FINE, sparing, "sitl.start=air", "mission.duration_s=8", until=Lockstep.mission_is_over)
    for agent, flown in zip(range(3), by_event.lockstep.agents, strict=True):
        assert flown is not None
        sent = flown.sent["path"]
        assert sent["messages"] <= 0.4 * len(by_event.ticks(agent))
        assert sent["bytes"] <= 200 * sent["messages"]
    assert by_event.separation_m() >= 0.85
    first_m = 0.0
    for agent in range(3):
        ticks, error = circle.tracked(agent)
        first_m += float(np.linalg.norm(error[ticks["mission_t_s"] < 8.0], axis=1).mean())
    assert by_event.summed_mean_error_m() <= 1.02 * first_m


def test_a_wrong_mass_costs_no_altitude(fly: Fly) -> None:
    heavy = fly("sitl.mass_scale=1.25", *ALONE, until=Lockstep.mission_is_over)
    ticks, error = heavy.tracked(0)
    assert np.abs(error[ticks["mission_t_s"] > 10, 2]).max() < 0.01


def test_negative_control_without_the_observer_a_wrong_mass_does(fly: Fly) -> None:
    off = ("agent.disturbance.enabled=false",)
    heavy = fly("sitl.mass_scale=1.25", *ALONE, *off, until=Lockstep.mission_is_over)
    ticks, error = heavy.tracked(0)
    assert np.abs(error[ticks["mission_t_s"] > 10, 2]).mean() > 0.05


@pytest.mark.parametrize(("terminal", "calm"), [("region", True), ("position_velocity", False)])
def test_thrust_stays_calm_with_half_a_tick_of_latency_but_not_under_the_equality(
    fly: Fly, terminal: str, calm: bool
) -> None:
    late = (FINE, "sitl.link_latency_ms=10", f"controller.mpc.terminal_z={terminal}", "swarm.agents=1")
    flight = fly("sitl.start=air", "mission.duration_s=12", *late, until=Lockstep.mission_is_over)
    ticks = flight.ticks(0)
    spread_01 = float(ticks["setpoint_thrust_01"][ticks["mission_t_s"] > 8.0].std())
    assert spread_01 < 0.02 if calm else spread_01 > 0.1


def test_without_peers_the_reference_is_met(fly: Fly) -> None:
    lone = fly(*ALONE, until=Lockstep.mission_is_over)
    ticks, error = lone.tracked(0)
    assert np.linalg.norm(error[ticks["mission_t_s"] > 10], axis=1).max() < 0.01


def closing_in(fly: Fly, *sets: str) -> Flight:
    """Fly twelve agents from their starts to the circle."""
    sets = (FINE, "swarm.agents=12", "sitl.start=air", *sets)
    return fly(*sets, until=lambda lockstep: mission_t_s(lockstep) >= 1.5, seed=2)


def test_twelve_agents_that_close_in_on_one_point_keep_their_distance(fly: Fly) -> None:
    """With peers on both sides, room to stop beyond the horizon costs distance within it, and plans are refused.

    Agents then coast on old plans and brake, each in another way. From starts 0 to 5 they keep 0.885 to 0.894 m;
    without room for those who come closer 0.874 m, and with one attempt only 0.80 m at the least of six.
    """
    assert closing_in(fly).separation_m() >= 0.85


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_twelve_agents_with_one_attempt_come_closer(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempts, "_relaxed", lambda separation: iter(()))
    assert closing_in(fly, "separation.approach_01=0").separation_m() < 0.85
