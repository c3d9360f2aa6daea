"""Strokes that continue each other become one edge, and those that repeat another one go.

Three passes. An arc whose circle goes on along other strokes becomes that circle. Strokes that follow each other
smoothly form a path, and the path is cut anew into as few shapes as pay (`model_selection`), by dynamic programming
over all ways to cut it. A stroke that lies beside others on its whole length repeats them.

Each Yardstick is that of the place: halfway along a stroke, at an end; of several in the mean of their pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.fitting.arcs import fit_arc, through_three
from taichi_edges.fitting.distances import distances_to, pairs_within, unit
from taichi_edges.fitting.model_selection import PixelAt, Track, Yardstick, best_shape, misfit, observations, track_of
from taichi_edges.fitting.prices import price_of
from taichi_edges.geometry.shapes import EllipticArc, Shape, bounds_of, middles_of, near_bounds

BESIDE = 3.0  # noises: places so near to a shape are on it
PARALLEL = np.cos(np.radians(20.0))
CONTINUED_COSINE = np.cos(np.radians(25.0))  # between the tangents of two strokes that continue each other
CONTINUED_GAP_PX = 12.0  # between their ends, along; a tail or a gap at a touching edge is as long
CONTINUED_ASIDE = 0.25  # of that gap: how far aside the other end may lie, beyond BESIDE
SPACING_PX = 2.0  # of the places by which strokes are compared
ROUNDING = 1e-9  # relative; what is cheaper by no more is not cheaper
LEAST_LOOP = 4.0  # times that gap: length of a stroke whose end may continue its start
LONGEST_RUN = 8  # strokes that may become one at once
FOLLOWED = 0.5  # of the places of a stroke that the shape which replaces it runs along, at least
CHORDS = 512  # of a shape, for its tangents
AROUND, MOST_BALLS = 8.0, 4096  # widths of the band about a circle: length searched at once; into so many at most
COVERED = 0.5  # of a circle by strokes, at least
GAP_SHOWN = 0.7  # of what lies between them, which the images must show as well
GAP_SEEN = 0.25  # a place is shown by this share of the views that see the strokes
LEAST_GAP_VIEWS = 1.0  # and by one at least
REPEATED = 0.9  # of the places of a stroke beside others, from which on it says nothing new

Seen = Callable[[Shape, np.ndarray], np.ndarray]  # (n,) how many views see a shape at (n,) parameters
ShapeEnd = tuple[int, int]  # number of the shape, side 0 or 1


@dataclass(frozen=True)
class Merging:
    """Numbers for the log: circles completed, strokes that were joined to others, strokes that repeated others."""

    circles: int = 0
    joined: int = 0
    duplicates: int = 0

    def __add__(self, other: "Merging") -> "Merging":
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Merging(*(one + more for one, more in pairs))


@dataclass(frozen=True)
class Stroke:
    """A shape, and the Track of places by which it is compared with others."""

    shape: Shape
    track: Track


class SmoothPath(NamedTuple):
    """Strokes that continue each other: (number, reversed) of each, and whether they come back to their start."""

    strokes: list[tuple[int, bool]]
    closes: bool


class Cut(NamedTuple):
    """The cheapest way to describe a path as far as one of its strokes.

    cost: BIC of the path so far. first: number in the path of the first stroke of the last shape. shape: that shape.
    """

    cost: float
    first: int
    shape: Shape


def continued(
    shapes: Sequence[Shape], yardstick: Yardstick, pixel_at: PixelAt, seen: Seen, gap_px: float = CONTINUED_GAP_PX
) -> tuple[list[Shape], Merging]:
    """The shapes after all three passes, and Merging.

    shapes: list of shapes in the unit cube. yardstick: of the scene. seen: function of a shape and (n,) parameters that
    tells how many views see an edge there, (n,). gap_px: between strokes that continue each other, at most.
    """
    rounded, circles = with_whole_circles(shapes, yardstick, pixel_at, seen)
    chained = rejoined(rounded, yardstick, pixel_at, seen, gap_px)
    single = without_repeats(chained, yardstick, pixel_at)
    joined = len(shapes) - len(chained)
    return single, Merging(circles, joined, len(chained) - len(single))


# --------------------------------------------------------------------------------------------------- whole circles


def yardsticks_at(places: np.ndarray, yardstick: Yardstick, pixel_at: PixelAt) -> list[Yardstick]:
    """The Yardstick at each of (n, 3) places. yardstick: of the scene."""
    return [yardstick.at(pixel) for pixel in pixel_at(places).tolist()]


def with_whole_circles(
    shapes: Sequence[Shape], yardstick: Yardstick, pixel_at: PixelAt, seen: Seen
) -> tuple[list[Shape], int]:
    """The shapes, arcs replaced by the circle they are parts of where that goes on; and how many circles that gave."""
    arcs = {n: shape for n, shape in enumerate(shapes) if isinstance(shape, EllipticArc) and shape.kind == "arc"}
    if not arcs:
        return list(shapes), 0
    circles: list[Shape] = []
    gone: set[int] = set()
    yardsticks = yardsticks_at(middles_of(shapes), yardstick, pixel_at)
    strokes = [Stroke(shape, track_of(shape, own.pixel)) for shape, own in zip(shapes, yardsticks, strict=True)]
    places, alive = Places([stroke.track for stroke in strokes]), np.array([not shape.closed for shape in shapes])
    for number in sorted(arcs, key=lambda n: -arcs[n].length):
        if number in gone:
            continue
        alive[list(gone)], own = False, yardsticks[number]
        circle = circle_around(arcs[number], places, alive, own)
        if circle is None:
            continue
        others = np.unique(places.owners[places.about(circle, BESIDE * own.noise, alive)]).tolist()
        on = {n: on_shape(circle, strokes[n].track, own) for n in others}
        parts = [n for n in others if on[n].mean() >= REPEATED]
        if number not in parts or not is_cheaper(circle, [strokes[n] for n in parts], own):
            continue
        if goes_on(circle, np.concatenate([strokes[n].track.points[on[n]] for n in others]), own, seen, COVERED):
            circles.append(circle)
            gone.update(parts)
    return [shape for n, shape in enumerate(shapes) if n not in gone] + circles, len(circles)


class Places:
    """The places of Tracks in a search tree, so that those about a circle are found without looking at all of them.

    points: (p, 3). owners: (p,) number of the Track. shares: (p,) length that each stands for. longest: (T,) the
    longest of these of each Track.
    """

    def __init__(self, tracks: Sequence[Track]) -> None:
        self.points = np.concatenate([track.points for track in tracks])
        self.shares = np.concatenate([track.share for track in tracks])
        self.owners = np.repeat(np.arange(len(tracks)), [len(track.points) for track in tracks])
        self.longest = np.array([track.share.max() for track in tracks])
        self.tree, self.box = cKDTree(self.points), (self.points.min(axis=0), self.points.max(axis=0))

    def about(self, circle: Shape, margin: float, alive: np.ndarray) -> np.ndarray:
        """Indices, ascending, of the places within `margin` of a circle, of the Tracks that are `alive`, (T,) bool."""
        step = max(AROUND * margin, circle.length / MOST_BALLS)
        reach = margin + 0.5 * step
        centres = circle.at(np.linspace(0.0, 1.0, int(np.ceil(circle.length / step)) + 1))
        inside = ((centres >= self.box[0] - reach) & (centres <= self.box[1] + reach)).all(axis=1)
        found = self.tree.query_ball_point(centres[inside], reach)
        around = np.unique(np.fromiter(chain.from_iterable(found), np.int64))
        around = around[alive[self.owners[around]]]
        return around[distances_to(circle, self.points[around]) <= margin]


def circle_around(shape: EllipticArc, places: Places, alive: np.ndarray, yardstick: Yardstick) -> Shape | None:
    """The whole circle of an arc, fitted to all the places that lie on it; None where it runs away from the arc.

    places: Places of all Tracks, of which those that are `alive`, (T,) bool, count.
    """
    middle = shape.low + 0.5 * (shape.high - shape.low)
    circle: Shape = shape.over(middle - np.pi, middle + np.pi)
    longest = places.longest[alive].max()
    for width in (3.0, 2.0, 1.0, 1.0):
        tolerance = width * BESIDE * yardstick.noise
        near = places.about(circle, tolerance, alive)
        if len(near) < 6:
            return None
        arc = through_three(*circle.at(np.array([0.25, 0.5, 0.75])))
        assert arc is not None  # places on a circle are on no line
        points, shares = places.points[near], places.shares[near] / longest
        arc = fit_arc(arc, points, np.broadcast_to(arc.tangent, points.shape), 0.0, tolerance, False, shares=shares)
        if not 0.5 < arc.curvature * shape.radii[0] < 2.0:
            return None
        circle = arc.over(0.0, arc.round).shape()
    return circle


def goes_on(shape: Shape, places: np.ndarray, yardstick: Yardstick, seen: Seen, least: float = 0.0) -> bool:
    """Do strokes, and the images between them, show the whole shape? places: (n, 3) points of strokes on it.

    least: share of the shape that the strokes must cover.
    """
    count = max(int(np.ceil(shape.length / yardstick.pixel)), 8)
    parameters = (np.arange(count) + 0.5) / count
    covered = cKDTree(places).query(shape.at(parameters))[0] <= SPACING_PX * yardstick.pixel
    if covered.all() or covered.mean() < least or not covered.any():
        return bool(covered.all())
    views = seen(shape, parameters)
    usual = np.median(views[covered])
    return (views[~covered] >= max(GAP_SEEN * usual, LEAST_GAP_VIEWS)).mean() >= GAP_SHOWN


def is_cheaper(shape: Shape, parts: Sequence[Stroke], yardstick: Yardstick) -> bool:
    """Does a shape describe what its parts, Strokes, describe at less cost (BIC)?"""
    points, share = (np.concatenate([getattr(part.track, name) for part in parts]) for name in ("points", "share"))
    price = np.log(observations(share, yardstick))
    before = price * sum(price_of(part.shape) for part in parts)
    return price * price_of(shape) + misfit(distances_to(shape, points), share, yardstick) < before


def on_shape(shape: Shape, track: Track, yardstick: Yardstick) -> np.ndarray:
    """(n,) bool: the places of a Track that lie on a shape and run along it."""
    near = distances_to(shape, track.points) <= BESIDE * yardstick.noise
    if near.any():
        along = np.gradient(track.points, axis=0)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        parameters = np.linspace(0, 1, CHORDS)
        nearest = cKDTree(shape.at(parameters)).query(track.points[near])[1]
        near[near] = np.abs((shape.tangents(parameters)[nearest] * along[near]).sum(axis=1)) >= PARALLEL
    return near


# ---------------------------------------------------------------------------------------------------- smooth paths


def rejoined(
    shapes: Sequence[Shape], yardstick: Yardstick, pixel_at: PixelAt, seen: Seen, gap_px: float = CONTINUED_GAP_PX
) -> list[Shape]:
    """The shapes, each path of strokes that continue each other cut anew into as few as pay."""
    whole: list[Shape] = []
    pixels = pixel_at(middles_of(shapes))
    for path, closes in smooth_paths(shapes, yardstick, pixel_at, gap_px):
        own = yardstick.at(float(pixels[[n for n, _ in path]].mean()))
        spacing = SPACING_PX * own.pixel
        strokes = [Stroke(shapes[n], oriented(track_of(shapes[n], spacing), backward)) for n, backward in path]
        loop = closed_shape(strokes, own, seen) if closes else None
        whole += [loop] if loop is not None else cut_anew(strokes, own, seen)
    return whole


def closed_shape(strokes: Sequence[Stroke], yardstick: Yardstick, seen: Seen) -> Shape | None:
    """The closed shape of Strokes that follow each other back to the first one, or None where none is cheaper."""
    track = replace(joined_track(strokes), closed=True)
    count = observations(track.share, yardstick)
    worth = np.log(count) * sum(price_of(stroke.shape) for stroke in strokes)
    shape, _ = best_shape(track, yardstick, count, worth)
    return shape if shape is not None and replaces(shape, strokes, yardstick, seen) else None


def smooth_paths(shapes: Sequence[Shape], yardstick: Yardstick, pixel_at: PixelAt, gap_px: float) -> list[SmoothPath]:
    """The SmoothPaths of shapes; every shape is in one of them."""
    partner = partners_of_ends(shapes, yardstick, pixel_at, gap_px)
    paths: list[SmoothPath] = []
    seen: set[int] = set()
    ends = [(number, side) for number, shape in enumerate(shapes) for side in (0, 1)]
    starts = [end for end in ends if end not in partner] + ends  # open paths first, then what goes round
    for number, side in starts:
        if number in seen:
            continue
        path, start = [], (number, side)
        onward: ShapeEnd | None = start
        while onward is not None and onward[0] not in seen:
            number, side = onward
            seen.add(number)
            path.append((number, side == 1))
            onward = partner.get((number, 1 - side))
        paths.append(SmoothPath(path, onward == start))
    return paths


def partners_of_ends(
    shapes: Sequence[Shape], yardstick: Yardstick, pixel_at: PixelAt, gap_px: float
) -> dict[ShapeEnd, ShapeEnd]:
    """{(shape, side): (shape, side)} of ends that continue each other, each the best for the other."""
    ends = [(number, side) for number, shape in enumerate(shapes) if not shape.closed for side in (0, 1)]
    if len(ends) < 2:
        return {}
    places = np.array([shapes[number].ends[side] for number, side in ends])
    outward = np.array([(2 * side - 1) * shapes[number].tangents(float(side)) for number, side in ends])
    found, pixels = [], pixel_at(places)
    for i, j in pairs_within(places, gap_px * pixels).tolist():
        own = yardstick.at(float(pixels[[i, j]].mean()))
        same = ends[i][0] == ends[j][0] and shapes[ends[i][0]].length < LEAST_LOOP * gap_px * own.pixel
        if same or outward[i] @ outward[j] > -CONTINUED_COSINE:
            continue
        step = places[j] - places[i]
        along = unit(outward[i] - outward[j])
        aside = np.linalg.norm(step - (step @ along) * along)
        if aside <= BESIDE * own.noise + CONTINUED_ASIDE * abs(step @ along):
            turn = np.arccos(np.clip(-outward[i] @ outward[j], -1, 1))
            ahead = abs(step @ along) / (4 * own.pixel)
            found.append((aside / own.noise + turn / np.radians(5.0) + ahead, i, j))
    partner: dict[ShapeEnd, ShapeEnd] = {}
    for _, i, j in sorted(found):
        if ends[i] not in partner and ends[j] not in partner:
            partner[ends[i]], partner[ends[j]] = ends[j], ends[i]
    return partner


def cut_anew(strokes: Sequence[Stroke], yardstick: Yardstick, seen: Seen) -> list[Shape]:
    """The shapes that describe a path of Strokes with the least cost (BIC), each over a run of them.

    strokes: in the order of the path, their Tracks in its direction.
    """
    count = observations(np.concatenate([stroke.track.share for stroke in strokes]), yardstick)
    least, cuts = [0.0], []
    for last, stroke in enumerate(strokes):
        best = Cut(least[last] + price_of(stroke.shape) * np.log(count), last, stroke.shape)
        for first in range(last - 1, max(0, last - LONGEST_RUN + 1) - 1, -1):
            run = strokes[first : last + 1]
            worth = (best.cost - least[first]) * (1 - ROUNDING)
            shape, cost = best_shape(joined_track(run), yardstick, count, worth)
            if shape is not None and replaces(shape, run, yardstick, seen):
                best = Cut(least[first] + cost, first, shape)
        least.append(best.cost)
        cuts.append(best)
    found, last = [], len(strokes) - 1
    while last >= 0:
        found.append(cuts[last].shape)
        last = cuts[last].first - 1
    return found[::-1]


def replaces(shape: Shape, strokes: Sequence[Stroke], yardstick: Yardstick, seen: Seen) -> bool:
    """Does the shape say most of what each of the Strokes says, and do the images show it in between?

    Without the former, a short stroke could be explained away by long ones.
    """
    for stroke in strokes:
        if (distances_to(shape, stroke.track.points) <= BESIDE * yardstick.noise).mean() < FOLLOWED:
            return False
    return goes_on(shape, np.concatenate([stroke.track.points for stroke in strokes]), yardstick, seen)


def oriented(track: Track, backward: bool) -> Track:
    """A Track run the other way round if `backward`."""
    if not backward:
        return track
    length = track.arc[-1] + track.arc[0]
    return Track(track.points[::-1], length - track.arc[::-1], track.share[::-1], track.closed)


def joined_track(strokes: Sequence[Stroke]) -> Track:
    """One Track of Strokes that follow each other; where they overlap, places are in the order of the path."""
    tracks, offset, before = [stroke.track for stroke in strokes], 0.0, None
    arcs: list[np.ndarray] = []
    for track in tracks:
        if before is not None:
            heading = unit(before.points[-1] - before.points[-2])
            offset = (
                arcs[-1][-1] + max((track.points[0] - before.points[-1]) @ heading, -before.share[-1]) - track.arc[0]
            )
        arcs.append(track.arc + offset)
        before = track
    points, share = (np.concatenate([getattr(track, name) for track in tracks]) for name in ("points", "share"))
    arc = np.concatenate(arcs)
    order = np.argsort(arc, kind="stable")
    return Track(points[order], arc[order], share[order])


# --------------------------------------------------------------------------------------------------------- repeats


def without_repeats(shapes: Sequence[Shape], yardstick: Yardstick, pixel_at: PixelAt) -> list[Shape]:
    """The shapes without those that lie beside longer ones on their whole length."""
    kept: set[int] = set()
    bounds, yardsticks = bounds_of(shapes), yardsticks_at(middles_of(shapes), yardstick, pixel_at)
    for number in sorted(range(len(shapes)), key=lambda number: -shapes[number].length):
        own = yardsticks[number]
        track = track_of(shapes[number], own.pixel)
        near = kept & set(near_bounds(bounds, track.points, BESIDE * own.noise).tolist())
        others = [shapes[other] for other in sorted(near)]
        if not others or beside_others(track, others, own).mean() < REPEATED:
            kept.add(number)
    return [shapes[number] for number in sorted(kept)]


def beside_others(track: Track, shapes: Sequence[Shape], yardstick: Yardstick) -> np.ndarray:
    """(n,) bool: the places of a Track that lie on one of the shapes and run along it."""
    return np.any([on_shape(shape, track, yardstick) for shape in shapes], axis=0)
