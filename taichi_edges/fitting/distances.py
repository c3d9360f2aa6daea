"""Distances of points to the shapes of edges, their ends included, and to each other."""

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.fitting.cubic_chains import nearest_on_chain
from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline


def distances_to(shape: Shape, points: np.ndarray) -> np.ndarray:
    """(n,) distances of points to a shape, ends included."""
    if isinstance(shape, Spline):
        return nearest_on_chain(points, shape.curves)[0]
    if isinstance(shape, Line):
        along = shape.points[1] - shape.points[0]
        share = np.clip((points - shape.points[0]) @ along / max(along @ along, 1e-300), 0, 1)
        return np.linalg.norm(points - shape.at(share), axis=1)
    return _distances_to_ellipse(shape, points)


def _distances_to_ellipse(shape: EllipticArc, points: np.ndarray) -> np.ndarray:
    """(n,) distances of points to an EllipticArc: exact for a circle, by Newton's steps on the angle for an ellipse.

    Of a point farther from an elliptic arc than its least radius of curvature, too great if the nearest place of the
    whole ellipse is not on the arc.
    """
    offsets = points - shape.centre
    x, y = (offsets @ axis / radius for axis, radius in zip(shape.axes, shape.radii, strict=True))
    t = np.arctan2(y / shape.radii[1], x / shape.radii[0]) if shape.circular else np.arctan2(y, x)
    a, b = shape.radii
    for _ in range(0 if shape.circular else 12):  # of flat ellipses, near the evolute, the first ones are short
        cosine, sine = np.cos(t), np.sin(t)
        slope = (a * a - b * b) * sine * cosine - a * x * sine + b * y * cosine
        bend = (a * a - b * b) * (cosine**2 - sine**2) - a * x * cosine - b * y * sine
        t = t - np.where(np.abs(bend) > 1e-12, slope / np.minimum(bend, -1e-12), 0.0).clip(-0.3, 0.3)
    middle = 0.5 * (shape.low + shape.high)
    t = middle + (t - middle + np.pi) % (2 * np.pi) - np.pi
    t = np.clip(t, shape.low, shape.high)
    return np.linalg.norm(points - shape.at((t - shape.low) / (shape.high - shape.low)), axis=1)


def pairs_within(places: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """(k, 2) pairs, in order, of (n, 3) places no farther apart than the mean of their (n,) reaches."""
    pairs = cKDTree(places).query_pairs(reaches.max(initial=0.0), output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    return pairs[apart <= reaches[pairs].mean(axis=1)]


def unit(vector: np.ndarray) -> np.ndarray:
    """A vector of length 1."""
    return vector / max(np.sqrt(vector @ vector), 1e-300)
