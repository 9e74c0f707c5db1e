"""The trajectory of least snap through points at given times, from rest to rest (Mellinger and Kumar, 2011).

The integral of the squared fourth derivative is least, under equality constraints only, exactly for a spline of degree
7 whose derivatives up to the sixth are continuous at the points: a square system of linear equations. Stretching time
by k divides speed by k and acceleration by k^2 and keeps the path, so that limits are met by one stretch.
"""

from __future__ import annotations

import math

import numpy as np

from swarmctl.control.reference.polynomial import PiecewisePolynomial
from swarmctl.core.types import Array

_TERMS = 8  # of a segment: degree 7
_CONTINUOUS = 6  # derivatives continuous at an inner point
_AT_REST = 3  # derivatives that are zero at both ends
_SAMPLES = 40  # of a segment, at which speed and acceleration are measured
_FACTORIALS = np.array([math.factorial(k) for k in range(_TERMS)], dtype=np.float64)


def minimum_snap(times_s: Array, points: Array) -> PiecewisePolynomial:
    """Return the trajectory through points (P, D) at increasing times (P,), P >= 2.

    Solved in each segment's own time s = 0..1, in which the equations are well conditioned: a derivative of order d by
    s is that by t times T^d.
    """
    spans_s = np.diff(times_s)
    segments, matrix, right = len(spans_s), [], []
    nothing = np.zeros(points.shape[1])

    def add(value: Array, *terms: tuple[int, Array]) -> None:
        row = np.zeros((segments, _TERMS))
        for segment, coefficients in terms:
            row[segment] = coefficients
        matrix.append(row.ravel())
        right.append(value)

    for i in range(segments):
        add(points[i], (i, _derivative(0, 0.0)))
        add(points[i + 1], (i, _derivative(0, 1.0)))
    for d in range(1, _AT_REST + 1):
        add(nothing, (0, _derivative(d, 0.0)))
        add(nothing, (segments - 1, _derivative(d, 1.0)))
    for i in range(1, segments):
        pace = spans_s[i - 1] / spans_s[i]
        for d in range(1, _CONTINUOUS + 1):
            add(nothing, (i - 1, _derivative(d, 1.0)), (i, -(pace**d) * _derivative(d, 0.0)))
    solved = np.linalg.solve(np.array(matrix), np.array(right)).reshape(segments, _TERMS, -1)
    by_time = spans_s[:, None] ** -np.arange(_TERMS)  # (segments, terms)
    return PiecewisePolynomial(knots_s=times_s, coefficients=solved * by_time[:, :, None])


def fastest_minimum_snap(points: Array, speed_m_s: float, accel_m_s2: float) -> PiecewisePolynomial:
    """Return the trajectory through points (P, D) at times of its own, as fast as speed and acceleration allow.

    A segment is given the time that flying it from rest to rest would take at the limits, between the pace of a long
    segment and that of a short one; then all times are stretched or shortened by the factor that the limits allow.
    """
    lengths_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    spans_s = lengths_m / speed_m_s + np.sqrt(lengths_m / accel_m_s2)
    times_s = np.concatenate([[0.0], np.cumsum(spans_s)])
    flight = minimum_snap(times_s, points)
    return stretched(flight, stretch(flight, speed_m_s, accel_m_s2))


def stretch(flight: PiecewisePolynomial, speed_m_s: float, accel_m_s2: float) -> float:
    """Return the factor by which all times have to be multiplied so that the faster of both limits is just met."""
    fractions = np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)
    t_s = (flight.knots_s[:-1, None] + np.diff(flight.knots_s)[:, None] * fractions).ravel()
    slope = PiecewisePolynomial(knots_s=flight.knots_s, coefficients=_slope(flight.coefficients))
    speed = np.linalg.norm(flight.sample(t_s)[1], axis=1).max()
    accel = np.linalg.norm(slope.sample(t_s)[1], axis=1).max()
    return max(float(speed) / speed_m_s, math.sqrt(float(accel) / accel_m_s2))


def stretched(flight: PiecewisePolynomial, factor: float) -> PiecewisePolynomial:
    """Return the same path with all times multiplied by `factor`."""
    powers = factor ** -np.arange(flight.coefficients.shape[1], dtype=np.float64)
    return PiecewisePolynomial(
        knots_s=flight.knots_s * factor, coefficients=flight.coefficients * powers[None, :, None]
    )


def _slope(coefficients: Array) -> Array:
    """Return the coefficients (S, K-1, D) of the derivative of (S, K, D)."""
    return coefficients[:, 1:] * np.arange(1, coefficients.shape[1])[None, :, None]


def _derivative(order: int, s: float) -> Array:
    """Return the coefficients (terms,) of the derivative of an order at s in [0, 1]."""
    row = np.zeros(_TERMS)
    powers = np.arange(order, _TERMS)
    row[order:] = _FACTORIALS[powers] / _FACTORIALS[powers - order] * s ** (powers - order)
    return row
