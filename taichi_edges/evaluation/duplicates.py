"""How much of the length of a set of edges says again what a longer edge says already."""

from collections.abc import Sequence

import numpy as np

from taichi_edges.evaluation.dense_curves import middle_samples

DUPLICATE_SPACING = 0.002  # normalised units between samples: reads a distance of 5 mm at most 0.1 mm too long
DUPLICATE_DISTANCE = 0.005  # normalised units: the finest threshold, below which two edges tell the metrics the same
DUPLICATE_COSINE = 0.9  # between tangents: edges that meet at more than 26 degrees never count as parallel


def duplicated_percent(polylines: Sequence[np.ndarray], sources: np.ndarray) -> float:
    """Percent of the length of the polylines that repeats what another, longer edge says already.

    polylines: list of (m, 3). sources: (P,) int, pieces of one edge share it.
    Pieces are counted one after the other: those of the longest edge (summed over its source) first, equal ones as
    they come. A stretch of a piece is a duplicate where, for one of the pieces counted before it,
    * the nearest point of that piece is at most DUPLICATE_DISTANCE away and not a duplicate itself;
    * the two tangents there are parallel: |cos| >= DUPLICATE_COSINE;
    * that point lies beside the stretch, not before it: where the other piece has already ended, the stretch goes on
      with it and repeats nothing. So pieces of one circle, and lines that continue each other, are no duplicates of
      each other, but a piece that runs back over another is one, even of the same source.
    Edges that meet or cross at more than 26 degrees never count; those that meet at a sharper angle (a spline that
    touches a circle) do, near the corner, and so do true edges less than 5 mm apart: compare with the number of the
    truth itself.
    """
    points, tangents, steps, pieces, ends = middle_samples(polylines, DUPLICATE_SPACING)
    total = steps.sum()
    if not total:
        return 0.0
    rank = rank_pieces(np.bincount(pieces, weights=steps, minlength=len(polylines)), sources)
    later, earlier = neighbours_counted_before(points, pieces, rank)
    offset = points[later] - points[earlier]
    parallel = np.abs((tangents[later] * tangents[earlier]).sum(axis=1)) >= DUPLICATE_COSINE
    outward = (offset * tangents[earlier]).sum(axis=1)
    # A sample stands for half a step to each side; the quarter closes the gap where two pieces of a bent curve join.
    reach = steps[earlier] / 2 + steps[later] / 4
    beyond = ((ends[earlier, 0]) & (outward < -reach)) | ((ends[earlier, 1]) & (outward > reach))
    beside = parallel & ~beyond
    duplicated = mark_in_turn(later[beside], earlier[beside], rank[pieces])
    return float(100.0 * steps[duplicated].sum() / total)


def rank_pieces(lengths: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """(P,) lengths and sources -> (P,) the turn in which each piece is counted: 0 for a piece of the longest edge."""
    _, edge = np.unique(sources, return_inverse=True)
    edge_lengths = np.bincount(edge, weights=lengths)
    order = np.lexsort((np.arange(len(lengths)), edge, -edge_lengths[edge]))
    rank = np.empty(len(lengths), dtype=np.int64)
    rank[order] = np.arange(len(lengths))
    return rank


def neighbours_counted_before(
    points: np.ndarray, pieces: np.ndarray, rank: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """For every sample, the nearest sample of each piece counted before its own, if within DUPLICATE_DISTANCE.

    Returns two (k,) index arrays: the sample, and its neighbour on the earlier piece.
    """
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(DUPLICATE_DISTANCE, output_type="ndarray")
    pairs = pairs[pieces[pairs[:, 0]] != pieces[pairs[:, 1]]]
    swap = rank[pieces[pairs[:, 0]]] < rank[pieces[pairs[:, 1]]]
    later, earlier = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])
    distances = np.linalg.norm(points[later] - points[earlier], axis=1)
    order = np.lexsort((distances, pieces[earlier], later))
    later, earlier = later[order], earlier[order]
    nearest = np.ones(len(order), dtype=bool)
    nearest[1:] = (np.diff(later) != 0) | (np.diff(pieces[earlier]) != 0)
    return later[nearest], earlier[nearest]


def mark_in_turn(later: np.ndarray, earlier: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """(n,) bool: the samples that repeat one which is not a duplicate itself, decided turn by turn.

    later, earlier: (k,) pairs of samples. turns: (n,) the turn of every sample.
    """
    duplicated = np.zeros(len(turns), dtype=bool)
    order = np.argsort(turns[later], kind="stable")
    later, earlier = later[order], earlier[order]
    borders = np.flatnonzero(np.diff(turns[later])) + 1
    for now, before in zip(np.split(later, borders), np.split(earlier, borders), strict=True):
        duplicated[now[~duplicated[before]]] = True
    return duplicated
