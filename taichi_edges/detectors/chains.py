"""Chains of edgels: what is connected in a view, and how long it is. Texture is short; edges are long."""

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

LINK_PX = 1.6  # between edgels next to each other on a chain; they are about 1 px apart
LINK_COSINE = np.cos(np.radians(25.0))  # between their normals
SURE_PX = 8.0  # px of a chain that say as much as one edgel alone: those beside each other share their noise
BESIDE_PX = 0.7  # by which the next edgel may be off the line of the one before


def chain_labels(edgels):
    """(e,) int: the chain of each of the Edgels; chains are numbered over all views."""
    counts, labels = 0, []
    for view in range(edgels.view_count):
        points, normals, _ = edgels.of_view(view)
        found, some = _chains_of(points, normals)
        labels.append(some + counts)
        counts += found
    return np.concatenate([np.zeros(0, np.int64), *labels])


def _chains_of(points, normals):
    """Number of chains in one view, and (n,) the chain of each edgel. points: (n, 2) px. normals: (n, 2)."""
    if not len(points):
        return 0, np.zeros(0, np.int64)
    pairs = cKDTree(points).query_pairs(LINK_PX, output_type="ndarray")
    one, other = pairs.T
    aligned = np.abs((normals[one] * normals[other]).sum(axis=1)) >= LINK_COSINE
    apart = points[other] - points[one]
    beside = np.minimum(np.abs((apart * normals[one]).sum(axis=1)), np.abs((apart * normals[other]).sum(axis=1)))
    linked = aligned & (beside <= BESIDE_PX)
    graph = coo_matrix((np.ones(linked.sum(), bool), (one[linked], other[linked])), (len(points), len(points)))
    return connected_components(graph, directed=False)


def chain_lengths(edgels):
    """(e,) number of edgels on the chain of each edgel: its length in pixels, roughly."""
    labels = chain_labels(edgels)
    return np.bincount(labels)[labels] if len(labels) else np.zeros(0, np.int64)


def with_long_chains(edgels, least, height, width):
    """The Edgels on chains of at least `least` edgels, as `with_chain_strengths` makes them."""
    edgels, lengths = with_chain_strengths(edgels, height, width)
    return edgels.keep(lengths >= least)


def with_chain_strengths(edgels, height, width):
    """The Edgels with their chain's say in how sure they are and how they run, and (e,) the length of its chain each.

    An edgel is as sure as its whole chain, if each SURE_PX of that could be wrong by themselves, and its normal is the
    chain's there. ti.init must have been called. height, width: pixels.
    """
    from taichi_edges.kernels.smoothing import with_smooth_normals

    edgels = with_smooth_normals(edgels, height, width)
    lengths = chain_lengths(edgels)
    doubt = (1.0 - edgels.strengths) ** np.maximum(lengths / SURE_PX, 1.0)  # a short chain says nothing against it
    return replace(edgels, strengths=(1.0 - doubt).astype(np.float32)), lengths
