"""Edgels in order: which of a view follows which along its 2D edge."""

import numpy as np

from taichi_edges.detectors.chains import links_between
from taichi_edges.views.edgels import Edgels

STEP_PX = 1.7  # from an edgel to the next; they are about 1 px apart
TURN_COSINE = np.cos(np.radians(30.0))  # between their normals: at corners a path ends
BESIDE_PX = 0.7  # by which one may be off the line of the other
SIDEWAYS = 2.0  # px of step that a pixel aside counts for, where several may be next
FEWEST = 3  # edgels of a path


def ordered_paths(edgels: Edgels) -> list[np.ndarray]:
    """Index arrays: the edgels of each path, in order. Every edgel is on one path at most, no path turns a corner."""
    paths = []
    for view in range(edgels.view_count):
        points, normals, _ = edgels.of_view(view)
        found = _paths_of(points.astype(np.float64), normals.astype(np.float64)) if len(points) > 1 else []
        paths += [edgels.starts[view] + path for path in found]
    return paths


def _paths_of(points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
    """Those of one view. points, normals: (n, 2)."""
    following = _following(points, normals)
    known = np.zeros(len(points), bool)
    counts = (following >= 0).sum(axis=1)
    paths = []
    # Open paths from their ends; what is left then are loops.
    for start in (*np.flatnonzero(counts < 2), *np.flatnonzero(counts == 2)):
        if known[start]:
            continue
        path, at = [int(start)], int(start)
        known[start] = True
        while True:
            ahead = [int(other) for other in following[at] if other >= 0 and not known[other]]
            if not ahead:
                break
            at = ahead[0]
            known[at] = True
            path.append(at)
        if len(path) >= FEWEST:
            paths.append(np.array(path))
    return paths


def _following(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 2) the nearest edgel to follow on either side of each, where each is the other's nearest; -1 for none."""
    first, second, cosines, beside = links_between(points, normals, STEP_PX)
    good = (cosines >= TURN_COSINE) & (beside.min(axis=0) <= BESIDE_PX)
    first, second, beside = first[good], second[good], beside[:, good]
    way = points[second] - points[first]
    along = np.column_stack([-normals[:, 1], normals[:, 0]])
    sides = [((way * along[first]).sum(axis=1) > 0), ((-way * along[second]).sum(axis=1) > 0)]
    cost = np.linalg.norm(way, axis=1) + SIDEWAYS * beside.min(axis=0)
    one, other = np.concatenate([first, second]), np.concatenate([second, first])
    side, cost = np.concatenate(sides).astype(int), np.concatenate([cost, cost])
    nearest = np.full((len(points), 2), -1)
    last = np.argsort(-cost, kind="stable")  # of several assignments the last one stays: the nearest
    nearest[one[last], side[last]] = other[last]
    mutual = np.full_like(nearest, -1)
    for k in (0, 1):
        has = np.flatnonzero(nearest[:, k] >= 0)
        theirs = nearest[nearest[has, k]]
        has = has[(theirs == has[:, None]).any(axis=1)]
        mutual[has, k] = nearest[has, k]
    return mutual
