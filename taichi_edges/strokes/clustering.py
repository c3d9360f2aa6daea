"""Clusters of oriented points by graph traversal (paper 3.3)."""

import heapq
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.strokes.neighbors import UNASSIGNED, NeighborGraph, alignment, neighbor_graph

if TYPE_CHECKING:
    from taichi_edges.scene.settings import ClusterConfig

DIRECTION_MEMORY = 0.7  # share of the edge grown so far in its running direction, against the newest point's


def seed_order(points: np.ndarray, directions: np.ndarray, graph: NeighborGraph, aligned: np.ndarray) -> np.ndarray:
    """Point indices, best seeds first: those that agree most with all their neighbours.

    Ties, and with them the whole traversal, are decided by the coordinates and not by the order of the input.
    """
    present = graph.indices >= 0
    parallel = np.abs(np.einsum("nc,nkc->nk", directions, directions[graph.indices]))
    agreement = np.where(present, parallel * aligned, 0.0).sum(axis=1)
    return np.lexsort((points[:, 2], points[:, 1], points[:, 0], -agreement))


def grow_clusters(points: np.ndarray, directions: np.ndarray, config: "ClusterConfig") -> np.ndarray:
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
    seeds = seed_order(points, directions, graph, aligned)
    follows = (graph.indices >= 0) & (aligned >= config.theta)
    return _by_size(np.array(_traverse(seeds, directions, graph, follows, config.theta)), config.min_points)


def _traverse(
    seeds: np.ndarray, directions: np.ndarray, graph: NeighborGraph, follows: np.ndarray, theta: float
) -> list[int]:
    """The number of the seed from which every point is reached, a list (n,).

    follows: (n, k) bool, the neighbours that lie along the point's own direction or theirs.
    """
    # Python's own lists and floats: reading single numbers out of arrays would take ten times longer.
    bounds = np.concatenate([[0], np.cumsum(follows.sum(axis=1))]).tolist()
    neighbors, lengths = graph.indices[follows].tolist(), graph.distances[follows].tolist()
    own = directions.tolist()
    labels, running = [UNASSIGNED] * len(own), list(own)
    for label, seed in enumerate(seeds.tolist()):
        if labels[seed] != UNASSIGNED:
            continue
        labels[seed] = label
        queue = [(0.0, seed)]
        while queue:
            travelled, point = heapq.heappop(queue)
            direction = running[point]
            for slot in range(bounds[point], bounds[point + 1]):
                neighbor = neighbors[slot]
                if labels[neighbor] == UNASSIGNED and (blend := _blended(direction, own[neighbor], theta)):
                    labels[neighbor], running[neighbor] = label, blend
                    heapq.heappush(queue, (travelled + lengths[slot], neighbor))
    return labels


def _blended(running: Sequence[float], newest: Sequence[float], theta: float) -> tuple[float, float, float] | None:
    """The running direction after a point of direction `newest`, whose sign is arbitrary; None where they disagree."""
    (a, b, c), (x, y, z) = running, newest
    cosine = a * x + b * y + c * z
    if abs(cosine) < theta:
        return None
    share = math.copysign(1 - DIRECTION_MEMORY, cosine) if cosine else 0.0
    a, b, c = DIRECTION_MEMORY * a + share * x, DIRECTION_MEMORY * b + share * y, DIRECTION_MEMORY * c + share * z
    length = math.sqrt(a * a + b * b + c * c)
    return a / length, b / length, c / length


def _by_size(labels: np.ndarray, minimum: int) -> np.ndarray:
    """Labels renumbered by falling size (ties: first seed first); clusters below `minimum` become UNASSIGNED."""
    found, cluster, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    numbers = np.empty(len(found), int)
    numbers[np.lexsort((found, -sizes))] = np.arange(len(found))
    numbers[sizes < minimum] = UNASSIGNED
    return numbers[cluster]
