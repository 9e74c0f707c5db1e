"""Tests that a controller of somebody else flies, and that a bad one is caught without a collision.

Two agents change places head-on. Each bad controller flies well until they approach each other.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.controllers import guard
from swarmctl.control.controllers.guard import Guard
from swarmctl.control.reference.kinds.goto import GotoParams
from swarmctl.core.types import Mode, Phase
from swarmctl.errors import ConfigError
from tests.benches import misbehaving
from tests.closed_loop.conftest import AT_100_HZ, FINE, ROOT, Flight, closer_than, fly_now

HEAD_ON = (
    AT_100_HZ,
    "swarm.agents=2",
    "sitl.start=air",
    "start.spacing_m=4",
    "start.center_ned_m=[0, 0, -1]",
    "mission.kind=swap",
    "mission.swap.travel_s=4",
    "mission.duration_s=5",
)


def named(controller: str) -> str:
    return f"controller.kind=tests.benches.misbehaving:{controller}"


def failures(flight: Flight, agent: int) -> list[str]:
    return [event["why"] for event in flight.lockstep.logs[agent].events if "why" in event]


def is_over_and_at_rest(lockstep: Lockstep) -> bool:
    return lockstep.mission_is_over() and bool(np.abs(lockstep.world.truth_rows()["vel_ned_m_s"]).max() < 0.2)


def test_a_controller_that_plans_through_a_peer_is_kept_from_it() -> None:
    flight = fly_now(*HEAD_ON, named("Meddling"), until=Lockstep.mission_is_over)
    assert flight.separation_m() >= 0.85
    assert flight.outcomes == {"completed"}
    for agent in range(2):
        assert failures(flight, agent), "its commands were not flown all the time"
        assert all("misbehaving:Meddling plans too close" in why for why in failures(flight, agent))
        brakes = np.count_nonzero(flight.ticks(agent)["mode"] == Mode.BRAKE)
        assert brakes <= 1, "there was a certified plan in every tick but one, after what it commanded"


def test_negative_control_without_guard_and_filter_it_flies_through(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Guard, "_clearance_m", lambda *_: np.inf)
    config = load(None, [*HEAD_ON, named("Straight")])
    unfiltered = config.agent.barrier.model_copy(update={"enabled": False})
    config = config.model_copy(update={"agent": config.agent.model_copy(update={"barrier": unfiltered})})
    flight, touched = Lockstep(config), closer_than(0.3)
    while not touched(flight):
        assert not flight.finished
        flight.step()


@pytest.mark.parametrize(
    "told",
    [
        {"Nan": "returned commands that are not finite", "Raising": "raised ZeroDivisionError: division by zero"},
        {"Sleeping": "took 1", "Straight": "plans too close to a peer"},
    ],
    ids=["nan and raising", "sleeping"],
)
def test_controllers_that_fail_are_caught_and_vehicles_brought_to_rest(told: dict[str, str]) -> None:
    configs = [load(None, [*HEAD_ON, named(controller)]) for controller in told]
    lockstep, alerts = Lockstep(configs[0], own={1: configs[1]}), set()
    while not is_over_and_at_rest(lockstep):
        assert not lockstep.finished
        lockstep.step()
        alerts |= {raised.text for agent in lockstep.agents if agent and (raised := agent._publisher.active_alert)}
    flight = Flight(lockstep)
    assert flight.separation_m() >= 0.85
    for agent, (controller, why) in enumerate(told.items()):
        said = f"controller tests.benches.misbehaving:{controller} {why}"
        assert any(said in alert for alert in alerts)
        assert said in failures(flight, agent)[-1]
        events = flight.lockstep.logs[agent].events
        traces = [event["traceback"] for event in events if event["event"] == "controller_raised"]
        if controller == "Raising":
            (line,) = re.findall(
                r"ZeroDivisionError: division by zero \(misbehaving\.py:(\d+)\)$", failures(flight, agent)[-1]
            )
            (trace,) = traces  # of twenty-five times
            assert f'misbehaving.py", line {line}, in _bad' in trace
        else:
            assert traces == []
        assert flight.modes(agent, Phase.TRACK) == {Mode.TRACKING}, "there always was a certified plan"
        pilot = lockstep.agents[agent]
        assert pilot is not None
        counts = pilot.own_controller
        assert counts["controller"] == f"tests.benches.misbehaving:{controller}"
        assert 0 < counts["flown_ticks"] < counts["mission_ticks"], "it flew well for a while"
        ended = said if controller != "Straight" else "completed"
        assert pilot.outcome.startswith(ended), "what is not asked any more ends the mission, and is named"


def flown_alone(controller: str, monkeypatch: pytest.MonkeyPatch, until: Callable[[Lockstep], bool]) -> Flight:
    """Fly a controller that is bad from the first tick on, a way off its reference."""
    monkeypatch.setattr(misbehaving, "GOOD_TICKS", 0)
    lone = (FINE, "swarm.agents=1", "sitl.start=air", "mission.duration_s=3")
    return fly_now(*lone, named(controller), until=until)


def largest_tilt_deg(flight: Flight) -> float:
    q_nb = flight.lockstep.truth["q_nb"].astype(np.float64)
    return float(np.degrees(np.arccos(1.0 - 2.0 * (q_nb[:, 1] ** 2 + q_nb[:, 2] ** 2))).max())


def test_a_controller_that_chatters_turns_no_vehicle_over(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = flown_alone("Chattering", monkeypatch, is_over_and_at_rest)
    assert largest_tilt_deg(flight) < np.degrees(flight.config.vehicle_model.tilt_max_rad), "no more than is asked for"
    why = "controller tests.benches.misbehaving:Chattering tilts to and fro faster than the vehicle follows"
    assert failures(flight, 0)[-1] == why
    (outcome,) = flight.outcomes
    assert outcome.startswith(why), "it is not asked any more"


def test_negative_control_flown_it_turns_the_vehicle_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard._Chatter, "refusal", lambda *_: "")
    flight = flown_alone("Chattering", monkeypatch, Lockstep.mission_is_over)
    assert largest_tilt_deg(flight) > 60.0


def test_negative_control_a_controller_that_swings_is_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = flown_alone("Swinging", monkeypatch, Lockstep.mission_is_over)
    assert failures(flight, 0) == []


@pytest.mark.parametrize(
    ("name", "rmse_m", "duration_s"),
    [("own_pid", 0.1, 2), ("own_lqr", 0.1, 4), ("own_spiral", 0.05, 2)],  # less than 4 s do not reach its goal
)
def test_every_example_flies(name: str, rmse_m: float, duration_s: int) -> None:
    short = (
        FINE,
        "sitl.start=air",
        f"mission.duration_s={duration_s}",
        *(() if name == "own_pid" else ("swarm.agents=1",)),
    )
    flight = fly_now(*short, config=f"examples/{name}.toml", until=Lockstep.mission_is_over)
    assert flight.outcomes == {"completed"}
    for agent in range(flight.config.swarm.agents):
        ticks, error = flight.tracked(agent)
        late = ticks["mission_t_s"] > 1.0
        assert float(np.sqrt(np.mean(np.sum(error[late] ** 2, axis=1)))) <= rmse_m
        assert failures(flight, agent) == [], "it flies itself"
        pilot = flight.lockstep.agents[agent]
        assert pilot is not None
        counts, tracked = pilot.own_controller, len(ticks) + 1  # the last tick of TRACK begins the next phase
        own = {"controller": flight.config.controller.kind, "flown_ticks": tracked, "mission_ticks": tracked}
        assert counts == (own if flight.config.controller.is_own else {})


SWAPPED = "mission.own.formations=[{slots_ned_m=[[2.0,1.0,-3.0],[2.0,-1.0,-3.0]]}]"  # agent 0 waits on the other side


def test_a_formation_is_changed_by_the_assignment_of_least_squares() -> None:
    short = ("swarm.agents=2", "sitl.start=air", "mission.duration_s=4.5", "mission.own.stay_s=0.5")
    sets = (*short, "mission.own.change_s=3.0", SWAPPED)
    flight = fly_now(*sets, config="examples/own_formation.toml", until=Lockstep.mission_is_over)
    assert flight.outcomes == {"completed"}
    assert flight.separation_m() >= 1.9, "side by side"
    for agent, slot in enumerate(([2.0, -1.0, -3.0], [2.0, 1.0, -3.0])):
        ticks, _ = flight.tracked(agent)
        assert ticks["pos_ned_m"][-1] == pytest.approx(slot, abs=0.05)
    with pytest.raises(ConfigError, match=r"agents 0 and 1: at .* the references are"):
        fly_now(
            *sets, "mission.own.assigned=false", config="examples/own_formation.toml", until=Lockstep.mission_is_over
        )
    with pytest.raises(ConfigError, match=r"agents 0 and 3: at 4\.54 s the references are 0\.85 m apart"):
        load(ROOT / "configs" / "examples/own_formation.toml", ["mission.own.assigned=false"])


def test_six_agents_with_goals_and_obstacles_of_their_own_are_in_one_file() -> None:
    config = load(ROOT / "configs" / "examples/six_goals.toml")
    assert len(set(config.mission.section(GotoParams).goals_ned_m)) == config.swarm.agents == 6
    assert [obstacle.column for obstacle in config.obstacles] == [True, False, False]
