"""Order along a cluster: the arc length of every point, and whether the cluster closes on itself."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

GRAPH_NEIGHBORS = 8
REACH = 3.0  # graph edges longer than this many times the longest gap of the spanning tree are shortcuts
WAIST = (0.4, 0.6)  # of the longest walk: an open edge is one strip here, a closed one two


@dataclass(frozen=True)
class Ordering:
    """arc: (n,) arc length of each point along the edge. length: of the whole edge. closed: does it end at its start?"""

    arc: np.ndarray
    length: float
    closed: bool


def order_points(points):
    """Order the (n, 3) points of one cluster along their edge, by geodesic distance in their neighbour graph."""
    graph = _connected_graph(points)
    start = int(np.argmax(dijkstra(graph, indices=0)))
    from_start = dijkstra(graph, indices=start)
    length = float(from_start.max())
    waist = np.flatnonzero((from_start >= WAIST[0] * length) & (from_start <= WAIST[1] * length))
    sides = _two_sides(points, waist)
    if sides is None:
        return Ordering(from_start, length, False)
    return _unroll(graph, from_start, length, sides)


def _connected_graph(points):
    """Symmetric graph of near neighbours that is connected: the spanning tree is always part of it."""
    count = min(GRAPH_NEIGHBORS + 1, len(points))
    distances, indices = cKDTree(points).query(points, count)
    rows = np.repeat(np.arange(len(points)), count - 1)
    columns, lengths = indices[:, 1:].ravel(), distances[:, 1:].ravel()
    lengths = np.maximum(lengths, 1e-12)  # a sparse graph takes a zero for a missing edge
    full = coo_array((lengths, (rows, columns)), shape=(len(points),) * 2).tocsr()
    full = full.maximum(full.T)
    pieces, labels = connected_components(full, directed=False)
    if pieces > 1:
        full = _bridge(points, full, labels)
    tree = minimum_spanning_tree(full)
    if tree.nnz:
        full.data[full.data > REACH * tree.data.max()] = 0.0
        full.eliminate_zeros()
    return full


def _bridge(points, graph, labels):
    """Join the pieces of a graph by their shortest connections."""
    graph = graph.tolil()
    while (pieces := labels.max() + 1) > 1:
        inside = np.flatnonzero(labels == 0)
        outside = np.flatnonzero(labels != 0)
        distances, nearest = cKDTree(points[inside]).query(points[outside])
        best = int(np.argmin(distances))
        a, b = inside[nearest[best]], outside[best]
        graph[a, b] = graph[b, a] = max(distances[best], 1e-12)
        labels = np.where(labels == labels[b], 0, labels)
        _, labels = np.unique(labels, return_inverse=True)
        assert labels.max() + 1 < pieces
    return graph.tocsr()


def _two_sides(points, waist):
    """Labels 0/1 of the waist's points when it consists of two separate strips, else None."""
    if len(waist) < 4:
        return None
    strip = points[waist]
    spread = np.linalg.norm(strip - strip.mean(axis=0), axis=1).max()
    tree = cKDTree(strip)
    gap = 0.5 * spread
    pairs = tree.query_pairs(gap, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(strip),) * 2)
    pieces, labels = connected_components(graph, directed=False)
    sizes = np.bincount(labels)
    if pieces < 2 or np.sort(sizes)[-2] < 2:
        return None
    largest = np.argsort(-sizes, kind="stable")[:2]
    return {int(waist[i]): int(labels[i] == largest[1]) for i in range(len(strip)) if labels[i] in largest}


def _unroll(graph, from_start, length, sides):
    """Arc length around a closed edge: out on one side (0 .. L), back on the other (L .. 2 L)."""
    members = [np.array([p for p, side in sides.items() if side == s]) for s in (0, 1)]
    # Which arm a point is on: the side whose waist it reaches without passing start or far end, that is, the nearer.
    nearest = [dijkstra(graph, indices=m, min_only=True) for m in members]
    back = nearest[1] < nearest[0]
    arc = np.where(back, 2 * length - from_start, from_start)
    return Ordering(arc, 2 * length, True)
