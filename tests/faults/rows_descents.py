"""A vehicle comes down by its autopilot, above another one, which must make room, or above an obstacle."""

from __future__ import annotations

from swarmctl.agent.sensing.known_obstacles import KnownObstacles
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.agent.sharing.path_publisher import PathPublisher
from swarmctl.core.obstacle import Obstacle
from tests.closed_loop.conftest import COARSE
from tests.faults.row import Off
from tests.faults.rows_agents import lands
from tests.faults.rows_vehicle import SET_MODE, link, overridden, pilot
from tests.faults.simulated import AIR, VICTIM, Happens, Scene, SimulatedRow, tracking

ABOVE = (  # the victim hovers four metres above agent `BELOW`
    *COARSE,
    AIR,
    "swarm.agents=3",
    "start.positions_ned_m=[[0,0.2,-1],[0,0,-5],[6,0,-1]]",
    "mission.kind=hover",
    "mission.duration_s=60",
)
BELOW = 0
ABOVE_GUARANTEED = (*ABOVE, "separation.mode=guaranteed")
_LONG_ENOUGH_S = 10.0  # to come past the other one
_PX4_CUSTOM_MODE, _AUTO, _AUTO_LAND = 1.0, 4.0, 6.0
BY_PHASE_ALONE = Off(patches=((WorldModel, "_flies_in", lambda *_: False),))
IGNORES_OBSTACLES = Off(patches=((KnownObstacles, "at_rest", lambda *_: []),))
SHARES_STALE_STATES = Off(patches=((PathPublisher, "_is_recent", lambda *_: True),))
OVER_A_BALL = (  # one hovers from the ground, five metres above the origin
    *COARSE,
    "swarm.agents=1",
    "start.positions_ned_m=[[0,0,-5]]",
    "mission.kind=hover",
    "mission.duration_s=4",
)
BALL = Obstacle(center_ned_m=(0.2, 0.0, -1.5), radius_m=1.0, keep_out_m=1.75, visibility_m=3.0)  # not seen from there
_OVER = 0  # who hovers there


def crashes_twice(scene: Scene) -> None:
    """Kill the victim's agent, start it again in flight, and kill that one too."""
    lockstep = scene.lockstep
    lockstep.kill(VICTIM)

    def goes_on(scene: Scene) -> None:
        if lockstep.agents[VICTIM] is None and 1.5 < scene.since_s < 2.0:
            lockstep.start_again(VICTIM)
        elif lockstep.agents[VICTIM] is not None and scene.since_s > 3.4:
            lockstep.kill(VICTIM)

    scene.each_tick.append(goes_on)


def has_passed(scene: Scene) -> bool:
    return bool(scene.true(VICTIM)["pos_ned_m"][2] > scene.true(BELOW)["pos_ned_m"][2])


def adds_ball(scene: Scene) -> None:
    """Add an obstacle under the vehicle, as an operator does."""
    scene.lockstep.set_obstacles([BALL])


def lands_over_ball(scene: Scene) -> None:
    """Order a landing there, too."""
    adds_ball(scene)
    scene.lockstep.command("land")


def is_clear_of_ball(scene: Scene) -> bool:
    return BALL.distance_m(scene.true(_OVER)["pos_ned_m"]) >= BALL.keep_out_m - scene.config.limits.obstacle_margin_m


def _over_ball(name: str, event: str, happens: Happens, told: tuple[str, ...] = ()) -> SimulatedRow:
    return SimulatedRow(
        name=name,
        scene=OVER_A_BALL,
        event=event,
        reaction="it lands beside the obstacle, outside of its keep-out",
        within_s=25.0,
        protection="a landing place has room from obstacles at rest, down to the ground",
        due=tracking(1.0),
        happens=happens,
        reacts=lambda scene: scene.stands(_OVER),
        lasts_s=25.5,
        always={"it is in the obstacle's keep-out": is_clear_of_ball},
        told=told,
        off=IGNORES_OBSTACLES,
    )


def _row(name: str, scene: tuple[str, ...]) -> SimulatedRow:
    guaranteed = scene is ABOVE_GUARANTEED
    return SimulatedRow(
        name=name,
        scene=scene,
        event="a pilot lands a vehicle above another one" + (", which flies by commitments" if guaranteed else ""),
        reaction="its agent yields, the other one makes room",
        within_s=0.5,
        protection="a peer lands where its vehicle does, whatever its agent is about to do",
        due=tracking(2.0),
        happens=pilot(SET_MODE, _PX4_CUSTOM_MODE, _AUTO, _AUTO_LAND),
        reacts=overridden,
        lasts_s=_LONG_ENOUGH_S,
        finally_={"the vehicle is still above": has_passed},
        off=BY_PHASE_ALONE,
    )


ROWS = (
    SimulatedRow(
        name="above-state-lost",
        scene=ABOVE,
        event="the states of a vehicle above another one are lost for good",
        reaction="its autopilot lands it, the other one makes room",
        within_s=1.2,
        protection="no path is shared from a stale state (agent.failsafe.state_max_age_s)",
        due=tracking(2.0),
        happens=link("link_loss", 1.0, direction="from_vehicle"),
        reacts=lands,
        lasts_s=_LONG_ENOUGH_S,
        finally_={"the vehicle is still above": has_passed},
        off=SHARES_STALE_STATES,
    ),
    _row("above-pilot-lands", ABOVE),
    _row("above-pilot-lands-guaranteed", ABOVE_GUARANTEED),
    SimulatedRow(
        name="above-agent-crashes-twice",
        scene=ABOVE,
        event="the agent of a vehicle above another one crashes, is started again, and crashes again",
        reaction="its autopilot lands it, the other one makes room",
        within_s=1.2,
        protection="a peer is parked once its vehicle does not fly, not when its agent is done",
        due=tracking(2.0),
        happens=crashes_twice,
        reacts=lands,
        lasts_s=_LONG_ENOUGH_S,
        told=("agent 1 died",),
        finally_={"the vehicle is still above": has_passed},
        off=BY_PHASE_ALONE,
    ),
    _over_ball(
        "above-obstacle-home", "an operator adds an obstacle below a start, to which a vehicle returns", adds_ball
    ),
    _over_ball(
        "above-obstacle-land",
        "an operator adds an obstacle below a vehicle, and lands it",
        lands_over_ball,
        told=("stopped by the operator",),
    ),
)
