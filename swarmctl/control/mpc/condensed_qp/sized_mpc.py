"""One condensed MPC for each of several numbers of keep-outs, of which the smallest with room is solved.

Of many keep-outs only those have rows that bounded increments can violate: the others change no solution, and the time
of a solution grows faster than the number of its rows. Of a few all have rows, which take little time: a first-order
solver starts from its last answer, and a program whose rows come and go has an older one to start from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, AxesSolution, HalfSpaces
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.condensed_qp.prediction import Forecast, Prediction

FEW = 16  # keep-outs that always have rows


class SizedMpc:
    """Solves every step with as few rows as it needs.

    Args:
        make: returns the MPC with room for a number of keep-outs.
        max_keep_outs: largest number of half-space families (neighbours and obstacles).
    """

    def __init__(self, make: Callable[[int], CondensedMpc], max_keep_outs: int) -> None:
        self.sizes = {room: make(room) for room in rooms(max_keep_outs)}
        self.prediction = self.sizes[max_keep_outs].prediction

    def solve(self, asked: AxesProblem, half_spaces: HalfSpaces | None = None) -> AxesSolution:
        """Solve one receding-horizon step, with at most `max_keep_outs` families of half-spaces; None for none."""
        forecast = self.prediction.forecast(asked, half_spaces)
        if half_spaces is not None and len(half_spaces.normal) > FEW:
            half_spaces = within_reach(half_spaces, self.prediction, forecast)
            forecast = replace(forecast, half_spaces=half_spaces)
        needed = 0 if half_spaces is None else len(half_spaces.normal)
        room = min((room for room in self.sizes if room >= needed), default=max(self.sizes))
        return self.sizes[room].solve_from(forecast)


def rooms(most: int) -> list[int]:
    """Return numbers of keep-outs, each about twice the one before, that problems have room for."""
    found = [most]
    while found[-1] > FEW:
        found.append(max(FEW, -(-found[-1] // 2)))
    return found[::-1]


def within_reach(spaces: HalfSpaces, prediction: Prediction, forecast: Forecast) -> HalfSpaces:
    """Return the half-spaces of keep-outs that bounded increments can violate, in their order.

    Displacements grow with every input, or fall with every input, so that inputs that rise, and that fall, as fast as
    bounds allow are the farthest on each axis.

    Args:
        spaces: half-spaces of all keep-outs.
        prediction: which steps have rows, and what bounds allow.
        forecast: motion without increments, and responses to them.
    """
    row_steps = prediction.row_steps
    normal, stop_s = spaces.normal.take(row_steps, axis=1), spaces.stop_s[:, None]  # (keep-outs, checks, axes)
    asked_m = spaces.offset_m.take(row_steps, axis=1)
    asked_m[:, -1] = spaces.stop_offset_m
    at = np.empty(normal.shape)  # without increments
    at[:] = forecast.free[0].take(row_steps, axis=0)
    at[:, -1] += stop_s * forecast.free[1, -1]
    asked_m -= np.einsum("ska,ska->sk", normal, at)
    moved = np.empty((2, *normal.shape))  # by inputs that rise and that fall
    extremes = prediction.extremes(forecast.u_prev)[..., None]  # (2, axes, Hc, 1)
    moved[:] = (forecast.response[0].take(row_steps, axis=1) @ extremes)[..., 0].transpose(0, 2, 1)[:, None]
    moved[:, :, -1] += stop_s * (forecast.response[1, :, None, -1] @ extremes)[:, None, :, 0, 0]
    moved *= normal
    least_m = np.add.reduce(np.minimum(moved[0], moved[1]), axis=2)
    kept = (~(asked_m <= least_m)).any(axis=1).nonzero()[0]  # with numbers that are none, which the solver refuses
    return HalfSpaces(
        normal=spaces.normal[kept],
        offset_m=spaces.offset_m[kept],
        stop_s=spaces.stop_s[kept],
        stop_offset_m=spaces.stop_offset_m[kept],
    )
