"""Curves as dense polylines, for distances to them that are as good as exact, and samples along curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.ranges import ragged

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

STEP = 0.0005  # normalised units between the vertices: far less than the radius of any edge that views can resolve


@dataclass(frozen=True)
class DenseCurves:
    """Polylines with vertices at most STEP apart.

    points:   (n, 3) vertices, one polyline after the other.
    owners:   (n,) int, the polyline of each vertex, in ascending order.
    tangents: (n, 3) unit direction of the chord that starts at each vertex; at the last one, of the chord before it.
    """

    points: np.ndarray
    owners: np.ndarray
    tangents: np.ndarray

    @cached_property
    def tree(self) -> "cKDTree":
        """k-d tree of the vertices."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) points -> (n,) distances to the nearest curve; infinite where there is none."""
        if not len(self.points) or not len(points):
            return np.full(len(points), np.inf)
        return self.distances_near(points, self.tree.query(points)[1])

    def distances_near(self, points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """(n,) distances of points (n, 3) to the chords on both sides of the vertices (n,) that are nearest to them.

        A vertex is up to half a STEP from the foot of the perpendicular; the chords are not.
        """
        found = np.linalg.norm(points - self.points[vertices], axis=1)
        for side in (-1, 1):
            other = np.clip(vertices + side, 0, len(self.points) - 1)
            other = np.where(self.owners[other] == self.owners[vertices], other, vertices)
            chord = self.points[other] - self.points[vertices]
            along = ((points - self.points[vertices]) * chord).sum(axis=1)
            share = np.clip(along / np.maximum((chord**2).sum(axis=1), 1e-300), 0.0, 1.0)
            feet = self.points[vertices] + share[:, None] * chord
            found = np.minimum(found, np.linalg.norm(points - feet, axis=1))
        return found

    def within(self, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Which curves pass within `radius` of which of the (n, 3) points.

        Returns the index of the point, of the polyline, of the polyline's vertex that is nearest to the point, and the
        distance, each (k,), in the order of points and polylines.
        """
        if not len(self.points) or not len(points):
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
        from scipy.spatial import cKDTree

        pairs = cKDTree(points).sparse_distance_matrix(self.tree, radius + STEP / 2, output_type="ndarray")
        order = np.lexsort((pairs["j"], pairs["v"], self.owners[pairs["j"]], pairs["i"]))
        at, vertices = pairs["i"][order], pairs["j"][order]
        first = np.ones(len(at), dtype=bool)
        first[1:] = (np.diff(at) != 0) | (np.diff(self.owners[vertices]) != 0)
        at, vertices = at[first], vertices[first]
        found = self.distances_near(points[at], vertices)
        near = found <= radius
        return at[near], self.owners[vertices[near]], vertices[near], found[near]


def dense_curves(polylines: Sequence[np.ndarray]) -> DenseCurves:
    """A list of (m, 3) polylines -> DenseCurves, every vertex of theirs kept; one of no length has no chord."""
    points, owners, tangents = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for index, polyline in enumerate(polylines):
        vertices, directions = subdivided(np.asarray(polyline, dtype=np.float64))
        points.append(vertices)
        tangents.append(directions)
        owners.append(np.full(len(vertices), index))
    return DenseCurves(np.concatenate(points), np.concatenate(owners), np.concatenate(tangents))


def subdivided(polyline: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m, 3) polyline -> (n, 3) vertices at most STEP apart, and the (n, 3) `tangents` of DenseCurves."""
    chords = np.diff(polyline, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    starts, chords, lengths = polyline[:-1][lengths > 0], chords[lengths > 0], lengths[lengths > 0]
    if not len(lengths):
        return polyline[:1], np.zeros((1, 3))
    counts = np.ceil(lengths / STEP).astype(np.int64)
    chord, number = ragged(counts)
    vertices = starts[chord] + (number / counts[chord])[:, None] * chords[chord]
    directions = (chords / lengths[:, None])[chord]
    return np.concatenate([vertices, polyline[-1:]]), np.concatenate([directions, directions[-1:]])


def middle_samples(polylines: Sequence[np.ndarray], spacing: float) -> tuple[np.ndarray, ...]:
    """The middles of equal steps of at most `spacing` along each polyline; none for one of no length.

    Returns points (n, 3), unit tangents (n, 3), step lengths (n,), the index of the polyline (n,), and (n, 2) bool:
    whether the sample is the first, the last of its polyline.
    """
    parts = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 2), bool))]
    for index, polyline in enumerate(polylines):
        chords = np.diff(polyline, axis=0)
        lengths = np.linalg.norm(chords, axis=1)
        chords, lengths, starts = chords[lengths > 0], lengths[lengths > 0], polyline[:-1][lengths > 0]
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        count = int(np.ceil(arc[-1] / spacing))
        at = (np.arange(count) + 0.5) * arc[-1] / max(count, 1)
        chord = np.minimum(np.searchsorted(arc, at, side="right") - 1, len(lengths) - 1)
        tangents = chords[chord] / lengths[chord, None]
        points = starts[chord] + (at - arc[chord])[:, None] * tangents
        number = np.arange(count)
        ends = np.stack([number == 0, number == count - 1], axis=1)
        parts.append((points, tangents, np.full(count, arc[-1] / max(count, 1)), np.full(count, index), ends))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))
