"""Sudden winds on x500 vehicles, judged on true states: how far one is blown, and that two don't touch."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.collision_monitor import CollisionMonitor
from sitl.studies.campaign.conditions.events import SimulatorFault
from sitl.studies.campaign.flight import TrialFlight, drawn
from sitl.studies.campaign.trials import Trial
from swarmctl.agent.flying import setpoint_output
from swarmctl.agent.planning.reference_selector import ReferenceSelector
from swarmctl.agent.watches.alerts import Alert
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.config import Config, load
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.commit.tube import Tube
from swarmctl.control.mpc.plan_buffer import PlanBuffer
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.types import Mode, Phase
from swarmctl.simulator_config import FaultParams
from tests.benches.guaranteed_trials import GUARANTEED_SWAP, fly_until
from tests.closed_loop.conftest import COARSE, ROOT, fly_now

X500 = ROOT / "configs" / "x500_circle.toml"
HOVER = ("sitl.start=air", "mission.kind=hover", "mission.duration_s=8", "sitl.estimator=exact")


def track_in_wind(config: Config, wind: SimulatorFault, for_s: float) -> Lockstep:
    """Fly until so long after the mission's begin, by which the wind counts its time too."""
    flight = Lockstep(config)
    began_s = None

    def blown(lockstep: Lockstep) -> bool:
        nonlocal began_s
        now_s = lockstep.clock.now_us() * 1e-6
        if began_s is None and lockstep.logs[0].rows[-1]["phase"][0] == Phase.TRACK:
            began_s = now_s
        if began_s is None:
            return False
        wind.step(lockstep, now_s - began_s, lockstep.world.plant.pos_ned_m.T, lockstep.world.plant.vel_ned_m_s.T)
        return now_s - began_s > for_s

    flight.run(blown)
    return flight


@pytest.mark.parametrize("gust_m_s", [4.0, 8.0])
@pytest.mark.parametrize(("towards_deg", "least_01"), [(0.0, 0.9), (30.0, 0.7)])  # tilt is bounded along each axis
def test_a_sudden_wind_blows_a_hovering_vehicle_no_farther_than_distances_leave_room_for(
    gust_m_s: float, towards_deg: float, least_01: float
) -> None:
    config = load(X500, [*HOVER, "swarm.agents=1", f"separation.gust_m_s={gust_m_s}"])
    wind = SimulatorFault(FaultParams(kind="wind", vehicle=0, value=gust_m_s, towards_deg=towards_deg), 2.0)
    flight = track_in_wind(config, wind, 6.0)
    ticks = flight.logs[0].ticks
    begin_us = ticks["t_us"][ticks["phase"] == Phase.TRACK][0]
    places_m = flight.truth["pos_ned_m"][flight.truth["t_us"] >= begin_us]
    drifted_m = np.linalg.norm(places_m - places_m[0], axis=1).max()
    assert least_01 * config.drift_m < drifted_m <= config.drift_m


def separation_blown_together_m(wind_m_s: float, apart_m: float) -> float:
    """Return the least true distance of two that hover, one of which an unexpected wind blows towards the other."""
    places = f"start.positions_ned_m=[[0,0,-5],[{apart_m},0.1,-5]]"
    wind = SimulatorFault(FaultParams(kind="wind", vehicle=0, value=wind_m_s, towards_deg=0.0), 2.0)
    config = load(X500, [*HOVER, "swarm.agents=2", places, "separation.gust_m_s=0.5"])
    flight = track_in_wind(config, wind, 6.0)
    pos_ned_m = flight.truth.reshape(-1, 2)["pos_ned_m"]
    return float(np.linalg.norm(pos_ned_m[:, 0] - pos_ned_m[:, 1], axis=1).min())


@pytest.mark.parametrize(("wind_m_s", "apart_m"), [(8.0, 1.2), (12.0, 2.0)])
def test_refused_plans_that_come_less_close_than_older_ones_are_flown(
    wind_m_s: float, apart_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No distance is kept in such a wind, far beyond the 0.5 m/s that is told: what is claimed is the difference."""
    with_them_m = separation_blown_together_m(wind_m_s, apart_m)
    monkeypatch.setattr(PlanBuffer, "_refused_m", lambda self, *_: -math.inf)
    assert with_them_m > separation_blown_together_m(wind_m_s, apart_m) + 0.04


def test_a_vehicle_that_brakes_at_all_tilt_it_has_stays_under_control() -> None:
    """Both axes together asked for more tilt than there is, and what braking began with had no thrust."""
    box = "volume={corners_ne_m=[[-3,-3],[3,-3],[3,3],[-3,3]],floor_z_m=-0.5,ceiling_z_m=-8}"
    place = "start.positions_ned_m=[[0,0,-5]]"
    wind = SimulatorFault(FaultParams(kind="wind", vehicle=0, value=12.0, towards_deg=40.0, for_s=5.0), 2.0)
    flight = track_in_wind(
        load(X500, [*HOVER, *COARSE, "swarm.agents=1", "mission.duration_s=14", place, box]), wind, 10.0
    )
    rows = flight.logs[0].ticks
    assert [event for event in flight.logs[0].events if event["event"] == "setpoint_refused"] == []
    assert Mode.PILOT_OVERRIDE not in rows["mode"] and Mode.BRAKE in rows["mode"]
    assert np.linalg.norm(flight.truth["pos_ned_m"][-1, :2]) < 5.0


def sunken_in_wind(wind_m_s: float, towards_deg: float) -> tuple[float, str]:
    """Return how far one on the circle sinks below its reference in a steady wind, and its alert after 4 s."""
    north, east = (wind_m_s * turn(math.radians(towards_deg)) for turn in (math.cos, math.sin))
    told: list[Alert | None] = []

    def note_alert(running: Lockstep) -> None:
        assert running.agents[0] is not None
        told.append(running.agents[0]._publisher.active_alert)

    settings = ("swarm.agents=1", "mission.duration_s=10", f"sitl.wind.mean_ned_m_s=[{north:.3f},{east:.3f},0]")
    over = Lockstep.mission_is_over
    flight = fly_now(*COARSE, "sitl.start=air", *settings, config=X500.name, at={4.0: note_alert}, until=over)
    _, error_ned_m = flight.tracked(0)
    return float(error_ned_m[:, 2].max()), "" if told[0] is None else told[0].text


@pytest.mark.parametrize("towards_deg", [0.0, 45.0])
def test_a_wind_that_thrust_does_not_hold_costs_place_and_not_height(
    towards_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """11 m/s, upwind on the circle 13: tilted against it as far as it may be, an x500 does not carry itself."""
    sunken_m, told = sunken_in_wind(11.0, towards_deg)
    assert sunken_m < 2.5
    assert "too low: tilts no more than its thrust holds" in told
    monkeypatch.setattr(setpoint_output, "holding_height", lambda virtual_control, *_: virtual_control)
    assert sunken_in_wind(11.0, towards_deg)[0] > 5.0


def drifted_in_hold_m() -> float:
    """Return how far a wind of 7 m/s, after 20 s, has carried one that is held below a mission that climbs on."""
    blows = "sitl.faults=[{kind='wind',vehicle=0,at_s=20,value=7,towards_deg=0}]"
    climbs = ("sitl.start=air", "swarm.agents=1", "mission.duration_s=60", "mission.circle.climb_ned_m_s=-0.6", blows)
    flight = fly_now(
        *COARSE,
        *climbs,
        "controller.mpc.thrust_max_m_s2=12.5",
        config=X500.name,
        at={3.0: lambda running: running.command("hold")},
        until=lambda running: running.clock.now_us() >= 40_000_000,
    )
    before = int(np.searchsorted(flight.t_s, 19.0))
    return float(np.linalg.norm(flight.pos_ned_m[-1, 0] - flight.pos_ned_m[before, 0]))


def test_who_is_held_below_a_mission_that_climbs_has_not_sunk(monkeypatch: pytest.MonkeyPatch) -> None:
    assert drifted_in_hold_m() < 3.0
    of_mission = property(lambda references: float(references.reference(np.zeros(3), np.zeros(3))[1].pos_ned_m[0, 2]))
    monkeypatch.setattr(ReferenceSelector, "followed_z_m", of_mission)
    assert drifted_in_hold_m() > 20.0, "negative control"


def blown_farther_than_expected(*sets: str, too_close_m: float = 0.0) -> CollisionMonitor:
    """Six vehicles swap with room for gusts of 3.65 m/s; each is hit by a wind of 8 m/s of its own in the first 4 s.

    That is more than is guaranteed: what is shown is that the reaction makes the difference in one flight, not in all.
    Of eight flights drawn one touches with it; the medians are 1.51 m, and 1.16 m without it. This one keeps 1.53 m,
    and 0.88 m without it. A flight ends when two are too close.
    """
    settings = " ".join(("separation.gust_m_s=3.65", *sets))
    cell = replace(GUARANTEED_SWAP, agents=6, airframe="x500", disturbance="steps:8", sets=settings)
    flight = TrialFlight(Trial(cell, 3), replace(drawn(cell, 3), limit_s=8.0))
    return fly_until(flight, lambda now: now.monitor.min_separation_m < too_close_m).monitor


@pytest.mark.usefixtures("configured_starts")
def test_vehicles_that_are_blown_out_of_their_tubes_commit_anew_and_keep_apart() -> None:
    assert blown_farther_than_expected().min_separation_m >= 1.2


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_vehicles_that_chase_what_they_were_committed_to_come_too_close(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What distances leave for clocks is off, too."""
    monkeypatch.setattr(Trajectory, "spread_m", lambda self, from_utc_us: 0.0)
    monkeypatch.setattr(PeerClocks, "spread_us", lambda self, agent: 0)
    monkeypatch.setattr(Tube, "update", lambda self, *_, **__: False)
    monkeypatch.setattr(Commitments, "wait_for", lambda self, *_: None)
    assert blown_farther_than_expected("separation.approach_01=0", too_close_m=0.9).min_separation_m < 0.9
