"""Piecewise polynomials of time, as which tables and minimum-snap flights are sampled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarmctl.core.types import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class PiecewisePolynomial:
    """A polynomial for each segment of time; it stays where it begins before its start and where it ends after its end.

    In segment i the value is the sum over k of `coefficients[i, k] (t - knots_s[i])^k`.
    """

    knots_s: Array  # (S+1,) increasing
    coefficients: Array  # (S, K, D)

    @property
    def end_s(self) -> float:
        """Return the time from which the value stays."""
        return float(self.knots_s[-1])

    def sample(self, t_s: Array) -> tuple[Array, Array]:
        """Return values and derivatives (M, D) at times (M,)."""
        inside_s = np.clip(t_s, self.knots_s[0], self.knots_s[-1])
        segment = np.clip(np.searchsorted(self.knots_s, inside_s, side="right") - 1, 0, len(self.coefficients) - 1)
        tau = (inside_s - self.knots_s[segment])[:, None]
        terms = self.coefficients[segment]  # (M, K, D)
        value, rate = np.zeros((len(t_s), terms.shape[2])), np.zeros((len(t_s), terms.shape[2]))
        for k in range(terms.shape[1] - 1, -1, -1):
            rate = rate * tau + value
            value = value * tau + terms[:, k]
        rate[(t_s < self.knots_s[0]) | (t_s > self.knots_s[-1])] = 0.0
        return value, rate


def through(knots_s: Array, values: Array, rates: Array | None, accels: Array | None) -> PiecewisePolynomial:
    """Return what meets values (S+1, D) at knots (S+1,), and their first and second derivatives where they are given.

    Without rates these are differences of the values. With rates alone the segments are cubic, with both quintic.
    """
    v = np.gradient(values, knots_s, axis=0, edge_order=2 if len(knots_s) > 2 else 1) if rates is None else rates
    t = np.diff(knots_s)[:, None]
    rise, v0, v1 = np.diff(values, axis=0), v[:-1], v[1:]
    if accels is None:
        terms = [values[:-1], v0, 3.0 * rise / t**2 - (2.0 * v0 + v1) / t, -2.0 * rise / t**3 + (v0 + v1) / t**2]
    else:
        a0, a1 = accels[:-1], accels[1:]
        terms = [
            values[:-1],
            v0,
            0.5 * a0,
            (20.0 * rise - (8.0 * v1 + 12.0 * v0) * t - (3.0 * a0 - a1) * t**2) / (2.0 * t**3),
            (-30.0 * rise + (14.0 * v1 + 16.0 * v0) * t + (3.0 * a0 - 2.0 * a1) * t**2) / (2.0 * t**4),
            (12.0 * rise - 6.0 * (v1 + v0) * t + (a1 - a0) * t**2) / (2.0 * t**5),
        ]
    return PiecewisePolynomial(knots_s=knots_s, coefficients=np.stack(terms, axis=1))
