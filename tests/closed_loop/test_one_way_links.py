"""Links of vehicles that fail in one direction, or slow down little by little, under the other agents' flight."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import FlightMode
from swarmctl.mavlink.vehicle.autopilot import Autopilot
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock
from swarmctl.simulator_config import FaultParams
from tests.closed_loop.conftest import COARSE, ROOT, mission_t_s
from tests.faults.simulated import SWAP

ARDUCOPTERS = Path(ROOT, "configs", "ardupilot_sitl.toml")
VICTIM = 1
Direction = Literal["both", "from_vehicle"]


def lost(flight: Lockstep, direction: Direction) -> float:
    """Lose the victim's link in the middle of a swap, for 17 s; the least separation [m] from then on."""
    while not mission_t_s(flight) >= 1.5:
        flight.step()
    loss = FaultParams(kind="link_loss", vehicle=VICTIM, value=1.0, direction=direction)
    flight.world.faults.begin(loss, flight.world.since_boot_us)
    until_us, least_m = flight.clock.now_us() + 17_000_000, float("inf")
    while flight.clock.now_us() < until_us:
        flight.step()
        least_m = min(least_m, float(closest_pair_m(flight.world.truth_rows()["pos_ned_m"][None])[0]))
    return least_m


@pytest.mark.parametrize("direction", ["both", "from_vehicle"])
def test_an_arducopter_that_its_agent_does_not_hear_lands_by_its_own_failsafe(direction: Direction) -> None:
    flight = Lockstep(load(ARDUCOPTERS, SWAP))
    assert lost(flight, direction) >= 0.85
    assert FlightMode(int(flight.world.truth_rows()["flight_mode"][VICTIM])) is FlightMode.LAND


def test_negative_control_heartbeats_that_go_on_keep_it_flying_into_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Autopilot, "is_attended", lambda autopilot, now_us: True)
    flight = Lockstep(load(ARDUCOPTERS, SWAP))
    assert lost(flight, "from_vehicle") < 0.6
    assert FlightMode(int(flight.world.truth_rows()["flight_mode"][VICTIM])) is FlightMode.EXTERNAL


def least_with_a_filling_link_m() -> float:
    """Fly the circle with a link from one vehicle whose delay grows by 20 ms a second; the least separation [m]."""
    flight, begun_us, least_m = Lockstep(load(None, (*COARSE, "mission.duration_s=60"))), None, float("inf")
    while begun_us is None or flight.clock.now_us() - begun_us < 25_000_000:
        flight.step()
        now_us = flight.clock.now_us()
        if begun_us is None:
            begun_us = now_us if mission_t_s(flight) > 8.0 else None
            continue
        for link in flight.world.links_of(VICTIM):
            link.from_vehicle.set_impairment("delay_ms", 20e-6 * (now_us - begun_us))
        least_m = min(least_m, float(closest_pair_m(flight.world.truth_rows()["pos_ned_m"][None])[0]))
    return least_m


def test_states_on_a_link_that_fills_up_are_not_flown_as_fresh() -> None:
    assert least_with_a_filling_link_m() >= 0.75


def test_negative_control_who_halves_what_a_round_trip_has_grown_by_comes_close(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def halved_us(clock: VehicleClock) -> float:
        if not clock._asked or not clock._spans():
            return 0.0
        return 0.5 * max(0.0, min(clock._offset_us + clock.rate * x - y for x, y in clock._asked) - 4_000)

    monkeypatch.setattr("swarmctl.mavlink.vehicle.vehicle_clock._QUESTIONS", 32)
    monkeypatch.setattr(VehicleClock, "_one_way_delay_us", property(halved_us))
    assert least_with_a_filling_link_m() < 0.5
