"""Calibration of edge maps: where a detector means its edges to be, found from the inputs alone.

Learned detectors have constant biases. Their maps may be shifted by a fraction of a pixel; and where they saw images
whose alpha channel was dropped, in which an object is dilated, they put its silhouettes outside the true ones. Both are
measured in two ways: against the colour images, where there are any, and through 3D points that all views must agree
on. Of each bias the surer estimate counts, and it is corrected where it is significant.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from taichi_edges.detectors.backgrounds import CLEAR, Sides, look_beside
from taichi_edges.detectors.consensus import chosen_points, displaced, observe, residuals_beside
from taichi_edges.detectors.offsets import fit_offsets, standard_errors
from taichi_edges.support import line_width

LEAST_OBSERVATIONS = 200  # against images or points; fewer tell nothing
LEAST_POINTS = 50  # 3D points that are worth asking
SURE, WORTH_PX = 3.0, 0.1  # a bias is corrected from so many standard errors and so many pixels on
REACHES = (5.0, 3.0)  # px around a 3D point within which an edgel may be its, round by round
FARTHEST_PX = 3.0  # that a point is moved in one round
MOST_SILHOUETTE = 0.85  # of a point's observations; with more it cannot tell its own displacement from their offset
# Standard errors through 3D points, of the outward offset and the shift's coordinates, for each px of median residual,
# that no leaving out of observations shows: interior edges have small biases of their own, which points on them take
# over. On exact CAD models, with residuals of 0.17 px, the offset came out wrong by 0.12 px and the shift by 0.09.
POINT_ERRORS = np.array([0.6, 0.4, 0.4])
EDGE_LEVEL = 0.5  # of full scale, at which the width of the maps' lines is measured


@dataclass(frozen=True)
class Calibration:
    """The biases of a detector's edgels, and what correcting them leaves.

    shift, shift_error:           (2,) px that the maps are shifted by, right and down, and its standard errors.
    silhouette, silhouette_error: px that silhouettes lie outside the true ones, and its standard error.
    shift_method, silhouette_method:   'fixed' by the caller, measured against 'images' or 3D 'points', or 'none'.
    shift_applied, silhouette_applied: whether the edgels were corrected for it.
    residuals:     (n,) px, from the 3D point that explains it to each corrected edgel, along `outward`; else NaN.
    on_silhouette: (n,) 0..1: how surely each edgel is on a silhouette.
    outward:       (n, 2) unit vectors across each edge, on silhouettes away from the object.
    reason:        why 3D points were not asked; '' where they were.
    """

    shift: np.ndarray
    shift_error: np.ndarray
    shift_method: str
    shift_applied: bool
    silhouette: float
    silhouette_error: float
    silhouette_method: str
    silhouette_applied: bool
    residuals: np.ndarray
    on_silhouette: np.ndarray
    outward: np.ndarray
    reason: str

    def facts(self):
        """JSON-able: the biases and how well the corrected edgels of all views agree."""
        explained, silhouettes = np.isfinite(self.residuals), self.on_silhouette >= CLEAR
        return {
            "shift_px": _rounded(self.shift),
            "shift_error_px": _rounded(self.shift_error),
            "shift_method": self.shift_method,
            "shift_applied": self.shift_applied,
            "silhouette_px": _rounded(self.silhouette),
            "silhouette_error_px": _rounded(self.silhouette_error),
            "silhouette_method": self.silhouette_method,
            "silhouette_applied": self.silhouette_applied,
            "edgels": len(self.residuals),
            "silhouette_share": _rounded(_mean(silhouettes)),
            "explained_share": _rounded(_mean(explained)),
            "median_residual_silhouette_px": _rounded(_median(self.residuals[explained & silhouettes])),
            "median_abs_residual_px": _rounded(_median(np.abs(self.residuals[explained]))),
            **({"reason": self.reason} if self.reason else {}),
        }


def _mean(values):
    return float(np.mean(values)) if len(values) else 0.0


def _median(values):
    return float(np.median(values)) if len(values) else np.nan


def _rounded(values):
    """Floats of four decimals, nested as the array is; None for what is not finite."""
    values = np.asarray(values, np.float64)
    return [_rounded(value) for value in values] if values.ndim else round(values.item(), 4) if np.isfinite(values) else None


@dataclass(frozen=True)
class _Estimate:
    """values, errors: (3,) px: outward offset of silhouettes, and the shift. method: how they were found."""

    values: np.ndarray
    errors: np.ndarray
    method: str


def calibrate(views, edgels, points, directions, fixed_shift=None, fixed_silhouette=None, threads=None):
    """The edgels of a detector's maps without its biases, and the Calibration.

    views: Views with the maps as the detector gave them. edgels: Edgels of those. points, directions: (n, 3) unit cube,
    seeds on 3D edges and unit vectors along them; they may be some pixels off. fixed_shift: (2,) px and
    fixed_silhouette: px are taken as they are, (0, 0) and 0 to correct nothing; None measures.
    """
    known = np.array([np.nan, np.nan, np.nan])
    known[0] = np.nan if fixed_silhouette is None else fixed_silhouette
    known[1:] = np.nan if fixed_shift is None else fixed_shift
    sides = sides_of(views, edgels, threads)
    estimates = [estimate for estimate in [_by_images(sides, edgels, known)] if estimate]
    seeds = _Seeds(views, edgels, sides, threads)
    reason = seeds.take(points, directions)
    start = estimates[0].values if estimates else np.zeros(3)
    start = np.where(np.isnan(known), start, known)
    if not reason:
        by_points = seeds.estimate(known, start)
        estimates += [by_points] if by_points else []
        reason = "" if by_points else "the 3D points explain too few edgels"
    parts = [_choose(part, known, estimates) for part in (slice(0, 1), slice(1, 3))]
    applied = np.concatenate([values * is_applied for values, _, _, is_applied in parts])
    corrected, on_silhouette = correct(edgels, sides, applied)
    residuals = np.full(len(edgels), np.nan) if reason else seeds.residuals(applied)
    (outward, outward_error, outward_method, outward_applied), shift = parts[0], parts[1]
    return corrected, Calibration(
        *shift,
        float(outward[0]),
        float(outward_error[0]),
        outward_method,
        outward_applied,
        residuals,
        on_silhouette,
        sides.outward,
        reason,
    )


def sides_of(views, edgels, threads=None):
    """Sides of all edgels."""
    width_px, _ = line_width(views, EDGE_LEVEL)

    def look(view):
        points, normals, _ = edgels.of_view(view)
        return look_beside(views.edge_maps[view], views.image_paths[view], points, normals, width_px)

    with ThreadPoolExecutor(threads) as pool:  # OpenCV and NumPy release the lock in the long loops
        return Sides.joined(list(pool.map(look, range(len(views)))))


def correct(edgels, sides, values):
    """The edgels without the biases `values`, (3,) px, and how surely each is on a silhouette, (n,) 0..1."""
    on_silhouette = sides.silhouettes(values[1:])
    return edgels.moved(-values[1:] - values[0] * on_silhouette[:, None] * sides.outward), on_silhouette


def _by_images(sides, edgels, known):
    """_Estimate against the colour images; None where they show too little."""
    shift = np.where(np.isnan(known[1:]), 0.0, known[1:])
    for _ in range(2):  # which edgels are on silhouettes is known better when the shift is
        observations = sides.observations(edgels.views, shift)
        if len(observations) < LEAST_OBSERVATIONS:
            return None
        fit = fit_offsets(observations, known)
        shift = fit.values[1:]
    return _Estimate(fit.values, standard_errors(observations, fit, known), "images")


def _choose(part, known, estimates):
    """Values and errors of a part of the biases, the method, and whether they are worth correcting."""
    if not np.isnan(known[part]).any():
        return known[part], np.zeros_like(known[part]), "fixed", bool(known[part].any())
    if not estimates:
        return np.zeros_like(known[part]), np.full_like(known[part], np.nan), "none", False
    best = min(estimates, key=lambda estimate: np.linalg.norm(estimate.errors[part]))
    values, errors = best.values[part], best.errors[part]
    significant = np.abs(values / errors).max() > SURE and np.linalg.norm(values) > WORTH_PX
    return values, errors, best.method, bool(significant)


class _Seeds:
    """3D points on edges, moved to where the edgels of all views see them."""

    def __init__(self, views, edgels, sides, threads):
        self.views, self.edgels, self.sides, self.threads = views, edgels, sides, threads

    def take(self, points, directions):
        """Keep some of the points. Returns why that is no use, or ''."""
        chosen = chosen_points(np.asarray(points))
        self.points, self.directions = np.asarray(points)[chosen], np.asarray(directions)[chosen]
        few = f"{len(self.points)} 3D points are too few to calibrate with; {LEAST_POINTS} are needed"
        return few if len(self.points) < LEAST_POINTS else ""

    def estimate(self, known, start):
        """_Estimate of the biases; None where there are too few observations. start: (3,) px, a guess."""
        values = start
        for reach in REACHES:
            observations = self._observe(values, reach)
            if len(observations) < LEAST_OBSERVATIONS:
                return None
            fit = fit_offsets(observations, known, len(self.points))
            self._move(fit)
            values = fit.values
        observations = self._balanced(self._observe(values, REACHES[-1]))
        if len(observations) < LEAST_OBSERVATIONS:
            return None
        fit = fit_offsets(observations, known, len(self.points))
        errors = standard_errors(observations, fit, known, self.points)
        own = POINT_ERRORS * np.median(np.abs(fit.residuals)) * np.isnan(known)
        return _Estimate(fit.values, np.hypot(errors, own), "points")

    def residuals(self, values):
        """(n,) px residuals of the edgels corrected by `values`, (3,) px; the points are moved to fit those first."""
        observations = self._observe(values, REACHES[-1])
        if len(observations):
            self._move(fit_offsets(observations, values, len(self.points)))
        corrected, _ = correct(self.edgels, self.sides, values)
        return residuals_beside(
            self.views, corrected, self.sides.outward, self.points, self.directions, REACHES[-1], self.threads
        )

    def _observe(self, values, reach):
        corrected, on_silhouette = correct(self.edgels, self.sides, values)
        flags = np.where(on_silhouette >= CLEAR, 1.0, np.where(self.sides.interior, 0.0, np.nan))
        return observe(
            self.views,
            self.edgels,
            corrected,
            self.sides.outward,
            flags,
            self.points,
            self.directions,
            reach,
            self.threads,
        )

    def _move(self, fit):
        moves = np.clip(fit.displacements, -FARTHEST_PX, FARTHEST_PX)
        self.points = displaced(self.views, self.points, self.directions, moves)

    def _balanced(self, observations):
        counts = np.bincount(observations.owners, minlength=len(self.points))
        silhouettes = np.bincount(observations.owners, observations.silhouette, len(self.points))
        return observations.keep((silhouettes <= MOST_SILHOUETTE * counts)[observations.owners])
