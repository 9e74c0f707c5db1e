"""Identifies dead time, attitude lag, drag and hover thrust of a vehicle from a recorded flight, with intervals.

Attitude: the response of dead time and `swarmctl.control.lag` to the setpoints sent is fitted to the measured tilt,
both axes with one set of parameters. Translation: the equation of motion is integrated against smooth windows, so that
positions need not be differentiated and the reported velocity, which is biased, is not used:

    p'' = -k g u d + drag (wind - v) + g   gives   int w'' p = -k int w g u d + drag (wind int w + int w' p) + g int w

with thrust setpoint u, measured body down axis d and k = 1 / hover thrust. The vertical axis gives k, the horizontal
ones drag and the mean wind. Residuals are correlated in time: intervals come from their sums over blocks (a sandwich
estimator) and Student's t, and hold for what the model describes, not for what it leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.lag import Lag
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array, Phase

_GRID_S = 0.004
_SETTLE_S = 1.0  # initial time left out, in which the initial state of the fitted lag decays
_GAP_S = 0.1  # longest time between setpoints; after a longer one the autopilot flew
_MIN_DURATION_S = 10.0
_MIN_TILT_RMS = 0.03  # below, the estimator's own errors are a large part of the tilt
_BLOCK_S = 2.0  # residuals farther apart are taken to be independent
_WINDOW_S = 1.5
_THRUST_DELAYS_S = np.arange(0.0, 0.21, 0.01)
_CONFIDENCE = 0.95
_ITERATIONS = 30
_INITIAL_PARAMETERS = (0.06, 10.0, 1.0)  # delay, natural frequency, damping
_LOWER_BOUNDS = (0.0, 1.0, 0.3)
_UPPER_BOUNDS = (0.5, 60.0, 3.0)
_MAX_MISFIT_01 = 0.3  # rms residual over rms tilt; above it a second-order lag does not describe the vehicle


@dataclass(frozen=True, slots=True)
class Figure:
    """An estimate and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ({self.low:.4g} to {self.high:.4g})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """Identified parameters of one vehicle."""

    delay_s: Figure
    attitude_rad_s: Figure
    attitude_damping: Figure
    drag_1_s: Figure
    hover_thrust_01: Figure

    def model(self, before: VehicleModelParams) -> VehicleModelParams:
        """Return `before` with these values; its bounds stay."""
        figures = {name: float(f"{getattr(self, name).value:.3g}") for name in self.__slots__}
        return VehicleModelParams.model_validate({**before.model_dump(), **figures})


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSegment:
    """Setpoints sent and states measured, each at its own times [s] from a common zero."""

    sent_s: Array  # (T,)
    sent_down: Array  # (T, 2) horizontal part of the commanded body down axis
    sent_thrust_01: Array  # (T,)
    seen_s: Array  # (S,)
    seen_down: Array  # (S, 3) body down axis, NED
    seen_pos_ned_m: Array  # (S, 3)


def longest_segment(ticks: NDArray[np.void]) -> FlightSegment | str:
    """Return the longest part of a flight that was flown by setpoints without a gap, or why there is none.

    Args:
        ticks: (T,) rows of `TICK_DTYPE`.
    """
    ours = (ticks["phase"] >= Phase.GOTO_START) & (ticks["phase"] <= Phase.GOTO_LAND)
    ours &= np.isfinite(ticks["setpoint_thrust_01"]) & np.isfinite(ticks["state_age_ms"])
    rows = ticks[ours]
    if not len(rows):
        return "no setpoints were flown"
    t_s = (rows["t_us"] - rows["t_us"][0]) * 1e-6
    starts = np.concatenate([[0], np.flatnonzero(np.diff(t_s) > _GAP_S) + 1, [len(rows)]])
    longest = int(np.argmax(t_s[starts[1:] - 1] - t_s[starts[:-1]]))
    part = slice(starts[longest], starts[longest + 1])
    rows, t_s = rows[part], t_s[part] - t_s[part][0]
    if t_s[-1] < _MIN_DURATION_S:
        return f"setpoints were flown for {t_s[-1]:.1f} s at a stretch; {_MIN_DURATION_S:.0f} s are needed"
    seen_s = t_s - rows["state_age_ms"].astype(np.float64) * 1e-3
    new = np.diff(seen_s, prepend=-math.inf) > 1e-3
    sent_down = _down(rows["setpoint_q_nb"].astype(np.float64))[:, :2]
    if float(np.sqrt(np.mean(np.var(sent_down, axis=0)))) < _MIN_TILT_RMS:
        return "it hardly tilted: nothing can be told from this flight"
    return FlightSegment(
        sent_s=t_s,
        sent_down=sent_down,
        sent_thrust_01=rows["setpoint_thrust_01"].astype(np.float64),
        seen_s=seen_s[new],
        seen_down=_down(rows["q_nb"][new].astype(np.float64)),
        seen_pos_ned_m=np.array(rows["pos_ned_m"][new]),
    )


def identify(flight: FlightSegment) -> Identified | str:
    """Fit all parameters; returns the reason in words if that is impossible."""
    attitude = _fit_attitude(flight)
    if isinstance(attitude, str):
        return attitude
    delay, natural, damping = attitude
    inverse_hover, thrust_01, pos, down = _fit_vertical(flight)
    hover = Figure(*(1.0 / k for k in (inverse_hover.value, inverse_hover.high, inverse_hover.low)))
    drag = _fit_drag(thrust_01, pos, down, inverse_hover.value)
    found = Identified(
        delay_s=delay, attitude_rad_s=natural, attitude_damping=damping, drag_1_s=drag, hover_thrust_01=hover
    )
    if not all(math.isfinite(f.low) and math.isfinite(f.high) for f in (*attitude, drag, hover)):
        return "the flight is too short for intervals"
    if not 0.05 < hover.value < 0.95:
        return f"a hover thrust of {hover.value:.2f} of full can't be: is the thrust setpoint a thrust?"
    return found


# -- attitude ---------------------------------------------------------------------------------------------------------


def _fit_attitude(flight: FlightSegment) -> tuple[Figure, Figure, Figure] | str:
    """Fit dead time, natural frequency and damping; a constant offset per axis absorbs errors of the level attitude."""
    used = flight.seen_s > _SETTLE_S
    at_s, measured = flight.seen_s[used], flight.seen_down[used, :2]

    def residuals(parameters: Array) -> Array:
        delay_s, natural_rad_s, damping = (float(p) for p in parameters[:3])
        followed = _followed(flight, delay_s, natural_rad_s, damping, at_s=at_s)
        return np.asarray(followed + parameters[3:] - measured)  # (S, 2)

    least, most = np.array([*_LOWER_BOUNDS, -1.0, -1.0]), np.array([*_UPPER_BOUNDS, 1.0, 1.0])
    best = _least_squares(residuals, np.array([*_INITIAL_PARAMETERS, 0.0, 0.0]), least, most)
    misfit = float(np.sqrt(np.mean(residuals(best) ** 2)))
    if misfit > _MAX_MISFIT_01 * float(np.sqrt(np.mean(np.var(measured, axis=0)))):
        return f"its attitude does not follow setpoints as a second-order lag: off by {misfit:.3f} rad rms"
    blocks = (at_s / _BLOCK_S).astype(int)
    wide = _half_widths(_jacobian(residuals, best), residuals(best), blocks)
    values = zip(best[:3], wide[:3], _LOWER_BOUNDS, strict=True)
    delay, natural, damping = (Figure(float(b), float(max(b - w, lo)), float(b + w)) for b, w, lo in values)
    return delay, natural, damping


def _followed(flight: FlightSegment, delay_s: float, natural_rad_s: float, damping: float, *, at_s: Array) -> Array:
    """Return the tilt (S, 2) at times `at_s` (S,) of a vehicle with these parameters."""
    from scipy.signal import lfilter  # slow to import, and not needed to fly

    grid_s = np.arange(flight.sent_s[0], flight.sent_s[-1] + _GRID_S, _GRID_S)
    command = _held_mean(flight.sent_s, flight.sent_down, grid_s - delay_s)
    lag = Lag(natural_rad_s, damping)
    (a, b, _), (c, d, _), (e, f, _) = (
        lag.advance(*start, _GRID_S) for start in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    denominator = [1.0, -(a + d), a * d - b * c]  # transfer function of x' = [[a, c], [b, d]] x + [e, f] u to x_1, tilt
    numerator = [0.0, e, c * f - d * e]
    tilt = command[0] + lfilter(numerator, denominator, command - command[0], axis=0)
    return np.column_stack([np.interp(at_s, grid_s, tilt[:, i]) for i in range(2)])


def _held_mean(sent_s: Array, sent: Array, from_s: Array) -> Array:
    """Return means (G, k), over one grid step from `from_s` (G,) on, of commands (T, k) held until the next one."""
    ends_s = np.append(sent_s, sent_s[-1] + 10.0)
    area = np.concatenate([np.zeros((1, sent.shape[1])), np.cumsum(sent * np.diff(ends_s)[:, None], axis=0)])
    before = np.minimum(from_s - sent_s[0], 0.0)[:, None] * sent[0]
    until = np.minimum(from_s + _GRID_S - sent_s[0], 0.0)[:, None] * sent[0]

    def integral(at_s: Array) -> Array:
        return np.column_stack([np.interp(at_s, ends_s, area[:, i]) for i in range(sent.shape[1])])

    return np.asarray((integral(from_s + _GRID_S) + until - integral(from_s) - before) / _GRID_S)


# -- translation ------------------------------------------------------------------------------------------------------


def _on_grid(flight: FlightSegment, delay_s: float) -> tuple[Array, Array, Array]:
    """Return acting thrust (G,), position (G, 3) and body down axis (G, 3) on one time grid."""
    grid_s = np.arange(flight.seen_s[0] + _SETTLE_S, flight.seen_s[-1], _GRID_S)
    pos = np.column_stack([np.interp(grid_s, flight.seen_s, flight.seen_pos_ned_m[:, i]) for i in range(3)])
    down = np.column_stack([np.interp(grid_s, flight.seen_s, flight.seen_down[:, i]) for i in range(3)])
    held = np.searchsorted(flight.sent_s, grid_s - delay_s, side="right") - 1
    return flight.sent_thrust_01[np.maximum(held, 0)], pos, down


def _fit_vertical(flight: FlightSegment) -> tuple[Figure, Array, Array, Array]:
    """Fit 1 / hover thrust and vertical drag, which is discarded; returns the former and the result of `_on_grid`.

    Thrust has a dead time of its own, motors included: the one with the smallest residual is taken.
    """
    motions = [_on_grid(flight, float(delay_s)) for delay_s in _THRUST_DELAYS_S]
    fits = [_vertical_rows(*motion) for motion in motions]
    missed = [left - rows @ np.linalg.lstsq(rows, left, rcond=None)[0] for rows, left, _ in fits]
    best = int(np.argmin([m @ m for m in missed]))
    rows, left, blocks = fits[best]
    return _regress(rows[:, None, :], left[:, None], blocks), *motions[best]


def _vertical_rows(thrust_01: Array, pos: Array, down: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    accel, drag, force, blocks = _windows(-GRAVITY_M_S2 * thrust_01 * down[:, 2], pos[:, 2])
    return np.column_stack([force, drag]), accel - GRAVITY_M_S2, blocks


def _fit_drag(thrust_01: Array, pos: Array, down: Array, inverse_hover: float) -> Figure:
    """Fit horizontal drag over mass, both axes together, with one constant per axis for drag times wind."""
    rows, left = [], []
    for i in range(2):
        accel, drag, force, blocks = _windows(-GRAVITY_M_S2 * thrust_01 * down[:, i], pos[:, i])
        wind = np.zeros((len(accel), 2))
        wind[:, i] = 1.0
        rows.append(np.column_stack([drag, wind]))
        left.append(accel - inverse_hover * force)
    return _regress(np.stack(rows, axis=1), np.column_stack(left), blocks)


def _windows(force: Array, pos: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return integrals over W overlapping windows of unit area: acceleration, minus velocity, force, and block number.

    Args:
        force: (G,) force along one axis, still to be divided by the hover thrust.
        pos: (G,) position on that axis.
    """
    count = round(_WINDOW_S / _GRID_S)
    s = (np.arange(count) + 0.5) / count
    weight = s**4 * (1.0 - s) ** 4
    slope = 4.0 * s**3 * (1.0 - s) ** 3 * (1.0 - 2.0 * s) / _WINDOW_S
    curve = (12.0 * s**2 * (1.0 - s) ** 2 * (1.0 - 2.0 * s) ** 2 - 8.0 * s**3 * (1.0 - s) ** 3) / _WINDOW_S**2
    area = float(np.sum(weight))
    first = np.arange(0, len(pos) - count, count // 6)
    over = first[:, None] + np.arange(count)
    near = pos[over] - pos[first][:, None]  # slope and curve integrate to zero, so the shift only reduces rounding
    blocks = (first * _GRID_S / _BLOCK_S).astype(np.int64)
    return near @ curve / area, near @ slope / area, force[over] @ weight / area, blocks


# -- least squares ----------------------------------------------------------------------------------------------------


def _regress(rows: Array, left: Array, blocks: NDArray[np.int64]) -> Figure:
    """Return the first coefficient of a linear least-squares fit; rows (W, axes, p), left sides (W, axes)."""
    flat = rows.reshape(-1, rows.shape[2])
    best = np.linalg.lstsq(flat, left.reshape(-1), rcond=None)[0]
    wide = _half_widths(rows, rows @ best - left, blocks)
    return Figure(float(best[0]), float(best[0] - wide[0]), float(best[0] + wide[0]))


def _half_widths(jacobian: Array, residuals: Array, blocks: NDArray[np.int64]) -> Array:
    """Return half widths (p,) of the intervals from jacobian (S, axes, p), residuals (S, axes) and blocks (S,)."""
    from scipy.special import stdtrit  # slow to import, and not needed to fly

    scores = np.einsum("sap,sa->sp", jacobian, residuals)
    names = np.unique(blocks)
    count, unknowns = len(names), jacobian.shape[2]
    if count <= unknowns:
        return np.full(unknowns, math.inf)
    sums = np.stack([scores[blocks == name].sum(axis=0) for name in names])
    flat = jacobian.reshape(-1, unknowns)
    bread = np.linalg.pinv(flat.T @ flat)
    covariance = bread @ (sums.T @ sums) @ bread * count / (count - unknowns)
    factor = stdtrit(count - unknowns, 0.5 + 0.5 * _CONFIDENCE)
    return np.asarray(factor * np.sqrt(np.diag(covariance)))


def _least_squares(residuals: Callable[[Array], Array], first: Array, least: Array, most: Array) -> Array:
    """Minimise the sum of squares by Levenberg-Marquardt; steps are clipped to the bounds. All vectors are (p,)."""
    best, damping = first, 1e-3
    cost = float(np.sum(residuals(best) ** 2))
    for _ in range(_ITERATIONS):
        jacobian = _jacobian(residuals, best).reshape(-1, len(best))
        slope, curve = jacobian.T @ residuals(best).reshape(-1), jacobian.T @ jacobian
        step = np.linalg.solve(curve + damping * np.diag(np.diag(curve) + 1e-12), -slope)
        tried = np.clip(best + step, least, most)
        tried_cost = float(np.sum(residuals(tried) ** 2))
        if tried_cost >= cost:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        done = cost - tried_cost < 1e-9 * cost
        best, cost, damping = tried, tried_cost, 0.3 * damping
        if done:
            break
    return best


def _jacobian(residuals: Callable[[Array], Array], at: Array) -> Array:
    """Return the Jacobian (S, axes, p) by central differences at `at` (p,)."""
    columns = []
    for i, value in enumerate(at):
        step = np.zeros(len(at))
        step[i] = 1e-4 * max(abs(float(value)), 0.05)
        columns.append((residuals(at + step) - residuals(at - step)) / (2.0 * step[i]))
    return np.stack(columns, axis=2)


def _down(q_nb: Array) -> Array:
    """Return body down axes (T, 3), NED, of attitudes (T, 4) wxyz."""
    w, x, y, z = q_nb.T
    return np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
