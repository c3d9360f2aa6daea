"""Proposals: the strokes that explain the edgels of all views, each edgel by one.

Every view proposes the edges it sees, so an edge is proposed as often as it is seen, more or less exactly, and some
proposals are mistakes that other edges have suggested. The one with the most support takes the edgels that lie on it,
in all views; the next one counts what is left. Where others have taken its edgels, a stroke is none.
"""

import heapq
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.detectors.paths import ordered_paths
from taichi_edges.detectors.straight_runs import runs_of as straight_runs_of
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.lying import EdgelsAbout
from taichi_edges.evidence.noise import (
    LIFT_NOISES,
    MOST_NOISE_PX,
    ON_NOISES,
    PROBE_PX,
    RADII_NOISES,
    SCALE_NOISES,
    TAKEN_NOISES,
    noise_of,
)
from taichi_edges.evidence.viewing_planes import refine_points
from taichi_edges.seeding.lifting import lift_edgels
from taichi_edges.seeding.pairing import paired_runs
from taichi_edges.seeding.segments import fitted, likely, places_on
from taichi_edges.seeding.tracing import SHORTEST, Strokes, traced
from taichi_edges.views.views import Views

if TYPE_CHECKING:
    from collections.abc import Callable

LIKELY_OF, BIASED_PX = 3, 1.5  # edgels lifted for each likely point; by which biased ones may disagree
PROBED = 16  # one edgel in so many tells the noise
MOST_COUNTED = 8.0  # views: more do not make an edge surer, and shall not let one that many see take all around it
EVERY_PX = 2.0  # between the points of a straight stroke
LONGEST_GAP = 3  # points without support in the middle of a stroke


def propose(views: Views, matching: EdgelMatching, report: "Callable[[int], None] | None" = None) -> Strokes:
    """The Strokes that explain the edgels of Views. ti.init must have been called.

    report: called with the number of views that are done.
    """
    noise = noise_of_views(views, matching)
    lifted = lift_edgels(views, LIFT_NOISES * noise, report=report)
    strokes = traced(views, lifted, ordered_paths(matching.edgels), LIFT_NOISES * noise)
    radii = tuple(noise * factor for factor in RADII_NOISES)
    placed = refine_points(matching, strokes.points, strokes.directions, radii, SCALE_NOISES * noise)
    strokes = Strokes(placed.points, placed.directions, strokes.edgels, strokes.numbers)
    return explaining(matching, strokes, noise)


def propose_straight(views: Views, matching: EdgelMatching, report: "Callable[[int], None] | None" = None) -> Strokes:
    """The straight Strokes that explain the edgels of Views, from whole 2D runs. Arguments as for `propose`."""
    runs = straight_runs_of(matching.edgels, np.ones(len(matching.edgels), bool))
    segments = likely(matching, fitted(matching, paired_runs(views, runs, report)))
    points, own, _ = places_on(segments, matching.pixel_at(segments.middles), EVERY_PX)
    directions = segments.ways[own]
    noise = noise_of(matching, refine_points(matching, points, directions))
    return explaining(matching, Strokes(points, directions, np.full(len(points), -1), own), noise)


def noise_of_views(views: Views, matching: EdgelMatching) -> float:
    """Standard deviation of the edgels across their edges, px, as one of PROBED of them tell it."""
    chosen = np.zeros(len(matching.edgels), bool)
    chosen[::PROBED] = True
    lifted = lift_edgels(views, PROBE_PX, chosen)
    good = lifted.evidence[:, 0] > 0
    if not good.any():
        return MOST_NOISE_PX
    return noise_of(matching, refine_points(matching, lifted.points[good, 0], lifted.directions[good, 0]))


def likely_points(views: Views, count: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` (n, 3) points on edges of Views whose edgels may be biased, and (n, 3) directions of these edges.

    One edgel in so many is lifted, as far as edgels that a detector has displaced may disagree.
    """
    assert views.edgels is not None
    chosen = np.zeros(len(views.edgels), bool)
    chosen[:: max(len(chosen) // (LIKELY_OF * count), 1)] = True
    lifted = lift_edgels(views, BIASED_PX, chosen)
    evidence = lifted.evidence[:, 0]
    best = np.argsort(-evidence, kind="stable")[: min(count, np.count_nonzero(evidence > 0))]
    return lifted.points[best, 0], lifted.directions[best, 0]


def explaining(matching: EdgelMatching, strokes: Strokes, noise_px: float) -> Strokes:
    """The Strokes that explain edgels which no better one explains, cut to where they do. noise_px: of the edgels."""
    on_px = ON_NOISES * noise_px
    about = EdgelsAbout.of(matching, strokes.points, strokes.directions, on_px)
    weights = about.closeness(on_px)
    bounds, free = strokes.starts, np.ones(len(matching.edgels) + 1, bool)
    free[-1] = False  # what index -1 means

    def supported(stroke: int) -> np.ndarray:
        part = slice(bounds[stroke], bounds[stroke + 1])
        return (weights[part] * free[about.edgels[part]]).sum(axis=1)

    def worth(views: np.ndarray) -> float:
        good = views >= matching.least_views
        return float(np.minimum(views[good], MOST_COUNTED).sum()) if good.sum() >= SHORTEST else 0.0

    waiting = [(-worth(supported(stroke)), stroke) for stroke in range(len(bounds) - 1)]
    waiting = [entry for entry in waiting if entry[0] < 0]
    heapq.heapify(waiting)
    kept: list[np.ndarray] = []
    while waiting:
        _, stroke = heapq.heappop(waiting)
        views = supported(stroke)
        gain = worth(views)
        if gain <= 0:
            continue
        if waiting and gain < -waiting[0][0]:  # others have taken its edgels: let it wait for its new turn
            heapq.heappush(waiting, (-gain, stroke))
            continue
        for first, last in runs_of(views >= matching.least_views):
            part = np.arange(bounds[stroke] + first, bounds[stroke] + last)
            kept.append(part)
            taken = about.edgels[part][about.within(TAKEN_NOISES * noise_px)[part]]
            free[matching.neighbors[taken].ravel()] = False
    if not kept:
        return strokes.keep(slice(0))
    numbers = np.repeat(np.arange(len(kept)), [len(part) for part in kept])
    found = strokes.keep(np.concatenate(kept))
    return Strokes(found.points, found.directions, found.edgels, numbers)


def runs_of(good: np.ndarray) -> list[tuple[int, int]]:
    """(first, last + 1) of the runs of (n,) bool that hold SHORTEST good ones, and no gap of LONGEST_GAP."""
    at = np.flatnonzero(good)
    parts = np.split(at, np.flatnonzero(np.diff(at) > LONGEST_GAP) + 1)
    return [(int(part[0]), int(part[-1]) + 1) for part in parts if len(part) >= SHORTEST]
