"""Explaining away: an edgel that one 3D edge explains does not support another.

A stray point that projects onto the lines of other edges has support in many views, and none of it is its own. An
occluding contour has edgels of its own, but moves with the viewpoint: they lie all around its projections, not on them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.robust import NORMAL_MAD
from taichi_edges.evidence.lying import EdgelsAbout, steadiness

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.viewing_planes import RefinedPoints

ROUNDS = 4  # owners whose own support turns out weak lose their edgels in the next round
MATCH_PX = 1.0  # a point explains an edgel within this distance
NEAR_PX = 3.0  # an edgel within this distance, and nobody else's, should lie on the point if that is on an edge
ALONG_PX = 8.0  # a point so near to the owner along its direction is on the same edge, and so near across it:
BESIDE_PX, BESIDE_NOISES = 1.0, 7.0  # the first, or so many times the maps' noise; other edges may be 1.5 px beside
TIGHT_PX, TIGHT_NOISES = 0.25, 2.0  # residuals of an edge: within the first, or within so many times the maps' noise
BEST_SUPPORTED = 0.2  # share of the points whose residuals tell the noise; those of stray points and contours do not
LEAST_USUAL = 0.3  # steadiness; where the best points have less, there is nothing to compare with
VIEWS_AT_ONCE = 16


@dataclass(frozen=True)
class Explained(Columns):
    """What edgels say about points when each of them counts for one edge alone.

    support: (n,) share of the views that have a point in the image in which it lies on an edgel of its own edge.
    relative_steadiness: (n,) of the edgels near a point's projections that no other edge explains, the share that lies
    on them, over that of the best-supported points, which is below 1 as much as the edgels are noisy.
    spread: (n,) that of the RefinedPoints: from how different directions they are seen.
    noise_px: standard deviation across the edge of the edgels of the best-supported points.
    """

    support: np.ndarray
    relative_steadiness: np.ndarray
    spread: np.ndarray
    noise_px: float

    @property
    def tight_px(self) -> float:
        """Residual up to which an edgel lies on an edge."""
        return max(TIGHT_PX, TIGHT_NOISES * self.noise_px)


def explain(matching: "EdgelMatching", refined: "RefinedPoints") -> Explained:
    """Explained for `RefinedPoints`. matching: EdgelMatching.

    The strongest point owns an edgel it lies on, with its neighbours along the line; a point beside the owner, on the
    same edge in 3D, shares it. Strength is the support, then what a point was found to own in the round before.
    """
    owned, count = refined.support, len(refined)
    beside = max(BESIDE_PX, BESIDE_NOISES * _noise(matching, refined.keep(_best(owned))))
    for _ in range(ROUNDS):
        owners = _owners(matching, refined, owned + 1e-3 * refined.support)
        shared, seen = np.zeros(count), np.zeros(count)
        for part in _in_parts(matching, refined, MATCH_PX):
            shared += (_whose(matching, refined, owners, part.edgels, beside) > 0).sum(axis=1)
            seen += part.inside.sum(axis=1)
        owned = shared / np.maximum(seen, 1)
    best = _best(owned)
    noise = _noise(matching, refined.keep(best))
    share = _steadiness_of_points(matching, refined, owners, max(TIGHT_PX, TIGHT_NOISES * noise), beside)
    usual = max(float(np.median(share[best])), LEAST_USUAL) if count else 1.0
    return Explained(owned, share / usual, refined.spread, noise)


def _best(support: np.ndarray) -> np.ndarray:
    """(n,) bool: the best-supported points."""
    return support >= np.quantile(support, 1 - BEST_SUPPORTED) if len(support) else np.zeros(0, bool)


def unexplained(matching: "EdgelMatching", refined: "RefinedPoints") -> np.ndarray:
    """(e,) bool: the edgels that none of the RefinedPoints, all of them trusted, lies on."""
    return _owners(matching, refined, refined.support) < 0


def _in_parts(matching: "EdgelMatching", refined: "RefinedPoints", radius: float) -> Iterator[EdgelsAbout]:
    """EdgelsAbout the RefinedPoints, some views at a time."""
    count = matching.edgels.view_count
    for first in range(0, count, VIEWS_AT_ONCE):
        some = slice(first, min(first + VIEWS_AT_ONCE, count))
        yield EdgelsAbout.of(matching, refined.points, refined.directions, radius, some)


def _owners(matching: "EdgelMatching", refined: "RefinedPoints", strength: np.ndarray) -> np.ndarray:
    """(e,) index of the strongest point on each edgel or on one of its neighbours, -1 where there is none."""
    order = np.argsort(strength, kind="stable")
    ranks = np.empty(len(refined), np.int64)
    ranks[order] = np.arange(len(refined))
    best = np.full(len(matching.edgels), -1)
    for part in _in_parts(matching, refined, MATCH_PX):
        at, column = np.nonzero(part.there)
        np.maximum.at(best, part.edgels[at, column], ranks[at])
    best = best[matching.neighbors].max(axis=1, initial=-1)
    return np.append(order, -1)[best]


def _whose(
    matching: "EdgelMatching", refined: "RefinedPoints", owners: np.ndarray, matches: np.ndarray, beside: float
) -> np.ndarray:
    """(n, v) int: 1 where the matched edgel is the point's own, -1 where it is another edge's, 0 no edgel or owner.

    beside: px; so far across its direction another point is on the same edge.
    """
    whose = np.zeros(matches.shape, np.int8)
    at, column = np.nonzero(matches >= 0)
    owner = owners[matches[at, column]]
    at, column, owner = at[owner >= 0], column[owner >= 0], owner[owner >= 0]
    apart, direction = refined.points[owner] - refined.points[at], refined.directions[at]
    along = (apart * direction).sum(axis=1)
    across = np.linalg.norm(apart - along[:, None] * direction, axis=1)
    reach = matching.pixel * np.array([beside, ALONG_PX])
    whose[at, column] = np.where((across <= reach[0]) & (np.abs(along) <= reach[1]), 1, -1)
    return whose


def _noise(matching: "EdgelMatching", best: "RefinedPoints") -> float:
    """Standard deviation, px, of the residuals of the `best` points."""
    parts = [part.residuals[part.there] for part in _in_parts(matching, best, MATCH_PX)]
    residuals = np.concatenate([np.zeros(0), *parts])
    return float(NORMAL_MAD * np.median(np.abs(residuals))) if len(residuals) else 0.0


def _steadiness_of_points(
    matching: "EdgelMatching", refined: "RefinedPoints", owners: np.ndarray, tight: float, beside: float
) -> np.ndarray:
    """(n,) see Explained, not yet relative. tight, beside: px."""
    on, about = np.zeros(len(refined)), np.zeros(len(refined))
    for part in _in_parts(matching, refined, NEAR_PX):
        counted = part.there & (_whose(matching, refined, owners, part.edgels, beside) >= 0)
        about += counted.sum(axis=1)
        on += (counted & part.within(tight)).sum(axis=1)
    return steadiness(on, about)
