"""Flights in a flight volume, judged on true states: nobody leaves it, whoever is found outside comes back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import Config, load
from swarmctl.core.flight_volume import VolumeParams
from swarmctl.core.types import Mode, Phase
from swarmctl.simulator_config import SimulatorConfig
from tests.closed_loop.conftest import AT_100_HZ, Flight

CORNERS = "[[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]]"
VOLUME = (f"volume.corners_ne_m={CORNERS}", "volume.floor_z_m=1", "volume.ceiling_z_m=-3")
CIRCLE = (  # of a radius that fits
    AT_100_HZ,
    "swarm.agents=2",
    "sitl.start=air",
    "start.center_ned_m=[0, 0, -1]",
    "start.spacing_m=1.5",
    "mission.circle.radius_m=1.5",
    "mission.circle.omega_rad_s=0.8",
    "mission.duration_s=4",
)
TOO_WIDE_M = 4.0


def too_wide(*overrides: str) -> Config:
    """Return a mission whose reference leads out of the volume, which no configuration file can ask for."""
    config = load(None, [*CIRCLE, *VOLUME, *overrides])
    circle = config.mission.flown().model_copy(update={"radius_m": TOO_WIDE_M})
    return config.model_copy(update={"mission": config.mission.model_copy(update={"circle": circle})})


def flown(config: Config) -> Flight:
    lockstep = Lockstep(config)
    lockstep.run(Lockstep.mission_is_over)
    return Flight(lockstep)


def farthest_m(flight: Flight, config: Config) -> float:
    """Return how far outside of the volume anybody was in the mission; negative is inside."""
    volume = config.volume.flight_volume()
    assert volume is not None
    began_s = min(float(flight.tracked(agent)[0]["t_us"][0]) * 1e-6 for agent in range(config.swarm.agents))
    return float(volume.beyond_m(flight.pos_ned_m[flight.t_s >= began_s]).max())


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_nobody_leaves_the_volume_after_a_reference_that_does(mode: str) -> None:
    config = too_wide(f"separation.mode={mode}")
    flight = flown(config)
    assert farthest_m(flight, config) <= -config.volume.margin_m + 0.06
    assert flight.separation_m() >= 0.85
    for agent in range(2):
        replayed = flight.ticks(agent)["mode"] == Mode.REPLAY
        assert float(np.mean(replayed)) < 0.05
        assert flight.modes(agent, Phase.TRACK) <= {Mode.TRACKING, Mode.REPLAY}


def test_negative_control_agents_that_know_of_no_volume_leave_it() -> None:
    config = too_wide()
    volume = config.volume.flight_volume()
    assert volume is not None
    flight = Lockstep(config.model_copy(update={"volume": VolumeParams()}))
    while float(volume.beyond_m(flight.world.truth_rows()["pos_ned_m"]).max()) < 0.5:
        assert not flight.mission_is_over()
        flight.step()


def test_a_vehicle_found_outside_is_told_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """It hovers 0.8 m beside the volume when the agent takes control, and an operator holds it there at once."""
    config = load(None, [*CIRCLE, *VOLUME, "swarm.agents=1", "start.positions_ned_m=[[0, 0, -1]]"])
    elsewhere = config.simulator().model_copy(update={"spawn_ned_m": ((3.3, 0.0, -1.0),)})
    monkeypatch.setattr(Config, "simulator", lambda _: SimulatorConfig.model_validate(elsewhere))
    lockstep, held_us = Lockstep(config), 0

    def hold(running: Lockstep) -> bool:
        nonlocal held_us
        rows = running.logs[0].rows
        if rows and rows[-1]["mode"][0] == Mode.TRACKING and not held_us:
            running.command("hold")
            held_us = running.clock.now_us()
        return bool(held_us) and running.clock.now_us() > held_us + 3_000_000

    lockstep.run(hold)
    flight = Flight(lockstep)
    assert flight.pos_ned_m[0, 0, 0] > 3.2
    assert flight.pos_ned_m[-1, 0, 0] == pytest.approx(2.5 - config.volume.margin_m, abs=0.03)
    told: list[dict[str, Any]] = [e for e in lockstep.logs[0].events if e["event"] == "outside_volume"]
    assert [event["begins"] for event in told] == [True, False]
    assert told[0]["face"].startswith("side")
    assert told[1]["worst_m"] == pytest.approx(0.8, abs=0.1)
    assert flight.modes(0, Phase.GOTO_START) <= {Mode.IDLE, Mode.PRIMING, Mode.TRACKING}, "no hard failure"
