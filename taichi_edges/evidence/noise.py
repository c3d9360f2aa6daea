"""How far edgels are off their edges, and the tolerances that follow from it.

One estimate for everything: the residuals of the edgels about the best supported points, whatever the detector, the
poses and the pictures make of them. All tolerances between points and edgels are so many of these standard deviations.
"""

from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.robust import NORMAL_MAD
from taichi_edges.evidence.lying import EdgelsAbout

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.viewing_planes import RefinedPoints

LEAST_NOISE_PX = 0.08  # next to other edges the best detector is off by as much
MOST_NOISE_PX = 0.5  # poses and maps that are off by more tell no two edges apart
PROBE_PX = 1.0  # of the edgels that tell it
BEST_SUPPORTED = 0.2  # share of the points whose edgels tell it; the others may be on no edge

LIFT_NOISES = 4.25  # by which edgels of an edge may disagree: each of two is off, and the ray as well
SCALE_NOISES = 2.1  # residual at which an edgel's weight has fallen to a quarter
RADII_NOISES = (8.5, 7.0, 5.0)  # of the edgels looked at while points are moved to their edge, round by round
ON_NOISES = 4.7  # within so much an edgel is an edge's
TAKEN_NOISES = 2.2  # and within so much nobody else's: an edge may run beside another
BEST_AGREEING = 0.25  # share of the places that are on edges, even if most are on contours
LEAST_VIEWS, LEAST_PLACES = 6, 20  # so many views of a place tell by how much they agree, and so many places


def noise_of_best_agreeing(residuals: np.ndarray) -> float:
    """Standard deviation, px, of (n, V) residuals, NaN where there are none, of the places whose views agree best.

    Where most of what the views show are contours of rounded surfaces, the residuals of all are theirs. Infinite where
    too few views tell it.
    """
    counts = np.isfinite(residuals).sum(axis=1)
    some = counts >= max(LEAST_VIEWS, np.median(counts) if len(counts) else 0)
    if np.count_nonzero(some) < LEAST_PLACES:
        return np.inf
    return NORMAL_MAD * float(np.quantile(np.nanmedian(np.abs(residuals[some]), axis=1), BEST_AGREEING))


def noise_of(matching: "EdgelMatching", placed: "RefinedPoints") -> float:
    """Standard deviation of the edgels across their edges, px: of those about the best supported of RefinedPoints."""
    if not len(placed):
        return MOST_NOISE_PX
    about = EdgelsAbout.of(matching, placed.points, placed.directions, PROBE_PX)
    counts = about.there.sum(axis=1)  # not the weights, which would choose small residuals
    best = counts >= np.quantile(counts, 1 - BEST_SUPPORTED)
    residuals = np.abs(about.residuals[best][about.there[best]])
    noise = NORMAL_MAD * float(np.median(residuals)) if len(residuals) else MOST_NOISE_PX
    return float(np.clip(noise, LEAST_NOISE_PX, MOST_NOISE_PX))
