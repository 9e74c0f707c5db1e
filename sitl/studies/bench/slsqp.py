"""The x-y problem exactly as the thesis poses it, for SciPy's SLSQP: the stand-in for MATLAB's fmincon.

Decision variables are the increments of u_x and u_y over Hc, in their own unit (3.25), (3.32). The cost is (3.27) and
(3.34), `e'Q1 e + de'Q2 de + du'R du` over Hp. Increments and inputs are bounded (3.28), (3.29), and the distances
`|p_i(k) - p_j(k)| >= r` hold at every step k = 1..Hp, in three dimensions with z as the z problem has planned it (4.1),
(4.2). All of it is hard, as there: no slack, no step left out. Some problems of a flight have no solution then.

Nothing is held back from the solver. Errors of all steps are one matrix product, everything constant is worked out
beforehand, so that only SciPy and its callbacks are timed, and the bounds on inputs come with their gradient, as
fmincon takes linear constraints. What is differentiated numerically unless told better is what fmincon differentiates:
the cost and the distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, Axis, Horizon
from swarmctl.core.types import Array

FTOL = 1e-6  # fmincon's tolerances; of the thesis' own cost
MAX_ITERATIONS = 400  # fmincon's own limit
KEPT_M = 1e-6  # fmincon's tolerance of a constraint
_SOLVED = 0  # SLSQP's exit mode
_LEAST_M = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class NonlinearAnswer:
    """Answer of SLSQP. Neither solved nor at its limit: it reports that the constraints can't be satisfied."""

    moves: Array  # (2 Hc,) increments of u_x, then of u_y
    cost: float
    solved: bool
    iterations: int
    shortfall_m: float  # largest violation of a distance


class NonlinearXy:
    """One tick's x-y problem with true distances.

    Args:
        axes: weights and bounds; their terminal conditions are left out, the thesis' swarm has none in x-y.
        horizon: lengths and sample time.
        asked: the tick's problem.
        keep_outs: neighbours and obstacles.
        z_ned_m: (Hp,) planned height at steps 1..Hp.
    """

    def __init__(
        self,
        axes: Sequence[Axis],
        horizon: Horizon,
        asked: AxesProblem,
        keep_outs: Sequence[KeepOut],
        *,
        z_ned_m: Array,
    ) -> None:
        hp, self._hc = horizon.prediction, horizon.control
        count = len(axes)
        u_min, u_max = np.array([a.u_min for a in axes]), np.array([a.u_max for a in axes])
        du_max = np.repeat([a.du_max for a in axes], self._hc)
        self._u_prev = np.clip(asked.u_prev, u_min, u_max)
        (to_pos, to_vel), (glide_s, kept) = horizon.of_acceleration(), horizon.of_velocity_s()
        accel = asked.gain_m_s2 * self._u_prev + asked.drift_m_s2  # (Hp, 2)
        self._free_m = (asked.pos_m + glide_s[:, None] * asked.vel_m_s + to_pos @ accel).T.ravel()  # (2 Hp,)
        free_vel = (kept[:, None] * asked.vel_m_s + to_vel @ accel).T.ravel()
        driven = [asked.gain_m_s2[:, i, None] * horizon.held() for i in range(count)]
        self._push = _blocks([to_pos @ d for d in driven])  # (2 Hp, 2 Hc) metres of a unit increment
        push_vel = _blocks([to_vel @ d for d in driven])
        weight_pos, weight_vel, weight_moves = (
            np.sqrt(np.repeat([getattr(a, name) for a in axes], length))
            for name, length in (("q_pos", hp), ("q_vel", hp), ("r", self._hc))
        )
        self._effect = np.concatenate(  # (4 Hp + 2 Hc, 2 Hc) weighted errors of a unit increment
            [weight_pos[:, None] * self._push, weight_vel[:, None] * push_vel, np.diag(weight_moves)]
        )
        self._at_rest = np.concatenate(  # (4 Hp + 2 Hc,) weighted errors without any
            [
                weight_pos * (self._free_m - asked.ref_pos_m.T.ravel()),
                weight_vel * (free_vel - asked.ref_vel_m_s.T.ravel()),
                np.zeros(count * self._hc),
            ]
        )
        sums = _blocks([np.tri(self._hc)] * count)
        self._sums = np.concatenate([sums, -sums])
        self._room = np.concatenate(
            [np.repeat(self._u_prev - u_min, self._hc), np.repeat(u_max - self._u_prev, self._hc)]
        )
        self._bounds = optimize.Bounds(-du_max, du_max)
        others = np.array([k.pos_ned_m[1 : hp + 1].T for k in keep_outs]).reshape(-1, 3, hp)
        self._others_m = others[:, :2]  # (K, 2, Hp)
        flat = np.array([k.vertical_01 for k in keep_outs])
        self._dz2 = ((z_ned_m - others[:, 2]) * flat[:, None]) ** 2  # (K, Hp)
        self._radius_m = np.array([k.radius_m for k in keep_outs])[:, None]

    def shortfall_m(self, moves: Array) -> float:
        """Return the largest violation of a distance [m]."""
        return float(np.max(-self.margins_m(moves), initial=0.0))

    def inputs(self, moves: Array) -> Array:
        """Return the inputs (Hc, 2) that increments make of the held ones."""
        return np.asarray(self._u_prev + np.cumsum(moves.reshape(2, self._hc).T, axis=0))

    def shifted(self, moves: Array) -> Array:
        """Return the last answer shifted by one step; the last increment is zero."""
        guess = np.zeros((2, self._hc))
        guess[:, :-1] = moves.reshape(2, self._hc)[:, 1:]
        return guess.ravel()

    def solve(self, guess: Array | None = None, gradients: bool = False) -> NonlinearAnswer:
        """Run SLSQP from `guess` (2 Hc,), or from zero; with analytic gradients, or with finite differences."""
        distances = {"type": "ineq", "fun": self.margins_m}
        if gradients:
            distances["jac"] = self.margin_gradients
        inputs = {"type": "ineq", "fun": self._input_margins, "jac": lambda moves: self._sums}
        result = optimize.minimize(
            self.cost_and_gradient if gradients else self.cost,
            np.zeros(2 * self._hc) if guess is None else guess,
            jac=gradients,
            method="SLSQP",
            bounds=self._bounds,
            constraints=[inputs, distances],
            options={"ftol": FTOL, "maxiter": MAX_ITERATIONS},
        )
        moves, mode = np.asarray(result.x), int(result.status)
        return NonlinearAnswer(
            moves=moves,
            cost=float(result.fun),
            solved=mode == _SOLVED,
            iterations=int(result.nit),
            shortfall_m=self.shortfall_m(moves),
        )

    def cost(self, moves: Array) -> float:
        """Return the cost (3.27) and (3.34)."""
        errors = self._at_rest + self._effect @ moves
        return float(errors @ errors)

    def cost_and_gradient(self, moves: Array) -> tuple[float, Array]:
        errors = self._at_rest + self._effect @ moves
        return float(errors @ errors), 2.0 * (errors @ self._effect)

    def margins_m(self, moves: Array) -> Array:
        """Return the margin of every distance at every step, (K Hp,) [m]."""
        return np.asarray((self._distances(moves)[1] - self._radius_m).ravel())

    def margin_gradients(self, moves: Array) -> Array:
        """Return the gradients of the margins, (K Hp, 2 Hc)."""
        apart, distance = self._distances(moves)
        normal = apart / np.maximum(distance, _LEAST_M)[:, None]  # (K, 2, Hp)
        push = self._push.reshape(2, -1, 2 * self._hc)
        return np.asarray((normal[:, 0, :, None] * push[0] + normal[:, 1, :, None] * push[1]).reshape(-1, 2 * self._hc))

    def _distances(self, moves: Array) -> tuple[Array, Array]:
        """Return the horizontal difference (K, 2, Hp) and the distance (K, Hp) to everything that is avoided."""
        apart = (self._free_m + self._push @ moves).reshape(2, -1) - self._others_m
        return apart, np.sqrt(np.einsum("sck,sck->sk", apart, apart) + self._dz2)

    def _input_margins(self, moves: Array) -> Array:
        return np.asarray(self._room + self._sums @ moves)


def _blocks(of_axes: Sequence[Array]) -> Array:
    """Return the block-diagonal matrix of the axes, which do not interact."""
    rows, columns = of_axes[0].shape
    whole = np.zeros((len(of_axes) * rows, len(of_axes) * columns))
    for i, block in enumerate(of_axes):
        whole[i * rows : (i + 1) * rows, i * columns : (i + 1) * columns] = block
    return whole
