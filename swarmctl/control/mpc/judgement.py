"""From the solutions of a tick to its plan: solved, within the residual limit and certified, or not to be flown."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from swarmctl.control.collision.separation import certify
from swarmctl.control.collision.volume_certificate import volume_margin_m
from swarmctl.control.mpc.condensed_qp.axes import AxesSolution
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array, Plan, PlanStatus, PlanTimes

RESIDUAL_LIMIT_M = 0.05  # a solution that violates a constraint by more is refused; the certificate checks the rest


def judged(
    problem: Problem,
    pos_ned_m: Array,
    vel_ned_m_s: Array,
    virtual_control: Array,
    *,
    solutions: Sequence[AxesSolution],
    from_step: int,
    dt_us: int,
    spaces_us: float,
    stopwatch_ns: Callable[[], int],
    volume: FlightVolume | None,
) -> Plan:
    """Return the plan with its status: whether it is solved, within the residual limit, and certified.

    Args:
        problem: the problem it solves.
        pos_ned_m, vel_ned_m_s: (steps+1, 3) from the start on.
        virtual_control: (steps, 3).
        solutions: solutions of all problems solved for it.
        from_step: first certified step; earlier ones cannot be changed any more.
        dt_us: step.
        spaces_us: time that half-spaces took.
        stopwatch_ns: see `CondensedMpc`.
        volume: to stay in; None for none.
    """
    residual_m = max([s.residual_m for s in solutions])
    solved_ns = stopwatch_ns()
    if not all(s.solved for s in solutions):
        status = PlanStatus.SOLVER_FAILED
    elif residual_m > RESIDUAL_LIMIT_M:
        status = PlanStatus.RESIDUAL
    else:
        status = _certified(problem, pos_ned_m, vel_ned_m_s, from_step, volume)
    certify_us = (stopwatch_ns() - solved_ns) * 1e-3
    return Plan(
        status=status,
        t0_us=problem.start.t_us,
        dt_us=dt_us,
        pos_ned_m=pos_ned_m,
        vel_ned_m_s=vel_ned_m_s,
        virtual_control=virtual_control,
        times=PlanTimes(solve_us=sum([s.solve_us for s in solutions]), certify_us=certify_us, spaces_us=spaces_us),
        iterations=sum([s.iterations for s in solutions]),
        slack_m=max([s.slack_m for s in solutions]),
        residual_m=residual_m,
        terminal_gap_m=max([s.terminal_gap_m for s in solutions]),
    )


def _certified(
    problem: Problem, pos_ned_m: Array, vel_ned_m_s: Array, from_step: int, volume: FlightVolume | None
) -> PlanStatus:
    """Return whether a solved plan keeps its true distances, and stays in the volume."""
    if not certify(pos_ned_m, problem.keep_outs, from_step) >= 0.0:  # nor where it is no number
        return PlanStatus.NOT_CERTIFIED
    stays = volume_margin_m(volume, pos_ned_m, vel_ned_m_s, from_step) >= 0.0
    return PlanStatus.OK if stays else PlanStatus.NOT_CERTIFIED
