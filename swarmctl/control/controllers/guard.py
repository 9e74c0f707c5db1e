"""What stands between a controller of somebody else and the vehicle; it can't be switched off.

In every tick the own controller is asked for commands. They are flown only if they are finite, if the vehicle can
follow the changes of their tilt, if the motion that they give the vehicle by its model, which is computed here, keeps
clear of every keep-out, stays in the flight volume and above the ground, and if the vehicle can stop behind it.
Otherwise the built-in controller plans this tick, by its own certificate. A controller that raises, returns something
else than commands, chatters, or takes too long, again and again, is not asked any more, and the mission ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOut, moved_on
from swarmctl.control.collision.separation import certify
from swarmctl.control.collision.volume_certificate import volume_margin_m
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.controllers.own import OwnController
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.rollout import ModelledVehicle
from swarmctl.control.setpoint import within_tilt
from swarmctl.core.discovery.own import in_words, raised_at, traced
from swarmctl.core.text import printable
from swarmctl.core.trajectory import braking_displacement
from swarmctl.core.types import Array, Plan, PlanStatus, PlanTimes, Reference

LATE_S = 0.05  # more than two ticks: setpoints have gaps
LATE_IN_A_ROW = 3  # late plans after which a controller is not asked any more
BAD_IN_A_ROW = 25  # likewise, without commands: half a second
_SLEW_1_S = 2.5  # of (u_x, u_y), as of the safety filter: attitudes that change faster for long saturate rotors
_SWINGS = 2.0  # changes at once, of the largest tilt: from one side to the other
_GROUND_M = 0.3  # least height of a plan above the place of the take-off, as of references
_BELOW_M = 0.1  # by which a plan may be lower than a reference that leads there
_TAIL_POINTS = 30  # of the braking behind a plan
_MAX_SHOWN = 120  # characters of an exception
_MOST_TRACED = 8  # places whose traceback is told: a controller may raise in every tick


class Guard:
    """Flies an own controller behind a certificate, with another controller to fall back on.

    Args:
        name: what the configuration calls the controller.
        own: the controller.
        fallback: plans where its commands can't be flown; plans and problems are on its grid.
        setup: what both were told.
    """

    def __init__(self, name: str, own: OwnController, fallback: Controller, setup: ControllerSetup) -> None:
        self._name, self._own, self._fallback, self._setup = name, own, fallback, setup
        self._suspended, self._bad, self._late = "", 0, 0
        self._chatter = _Chatter(setup)
        self._raised_at: set[str] = set()
        self._traceback = ""  # of the newest place, until a plan tells it

    @property
    def dt_us(self) -> int:
        """Return the time between plan points [us]."""
        return self._fallback.dt_us

    @property
    def steps(self) -> int:
        """Return the number of steps of a plan."""
        return self._fallback.steps

    @property
    def longest(self) -> int:
        """Return the number of steps of reference that a problem has to hold."""
        return self._fallback.longest

    def reset(self) -> None:
        """Let both forget the past, after a handover; what was suspended stays so."""
        self._fallback.reset()
        self._bad = self._late = 0
        self._chatter.forget()
        if not self._suspended:
            self._called(lambda: self._own.reset())

    def plan(self, problem: Problem) -> Plan:
        """Return the own controller's plan, or that of the fallback with the reason."""
        if self._suspended:
            return self._instead(problem, self._suspended)
        began_ns = self._setup.stopwatch_ns()
        commands, failure = self._called(lambda: self._own.commands(_copied(problem)))
        took_s = (self._setup.stopwatch_ns() - began_ns) * 1e-9
        if not failure:
            failure = self._malformed(commands) or self._chatter.refusal(commands[0], problem.start.t_us)
        self._count(failure, took_s)
        if failure or self._suspended:
            return self._instead(problem, self._suspended or failure)
        plan = self._moved(problem, commands, took_s)
        if problem.keep_outs and not self._clearance_m(plan, problem.keep_outs) >= 0.0:  # nor where it is no number
            return self._instead(problem, "plans too close to a peer or an obstacle")
        if not volume_margin_m(self._setup.volume, plan.pos_ned_m, plan.vel_ned_m_s, 1) >= 0.0:
            return self._instead(problem, "plans to leave the flight volume")
        if self._sinks_too_low(plan, problem):
            return self._instead(problem, "plans to fly into the ground")
        return plan

    def _sinks_too_low(self, plan: Plan, problem: Problem) -> bool:
        """Return whether a plan, or a stop behind it, comes too near to the height of the take-off.

        A reference may lead lower, down a slope: so may a plan that follows it.
        """
        if problem.ground_z_m is None:
            return False
        lowest_z_m = max(problem.ground_z_m - _GROUND_M, float(problem.reference.pos_ned_m[:, 2].max()) + _BELOW_M)
        sinks_m_s = max(0.0, float(plan.vel_ned_m_s[-1, 2]))
        stops_z_m = float(plan.pos_ned_m[-1, 2]) + sinks_m_s**2 / (2.0 * self._setup.separation.brake_m_s2)
        return max(stops_z_m, float(plan.pos_ned_m[1:, 2].max())) > lowest_z_m

    def _called(self, call: Callable[[], Array | None]) -> tuple[Array, str]:
        """Return what a call of the own controller returns, and what it raised, or ""."""
        try:
            return np.asarray(call(), dtype=np.float64), ""
        except (Exception, SystemExit) as error:  # whatever it raises: the vehicle flies on
            return np.empty(0), self._told(error)

    def _told(self, error: BaseException) -> str:
        """Return what was raised, and where; the traceback of a new place goes with the next plan."""
        place = raised_at(error, type(self._own).__module__)
        if place not in self._raised_at and len(self._raised_at) < _MOST_TRACED:
            self._raised_at.add(place)
            self._traceback = traced(error)
        return f"{printable(f'raised {in_words(error)}', _MAX_SHOWN)} ({printable(place, _MAX_SHOWN)})"

    def _malformed(self, commands: Array) -> str:
        if commands.shape != (self.steps, 3):
            return f"returned commands of shape {commands.shape}, not {(self.steps, 3)}"
        return "" if np.isfinite(commands).all() else "returned commands that are not finite"

    def _count(self, failure: str, took_s: float) -> None:
        """Suspend a controller that fails or is late again and again."""
        self._bad = self._bad + 1 if failure else 0
        self._late = self._late + 1 if took_s > LATE_S else 0
        if self._late >= LATE_IN_A_ROW:
            self._suspended = f"took {took_s * 1e3:.0f} ms for a plan"
        elif self._bad >= BAD_IN_A_ROW:
            self._suspended = failure

    def _instead(self, problem: Problem, why: str) -> Plan:
        failure, suspended = f"controller {self._name} {why}", bool(self._suspended)
        plan = self._fallback.plan(problem)
        return replace(plan, failure=failure, suspended=suspended, traceback=self._untold())

    def _untold(self) -> str:
        """Return the traceback that no plan has told yet, or ""."""
        untold, self._traceback = self._traceback, ""
        return untold

    def _moved(self, problem: Problem, commands: Array, took_s: float) -> Plan:
        """Return the plan of commands (N, 3): the motion that they give the vehicle by its model."""
        vehicle = ModelledVehicle(problem.start, self._setup.vehicle, problem.disturbance_ned_m_s2)
        pos, vel = np.empty((self.steps + 1, 3)), np.empty((self.steps + 1, 3))
        pos[0], vel[0] = vehicle.pos_ned_m, vehicle.vel_ned_m_s
        for k in range(self.steps):
            vehicle.step(commands[k], self.dt_us * 1e-6)
            pos[k + 1], vel[k + 1] = vehicle.pos_ned_m, vehicle.vel_ned_m_s
        return Plan(
            status=PlanStatus.OK,
            t0_us=problem.start.t_us,
            dt_us=self.dt_us,
            pos_ned_m=pos,
            vel_ned_m_s=vel,
            virtual_control=np.array([vehicle.bounded(command) for command in commands]),
            times=PlanTimes(solve_us=took_s * 1e6, certify_us=0.0),
            traceback=self._untold(),
            by_own=True,
        )

    def _clearance_m(self, plan: Plan, keep_outs: Sequence[KeepOut]) -> float:
        """Return the smallest margin [m] of a plan and of the braking behind it, as `certify` does.

        It has to keep the distance that plans keep, not only the hard minimum: from closer the fallback would have to
        use slack.
        """
        keep_outs = [replace(keep_out, hard_min_distance_m=keep_out.radius_m) for keep_out in keep_outs]
        separation, dt_s = self._setup.separation, plan.dt_us * 1e-6
        stop_s = float(np.linalg.norm(plan.vel_ned_m_s[-1])) / separation.brake_m_s2
        tail_s = np.linspace(0.0, max(dt_s, stop_s), _TAIL_POINTS)
        path = plan.pos_ned_m[-1] + braking_displacement(plan.vel_ned_m_s[-1], tail_s, separation.brake_m_s2)
        behind = [replace(k, pos_ned_m=moved_on(k, tail_s, dt_s, separation.brake_m_s2)) for k in keep_outs]
        return float(np.minimum(certify(plan.pos_ned_m, keep_outs, 1), certify(path, behind, 1)))


class _Chatter:
    """Knows whether a vehicle can follow the commands of successive ticks.

    The model that plans are judged by may take attitudes for immediate. A vehicle that is told 30 degrees to and fro in
    every tick saturates its rotors, loses thrust and turned over in a few seconds. One swing at once is none of that:
    what is added up is how much faster tilt changes than rotors turn a vehicle for long.
    """

    def __init__(self, setup: ControllerSetup) -> None:
        self._setup = setup
        self.forget()

    def forget(self) -> None:
        """Begin with any command."""
        self._last: tuple[Array, int] | None = None
        self._ahead = 0.0  # change of (u_x, u_y) that the vehicle has yet to follow

    def refusal(self, command: Array, t_us: int) -> str:
        """Return why the command (3,) of a tick that acts at `t_us` is not flown, or ""."""
        vehicle = self._setup.vehicle
        tilt, most = within_tilt(command, vehicle)[:2], _SWINGS * vehicle.u_max()
        if self._last is not None:
            was, was_us = self._last
            change, follows = float(np.linalg.norm(tilt - was)), _SLEW_1_S * (t_us - was_us) * 1e-6
            # no more is remembered than what a controller that has come to rest makes good in half a second
            self._ahead = min(most + 0.5 * _SLEW_1_S, max(0.0, self._ahead + change - follows))
        self._last = tilt, t_us
        return "tilts to and fro faster than the vehicle follows" if self._ahead > most else ""


def _copied(problem: Problem) -> Problem:
    """Return a problem with arrays of its own, so that what is judged can't be changed."""
    start, reference, guess = problem.start, problem.reference, problem.guess_ned_m
    return Problem(
        start=Start(
            t_us=start.t_us,
            pos_ned_m=start.pos_ned_m.copy(),
            vel_ned_m_s=start.vel_ned_m_s.copy(),
            cos_tilt=start.cos_tilt,
            virtual_control=start.virtual_control.copy(),
            tilt=start.tilt.copy(),
            tilt_rate_1_s=start.tilt_rate_1_s.copy(),
        ),
        reference=Reference(reference.pos_ned_m.copy(), reference.vel_ned_m_s.copy(), reference.yaw_rad),
        disturbance_ned_m_s2=problem.disturbance_ned_m_s2.copy(),
        keep_outs=tuple(replace(keep_out, pos_ned_m=keep_out.pos_ned_m.copy()) for keep_out in problem.keep_outs),
        guess_ned_m=None if guess is None else guess.copy(),
        ground_z_m=problem.ground_z_m,
    )
