"""Edges as a graph: where they end, and what is joined with what. Truth and prediction alike.

edge      one source of an EdgeSet, or one primitive of the truth; its pieces are polylines.
end       an end of a piece, unless another piece of the same edge, or the piece itself, goes on from there smoothly.
joined    two ends, or an end and a point along another piece, that are at most JOINED apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taichi_edges.evaluation.dense_curves import DenseCurves, dense_curves
from taichi_edges.evaluation.primitives import CORNER_DEGREES, JOINED


@dataclass(frozen=True)
class EdgeGraph:
    """Edges as a graph sees them.

    polylines: list of (m, 3) pieces. edges: (P,) int, the edge of each piece, numbered from 0.
    """

    polylines: list[np.ndarray]
    edges: np.ndarray

    @cached_property
    def dense(self) -> DenseCurves:
        """DenseCurves of the pieces."""
        return dense_curves(self.polylines)

    @cached_property
    def lengths(self) -> np.ndarray:
        """(E,) the length of each edge."""
        sizes = [np.linalg.norm(np.diff(polyline, axis=0), axis=1).sum() for polyline in self.polylines]
        return np.bincount(self.edges, weights=sizes)

    @cached_property
    def ends(self) -> "Ends":
        """The Ends of all edges."""
        return edge_ends(self.polylines, self.edges)

    @cached_property
    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Two (k,) arrays, an end and a piece that it is joined with: another's interior, or any other end."""
        return contacts_of(self)


@dataclass(frozen=True)
class Ends:
    """points: (k, 3). outward: (k, 3) unit direction into the edge. pieces, edges: (k,) whose end it is."""

    points: np.ndarray
    outward: np.ndarray
    pieces: np.ndarray
    edges: np.ndarray


def edge_graph(polylines: Sequence[np.ndarray], sources: np.ndarray | Sequence[int]) -> EdgeGraph:
    """Pieces (m, 3) and the (P,) source of each -> EdgeGraph; pieces of no length are left out."""
    sizes = np.array([np.ptp(polyline, axis=0).max() for polyline in polylines])
    kept = np.flatnonzero(sizes > 0)
    _, edges = np.unique(np.asarray(sources, dtype=np.int64)[kept], return_inverse=True)
    return EdgeGraph([polylines[index] for index in kept.tolist()], edges)


def edge_ends(polylines: Sequence[np.ndarray], edges: np.ndarray) -> Ends:
    """The Ends of the pieces at which the edge does not go on."""
    if not polylines:
        return Ends(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    pieces = np.repeat(np.arange(len(polylines)), 2)
    points = np.array([point for polyline in polylines for point in (polyline[0], polyline[-1])])
    outward = np.array([direction_from(p) for polyline in polylines for p in (polyline, polyline[::-1])])
    one, other = close_pairs(points).T
    angle_cosine = -(outward[one] * outward[other]).sum(axis=1)
    goes_on = (edges[pieces[one]] == edges[pieces[other]]) & (angle_cosine >= np.cos(np.radians(CORNER_DEGREES)))
    kept = np.ones(len(points), dtype=bool)
    kept[np.concatenate([one[goes_on], other[goes_on]])] = False
    return Ends(points[kept], outward[kept], pieces[kept], edges[pieces[kept]])


def direction_from(polyline: np.ndarray) -> np.ndarray:
    """(m, 3) polyline -> unit direction of its first chord that has a length."""
    chords = np.diff(polyline, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    first = int(np.argmax(lengths > 0))
    return chords[first] / lengths[first]


def close_pairs(points: np.ndarray) -> np.ndarray:
    """(k, 2) pairs of the points that are at most JOINED apart, in ascending order."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.zeros((0, 2), np.int64)
    pairs = cKDTree(points).query_pairs(JOINED, output_type="ndarray")
    return pairs[np.lexsort(pairs.T[::-1])]


def contacts_of(frame: EdgeGraph) -> tuple[np.ndarray, np.ndarray]:
    """The `contacts` of an EdgeGraph. An end is always near its own piece: only the piece's other end counts there."""
    ends = frame.ends
    at, pieces, _, _ = frame.dense.within(ends.points, JOINED)
    foreign = pieces != ends.pieces[at]
    one, other = close_pairs(ends.points).T
    return (
        np.concatenate([at[foreign], one, other]),
        np.concatenate([pieces[foreign], ends.pieces[other], ends.pieces[one]]),
    )


def free_ends(frame: EdgeGraph) -> np.ndarray:
    """(f, 3) the ends of edges that nothing is joined with."""
    joined = np.zeros(len(frame.ends.points), dtype=bool)
    joined[frame.contacts[0]] = True
    return frame.ends.points[~joined]
