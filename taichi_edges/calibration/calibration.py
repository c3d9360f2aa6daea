"""Calibration of edge maps: where a detector means its edges to be, found from the inputs alone.

Learned detectors have constant biases. Their maps may be shifted by a fraction of a pixel; and where they saw images
whose alpha channel was dropped, in which an object is dilated, they put its silhouettes outside the true ones. Both are
measured in two ways: against the colour images, where there are any, and through 3D points that all views must agree
on. Of each bias the surer estimate counts, and it is corrected where it is significant.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.calibration.backgrounds import CLEAR, Sides, look_beside
from taichi_edges.calibration.consensus import Consensus
from taichi_edges.calibration.offsets import LEAST_OBSERVATIONS, MOST_RESIDUAL, Estimate, fit_offsets, standard_errors
from taichi_edges.evidence.support import line_width
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import Views

SURE, WORTH_PX = 3.0, 0.1  # a bias is corrected from so many standard errors and so many pixels on
UNKNOWN_PX = 2.0  # a standard error beyond says that the bias has not been measured
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
    reason:        why 3D points say nothing; '' where they do.
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

    def facts(self) -> dict[str, Any]:
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


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else 0.0


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else np.nan


def _rounded(values: ArrayLike) -> Any:
    """Floats of four decimals, nested as the array is; None for what is not finite."""
    array = np.asarray(values, np.float64)
    if array.ndim:
        return [_rounded(value) for value in array]
    return round(array.item(), 4) if np.isfinite(array) else None


def calibrate(
    views: Views,
    edgels: Edgels,
    points: np.ndarray,
    directions: np.ndarray,
    fixed_shift: Sequence[float] | np.ndarray | None = None,
    fixed_silhouette: float | None = None,
    threads: int | None = None,
) -> tuple[Edgels, Calibration]:
    """The edgels of a detector's maps without its biases, and the Calibration.

    views: Views with the maps as the detector gave them. edgels: n Edgels of those. points, directions: (p, 3) unit
    cube, seeds on 3D edges and unit vectors along them; they may be some pixels off. fixed_shift: (2,) px and
    fixed_silhouette: px are taken as they are, (0, 0) and 0 to correct nothing; None measures.
    """
    known = np.full(3, np.nan)
    known[0] = np.nan if fixed_silhouette is None else fixed_silhouette
    known[1:] = np.nan if fixed_shift is None else fixed_shift
    sides = sides_of(views, edgels, threads)
    consensus = Consensus(views, edgels, sides, points, directions, threads)
    by_images = _by_images(sides, edgels, known)
    by_points, reason = _by_points(consensus, by_images, known)
    estimates = [estimate for estimate in (by_images, by_points) if estimate is not None]
    silhouette, shift = (_choose(part, known, estimates) for part in (slice(0, 1), slice(1, 3)))
    values = np.concatenate([silhouette.applied_values, shift.applied_values])
    corrected, on_silhouette = sides.correct(edgels, values)
    return corrected, Calibration(
        *(shift.values, shift.errors, shift.method, shift.applied),
        *(float(silhouette.values[0]), float(silhouette.errors[0]), silhouette.method, silhouette.applied),
        *(consensus.residuals(values), on_silhouette, sides.outward, reason),
    )


def sides_of(views: Views, edgels: Edgels, threads: int | None = None) -> Sides:
    """Sides of all edgels."""
    width_px, _ = line_width(views, EDGE_LEVEL)

    def look(view: int) -> Sides:
        points, normals, _ = edgels.of_view(view)
        return look_beside(views.edge_maps[view], views.image_paths[view], points, normals, width_px)

    with ThreadPoolExecutor(threads) as pool:  # OpenCV and NumPy release the lock in the long loops
        return Sides.joined(list(pool.map(look, range(len(views)))))


def _by_images(sides: Sides, edgels: Edgels, known: np.ndarray) -> Estimate | None:
    """Estimate against the colour images; None where they show too little, or other edges."""
    shift = np.where(np.isnan(known[1:]), 0.0, known[1:])
    for _ in range(2):  # which edgels are on silhouettes is known better when the shift is
        observations = sides.observations(edgels.views, shift)
        if len(observations) < LEAST_OBSERVATIONS:
            return None
        fit = fit_offsets(observations, known)
        shift = fit.values[1:]
    if np.median(np.abs(fit.residuals)) > MOST_RESIDUAL:
        return None
    return Estimate(fit.values, standard_errors(observations, fit, known), "images")


def _by_points(consensus: Consensus, by_images: Estimate | None, known: np.ndarray) -> tuple[Estimate | None, str]:
    """Estimate through 3D points, or None, and then why, or ''.

    Where the cameras stand alike a shift is hard to tell from a displacement of all points, which takes the silhouettes
    with it; so a shift that the images tell surely is not measured again.
    """
    if by_images is None:
        return consensus.estimate(known, np.zeros(3))
    sure = np.linalg.norm(by_images.errors[1:]) <= WORTH_PX
    given = np.append(known[0], by_images.values[1:] if sure else known[1:])
    found, reason = consensus.estimate(given, by_images.values)
    if found is None or not sure:
        return found, reason
    return Estimate(found.values, np.append(found.errors[0], by_images.errors[1:]), found.method), reason


@dataclass(frozen=True)
class _Choice:
    """One of the biases: values and errors, (1,) or (2,) px, how they were found, and whether they are corrected."""

    values: np.ndarray
    errors: np.ndarray
    method: str
    applied: bool

    @property
    def applied_values(self) -> np.ndarray:
        return self.values * self.applied


def _choose(part: slice, known: np.ndarray, estimates: Sequence[Estimate]) -> _Choice:
    """_Choice of one part of the (3,) px: what is known, or else the surest of the estimates."""
    if not np.isnan(known[part]).any():
        return _Choice(known[part], np.zeros_like(known[part]), "fixed", bool(known[part].any()))
    if not estimates:
        return _Choice(np.zeros_like(known[part]), np.full_like(known[part], np.nan), "none", False)
    best = min(estimates, key=lambda estimate: float(np.linalg.norm(estimate.errors[part])))
    if np.linalg.norm(best.errors[part]) > UNKNOWN_PX:  # nothing has been observed of it, a prior alone keeps it finite
        return _Choice(np.zeros_like(known[part]), np.full_like(known[part], np.nan), "none", False)
    values, errors = best.values[part], best.errors[part]
    applied = np.linalg.norm(values) > max(SURE * np.linalg.norm(errors), WORTH_PX)
    return _Choice(values, errors, best.method, bool(applied))
