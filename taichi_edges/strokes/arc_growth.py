"""Lines and circular arcs grown over oriented points, as far as places and directions agree."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.ranges import ragged
from taichi_edges.fitting.arc_batch import ArcBatch, fit_batch
from taichi_edges.fitting.arcs import Arc
from taichi_edges.fitting.prices import OUTLIER

INLIER = (
    OUTLIER**0.5
)  # noises: a point on an edge lies no farther from it (99 % of those of a normal distribution in a plane)
SAGITTA = 3.0  # noises that the middle of an arc is off its chord, at least; a line follows a flatter one as well
START_POINTS = 5  # aligned neighbours that a seed starts with, at least, itself included
GROWTH = 0.5  # of an arc's length: how far beyond its ends it is looked for; a longer arc foretells more
GROWTH_ROUNDS = 30
BALL = 16.0 * INLIER  # noises: length of an arc about which points are looked for at once
GROWN = 1.02  # an arc that grew by less is done
DIRECTION_NOISES = 4.0
TURNS = np.radians([10.0, 35.0])  # a point whose direction is off by more is on another edge, whatever the noise


@dataclass(frozen=True)
class Scale:
    """What the points themselves say about distances; unit-cube units and radians.

    noise: standard deviation of the points across their edge, on each of its two axes. turn: the same of directions.
    gap: points of an edge are no farther apart. spread: times the tolerance of directions is wider for coarser edges.
    """

    noise: float
    turn: float
    gap: float
    spread: float = 1.0

    @property
    def lever(self) -> float:
        """Noise of the points over that of the directions: on a stretch as short as that, directions tell more."""
        return min(self.noise / self.turn, self.gap)

    @property
    def cosine(self) -> float:
        """A point whose direction is off by more is on another edge."""
        return float(np.cos(np.clip(self.spread * max(DIRECTION_NOISES * self.turn, TURNS[0]), *TURNS)))


@dataclass(frozen=True)
class Inliers(Columns):
    """Points on a line or an arc.

    members: (n,) indices of the points. along: (n,) their arc lengths. squared: (n,) squared residuals, noises.
    """

    members: np.ndarray
    along: np.ndarray
    squared: np.ndarray


@dataclass(frozen=True)
class InliersOfArcs(Inliers):
    """Points on several lines or arcs. of: (n,) number of the arc, ascending."""

    of: np.ndarray


class Cloud:
    """Oriented points in a search tree: points, directions (n, 3), scale: Scale."""

    def __init__(self, points: np.ndarray, directions: np.ndarray, scale: Scale, tree: cKDTree | None = None) -> None:
        self.points, self.directions, self.scale = points, directions, scale
        self.tree = cKDTree(points) if tree is None else tree
        self.noises = np.full(len(points), scale.noise)

    def at_scale(self, scale: Scale) -> "Cloud":
        """The same points with another Scale."""
        return Cloud(self.points, self.directions, scale, self.tree)

    def with_noises(self, noises: np.ndarray) -> "Cloud":
        """The same points, each with a noise of its own: (n,), unit-cube units."""
        cloud = self.at_scale(self.scale)
        cloud.noises = noises
        return cloud

    def near(self, arc: Arc, low: float, high: float, tolerance: float = INLIER) -> np.ndarray:
        """Indices of the points about the arc between two arc lengths; some farther ones are among them."""
        high = min(high, low + arc.round)
        count = int((high - low) / (BALL * self.scale.noise)) + 1
        step = (high - low) / count
        radius = np.hypot(0.5 * step, tolerance * self.scale.noise) * (1 + 1e-9)
        found = self.tree.query_ball_point(arc.at(low + step * (np.arange(count) + 0.5)), radius)
        return np.unique(np.fromiter(itertools.chain.from_iterable(found), np.int64))

    def inliers(self, arc: Arc, low: float, high: float, tolerance: float = INLIER) -> Inliers:
        """The Inliers of an Arc between two arc lengths.

        tolerance: noises that they may be off.
        """
        around = self.near(arc, low, high, tolerance)
        along, offsets = replace(arc, low=low, high=high).coordinates(self.points[around])
        squared = (offsets**2).sum(axis=1) / self.scale.noise**2
        agree = np.abs((self.directions[around] * arc.tangents(along)).sum(axis=1)) >= self.scale.cosine
        good = (squared <= tolerance**2) & agree & (along >= low) & (along <= high)
        return Inliers(around[good], along[good], squared[good])

    def inliers_of(self, arcs: ArcBatch, low: np.ndarray, high: np.ndarray) -> InliersOfArcs:
        """The Inliers of the arcs of an ArcBatch, arc after arc, each between two arc lengths, (m,)."""
        of, around = self._near_each(arcs, low, high)
        stretched = ArcBatch(arcs.origin, arcs.tangent, arcs.bend, low, high, arcs.closed)
        along, offsets = stretched.coordinates(self.points[around], of)
        squared = (offsets**2).sum(axis=1) / self.scale.noise**2
        good = (squared <= INLIER**2) & (along >= low[of]) & (along <= high[of])
        on = InliersOfArcs(around, along, squared, of).keep(good)
        agree = np.abs((self.directions[on.members] * arcs.tangents(on.along, on.of)).sum(axis=1)) >= self.scale.cosine
        return on.keep(agree)

    def _near_each(self, arcs: ArcBatch, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the arcs, and indices of the points about them, (t,); some farther ones are among them."""
        high = np.minimum(high, low + arcs.round)
        counts = ((high - low) / (BALL * self.scale.noise)).astype(int) + 1
        of, place = ragged(counts)
        step = (high - low) / counts
        centres = arcs.at((low + 0.5 * step)[of] + step[of] * place, of)
        radius = np.hypot(0.5 * step, INLIER * self.scale.noise)[of] * (1 + 1e-9)
        found = self.tree.query_ball_point(centres, radius, return_sorted=False)
        around = np.fromiter(itertools.chain.from_iterable(found), np.int64)
        keys = np.unique(np.repeat(of, [len(some) for some in found]) * len(self.points) + around)
        return keys // len(self.points), keys % len(self.points)


def grow_arcs(cloud: Cloud, arcs: ArcBatch, straight: bool) -> tuple[ArcBatch, np.ndarray]:
    """The longest unbroken lines or arcs that those of an ArcBatch are parts of; (m,) bool, whether there are any."""
    scale, best, found, active = cloud.scale, arcs, np.zeros(len(arcs), bool), np.arange(len(arcs))
    for _ in range(GROWTH_ROUNDS if len(arcs) else 0):
        ahead = np.maximum(GROWTH * arcs.length, INLIER * scale.noise)
        on = cloud.inliers_of(arcs, arcs.low - ahead, arcs.high + ahead)
        inside = all_unbroken(on.of, on.along, arcs.low, arcs.high, np.minimum(ahead, scale.gap))
        enough = np.bincount(on.of[inside], minlength=len(arcs)) >= START_POINTS
        on = on.keep(inside & enough[on.of])
        of, arcs, active = (np.cumsum(enough) - 1)[on.of], arcs.keep(enough), active[enough]
        if not len(arcs):
            break
        before, starts = arcs.length, np.searchsorted(of, np.arange(len(arcs)))
        arcs = arcs.over(np.minimum.reduceat(on.along, starts), np.maximum.reduceat(on.along, starts))
        arcs = arcs.over(arcs.low, np.where(arcs.length + scale.gap >= arcs.round, arcs.low + arcs.round, arcs.high))
        places, directions, none = cloud.points[on.members], cloud.directions[on.members], np.zeros(len(arcs))
        arcs = fit_batch(arcs.recentred(), places, directions, of, none, INLIER * scale.noise, straight, 1)
        best = best.put(active, arcs)
        grows = ~found[active] | (arcs.length > GROWN * before)
        found[active] = True
        arcs, active = arcs.keep(grows), active[grows]
    return best, found


def all_unbroken(of: np.ndarray, along: np.ndarray, low: np.ndarray, high: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """(t,) bool: the points reached from their arc's stretch low..high without a step longer than its gap, (m,) each.

    of, along: (t,) number of the arc, and arc length on it.
    """
    order = np.lexsort((along, of))
    of, along = of[order], along[order]
    steps = (np.diff(along) > gap[of[1:]]) | (np.diff(of) > 0)
    run = np.concatenate([[0], np.cumsum(steps)])[: len(along)]
    counts = np.bincount(run, weights=(along >= low[of]) & (along <= high[of]))
    owner = of[np.flatnonzero(np.diff(run, prepend=-1))]  # of each run
    most = np.zeros(len(low))
    np.maximum.at(most, owner, counts)
    fullest = np.flatnonzero((counts > 0) & (counts == most[owner]))
    chosen = np.full(len(low), -1)
    chosen[owner[fullest[::-1]]] = fullest[::-1]  # of ties the first
    inside = np.empty(len(along), bool)
    inside[order] = run == chosen[of]
    return inside


def unbroken(along: np.ndarray, low: float, high: float, gap: float) -> np.ndarray:
    """(n,) bool: the points reached from the stretch low..high without a step longer than `gap`."""
    order = np.argsort(along, kind="stable")
    sorted_along = along[order]
    run = np.concatenate([[0], np.cumsum(np.diff(sorted_along) > gap)])[: len(along)]
    within = run[(sorted_along >= low) & (sorted_along <= high)]
    inside = np.zeros(len(along), bool)
    if len(within):
        counts = np.bincount(within)
        inside[order[run == counts.argmax()]] = True
    return inside


def grown_from_seeds(
    cloud: Cloud, neighbors: Sequence[np.ndarray], seeds: np.ndarray
) -> list[tuple[Arc | None, Arc | None]]:
    """For each of (m,) seeds the line and the arc grown from it, a list of pairs; None where there is none.

    neighbors: for every point its aligned neighbours, an index array. Where there is a line the arc starts from what
    that goes along, which on an arc is a chord.
    """
    lines: list[Arc | None] = [None] * len(seeds)
    arcs: list[Arc | None] = [None] * len(seeds)
    rich = np.flatnonzero([len(neighbors[seed]) >= START_POINTS - 1 for seed in seeds])
    starts, of, members = from_neighbors(cloud, neighbors, seeds[rich])
    grown, found = refitted(cloud, starts, of, members, straight=True)
    on = cloud.inliers_of(grown.keep(found), grown.low[found], grown.high[found])
    bent = refitted(cloud, grown.keep(found), on.of, on.members, straight=False)
    without = ~found[of]
    of, members = (np.cumsum(~found) - 1)[of[without]], members[without]
    rest = refitted(cloud, starts.keep(~found), of, members, straight=False)
    for number, line in zip(rich[found], grown.keep(found), strict=True):
        lines[number] = line
    for numbers, (some, good) in ((rich[found], bent), (rich[~found], rest)):
        for number, arc in zip(numbers[good], some.keep(good), strict=True):
            arcs[number] = arc
    return list(zip(lines, arcs, strict=True))


def from_neighbors(
    cloud: Cloud, neighbors: Sequence[np.ndarray], seeds: np.ndarray
) -> tuple[ArcBatch, np.ndarray, np.ndarray]:
    """An ArcBatch of lines through seeds, (m,); and their aligned neighbours and themselves: numbers, indices (t,)."""
    near = [np.append(neighbors[seed], seed) for seed in seeds]
    of = np.repeat(np.arange(len(seeds)), [len(some) for some in near])
    members, none = np.concatenate([np.zeros(0, int), *near]), np.zeros(len(seeds))
    starts = ArcBatch(cloud.points[seeds], cloud.directions[seeds], np.zeros((len(seeds), 3)), none, none, none > 0)
    along, first = starts.coordinates(cloud.points[members], of)[0], np.searchsorted(of, np.arange(len(seeds)))
    if len(seeds):
        starts = starts.over(np.minimum.reduceat(along, first), np.maximum.reduceat(along, first))
    return starts, of, members


def refitted(
    cloud: Cloud, starts: ArcBatch, of: np.ndarray, members: np.ndarray, straight: bool
) -> tuple[ArcBatch, np.ndarray]:
    """An ArcBatch fitted to some points of each and grown from there; (m,) bool, whether there is a line, or an arc.

    of, members: (t,) number of the arc, and index of the point. What bends too little is no arc.
    """
    scale = cloud.scale
    places, directions = cloud.points[members], cloud.directions[members]
    lever = np.where(straight | (starts.length < scale.gap), scale.lever, 0.0)  # on longer stretches places tell more
    starts = fit_batch(starts, places, directions, of, lever, INLIER * scale.noise, straight)
    arcs, found = grow_arcs(cloud, starts, straight)
    return arcs, found & (straight | (arcs.sagitta >= SAGITTA * scale.noise))


def sagitta(arc: Arc) -> float:
    """How far the middle of an arc is off its chord; of more than half a circle, the radius at least."""
    return (1 - np.cos(min(0.5 * arc.curvature * arc.length, np.pi))) / max(arc.curvature, 1e-9)
