"""Cubic Bezier curves. Control points are (4, 3); the parameter t runs from 0 to 1."""

import numpy as np

LENGTH_SEGMENTS = 99  # EMAP measures a curve by the chords between 100 points uniform in t


def bernstein(parameters):
    """(n,) parameters -> (n, 4) cubic Bernstein weights."""
    t = np.asarray(parameters, dtype=np.float64)
    s = 1.0 - t
    return np.stack([s**3, 3 * s**2 * t, 3 * s * t**2, t**3], axis=-1)


def evaluate_bezier(control_points, parameters):
    """(..., 4, 3) control points at (n,) parameters -> (..., n, 3) points."""
    return bernstein(parameters) @ control_points


def bezier_derivative(control_points, parameters):
    """(4, 3) control points at (n,) parameters -> (n, 3) derivatives with respect to t."""
    t = np.asarray(parameters, dtype=np.float64)
    s = 1.0 - t
    weights = np.stack([3 * s**2, 6 * s * t, 3 * t**2], axis=-1)
    return weights @ np.diff(control_points, axis=0)


def bezier_lengths(curves):
    """(C, 4, 3) control points -> (C,) lengths, measured along LENGTH_SEGMENTS chords."""
    points = evaluate_bezier(np.asarray(curves).reshape(-1, 4, 3), np.linspace(0.0, 1.0, LENGTH_SEGMENTS + 1))
    return np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)


def split_bezier(control_points, parameter):
    """De Casteljau: one (4, 3) cubic -> two (4, 3) cubics that meet at `parameter`."""
    points = np.asarray(control_points, dtype=np.float64)
    left, right = [points[0]], [points[-1]]
    while len(points) > 1:
        points = points[:-1] + parameter * np.diff(points, axis=0)
        left.append(points[0])
        right.append(points[-1])
    return np.array(left), np.array(right[::-1])
