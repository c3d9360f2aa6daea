"""Lines and circular arcs grown over oriented points, as far as places and directions agree."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.edges.arcs import Arc, fit_arc

INLIER = 3.0  # noises: a point on an edge lies no farther from it (99 % of those of a normal distribution in a plane)
SAGITTA = 3.0  # noises that the middle of an arc is off its chord, at least; a line follows a flatter one as well
START_POINTS = 5  # aligned neighbours that a seed starts with, at least, itself included
GROWTH = 0.5  # of an arc's length: how far beyond its ends it is looked for; a longer arc foretells more
GROWTH_ROUNDS = 30
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
    def lever(self):
        """Noise of the points over that of the directions: on a stretch as short as that, directions tell more."""
        return min(self.noise / self.turn, self.gap)

    @property
    def cosine(self):
        """A point whose direction is off by more is on another edge."""
        return float(np.cos(np.clip(self.spread * max(DIRECTION_NOISES * self.turn, TURNS[0]), *TURNS)))


class Cloud:
    """Oriented points in a search tree: points, directions (n, 3), scale: Scale."""

    def __init__(self, points, directions, scale, tree=None):
        self.points, self.directions, self.scale = points, directions, scale
        self.tree = cKDTree(points) if tree is None else tree
        self.noises = np.full(len(points), scale.noise)

    def at_scale(self, scale):
        """The same points with another Scale."""
        return Cloud(self.points, self.directions, scale, self.tree)

    def with_noises(self, noises):
        """The same points, each with a noise of its own: (n,), unit-cube units."""
        cloud = self.at_scale(self.scale)
        cloud.noises = noises
        return cloud

    def near(self, arc, low, high, tolerance=INLIER):
        """Indices of the points about the arc between two arc lengths; some farther ones are among them."""
        high = min(high, low + arc.round)
        count = int((high - low) / self.scale.gap) + 1
        step = (high - low) / count
        radius = np.hypot(0.5 * step, tolerance * self.scale.noise) * (1 + 1e-9)
        found = self.tree.query_ball_point(arc.at(low + step * (np.arange(count) + 0.5)), radius)
        return np.unique(np.fromiter(itertools.chain.from_iterable(found), np.int64))

    def inliers(self, arc, low, high, tolerance=INLIER):
        """Indices, arc lengths and squared residuals (noises) of the points on the arc between two arc lengths.

        tolerance: noises that they may be off.
        """
        around = self.near(arc, low, high, tolerance)
        along, offsets = replace(arc, low=low, high=high).coordinates(self.points[around])
        squared = (offsets**2).sum(axis=1) / self.scale.noise**2
        agree = np.abs((self.directions[around] * arc.tangents(along)).sum(axis=1)) >= self.scale.cosine
        good = (squared <= tolerance**2) & agree & (along >= low) & (along <= high)
        return around[good], along[good], squared[good]


def grow_arc(cloud, start, straight):
    """The longest unbroken line or arc that `start`, an Arc with points along it, is a part of, or None."""
    scale, arc, best = cloud.scale, start, None
    for _ in range(GROWTH_ROUNDS):
        ahead = max(GROWTH * arc.length, INLIER * scale.noise)
        members, along, squared = cloud.inliers(arc, arc.low - ahead, arc.high + ahead)
        inside = unbroken(along, arc.low, arc.high, min(ahead, scale.gap))
        members, along, squared = members[inside], along[inside], squared[inside]
        if len(members) < START_POINTS:
            return best
        before = arc.length
        arc = arc.over(along.min(), along.max())
        if arc.length + scale.gap >= arc.round:
            arc = arc.over(arc.low, arc.low + arc.round)
        places, directions = cloud.points[members], cloud.directions[members]
        arc = fit_arc(arc.recentred(), places, directions, 0.0, INLIER * scale.noise, straight, 1)
        if best is not None and arc.length <= GROWN * before:
            return arc
        best = arc
    return best


def unbroken(along, low, high, gap):
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


def grown_from_neighbors(cloud, neighbors, seed, straight):
    """A line or an arc grown from one point and its aligned neighbours, or None."""
    near = neighbors[seed]
    if len(near) < START_POINTS - 1:
        return None
    near = np.append(near, seed)
    start = Arc(cloud.points[seed], cloud.directions[seed], np.zeros(3))
    along, _ = start.coordinates(cloud.points[near])
    return refitted(cloud, start.over(along.min(), along.max()), near, straight)


def bent_from(cloud, line):
    """An arc grown from what a line goes along, or None. On an arc, that is a chord."""
    members, _, _ = cloud.inliers(line, line.low, line.high)
    return refitted(cloud, line, members, straight=False)


def refitted(cloud, start, members, straight):
    """A line or an arc fitted to some points and grown from there, or None where that bends too little for an arc."""
    scale = cloud.scale
    places, directions = cloud.points[members], cloud.directions[members]
    lever = scale.lever if straight or start.length < scale.gap else 0.0  # on longer stretches the places tell more
    start = fit_arc(start, places, directions, lever, INLIER * scale.noise, straight)
    arc = grow_arc(cloud, start, straight)
    bends = arc is not None and sagitta(arc) >= SAGITTA * scale.noise
    return arc if straight or bends else None


def sagitta(arc):
    """How far the middle of an arc is off its chord; of more than half a circle, the radius at least."""
    return (1 - np.cos(min(0.5 * arc.curvature * arc.length, np.pi))) / max(arc.curvature, 1e-9)
