"""Clusters that fork, taken apart into chains.

Where two edges touch at a small angle (a rim and the line tangent to it), graph traversal runs on into both. An edge
does not fork: the longest walk through such a cluster, with what lies beside it, is one edge, and the rest is looked at
again.
"""

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from taichi_edges.arrays.components import components_of
from taichi_edges.strokes.neighbors import UNASSIGNED, members_of_clusters
from taichi_edges.strokes.ordering import connected_graph, extremity, two_sides

SCATTER_NEIGHBORS = 8
BESIDE = 4.0  # a point belongs to the walk up to this many times the points' own scatter
LEAST_BESIDE = 3e-3  # unit-cube units
PATH_SPACING = 1e-3  # unit-cube units between the samples of the walk


def separate_branches(points: np.ndarray, labels: np.ndarray, min_points: int) -> np.ndarray:
    """Relabel forking clusters so that every cluster is one chain, open or closed.

    points: (n, 3) unit cube. labels: (n,) ints, UNASSIGNED for none. Branches below min_points become UNASSIGNED.
    """
    separated = np.full(len(labels), UNASSIGNED)
    count = 0
    waiting = members_of_clusters(labels)[::-1]
    while waiting:
        members = waiting.pop()
        if len(members) < min_points:
            continue
        on_walk, branches = longest_walk(points[members])
        separated[members[on_walk]] = count
        count += 1
        waiting += [members[branch] for branch in branches]
    return separated


def longest_walk(points: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """(n,) bool: the points on or beside the longest walk; and the connected groups of the others, as index arrays."""
    graph = connected_graph(points)
    start = extremity(graph)
    from_start, before = dijkstra(graph, indices=start, return_predecessors=True)
    far = int(np.argmax(from_start))
    strips = two_sides(graph, from_start)
    if strips is None:
        walks = [_walk(before, far)]
    else:  # round a loop there are two ways from the start to the far end, one through each strip
        walks = []
        for strip in strips:
            half_way = strip[np.argsort(from_start[strip])[len(strip) // 2]]
            _, before_half = dijkstra(graph, indices=half_way, return_predecessors=True)
            walks += [_walk(before, half_way), _walk(before_half, far)]
    samples = np.concatenate([_densified(points[walk]) for walk in walks])
    distances = cKDTree(samples).query(points)[0]
    on_walk = distances <= max(BESIDE * scatter(points), LEAST_BESIDE)
    rest = np.flatnonzero(~on_walk)
    groups = components_of(graph[rest][:, rest])
    return on_walk, [rest[members] for members in members_of_clusters(groups)]


def _walk(before: np.ndarray, end: int) -> np.ndarray:
    """Indices from the source of a Dijkstra search to `end`."""
    walk = [end]
    while before[walk[-1]] >= 0:
        walk.append(before[walk[-1]])
    return np.array(walk[::-1])


def _densified(corners: np.ndarray) -> np.ndarray:
    """Samples PATH_SPACING apart along the polyline through (m, 3) corners."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, arc[-1], max(int(arc[-1] / PATH_SPACING), 1) + 1)
    return np.stack([np.interp(at, arc, corners[:, axis]) for axis in range(3)], axis=1)


def scatter(points: np.ndarray) -> float:
    """How far (n, 3) points lie beside their own edge: median over all of the second axis of their neighbourhoods."""
    count = min(SCATTER_NEIGHBORS, len(points))
    near = points[cKDTree(points).query(points, count)[1]]
    offsets = near - near.mean(axis=1, keepdims=True)
    variances = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", offsets, offsets) / count)
    return float(np.sqrt(np.median(np.maximum(variances[:, 1], 0.0))))
