"""Growing: oriented points continued along their tangents, as long as the views support it.

Seeds are sparse where an edge is faint or often hidden. What is found of it tells where it goes on.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.evidence.viewing_planes import RefinedPoints, refine_points

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching

STEP_PX = 1.0  # of a step along the tangent
RADII_PX = (1.5, 1.0, 1.0)  # of the refinement of a step
COVERED, TOO_CLOSE = 0.6, 0.5  # steps; no proposal is made, and no point kept, so near to one that is there
STRAYED = 0.7  # steps; a point that the refinement moves farther has jumped to something else
LEAST_COSINE = 0.8  # between the directions before and after a step
MOST_ROUNDS = 200


def grow_points(matching: "EdgelMatching", refined: RefinedPoints, least: np.ndarray) -> RefinedPoints:
    """RefinedPoints and the points that continue them, each the step after another.

    matching: EdgelMatching. least: (n,) share of the views that the points which continue each of them need.
    """
    step, newest = STEP_PX * matching.pixel, refined
    for _ in range(MOST_ROUNDS):
        if len(newest) == 0:
            break
        tree = cKDTree(refined.points)
        newest, least = _next_points(matching, newest, tree, step, least)
        refined = RefinedPoints.joined([refined, newest])
    return refined


def _next_points(
    matching: "EdgelMatching", newest: RefinedPoints, tree: cKDTree, step: float, least: np.ndarray
) -> tuple[RefinedPoints, np.ndarray]:
    """The refined points one step on from the `newest` ones, both ways, where nothing is yet; and their `least`."""
    ahead = np.concatenate([newest.points + step * newest.directions, newest.points - step * newest.directions])
    free = np.flatnonzero(tree.query(ahead)[0] > COVERED * step)
    free = free[_one_for_each_cell(ahead[free], TOO_CLOSE * step)]
    before = free % len(newest)
    ahead, directions, least = ahead[free], newest.directions[before], least[before]
    found = refine_points(matching, ahead, directions, RADII_PX)
    good = (found.support >= least) & (found.views >= matching.least_views)
    good &= np.linalg.norm(found.points - ahead, axis=1) <= STRAYED * step
    good &= np.abs((found.directions * directions).sum(axis=1)) >= LEAST_COSINE
    good[good] = tree.query(found.points[good])[0] > TOO_CLOSE * step
    good[good] = _best_apart(found.keep(good), TOO_CLOSE * step)
    return found.keep(good), least[good]


def _one_for_each_cell(points: np.ndarray, size: float) -> np.ndarray:
    """Indices of the first of the points in each cubic cell."""
    cells = np.floor(points / size).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def _best_apart(found: RefinedPoints, distance: float) -> np.ndarray:
    """(n,) bool: of points that are closer than `distance` the better supported ones."""
    kept = np.ones(len(found), bool)
    if len(found) < 2:
        return kept
    for one, other in sorted(cKDTree(found.points).query_pairs(distance)):
        if kept[one] and kept[other]:
            kept[other if found.support[other] <= found.support[one] else one] = False
    return kept
