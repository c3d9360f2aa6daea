"""Whole lines and circular arcs that claim the oriented points, best supported first.

Graph traversal follows an edge wherever it goes smoothly, and where edges touch tangentially also where it does not. Here
a line and an arc grow from every seed over all points, whatever their clusters, as far as places and directions agree.
The one with the greatest support claims its points, the next one what is left; so a rim that touches other edges is one
closed circle, and the points that remain are the other edges. Points at a contact are claimed by one and shared by both.
"""

import heapq
from dataclasses import dataclass

import numpy as np

from taichi_edges.edges.arc_growth import INLIER, Cloud, bent_from, grown_from_neighbors
from taichi_edges.edges.arcs import Arc

OUTLIER = INLIER**2  # squared noises: what a point on an edge brings at most
LINE_PRICE, ARC_PRICE = 5, 8  # free parameters: a line and where it ends; an arc, which has a plane and a bend as well
OWN_SHARE = 0.5  # of the points along a stretch, which must be an arc's own: elsewhere it repeats another
COVERED = 2.0  # noises: a point so near to what has grown from another seed needs no growth of its own


@dataclass(frozen=True)
class Claim:
    """An arc and its points: those it owns, and those it shares with a better supported one; ascending indices."""

    arc: Arc
    own: np.ndarray
    shared: np.ndarray

    @property
    def members(self):
        """All of its points."""
        return np.concatenate([self.own, self.shared])


def claims(cloud, neighbors, seeds, min_points):
    """Claims of lines and arcs that own disjoint points, best supported first; and (n,) who owns each point, or -1.

    neighbors: for every point its aligned neighbours, an index array. seeds: (n,) indices, best first.
    """
    owner = np.full(len(cloud.points), -1)
    waiting = []
    for number, arc in enumerate(candidates(cloud, neighbors, seeds, min_points)):
        gain, _ = supported(cloud, arc, owner, min_points)
        heapq.heappush(waiting, (-gain, number, arc))
    found = []
    while waiting:
        _, number, arc = heapq.heappop(waiting)
        gain, claim = supported(cloud, arc, owner, min_points)
        if gain <= 0:
            continue
        if waiting and gain < -waiting[0][0]:  # others have claimed its points: let it wait for its new turn
            heapq.heappush(waiting, (-gain, number, arc))
            continue
        owner[claim.own] = len(found)
        found.append(claim)
    return found, owner


def candidates(cloud, neighbors, seeds, min_points):
    """Arcs grown from seeds until every point is near one, or has grown none."""
    covered = np.zeros(len(cloud.points), bool)
    nobody = np.full(len(cloud.points), -1)
    for seed in seeds:
        if covered[seed]:
            continue
        covered[seed] = True
        line = grown_from_neighbors(cloud, neighbors, seed, straight=True)
        arc = grown_from_neighbors(cloud, neighbors, seed, straight=False) if line is None else bent_from(cloud, line)
        grown = [(arc, supported(cloud, arc, nobody, min_points)[0]) for arc in (line, arc) if arc is not None]
        grown = [(arc, gain) for arc, gain in grown if gain > 0]
        if not grown:
            continue
        best = max(grown, key=lambda pair: pair[1])[0]
        members, _, squared = cloud.inliers(best, best.low, best.high)
        covered[members[squared <= COVERED**2]] = True
        for arc, _ in grown:
            yield arc


def supported(cloud, arc, owner, min_points):
    """What an arc gains by the points that nobody owns, net of its price; and its Claim on them.

    A stretch counts where most points along it are its own. Shared points carry it across a contact, no farther.
    """
    scale = cloud.scale
    members, along, squared = cloud.inliers(arc, arc.low, arc.high)
    own = owner[members] < 0
    if own.sum() < min_points:
        return 0.0, None
    kept = _own_stretches(along, own, scale.gap, arc)
    own &= kept
    count = int(own.sum())
    if count < min_points:
        return 0.0, None
    gain = (OUTLIER - squared[own]).sum() - price(arc) * np.log(max(len(members), 2))
    low, high = along[own].min(), along[own].max()
    if not (arc.closed and own.all()):
        inside = (along >= low) & (along <= high)
    else:
        inside = np.ones(len(along), bool)
    whole = arc if arc.closed else arc.over(low, high)
    return gain, Claim(whole, members[own], members[~own & inside])


def _own_stretches(along, own, gap, arc):
    """(n,) bool: points of the stretches, between gaps in the own points, in which these are the majority."""
    order = np.argsort(along, kind="stable")
    mine = order[own[order]]
    run = np.concatenate([[0], np.cumsum(np.diff(along[mine]) > gap)])
    kept = np.zeros(len(along), bool)
    for number in range(run[-1] + 1):
        part = mine[run == number]
        inside = (along >= along[part[0]]) & (along <= along[part[-1]])
        if own[inside].mean() >= OWN_SHARE:
            kept[inside] = True
    return kept


def price(arc):
    """Free parameters of a line or an arc with its ends."""
    return LINE_PRICE if arc.curvature == 0 else ARC_PRICE
