"""Own controllers that fly well for a while and then do what an own controller must not do to a vehicle."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from swarmctl.control.controllers.own import FeedbackController
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.types import Array

GOOD_TICKS = 60  # in which they approach each other


class Straight(FeedbackController):
    """Follows its reference whatever is in the way; a good controller of a lone vehicle."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._ticks = 0

    def accel_ned_m_s2(
        self, pos: Array, vel: Array, wanted_pos: Array, wanted_vel: Array, wanted_accel: Array
    ) -> Array:
        return 4.0 * (wanted_pos - pos) + 3.5 * (wanted_vel - vel)

    def commands(self, problem: Problem) -> Array:
        self._ticks += 1
        return super().commands(problem) if self._ticks < GOOD_TICKS else self._bad(problem)

    def _bad(self, problem: Problem) -> Array:
        return super().commands(problem)


class Nan(Straight):
    """Returns commands that are not numbers."""

    def _bad(self, problem: Problem) -> Array:
        return np.full((self.steps, 3), np.nan)


class Raising(Straight):
    """Raises an exception."""

    def _bad(self, problem: Problem) -> Array:
        raise ZeroDivisionError("division by zero")


class Sleeping(Straight):
    """Sleeps for 100 ms, five ticks, before it commands."""

    def _bad(self, problem: Problem) -> Array:
        time.sleep(0.1)
        return super()._bad(problem)


class Chattering(Straight):
    """Asks for 30 degrees more to one side in a tick and to the other in the next one, as a gain too large does."""

    def _bad(self, problem: Problem) -> Array:
        commands = super()._bad(problem)
        commands[:, 0] += math.sin(math.radians(30.0)) * np.where((self._ticks + np.arange(self.steps)) % 2, 1.0, -1.0)
        return commands


class Swinging(Chattering):
    """Changes sides once in a second."""

    def _bad(self, problem: Problem) -> Array:
        commands = super(Chattering, self)._bad(problem)
        commands[:, 0] = math.sin(math.radians(15.0)) * (1.0 if self._ticks // 50 % 2 else -1.0)
        return commands


class Meddling(Straight):
    """Moves what it is told to keep clear of."""

    def commands(self, problem: Problem) -> Array:
        for keep_out in problem.keep_outs:
            keep_out.pos_ned_m[:] += 100.0
        return super().commands(problem)
