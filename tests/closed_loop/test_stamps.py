"""Tests that states with wrong stamps, received in flight, change neither the mission nor any bit of the flight."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as dialect

from sitl.lockstep import Lockstep
from swarmctl.control.phases.state_machine import REBOOTED
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock
from tests.closed_loop.conftest import Flight, Fly

OFFS_US = (-30_000_000, -1_500_000, 200_000, 900_000, 10**12)
NOTHING = [math.nan] * 21


def flown_with(fly: Fly, forged: bool) -> Flight:
    """Fly the first seconds of a mission of one agent with one forged state every tenth of a second."""
    codec = Codec(1, 1)

    def over(running: Lockstep) -> bool:
        now_us, count = running.clock.now_us(), running.clock.now_us() // 20_000
        if forged and now_us > 4_000_000 and count % 5 == 0:
            stamp_us = max(0, now_us + OFFS_US[count // 5 % len(OFFS_US)])
            state = (50.0, 50.0, -50.0, [1.0, 0.0, 0.0, 0.0], 9.0, 9.0, 0.0, 0.0, 0.0, 0.0)
            message = dialect.MAVLink_odometry_message(stamp_us, 1, 1, *state, NOTHING, NOTHING, 0, 2, 90)
            running.links[0][1].send(codec.encode(message))
        return now_us >= 9_000_000

    return fly("swarm.agents=1", "sitl.start=air", "mission.duration_s=20", until=over)


def test_forged_states_of_another_time_change_no_bit_of_the_flight(fly: Fly) -> None:
    touched, twin = flown_with(fly, True), flown_with(fly, False)
    assert np.isfinite(touched.ticks(0)["mission_t_s"][-1])
    assert touched.lockstep.truth.tobytes() == twin.lockstep.truth.tobytes()


def test_negative_control_believed_at_once_they_end_the_mission(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    def believe(clock: VehicleClock, vehicle_us: int, arrived_us: int) -> bool:
        clock.boots += 1
        clock.restarts += 1
        clock._begin_again(vehicle_us, arrived_us - vehicle_us)
        return True

    monkeypatch.setattr(VehicleClock, "_has_begun_again", believe)
    agent = flown_with(fly, True).lockstep.agents[0]
    assert agent is not None
    assert agent.outcome == REBOOTED
