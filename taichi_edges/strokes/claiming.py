"""Whole lines and circular arcs that claim the oriented points, best supported first.

Graph traversal follows an edge wherever it goes smoothly, at a tangential touch into the other edge too. Here a line
and an arc grow from seeds over all points, as far as places and directions agree. The one with the greatest support
claims its points, the next one what is left; so a rim that touches other edges is one closed circle, and the points
that remain are the other edges. Points at a contact are claimed by one and shared by both.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from taichi_edges.fitting.arc_batch import ArcBatch
from taichi_edges.fitting.arcs import Arc, fit_arc
from taichi_edges.fitting.prices import OUTLIER, price_of_arc
from taichi_edges.strokes.arc_growth import INLIER, Cloud, Inliers, grown_from_seeds, unbroken

OWN_SHARE = 0.5  # of the points along a stretch, which must be an arc's own: elsewhere it repeats another
LEAST_DENSITY = 4.0  # own points on the length of a gap, on average; strays line up by chance, but not so closely
ROUNDS, COARSER = 3, 2.0  # of claiming, and from the noise of one to that of the next
MOST_NOISE = 2e-3  # unit-cube units; coarser rounds would claim neighbouring edges (the paper's lines take 5e-3)
LEAST_AT_ONCE, MOST_AT_ONCE = 16, 512  # seeds from which arcs are grown together
USED = 0.7  # of the arcs of one such batch, for the next to be larger
WINDOW = 8192  # seeds among which these are looked for
TAIL = 0.7  # of the gap: an edge goes on past its sharp points in steps of that size at most


@dataclass(frozen=True)
class Grown:
    """An arc that was grown from a seed, and the Inliers on its whole length."""

    arc: Arc
    inliers: Inliers


@dataclass(frozen=True)
class Claim:
    """An arc and its points: those it owns, and those it shares with a better supported one; ascending indices."""

    arc: Arc
    own: np.ndarray
    shared: np.ndarray

    @property
    def members(self) -> np.ndarray:
        """All of its points."""
        return np.concatenate([self.own, self.shared])


class PointOwners:
    """Who owns each point, (n,) ints, -1 for nobody; and the noise at which it was claimed, (n,) unit-cube units."""

    def __init__(self, count: int) -> None:
        self.owner, self.noise = np.full(count, -1), np.full(count, np.inf)

    def enter(self, members: np.ndarray, owner: int, noise: float) -> None:
        """The points in `members` now belong to `owner`."""
        self.owner[members], self.noise[members] = owner, noise


def claims(
    cloud: Cloud, neighbors: Sequence[np.ndarray], seeds: np.ndarray, min_points: int
) -> tuple[list[Claim], PointOwners]:
    """Claims of lines and arcs that own disjoint points; and the PointOwners that says so.

    neighbors: for every point its aligned neighbours, an index array. seeds: (n,) indices, best first.
    Edges that few views see are noisier than others. Their turn comes when the sharp ones have their points: in every
    round the tolerance is COARSER times that of the round before, and what is found already grows first.
    """
    found: list[Claim] = []
    taken, finest = PointOwners(len(cloud.points)), cloud.scale.noise
    for number in range(ROUNDS):
        noise = finest * COARSER**number
        if number and noise > MOST_NOISE:
            break
        cloud = cloud.at_scale(replace(cloud.scale, noise=noise, spread=COARSER**number))
        found = [widened(cloud, claim, taken, k, beyond=0.0) for k, claim in enumerate(found)]
        claim_round(cloud, neighbors, seeds[taken.owner[seeds] < 0], min_points, taken, found)
        found = [widened(cloud, claim, taken, k, beyond=TAIL * cloud.scale.gap) for k, claim in enumerate(found)]
    return [refined(cloud, claim, taken) for claim in found], taken


def claim_round(
    cloud: Cloud,
    neighbors: Sequence[np.ndarray],
    seeds: np.ndarray,
    min_points: int,
    taken: PointOwners,
    found: list[Claim],
) -> None:
    """Add to the Claims in `found`, and to the PointOwners, what can be claimed at the cloud's scale."""
    waiting: list[tuple[float, int, Grown]] = []
    owner = taken.owner
    for number, (gain, candidate) in enumerate(arc_candidates(cloud, neighbors, seeds, min_points, owner)):
        heapq.heappush(waiting, (-gain, number, candidate))
    while waiting:
        _, number, candidate = heapq.heappop(waiting)
        gain, claim = supported(cloud, candidate, owner, min_points)
        if claim is None or gain <= 0:
            continue
        if waiting and gain < -waiting[0][0]:  # others have claimed its points: let it wait for its new turn
            heapq.heappush(waiting, (-gain, number, candidate))
            continue
        taken.enter(claim.own, len(found), cloud.scale.noise)
        found.append(claim)


def widened(cloud: Cloud, claim: Claim, taken: PointOwners, number: int, beyond: float) -> Claim:
    """The Claim with the points that nobody owns and that lie on it at the cloud's scale; the PointOwners is told.

    beyond: how far it may go on past its ends, without a longer step, unit-cube units.
    """
    arc = claim.arc
    reach = 0.0 if arc.closed else cloud.scale.gap * (beyond > 0)
    on = cloud.inliers(arc, arc.low - reach, arc.high + reach)
    on = on.keep(taken.owner[on.members] < 0)
    members, along = on.members, on.along
    if beyond and not arc.closed and len(members):
        stations = np.concatenate([along, np.linspace(arc.low, arc.high, int(arc.length / beyond) + 2)])
        good = unbroken(stations, arc.low, arc.high, beyond)[: len(along)]
        members, along = members[good], along[good]
    if not len(members):
        return claim
    taken.enter(members, number, cloud.scale.noise)
    ends = (arc.low, arc.high) if arc.closed else (min(arc.low, along.min()), max(arc.high, along.max()))
    return Claim(arc.over(*ends), np.union1d(claim.own, members), np.setdiff1d(claim.shared, members))


def refined(cloud: Cloud, claim: Claim, taken: PointOwners) -> Claim:
    """The Claim with its arc fitted once more to all of its points, each as sharply as it was claimed."""
    members, noises = claim.members, taken.noise[claim.members]
    places, directions = cloud.points[members], cloud.directions[members]
    shares, tolerance = (noises.min() / noises) ** 2, INLIER * noises.max()
    arc = claim.arc.recentred()
    arc = fit_arc(arc, places, directions, 0.0, tolerance, arc.curvature == 0, shares=shares)
    return Claim(arc, claim.own, claim.shared)


def arc_candidates(
    cloud: Cloud, neighbors: Sequence[np.ndarray], seeds: np.ndarray, min_points: int, owner: np.ndarray
) -> Iterator[tuple[float, Grown]]:
    """Gains and Grown, one seed after the other until every point that nobody owns is on an arc, or has grown none."""
    covered = owner >= 0
    for seed, grown in grown_pairs(cloud, neighbors, seeds, covered):
        covered[seed] = True
        gains = [supported(cloud, candidate, owner, min_points)[0] for candidate in grown]
        for candidate, gain in zip(grown, gains, strict=True):
            if gain == max(gains):  # even where it is too short to be claimed: its points will not do better
                covered[candidate.inliers.members] = True
            if gain > 0:
                yield gain, candidate


def grown_pairs(
    cloud: Cloud, neighbors: Sequence[np.ndarray], seeds: np.ndarray, covered: np.ndarray
) -> Iterator[tuple[int, list[Grown]]]:
    """(seed, list of its Grown) of one seed after the other that is not covered when its turn comes.

    covered: (n,) bool, which changes meanwhile. Arcs of seeds that are covered by then are dropped; where that were
    many, fewer are grown at once the next time.
    """
    first, count = 0, LEAST_AT_ONCE
    while first < len(seeds):
        waiting = first + np.flatnonzero(~covered[seeds[first : first + WINDOW]])[:count]
        first = int(waiting[-1]) + 1 if len(waiting) == count else first + WINDOW
        some = seeds[waiting]
        pairs = [[arc for arc in pair if arc is not None] for pair in grown_from_seeds(cloud, neighbors, some)]
        grown_all, used = iter(with_inliers(cloud, [arc for pair in pairs for arc in pair])), 0
        for seed, pair in zip(some.tolist(), pairs, strict=True):
            grown = [next(grown_all) for _ in pair]
            if not covered[seed]:
                used += 1
                yield seed, grown
        count = min(2 * count, MOST_AT_ONCE) if used >= USED * len(some) else max(count // 2, LEAST_AT_ONCE)


def with_inliers(cloud: Cloud, arcs: Sequence[Arc]) -> list[Grown]:
    """A list of Grown from Arcs."""
    if not arcs:
        return []
    batch = ArcBatch.of(arcs)
    on = cloud.inliers_of(batch, batch.low, batch.high)
    bounds = np.searchsorted(on.of, np.arange(len(arcs) + 1)).tolist()
    return [Grown(arc, on.keep(slice(*part))) for arc, part in zip(arcs, pairwise(bounds), strict=True)]


def supported(cloud: Cloud, candidate: Grown, owner: np.ndarray, min_points: int) -> tuple[float, Claim | None]:
    """What a Grown arc gains by the points that nobody owns, net of its price; and its Claim on them.

    A stretch counts where most points along it are its own. Shared points carry it across a contact, no farther.
    """
    arc, members, along = candidate.arc, candidate.inliers.members, candidate.inliers.along
    own = owner[members] < 0
    if own.sum() < min_points:
        return 0.0, None
    kept = _own_stretches(along, own, cloud.scale.gap)
    own &= kept
    if own.sum() < min_points:
        return 0.0, None
    if own.sum() * cloud.scale.gap < LEAST_DENSITY * np.ptp(along[own]):
        return 0.0, None
    gain = (OUTLIER - candidate.inliers.squared[own]).sum() - price_of_arc(arc) * np.log(len(members))
    whole = arc if arc.closed and own.mean() >= OWN_SHARE else arc.over(along[kept].min(), along[kept].max())
    return gain, Claim(whole, members[own], members[kept & ~own])


def _own_stretches(along: np.ndarray, own: np.ndarray, gap: float) -> np.ndarray:
    """(n,) bool: the points of an arc's own stretches and between them.

    A stretch lies between gaps in the own points, and these are the majority of its points. Stretches are one where
    shared points join them, over no more than the length of the two: else the arc repeats another one.
    """
    order = np.argsort(along, kind="stable")
    mine = along[order[own[order]]]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(mine) > gap]))
    lows, highs = mine[starts], mine[np.append(starts[1:], len(mine)) - 1]
    first, last = np.searchsorted(along[order], lows), np.searchsorted(along[order], highs, side="right")
    owned = np.concatenate([[0], np.cumsum(own[order])])
    good = owned[last] - owned[first] >= OWN_SHARE * (last - first)
    spans: list[tuple[float, float, float]] = []  # from, to, length of the stretches
    for low, high in zip(lows[good], highs[good], strict=True):
        if spans and low - spans[-1][1] <= high - low + spans[-1][2]:
            spans[-1] = (spans[-1][0], high, spans[-1][2] + high - low)
        else:
            spans.append((low, high, high - low))
    if not spans:
        return np.zeros(len(along), bool)
    low, high, _ = max(spans, key=lambda span: span[2])
    return (along >= low) & (along <= high)
