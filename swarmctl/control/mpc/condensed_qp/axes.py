"""Inputs and outputs of a condensed MPC problem: axes, horizon, penalties, half-spaces, solution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.lag import Lag
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array

Terminal = Literal["none", "position", "position_velocity", "region"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """Holds weights and bounds of one axis (thesis Tables 9, 10, 17, 21)."""

    q_pos: float
    q_vel: float
    r: float
    u_min: float
    u_max: float
    du_max: float
    u_rest: float  # input that holds the vehicle still
    gain_m_s2: float  # nominal acceleration of a unit input; scales cost and terminal region
    terminal: Terminal
    proximal: float = 0.0  # weight of what increments differ by from those planned before
    lag: Lag | None = None  # lag from input to acceleration; None for none

    @property
    def u_scale(self) -> float:
        """Return the largest magnitude of the input."""
        return max(abs(self.u_min), abs(self.u_max))


@dataclass(frozen=True, slots=True, kw_only=True)
class Horizon:
    """Holds lengths and sample time of the prediction, and computes motion under drag over it: p'' = a - drag p'."""

    control: int
    prediction: int
    dt_s: float
    euler: bool  # forward Euler as in the thesis (3.6), otherwise exact for a held input
    drag_1_s: float = 0.0
    spread: bool = False  # increments over the whole horizon, farther and farther apart; else at its first steps

    def starts(self) -> NDArray[np.intp]:
        """Return the steps (Hc,) over which an input begins to act: move blocking (Cagienard et al. 2007).

        Those that are spread grow with the square of their number: near ones are as close as steps allow, and the last
        ones far enough apart to reach the end.
        """
        moves = np.arange(self.control)
        if not self.spread:
            return moves
        return np.maximum(moves, np.rint(self.prediction * (moves / self.control) ** 2).astype(np.intp))

    def blocks(self) -> Array:
        """Return over how many steps (Hc,) an increment may be made: those from the one before on, 1 for the first."""
        return np.diff(self.starts(), prepend=-1).astype(float)

    def t_s(self) -> Array:
        """Return times (Hp,) [s] of steps 1..Hp."""
        return np.asarray(self.dt_s * np.arange(1, self.prediction + 1), np.float64)

    def held(self) -> Array:
        """Return inputs (Hp, Hc) over each step, due to a unit increment at each control step."""
        return np.asarray(np.arange(self.prediction)[:, None] >= self.starts(), np.float64)

    def of_velocity_s(self) -> tuple[Array, Array]:
        """Return displacement (Hp,) [s] and velocity (Hp,) [1] at steps 1..Hp, due to a unit velocity at the start."""
        t_s, drag = self.t_s(), self.drag_1_s
        if drag == 0.0:
            return t_s, np.ones(self.prediction)
        left = np.exp(-drag * t_s)
        return (1.0 - left) / drag, left

    def of_acceleration(self) -> tuple[Array, Array]:
        """Return displacement [s2] and velocity [s] (Hp, Hp) at steps 1..Hp, due to unit accelerations over steps."""
        dt_s, drag = self.dt_s, self.drag_1_s
        steps = np.arange(1, self.prediction + 1)
        since = steps[:, None] - steps[None, :]  # steps since the one in which an acceleration acted
        acted = since >= 0
        if drag == 0.0:
            own = 0.0 if self.euler else 0.5
            return dt_s**2 * np.where(acted, since + own, 0.0), np.where(acted, dt_s, 0.0)
        gained = -math.expm1(-drag * dt_s) / drag  # velocity at the end of its own step
        left = np.exp(-drag * dt_s * np.maximum(since, 0))
        own = 0.0 if self.euler else (dt_s - gained) / drag
        return np.where(acted, own + gained * (1.0 - left) / drag, 0.0), np.where(acted, gained * left, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Penalties:
    """Holds exact (linear) and quadratic weights of softened constraints.

    A linear penalty is exact when it exceeds the multiplier of the hard constraint, that is the slope of the tracking
    cost along the constraint; so the slack's weight follows that slope.
    """

    floor: float = 50.0  # per metre, added to `over` times the slope of the tracking cost
    over: float = 3.0
    over_terminal: float = 100.0  # with active bounds these multipliers are far larger than the slope
    slack_quadratic: float = 20000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HalfSpaces:
    """Holds rows `normal[s, k] . p_k >= offset[s, k]` for keep-outs s and steps k = 1..Hp; offset -inf disables a row.

    Only steps 0.08 s apart become rows, from the first one that increments can change: the certificate checks true
    distances in between. One more row for each keep-out looks beyond the horizon, so that there is room left to stop:
    `normal[s, -1] . (p_Hp + stop_s[s] v_Hp) >= stop_offset_m[s]`.
    """

    normal: Array  # (keep-outs, Hp, axes)
    offset_m: Array  # (keep-outs, Hp)
    stop_s: Array  # (keep-outs,)
    stop_offset_m: Array  # (keep-outs,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Faces:
    """Holds faces that do not move: `normal . p >= offset`, with room to stop before them."""

    normals: Array  # (faces, axes) of unit length, pointing inside
    offsets_m: Array  # (faces,)
    brakes_m_s2: Array  # (faces,) braking that room is left for


@dataclass(frozen=True, slots=True, kw_only=True)
class AxesProblem:
    """Holds the data of one receding-horizon step: initial state, gains, drift and reference."""

    pos_m: Array  # (axes,)
    vel_m_s: Array  # (axes,)
    u_prev: Array  # (axes,) input held now
    gain_m_s2: Array  # (Hp, axes) acceleration of a unit input over each step, sign included
    drift_m_s2: Array  # (axes,) acceleration without input
    ref_pos_m: Array  # (Hp, axes) at steps 1..Hp
    ref_vel_m_s: Array  # (Hp, axes)
    realised: Array | None = None  # (axes,) input realised at the start, of axes with a lag; None for the held one
    realised_1_s: Array | None = None  # (axes,) rate of `realised`; None for 0
    before: Array | None = None  # (axes, Hc) scaled increments planned before, to change little; None for none


@dataclass(frozen=True, slots=True, kw_only=True)
class AxesSolution:
    """Holds the predicted motion of the axes; with `solved` False it is the free response.

    Increments and inputs are within their bounds exactly, and `residual_m` is the largest violation of a half-space
    that remains. An unfinished iterate counts as solved: its residual decides.
    """

    solved: bool
    status: str
    iterations: int
    u: Array  # (Hp, axes), held over each step
    increments: Array  # (axes, Hc), scaled to [-1, 1]
    pos_m: Array  # (Hp, axes), steps 1..Hp
    vel_m_s: Array  # (Hp, axes)
    slack_m: float
    residual_m: float
    terminal_gap_m: float
    solve_us: float  # inside the QP solver


def faces_along(volume: FlightVolume | None, axes: slice) -> Faces | None:
    """Return those faces of a volume that limit positions along `axes` of NED, as plans keep them; None without any."""
    if volume is None:
        return None
    normals = volume.normals_ned[:, axes]
    limits = normals.any(axis=1)
    return Faces(normals=normals[limits], offsets_m=volume.planned_m[limits], brakes_m_s2=volume.brakes_m_s2[limits])
