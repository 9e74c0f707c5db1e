"""The terminal region of the MPC, in place of a terminal equality (thesis 5.2 leaves it open).

The error to the reference is e = (position, velocity, acceleration); the increment d of the acceleration is the input.
With the input held over a step,

    e+ = A e + B d,   A = [1 h h^2/2; 0 1 h; 0 0 1],   B = [h^2/2, h, 1]',

and the stage cost e' Q e + r_a d^2, Q = diag(q_pos, q_vel, 0), r_a = r / g^2, is the MPC's own in units of
acceleration. Let P be the solution of the discrete algebraic Riccati equation and K its gain. Then V(e) = e' P e is the
cost of flying d = -K e for ever, and V(e+) - V(e) = -(e' Q e + r_a d^2) <= 0, so that every set {V <= alpha} is
invariant under it. The terminal region is the largest such set in which that law keeps the bounds:

    max |K e| over V <= alpha is sqrt(alpha K P^-1 K')  <= the largest increment of the acceleration,
    max |e_a| over V <= alpha is sqrt(alpha (P^-1)_aa)  <= the largest acceleration.

The MPC's sum counts the stage cost of its last predicted state already, so P - Q is what it adds there. With as many
free increments as steps and an end inside the region, its cost is then that of the infinite horizon: the MPC is the
unconstrained optimal regulator, its optimal cost falls every step by at least the stage cost, and no equality has to be
met (Mayne, Rawlings, Rao and Scokaert 2000, conditions A1 to A4). With fewer increments (3 of 40) this holds except for
what the missing ones would gain. A plan that ends outside is flown all the same, and its distance is reported. A steady
disturbance shifts the acceleration and reduces the bounds by as much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.core.types import Array

_DOUBLINGS = 60  # far more steps than a plan's horizon has; some ten are enough
_RICCATI_TOLERANCE = 1e-15


@dataclass(frozen=True, slots=True, kw_only=True)
class TerminalRegion:
    """Describes the set {e: e' P e <= alpha} of errors e = (position [m], velocity [m/s], acceleration [m/s2])."""

    cost_to_go: Array  # (3, 3) P
    beyond: Array  # (3, 3) P - Q: V of the end without its stage cost, which the sum contains
    gain: Array  # (3,) K
    level: float  # alpha

    def outside_m(self, error: Array) -> float:
        """Return how far `error` (3,) is outside, as the position error [m] of the same cost; 0 inside."""
        value = max(0.0, float(error @ self.cost_to_go @ error))
        return max(0.0, math.sqrt(value) - math.sqrt(self.level)) / math.sqrt(float(self.cost_to_go[0, 0]))


def transition(dt_s: float) -> tuple[Array, Array]:
    """Return A (3, 3) and B (3, 1) of the error model above."""
    half = 0.5 * dt_s * dt_s
    a = np.array([[1.0, dt_s, half], [0.0, 1.0, dt_s], [0.0, 0.0, 1.0]])
    return a, np.array([[half], [dt_s], [1.0]])


def riccati_solution(a: Array, b: Array, q: Array, r: float) -> Array:
    """Return the stabilising solution P (n, n) of P = A'PA - A'PB (r + B'PB)^-1 B'PA + Q, one input.

    By the structure-preserving doubling algorithm (Chu, Fan, Lin and Wang 2004), whose k-th iterate is the cost of 2^k
    steps: a few products of small matrices, where SciPy's solver is 7 MB and 0.15 s of import in every agent.

    Args:
        a, b: (n, n) and (n, 1), stabilisable.
        q: (n, n) positive semidefinite, detectable with `a`.
        r: weight of the input, > 0.
    """
    eye = np.eye(len(a))
    a, g, p = a, b @ b.T / r, q
    for _ in range(_DOUBLINGS):
        w = np.linalg.solve(eye + g @ p, np.hstack([a, g]))
        w_a, w_g = w[:, : len(a)], w[:, len(a) :]
        a, g, p, before = a @ w_a, g + a @ w_g @ a.T, p + a.T @ p @ w_a, p
        if np.abs(p - before).max() <= _RICCATI_TOLERANCE * np.abs(p).max():
            break
    return 0.5 * (p + p.T)


def terminal_region(
    q_pos: float, q_vel: float, r: float, accel_max_m_s2: float, *, daccel_max_m_s2: float, dt_s: float
) -> TerminalRegion:
    """Return the terminal region of one axis.

    Args:
        q_pos, q_vel: stage weights, `q_pos` > 0.
        r: weight of the increment of the acceleration.
        accel_max_m_s2: largest acceleration error the bounds allow around the reference's.
        daccel_max_m_s2: largest increment of the acceleration per step.
        dt_s: step.
    """
    a, b = transition(dt_s)
    p = riccati_solution(a, b, np.diag([q_pos, q_vel, 0.0]), r)
    gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0]
    inverse = np.linalg.inv(p)
    level = min(daccel_max_m_s2**2 / float(gain @ inverse @ gain), accel_max_m_s2**2 / float(inverse[2, 2]))
    return TerminalRegion(cost_to_go=p, beyond=p - np.diag([q_pos, q_vel, 0.0]), gain=gain, level=level)
