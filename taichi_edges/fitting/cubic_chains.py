"""Smooth chains of cubic Beziers through ordered points, by robust least squares (paper 3.3)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.robust import geman_mcclure
from taichi_edges.geometry.bezier import bernstein, evaluate_bezier

ROUNDS = 3  # of the fit, in which places on the chain and weights settle
MEDIANS = 4.0  # of the distances, that the tolerance of the robust weights is at least
SLIDING = 0.01  # weight of residuals along a chain: between its ends, points may lie anywhere along it
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
    """`fit_curve` with a given number of pieces.

    Where along it a point belongs is not known, so what counts is its distance across the chain (Wang, Pottmann, Liu
    2006, tangent distance minimization): moving the parameters alone takes a hundred rounds for what these do.
    """
    parameters = ordering.arc / ordering.length * pieces
    curves = lsq_chain(parameters, points, np.ones(len(points)), pieces, ordering.closed)
    for _ in range(ROUNDS):
        distances, nearest = nearest_on_chain(points, curves)
        width = max(tolerance, MEDIANS * float(np.median(distances)))  # strays are few; of a first fit all may be off
        weights = geman_mcclure((distances / width) ** 2)
        parameters = _whole_range(nearest, parameters, pieces, ordering.closed)
        along = tangents_of_chain(curves, parameters)
        if not ordering.closed:  # nothing but its outermost points says where a chain ends
            ends = [parameters.argmin(), parameters.argmax()]
            along[ends], weights[ends] = 0.0, 1.0
        curves = lsq_chain(parameters, points, weights, pieces, ordering.closed, along)
    distances, _ = nearest_on_chain(points, curves)
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


def lsq_chain(
    parameters: np.ndarray,
    points: np.ndarray,
    weights: np.ndarray,
    pieces: int,
    closed: bool = False,
    along: np.ndarray | None = None,
) -> np.ndarray:
    """Weighted least-squares chain of cubics with a continuous tangent; piece i has the parameters i .. i + 1.

    With equal spans a joint is the middle of the two control points next to it, so the unknowns are the polygon of the
    inner control points, and the ends of an open chain: the coefficients of a cubic B-spline with double knots. A faint
    penalty on the bending of that polygon carries the chain over pieces without points. along: (n, 3) unit vectors in
    which residuals hardly count, for the parameters are no more than a guess; 0 where they count. Returns
    (pieces, 4, 3).
    """
    size = 2 * pieces if closed else 2 * pieces + 2
    local = np.tile([[0.5, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.5, 0.5]], (pieces, 1, 1))
    if not closed:
        local[0, 0], local[-1, 3] = (1, 0, 0, 0), (0, 0, 0, 1)
    unknowns = (2 * np.arange(pieces)[:, None] + np.arange(4)) % size
    controls = np.zeros((pieces, 4, size))  # control points from unknowns
    np.add.at(controls, (np.arange(pieces)[:, None, None], np.arange(4)[:, None], unknowns[:, None]), local)
    piece = np.clip(parameters.astype(int), 0, pieces - 1)
    design = np.einsum("nb,nbu->nu", bernstein(np.clip(parameters - piece, 0.0, 1.0)), controls[piece])
    around = np.eye(size)[np.arange(size + 2) % size] if closed else np.eye(size)
    bend = np.diff(around, 2, axis=0) * BENDING * np.sqrt(weights.sum())
    # Normal equations: a B-spline's are well conditioned, and small whatever the number of points.
    weighted = weights[:, None] * design
    normal, right = weighted.T @ design + bend.T @ bend, weighted.T @ points
    if along is None:
        return controls @ np.linalg.solve(normal, right)
    lengthwise = (design[:, :, None] * along[:, None, :]).reshape(len(points), 3 * size)
    weighted = (1.0 - SLIDING) * weights[:, None] * lengthwise
    normal = np.kron(normal, np.eye(3)) - weighted.T @ lengthwise
    right = right.ravel() - weighted.T @ (points * along).sum(axis=1)
    polygon = np.linalg.solve(normal, right).reshape(size, 3)
    return controls @ polygon


def tangents_of_chain(curves: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """(n, 3) unit tangents of a chain of cubics at (n,) parameters (piece + t)."""
    piece = np.clip(parameters.astype(int), 0, len(curves) - 1)
    t, legs = (parameters - piece)[:, None], np.diff(curves[piece], axis=1)
    along = (1 - t) ** 2 * legs[:, 0] + 2 * t * (1 - t) * legs[:, 1] + t**2 * legs[:, 2]
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)


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


def _whole_range(nearest: np.ndarray, before: np.ndarray, pieces: int, closed: bool) -> np.ndarray:
    """(n,) parameters of the nearest places on a chain; the ends of an open chain keep the whole range in use.

    before: (n,) those of the round before.
    """
    if closed:  # a nearest sample on the other side of the joint is the same place, one period on
        return np.clip(nearest + np.round((before - nearest) / pieces) * pieces, 0.0, pieces)
    return (nearest - nearest.min()) / max(np.ptp(nearest), 1e-300) * pieces


@dataclass(frozen=True)
class Ordering:
    """arc: (n,) arc length of each point. length: of the whole edge. closed: does it end where it starts?"""

    arc: np.ndarray
    length: float
    closed: bool
