"""Smooth chains of cubic Beziers through ordered points, by robust least squares (paper 3.3)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.robust import geman_mcclure
from taichi_edges.geometry.bezier import bernstein, evaluate_bezier

REPARAMETRIZATIONS = 4
TURN_PER_CUBIC = np.radians(100.0)  # one cubic follows a circular arc of 90 degrees to 3e-4 of the radius
BENDING = 1e-3  # penalty on second differences of the control points, relative to the data
CURVE_SAMPLES = 128  # for each cubic, where distances to a curve are measured


def corrected_error(distances: np.ndarray, parameters: int) -> float:
    """Mean of (n,) distances to a fitted edge, as it would be without the fit's `parameters` adapting to the points.

    Across the edge n points give 2 n residuals; sqrt(2 n / (2 n - parameters)) undoes what the fit took away.
    """
    freedom = 2 * len(distances) - parameters
    return float(distances.mean() * np.sqrt(2 * len(distances) / freedom)) if freedom > 0 else float("inf")


def fit_chain(points: np.ndarray, ordering: "Ordering", tolerance: float, pieces: int) -> tuple[np.ndarray, float]:
    """`fit_curve` with a given number of pieces."""
    arc, length, closed = ordering.arc, ordering.length, ordering.closed
    weights = np.ones(len(points))
    for _ in range(REPARAMETRIZATIONS):
        curves = _fit_spline(points, arc / length, weights, pieces, closed)
        distances, parameters = nearest_on_chain(points, curves)
        arc = _reparametrize(arc, parameters, length, closed)
        weights = geman_mcclure((distances / tolerance) ** 2)
    return curves, corrected_error(distances, 4 * (pieces + 1))  # two across each end of each piece, value and slope


def fewest_cubics(points: np.ndarray, ordering: "Ordering") -> int:
    """As many cubics as the total turning of (n, 3) ordered points asks for."""
    turning = 2 * np.pi if ordering.closed else total_turning(points, ordering.arc)
    return max(int(np.ceil(turning / TURN_PER_CUBIC)), 4 if ordering.closed else 1)


def total_turning(points: np.ndarray, arc: np.ndarray) -> float:
    """Radians by which the tangent turns along ordered points, after averaging over a tenth of the length."""
    stations = np.linspace(arc.min(), arc.max(), 12)
    width = stations[1] - stations[0]
    kernel = np.exp(-0.5 * ((stations[:, None] - arc) / width) ** 2)
    centres = kernel @ points / kernel.sum(axis=1, keepdims=True)
    steps = np.diff(centres[1:-1], axis=0)
    steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-300)
    return float(np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1, 1)).sum() * 11 / 8)


def _fit_spline(
    points: np.ndarray, parameters: np.ndarray, weights: np.ndarray, pieces: int, closed: bool
) -> np.ndarray:
    """Least-squares chain of cubics over parameters in 0..1, in `pieces` equal spans -> (pieces, 4, 3) Beziers."""
    if not closed:
        return lsq_chain(parameters * pieces, points, weights, pieces)
    # The data repeated on both sides make the middle period periodic.
    parameters = np.concatenate([parameters, parameters + 1, parameters + 2])
    chain = lsq_chain(parameters * pieces, np.tile(points, (3, 1)), np.tile(weights, 3), 3 * pieces)
    controls = chain[pieces : 2 * pieces].copy()
    joint = 0.5 * (controls[0, 0] + controls[-1, 3])
    controls[0, 0] = controls[-1, 3] = joint
    return controls


def lsq_chain(parameters: np.ndarray, points: np.ndarray, weights: np.ndarray, pieces: int) -> np.ndarray:
    """Weighted least-squares chain of cubics with a continuous tangent; piece i has the parameters i .. i + 1.

    With equal spans a joint is the middle of the two control points next to it, so the unknowns are the polygon of the
    inner control points and the chain's two ends: the coefficients of a cubic B-spline with double knots. A faint
    penalty on the bending of that polygon carries the chain over pieces without points. Returns (pieces, 4, 3).
    """
    local = np.tile([[0.5, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.5, 0.5]], (pieces, 1, 1))
    local[0, 0], local[-1, 3] = (1, 0, 0, 0), (0, 0, 0, 1)  # (pieces, 4, 4) control points from unknowns 2 i .. 2 i + 3
    unknowns = 2 * np.arange(pieces)[:, None] + np.arange(4)
    piece = np.clip(parameters.astype(int), 0, pieces - 1)
    design = np.zeros((len(points), 2 * pieces + 2))
    shares = np.einsum("nb,nbu->nu", bernstein(np.clip(parameters - piece, 0.0, 1.0)), local[piece])
    np.put_along_axis(design, unknowns[piece], shares, axis=1)
    rows = np.sqrt(weights)[:, None]
    bend = np.diff(np.eye(design.shape[1]), 2, axis=0) * BENDING * np.sqrt(weights.sum())
    targets = np.concatenate([points * rows, np.zeros((len(bend), 3))])
    # Normal equations: a B-spline's are well conditioned, and small whatever the number of points.
    system = np.concatenate([design * rows, bend])
    polygon = np.linalg.solve(system.T @ system, system.T @ targets)
    return local @ polygon[unknowns]


def nearest_on_chain(points: np.ndarray, curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) of points to a chain of cubics, and the chain parameters (piece + t) of the nearest places.

    The nearest place is looked for on the chords on both sides of the nearest of CURVE_SAMPLES samples of each cubic.
    """
    t = np.linspace(0.0, 1.0, CURVE_SAMPLES)
    samples = evaluate_bezier(curves, t).reshape(-1, 3)
    parameters = (np.arange(len(curves))[:, None] + t).ravel()
    nearest = cKDTree(samples).query(points)[1]
    first = np.stack([np.maximum(nearest - 1, 0), np.minimum(nearest, len(samples) - 2)])  # (2, n) chords
    start, chord = samples[first], samples[first + 1] - samples[first]
    squared = np.maximum((chord**2).sum(axis=2), 1e-300)  # 0 at the joints, where two samples coincide
    share = np.clip(((points - start) * chord).sum(axis=2) / squared, 0.0, 1.0)
    before, after = np.linalg.norm(start + share[:, :, None] * chord - points, axis=2)
    reached = parameters[first] + share * (parameters[first + 1] - parameters[first])
    return np.minimum(before, after), np.where(before < after, *reached)


def _reparametrize(arc: np.ndarray, parameters: np.ndarray, length: float, closed: bool) -> np.ndarray:
    """Arc lengths moved to the nearest points of the chain; the ends of an open chain keep the whole range in use."""
    pieces = max(np.ceil(parameters.max()), 1.0)
    moved = parameters / pieces * length
    if closed:  # a nearest sample on the other side of the joint is the same place, one period on
        moved += np.round((arc - moved) / length) * length
        return np.clip(moved, 0.0, length)
    spread = moved.max() - moved.min()
    return (moved - moved.min()) / max(spread, 1e-300) * length


@dataclass(frozen=True)
class Ordering:
    """arc: (n,) arc length of each point. length: of the whole edge. closed: does it end where it starts?"""

    arc: np.ndarray
    length: float
    closed: bool
