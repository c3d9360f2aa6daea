"""Chains of edgels: what is connected in a view, and how long it is. Texture is short; edges are long."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.components import components
from taichi_edges.views.edgels import Edgels

LINK_PX = 1.6  # between edgels next to each other on a chain; they are about 1 px apart
LINK_COSINE = np.cos(np.radians(25.0))  # between their normals
SURE_PX = 8.0  # px of a chain that say as much as one edgel alone: those beside each other share their noise
BESIDE_PX = 0.7  # by which the next edgel may be off the line of the one before


def chain_labels(edgels: Edgels) -> np.ndarray:
    """(e,) int: the chain of each of the Edgels; chains are numbered over all views."""
    counts = 0
    labels: list[np.ndarray] = []
    for view in range(edgels.view_count):
        points, normals, _ = edgels.of_view(view)
        found, some = _chains_of(points, normals)
        labels.append(some + counts)
        counts += found
    return np.concatenate([np.zeros(0, np.int64), *labels])


def _chains_of(points: np.ndarray, normals: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of chains in one view, and (n,) the chain of each edgel. points: (n, 2) px. normals: (n, 2)."""
    if not len(points):
        return 0, np.zeros(0, np.int64)
    one, other, cosines, beside = links_between(points, normals, LINK_PX)
    linked = (cosines >= LINK_COSINE) & (beside.min(axis=0) <= BESIDE_PX)
    labels = components(len(points), one[linked], other[linked])
    return labels.max() + 1, labels


def links_between(
    points: np.ndarray, normals: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of edgels of one view that may follow each other: first and second (k,), absolute cosines (k,) between
    their normals, and (2, k) px by which each is off the line through the other one.

    points, normals: (n, 2) px. reach: px, between them at most.
    """
    first, second = cKDTree(points).query_pairs(reach, output_type="ndarray").T
    cosines = np.abs((normals[first] * normals[second]).sum(axis=1))
    way = points[second] - points[first]
    return first, second, cosines, np.abs([(way * normals[end]).sum(axis=1) for end in (first, second)])


def chain_lengths(edgels: Edgels) -> np.ndarray:
    """(e,) number of edgels on the chain of each edgel: its length in pixels, roughly."""
    labels = chain_labels(edgels)
    return np.bincount(labels)[labels] if len(labels) else np.zeros(0, np.int64)


def with_chain_strengths(edgels: Edgels, height: int, width: int) -> tuple[Edgels, np.ndarray]:
    """The Edgels with their chain's say in how sure they are and how they run, and (e,) the length of its chain each.

    An edgel is as sure as its whole chain, if each SURE_PX of that could be wrong by themselves, and its normal is the
    chain's there. ti.init must have been called. height, width: pixels.
    """
    from taichi_edges.detectors.smoothing import with_smooth_normals

    edgels = with_smooth_normals(edgels, height, width)
    lengths = chain_lengths(edgels)
    doubt = (1.0 - edgels.strengths) ** np.maximum(lengths / SURE_PX, 1.0)  # a short chain says nothing against it
    return replace(edgels, strengths=(1.0 - doubt).astype(np.float32)), lengths
