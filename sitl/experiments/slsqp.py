"""The x-y problem as the thesis poses it, with true distances, for SciPy's SLSQP: the stand-in for MATLAB's fmincon.

Decision variables, cost and linear rows are those of the linearised QP, taken from the QP itself: scaled increments
over Hc and a slack for each neighbour or obstacle, `1/2 x'Px + q'x`, bounds on increments and inputs. What differs is
what is kept clear of: `|p_i(k) - p_j(k)| + slack >= r` at every step k = 1..Hp (4.1), (4.2), in three dimensions with z
as the z problem has planned it, instead of half-spaces at some steps. Everything constant is worked out beforehand, so
that only the solver and its callbacks are timed. The slack keeps it feasible, as in the QP: hard distances have no
solution once delay has cost a millimetre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from swarmctl.control.axes import Axis, Horizon
from swarmctl.control.qp import INFINITY
from swarmctl.control.separation import KeepOut
from swarmctl.core.types import Array

FTOL = 1e-6  # of a cost whose Hessian has a diagonal of about 1
MAX_ITERATIONS = 100
_LEAST_M = 1e-9


@dataclass(frozen=True, slots=True)
class DenseQp:
    """`1/2 x'Px + q'x` subject to `lower <= Ax <= upper`; columns are increments, then slacks.

    The last rows are half-spaces, as many for each slot, and the last columns the slots' slacks.
    """

    hessian: Array  # (n, n)
    slope: Array  # (n,)
    rows: Array  # (m, n)
    lower: Array  # (m,)
    upper: Array  # (m,)
    half_spaces: int  # rows of `rows`
    slots: int
    slack_m: float  # of one unit of a slot's slack variable

    def cost(self, x: Array) -> float:
        return float(0.5 * x @ self.hessian @ x + self.slope @ x)


@dataclass(frozen=True, slots=True)
class XyState:
    """What the x-y prediction starts from."""

    pos_m: Array  # (2,)
    vel_m_s: Array  # (2,)
    u_prev: Array  # (2,)
    gain_m_s2: Array  # (Hp, 2) acceleration of a unit input over each step
    drift_m_s2: Array  # (2,)


@dataclass(frozen=True, slots=True)
class NonlinearAnswer:
    """What SLSQP returned; `x` as in the QP."""

    x: Array
    cost: float
    solved: bool
    iterations: int


class NonlinearXy:
    """One tick's x-y problem with true distances.

    Args:
        qp: the linearised problem of the same tick.
        axes, horizon: what it is about.
        state: where it starts.
        keep_outs: neighbours and obstacles, at most as many as the QP has slots.
        z_ned_m: (Hp,) planned height at steps 1..Hp.
    """

    def __init__(
        self,
        qp: DenseQp,
        axes: Sequence[Axis],
        horizon: Horizon,
        state: XyState,
        keep_outs: Sequence[KeepOut],
        z_ned_m: Array,
    ) -> None:
        if len(keep_outs) > qp.slots:
            raise ValueError(f"keep_outs: {len(keep_outs)}, the QP has {qp.slots} slots")
        self.qp = qp
        hp, self._hc, dt_s = horizon.prediction, horizon.control, horizon.dt_s
        self._moves, self._slacks = len(axes) * self._hc, len(qp.slope) - qp.slots
        steps = np.arange(1, hp + 1)
        since = steps[:, None] - steps  # (Hp, Hp) steps after the one an acceleration has acted in
        half = 0.0 if horizon.euler else 0.5
        integral = dt_s**2 * np.where(since >= 0, since + half, 0.0)  # position of an acceleration in each step
        held = (np.minimum(steps[:, None] - 1, self._hc - 1) >= np.arange(self._hc)).astype(float)  # (Hp, Hc)
        accel = state.gain_m_s2 * np.clip(state.u_prev, [a.u_min for a in axes], [a.u_max for a in axes])
        self._free_m = state.pos_m + (dt_s * steps)[:, None] * state.vel_m_s + integral @ (accel + state.drift_m_s2)
        self._push = np.stack(  # (2, Hp, Hc) metres of a whole increment
            [integral @ (state.gain_m_s2[:, i, None] * held) * axis.du_max for i, axis in enumerate(axes)]
        )
        others = np.array([k.pos_ned_m[1 : hp + 1] for k in keep_outs]).reshape(-1, hp, 3)
        self._others_m = others[:, :, :2]  # (slots, Hp, 2)
        flat = np.array([0.0 if k.any_height else 1.0 for k in keep_outs])
        self._dz2 = ((z_ned_m - others[:, :, 2]) * flat[:, None]) ** 2  # (slots, Hp)
        self._radius_m = np.array([k.radius_m for k in keep_outs])[:, None]
        self._build_rows(len(keep_outs), hp)

    def _build_rows(self, used: int, hp: int) -> None:
        qp = self.qp
        kept = slice(self._moves, len(qp.rows) - qp.half_spaces)  # the first ones are the increments' own bounds
        rows, lower, upper = qp.rows[kept], qp.lower[kept], qp.upper[kept]
        below, above = lower > -INFINITY, upper < INFINITY
        self._linear = np.concatenate([rows[below], -rows[above]])
        self._linear_least = np.concatenate([lower[below], -upper[above]])
        self._gradient = np.zeros((len(self._linear) + used * hp, len(qp.slope)))
        self._gradient[: len(self._linear)] = self._linear
        slots = self._gradient[len(self._linear) :].reshape(used, hp, -1)
        for s in range(used):
            slots[s, :, self._slacks + s] = qp.slack_m
        self._bounds = [(-1.0, 1.0)] * self._moves + [(0.0, None)] * (len(qp.slope) - self._moves)

    def positions_m(self, x: Array) -> Array:
        """(Hp, 2) at steps 1..Hp."""
        moved = np.einsum("ahj,aj->ha", self._push, x[: self._moves].reshape(len(self._push), self._hc))
        return np.asarray(self._free_m + moved)

    def shortfall_m(self, x: Array) -> float:
        """Largest violation of a softened distance."""
        return float(np.max(-self._distances(x)[1], initial=0.0))

    def shifted(self, x: Array) -> Array:
        """The last answer one step on: every increment a step earlier, none at the end."""
        guess = x.copy()
        moves = guess[: self._moves].reshape(-1, self._hc)
        moves[:, :-1] = moves[:, 1:]
        moves[:, -1] = 0.0
        return guess

    def solve(self, guess: Array, gradients: bool = True) -> NonlinearAnswer:
        """SLSQP from `guess` (n,), with analytic gradients or with finite differences."""
        constraints = {"type": "ineq", "fun": self._margins}
        if gradients:
            constraints["jac"] = self._gradients
        result = optimize.minimize(
            self._cost_and_gradient if gradients else self.qp.cost,
            guess,
            jac=gradients,
            method="SLSQP",
            bounds=self._bounds,
            constraints=constraints,
            options={"ftol": FTOL, "maxiter": MAX_ITERATIONS},
        )
        return NonlinearAnswer(np.asarray(result.x), float(result.fun), bool(result.success), int(result.nit))

    def _distances(self, x: Array) -> tuple[Array, Array, Array]:
        """Horizontal difference (slots, Hp, 2), margin and distance (slots, Hp) to everything to keep clear of."""
        apart = self.positions_m(x) - self._others_m
        distance = np.sqrt(np.einsum("skc,skc->sk", apart, apart) + self._dz2)
        slack = x[self._slacks : self._slacks + len(self._radius_m), None] * self.qp.slack_m
        return apart, distance + slack - self._radius_m, distance

    def _cost_and_gradient(self, x: Array) -> tuple[float, Array]:
        pull = self.qp.hessian @ x
        return float(0.5 * x @ pull + self.qp.slope @ x), pull + self.qp.slope

    def _margins(self, x: Array) -> Array:
        return np.concatenate([self._linear @ x - self._linear_least, self._distances(x)[1].ravel()])

    def _gradients(self, x: Array) -> Array:
        apart, _, distance = self._distances(x)
        normal = apart / np.maximum(distance, _LEAST_M)[:, :, None]  # (slots, Hp, 2)
        slots = self._gradient[len(self._linear) :].reshape(*distance.shape, -1)
        for a, push in enumerate(self._push):
            slots[:, :, a * self._hc : (a + 1) * self._hc] = normal[:, :, a, None] * push
        return self._gradient
