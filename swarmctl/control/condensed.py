"""Condensed linear MPC over input increments for one, two or three double-integrator axes (thesis 3.9-3.31).

Every axis obeys `p'' = gain u + drift`. The decision variables are the increments of `u` over the control horizon Hc,
scaled by their bound to [-1, 1]; after Hc the input stays. Rows: increment bounds, input bounds, softened terminal
conditions, and half-spaces `n . p_k >= b_k` with one slack a slot. Nothing here knows which axis is which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarmctl.control.qp import INFINITY, OsqpSolver, QpParams, QpSolver, pattern_index
from swarmctl.core.types import Array

_SLACK_SCALE_M = 0.1  # slack variables are in units of this, so that they are about 1 like all others
_ROW_STRIDE = 4  # neighbouring rows are nearly parallel, which slows a first-order solver down
_NOMINAL_GAIN_M_S2 = 9.81  # only scales the cost


@dataclass(frozen=True, slots=True)
class Axis:
    """Weights and bounds of one axis (thesis Tables 9, 10, 17, 21)."""

    q_pos: float
    q_vel: float
    r: float
    u_min: float
    u_max: float
    du_max: float
    terminal_pos: bool
    terminal_vel: bool


@dataclass(frozen=True, slots=True)
class Horizon:
    """Lengths and sample time of the prediction."""

    control: int
    prediction: int
    dt_s: float
    euler: bool  # forward Euler as in the thesis (3.6), otherwise exact for a held input


@dataclass(frozen=True, slots=True)
class Penalties:
    """Exact (linear) and quadratic weights of what is softened.

    A linear penalty is exact when it exceeds the multiplier of the hard constraint, that is the slope of the tracking
    cost along the constraint; so the slack's weight follows that slope.
    """

    floor: float = 50.0  # per metre; on top of `over` times the tracking cost's own slope
    over: float = 3.0
    slack_quadratic: float = 20000.0


@dataclass(frozen=True, slots=True)
class HalfSpaces:
    """`normal[s, k] . p_k >= offset[s, k]` for slots s and steps k = 1..Hp; offset -inf switches a row off.

    Only every fourth step from the end of the control horizon on becomes a row: earlier ones can't be influenced, and
    between rows 0.08 s apart the certificate looks at true distances anyway. One more row a slot looks beyond
    the horizon: `normal[s, -1] . (p_Hp + stop_s[s] v_Hp) >= stop_offset_m[s]`, so that there is room left to stop.
    """

    normal: Array  # (slots, Hp, axes)
    offset_m: Array  # (slots, Hp)
    stop_s: Array  # (slots,)
    stop_offset_m: Array  # (slots,)


@dataclass(frozen=True, slots=True)
class AxesSolution:
    """Predicted motion of the axes; `solved` False leaves the arrays at the free response.

    Increments and inputs are within their bounds exactly; `residual_m` is the largest violation of a half-space after
    that. An unfinished iterate comes as solved: its residual decides.
    """

    solved: bool
    status: str
    iterations: int
    u: Array  # (Hp, axes), held over each step
    pos_m: Array  # (Hp, axes), steps 1..Hp
    vel_m_s: Array  # (Hp, axes)
    slack_m: float
    residual_m: float
    terminal_gap_m: float


class CondensedMpc:
    """One problem family with fixed sparsity; `solve` is called every tick.

    Args:
        axes: one entry an axis.
        horizon: lengths and sample time.
        slots: how many half-space families (neighbours and obstacles) there is room for.
        relax_01: half-space rows never ask for more than this share of what the bounded increments can reach, so rows
            inside the dead time can't be infeasible and push agents away (`1` asks for all).
        penalties: weights of what is softened.
        qp: solver settings.
    """

    def __init__(
        self,
        axes: tuple[Axis, ...],
        horizon: Horizon,
        slots: int,
        relax_01: float,
        penalties: Penalties,
        qp: QpParams,
    ) -> None:
        self.axes, self.horizon, self.slots, self._relax_01 = axes, horizon, slots, relax_01
        self._penalties = penalties
        self._u_min = np.array([a.u_min for a in axes])
        self._u_max = np.array([a.u_max for a in axes])
        self._du_max = np.array([a.du_max for a in axes])
        self._build_response()
        self._build_layout()
        self._build_cost()
        if slots == 0:  # small: tight tolerances cost less than polishing
            qp = qp.model_copy(update={"polish": False, "eps": 0.01 * qp.eps, "eps_relative": 0.01 * qp.eps_relative})
        self._solver: QpSolver = OsqpSolver(self._p_pattern, self._a_pattern, qp)

    def _build_response(self) -> None:
        """Positions and velocities at steps 1..Hp of a unit increment at each step j < Hc, per unit gain."""
        hp, hc, dt_s = self.horizon.prediction, self.horizon.control, self.horizon.dt_s
        steps = np.arange(1, hp + 1)
        held = np.maximum(steps[:, None] - np.arange(hc)[None, :], 0)  # (Hp, Hc) steps an increment has acted
        own = held - 1 if self.horizon.euler else held
        self._phi_pos = 0.5 * dt_s**2 * held * np.maximum(own, 0)  # (Hp, Hc)
        self._phi_vel = dt_s * held
        self._t_s = dt_s * steps  # (Hp,)
        self._drop = 0.5 * dt_s**2 * steps * (steps - 1 if self.horizon.euler else steps)  # position of unit accel.
        self._checked = np.arange(hp - 1, min(hc, hp - 1) - 1, -_ROW_STRIDE)[
            ::-1
        ]  # 0-based steps that get half-space rows
        response = self._phi_pos[self._checked].max(axis=1) * max(a.du_max for a in self.axes) * _NOMINAL_GAIN_M_S2
        response = np.append(response, response[-1])  # and the stopping row
        self._row_scale = 1.0 / np.maximum(response, 0.01)  # rows of about unit size suit a first-order solver
        self._hold = (np.minimum.outer(np.arange(hp), np.arange(hc)) == np.arange(hc)).astype(float)  # (Hp, Hc)

    def _build_layout(self) -> None:
        n, hc, checks = len(self.axes), self.horizon.control, len(self._row_scale)
        self._terminals = [(i, "pos") for i, a in enumerate(self.axes) if a.terminal_pos]
        self._terminals += [(i, "vel") for i, a in enumerate(self.axes) if a.terminal_vel]
        moves, soft = n * hc, len(self._terminals)
        self._moves, self._columns = moves, moves + soft + self.slots
        self._row_input = moves
        self._row_soft = 2 * moves
        self._row_terminal = self._row_soft + soft + self.slots
        self._row_half = self._row_terminal + 2 * soft
        rows = self._row_half + self.slots * checks
        a = np.zeros((rows, self._columns), bool)
        a[np.arange(moves), np.arange(moves)] = True
        for i in range(n):
            block = slice(moves + i * hc, moves + (i + 1) * hc)
            a[block, i * hc : (i + 1) * hc] = np.tri(hc, dtype=bool)
        extra = np.arange(soft + self.slots)
        a[self._row_soft + extra, moves + extra] = True
        for j, (i, _) in enumerate(self._terminals):
            for row in (self._row_terminal + 2 * j, self._row_terminal + 2 * j + 1):
                a[row, i * hc : (i + 1) * hc] = True
                a[row, moves + j] = True
        for s in range(self.slots):
            block = slice(self._row_half + s * checks, self._row_half + (s + 1) * checks)
            a[block, :moves] = True
            a[block, moves + soft + s] = True
        p = np.zeros((self._columns, self._columns), bool)
        for i in range(n):
            p[i * hc : (i + 1) * hc, i * hc : (i + 1) * hc] = True
        p[np.arange(moves, self._columns), np.arange(moves, self._columns)] = True
        self._a_pattern, self._p_pattern = a, p
        self._a_index, self._p_index = pattern_index(a), pattern_index(p, upper=True)
        self._a_dense = np.zeros(a.shape)
        self._p_dense = np.zeros(p.shape)
        self._lower = np.full(rows, -INFINITY)
        self._upper = np.full(rows, INFINITY)

    def _build_cost(self) -> None:
        n, hc = len(self.axes), self.horizon.control
        self._hessian: list[Array] = []
        for axis in self.axes:
            gram = axis.q_pos * self._phi_pos.T @ self._phi_pos + axis.q_vel * self._phi_vel.T @ self._phi_vel
            self._hessian.append(2.0 * axis.du_max**2 * gram)
        largest = max(float(np.max(np.diag(h))) for h in self._hessian) * _NOMINAL_GAIN_M_S2**2
        self._cost_scale = 1.0 / max(largest, 1e-12)
        for i, axis in enumerate(self.axes):
            block = slice(self._moves + i * hc, self._moves + (i + 1) * hc)
            self._a_dense[block, i * hc : (i + 1) * hc] = np.tri(hc) * axis.du_max / self._input_scale(axis)
            self._lower[i * hc : (i + 1) * hc] = -1.0
            self._upper[i * hc : (i + 1) * hc] = 1.0
        moves, soft = self._moves, len(self._terminals)
        self._a_dense[np.arange(moves), np.arange(moves)] = 1.0
        extra = np.arange(soft + self.slots)
        self._a_dense[self._row_soft + extra, moves + extra] = 1.0
        self._lower[self._row_soft + extra] = 0.0
        for j in range(soft):
            self._a_dense[self._row_terminal + 2 * j, moves + j] = _SLACK_SCALE_M
            self._a_dense[self._row_terminal + 2 * j + 1, moves + j] = -_SLACK_SCALE_M
        checks = len(self._row_scale)
        for s in range(self.slots):
            block = slice(self._row_half + s * checks, self._row_half + (s + 1) * checks)
            self._a_dense[block, moves + soft + s] = _SLACK_SCALE_M * self._row_scale
        weights = self._penalties
        quadratic = [1e-3] * soft + [2 * weights.slack_quadratic * _SLACK_SCALE_M**2 * self._cost_scale] * self.slots
        self._p_dense[np.arange(moves, self._columns), np.arange(moves, self._columns)] = quadratic
        self._q_soft = np.full(soft + self.slots, weights.floor * _SLACK_SCALE_M * self._cost_scale)
        assert len(self._q_soft) == self._columns - n * hc

    @staticmethod
    def _input_scale(axis: Axis) -> float:
        return max(abs(axis.u_min), abs(axis.u_max))

    def solve(
        self,
        pos_m: Array,
        vel_m_s: Array,
        u_prev: Array,
        gain_m_s2: Array,
        drift_m_s2: Array,
        ref_pos_m: Array,
        ref_vel_m_s: Array,
        half_spaces: HalfSpaces | None = None,
    ) -> AxesSolution:
        """One receding-horizon step.

        Args:
            pos_m, vel_m_s: (axes,) state the prediction starts from.
            u_prev: (axes,) input now held.
            gain_m_s2: (axes,) acceleration of a unit input, sign included.
            drift_m_s2: (axes,) acceleration without input.
            ref_pos_m, ref_vel_m_s: (Hp, axes) at steps 1..Hp.
            half_spaces: at most `slots` families; None for none.
        """
        u_prev = np.clip(u_prev, self._u_min, self._u_max)
        accel = gain_m_s2 * u_prev + drift_m_s2  # (axes,)
        free_pos = pos_m + self._t_s[:, None] * vel_m_s + self._drop[:, None] * accel  # (Hp, axes)
        free_vel = vel_m_s + self._t_s[:, None] * accel
        q = self._fill_cost(gain_m_s2, free_pos - ref_pos_m, free_vel - ref_vel_m_s)
        self._fill_inputs(u_prev)
        self._fill_terminals(gain_m_s2, (free_pos - ref_pos_m)[-1], (free_vel - ref_vel_m_s)[-1])
        self._fill_half_spaces(gain_m_s2, u_prev, free_pos, free_vel, half_spaces)
        solution = self._solver.solve(
            self._p_dense[self._p_index], q, self._a_dense[self._a_index], self._lower, self._upper
        )
        return self._unpack(solution.x, solution.status, solution.iterations, u_prev, gain_m_s2, free_pos, free_vel)

    def _fill_cost(self, gain_m_s2: Array, pos_error: Array, vel_error: Array) -> Array:
        hc = self.horizon.control
        q = np.empty(self._columns)
        q[self._moves :] = self._q_soft
        for i, axis in enumerate(self.axes):
            block = slice(i * hc, (i + 1) * hc)
            gain = float(gain_m_s2[i])
            hessian = gain * gain * self._hessian[i]
            hessian[np.arange(hc), np.arange(hc)] += 2.0 * axis.r * axis.du_max**2
            self._p_dense[block, block] = hessian * self._cost_scale
            slope = axis.q_pos * (pos_error[:, i] @ self._phi_pos) + axis.q_vel * (vel_error[:, i] @ self._phi_vel)
            q[block] = (2.0 * gain * axis.du_max * self._cost_scale) * slope
        steepest = float(np.abs(q[: self._moves]).max()) * self._row_scale[-1]  # per metre of the last row
        q[self._moves :] += self._penalties.over * steepest * _SLACK_SCALE_M
        return q

    def _fill_inputs(self, u_prev: Array) -> None:
        hc = self.horizon.control
        for i, axis in enumerate(self.axes):
            block = slice(self._row_input + i * hc, self._row_input + (i + 1) * hc)
            scale = self._input_scale(axis)
            self._lower[block] = (axis.u_min - u_prev[i]) / scale
            self._upper[block] = (axis.u_max - u_prev[i]) / scale

    def _fill_terminals(self, gain_m_s2: Array, pos_error: Array, vel_error: Array) -> None:
        hc = self.horizon.control
        for j, (i, what) in enumerate(self._terminals):
            response = self._phi_pos[-1] if what == "pos" else self._phi_vel[-1]
            error = pos_error[i] if what == "pos" else vel_error[i]
            row = self._row_terminal + 2 * j
            self._a_dense[row : row + 2, i * hc : (i + 1) * hc] = gain_m_s2[i] * self.axes[i].du_max * response
            self._lower[row] = -error  # gap + slack >= 0
            self._upper[row + 1] = -error  # gap - slack <= 0

    def _fill_half_spaces(
        self, gain_m_s2: Array, u_prev: Array, free_pos: Array, free_vel: Array, spaces: HalfSpaces | None
    ) -> None:
        hc, checks = self.horizon.control, len(self._row_scale)
        self._lower[self._row_half :] = -INFINITY
        if spaces is None or len(spaces.normal) == 0:
            return
        used = len(spaces.normal)
        normal = np.concatenate([spaces.normal[:, self._checked], spaces.normal[:, -1:]], axis=1)
        offset = np.concatenate([spaces.offset_m[:, self._checked], spaces.stop_offset_m[:, None]], axis=1)
        response = np.empty((used, checks, hc))  # metres of each row per unit gain and increment
        response[:, :-1] = self._phi_pos[self._checked]
        response[:, -1] = self._phi_pos[-1] + spaces.stop_s[:, None] * self._phi_vel[-1]
        free = np.empty((used, checks, len(self.axes)))
        free[:, :-1] = free_pos[self._checked]
        free[:, -1] = free_pos[-1] + spaces.stop_s[:, None] * free_vel[-1]
        push = normal * gain_m_s2
        scaled = push * self._row_scale[None, :, None]
        rows = slice(self._row_half, self._row_half + used * checks)
        block = self._a_dense[rows].reshape(used, checks, self._columns)
        for i, axis in enumerate(self.axes):
            block[:, :, i * hc : (i + 1) * hc] = scaled[:, :, i, None] * (axis.du_max * response)
        wanted = offset - np.einsum("ska,ska->sk", normal, free)
        lower = np.minimum(wanted, self._relax_01 * self._reach(push, response, u_prev)) * self._row_scale
        self._lower[rows] = np.where(np.isfinite(offset), lower, -INFINITY).ravel()

    def _reach(self, push: Array, response: Array, u_prev: Array) -> Array:
        """Largest value of each row (used, checks) that the bounded increments allow."""
        total = np.zeros(push.shape[:2])
        ramp = np.arange(1, self.horizon.control + 1)
        for i, axis in enumerate(self.axes):
            up = np.minimum(u_prev[i] + axis.du_max * ramp, axis.u_max)
            down = np.maximum(u_prev[i] - axis.du_max * ramp, axis.u_min)
            rise = response @ np.diff(up, prepend=u_prev[i])  # (used, checks)
            fall = response @ np.diff(down, prepend=u_prev[i])
            total += np.maximum(push[:, :, i] * rise, push[:, :, i] * fall)
        return total

    def _unpack(
        self,
        x: Array | None,
        status: str,
        iterations: int,
        u_prev: Array,
        gain_m_s2: Array,
        free_pos: Array,
        free_vel: Array,
    ) -> AxesSolution:
        hp, hc, n = self.horizon.prediction, self.horizon.control, len(self.axes)
        if x is None:
            held = np.tile(u_prev, (hp, 1))
            return AxesSolution(False, status, iterations, held, free_pos, free_vel, 0.0, np.inf, np.inf)
        wanted = np.clip(x[: self._moves], -1.0, 1.0).reshape(n, hc).T * self._du_max  # (Hc, axes)
        inputs = np.clip(u_prev + np.cumsum(wanted, axis=0), self._u_min, self._u_max)
        moves = np.diff(inputs, axis=0, prepend=u_prev[None])  # within both bounds, whatever the solver's tolerance
        u = u_prev + self._hold @ moves
        pos = free_pos + (self._phi_pos @ moves) * gain_m_s2
        vel = free_vel + (self._phi_vel @ moves) * gain_m_s2
        soft = len(self._terminals)
        flown = np.concatenate([(moves / self._du_max).T.ravel(), x[self._moves :]])
        slack = flown[self._moves + soft :] * _SLACK_SCALE_M
        terminal = slice(self._row_terminal, self._row_half, 2)  # their bounds are the error without any move
        gap = np.abs(self._a_dense[terminal, : self._moves] @ flown[: self._moves] - self._lower[terminal])
        shortfall = self._lower[self._row_half :] - self._a_dense[self._row_half :] @ flown
        shortfall = shortfall / np.tile(self._row_scale, self.slots)
        return AxesSolution(
            True,
            status,
            iterations,
            u,
            pos,
            vel,
            float(slack.max(initial=0.0)),
            float(shortfall.max(initial=0.0)),
            float(gap.max(initial=0.0)),
        )
