"""Solves the problems of a real flight again: the x-y QP by the QP solvers, and the thesis' own problem by SLSQP.

The flight is the thesis' circle with an obstacle on the way: agents and their MAVLink bytes in lockstep. Problems are
recorded where an agent sees both neighbours and the obstacle.

Timed parts: for the QP the solver call from Python, including the update of its matrices but not their computation
(which is a tick's `setup`); for the nonlinear problem the SciPy call, including callbacks but not the computation of
constants. Both are warm-started from their own last answer. SLSQP runs twice: with finite differences, as fmincon does
and in its place, and with analytic gradients. Its constraints are hard, those of the QP have slacks: about a third of
these problems ask for a distance that is lost already, and problems without a solution are left out of the ratio. All
times are processor times: on a busy machine wall time would include the time slices of other processes, which hit the
slower solver more often. Only the whole ticks of the flight are in wall time.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from sitl.studies.bench.slsqp import KEPT_M, NonlinearAnswer, NonlinearXy
from swarmctl.config import Config, load
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, AxesSolution, HalfSpaces
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.mpc.solvers.qp import QpParams, installed_solvers
from swarmctl.control.mpc.swarm_mpc import SwarmMpc
from swarmctl.core.types import Array, Plan

Mask = NDArray[np.bool_]
_OBSTACLE = "obstacles=[{center_ned_m=[-5.0,-1.5,-1.8],radius_m=1.0,keep_out_m=1.75,visibility_m=3.0}]"
_MISSION = "mission.duration_s=9.0"  # the obstacle is passed at about 7 s
WARM_UP = 20  # problems that are solved but not counted
MOST_PROBLEMS = 240
_MAX_KEEP_OUTS = 3  # two neighbours, one obstacle


def circle_with_obstacle() -> Config:
    """Return the thesis' circle (its section 4.3) with an obstacle like that of its section 4.4 on the way."""
    return load(None, [_MISSION, _OBSTACLE, "sitl.start='air'"])


@dataclass(frozen=True, slots=True)
class Captured:
    """The planning problems of a flight in order, and the durations of their whole ticks."""

    config: Config
    problems: tuple[Problem, ...]
    tick_ms: Array  # (len(problems),)


class Recording:
    """A controller that records its problems."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.problems: list[Problem] = []

    @property
    def dt_us(self) -> int:
        return self._controller.dt_us

    @property
    def steps(self) -> int:
        return self._controller.steps

    @property
    def longest(self) -> int:
        return self._controller.longest

    def plan(self, problem: Problem) -> Plan:
        self.problems.append(problem)
        return self._controller.plan(problem)

    def reset(self) -> None:
        self._controller.reset()


def capture(config: Config, most: int = MOST_PROBLEMS) -> Captured:
    """Fly `config` in lockstep and keep up to `most` tracking problems with everything to avoid that there is.

    They are consecutive, agent after agent.
    """
    flight = Lockstep(config)
    agents = [agent for agent in flight.agents if agent is not None]
    recordings = []
    for agent in agents:
        recordings.append(Recording(agent._planner.controller))
        agent._planner.controller = recordings[-1]  # only tracking is recorded, so `_transit` stays
    found: list[list[tuple[Problem, float]]] = [[] for _ in agents]

    def enough(flown: Lockstep) -> bool:
        for agent, recording, kept in zip(agents, recordings, found, strict=True):
            kept += [(p, agent.timing.tick_ms) for p in recording.problems if len(p.keep_outs) == _MAX_KEEP_OUTS]
            recording.problems.clear()
        return len(found[0]) >= most or flown.mission_is_over()

    with settled_garbage():
        flight.run(enough)
    together = [item for kept in found for item in kept][:most]
    return Captured(config, tuple(p for p, _ in together), np.array([ms for _, ms in together]))


@contextmanager
def settled_garbage() -> Iterator[None]:
    """Exclude start-up garbage from collection while something is measured, as the real-time loop does."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class TappedMpc(SwarmMpc):
    """The controller of a flight that records its last x-y problem and the duration of its solution."""

    def __init__(self, params: MpcParams, setup: ControllerSetup) -> None:
        super().__init__(params, setup)
        self._genuine = self._xy.solve
        self._xy.solve = self._watched  # type: ignore[method-assign]
        self.solve_ms = 0.0
        self._asked: AxesProblem | None = None

    def _watched(self, asked: AxesProblem, half_spaces: HalfSpaces | None = None) -> AxesSolution:
        self._asked = asked
        answer = self._genuine(asked, half_spaces)
        self.solve_ms = answer.solve_us * 1e-3
        return answer

    def nonlinear(self, problem: Problem, plan: Plan) -> NonlinearXy:
        """Return the x-y problem of the last plan as the thesis poses it; same z, same thrust."""
        assert self._asked is not None
        xy = self._xy.prediction
        return NonlinearXy(xy.axes, xy.horizon, self._asked, problem.keep_outs, z_ned_m=plan.pos_ned_m[1:, 2])


@dataclass(frozen=True, slots=True)
class Times:
    """Percentiles of a duration [ms]."""

    p50_ms: float
    p99_ms: float


def times_of(duration_ms: Sequence[float] | Array) -> Times:
    """Return p50 and p99 of at least one duration [ms]."""
    p50_ms, p99_ms = np.percentile(np.asarray(duration_ms), (50, 99))
    return Times(float(p50_ms), float(p99_ms))


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """Answers of SLSQP to the counted problems, as the thesis poses them."""

    duration_ms: Array  # (problems,)
    solved: Mask  # (problems,) reported as solved
    kept: Mask  # (problems,) whether its answer keeps every true distance

    @property
    def times(self) -> Times:
        """Times of all problems, including those without a solution."""
        return times_of(self.duration_ms)

    @property
    def solved_01(self) -> float:
        return float(self.solved.mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class XyTimes:
    """Processor time of each solver for the x-y problem with two neighbours and an obstacle."""

    tick: Times  # whole ticks of the problems in flight, wall time
    qp_ms: dict[str, Array]  # by solver: the QP, (problems,)
    fmincon: Baseline | None  # SLSQP with finite differences, in place of fmincon; None when not requested
    gradients: Baseline | None  # SLSQP with analytic gradients, its best case

    @property
    def problems(self) -> int:
        """Number of counted problems."""
        return len(next(iter(self.qp_ms.values())))

    def qp(self, solver: str) -> Times:
        return times_of(self.qp_ms[solver])

    def speed_up(self, solver: str = "osqp", gradients: bool = False) -> float:
        """Return the p50 of SLSQP over that of a solver, on the problems SLSQP has solved; NaN when not measured."""
        baseline = self.gradients if gradients else self.fmincon
        if baseline is None or not baseline.solved.any():
            return float("nan")
        solved = baseline.solved
        return float(np.median(baseline.duration_ms[solved]) / np.median(self.qp_ms[solver][solved]))


def measure_xy(
    captured: Captured,
    solvers: Sequence[str] | None = None,
    slsqp: bool = True,
    on_problem: Callable[[], None] = lambda: None,
) -> XyTimes:
    """Solve every captured problem with every solver in turn, so that a busy machine slows all of them alike.

    The first 20 are solved but not counted. `solvers` None: all that are installed.
    """
    solvers = installed_solvers() if solvers is None else solvers
    mpcs = {name: tapped(captured.config, name) for name in solvers}
    qp_ms: dict[str, list[float]] = {name: [] for name in solvers}
    baselines = (_Running(False), _Running(True)) if slsqp else ()
    with settled_garbage():
        for problem in captured.problems:
            for name, mpc in mpcs.items():
                plan = mpc.plan(problem)
                qp_ms[name].append(mpc.solve_ms)
            for baseline in baselines:
                baseline.solve(mpc.nonlinear(problem, plan))
            on_problem()
    counted = {name: np.array(took[WARM_UP:]) for name, took in qp_ms.items()}
    fmincon, gradients = [b.counted() for b in baselines] if slsqp else [None, None]
    return XyTimes(tick=times_of(captured.tick_ms), qp_ms=counted, fmincon=fmincon, gradients=gradients)


def tapped(config: Config, solver: str) -> TappedMpc:
    """Return the controller of `config` with another QP solver."""
    params = config.controller.mpc
    qp = QpParams.model_validate({**params.qp.model_dump(), "solver": solver})
    setup = ControllerSetup(
        vehicle=config.vehicle_model,
        separation=config.separation,
        agent=0,
        max_keep_outs=_MAX_KEEP_OUTS,
        stopwatch_ns=time.thread_time_ns,
    )
    return TappedMpc(params.model_copy(update={"qp": qp}), setup)


class _Running:
    """SLSQP started from its own last answer, shifted by one step."""

    def __init__(self, gradients: bool) -> None:
        self._gradients = gradients
        self._duration_ms: list[float] = []
        self._answers: list[NonlinearAnswer] = []

    def solve(self, problem: NonlinearXy) -> None:
        guess = problem.shifted(self._answers[-1].moves) if self._answers else None
        began_ns = time.thread_time_ns()
        answer = problem.solve(guess, self._gradients)
        self._duration_ms.append((time.thread_time_ns() - began_ns) * 1e-6)
        self._answers.append(answer)

    def counted(self) -> Baseline:
        answers = self._answers[WARM_UP:]
        return Baseline(
            duration_ms=np.array(self._duration_ms[WARM_UP:]),
            solved=np.array([a.solved for a in answers]),
            kept=np.array([a.shortfall_m < KEPT_M for a in answers]),
        )
