"""How MPCs plan among keep-outs: within half-spaces near a guess and, until a plan is not refused, within others."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from swarmctl.control.collision.half_spaces import half_spaces
from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts, stacked
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.mpc.condensed_qp.axes import HalfSpaces
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.types import Array, Plan, PlanStatus


def first_guess(problem: Problem, dt_s: float, steps: int) -> Array:
    """Return positions (steps+1, 3) to linearise around: the previous prediction, or constant velocity."""
    if problem.guess_ned_m is not None:
        return problem.guess_ned_m.copy()
    return problem.start.at_constant_velocity(steps, dt_s)[0]


def planned_clear(
    problem: Problem,
    guess_ned_m: Array,
    plan: Callable[[HalfSpaces | None, float], Plan],
    *,
    axes: int,
    dt_s: float,
    setup: ControllerSetup,
) -> Plan:
    """Return the first plan that may be flown, else the last one that was solved.

    Args:
        problem: of this tick.
        guess_ned_m: (steps+1, 3) around which half-spaces are linearised.
        plan: makes a plan within half-spaces, given the time [us] that they took.
        axes: number of leading axes in which half-spaces are.
        dt_s: time between two points of the guess.
        setup: parameters of the first plan's half-spaces; those of the next ones are `_relaxed`.
    """
    separation, stopwatch_ns = setup.separation, setup.stopwatch_ns
    spaces_of = partial(_near_half_spaces, problem=problem, guess_ned_m=guess_ned_m, axes=axes, dt_s=dt_s, setup=setup)
    began_ns = stopwatch_ns()
    spaces = spaces_of(separation)
    best = plan(spaces, (stopwatch_ns() - began_ns) * 1e-3)
    for relaxed in _relaxed(separation):
        if spaces is None or best.status is not PlanStatus.NOT_CERTIFIED:
            return best
        began_ns, before, spaces = stopwatch_ns(), spaces, spaces_of(separation.model_copy(update=relaxed))
        if spaces is not None and not _are_equal(spaces, before):
            found = plan(spaces, (stopwatch_ns() - began_ns) * 1e-3)
            best = found if found.status in (PlanStatus.OK, PlanStatus.NOT_CERTIFIED) else best
    return best


def closest_keep_outs(keep_outs: Sequence[KeepOut], guess_ned_m: Array, max_keep_outs: int) -> KeepOuts:
    """Return the `max_keep_outs` keep-outs that the guess (steps+1, 3) comes closest to."""
    known = stacked(keep_outs)
    if len(known) < 2:
        return known
    apart = known.apart(guess_ned_m)
    closest_m = np.sqrt(np.minimum.reduce(np.add.reduce(apart * apart, axis=2), axis=1)).tolist()
    gaps_m = [closest - k.radius_m for closest, k in zip(closest_m, known, strict=True)]
    order = sorted(range(len(known)), key=gaps_m.__getitem__)[:max_keep_outs]
    return KeepOuts([known[i] for i in order], known.pos_ned_m.take(order, axis=0))


def _near_half_spaces(
    params: SeparationParams, *, problem: Problem, guess_ned_m: Array, axes: int, dt_s: float, setup: ControllerSetup
) -> HalfSpaces | None:
    """Return half-spaces of the closest keep-outs around the guess, in the first `axes` axes."""
    steps, near = len(guess_ned_m) - 1, closest_keep_outs(problem.keep_outs, guess_ned_m, setup.max_keep_outs)
    goal, vel = problem.reference.pos_ned_m[steps, :axes], problem.start.vel_ned_m_s[:axes]
    return half_spaces(near, guess_ned_m, goal, vel, dt_s=dt_s, own_priority_id=setup.agent, params=params)


def _relaxed(separation: SeparationParams) -> tuple[dict[str, float], ...]:
    """Return what differs in parameters of half-spaces for a plan that comes closer than is ever flown.

    - Without the gate: a plan may move far away from a guess that stands still, while half-spaces far from the guess
      are left out. It then runs into peers that are there by the time it arrives, as does the next from that guess.
    - With the harder braking that peers expect beyond the horizon: room to stop has much slack where peers are on
      several sides, and one slack for each of them lets a plan come too close within the horizon as well. Agents that
      always fly with less room to stop lack it when a peer drops out.
    """
    return {"gate_m": math.inf}, {"gate_m": math.inf, "stop_m_s2": separation.brake_m_s2}


def _are_equal(one: HalfSpaces, other: HalfSpaces) -> bool:
    return np.array_equal(one.offset_m, other.offset_m) and np.array_equal(one.stop_s, other.stop_s)
