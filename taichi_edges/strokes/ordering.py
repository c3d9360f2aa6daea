"""Order along a cluster: the arc length of every point, and whether the cluster closes on itself."""

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from taichi_edges.arrays.components import components_of
from taichi_edges.fitting.cubic_chains import Ordering
from taichi_edges.strokes.neighbors import members_of_clusters

GRAPH_NEIGHBORS = 8
REACH = 3.0  # graph edges longer than this many times the longest gap of the spanning tree are shortcuts
WAIST = (0.25, 0.75)  # of the longest walk: an open edge is one strip here, a closed one two
SPAN = 0.6  # of the waist that a strip reaches through at least


def order_points(points: np.ndarray) -> Ordering:
    """Order the (n, 3) points of one cluster along their edge, by geodesic distance in their neighbour graph."""
    graph = connected_graph(points)
    start = extremity(graph)
    from_start = dijkstra(graph, indices=start)
    length = float(from_start.max())
    strips = two_sides(graph, from_start)
    if strips is None:
        return Ordering(from_start, length, False)
    return _unroll(graph, from_start, length, strips)


def extremity(graph: csr_array) -> int:
    """The point farthest along the graph from an arbitrary one: an end of an open edge."""
    return int(np.argmax(dijkstra(graph, indices=0)))


def connected_graph(points: np.ndarray) -> csr_array:
    """(n, n) sparse, symmetric graph of near neighbours that is connected: the spanning tree is always part of it."""
    count = min(GRAPH_NEIGHBORS + 1, len(points))
    distances, indices = cKDTree(points).query(points, count)
    rows = np.repeat(np.arange(len(points)), count - 1)
    columns, lengths = indices[:, 1:].ravel(), distances[:, 1:].ravel()
    lengths = np.maximum(lengths, 1e-12)  # a sparse graph takes a zero for a missing edge
    full = coo_array((lengths, (rows, columns)), shape=(len(points),) * 2).tocsr()
    full = full.maximum(full.T)
    labels = components_of(full)
    if labels.any():
        full = join_pieces(points, full, labels)
    tree = minimum_spanning_tree(full)
    if tree.nnz:
        full.data[full.data > REACH * tree.data.max()] = 0.0
        full.eliminate_zeros()
    return full


def join_pieces(points: np.ndarray, graph: csr_array, labels: np.ndarray) -> csr_array:
    """Join the pieces of a graph by their shortest connections, one piece after the other to that of label 0."""
    pieces = members_of_clusters(labels)
    newest, outside = pieces[0], np.flatnonzero(labels)
    gaps, nearest = np.full(len(points), np.inf), np.zeros(len(points), int)  # from the points outside to those joined
    bridges = []
    while len(outside):
        distances, found = cKDTree(points[newest]).query(points[outside])
        nearer = distances < gaps[outside]
        gaps[outside[nearer]], nearest[outside[nearer]] = distances[nearer], newest[found[nearer]]
        best = outside[np.argmin(gaps[outside])]
        bridges.append(best)
        newest = pieces[labels[best]]
        outside = outside[labels[outside] != labels[best]]
    ends, lengths = (nearest[bridges], bridges), np.maximum(gaps[bridges], 1e-12)
    added = coo_array((lengths, ends), shape=graph.shape).tocsr()
    return graph.maximum(added).maximum(added.T)


def two_sides(graph: csr_array, from_start: np.ndarray) -> list[np.ndarray] | None:
    """The two strips (arrays of indices) of which a closed edge consists at its waist; None for an open edge.

    Each strip must reach through the whole waist, since a mere gap in an open edge leaves pieces that share it out; and
    beyond the start the two must come together again, which the arms of a fork do not.
    """
    length = from_start.max()
    waist = np.flatnonzero((from_start >= WAIST[0] * length) & (from_start <= WAIST[1] * length))
    labels = components_of(graph[waist][:, waist])
    strips = [waist[members] for members in members_of_clusters(labels)]
    least = SPAN * (WAIST[1] - WAIST[0]) * length
    strips = [strip for strip in strips if np.ptp(from_start[strip]) >= least]
    if len(strips) != 2:
        return None
    beyond = np.flatnonzero(from_start >= WAIST[0] * length)
    sides = components_of(graph[beyond][:, beyond])
    meeting = np.isin(beyond, strips[0]), np.isin(beyond, strips[1])
    return strips if set(sides[meeting[0]]) & set(sides[meeting[1]]) else None


def _unroll(graph: csr_array, from_start: np.ndarray, length: float, strips: list[np.ndarray]) -> Ordering:
    """Arc length around a closed edge: out on one side (0 .. L), back on the other (L .. 2 L)."""
    # Which arm a point is on: the side whose waist it reaches without passing start or far end, that is, the nearer.
    nearest = [dijkstra(graph, indices=strip, min_only=True) for strip in strips]
    back = nearest[1] < nearest[0]
    arc = np.where(back, 2 * length - from_start, from_start)
    return Ordering(arc, 2 * length, True)
