"""An agent is stopped, killed or starved; a host is lost; a clock steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from swarmctl import wall_clock
from swarmctl.agent.planning import coordination
from swarmctl.bus.bus import agent_name
from swarmctl.core.types import FlightMode, Mode, Phase
from swarmctl.wall_clock import WallClock
from tests.faults.bus_events import FORGETS, arrived, for_, others_arrived, rests
from tests.faults.row import Off
from tests.faults.simulated import GUARANTEED, SWAP, VICTIM, Scene, SimulatedRow, entered, tracking

NO_LANDING = Off(settings=("agent.autopilot_params={COM_OBL_RC_ACT=4,COM_OF_LOSS_T=60}",))
UNPROTECTED = Off(settings=("agent.overload.widen_01=1", "agent.overload.hold_01=1", "agent.overload.clear_01=1"))
WHATEVER_PEERS = Off(patches=((coordination, "_SUSPECT_US", 10**12),))
_BLIND_S = 0.8  # COM_OF_LOSS_T, which the agent sets, and what the autopilot takes to act


def frozen(seconds: float) -> Callable[[Scene], None]:
    return for_(
        seconds,
        lambda scene: scene.lockstep.frozen.add(VICTIM),
        lambda scene: scene.lockstep.frozen.discard(VICTIM),
    )


def killed(scene: Scene) -> None:
    scene.lockstep.kill(VICTIM)


def lost(scene: Scene, agents: Sequence[int] = (VICTIM,)) -> None:
    """End agents of which nobody tells the others, as with their host."""
    for agent in agents:
        scene.lockstep.agents[agent] = None
        scene.lockstep.hub.detach(agent_name(agent))


def starved(agents: Sequence[int], one_of: int) -> Callable[[Scene], None]:
    return lambda scene: scene.lockstep.starved.update(dict.fromkeys(agents, one_of))


def lands(scene: Scene) -> bool:
    """Return whether the victim's autopilot lands it."""
    return scene.flight_mode(VICTIM) is FlightMode.LAND


def _clock_follows(scene: Scene, seconds: float) -> None:
    """Give the victim's host the clock of a real one, which now steps."""
    lockstep = scene.lockstep
    own, stepped_ns = lockstep.logs[VICTIM].clock, round(seconds * 1e9)
    scene.notes["stepped"] = lambda: stepped_ns if scene.began_us is not None else 0
    host = WallClock(
        lambda: lockstep.clock.now_us() * 1000,
        lambda: lockstep.clock.utc_us() * 1000 + scene.notes["stepped"](),
    )
    host.utc_us()
    own.utc_us = host.utc_us  # type: ignore[method-assign]


def _goes_on(scene: Scene) -> bool:
    """Return whether everybody tracks and nothing was refused."""
    tracks = all(scene.phase(i) is Phase.TRACK for i in scene.agents)
    return tracks and not any(
        scene.agent(i).rejected.get(reason) for i in scene.agents for reason in ("future", "late")
    )


def stops_without_taking_back(name: str, seconds: float, scene: tuple[str, ...], words: str) -> SimulatedRow:
    return SimulatedRow(
        name=name,
        event=f"an agent is stopped for {seconds:g} s{words}",
        reaction="its autopilot lands the vehicle; the agent never takes it back; the others keep clear",
        within_s=_BLIND_S,
        protection="offboard-loss action of the autopilot",
        scene=scene,
        happens=frozen(seconds),
        reacts=lands,
        lasts_s=max(4.0, seconds + 2.0),
        may_be_told=("deadline misses",),
        finally_={"why is not told": lambda scene: scene.agent(VICTIM).outcome.startswith("overload: setpoints stop")},
        off=NO_LANDING,
    )


def dies_in(phase: Phase, off: Off) -> SimulatedRow:
    return SimulatedRow(
        name=f"agent-killed-{phase.name.lower()}",
        event=f"an agent is killed in {phase.name}",
        reaction="its autopilot lands the vehicle; the others keep clear",
        within_s=_BLIND_S,
        protection="offboard-loss action of the autopilot",
        scene=(*SWAP, "start.center_ned_m=[0,0,-2]"),
        due=entered(phase),
        happens=killed,
        reacts=lands,
        lasts_s=5.0,
        told=("agent 1 died",),
        may_be_told=("a peer gave up or was lost before the mission began",),
        off=off,
    )


def clock_steps(seconds: float, name: str, scene: tuple[str, ...], words: str) -> SimulatedRow:
    return SimulatedRow(
        name=name,
        event=f"the clock of one host steps by {seconds:+g} s{words}",
        reaction="its agent follows slowly; all arrive, nothing is refused",
        within_s=12.0,
        protection="steps of UTC are slewed",
        scene=scene,
        clocks=(VICTIM,),
        due=partial(_due_with_clock, seconds),
        happens=lambda scene: None,
        reacts=arrived,
        lasts_s=12.5,
        always={"messages are refused": _goes_on},
        off=Off(patches=((wall_clock, "_UTC_SLEW_01", 1e9),)),
    )


def _due_with_clock(seconds: float, scene: Scene) -> bool:
    if "stepped" not in scene.notes:
        _clock_follows(scene, seconds)
    return scene.mission_s >= 1.0


def overloaded(scene: Scene, agent: int = VICTIM) -> list[str]:
    return [event["level"] for event in scene.events(agent, "overload")]


ROWS = (
    stops_without_taking_back("agent-stopped-2s", 2.0, SWAP, ""),
    stops_without_taking_back("agent-stopped-20s", 20.0, SWAP, ""),
    stops_without_taking_back("agent-stopped-2s-guaranteed", 2.0, GUARANTEED, ", with guaranteed separation"),
    dies_in(Phase.READY, NO_LANDING),
    dies_in(Phase.TRACK, NO_LANDING),
    SimulatedRow(
        name="agent-killed-meeting",
        event="an agent is killed where four meet",
        reaction="its autopilot lands the vehicle; the others keep clear of where it can be",
        within_s=_BLIND_S,
        protection="a silent peer's last path grows with age",
        due=tracking(2.2),
        happens=killed,
        reacts=lands,
        lasts_s=6.0,
        told=("agent 1 died",),
        apart_m=0.75,
        off=FORGETS,
    ),
    SimulatedRow(
        name="agent-killed-guaranteed",
        event="an agent is killed on the way, with guaranteed separation; the launch tells the others",
        reaction="its autopilot lands the vehicle; the others arrive",
        within_s=_BLIND_S,
        protection="offboard-loss action of the autopilot",
        scene=GUARANTEED,
        happens=killed,
        reacts=lands,
        lasts_s=14.0,
        finally_={"the others don't arrive": others_arrived},
        told=("agent 1 died",),
        off=NO_LANDING,
    ),
    SimulatedRow(
        name="host-lost",
        event="a host is lost, and nobody tells the others, with guaranteed separation",
        reaction="its autopilot lands the vehicle; a majority excludes its agent and arrives",
        within_s=22.0,
        protection="exclusion by a majority",
        scene=GUARANTEED,
        happens=lost,
        reacts=others_arrived,
        lasts_s=22.5,
        finally_={"its vehicle does not land": lands},
        told=("agent 1 died",),
        off=WHATEVER_PEERS,
    ),
    SimulatedRow(
        name="host-lost-minority",
        event="two of four are lost with their host, with guaranteed separation",
        reaction="without a majority the others come to rest",
        within_s=6.0,
        protection="who is silent is waited for",
        scene=GUARANTEED,
        happens=partial(lost, agents=(1, 2)),
        reacts=lambda scene: scene.since_s > 3.0 and rests((0, 3), 0.1)(scene),
        lasts_s=7.0,
        told=(r"agent \d died",),
        off=Off(patches=((coordination.Coordination, "_required_peers", lambda *_: frozenset()),)),
    ),
    SimulatedRow(
        name="host-lost-best-effort",
        event="a host is lost where four meet, and nobody tells the others",
        reaction="its autopilot lands the vehicle; the others keep clear of where it can be, and arrive",
        within_s=14.0,
        protection="a silent peer's last path grows with age",
        scene=(*SWAP, "start.positions_ned_m=[[3.001,0,0],[0,2.999,0],[-3,0.001,0],[0.0005,-3,0]]"),  # 7 s, exact 14
        due=tracking(2.2),
        happens=lost,
        reacts=others_arrived,
        lasts_s=14.5,
        told=("agent 1 died",),
        apart_m=0.75,
        off=FORGETS,
    ),
    clock_steps(3.0, "clock-ahead", SWAP, ""),
    clock_steps(-0.7, "clock-behind", SWAP, ""),
    clock_steps(0.7, "clock-ahead-guaranteed", GUARANTEED, ", with guaranteed separation"),
    clock_steps(-0.7, "clock-behind-guaranteed", GUARANTEED, ", with guaranteed separation"),
    SimulatedRow(
        name="one-starved",
        event="the processor of one agent executes one tick of five, for good",
        reaction="wider distances, rest, and then a landing",
        within_s=4.0,
        protection="response to missed deadlines (agent.overload)",
        due=tracking(0.5),
        happens=starved((VICTIM,), 5),
        reacts=lambda scene: "HOLD" in overloaded(scene) and rests((VICTIM,), 0.4)(scene),
        lasts_s=16.0,
        finally_={
            "it does not land": lambda scene: "LAND" in overloaded(scene),
            "it did not widen first": lambda scene: overloaded(scene)[0] == "WIDEN",
        },
        may_be_told=("overload", "deadline misses"),
        off=UNPROTECTED,
    ),
    SimulatedRow(
        name="all-starved-guaranteed",
        event="the processors of all agents execute one tick of five, with guaranteed separation",
        reaction="all say so, widen distances, hold, and land",
        within_s=14.0,
        protection="response to missed deadlines (agent.overload)",
        scene=GUARANTEED,
        due=tracking(0.5),
        happens=starved(range(4), 5),
        reacts=lambda scene: all(overloaded(scene, i)[-1:] == ["LAND"] for i in range(4)),
        lasts_s=14.5,
        may_be_told=("overload", "deadline misses"),
        off=UNPROTECTED,
    ),
    SimulatedRow(
        name="half-starved",
        event="the processor of one agent executes every fourth tick for 3 s",
        reaction="it comes to rest, goes on when it has time again, and all arrive",
        within_s=4.0,
        protection="response to missed deadlines (agent.overload)",
        due=tracking(0.5),
        happens=for_(3.0, starved((VICTIM,), 4), lambda scene: scene.lockstep.starved.clear()),
        reacts=lambda scene: "HOLD" in overloaded(scene),
        lasts_s=20.0,
        finally_={
            "they don't arrive": arrived,
            "it gave up": lambda scene: Mode.LAND not in scene.modes[VICTIM],
        },
        may_be_told=("deadline misses",),
        off=UNPROTECTED,
    ),
)
