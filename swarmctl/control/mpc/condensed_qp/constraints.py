"""The constraints of a condensed MPC, each a block of rows: bounds, softened ends, half-spaces, faces of a volume.

A new constraint is one class here and one line in `swarmctl.control.mpc.condensed_qp.condensed`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.condensed_qp.axes import Faces, Penalties
from swarmctl.control.mpc.condensed_qp.prediction import Forecast, Prediction
from swarmctl.control.mpc.condensed_qp.program import ConstraintBlock, Rows
from swarmctl.control.mpc.solvers.qp import INFINITY, QpSolution
from swarmctl.core.types import Array

_SLACK_SCALE_M = 0.1  # unit of slack variables, so that they are about 1 like all others
_REACHABLE_01 = 0.998  # share of the reachable displacement that replaces an end out of reach
_FACE_SPACING_S = 0.2  # between the rows of a face: a path can't bend much in between
_USUAL_S = 1.0  # time that braking takes, for the scale of its rows
_ASKED_01 = 0.97  # share of the reachable displacement that a face may ask for: with 0.9 plans put braking off
_TANGENT_GAP_M = 0.05  # missed between tangents of the way to stop: less than a certificate allows
_TANGENTS = np.array([-1.5, -0.5, 0.5, 1.5, 2.5])  # where they touch, in spacings from the present speed
_TERMINAL_CURVATURE = 1e-3  # keeps the Hessian positive definite; the exact penalty is the slope


class IncrementBounds(ConstraintBlock):
    """Bounds every scaled increment by -1 and 1."""

    def __init__(self, prediction: Prediction) -> None:
        super().__init__(np.eye(len(prediction.axes) * prediction.horizon.control, dtype=bool))

    def prepare(self, rows: Rows) -> None:
        rows.moves[:] = np.eye(len(rows.moves))
        rows.lower[:], rows.upper[:] = -1.0, 1.0

    def fill(self, rows: Rows, forecast: Forecast) -> None:
        return


class InputBounds(ConstraintBlock):
    """Bounds every input, the held one plus the increments up to its step, in units of the largest input."""

    def __init__(self, prediction: Prediction) -> None:
        self._prediction = prediction
        self._bounds = [  # by axis: its rows, bounds and unit
            (prediction.columns(i), axis.u_min, axis.u_max, axis.u_scale) for i, axis in enumerate(prediction.axes)
        ]
        super().__init__(np.kron(np.eye(len(prediction.axes)), np.tri(prediction.horizon.control)).astype(bool))

    def prepare(self, rows: Rows) -> None:
        for i, (axis, du_max) in enumerate(zip(self._prediction.axes, self._prediction.du_max, strict=True)):
            own = self._prediction.columns(i)
            rows.moves[own, own] = np.tri(len(du_max)) * du_max / axis.u_scale

    def fill(self, rows: Rows, forecast: Forecast) -> None:
        for (own, u_min, u_max, u_scale), held in zip(self._bounds, forecast.u_prev.tolist(), strict=True):
            rows.lower[own], rows.upper[own] = (u_min - held) / u_scale, (u_max - held) / u_scale


class TerminalConditions(ConstraintBlock):
    """Asks for the reference's position, or position and velocity, at the end of the horizon.

    Conditions are equalities `gap = 0` with two rows and a slack each, which is fixed at 0 until they are softened.
    """

    def __init__(self, prediction: Prediction, penalties: Penalties, cost_scale: float) -> None:
        self._prediction, self._over = prediction, penalties.over_terminal
        self._slope_floor = penalties.floor * _SLACK_SCALE_M * cost_scale
        ends = [a.terminal for a in prediction.axes]
        self._ends = [(i, "pos") for i, end in enumerate(ends) if end in ("position", "position_velocity")]
        self._ends += [(i, "vel") for i, end in enumerate(ends) if end == "position_velocity"]
        self.every = np.arange(len(self._ends))  # conditions
        self.velocities = np.array([j for j, (_, what) in enumerate(self._ends) if what == "vel"], dtype=int)
        self._of_axis = {
            i: np.array([j for j, (k, _) in enumerate(self._ends) if k == i])
            for i in sorted({i for i, _ in self._ends})
        }
        uses = np.zeros((2 * len(self._ends), len(ends) * prediction.horizon.control), bool)
        for j, (i, _) in enumerate(self._ends):
            uses[2 * j : 2 * j + 2, prediction.columns(i)] = True
        slacks = np.kron(np.eye(len(self._ends)), np.array([[_SLACK_SCALE_M], [-_SLACK_SCALE_M]]))
        super().__init__(uses, slacks, _TERMINAL_CURVATURE)

    def fill(self, rows: Rows, forecast: Forecast) -> None:
        """Write equalities; an end that bounded increments can't reach is replaced by the farthest that they can."""
        out_of_reach, extremes = set[int](), self._prediction.extremes(forecast.u_prev)
        for j, (i, what) in enumerate(self._ends):
            response = (forecast.pos_response if what == "pos" else forecast.vel_response)[i, -1]
            both = slice(2 * j, 2 * j + 2)
            rows.moves[both, self._prediction.columns(i)] = self._prediction.du_max[i] * response
            asked = self._wanted(j, forecast)
            least, most = sorted(float(response @ increments) for increments in extremes[:, i])
            rows.lower[both], rows.upper[both] = -INFINITY, INFINITY
            if i in out_of_reach:
                continue  # its end velocity then does not matter
            if not least <= asked <= most:
                out_of_reach.add(i)
                asked = _REACHABLE_01 * (most if asked > most else least)
            rows.lower[both] = rows.upper[both] = asked
        rows.slack_max[:], rows.slack_slope[:] = 0.0, self._slope_floor

    def _wanted(self, j: int, forecast: Forecast) -> float:
        """Return by how much increments have to move the end of a condition."""
        i, what = self._ends[j]
        return float(-forecast.error[0 if what == "pos" else 1, -1, i])

    def soften(self, rows: Rows, which: NDArray[np.intp]) -> None:
        """Replace conditions `which` by `gap + slack >= 0` and `gap - slack <= 0` with free slacks.

        The multipliers that balance the slope g of the cost along the rows R, (R R')^-1 R g, scale the weights that
        make the penalties exact.
        """
        for i, own in self._of_axis.items():
            columns = self._prediction.columns(i)
            along = rows.moves[2 * own, columns]  # (own, Hc)
            multiplier = np.abs(np.linalg.lstsq(along.T, rows.slope[columns], rcond=1e-9)[0])
            rows.slack_slope[own] = self._slope_floor + self._over * multiplier * _SLACK_SCALE_M
        rows.upper[2 * which], rows.lower[2 * which + 1] = INFINITY, -INFINITY
        rows.slack_max[which] = INFINITY

    def give_up(self, rows: Rows) -> None:
        """Soften all conditions at no cost."""
        self.soften(rows, self.every)
        rows.slack_slope[:] = 0.0

    def gap(self, rows: Rows, forecast: Forecast, flown: Array) -> float:
        """Return the largest gap [m or m/s] that the variables `flown` (columns,) leave."""
        if not self._ends:
            return 0.0
        wanted = np.array([self._wanted(j, forecast) for j in range(len(self._ends))])
        moved = rows.moves[::2] @ flown[: rows.moves.shape[1]]
        return float(np.abs(moved - wanted).max(initial=0.0))


class KeepOutHalfSpaces(ConstraintBlock):
    """Keeps positions within half-spaces `n . p_k >= b_k`, softened by one slack for each keep-out.

    Args:
        prediction: the motion.
        max_keep_outs: largest number of half-space families (neighbours and obstacles).
        relax_01: rows ask for at most this share of what the bounded increments can reach, so that rows inside the
            dead time are never infeasible and never push agents away (1 asks for all).
        penalties, cost_scale: weights of slacks.
    """

    def __init__(
        self, prediction: Prediction, max_keep_outs: int, relax_01: float, penalties: Penalties, *, cost_scale: float
    ) -> None:
        self._prediction, self._relax_01 = prediction, relax_01
        self._over, self._slope_floor = penalties.over, penalties.floor * _SLACK_SCALE_M * cost_scale
        axes, self._steps = prediction.axes, prediction.row_steps
        step_m_s2 = max(a.du_max * a.gain_m_s2 for a in axes)
        response = (prediction.pos_of_accel @ prediction.acted[0])[prediction.checked].max(axis=1) * step_m_s2
        response = np.append(response, response[-1])  # the stopping row
        self._row_scale = 1.0 / np.maximum(response, 0.01)  # rows of about unit size suit a first-order solver
        self._scale = np.tile(self._row_scale, max_keep_outs)  # of all rows
        self._unit = prediction.du_max[:, None, None] * self._row_scale[:, None]  # (axes, 1, checks, Hc)
        uses = np.ones((max_keep_outs * len(response), len(axes) * prediction.horizon.control), bool)
        slacks = np.kron(np.eye(max_keep_outs), (_SLACK_SCALE_M * self._row_scale)[:, None])
        curvature = 2 * penalties.slack_quadratic * _SLACK_SCALE_M**2 * cost_scale
        super().__init__(uses, slacks, curvature)

    def fill(self, rows: Rows, forecast: Forecast) -> None:
        """Write the rows of half-spaces; without any they are disabled."""
        rows.lower[:] = -INFINITY
        steepest = max(map(abs, rows.slope.tolist())) * self._row_scale[-1]  # per metre of the last row
        rows.slack_slope[:] = self._slope_floor + self._over * steepest * _SLACK_SCALE_M
        spaces = forecast.half_spaces
        if spaces is None or len(spaces.normal) == 0:
            return
        normal = spaces.normal.take(self._steps, axis=1)  # (used, checks, axes) of checked steps and the stopping row
        offset = spaces.offset_m.take(self._steps, axis=1)
        offset[:, -1] = spaces.stop_offset_m
        free = np.empty(normal.shape)
        free[:] = forecast.free[0].take(self._steps, axis=0)
        free[:, -1] += spaces.stop_s[:, None] * forecast.free[1, -1]
        wanted = offset - np.einsum("ska,ska->sk", normal, free)
        reach = self._fill_coefficients(rows, forecast, spaces.stop_s, normal)
        lower = np.minimum(wanted, self._relax_01 * reach) * self._row_scale
        rows.lower[: offset.size] = np.maximum(lower, -INFINITY).ravel()

    def _fill_coefficients(self, rows: Rows, forecast: Forecast, stop_s: Array, normal: Array) -> Array:
        """Write coefficients, and return the largest value [m] (used, checks) that bounded increments allow."""
        used, checks, axes = normal.shape
        push = np.empty((axes, used, checks, self._prediction.horizon.control))  # metres of a row per unit increment
        push[:] = forecast.response[0].take(self._steps, axis=1)[:, None]
        push[:, :, -1] += stop_s[:, None] * forecast.response[1, :, None, -1]
        push *= normal.transpose(2, 0, 1)[..., None]
        block = rows.moves[: used * checks].reshape(used, checks, axes, -1)  # a view
        np.multiply(self._unit, push, out=block.transpose(2, 0, 1, 3))
        extremes = self._prediction.extremes(forecast.u_prev)
        reached = (push @ extremes[:, :, None, :, None])[..., 0]  # (2, axes, used, checks)
        return np.asarray(np.add.reduce(np.maximum(reached[0], reached[1])))

    def residual_m(self, rows: Rows, flown: Array) -> float:
        shortfall = rows.lower - rows.coefficients @ flown
        return float((shortfall / self._scale).max(initial=0.0))


class VolumeFaces(ConstraintBlock):
    """Keeps positions inside of faces `n . p_k >= b`, with room to stop before them, softened by one slack each.

    From the end of the horizon, at speed v towards a face, braking with a takes v^2 / 2a. That is convex, so that its
    tangents bound it from below: rows `n . p_N - (w / a) v <= ...` at speeds w around the present one, so close that
    between them less than `_TANGENT_GAP_M` is missed.

    Args:
        prediction: the motion.
        faces: n, b and a of each.
        penalties, cost_scale: weights of slacks.
    """

    def __init__(
        self,
        prediction: Prediction,
        faces: Faces,
        penalties: Penalties,
        *,
        cost_scale: float,
    ) -> None:
        self._prediction, self._faces = prediction, faces
        self._over, self._slope_floor = penalties.over, penalties.floor * _SLACK_SCALE_M * cost_scale
        axes, first, last = prediction.axes, prediction.first_row(), prediction.horizon.prediction - 1
        stride = max(1, round(_FACE_SPACING_S / prediction.horizon.dt_s))
        positions, soon = np.arange(last, first - 1, -stride)[::-1], min(first + stride, last)
        self._steps = np.concatenate([positions, np.repeat([soon, last], len(_TANGENTS))])  # of the rows of a face
        self._stops = slice(len(positions), len(self._steps))  # rows with room to stop behind their step
        step_m_s2 = max(a.du_max * a.gain_m_s2 for a in axes)
        usual_s = np.zeros(len(self._steps))
        usual_s[self._stops] = _USUAL_S
        response = (prediction.pos_of_accel @ prediction.acted[0])[self._steps].max(axis=1)
        response += usual_s * (prediction.vel_of_accel @ prediction.acted[0])[self._steps].max(axis=1)
        self._scale = 1.0 / np.maximum(response * step_m_s2, 0.01)  # (rows of a face,) as in `KeepOutHalfSpaces`
        self._unit = prediction.du_max[:, None, None] * self._scale[:, None]  # (axes, 1, checks, Hc)
        self._normals = faces.normals.T[:, :, None, None]  # (axes, faces, 1, 1)
        self._steepest = float(self._scale[len(positions) - 1])  # increments per metre of the last position
        uses = np.repeat(np.repeat(faces.normals != 0.0, len(self._steps), axis=0), prediction.horizon.control, axis=1)
        slacks = np.kron(np.eye(len(faces.normals)), (_SLACK_SCALE_M * self._scale)[:, None])
        super().__init__(uses, slacks, 2 * penalties.slack_quadratic * _SLACK_SCALE_M**2 * cost_scale)

    def fill(self, rows: Rows, forecast: Forecast) -> None:
        """Write the rows; those that no increments in bounds can violate are disabled."""
        normals, brakes_m_s2 = self._faces.normals, self._faces.brakes_m_s2[:, None]
        speeds = np.maximum(-(normals @ forecast.asked.vel_m_s), 0.0)  # towards each face
        spacing = 2.0 * np.sqrt(2.0 * brakes_m_s2 * _TANGENT_GAP_M)
        ahead_s = np.zeros((len(speeds), len(self._steps)))
        tangents = np.tile(np.maximum(speeds[:, None] + spacing * _TANGENTS, 0.0), 2)
        ahead_s[:, self._stops] = tangents / brakes_m_s2
        pos_m = forecast.free_pos_m[self._steps] @ normals.T  # (rows of a face, faces)
        vel_m_s = forecast.free_vel_m_s[self._steps] @ normals.T
        wanted = self._faces.offsets_m[:, None] - (pos_m.T + ahead_s * vel_m_s.T) - 0.5 * brakes_m_s2 * ahead_s**2
        least, most = self._fill_coefficients(rows, forecast, ahead_s)
        lower = np.where(wanted > least, np.minimum(wanted, _ASKED_01 * most) * self._scale, -INFINITY)
        rows.lower[:] = lower.ravel()
        steepest = max(map(abs, rows.slope.tolist())) * self._steepest
        rows.slack_slope[:] = self._slope_floor + self._over * steepest * _SLACK_SCALE_M

    def _fill_coefficients(self, rows: Rows, forecast: Forecast, ahead_s: Array) -> tuple[Array, Array]:
        """Write coefficients, and return the least and the largest value [m] (faces, rows) that bounds allow."""
        faces, checks = ahead_s.shape
        pos, vel = forecast.response.take(self._steps, axis=2)[:, :, None]  # (axes, 1, checks, Hc) each
        push = (pos + ahead_s[:, :, None] * vel) * self._normals  # (axes, faces, checks, Hc) metres per unit increment
        block = rows.moves.reshape(faces, checks, len(push), -1)  # a view
        np.multiply(self._unit, push, out=block.transpose(2, 0, 1, 3))
        extremes = self._prediction.extremes(forecast.u_prev)
        reached = (push @ extremes[:, :, None, :, None])[..., 0]  # (2, axes, faces, checks)
        least, most = np.minimum(reached[0], reached[1]), np.maximum(reached[0], reached[1])
        return np.asarray(np.add.reduce(least)), np.asarray(np.add.reduce(most))

    def residual_m(self, rows: Rows, flown: Array) -> float:
        shortfall = (rows.lower - rows.coefficients @ flown).reshape(-1, len(self._scale))
        return float((shortfall / self._scale).max(initial=0.0))


def slack_m(rows: Rows, solution: QpSolution) -> float:
    """Return the largest slack [m] of a block in a solution, 0 without one."""
    if solution.x is None or not len(rows.slack_slope):
        return 0.0
    return max(0.0, float(solution.x[rows.slack_columns].max())) * _SLACK_SCALE_M
