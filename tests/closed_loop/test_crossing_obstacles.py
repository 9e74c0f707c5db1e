"""Obstacles that move across the way of a vehicle that its autopilot, which avoids none, would fly up or down."""

from __future__ import annotations

import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Landed, Phase
from tests.closed_loop.conftest import COARSE, ROOT
from tests.closed_loop.test_operator import fly_until, outcome, phase, vehicle

ALONE = (*COARSE, "swarm.agents=1", "start.positions_ned_m=[[0,0,-8]]", "mission.kind=hover", "mission.duration_s=1")
BALL = Obstacle(center_ned_m=(0.0, 0.0, 0.0), radius_m=0.5, keep_out_m=1.0, visibility_m=3.0)
AUTOPILOTS = pytest.mark.parametrize("config", [None, "ardupilot_sitl.toml"], ids=["px4", "arducopter"])
PROTECTED = pytest.mark.parametrize("waits", [True, False], ids=["keeps clear", "negative control"])


def alone(config: str | None, waits: bool, monkeypatch: pytest.MonkeyPatch) -> Lockstep:
    if not waits:
        monkeypatch.setattr(PhaseInputs, "crossing_obstacle", lambda *_: None)
    return Lockstep(load(None if config is None else ROOT / "configs" / config, ALONE))


def crosses(flight: Lockstep, at_z_m: float, from_m: float, speed_m_s: float) -> Obstacle:
    """Add an obstacle that flies south through the vertical of the vehicle, from so far north."""
    north_m, east_m, _ = vehicle(flight)[0].tolist()
    centre = (north_m + from_m, east_m, at_z_m)
    added = BALL.model_copy(update={"center_ned_m": centre, "vel_ned_m_s": (-speed_m_s, 0.0, 0.0)})
    flight.set_obstacles([added])
    return added


def least_m(flight: Lockstep, obstacle: Obstacle, seconds: float) -> float:
    """Fly for a while, and return the least true distance from an obstacle that begins to move now."""
    began_us, found_m = flight.clock.now_us(), []
    while flight.clock.now_us() < began_us + seconds * 1e6:
        flight.step()
        now = obstacle.moved((flight.clock.now_us() - began_us) * 1e-6)
        found_m.append(now.distance_m(vehicle(flight)[0]))
    return min(found_m)


@AUTOPILOTS
@PROTECTED
def test_a_climbing_vehicle_keeps_clear(config: str | None, waits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its agent takes control before the obstacle is where its autopilot would climb."""
    flight = alone(config, waits, monkeypatch)
    ground_z_m = float(vehicle(flight)[0][2])
    fly_until(flight, lambda: phase(flight) is Phase.TAKEOFF and vehicle(flight)[0][2] < ground_z_m - 2.0)
    meets_s = 3.0 / -float(vehicle(flight)[1][2])
    least = least_m(flight, crosses(flight, ground_z_m - 5.0, 1.5 * meets_s, 1.5), 15.0)
    assert least > 0.85 if waits else least < BALL.radius_m
    assert phase(flight) in (Phase.TRACK, Phase.GOTO_LAND, Phase.LAND), "the mission goes on"


@AUTOPILOTS
@PROTECTED
def test_who_would_be_landed_waits(config: str | None, waits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = alone(config, waits, monkeypatch)
    ground_z_m = float(vehicle(flight)[0][2])
    fly_until(flight, lambda: phase(flight) is Phase.TRACK)
    from_m = (
        9.0 if config is None else 15.0
    )  # it meets a vehicle that is landed at once, as ArduCopter lands more slowly
    least = least_m(flight, crosses(flight, ground_z_m - 3.0, from_m, 1.0), 20.0)
    assert least > 5.0 if waits else least < BALL.radius_m, "it waits at its height, 7 m above"
    fly_until(flight, lambda: flight.world.truth_rows()[0]["landed"] == Landed.ON_GROUND)
    assert outcome(flight) == "completed"
