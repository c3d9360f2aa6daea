"""Straight runs of edgels in the views: bent chains are cut, and what one straight line continues is joined."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.components import components
from taichi_edges.detectors.chains import links_between

if TYPE_CHECKING:
    from taichi_edges.views.edgels import Edgels

LINKED_PX, LINKED_BESIDE_PX = 1.6, 0.8  # edgels of one 2D edge: apart, to the side
LINKED_COSINE = np.sqrt(1 - 0.25**2)  # between their normals, 14 degrees
BEND_PX = 0.8  # an edgel farther from the straight line through a run of them shows that it bends
SPLITS = 12  # rounds in which bent runs are halved
BRIDGED_PX = 12.0  # gap in a straight run where another edge crosses it
BRIDGINGS = 6  # rounds in which pairs of parts are joined
LEAST_LENGTH_PX = 15.0  # of a straight run
LEAST_EDGELS = 5  # of a part of one


@dataclass(frozen=True)
class StraightRuns(Columns):
    """Straight runs of edgels. views: (n,). ends: (n, 2, 2) px."""

    views: np.ndarray
    ends: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """(n,) px."""
        return np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1)

    @property
    def along(self) -> np.ndarray:
        """(n, 2) unit vectors."""
        return (self.ends[:, 1] - self.ends[:, 0]) / np.maximum(self.lengths, 1e-300)[:, None]


def runs_of(edgels: "Edgels", free: np.ndarray) -> StraightRuns:
    """The StraightRuns of those Edgels that are free, (e,) bool."""
    views, ends = [np.zeros(0, np.int64)], [np.zeros((0, 2, 2))]
    for view in range(edgels.view_count):
        mine = free[edgels.starts[view] : edgels.starts[view + 1]]
        points, normals, _ = edgels.of_view(view)
        found = straight_runs(points[mine].astype(np.float64), normals[mine].astype(np.float64))
        views.append(np.full(len(found), view))
        ends.append(found)
    return StraightRuns(np.concatenate(views), np.concatenate(ends))


def straight_runs(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 2, 2) ends, px, of the straight runs among the edgels of one view. points, normals: (m, 2)."""
    labels = chains(points, normals)
    points, labels = straightened(points, labels)
    if not len(points):
        return np.zeros((0, 2, 2))
    moments = moments_of(points, labels)
    ends = ends_of(points, labels, *axes_of(moments))
    ends = bridged(ends, moments)
    return ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= LEAST_LENGTH_PX]


def chains(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(m,) labels of edgels, the same for those that follow each other on a smooth 2D edge."""
    if not len(points):
        return np.zeros(0, np.int64)
    first, second, cosines, beside = links_between(points, normals, LINKED_PX)
    linked = (cosines >= LINKED_COSINE) & (beside.max(axis=0) <= LINKED_BESIDE_PX)
    return components(len(points), first[linked], second[linked])


def straightened(points: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of straight runs and their labels, 0 .. n - 1: bent runs are cut where they are farthest off."""
    done_points, done_labels, count = [np.zeros((0, 2))], [np.zeros(0, np.int64)], 0
    for _ in range(SPLITS):
        labels, sizes = np.unique(labels, return_inverse=True, return_counts=True)[1:]
        long = (sizes >= LEAST_EDGELS)[labels]
        points, labels = points[long], np.unique(labels[long], return_inverse=True)[1]
        if not len(points):
            break
        means, axes = axes_of(moments_of(points, labels))
        bent, pieces = halved(points, labels, means, axes)
        straight = ~bent[labels]
        names = np.cumsum(~bent) - 1 + count
        done_points.append(points[straight])
        done_labels.append(names[labels[straight]])
        count += int((~bent).sum())
        points, labels = points[~straight], pieces[~straight]
    return np.concatenate(done_points), np.concatenate(done_labels)


def halved(
    points: np.ndarray, labels: np.ndarray, means: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool, whether a run bends; and (m,) labels of its halves, cut where it is farthest from its chord."""
    way = ((points - means[labels]) * axes[labels]).sum(axis=1)
    first, last = (farthest(sign * way, labels) for sign in (-1.0, 1.0))
    off = off_lines(points, means[labels], axes[labels])
    bent = off[farthest(off, labels)] > BEND_PX
    chords = points[last] - points[first]
    chords = chords / np.maximum(np.linalg.norm(chords, axis=1, keepdims=True), 1e-300)
    corner = way[farthest(off_lines(points, points[first][labels], chords[labels]), labels)]
    low, high = way[first], way[last]
    inside = np.minimum(corner - low, high - corner) > LINKED_PX
    cut = np.where(inside, corner, 0.5 * (low + high))
    return bent, 2 * labels + (way > cut[labels])


def off_lines(points: np.ndarray, starts: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(n,) distances of points (n, 2) from lines through (n, 2) points along (n, 2) unit vectors."""
    offsets = points - starts
    return np.abs(offsets[:, 0] * along[:, 1] - offsets[:, 1] * along[:, 0])


def farthest(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(n,) index of the greatest of the values (m,) with each label."""
    order = np.lexsort((values, labels))
    return order[np.flatnonzero(np.diff(labels[order], append=-1))]


def extremes(values: np.ndarray, labels: np.ndarray, function: np.ufunc) -> np.ndarray:
    """(n,) np.minimum or np.maximum of the values (m,) with each label."""
    found = np.full(labels.max(initial=-1) + 1, np.inf if function is np.minimum else -np.inf)
    function.at(found, labels, values)
    return found


def moments_of(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(n, 6) count, sums of x, y, xx, xy, yy of the points with each label; those of a union are the sum."""
    x, y = points.T
    columns = (np.ones(len(points)), x, y, x * x, x * y, y * y)
    return np.column_stack([np.bincount(labels, column) for column in columns])


def axes_of(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) means and (n, 2) unit vectors along the points with such moments."""
    means = moments[:, 1:3] / moments[:, :1]
    xx = moments[:, 3] / moments[:, 0] - means[:, 0] ** 2
    xy = moments[:, 4] / moments[:, 0] - means[:, 0] * means[:, 1]
    yy = moments[:, 5] / moments[:, 0] - means[:, 1] ** 2
    angles = 0.5 * np.arctan2(2 * xy, xx - yy)
    return means, np.column_stack([np.cos(angles), np.sin(angles)])


def ends_of(points: np.ndarray, labels: np.ndarray, means: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(n, 2, 2) ends of the runs: their outermost points, on the line through all."""
    way = ((points - means[labels]) * axes[labels]).sum(axis=1)
    low, high = extremes(way, labels, np.minimum), extremes(way, labels, np.maximum)
    return means[:, None] + np.stack([low, high], axis=1)[:, :, None] * axes[:, None]


def bridged(ends: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """The ends of runs, those that continue each other on one straight line joined. moments: (n, 6) of their points."""
    for _ in range(BRIDGINGS):
        first, second = continuing(ends)
        if not len(first):
            break
        labels = np.arange(len(ends))
        labels[second] = first
        labels = np.unique(labels, return_inverse=True)[1]
        moments = np.column_stack([np.bincount(labels, column) for column in moments.T])
        ends = ends_of(ends.reshape(-1, 2), np.repeat(labels, 2), *axes_of(moments))
    return ends


def continuing(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of runs that continue each other, first and second (k,): each the other's best."""
    places, outer = ends.reshape(-1, 2), ends[:, ::-1].reshape(-1, 2)
    a, b = cKDTree(places).query_pairs(BRIDGED_PX, output_type="ndarray").T
    chord = outer[b] - outer[a]
    chord = chord / np.maximum(np.linalg.norm(chord, axis=1, keepdims=True), 1e-300)
    off = np.maximum(*(off_lines(places[end], outer[a], chord) for end in (a, b)))
    ahead = ((places[b] - places[a]) * chord).sum(axis=1) >= -LINKED_PX
    good = (a // 2 != b // 2) & ahead & (off <= BEND_PX)
    a, b = a[good] // 2, b[good] // 2
    order = np.lexsort((b, a, off[good]))
    a, b, rank = a[order], b[order], np.arange(len(order))
    best = np.full(len(ends), len(order))
    for run in (a, b):
        np.minimum.at(best, run, rank)
    mutual = (best[a] == rank) & (best[b] == rank)
    return a[mutual], b[mutual]
