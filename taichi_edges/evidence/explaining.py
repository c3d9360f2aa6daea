"""Explaining away: an edgel that one 3D edge explains does not support another.

A stray point that projects onto the lines of other edges has support in many views, and none of it is its own.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.robust import NORMAL_MAD
from taichi_edges.evidence.lying import EdgelsAbout

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.viewing_planes import RefinedPoints

ROUNDS = 4  # owners whose own support turns out weak lose their edgels in the next round
MATCH_PX = 1.0  # a point explains an edgel within this distance
ALONG_PX = 8.0  # a point so near to the owner along its direction is on the same edge, and so near across it:
BESIDE_PX, BESIDE_NOISES = 1.0, 7.0  # the first, or so many times the maps' noise; other edges may be 1.5 px beside
BEST_SUPPORTED = 0.2  # share of the points whose residuals tell the noise; those of stray points do not
VIEWS_AT_ONCE = 16


def explained_support(matching: "EdgelMatching", refined: "RefinedPoints") -> np.ndarray:
    """(n,) share of the views that have a point in the image in which it lies on an edgel of its own edge.

    matching: EdgelMatching. refined: RefinedPoints. The strongest point owns an edgel it lies on, with its neighbours
    along the line; a point beside the owner, on the same edge in 3D, shares it. Strength is the support, then what a
    point was found to own in the round before.
    """
    owned, count, pixel = refined.support, len(refined), matching.pixel_at(refined.points)
    beside = max(BESIDE_PX, BESIDE_NOISES * _noise(matching, refined.keep(_best(owned))))
    for _ in range(ROUNDS):
        owners = _owners(matching, refined, owned + 1e-3 * refined.support)
        shared, seen = np.zeros(count), np.zeros(count)
        for part in _in_parts(matching, refined, MATCH_PX):
            shared += (_whose(pixel, refined, owners, part.edgels, beside) > 0).sum(axis=1)
            seen += part.inside.sum(axis=1)
        owned = shared / np.maximum(seen, 1)
    return owned


def _best(support: np.ndarray) -> np.ndarray:
    """(n,) bool: the best-supported points."""
    return support >= np.quantile(support, 1 - BEST_SUPPORTED) if len(support) else np.zeros(0, bool)


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
    pixel: np.ndarray, refined: "RefinedPoints", owners: np.ndarray, matches: np.ndarray, beside: float
) -> np.ndarray:
    """(n, v) int: 1 where the matched edgel is the point's own, -1 where it is another edge's, 0 no edgel or owner.

    pixel: (n,) size of one at each point. beside: px; so far across its direction another point is on the same edge.
    """
    whose = np.zeros(matches.shape, np.int8)
    at, column = np.nonzero(matches >= 0)
    owner = owners[matches[at, column]]
    at, column, owner = at[owner >= 0], column[owner >= 0], owner[owner >= 0]
    apart, direction = refined.points[owner] - refined.points[at], refined.directions[at]
    along = (apart * direction).sum(axis=1)
    across = np.linalg.norm(apart - along[:, None] * direction, axis=1)
    same = (across <= beside * pixel[at]) & (np.abs(along) <= ALONG_PX * pixel[at])
    whose[at, column] = np.where(same, 1, -1)
    return whose


def _noise(matching: "EdgelMatching", best: "RefinedPoints") -> float:
    """Standard deviation, px, of the residuals of the `best` points."""
    parts = [part.residuals[part.there] for part in _in_parts(matching, best, MATCH_PX)]
    residuals = np.concatenate([np.zeros(0), *parts])
    return float(NORMAL_MAD * np.median(np.abs(residuals))) if len(residuals) else 0.0
