"""What an agent says that it waits for, and for how long it says it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from swarmctl.agent.mission.start_conditions import StartConditions
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.failsafe.overload import OverloadParams
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.core.types import Landed, Phase
from tests import builders

SECOND = 1_000_000
SETUP = SimpleNamespace(
    code="",
    starts_ned_m=np.zeros((2, 3)),
    separation=SeparationParams(),
    drift_m=0.0,
    agent=0,
    params=SimpleNamespace(overload=OverloadParams(), state_machine=StateMachineParams()),
)


@pytest.mark.parametrize(
    ("phase", "waits_for"), [(Phase.GOTO_START, "its estimator"), (Phase.TRACK, "agent-1"), (Phase.READY, "")]
)
def test_an_agent_that_waits_no_longer_does_not_say_so(phase: Phase, waits_for: str) -> None:
    mission, alerts = SimpleNamespace(phase=Phase.STANDBY, waits_for="its estimator"), Alerts()
    conditions = StartConditions(cast(AgentSetup, SETUP), cast(MissionState, mission), alerts)
    for now_us in range(0, 5 * SECOND, SECOND // 10):
        conditions.report(now_us)
    alert = alerts.newest(5 * SECOND)
    assert alert is not None
    assert alert.text == "waits for its estimator"
    mission.phase, mission.waits_for = phase, waits_for
    conditions.report(5 * SECOND)
    assert alerts.newest(5 * SECOND) is None


@pytest.mark.parametrize(
    ("phase", "others_m", "said"),
    [
        (Phase.STANDBY, {1: 5.4, 2: 4.6}, ""),
        (Phase.STANDBY, {1: 5.4, 2: 4.4}, "estimates to stand 0.6 m above agent-2: "),
        (Phase.STANDBY, {1: 7.0, 2: 4.4}, "estimates to stand 2.0 m below agent-1: "),
        (Phase.TAKEOFF, {1: 7.0}, ""),
        (Phase.STANDBY, {}, ""),
    ],
)
def test_who_stands_at_another_height_than_a_peer_says_so(phase: Phase, others_m: dict[int, float], said: str) -> None:
    alerts, mission = Alerts(), SimpleNamespace(phase=phase)
    conditions = StartConditions(cast(AgentSetup, SETUP), cast(MissionState, mission), alerts)
    stands = builders.vehicle_state(landed=Landed.ON_GROUND, pos_ned_m=np.array([0.0, 0.0, -5.0]))
    conditions.compare_heights(0, stands, lambda: others_m)
    alert = alerts.newest(0)
    assert (alert is not None) == bool(said)
    assert alert is None or alert.text.startswith(said)


def test_nobody_is_armed_beside_another_vehicle_until_that_has_been_away_for_a_while() -> None:
    mission = SimpleNamespace(phase=Phase.STANDBY)
    conditions = StartConditions(cast(AgentSetup, SETUP), cast(MissionState, mission), Alerts())
    stands = builders.vehicle_state(landed=Landed.ON_GROUND)

    def waits_for(at_s: float, north_m: float) -> str:
        other = np.array([north_m, 0.0, -9.0])  # its height is no matter to a vehicle that climbs
        return conditions.unsettled(round(at_s * SECOND), 0.05, stands, lambda: [other], dict)

    for tenth in range(50):
        waits_for(tenth / 10.0, 1.0)
    assert waits_for(5.0, 0.9) == ""
    assert waits_for(5.1, 0.4) == "0.62 m to the next vehicle (now 0.40 m)"
    assert waits_for(9.0, 0.9) == "0.62 m to the next vehicle (now 0.90 m)"
    assert waits_for(9.2, 0.9) == ""
    for at_s, phase in ((9.3, Phase.ARM), (9.6, Phase.TAKEOFF)):
        mission.phase = phase
        assert waits_for(at_s, 0.9) == ""
        assert waits_for(at_s + 0.1, 0.6) == "0.62 m to the next vehicle (now 0.60 m)", "it has come since"
        assert waits_for(at_s + 0.2, 0.9) == "", "and gone"
    mission.phase = Phase.GOTO_START
    assert waits_for(9.9, 0.4) == "", "an agent flies it, which avoids the other one"


@pytest.mark.parametrize("vehicles", [1, 2])
@pytest.mark.parametrize(
    ("place_ned_m", "landed", "said"),
    [
        ((0.0, 0.0, 85.0), Landed.ON_GROUND, ""),
        ((170.0, 0.0, 2.0), Landed.ON_GROUND, ""),
        ((0.0, 0.0, 489.0), Landed.ON_GROUND, "(it is 0 m beside it, 489 m below): correct swarm.origin_*"),
        ((300.0, -400.0, 2.0), Landed.ON_GROUND, "(it is 500 m beside it, 2 m below): correct swarm.origin_*"),
        ((100.0, 0.0, 50.0), Landed.ON_GROUND, "(it is 100 m beside it, 50 m below): correct swarm.origin_*"),
        ((300.0, -400.0, 2.0), Landed.IN_AIR, "(it is 500 m beside it, 2 m below): correct swarm.origin_*"),
        ((170.0, 0.0, -200.0), Landed.IN_AIR, ""),
        ((300.0, -400.0, 2.0), Landed.UNKNOWN, ""),
    ],
)
def test_nobody_is_armed_whose_start_is_somewhere_else(
    place_ned_m: tuple[float, float, float], landed: Landed, said: str, vehicles: int
) -> None:
    """The autopilot would climb to the height of the start, wherever that is."""
    setup, mission = SimpleNamespace(**vars(SETUP)), SimpleNamespace(phase=Phase.STANDBY)
    setup.starts_ned_m = np.zeros((vehicles, 3))
    conditions = StartConditions(cast(AgentSetup, setup), cast(MissionState, mission), Alerts())
    stands = builders.vehicle_state(landed=landed, pos_ned_m=np.array(place_ned_m))
    for second in range(6):
        waits_for = conditions.unsettled(second * SECOND, 0.05, stands, tuple, dict)
    assert said in waits_for
    assert waits_for.startswith("its start to be within reach") == bool(said)
    mission.phase = Phase.TAKEOFF
    assert conditions.unsettled(6 * SECOND, 0.05, stands, tuple, dict) == ""


def test_an_agent_whose_processor_has_too_much_to_do_waits_until_it_keeps_up_for_a_while() -> None:
    """Rehearsals begin in STANDBY: what was missed before says nothing, and neither does a short lull."""
    mission = SimpleNamespace(phase=Phase.CONNECT)
    lone = SimpleNamespace(starts_ned_m=np.zeros((1, 3)), params=SETUP.params)
    conditions = StartConditions(cast(AgentSetup, lone), cast(MissionState, mission), Alerts())

    def waits_for(at_s: float, missed_01: float) -> str:
        return conditions.too_slow(round(at_s * SECOND), missed_01)

    for tenth in range(50):
        waits_for(tenth / 10.0, 0.0)
    mission.phase = Phase.STANDBY
    few = "its processor to keep up: fewer than 20 % of deadlines missed for 2 s"
    assert waits_for(5.0, 0.1) == f"{few} (now 10 %)"
    assert waits_for(6.9, 0.37) == f"{few} (now 37 %)"
    assert waits_for(7.0, 0.19) == f"{few} (now 19 %)"
    assert waits_for(8.9, 0.19) == f"{few} (now 19 %)"
    assert waits_for(9.0, 0.19) == ""
    assert waits_for(9.1, 0.2) == f"{few} (now 20 %)"
    mission.phase = Phase.ARM
    assert waits_for(9.2, 0.5) == "", "overload in flight has other consequences"


@pytest.mark.parametrize(
    ("own", "others", "said"),
    [
        ("swarmctl 2", {1: "swarmctl 2"}, ""),
        ("swarmctl 2", {1: "swarmctl 3"}, "agent-1 to fly the same code: swarmctl 3 there, swarmctl 2 here"),
        ("swarmctl 2", {1: ""}, "agent-1 to fly the same code: an older swarmctl there, swarmctl 2 here"),
        ("", {1: ""}, ""),
    ],
)
def test_nobody_is_armed_among_agents_that_fly_other_code(own: str, others: dict[int, str], said: str) -> None:
    setup, mission = SimpleNamespace(**vars(SETUP) | {"code": own}), SimpleNamespace(phase=Phase.STANDBY)
    conditions = StartConditions(cast(AgentSetup, setup), cast(MissionState, mission), Alerts())
    stands = builders.vehicle_state(landed=Landed.ON_GROUND)
    for second in range(6):
        waits_for = conditions.unsettled(second * SECOND, 0.05, stands, tuple, lambda: others)
    assert waits_for == said


@pytest.mark.parametrize(
    ("vehicles", "accuracy_m", "at_once", "later"),
    [
        (2, 0.05, "the estimator's accuracy to settle", ""),
        (2, 2.0, "the estimator's accuracy to settle", "separation.radius_m = 0.9: body"),
        (2, None, "the estimator to tell its accuracy", ""),
        (1, 2.0, "", ""),
    ],
)
def test_nobody_is_armed_among_others_while_an_estimate_settles_or_is_too_inaccurate_for_the_radius(
    vehicles: int, accuracy_m: float | None, at_once: str, later: str
) -> None:
    setup = SimpleNamespace(**vars(SETUP) | {"starts_ned_m": np.zeros((vehicles, 3))})
    conditions = StartConditions(
        cast(AgentSetup, setup), cast(MissionState, SimpleNamespace(phase=Phase.STANDBY)), Alerts()
    )
    stands = builders.vehicle_state(landed=Landed.ON_GROUND)
    said = [conditions.unsettled(second * SECOND, accuracy_m, stands, tuple, dict) for second in range(6)]
    for text, expected in ((said[0], at_once), (said[-1], later)):
        assert text.startswith(expected)
        assert bool(text) == bool(expected)
