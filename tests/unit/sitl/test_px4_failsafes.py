"""Several causes of a failsafe at once: the simulated PX4 flies the most severe action of all that are left."""

from __future__ import annotations

import pytest

from sitl.px4.modes import OffboardLoss, Px4Mode
from tests.benches.px4_bench import Bench, taken_off

HOLD, RTL, LAND, OFFBOARD = Px4Mode.AUTO_LOITER, Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND, Px4Mode.OFFBOARD
CRITICAL_01 = 0.06
LANDS, HOLDS, RETURNS = 2, 1, 2  # COM_LOW_BAT_ACT; NAV_DLL_ACT twice


def climbed(**parameters: float) -> Bench:
    """Return a vehicle in Hold with some of its parameters set, whose ground station was heard just now."""
    bench = taken_off("x500").as_ground_station()
    for name, value in ({"COM_FAIL_ACT_T": 1.0, "COM_DL_LOSS_T": 2.0} | parameters).items():
        bench.pilot.parameters.assign(name, value)
    bench.pilot.watch.on_gcs_heartbeat(bench.clock.now_us())
    return bench


def test_a_lost_position_does_not_make_it_forget_an_empty_battery() -> None:
    bench = climbed(COM_LOW_BAT_ACT=LANDS)
    bench.pilot.battery_01 = CRITICAL_01
    bench.run(0.3)
    assert bench.pilot.mode == HOLD, "first time for the pilot"
    bench.pilot.position_ok = False
    bench.run(0.3)
    assert bench.pilot.mode == LAND
    bench.pilot.position_ok = True
    bench.run(0.3)
    assert (bench.pilot.mode, bench.pilot.failsafe) == (LAND, True)


def test_a_weaker_action_does_not_replace_the_landing_of_an_empty_battery() -> None:
    bench = climbed(COM_LOW_BAT_ACT=LANDS, NAV_DLL_ACT=HOLDS)
    bench.pilot.battery_01 = CRITICAL_01
    bench.run(1.3)
    assert bench.pilot.mode == LAND
    bench.run(1.2)  # of which the ground station is lost from 2 s on
    assert "Connection to ground station lost\t" in bench.texts()
    assert bench.pilot.mode == LAND


@pytest.mark.parametrize("action", [HOLDS, RETURNS])
def test_a_stronger_action_replaces_a_weaker_one_after_its_time_in_hold(action: int) -> None:
    bench = climbed(COM_LOW_BAT_ACT=LANDS, NAV_DLL_ACT=action)
    bench.run(3.3)
    assert bench.pilot.mode == (HOLD if action == HOLDS else RTL)
    bench.pilot.battery_01 = CRITICAL_01
    bench.run(0.5)
    assert bench.pilot.mode == (HOLD if action == HOLDS else LAND), "more than Hold is flown at once"
    bench.run(1.0)
    assert bench.pilot.mode == LAND


def test_when_the_most_severe_cause_ends_the_next_one_is_flown() -> None:
    bench = climbed(NAV_DLL_ACT=RETURNS, COM_OBL_RC_ACT=OffboardLoss.LAND)
    bench.setpoint()
    bench.mode(6)
    bench.run(3.3, 50)
    assert (bench.pilot.mode, bench.pilot.intended) == (RTL, OFFBOARD), "its ground station is lost"
    bench.run(1.3)
    assert bench.pilot.mode == LAND, "its setpoints, too"
    bench.run(0.2, 50)
    assert (bench.pilot.mode, bench.pilot.intended) == (RTL, OFFBOARD), "they are back"


def test_a_commanded_mode_suspends_a_failsafe_until_another_cause_begins() -> None:
    bench = climbed(COM_LOW_BAT_ACT=LANDS, COM_OBL_RC_ACT=OffboardLoss.HOLD)
    bench.pilot.battery_01 = CRITICAL_01
    bench.run(1.3)
    assert bench.pilot.mode == LAND
    bench.setpoint()
    bench.mode(6)
    bench.run(1.0, 50)
    assert (bench.pilot.mode, bench.pilot.failsafe) == (OFFBOARD, False)
    bench.run(1.3)
    assert bench.pilot.mode == LAND, "of the battery, which is still empty; not Hold"
