"""Cubic Bezier curves. Control points are (4, 3); the parameter t runs from 0 to 1."""

import numpy as np
from numpy.typing import ArrayLike

LENGTH_SEGMENTS = 99  # EMAP measures a curve by the chords between 100 points uniform in t


def bernstein(parameters: ArrayLike) -> np.ndarray:
    """(n,) parameters -> (n, 4) cubic Bernstein weights."""
    t = np.asarray(parameters, dtype=np.float64)
    s = 1.0 - t
    return np.stack([s**3, 3 * s**2 * t, 3 * s * t**2, t**3], axis=-1)


def evaluate_bezier(control_points: np.ndarray, parameters: ArrayLike) -> np.ndarray:
    """(..., 4, 3) control points at (n,) parameters -> (..., n, 3) points."""
    return bernstein(parameters) @ control_points


def bezier_lengths(curves: ArrayLike) -> np.ndarray:
    """(C, 4, 3) control points -> (C,) lengths, measured along LENGTH_SEGMENTS chords."""
    points = evaluate_bezier(np.asarray(curves).reshape(-1, 4, 3), np.linspace(0.0, 1.0, LENGTH_SEGMENTS + 1))
    return np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
