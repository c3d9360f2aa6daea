"""One parametric edge for each cluster: a line segment, or a smooth chain of cubic Bezier curves (paper 3.3)."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.bezier import bernstein, evaluate_bezier
from taichi_edges.edges.ordering import order_points
from taichi_edges.shapes import EllipticArc, Line, Spline
from taichi_edges.wireframe import Wireframe

ROBUST_ROUNDS = 10
REPARAMETRIZATIONS = 4
TURN_PER_CUBIC = np.radians(100.0)  # one cubic follows a circular arc of 90 degrees to 3e-4 of the radius
POINTS_PER_PIECE = 6  # at least
WORTH_A_PIECE = 0.8  # another piece must bring the error down to this share, and again for every doubling of pieces
FAR_OFF = 3.0  # noise floors
LEAPS = (2, 3)  # times as many pieces, tried where one more does not pay and the chain is far off
NOISE_FLOOR = 3.5e-4  # unit-cube units; a mean distance below is no reason for a curve or for another piece
LINE_PARAMETERS = 4  # of a line in space
END_QUANTILE = 0.01  # of the points along a line: its ends, so that one stray point does not lengthen it
BENDING = 1e-3  # penalty on second differences of the control points, relative to the data
CURVE_SAMPLES = 128  # for each cubic, where distances to a curve are measured


@dataclass(frozen=True)
class Fit:
    """What became of one cluster: a shape of kind 'line', 'curve' or 'loop' (closed); 'short' or 'degenerate': None."""

    kind: str
    shape: Line | EllipticArc | Spline | None = None


def wireframe_of(fits):
    """The loose Wireframe of some Fits, and the dict kind -> how many there are."""
    fits = list(fits)
    counts = dict.fromkeys(("line", "curve", "loop", "short", "degenerate"), 0) | Counter(fit.kind for fit in fits)
    return Wireframe.loose([fit.shape for fit in fits if fit.shape is not None]), counts


def fit_cluster(points, config):
    """Fit (n, 3) points: the curve is kept when its error e_c <= delta * e_l, the line's (paper 3.3).

    Errors are mean distances, corrected for the parameters (`corrected_error`): a curve through few points is close to
    them whatever they are.
    """
    if len(points) == 0 or not np.ptp(points, axis=0).any():
        return Fit("degenerate")
    line, line_error = fit_line(points, config.line_tolerance)
    if len(points) >= 4:
        ordering = order_points(points)
        curves, curve_error = fit_curve(points, ordering, config.line_tolerance)
        long_enough = np.linalg.norm(np.diff(evaluate_bezier(curves, [0, 0.5, 1]), axis=1), axis=2).sum()
        if max(curve_error, NOISE_FLOOR) <= config.delta * line_error and long_enough >= config.min_length:
            return Fit("loop" if ordering.closed else "curve", Spline(curves, ordering.closed))
    if np.linalg.norm(line[1] - line[0]) < config.min_length:
        return Fit("short")
    return Fit("line", Line(line))


def fit_line(points, tolerance):
    """Robust line segment through (n, 3) points: iteratively reweighted least squares (Geman-McClure).

    tolerance: distance at which a point's weight has fallen to a quarter.
    Returns end points (2, 3) and the corrected mean distance of all points to the line.
    """
    weights = np.ones(len(points))
    for _ in range(ROBUST_ROUNDS):
        centre = weights @ points / weights.sum()
        offsets = points - centre
        direction = np.linalg.svd(offsets * np.sqrt(weights)[:, None], full_matrices=False)[2][0]
        along = offsets @ direction
        distances = np.linalg.norm(offsets - along[:, None] * direction, axis=1)
        weights = 1.0 / (1.0 + (distances / tolerance) ** 2) ** 2
    inliers = along[weights >= 0.25] if (weights >= 0.25).sum() >= 2 else along
    ends = np.quantile(inliers, [END_QUANTILE, 1 - END_QUANTILE]) if len(inliers) > 2 else np.sort(inliers)
    if len(inliers) > 2:  # along an edge the points lie evenly: what the quantiles leave out at each end is known
        ends += np.array([-1, 1]) * np.ptp(ends) * END_QUANTILE / (1 - 2 * END_QUANTILE)
        ends = np.clip(ends, inliers.min(), inliers.max())
    return centre + ends[:, None] * direction, corrected_error(distances, LINE_PARAMETERS)


def corrected_error(distances, parameters):
    """Mean of (n,) distances to a fitted edge, as it would be without the fit's `parameters` adapting to the points.

    Across the edge n points give 2 n residuals; sqrt(2 n / (2 n - parameters)) undoes what the fit took away.
    """
    freedom = 2 * len(distances) - parameters
    return float(distances.mean() * np.sqrt(2 * len(distances) / freedom)) if freedom > 0 else float("inf")


def fit_curve(points, ordering, tolerance):
    """Chain of cubic Beziers through (n, 3) points by robust least squares over the arc-length parameter.

    The chain is a cubic spline with a continuous tangent, cut into its Bezier pieces; as many pieces as the points'
    total turning asks for, and more while that pays. Where one more does not, but the points are far off, twice and
    three times as many may, as on a rim of scallops or round the sharp ends of an ellipse. (Continuous curvature as
    well would need twice the pieces to follow a circle.)
    Returns control points (m, 4, 3) and the corrected mean distance of all points to the chain.
    """
    most = max(len(points) // POINTS_PER_PIECE, 1)
    pieces = min(fewest_cubics(points, ordering), most)
    curves, error = fit_chain(points, ordering, tolerance, pieces)
    tried = [pieces + 1, *(leap * pieces for leap in LEAPS)]
    while tried:
        count = tried.pop(0)
        more_than_one = count > pieces + 1
        if count > most or (more_than_one and error <= FAR_OFF * NOISE_FLOOR):
            continue
        more, smaller_error = fit_chain(points, ordering, tolerance, count)
        doublings = np.log2(count / pieces) if more_than_one else 1.0
        if max(smaller_error, NOISE_FLOOR) <= WORTH_A_PIECE**doublings * error:
            curves, error, pieces = more, smaller_error, count
            tried = [pieces + 1, *(leap * pieces for leap in LEAPS)]
    return curves, error


def fit_chain(points, ordering, tolerance, pieces):
    """`fit_curve` with a given number of pieces."""
    arc, length, closed = ordering.arc, ordering.length, ordering.closed
    weights = np.ones(len(points))
    for _ in range(REPARAMETRIZATIONS):
        curves = _fit_spline(points, arc / length, weights, pieces, closed)
        distances, parameters = nearest_on_chain(points, curves)
        arc = _reparametrize(arc, parameters, length, closed)
        weights = 1.0 / (1.0 + (distances / tolerance) ** 2) ** 2
    return curves, corrected_error(distances, 4 * (pieces + 1))  # two across each end of each piece, value and slope


def fewest_cubics(points, ordering):
    """As many cubics as the total turning of (n, 3) ordered points asks for."""
    turning = 2 * np.pi if ordering.closed else total_turning(points, ordering.arc)
    return max(int(np.ceil(turning / TURN_PER_CUBIC)), 4 if ordering.closed else 1)


def total_turning(points, arc):
    """Radians by which the tangent turns along ordered points, after averaging over a tenth of the length."""
    stations = np.linspace(arc.min(), arc.max(), 12)
    width = stations[1] - stations[0]
    kernel = np.exp(-0.5 * ((stations[:, None] - arc) / width) ** 2)
    centres = kernel @ points / kernel.sum(axis=1, keepdims=True)
    steps = np.diff(centres[1:-1], axis=0)
    steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-300)
    return float(np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1, 1)).sum() * 11 / 8)


def _fit_spline(points, parameters, weights, pieces, closed):
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


def lsq_chain(parameters, points, weights, pieces):
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


def nearest_on_chain(points, curves):
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


def _reparametrize(arc, parameters, length, closed):
    """Arc lengths moved to the nearest points of the chain; the ends of an open chain keep the whole range in use."""
    pieces = max(np.ceil(parameters.max()), 1.0)
    moved = parameters / pieces * length
    if closed:  # a nearest sample on the other side of the joint is the same place, one period on
        moved += np.round((arc - moved) / length) * length
        return np.clip(moved, 0.0, length)
    spread = moved.max() - moved.min()
    return (moved - moved.min()) / max(spread, 1e-300) * length
