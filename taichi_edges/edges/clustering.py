"""Clusters of oriented points by graph traversal (paper 3.3)."""

import heapq
from dataclasses import dataclass

import numpy as np

UNASSIGNED = -1
DIRECTION_MEMORY = 0.7  # share of the edge grown so far in its running direction, against the newest point's


@dataclass(frozen=True)
class NeighborGraph:
    """For each point its nearest others within reach, nearest first.

    indices: (n, k), -1 where there are fewer. offsets: (n, k, 3) neighbour minus point. distances: (n, k).
    """

    indices: np.ndarray
    offsets: np.ndarray
    distances: np.ndarray


def neighbor_graph(points, count, reach):
    """NeighborGraph of (n, 3) points: at most `count` neighbours within `reach`, from Open3D's KD-tree."""
    import open3d as o3d

    tensor = o3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float64))
    search = o3d.core.nns.NearestNeighborSearch(tensor)
    search.knn_index()
    indices, squared = search.knn_search(tensor, min(count + 1, len(points)))
    indices, distances = indices.numpy().astype(np.int64), np.sqrt(squared.numpy())
    own = indices == np.arange(len(points))[:, None]
    indices = np.where(own | (distances > reach), -1, indices)
    offsets = points[indices] - points[:, None]
    return NeighborGraph(indices, offsets, distances)


def alignment(directions, graph):
    """(n, k) |d_j . (x_j - x_i)| / |x_j - x_i|: does the neighbour's orientation follow the line that joins the two?

    Neighbours at the very same place count as aligned.
    """
    lengths = np.linalg.norm(graph.offsets, axis=2)
    along = np.abs(np.einsum("nkc,nkc->nk", directions[graph.indices], graph.offsets))
    return np.where(lengths > 0, along / np.maximum(lengths, 1e-300), 1.0)


def seed_order(points, directions, graph, aligned):
    """Point indices, best seeds first: those that agree most with all their neighbours.

    Ties, and with them the whole traversal, are decided by the coordinates and not by the order of the input.
    """
    present = graph.indices >= 0
    parallel = np.abs(np.einsum("nc,nkc->nk", directions, directions[graph.indices]))
    agreement = np.where(present, parallel * aligned, 0.0).sum(axis=1)
    return np.lexsort((points[:, 2], points[:, 1], points[:, 0], -agreement))


def grow_clusters(points, directions, config):
    """Label every point with its cluster.

    points: (n, 3) unit cube. directions: (n, 3) unit vectors, sign arbitrary. config: the scene's `cluster` section.
    A cluster starts at a seed and grows over the neighbour graph, nearest point first. A neighbour is added when its
    orientation agrees (|cos| >= theta) with the running direction of the edge grown so far, and with the line that
    joins it to the point it is reached from.
    Returns (n,) int labels: 0.. by falling size, UNASSIGNED for points in clusters below config.min_points.
    """
    labels = np.full(len(points), UNASSIGNED)
    if len(points) < 2:
        return labels
    graph = neighbor_graph(points, config.neighbors, config.max_gap)
    aligned = alignment(directions, graph)
    for label, seed in enumerate(seed_order(points, directions, graph, aligned)):
        if labels[seed] == UNASSIGNED:
            _grow(seed, label, labels, directions, graph, aligned, config.theta)
    return _by_size(labels, config.min_points)


def _grow(seed, label, labels, directions, graph, aligned, theta):
    """Label what is reachable from the seed (changes `labels`)."""
    running = {seed: directions[seed]}
    labels[seed] = label
    queue = [(0.0, int(seed))]
    while queue:
        travelled, point = heapq.heappop(queue)
        direction = running[point]
        for slot, neighbor in enumerate(graph.indices[point]):
            if neighbor < 0 or labels[neighbor] != UNASSIGNED or aligned[point, slot] < theta:
                continue
            cosine = directions[neighbor] @ direction
            if abs(cosine) < theta:
                continue
            blend = DIRECTION_MEMORY * direction + (1 - DIRECTION_MEMORY) * np.sign(cosine) * directions[neighbor]
            running[neighbor] = blend / np.linalg.norm(blend)
            labels[neighbor] = label
            heapq.heappush(queue, (travelled + graph.distances[point, slot], int(neighbor)))


def _by_size(labels, minimum):
    """Labels renumbered by falling size (ties: first seed first); clusters below `minimum` become UNASSIGNED."""
    found, sizes = np.unique(labels, return_counts=True)
    order = np.lexsort((found, -sizes))
    renumbered = np.full(len(labels), UNASSIGNED)
    for number, index in enumerate(order):
        if sizes[index] >= minimum:
            renumbered[labels == found[index]] = number
    return renumbered
