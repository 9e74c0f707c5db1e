"""The solver fails, hits its limit, or answers wrongly; a plan would violate true distances."""

from __future__ import annotations

from functools import partial

from swarmctl.control.mpc import judgement
from swarmctl.control.mpc.condensed_qp import condensed
from swarmctl.core.types import FlightMode, Mode, Phase, PlanStatus
from tests.benches.broken_solver import Spoil, break_solver, no_answer, not_numbers, wrong_answer
from tests.faults.row import Off
from tests.faults.simulated import ALONE, GUARANTEED, VICTIM, Holds, Scene, SimulatedRow, tracking

ON_A_CIRCLE = (*ALONE, "mission.kind=circle")


def broken(lasts_s: float, spoil: Spoil = no_answer, agent: int = 0) -> partial[None]:
    return partial(_break, agent=agent, lasts_s=lasts_s, spoil=spoil)


def _break(scene: Scene, agent: int, lasts_s: float, spoil: Spoil) -> None:
    break_solver(scene.lockstep, agent, lasts_s, spoil)


def _all_wrong(scene: Scene) -> None:
    for agent in range(4):
        _break(scene, agent, 1.0, wrong_answer)


def flies_in(mode: Mode, agent: int = 0) -> Holds:
    return lambda scene: mode in scene.modes.get(agent, set())


def _tracks_again(scene: Scene) -> bool:
    return int(scene.tick(0)["mode"]) == Mode.TRACKING and scene.phase(0) is Phase.TRACK


ROWS = (
    SimulatedRow(
        name="solver-0.3s",
        event="the solver gives no answer for 0.3 s",
        reaction="the last certified plan is flown, then the mission goes on",
        within_s=0.1,
        protection="replay of the last certified plan (agent.failsafe.replay_s)",
        scene=ON_A_CIRCLE,
        happens=broken(0.3),
        reacts=flies_in(Mode.REPLAY),
        lasts_s=1.5,
        finally_={"it does not track again": _tracks_again},
        off=Off(settings=("agent.failsafe.replay_s=0",)),
    ),
    SimulatedRow(
        name="solver-3s",
        event="the solver gives no answer for 3 s",
        reaction="replay, brake, hold; then the mission goes on",
        within_s=2.5,
        protection="an end of the replay (agent.failsafe.replay_s)",
        scene=ON_A_CIRCLE,
        happens=broken(3.0),
        reacts=lambda scene: flies_in(Mode.HOLD)(scene) and scene.speed_m_s(0) < 0.4,
        lasts_s=5.0,
        finally_={"it does not track again": _tracks_again, "it did not brake": flies_in(Mode.BRAKE)},
        off=Off(settings=("agent.failsafe.replay_s=4.9",)),
    ),
    SimulatedRow(
        name="solver-for-good",
        event="the solver gives no answer any more",
        reaction="replay, brake, hold; then the autopilot gets the vehicle, at rest",
        within_s=7.0,
        protection="the longest hold without a plan (agent.failsafe.hold_s)",
        scene=ON_A_CIRCLE,
        happens=broken(600.0),
        reacts=lambda scene: (
            scene.phase(0) >= Phase.LAND and scene.flight_mode(0) in (FlightMode.HOLD, FlightMode.LAND)
        ),
        lasts_s=8.0,
        told=("agent 0: no plan for too long",),
        off=Off(settings=("agent.failsafe.hold_s=600",)),
    ),
    SimulatedRow(
        name="solver-not-finite",
        event="the solver's answer is no number for 0.3 s",
        reaction="it is not flown: the last certified plan is",
        within_s=0.1,
        protection="answers are looked at before they are flown",
        scene=ON_A_CIRCLE,
        happens=broken(0.3, not_numbers),
        reacts=flies_in(Mode.REPLAY),
        lasts_s=1.5,
        finally_={"it does not track again": _tracks_again},
        off=Off(patches=((condensed, "_usable", lambda solution: solution.x),)),
    ),
    SimulatedRow(
        name="solver-wrong",
        event="the solvers of four agents that meet answer wrongly for 1 s, and call it a solution",
        reaction="the residual gives the answers away: they are not flown",
        within_s=0.2,
        protection="limit of the residual",
        due=tracking(2.0),
        happens=_all_wrong,
        reacts=lambda scene: any(scene.tick(i)["plan_status"] == PlanStatus.RESIDUAL for i in range(4)),
        lasts_s=4.0,
        off=Off(patches=((judgement, "RESIDUAL_LIMIT_M", float("inf")),)),
    ),
    SimulatedRow(
        name="solver-among-others",
        event="one agent of four in a swap has no solver for 2 s",
        reaction="it comes to rest, the others keep clear",
        within_s=1.5,
        protection="an end of the replay (agent.failsafe.replay_s)",
        happens=broken(2.0, agent=VICTIM),
        reacts=lambda scene: {Mode.REPLAY, Mode.BRAKE} <= scene.modes[VICTIM] and scene.speed_m_s(VICTIM) < 0.5,
        lasts_s=6.0,
        off=Off(settings=("agent.failsafe.replay_s=4.9",)),
    ),
    SimulatedRow(
        name="solver-guaranteed",
        event="likewise with guaranteed separation",
        reaction="it comes to rest, the others keep clear",
        within_s=1.5,
        protection="an end of the replay (agent.failsafe.replay_s)",
        scene=GUARANTEED,
        happens=broken(2.0, agent=VICTIM),
        reacts=lambda scene: {Mode.REPLAY, Mode.BRAKE} <= scene.modes[VICTIM] and scene.speed_m_s(VICTIM) < 0.5,
        lasts_s=6.0,
        off=Off(settings=("agent.failsafe.replay_s=4.9",)),
    ),
)
