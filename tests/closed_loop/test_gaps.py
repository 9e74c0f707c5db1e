"""Tests of an agent stopped briefly: it continues before the autopilot's failsafe acts, or notices that it has."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as dialect

from sitl.lockstep import Lockstep
from sitl.px4.link.endpoint import Endpoint
from swarmctl.agent.planning.coordination import Coordination
from swarmctl.core.types import FlightMode, Mode, Phase
from swarmctl.mavlink.vehicle.autopilot import Autopilot
from swarmctl.simulator_config import FaultParams
from tests.closed_loop.conftest import Flight, Fly, mission_t_s

ALONE = ("swarm.agents=1", "sitl.start=air", "mission.duration_s=8")
AT_S = 4.03


def freeze(running: Lockstep) -> None:
    """The vehicle reports modes by HEARTBEAT only, once a second, or on request."""
    endpoint = running.world.endpoints[0]
    assert isinstance(endpoint, Endpoint)
    endpoint.set_interval(dialect.MAVLINK_MSG_ID_CURRENT_MODE, -1)
    running.frozen.add(0)


def gaps(flight: Flight) -> list[float]:
    """Return the times between setpoints while tracking [s], the longest first."""
    ticks = flight.ticks(0)
    ticks = ticks[(ticks["phase"] == Phase.TRACK) & np.isfinite(ticks["setpoint_thrust_01"])]
    return sorted((np.diff(ticks["t_us"]) * 1e-6).tolist(), reverse=True)


def fly_stopped_for(fly: Fly, seconds: float) -> Flight:
    """Fly until three seconds after the agent was stopped."""
    stopped_us: list[int] = []

    def stop(running: Lockstep) -> None:
        freeze(running)
        stopped_us.append(running.clock.now_us())

    def over(running: Lockstep) -> bool:
        since_s = (running.clock.now_us() - stopped_us[0]) * 1e-6 if stopped_us else 0.0
        if since_s >= seconds:
            running.frozen.discard(0)
        return since_s > 3.0

    return fly(*ALONE, at={AT_S: stop}, until=over)


def is_overridden(flight: Flight) -> bool:
    return Mode.PILOT_OVERRIDE in flight.modes(0)


def test_an_agent_stopped_for_a_third_of_a_second_continues_before_a_failsafe_acts(fly: Fly) -> None:
    flight = fly_stopped_for(fly, 0.32)
    assert 0.32 <= gaps(flight)[0] < 0.40
    assert gaps(flight)[1] < 0.05
    ticks = flight.ticks(0)
    assert set(ticks["flight_mode"][ticks["phase"] == Phase.TRACK].tolist()) == {FlightMode.EXTERNAL}
    assert not is_overridden(flight)
    assert "setpoint_gap" not in flight.event_names(0)


def test_negative_control_who_waits_to_be_told_the_mode_loses_the_vehicle(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Autopilot, "_ask_for", lambda *_, **__: None)
    flight = fly_stopped_for(fly, 0.32)
    assert is_overridden(flight)


def test_an_agent_stopped_for_longer_leaves_control_to_the_failsafe(fly: Fly) -> None:
    flight = fly_stopped_for(fly, 0.8)
    assert is_overridden(flight)
    assert np.isnan(flight.ticks(0)["setpoint_thrust_01"][-100:]).all()


GUARANTEED = ("swarm.agents=3", "sitl.start=air", "separation.mode=guaranteed", "mission.duration_s=8")


def times_abandoned(fly: Fly) -> int:
    """Return how often an agent abandoned its commitment, while telemetry of its vehicle stopped twice for 0.35 s."""

    def stop(running: Lockstep) -> None:
        gap = FaultParams(kind="link_loss", vehicle=0, value=1.0, for_s=0.35, direction="from_vehicle")
        running.world.faults.begin(gap, running.world.since_boot_us)

    flight = fly(*GUARANTEED, at={2.0: stop, 4.0: stop}, until=lambda running: mission_t_s(running) > 4.1)
    assert Mode.STATE_STALE in flight.modes(0)
    return flight.event_names(0).count("commitments")


def test_a_short_telemetry_gap_keeps_what_is_committed(fly: Fly) -> None:
    assert times_abandoned(fly) == 0


def test_negative_control_an_agent_that_idles_in_a_gap_commits_anew_at_speed(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Coordination, "wait", Coordination.idle)
    assert times_abandoned(fly) > 0
