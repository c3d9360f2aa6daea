"""Pieces that continue each other become one edge: a line, an arc, or a free curve where neither describes them.

Whether they do is decided as everywhere here: squared residuals in units of the points' noise plus the price of the
free parameters, ln n each (BIC). Two pieces of one line pay one price instead of two; a hyperbola that was claimed by
several arcs is one cubic; a fillet between two lines stays three edges, because no cubic follows all three.
"""

import heapq
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taichi_edges.fitting.arcs import Arc, fit_arc
from taichi_edges.fitting.cubic_chains import Ordering, fit_chain, nearest_on_chain
from taichi_edges.fitting.prices import MOST_CUBICS, OUTLIER, price_of_arc, price_of_cubics
from taichi_edges.strokes.arc_growth import INLIER, SAGITTA, Cloud, sagitta
from taichi_edges.strokes.claiming import Claim

WIDE = 4.0  # times the tolerance: the first fit to two pieces starts from one of them, and looks farther

NumberedEnd = tuple[int, int]  # number of the piece, side 0 or 1


@dataclass(frozen=True)
class Piece:
    """A part of an edge, or all of it.

    arc: Arc, or None for a free curve. curves: (c, 4, 3) control points of a free curve, in order; None for an arc.
    own, shared: indices of its points. along: arc lengths or chain parameters of own and then shared. cost: BIC.
    """

    arc: Arc | None
    curves: np.ndarray | None
    own: np.ndarray
    shared: np.ndarray
    along: np.ndarray
    cost: float

    @property
    def members(self) -> np.ndarray:
        """All of its points."""
        return np.concatenate([self.own, self.shared])

    @property
    def chain(self) -> np.ndarray:
        """The `curves` of what is no arc."""
        assert self.curves is not None
        return self.curves

    @property
    def closed(self) -> bool:
        """Has it no ends?"""
        return self.arc is not None and self.arc.closed

    @property
    def cubics(self) -> int:
        """How many cubics describe it."""
        if self.arc is None:
            return len(self.chain)
        return max(int(np.ceil(self.arc.length * self.arc.curvature / (0.5 * np.pi))), 1)

    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """(2, 3) its two ends, and (2, 3) the tangents there, both pointing outwards."""
        if self.arc is not None:
            at = np.array([self.arc.low, self.arc.high])
            return self.arc.at(at), self.arc.tangents(at) * np.array([[-1.0], [1.0]])
        curves = self.chain
        places = np.stack([curves[0, 0], curves[-1, 3]])
        tangents = np.stack([curves[0, 0] - curves[0, 1], curves[-1, 3] - curves[-1, 2]])
        return places, tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-300)

    def lengths(self) -> tuple[np.ndarray, np.ndarray]:
        """Arc lengths of its points, at least in order of size; and (2,) those of its ends."""
        if self.arc is not None:
            return self.along, np.array([self.arc.low, self.arc.high])
        scale = np.linalg.norm(np.diff(self.chain, axis=1), axis=2).sum() / len(self.chain)
        return self.along * scale, np.array([0.0, len(self.chain)]) * scale


@dataclass(frozen=True)
class PieceEnd:
    """One end of a Piece, side 0 or 1."""

    piece: Piece
    side: int

    def ways(self) -> np.ndarray:
        """Arc lengths of the piece's points, see `Piece.lengths`, counted outwards from this end."""
        along, ends = self.piece.lengths()
        return (along - ends[self.side]) * (1 if self.side else -1)


def merged(cloud: Cloud, claims: Sequence[Claim], noises: np.ndarray) -> list[Piece]:
    """Pieces of whole edges from Claims, see `claiming`.

    cloud: Cloud. noises: (n,) at which each point was claimed, unit-cube units.
    """
    cloud = cloud.with_noises(noises)
    pieces = {number: piece_of(cloud, claim.arc, claim.own, claim.shared) for number, claim in enumerate(claims)}
    waiting: list[tuple[float, int, int, int, Piece]] = []
    turns, count, ends = itertools.count(), len(pieces), EndGrid(cloud.scale.gap)

    def propose(some: Sequence[int]) -> None:
        for number in some:
            ends.add(number, pieces[number])
        for a, b in facing_ends(cloud, pieces, ends, some):
            gain, piece = joined(cloud, PieceEnd(pieces[a[0]], a[1]), PieceEnd(pieces[b[0]], b[1]))
            if piece is not None:
                heapq.heappush(waiting, (-gain, a[0], b[0], next(turns), piece))

    propose(list(pieces))
    while waiting:
        _, a, b, _, piece = heapq.heappop(waiting)
        if a in pieces and b in pieces:
            del pieces[a], pieces[b]
            pieces[count] = piece
            count += 1
            propose([count - 1])
    return [pieces[number] for number in sorted(pieces)]


def piece_of(cloud: Cloud, arc: Arc, own: np.ndarray, shared: np.ndarray) -> Piece:
    """The Piece of an arc and its points."""
    members = np.concatenate([own, shared])
    along, offsets = arc.coordinates(cloud.points[members])
    cost = capped((offsets**2).sum(axis=1), cloud.noises[members]) + price_of_arc(arc) * np.log(len(members))
    return Piece(arc, None, own, shared, along, cost)


def capped(squared: np.ndarray, noises: np.ndarray) -> float:
    """Sum of (n,) squared distances in units of the noises, (n,), each at most OUTLIER."""
    return float(np.minimum(squared / noises**2, OUTLIER).sum())


class EndGrid:
    """The ends of open pieces in cubes of side `reach`: which are near an end is asked again after every joining."""

    def __init__(self, reach: float) -> None:
        self.reach = reach
        self.ends: dict[NumberedEnd, tuple[np.ndarray, np.ndarray]] = {}  # places and tangents
        self.cells: dict[tuple[int, ...], list[NumberedEnd]] = {}

    def add(self, number: int, piece: Piece) -> None:
        """Add the two ends of a Piece of some number, if it has any."""
        if not piece.closed:
            for side, (place, tangent) in enumerate(zip(*piece.ends(), strict=True)):
                self.ends[number, side] = place, tangent
                self.cells.setdefault(self._cell(place), []).append((number, side))

    def near(self, end: NumberedEnd) -> list[NumberedEnd]:
        """Ends (number, side) within reach of one of them, itself included."""
        place = self.ends[end][0]
        corner = np.array(self._cell(place)) - 1
        cells = (tuple(cell) for cell in (corner + np.indices((3, 3, 3)).reshape(3, -1).T).tolist())
        around = [other for cell in cells for other in self.cells.get(cell, ())]
        apart = np.linalg.norm([self.ends[other][0] - place for other in around], axis=1)
        return [other for other, distance in zip(around, apart, strict=True) if distance <= self.reach]

    def _cell(self, place: np.ndarray) -> tuple[int, ...]:
        return tuple(np.floor(place / self.reach).astype(int).tolist())


def facing_ends(
    cloud: Cloud, pieces: Mapping[int, Piece], grid: EndGrid, some: Iterable[int]
) -> list[tuple[NumberedEnd, NumberedEnd]]:
    """Pairs of ends that are near and look at each other, each (number of the piece, 0 or 1); one of them in `some`.

    grid: EndGrid of all pieces, and of some that are gone.
    """
    found = set()
    for end in [(number, side) for number in some if not pieces[number].closed for side in (0, 1)]:
        for other in grid.near(end):
            facing = grid.ends[end][1] @ grid.ends[other][1] <= -cloud.scale.cosine
            if other[0] != end[0] and other[0] in pieces and facing:
                found.add((min(end, other), max(end, other)))
    return sorted(found)


def joined(cloud: Cloud, end: PieceEnd, other: PieceEnd) -> tuple[float, Piece | None]:
    """What it gains to make the pieces of two Ends one, and that Piece; 0 and None where it does not pay."""
    a, b = end.piece, other.piece
    own = np.union1d(a.own, b.own)
    shared = np.setdiff1d(np.union1d(a.shared, b.shared), own)
    found = [free_piece(cloud, end, other, own, shared)]
    if a.arc is not None and b.arc is not None:
        longer = a.arc if a.arc.length >= b.arc.length else b.arc
        found += [arc_piece(cloud, longer, own, shared, straight) for straight in (True, False)]
    best = min((piece for piece in found if piece is not None), key=lambda piece: piece.cost, default=None)
    gain = a.cost + b.cost - best.cost if best is not None else 0.0
    return (gain, best) if gain > 0 else (0.0, None)


def arc_piece(cloud: Cloud, start: Arc, own: np.ndarray, shared: np.ndarray, straight: bool) -> Piece | None:
    """The points of two pieces as one line or arc; None where it bends too little for an arc."""
    members, scale = np.concatenate([own, shared]), cloud.scale
    points, directions, noises = cloud.points[members], cloud.directions[members], cloud.noises[members]
    shares = (noises.min() / noises) ** 2
    for tolerance in (WIDE * INLIER, INLIER):
        start = fit_arc(start, points, directions, 0.0, tolerance * noises.max(), straight, shares=shares)
    along, offsets = start.coordinates(points)
    good = (offsets**2).sum(axis=1) <= OUTLIER * noises**2
    if good.sum() < 2:
        return None
    arc = start.over(along[good].min(), along[good].max())
    if arc.length + scale.gap >= arc.round:
        arc = arc.over(arc.low, arc.low + arc.round)
    if not straight and sagitta(arc) < SAGITTA * noises.min():
        return None
    return piece_of(cloud, arc.recentred(), own, shared)


def free_piece(cloud: Cloud, end: PieceEnd, other: PieceEnd, own: np.ndarray, shared: np.ndarray) -> Piece | None:
    """The points of two pieces as a smooth chain of as few cubics as pay; see `joined`."""
    members = np.concatenate([own, shared])
    points, noises = cloud.points[members], cloud.noises[members]
    ordering = chained(end, other, members)
    best, most = None, min(end.piece.cubics + other.piece.cubics, MOST_CUBICS)
    for cubics in range(1, most + 1):
        if len(points) < 6 * cubics:
            break
        curves, _ = fit_chain(points, ordering, INLIER * noises.max(), cubics)
        distances, along = nearest_on_chain(points, curves)
        cost = price_of_cubics(cubics) * np.log(len(points)) + capped(distances**2, noises)
        if best is None or cost < best.cost:
            best = Piece(None, curves, own, shared, along, cost)
    return best


def chained(end: PieceEnd, other: PieceEnd, members: np.ndarray) -> Ordering:
    """Ordering of the members of two pieces: along the one to its end, on from the end of the other along that."""
    (places, outwards), (other_places, _) = end.piece.ends(), other.piece.ends()
    gap = (other_places[other.side] - places[end.side]) @ outwards[end.side]
    order = np.argsort(members, kind="stable")
    arc = np.zeros(len(members))
    for piece, along in ((other.piece, gap - other.ways()), (end.piece, end.ways())):
        arc[order[np.searchsorted(members, piece.members, sorter=order)]] = along
    arc -= arc.min()
    return Ordering(arc, float(arc.max()), False)
