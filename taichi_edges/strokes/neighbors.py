"""Neighbourhoods of oriented points, and the members of labelled clusters."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

UNASSIGNED = -1


def members_of_clusters(labels: np.ndarray) -> list[np.ndarray]:
    """The points of every cluster: a list of ascending index arrays, one for each of the labels 0, 1, ..

    labels: (n,) ints, UNASSIGNED for none. One sort, however many clusters there are.
    """
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.arange(labels.max(initial=UNASSIGNED) + 2))
    return [order[start:end] for start, end in pairwise(bounds)]


@dataclass(frozen=True)
class NeighborGraph:
    """For each point its nearest others within reach, nearest first.

    indices: (n, k), -1 where there are fewer. offsets: (n, k, 3) neighbour minus point. distances: (n, k).
    """

    indices: np.ndarray
    offsets: np.ndarray
    distances: np.ndarray


def neighbor_graph(points: np.ndarray, count: int, reach: float) -> NeighborGraph:
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


def alignment(directions: np.ndarray, graph: NeighborGraph) -> np.ndarray:
    """(n, k) |d_j . (x_j - x_i)| / |x_j - x_i|: does the neighbour's orientation follow the line that joins the two?

    Neighbours at the very same place count as aligned.
    """
    lengths = np.linalg.norm(graph.offsets, axis=2)
    along = np.abs(np.einsum("nkc,nkc->nk", directions[graph.indices], graph.offsets))
    return np.where(lengths > 0, along / np.maximum(lengths, 1e-300), 1.0)
