"""One parametric edge for each cluster: a line segment, or a smooth chain of cubic Bezier curves (paper 3.3)."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.robust import geman_mcclure
from taichi_edges.fitting.cubic_chains import Ordering, corrected_error, fewest_cubics, fit_chain
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.geometry.shapes import Line, Shape, Spline
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.strokes.ordering import order_points

if TYPE_CHECKING:
    from taichi_edges.scene.settings import FitConfig

ROBUST_ROUNDS = 10
POINTS_PER_PIECE = 6  # at least
WORTH_A_PIECE = 0.8  # another piece must bring the error down to this share, and again for every doubling of pieces
FAR_OFF = 3.0  # noise floors
LEAPS = (2, 3)  # times as many pieces, tried where one more does not pay and the chain is far off
NOISE_FLOOR = 3.5e-4  # unit-cube units; a mean distance below is no reason for a curve or for another piece
LINE_PARAMETERS = 4  # of a line in space
END_QUANTILE = 0.01  # of the points along a line: its ends, so that one stray point does not lengthen it


@dataclass(frozen=True)
class ClusterFit:
    """What became of one cluster: a shape of kind 'line', 'curve' or 'loop' (closed); 'short' or 'degenerate': None."""

    kind: str
    shape: Shape | None = None


def wireframe_of(fits: Iterable[ClusterFit]) -> tuple[Wireframe, dict[str, int]]:
    """The loose Wireframe of some ClusterFits, and the dict kind -> how many there are."""
    fits = list(fits)
    counts = dict.fromkeys(("line", "curve", "loop", "short", "degenerate"), 0) | Counter(fit.kind for fit in fits)
    return Wireframe.loose([fit.shape for fit in fits if fit.shape is not None]), counts


def fit_cluster(points: np.ndarray, config: "FitConfig") -> ClusterFit:
    """Fit (n, 3) points: the curve is kept when its error e_c <= delta * e_l, the line's (paper 3.3).

    Errors are mean distances, corrected for the parameters (`corrected_error`): a curve through few points is close to
    them whatever they are.
    """
    if len(points) == 0 or not np.ptp(points, axis=0).any():
        return ClusterFit("degenerate")
    line, line_error = fit_line(points, config.line_tolerance)
    if len(points) >= 4:
        ordering = order_points(points)
        curves, curve_error = fit_curve(points, ordering, config.line_tolerance)
        long_enough = np.linalg.norm(np.diff(evaluate_bezier(curves, [0, 0.5, 1]), axis=1), axis=2).sum()
        if max(curve_error, NOISE_FLOOR) <= config.delta * line_error and long_enough >= config.min_length:
            return ClusterFit("loop" if ordering.closed else "curve", Spline(curves, ordering.closed))
    if np.linalg.norm(line[1] - line[0]) < config.min_length:
        return ClusterFit("short")
    return ClusterFit("line", Line(line))


def fit_line(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, float]:
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
        weights = geman_mcclure((distances / tolerance) ** 2)
    inliers = along[weights >= 0.25] if (weights >= 0.25).sum() >= 2 else along
    ends = np.quantile(inliers, [END_QUANTILE, 1 - END_QUANTILE]) if len(inliers) > 2 else np.sort(inliers)
    if len(inliers) > 2:  # along an edge the points lie evenly: what the quantiles leave out at each end is known
        ends += np.array([-1, 1]) * np.ptp(ends) * END_QUANTILE / (1 - 2 * END_QUANTILE)
        ends = np.clip(ends, inliers.min(), inliers.max())
    return centre + ends[:, None] * direction, corrected_error(distances, LINE_PARAMETERS)


def fit_curve(points: np.ndarray, ordering: Ordering, tolerance: float) -> tuple[np.ndarray, float]:
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
