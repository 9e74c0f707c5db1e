"""Condensed linear MPC over input increments for one, two or three axes (thesis 3.9-3.31).

Every axis obeys `p'' = gain(k) a + drift - drag p'`, where `a` is the input u or, with a lag, what follows it. The
decision variables are the increments of `u` over the control horizon Hc, scaled to about [-1, 1]; after Hc the input
is constant. Rows are increment bounds, input bounds, softened terminal conditions, and half-spaces `n . p_k >= b_k`
with one slack for each slot. The problem does not depend on which axis is which.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.lag import lag_response
from swarmctl.control.mpc.axes import AxesProblem, AxesSolution, Axis, HalfSpaces, Horizon, Penalties
from swarmctl.control.mpc.qp import INFINITY, QpParams, make_solver, pattern_index
from swarmctl.control.mpc.terminal import TerminalRegion, terminal_region
from swarmctl.core.types import Array

_SLACK_SCALE_M = 0.1  # unit of slack variables, so that they are about 1 like all others
_SLACK_USED_M = 1e-3
_DECIDED_S = 0.12  # motion within this time after the dead time can hardly be changed
_REACHABLE_01 = 0.998  # share of the reachable displacement that replaces an end out of reach
_ROW_SPACING_S = 0.08  # closer rows are nearly parallel, which slows a first-order solver down


class CondensedMpc:
    """Solves one family of problems with fixed sparsity; `solve` is called every tick.

    Args:
        axes: weights and bounds of each axis.
        horizon: lengths and sample time.
        max_keep_outs: largest number of half-space families (neighbours and obstacles).
        relax_01: half-space rows ask for at most this share of what the bounded increments can reach, so that rows
            inside the dead time are never infeasible and never push agents away (1 asks for all).
        penalties: weights of softened constraints.
        qp: solver settings.
        stopwatch_ns: measures the solver and has no influence.
    """

    def __init__(
        self,
        axes: tuple[Axis, ...],
        horizon: Horizon,
        max_keep_outs: int,
        relax_01: float,
        penalties: Penalties,
        qp: QpParams,
        stopwatch_ns: Callable[[], int],
    ) -> None:
        self.axes, self.horizon, self.max_keep_outs, self._relax_01 = axes, horizon, max_keep_outs, relax_01
        self._penalties, self._stopwatch_ns = penalties, stopwatch_ns
        self._u_min = np.array([a.u_min for a in axes])
        self._u_max = np.array([a.u_max for a in axes])
        self._du_max = np.array([a.du_max for a in axes])
        self._build_response()
        self._build_layout()
        self._build_cost()
        if max_keep_outs == 0:  # a small problem: tight tolerances cost less than polishing
            qp = qp.model_copy(update={"polish": False, "eps": 0.01 * qp.eps, "eps_relative": 0.01 * qp.eps_relative})
        self._solver = make_solver(self._p_pattern, self._a_pattern, qp)
        self._soft_solver = make_solver(self._p_pattern, self._a_pattern, qp) if self._terminals else self._solver

    def _build_response(self) -> None:
        """Compute the constant responses: positions and velocities at steps 1..Hp to accelerations and increments."""
        hp = self.horizon.prediction
        self._pos_of_accel, self._vel_of_accel = self.horizon.of_acceleration()
        self._pos_of_vel, self._vel_of_vel = self.horizon.of_velocity_s()
        self._hold = self.horizon.held()
        self._lags = [lag_response(a.lag, self.horizon.dt_s, hp) for a in self.axes]
        self._acted = np.stack([response.of_command @ self._hold for response in self._lags])  # (axes, Hp, Hc)
        first, stride = self.first_row(), max(1, round(_ROW_SPACING_S / self.horizon.dt_s))
        self._checked = np.arange(hp - 1, first - 1, -stride)[::-1]  # 0-based steps that get half-space rows
        step_m_s2 = max(a.du_max * a.gain_m_s2 for a in self.axes)
        response = (self._pos_of_accel @ self._acted[0])[self._checked].max(axis=1) * step_m_s2
        response = np.append(response, response[-1])  # the stopping row
        self._row_scale = 1.0 / np.maximum(response, 0.01)  # rows of about unit size suit a first-order solver

    def _build_layout(self) -> None:
        """Number variables and rows, and build the sparsity patterns."""
        n, hc, checks = len(self.axes), self.horizon.control, len(self._row_scale)
        ends = [a.terminal for a in self.axes]
        self._terminals = [(i, "pos") for i, end in enumerate(ends) if end in ("position", "position_velocity")]
        self._terminals += [(i, "vel") for i, end in enumerate(ends) if end == "position_velocity"]
        self._ends = np.arange(len(self._terminals))
        self._end_velocities = np.array([j for j, (_, what) in enumerate(self._terminals) if what == "vel"], dtype=int)
        self._end_wanted = np.zeros(len(self._terminals))
        self._terminals_of = {
            i: np.array([j for j, (k, _) in enumerate(self._terminals) if k == i])
            for i in sorted({i for i, _ in self._terminals})
        }
        self._regions = {i: self._region(a) for i, a in enumerate(self.axes) if a.terminal == "region"}
        moves, soft = n * hc, len(self._terminals)
        self._moves, self._columns = moves, moves + soft + self.max_keep_outs
        self._row_input = moves
        self._row_soft = 2 * moves
        self._row_terminal = self._row_soft + soft + self.max_keep_outs
        self._row_half = self._row_terminal + 2 * soft
        rows = self._row_half + self.max_keep_outs * checks
        a = np.zeros((rows, self._columns), bool)
        a[np.arange(moves), np.arange(moves)] = True
        for i in range(n):
            block = slice(moves + i * hc, moves + (i + 1) * hc)
            a[block, i * hc : (i + 1) * hc] = np.tri(hc, dtype=bool)
        extra = np.arange(soft + self.max_keep_outs)
        a[self._row_soft + extra, moves + extra] = True
        for j, (i, _) in enumerate(self._terminals):
            for row in (self._row_terminal + 2 * j, self._row_terminal + 2 * j + 1):
                a[row, i * hc : (i + 1) * hc] = True
                a[row, moves + j] = True
        for s in range(self.max_keep_outs):
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

    def _region(self, axis: Axis) -> TerminalRegion:
        """Return the terminal region of an axis, in units of acceleration."""
        gain = axis.gain_m_s2
        room = min(axis.u_max - axis.u_rest, axis.u_rest - axis.u_min)
        return terminal_region(
            axis.q_pos, axis.q_vel, axis.r / gain**2, gain * room, gain * axis.du_max, self.horizon.dt_s
        )

    def _build_cost(self) -> None:
        """Fill the parts of cost and rows that never change, and find the scale of the cost."""
        n, hc = len(self.axes), self.horizon.control
        largest = 0.0
        for i, axis in enumerate(self.axes):
            phi_pos, phi_vel = self._pos_of_accel @ self._acted[i], self._vel_of_accel @ self._acted[i]  # (Hp, Hc)
            gram = axis.q_pos * phi_pos.T @ phi_pos + axis.q_vel * phi_vel.T @ phi_vel
            if i in self._regions:
                end = np.stack([phi_pos[-1], phi_vel[-1], self._acted[i, -1]])  # (3, Hc)
                gram += end.T @ self._regions[i].beyond @ end
            largest = max(largest, 2.0 * (axis.du_max * axis.gain_m_s2) ** 2 * float(np.max(np.diag(gram))))
        self._cost_scale = 1.0 / max(largest, 1e-12)
        for i, axis in enumerate(self.axes):
            block = slice(self._moves + i * hc, self._moves + (i + 1) * hc)
            self._a_dense[block, i * hc : (i + 1) * hc] = np.tri(hc) * axis.du_max / axis.u_scale
            self._lower[i * hc : (i + 1) * hc] = -1.0
            self._upper[i * hc : (i + 1) * hc] = 1.0
        moves, soft = self._moves, len(self._terminals)
        self._a_dense[np.arange(moves), np.arange(moves)] = 1.0
        extra = np.arange(soft + self.max_keep_outs)
        self._a_dense[self._row_soft + extra, moves + extra] = 1.0
        self._lower[self._row_soft + extra] = 0.0
        for j in range(soft):
            self._a_dense[self._row_terminal + 2 * j, moves + j] = _SLACK_SCALE_M
            self._a_dense[self._row_terminal + 2 * j + 1, moves + j] = -_SLACK_SCALE_M
        checks = len(self._row_scale)
        for s in range(self.max_keep_outs):
            block = slice(self._row_half + s * checks, self._row_half + (s + 1) * checks)
            self._a_dense[block, moves + soft + s] = _SLACK_SCALE_M * self._row_scale
        weights = self._penalties
        quadratic = [1e-3] * soft + [
            2 * weights.slack_quadratic * _SLACK_SCALE_M**2 * self._cost_scale
        ] * self.max_keep_outs
        self._p_dense[np.arange(moves, self._columns), np.arange(moves, self._columns)] = quadratic
        self._q_soft = np.full(soft + self.max_keep_outs, weights.floor * _SLACK_SCALE_M * self._cost_scale)
        assert len(self._q_soft) == self._columns - n * hc

    def solve(self, asked: AxesProblem, half_spaces: HalfSpaces | None = None) -> AxesSolution:
        """Solve one receding-horizon step, with at most `max_keep_outs` families of half-spaces; None for none."""
        gain_m_s2, ref_pos_m, ref_vel_m_s = asked.gain_m_s2, asked.ref_pos_m, asked.ref_vel_m_s
        u_prev = np.minimum(np.maximum(asked.u_prev, self._u_min), self._u_max)
        held = np.broadcast_to(u_prev, gain_m_s2.shape)
        accel = gain_m_s2 * self.realised(held, asked.realised, asked.realised_1_s) + asked.drift_m_s2  # (Hp, axes)
        free_pos, free_vel = self.motion(asked.pos_m, asked.vel_m_s, accel)
        driven = gain_m_s2.T[:, :, None] * self._acted  # (axes, Hp, Hc)
        phi_pos, phi_vel = self._pos_of_accel @ driven, self._vel_of_accel @ driven
        pos_error, vel_error = free_pos - ref_pos_m, free_vel - ref_vel_m_s
        ref_accel = (ref_vel_m_s[-1] - ref_vel_m_s[-2]) / self.horizon.dt_s if len(ref_vel_m_s) > 1 else 0.0 * u_prev
        surplus = accel[-1] - self.horizon.drag_1_s * ref_vel_m_s[-1] - ref_accel
        ends = np.stack([pos_error[-1], vel_error[-1], surplus])  # (3, axes) error at the end without increments
        q = self._fill_cost(gain_m_s2, phi_pos, phi_vel, pos_error, vel_error, ends)
        self._fill_inputs(u_prev)
        self._fill_terminals(phi_pos[:, -1], phi_vel[:, -1], u_prev, pos_error[-1], vel_error[-1])
        self._fill_half_spaces(phi_pos, phi_vel, u_prev, free_pos, free_vel, half_spaces)
        p_values, a_values = self._p_dense[self._p_index], self._a_dense[self._a_index]
        began_ns = self._stopwatch_ns()
        solution = self._solver.solve(p_values, q, a_values, self._lower, self._upper)
        for softened in (self._end_velocities, self._ends):  # if infeasible, exact penalties replace equalities
            if len(softened) and not solution.exact:
                self._soften(q, softened)
                solution = self._soft_solver.solve(p_values, q, a_values, self._lower, self._upper)
        if len(self._ends) and self.max_keep_outs and self._distance_slack_m(solution.x) > _SLACK_USED_M:
            self._soften(q, self._ends)  # distances have priority over the end
            q[self._moves + self._ends] = 0.0
            solution = self._soft_solver.solve(p_values, q, a_values, self._lower, self._upper)
        solve_us = (self._stopwatch_ns() - began_ns) * 1e-3
        inputs = self._inputs(solution.x, u_prev)
        moves = np.diff(inputs, axis=0, prepend=u_prev[None])  # within both bounds exactly
        slack_m, residual_m, gap_m = self._violations(solution.x, moves)
        pos = free_pos + np.einsum("akc,ca->ka", phi_pos, moves)
        vel = free_vel + np.einsum("akc,ca->ka", phi_vel, moves)
        for i, region in self._regions.items():
            end = np.array([(pos - ref_pos_m)[-1, i], (vel - ref_vel_m_s)[-1, i], ends[2, i]])
            end[2] += gain_m_s2[-1, i] * float(self._acted[i, -1] @ moves[:, i])
            gap_m = max(gap_m, region.outside_m(end))
        return AxesSolution(
            solved=solution.x is not None,
            status=solution.status,
            iterations=solution.iterations,
            u=u_prev + self._hold @ moves,
            pos_m=pos,
            vel_m_s=vel,
            slack_m=slack_m,
            residual_m=residual_m,
            terminal_gap_m=gap_m,
            solve_us=solve_us,
        )

    def first_row(self) -> int:
        """Return the 0-based index of the first step at which increments change a position noticeably."""
        slowest_s = max((a.lag.ramp_delay_s for a in self.axes if a.lag is not None), default=0.0)
        steps = math.ceil((_DECIDED_S + slowest_s) / self.horizon.dt_s - 1e-9)
        return min(steps, self.horizon.prediction - 1)

    def realised(self, u: Array, at_start: Array | None, rate_1_s: Array | None) -> Array:
        """Return mean realised inputs (Hp, axes) over each step, for commanded inputs `u` (Hp, axes).

        `at_start` (axes,) is the input realised at the start (None: the first command), `rate_1_s` (axes,) its rate
        (None: 0).
        """
        acts = np.empty(u.shape)
        for i, lag in enumerate(self._lags):
            begins = u[0, i] if at_start is None else at_start[i]
            acts[:, i] = lag.of_command @ u[:, i] + begins * lag.of_tilt
            if rate_1_s is not None:
                acts[:, i] += rate_1_s[i] * lag.of_rate_s
        return acts

    def motion(self, pos_m: Array, vel_m_s: Array, accel_m_s2: Array) -> tuple[Array, Array]:
        """Return positions and velocities (Hp, axes) under accelerations (Hp, axes) held over each step."""
        pos = pos_m + self._pos_of_vel[:, None] * vel_m_s + self._pos_of_accel @ accel_m_s2
        return pos, self._vel_of_vel[:, None] * vel_m_s + self._vel_of_accel @ accel_m_s2

    def _fill_cost(
        self, gain_m_s2: Array, phi_pos: Array, phi_vel: Array, pos_error: Array, vel_error: Array, ends: Array
    ) -> Array:
        """Fill the Hessian and return the linear cost (n,)."""
        hc = self.horizon.control
        q = np.empty(self._columns)
        q[self._moves :] = self._q_soft
        for i, axis in enumerate(self.axes):
            block = slice(i * hc, (i + 1) * hc)
            hessian = axis.q_pos * (phi_pos[i].T @ phi_pos[i]) + axis.q_vel * (phi_vel[i].T @ phi_vel[i])
            slope = axis.q_pos * (pos_error[:, i] @ phi_pos[i]) + axis.q_vel * (vel_error[:, i] @ phi_vel[i])
            if i in self._regions:
                end = np.stack([phi_pos[i, -1], phi_vel[i, -1], gain_m_s2[-1, i] * self._acted[i, -1]])  # (3, Hc)
                pull = end.T @ self._regions[i].beyond
                hessian += pull @ end
                slope += pull @ ends[:, i]
            hessian[np.arange(hc), np.arange(hc)] += axis.r
            self._p_dense[block, block] = (2.0 * axis.du_max**2 * self._cost_scale) * hessian
            q[block] = (2.0 * axis.du_max * self._cost_scale) * slope
        steepest = float(np.abs(q[: self._moves]).max()) * self._row_scale[-1]  # per metre of the last row
        q[self._moves + len(self._terminals) :] += self._penalties.over * steepest * _SLACK_SCALE_M
        return q

    def _fill_inputs(self, u_prev: Array) -> None:
        """Fill the bounds of the inputs, relative to the held input (axes,)."""
        hc = self.horizon.control
        for i, axis in enumerate(self.axes):
            block = slice(self._row_input + i * hc, self._row_input + (i + 1) * hc)
            scale = axis.u_scale
            self._lower[block] = (axis.u_min - u_prev[i]) / scale
            self._upper[block] = (axis.u_max - u_prev[i]) / scale

    def _fill_terminals(
        self, end_pos: Array, end_vel: Array, u_prev: Array, pos_error: Array, vel_error: Array
    ) -> None:
        """Fill terminal conditions as equalities `gap = 0` with slacks fixed at 0.

        An end that the bounded increments can't reach is replaced by the farthest one that they can.
        """
        hc, out_of_reach = self.horizon.control, set[int]()
        for j, (i, what) in enumerate(self._terminals):
            response = end_pos[i] if what == "pos" else end_vel[i]
            row = self._row_terminal + 2 * j
            self._a_dense[row : row + 2, i * hc : (i + 1) * hc] = self.axes[i].du_max * response
            self._end_wanted[j] = -(pos_error if what == "pos" else vel_error)[i]
            asked = self._end_wanted[j]
            least, most = sorted(float(response @ moves) for moves in self._extremes(i, u_prev))
            self._lower[row : row + 2], self._upper[row : row + 2] = -INFINITY, INFINITY
            if i in out_of_reach:
                continue  # its end velocity then does not matter
            if not least <= asked <= most:
                out_of_reach.add(i)
                asked = _REACHABLE_01 * (most if asked > most else least)
            self._lower[row : row + 2] = self._upper[row : row + 2] = asked
        self._upper[self._row_soft + self._ends] = 0.0

    def _extremes(self, i: int, u_prev: Array) -> tuple[Array, Array]:
        """Return increments (Hc,) of axis `i` that raise, and that lower, its input as fast as the bounds allow."""
        axis, ramp = self.axes[i], np.arange(1, self.horizon.control + 1)
        rise = np.minimum(u_prev[i] + axis.du_max * ramp, axis.u_max)
        fall = np.maximum(u_prev[i] - axis.du_max * ramp, axis.u_min)
        before = np.full(1, u_prev[i])
        return rise - np.concatenate([before, rise[:-1]]), fall - np.concatenate([before, fall[:-1]])

    def _distance_slack_m(self, x: Array | None) -> float:
        """Return the largest slack of a half-space [m] in a solution."""
        return 0.0 if x is None else float(x[self._moves + len(self._terminals) :].max()) * _SLACK_SCALE_M

    def _soften(self, q: Array, which: NDArray[np.intp]) -> None:
        """Replace terminal conditions `which` by `gap + slack >= 0` and `gap - slack <= 0` with free slacks.

        The multipliers that balance the slope g of the cost along the rows R, (R R')^-1 R g, scale the weights that
        make the penalties exact.
        """
        hc = self.horizon.control
        for i, own in self._terminals_of.items():
            block = self._a_dense[self._row_terminal + 2 * own, i * hc : (i + 1) * hc]  # (own, Hc)
            multiplier = np.abs(np.linalg.lstsq(block.T, q[i * hc : (i + 1) * hc], rcond=1e-9)[0])
            q[self._moves + own] = self._q_soft[own] + self._penalties.over_terminal * multiplier * _SLACK_SCALE_M
        rows = self._row_terminal + 2 * which
        self._upper[rows], self._lower[rows + 1] = INFINITY, -INFINITY
        self._upper[self._row_soft + which] = INFINITY

    def _fill_half_spaces(
        self,
        phi_pos: Array,
        phi_vel: Array,
        u_prev: Array,
        free_pos: Array,
        free_vel: Array,
        spaces: HalfSpaces | None,
    ) -> None:
        """Fill the rows of half-spaces; without any they are disabled."""
        hc, checks = self.horizon.control, len(self._row_scale)
        self._lower[self._row_half :] = -INFINITY
        if spaces is None or len(spaces.normal) == 0:
            return
        used = len(spaces.normal)
        normal = np.concatenate([spaces.normal[:, self._checked], spaces.normal[:, -1:]], axis=1)
        offset = np.concatenate([spaces.offset_m[:, self._checked], spaces.stop_offset_m[:, None]], axis=1)
        free = np.empty((used, checks, len(self.axes)))
        free[:, :-1] = free_pos[self._checked]
        free[:, -1] = free_pos[-1] + spaces.stop_s[:, None] * free_vel[-1]
        rows = slice(self._row_half, self._row_half + used * checks)
        block = self._a_dense[rows].reshape(used, checks, self._columns)
        reach = np.zeros((used, checks))  # largest value of each row that the bounded increments allow
        for i, axis in enumerate(self.axes):
            push = np.empty((used, checks, hc))  # metres of each row per unit increment
            push[:, :-1] = phi_pos[i, self._checked]
            push[:, -1] = phi_pos[i, -1] + spaces.stop_s[:, None] * phi_vel[i, -1]
            push *= normal[:, :, i, None]
            block[:, :, i * hc : (i + 1) * hc] = (axis.du_max * self._row_scale)[None, :, None] * push
            rise, fall = self._extremes(i, u_prev)
            reach += np.maximum(push @ rise, push @ fall)
        wanted = offset - np.einsum("ska,ska->sk", normal, free)
        lower = np.minimum(wanted, self._relax_01 * reach) * self._row_scale
        self._lower[rows] = np.where(np.isfinite(offset), lower, -INFINITY).ravel()

    def _inputs(self, x: Array | None, u_prev: Array) -> Array:
        """Return inputs (Hc, axes) of a solution, clipped to all bounds; without one the held input."""
        hc, n = self.horizon.control, len(self.axes)
        if x is None:
            return np.tile(u_prev, (hc, 1))
        wanted = x[: self._moves].reshape(n, hc).T * self._du_max
        wanted = np.minimum(np.maximum(wanted, -self._du_max), self._du_max)
        return np.asarray(np.minimum(np.maximum(u_prev + np.cumsum(wanted, axis=0), self._u_min), self._u_max))

    def _violations(self, x: Array | None, moves: Array) -> tuple[float, float, float]:
        """Return the largest slack, half-space violation and terminal gap [m] of the clipped increments."""
        if x is None:
            return 0.0, np.inf, np.inf
        soft = len(self._terminals)
        flown = np.concatenate([(moves / self._du_max).T.ravel(), x[self._moves :]])
        slack = flown[self._moves + soft :] * _SLACK_SCALE_M
        rows = self._a_dense[self._row_terminal : self._row_half : 2, : self._moves]
        gap = np.abs(rows @ flown[: self._moves] - self._end_wanted)
        shortfall = self._lower[self._row_half :] - self._a_dense[self._row_half :] @ flown
        shortfall = shortfall / np.tile(self._row_scale, self.max_keep_outs)
        return float(slack.max(initial=0.0)), float(shortfall.max(initial=0.0)), float(gap.max(initial=0.0))
