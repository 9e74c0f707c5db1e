"""What a controller of somebody else is derived from. It only commands; what comes of it is for `guard.py` to judge."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.rollout import ModelledVehicle
from swarmctl.core.params import Params
from swarmctl.core.types import Array

GROUP = "swarmctl.controllers"  # of entry points


class OwnController(ABC):
    """Commands a vehicle in the mission; transits and landings are flown by the built-in controller.

    Args:
        params: parameters of the class in `Params`, from `[controller.own]`.
        setup: model of the vehicle, and which agent it is.
        dt_s: time between two commands of a plan, which is that between two points of a problem.
        steps: number of commands of a plan.
    """

    Params: ClassVar[type[Params]] = Params

    def __init__(self, params: Any, setup: ControllerSetup, dt_s: float, steps: int) -> None:
        self.params, self.setup, self.dt_s, self.steps = params, setup, dt_s, steps

    @abstractmethod
    def commands(self, problem: Problem) -> Array:
        """Return virtual controls (steps, 3): u_x, u_y (horizontal part of the body's down axis), thrust over mass."""

    def reset(self) -> None:
        """Forget the past, after a handover."""
        return


class FeedbackController(OwnController):
    """Commands accelerations by a law, and plans by following it on the model of the vehicle."""

    @abstractmethod
    def accel_ned_m_s2(
        self, pos: Array, vel: Array, wanted_pos: Array, wanted_vel: Array, wanted_accel: Array
    ) -> Array:
        """Return the acceleration (3,) at a position and velocity, given those of the reference, (3,) NED each.

        Called for each step of a plan; what it remembers it must remember once a tick, in `commands`.
        """

    def commands(self, problem: Problem) -> Array:
        vehicle = ModelledVehicle(problem.start, self.setup.vehicle, problem.disturbance_ned_m_s2)
        planned = np.empty((self.steps, 3))
        wanted_pos, wanted_vel = problem.reference.pos_ned_m, problem.reference.vel_ned_m_s
        wanted_accel = np.diff(wanted_vel, axis=0) / self.dt_s
        for k in range(self.steps):
            here = vehicle.pos_ned_m, vehicle.vel_ned_m_s
            accel = self.accel_ned_m_s2(*here, wanted_pos[k], wanted_vel[k], wanted_accel[k])
            planned[k] = vehicle.control_for(accel)
            vehicle.step(planned[k], self.dt_s)
        return planned
