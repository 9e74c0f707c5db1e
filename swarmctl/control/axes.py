"""What a condensed MPC problem consists of and what comes back: axes, horizon, penalties, half-spaces, solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from swarmctl.core.types import Array

Terminal = Literal["none", "position", "position_velocity", "region"]


@dataclass(frozen=True, slots=True)
class Axis:
    """Weights and bounds of one axis (thesis Tables 9, 10, 17, 21)."""

    q_pos: float
    q_vel: float
    r: float
    u_min: float
    u_max: float
    du_max: float
    u_rest: float  # input that holds still
    gain_m_s2: float  # nominal acceleration of a unit input; scales cost and terminal region
    terminal: Terminal

    @property
    def u_scale(self) -> float:
        """Largest magnitude of the input."""
        return max(abs(self.u_min), abs(self.u_max))


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
    over_terminal: float = 100.0  # bounds that are active as well make these multipliers far larger than the slope
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
    solve_us: float  # inside the QP solver
