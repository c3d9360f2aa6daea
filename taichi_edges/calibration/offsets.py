"""Constant offsets of a detector's edgels, fitted to many observations robustly, with errors that can be believed."""

from dataclasses import dataclass

import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.robust import NORMAL_MAD, geman_mcclure

LEAST_OBSERVATIONS = 200  # fewer tell nothing
# px, median; where references agree with edgels no better, as on textured photographs or between thin bars, chance has
# made the pairs. The scale of a robust fit grows with what it is given, so its standard errors do not tell.
MOST_RESIDUAL = 0.35
NOTHING_KNOWN = 100.0  # px; prior standard deviation of an offset: one that nothing observes keeps it as its error
FREE_WAY = 10.0  # px; prior standard deviation of a point's displacement, far beyond what seeds are off
ABSOLUTE_ROUNDS, REDESCENDING_ROUNDS = 4, 8  # first least absolute values, from anywhere; then outliers drop out
LEAST_RESIDUAL = 0.1  # px; below, a residual is as good as none
CUT = 2.0  # standard deviations of the residuals at which the Geman-McClure weight has fallen to a quarter
# A point that is mostly on silhouettes would explain their offset, which is not quite the same all round, by moving;
# interior edgels, which have none, shall say where it is.
INTERIOR_WEIGHT = 3.0
MOST_STIFF = 3.0  # a fit with more has hardly an optimum
VIEW_BLOCKS, SPLITS = 10, 4  # views next to each other, and halves of halves of the points, that are left out together


@dataclass(frozen=True)
class Observations(Columns):
    """Edgels against where the edge should be: offset = b * silhouette + normal . shift + slope . displacement.

    offsets:    (m,) px, from the reference to the edgel along `normals`.
    normals:    (m, 2) unit vectors across the edge, of silhouettes outward.
    silhouette: (m,) float, 1 on silhouettes and 0 inside.
    edgels:     (m,) which edgel. views: (m,) in which view it is.
    owners:     (m,) which 3D point is the reference; None where the reference is exact.
    slopes:     (m, 2) px that the reference moves along the normal for each px of displacement of its point.
    """

    offsets: np.ndarray
    normals: np.ndarray
    silhouette: np.ndarray
    edgels: np.ndarray
    views: np.ndarray
    owners: np.ndarray | None = None
    slopes: np.ndarray | None = None

    @property
    def columns(self) -> np.ndarray:
        """(m, 3): what each observation sees of the outward offset and of the shift's two coordinates."""
        return np.column_stack([self.silhouette, self.normals])

    def moved_by(self, displacements: np.ndarray) -> np.ndarray:
        """(m,) px by which displacements (n, 2) px of the points move the references; 0 where those are exact."""
        if self.owners is None or self.slopes is None:
            return np.zeros(len(self))
        return (self.slopes * displacements[self.owners]).sum(axis=1)


@dataclass(frozen=True)
class OffsetFit:
    """What fits m observations best.

    values:        (3,) px: outward offset of silhouettes, shift in x and y.
    displacements: (n, 2) px, of the points; n is 0 where there are none.
    residuals:     (m,) px, offset - model.
    weights:       (m,) of the observations in the end; robust: (m,) 0..1, the part that their residuals have in them.
    matrix:        (3, 3) of the values' normal equations.
    """

    values: np.ndarray
    displacements: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    robust: np.ndarray
    matrix: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """values, errors: (3,) px, outward offset of silhouettes and shift, with standard errors. method: how found."""

    values: np.ndarray
    errors: np.ndarray
    method: str


def fit_offsets(observations: Observations, known: np.ndarray, count: int | None = None) -> OffsetFit:
    """The OffsetFit of observations. known: (3,) px values that are taken as they are, NaN where they are fitted.

    count: number of 3D points, the owners, where there are any; their displacements are fitted too.
    """
    weights = np.where((observations.silhouette > 0) | (count is None), 1.0, INTERIOR_WEIGHT)
    residuals = observations.offsets - np.median(observations.offsets)
    robust = _weights(residuals, redescending=False)
    for round_ in range(1, ABSOLUTE_ROUNDS + REDESCENDING_ROUNDS + 1):
        values, displacements, matrix = solve_offsets(observations, weights * robust, known, count)
        residuals = _residuals(observations, values, displacements)
        robust = _weights(residuals, redescending=round_ >= ABSOLUTE_ROUNDS)
    return OffsetFit(values, displacements, residuals, weights * robust, robust, matrix)


def standard_errors(
    observations: Observations, fit: OffsetFit, known: np.ndarray, points: np.ndarray | None = None
) -> np.ndarray:
    """(3,) px: standard errors of a fit's values, 0 where they are known. points: (n, 3) unit cube, the owners.

    Observations in one view, and those of points near each other, err alike; a plain standard error would count them
    as independent. So the values' spread is measured when blocks of views, and of points, are left out; the variances
    are added, which rather overestimates.
    """
    count = None if points is None else len(points)
    variances = np.average(fit.residuals**2, weights=fit.weights) * np.diag(np.linalg.inv(fit.matrix))
    views = np.unique(observations.views, return_inverse=True)[1]
    variances += _jackknife(observations, fit.weights, known, count, views * VIEW_BLOCKS // (views.max() + 1))
    if points is not None:
        blocks = neighbourhoods(points)[observations.owners]
        variances += _jackknife(observations, fit.weights, known, count, blocks)
    return np.where(np.isnan(known), np.sqrt(variances) * _stiffness(fit.robust), 0.0)


def camera_leverage(observations: Observations, fit: OffsetFit, known: np.ndarray, count: int) -> np.ndarray:
    """(3,): standard errors of the values for cameras that are wrong by 1 px in each image coordinate, each by itself.

    A shift of the maps is hard to tell from a displacement of all points where the cameras stand alike, and then small
    errors of the cameras make a large one of the shift. Points soak them up, so that residuals hardly show them.
    """
    columns = observations.columns * np.isnan(known)
    weighted = columns * fit.weights[:, None]
    inverses, crossed, _ = _point_equations(observations, fit.weights, weighted, observations.offsets, count)
    # What moving one observation by 1 px does to the values, once the points have given way.
    assert observations.slopes is not None
    moved = np.einsum("mk,mkj->mj", observations.slopes, (inverses @ crossed)[observations.owners])
    influences = (columns - moved) * fit.weights[:, None] @ np.linalg.inv(fit.matrix)
    sums = [
        np.bincount(observations.views, influences[:, value] * observations.normals[:, axis])
        for value in range(3)
        for axis in (0, 1)
    ]
    return np.sqrt((np.array(sums).reshape(3, -1) ** 2).sum(axis=1))


def _stiffness(robust: np.ndarray) -> float:
    """By how much constant weights understate what an observation moves a robust fit: E[weight] / E[influence'].

    Where residuals r change the weights, w = (1 + r^2)^-2, the influence is r w and its derivative 4 w^1.5 - 3 w.
    """
    return np.clip(robust.sum() / max((4 * robust**1.5 - 3 * robust).sum(), 1e-9), 1.0, MOST_STIFF)


def _weights(residuals: np.ndarray, redescending: bool) -> np.ndarray:
    """(m,) IRLS weights: of least absolute values, or Geman and McClure's at the residuals' own scale."""
    sizes = np.abs(residuals)
    if not redescending:
        return LEAST_RESIDUAL / np.maximum(sizes, LEAST_RESIDUAL)
    scale = CUT * max(NORMAL_MAD * np.median(sizes), LEAST_RESIDUAL)
    return geman_mcclure((residuals / scale) ** 2)


def _residuals(observations: Observations, values: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    return observations.offsets - observations.columns @ values - observations.moved_by(displacements)


def solve_offsets(
    observations: Observations, weights: np.ndarray, known: np.ndarray, count: int | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted least squares: values (3,), displacements (count, 2), and the matrix of the values' normal equations.

    The points are eliminated first, each by itself (Schur complement).
    """
    columns, free = observations.columns, np.isnan(known)
    targets = observations.offsets - columns @ np.where(free, 0.0, known)
    columns = columns * free
    weighted = columns * weights[:, None]
    matrix = weighted.T @ columns + np.eye(3) / NOTHING_KNOWN**2
    right = weighted.T @ targets
    displacements = np.zeros((0, 2))
    if count is not None:
        inverses, crossed, sides = _point_equations(observations, weights, weighted, targets, count)
        eliminated = inverses @ crossed
        matrix -= np.einsum("nki,nkj->ij", crossed, eliminated)
        right -= np.einsum("nki,nk->i", eliminated, sides)
    values = np.linalg.solve(matrix, right)
    if count is not None:
        displacements = np.einsum("nij,nj->ni", inverses, sides - crossed @ values)
    return np.where(free, values, known), displacements, matrix


def _point_equations(
    observations: Observations, weights: np.ndarray, weighted: np.ndarray, targets: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each point: inverse of its (2, 2) normal matrix, its coupling (2, 3) to the values, its right side (2,)."""
    slopes, owners = observations.slopes, observations.owners
    assert slopes is not None and owners is not None

    def sums(terms: np.ndarray) -> np.ndarray:
        return np.bincount(owners, terms, count)

    xx, xy, yy = (sums(weights * slopes[:, i] * slopes[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    xx, yy = xx + FREE_WAY**-2, yy + FREE_WAY**-2
    inverses = np.array([[yy, -xy], [-xy, xx]]) / (xx * yy - xy**2)
    crossed = np.array([[sums(slopes[:, i] * weighted[:, j]) for j in range(3)] for i in range(2)])
    sides = np.array([sums(slopes[:, i] * weights * targets) for i in range(2)])
    return np.moveaxis(inverses, 2, 0), np.moveaxis(crossed, 2, 0), sides.T


def _jackknife(
    observations: Observations, weights: np.ndarray, known: np.ndarray, count: int | None, groups: np.ndarray
) -> np.ndarray:
    """(3,) px^2: delete-a-group jackknife variances. groups: (m,) int."""
    labels = np.unique(groups)
    if len(labels) < 2:
        return np.full(3, NOTHING_KNOWN**2)
    found = np.array([solve_offsets(observations, weights * (groups != label), known, count)[0] for label in labels])
    return (len(labels) - 1) * found.var(axis=0)


def neighbourhoods(points: np.ndarray) -> np.ndarray:
    """(n,) int: blocks of equally many (n, 3) points near each other: SPLITS times each is halved at its median."""
    labels = np.zeros(len(points), np.int64)
    for split in range(SPLITS):
        values = points[:, split % 3]
        for label in range(2**split):
            part = np.flatnonzero(labels == label)
            labels[part[np.argsort(values[part], kind="stable")[len(part) // 2 :]]] += 2**split
    return labels
