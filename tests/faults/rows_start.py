"""Around the start: who stays on the ground, whose place to return to is taken, who falls silent beside others."""

from __future__ import annotations

import math
from typing import Any

from swarmctl.agent.sensing import world_model
from swarmctl.control.phases import departure, landing
from swarmctl.control.phases.steps import on_ground
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Phase
from tests.closed_loop.conftest import COARSE
from tests.faults.row import Off
from tests.faults.rows_agents import frozen
from tests.faults.rows_vehicle import SET_MODE, link, pilot
from tests.faults.simulated import VICTIM, Scene, SimulatedRow, tracking

IN_A_ROW = (  # they hover seven metres above the ground
    *COARSE,
    "swarm.agents=3",
    "start.positions_ned_m=[[3,0,-5],[0,0,-5],[-3,0,-5]]",
    "mission.kind=hover",
    "mission.duration_s=60",
)
BESIDE_EACH_OTHER = (*COARSE, "swarm.agents=4", "mission.duration_s=25", "separation.mode=guaranteed")  # 1 m apart
OVER_FIRST = Obstacle(center_ned_m=(3.0, 0.1, -1.5), radius_m=0.5, keep_out_m=1.0, visibility_m=3.0)
FIRST = 0
_HOLDS_AFTER_S, _RETURNS_AFTER_S = 8.0, 10.0
_PX4_CUSTOM_MODE, _AUTO, _AUTO_LOITER = 1.0, 4.0, 3.0


def takes_the_place(scene: Scene) -> None:
    """Send the victim below the first agent's start, where its pilot takes it over; then let the first one return."""
    scene.lockstep.command("goto", VICTIM, north_m=3.0, east_m=0.0, down_m=-2.0)
    due: list[tuple[float, Any]] = [
        (_HOLDS_AFTER_S, pilot(SET_MODE, _PX4_CUSTOM_MODE, _AUTO, _AUTO_LOITER)),
        (_RETURNS_AFTER_S, lambda scene: scene.lockstep.command("rtl", FIRST)),
    ]

    def goes_on(scene: Scene) -> None:
        if due and scene.since_s > due[0][0]:
            due.pop(0)[1](scene)

    scene.each_tick.append(goes_on)


def is_late(scene: Scene) -> None:
    """Keep the victim from being armed until all others have given up."""
    link("link_loss", 1.0, for_s=50.0, direction="to_vehicle")(scene)
    scene.each_tick.append(lambda scene: scene.lockstep.command("rtl", FIRST) if 10.0 < scene.since_s < 10.1 else None)


ROWS = (
    SimulatedRow(
        name="home-taken",
        scene=IN_A_ROW,
        event="a pilot holds a vehicle below the start of another one, which returns",
        reaction="that one waits, and lands beside it",
        within_s=60.0,
        protection="a start over which another vehicle is, at whatever height, is no landing place (Landing)",
        due=tracking(2.0),
        happens=takes_the_place,
        reacts=lambda scene: scene.stands(FIRST),
        lasts_s=60.5,
        may_be_told=("pilot or autopilot took over", "stopped by the operator"),
        off=Off(patches=((landing, "nearest_in_plane_m", lambda *_: math.inf),)),
    ),
    SimulatedRow(
        name="late-arm",
        scene=IN_A_ROW,
        event="a vehicle can't be armed for 50 s, and the others, who wait for it, are ordered home",
        reaction="it stays on the ground",
        within_s=60.0,
        protection="nobody is armed once a peer has given up, or begun the mission",
        due=lambda scene: scene.phase(VICTIM) is Phase.ARM,
        happens=is_late,
        reacts=lambda scene: scene.phase(VICTIM) is Phase.DONE and scene.stands(VICTIM),
        lasts_s=62.0,
        always={"it has taken off": lambda scene: scene.stands(VICTIM)},
        may_be_told=("gave up", "stopped by the operator"),
        off=Off(patches=((on_ground, "_too_late", lambda _: ""),)),
    ),
    SimulatedRow(
        name="obstacle-over-start",
        scene=IN_A_ROW,
        event="an operator adds an obstacle above a vehicle that stands by",
        reaction="its agent stays on the ground, and says why",
        within_s=5.0,
        protection="nobody is armed below a known obstacle",
        due=lambda scene: scene.phase(FIRST) is Phase.STANDBY,
        happens=lambda scene: scene.lockstep.set_obstacles([OVER_FIRST]),
        reacts=lambda scene: "obstacle" in scene.alert(FIRST),
        lasts_s=20.0,
        always={"it flies into the obstacle": lambda scene: scene.stands(FIRST)},
        off=Off(patches=((departure, "_obstacle_over", lambda *_: ""),)),
    ),
    SimulatedRow(
        name="start-frozen",
        scene=BESIDE_EACH_OTHER,
        event="an agent freezes in the climb, 1 m from its neighbours, with guaranteed separation",
        reaction="they stay where they are, or land; nobody is driven into others",
        within_s=16.0,
        protection="the safety filter does not drive away from a silent peer (not_driving_away_m)",
        due=lambda scene: scene.phase(VICTIM) is Phase.TAKEOFF and scene.true(VICTIM)["pos_ned_m"][2] < 1.0,
        happens=frozen(math.inf),
        reacts=lambda scene: scene.stands(VICTIM),
        lasts_s=17.0,
        apart_m=0.85,
        may_be_told=(".",),
        off=Off(patches=((world_model, "not_driving_away_m", lambda wanted_m, *_: wanted_m),)),
    ),
)
