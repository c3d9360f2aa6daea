"""Segments that whole 2D runs propose: laid where the edgels of all views say, and judged by all views that have them
in sight.

The views that a segment is from agree on it, and so do those of many a wrong one: among texture there is a run for any
line. But a right one is shown by most views that have it in sight, on its whole length, and a little aside of it they
show less: what counts is the mean over the views of the share that each shows, less what it shows there by chance.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.ranges import ragged
from taichi_edges.evidence.lying import EdgelsAbout
from taichi_edges.evidence.plane_equations import PlaneEquations
from taichi_edges.seeding.pairing import Segments

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching

FIT_PX = (2.0, 1.5, 1.0, 1.0)  # of the edgels looked at while segments are fitted, round by round
FIT_SCALE_PX = 0.5  # residual at which an edgel's weight has fallen to a quarter
MOST_STEP = 10.0  # times these: a segment along a row of cameras is far off where its edgels are hardly
FIT_EVERY_PX, JUDGED_EVERY_PX = 4.0, 3.0  # of the places that are asked about
FEWEST_PLACES = 4  # on a segment
STIFF = 1e-6  # of the mean eigenvalue: what no edgel tells stays as it is
SHOWN_PX = 0.5  # within so much of a segment an edgel shows it
ASIDE_PX = 6.0  # to four sides: there a view shows what it does by chance
SHOWN, LEAST_VIEWS = 0.5, 4  # of its length in a view that shows a segment, and how many do
LEAST_EXCESS = 0.15  # share of the length, over all views in sight, that is shown beyond chance
BESIDE = 3  # views that look from nearest to where another one looks from
COHERENT = 0.55  # share of these that show a segment which this one shows, the mean over those that do
AT_ONCE = 1 << 17  # segments times views that are asked at once


def places_on(segments: Segments, pixels: np.ndarray, every: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places `every` px apart on Segments: (m, 3) points, (m,) the segment, (m,) how far along it, 0 to 1.

    pixels: (n,) size of a pixel at each.
    """
    counts = np.maximum((segments.lengths / (every * pixels)).astype(np.int64), FEWEST_PLACES)
    own, number = ragged(counts)
    share = (number + 0.5) / counts[own]
    points = segments.ends[own, 0] + share[:, None] * (segments.ends[own, 1] - segments.ends[own, 0])
    return points, own, share


def fitted(matching: "EdgelMatching", segments: Segments) -> Segments:
    """The Segments moved, end by end, to where the edgels of all views along them say. Those that none tells stay."""
    for radius in FIT_PX:
        pixels, ways = matching.pixel_at(segments.middles), segments.ways
        points, own, share = places_on(segments, pixels, FIT_EVERY_PX)
        equations = matching.equations(points, ways[own], radius, FIT_SCALE_PX)
        steps = _steps_of_ends(equations, own, share, ways)
        lengths = np.linalg.norm(steps, axis=2)
        longest = MOST_STEP * radius * pixels[:, None]
        steps *= np.minimum(1.0, longest / np.maximum(lengths, 1e-300))[:, :, None]
        segments = replace(segments, ends=segments.ends + steps)
    return segments


def _steps_of_ends(equations: PlaneEquations, own: np.ndarray, share: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """(n, 2, 3) steps of the ends, across the segments, that bring their places nearest to the planes of their edgels.

    equations: PlaneEquations of the places, (m,) on the segment `own`, `share` of the way along it. ways: (n, 3).
    """
    count, weights = len(ways), (1.0 - share, share)
    starts = np.flatnonzero(np.diff(own, prepend=-1))
    matrices, pulls = np.zeros((count, 6, 6)), np.zeros((count, 6))
    for a, one in enumerate(weights):
        pulls[:, 3 * a : 3 * a + 3] = np.add.reduceat(one[:, None] * equations.gradients, starts)
        for b, two in enumerate(weights):
            block = np.add.reduceat((one * two)[:, None, None] * equations.matrices, starts)
            matrices[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3] = block
    scale = np.einsum("nii->n", matrices) / 6 + 1e-12
    along = scale[:, None, None] * ways[:, :, None] * ways[:, None]
    for a in (0, 3):
        matrices[:, a : a + 3, a : a + 3] += along
    matrices += (STIFF * scale)[:, None, None] * np.eye(6)
    return -np.linalg.solve(matrices, pulls[:, :, None])[:, :, 0].reshape(count, 2, 3)


def is_shown(matching: "EdgelMatching", segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool: do the views show Segments as they show edges? And (n,) by how much they do beyond chance, 0 to 1.

    An edge is shown by views that look from nearly the same place, or by none of them, where it is hidden; what other
    edges happen to look like from here is not what they look like from beside it.
    """
    pixels, ways = matching.pixel_at(segments.middles), segments.ways
    points, own, _ = places_on(segments, pixels, JUDGED_EVERY_PX)
    across = np.cross(ways, np.eye(3)[np.abs(ways).argmin(axis=1)])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    up = np.cross(ways, across)
    shown, inside = _shares(matching, points, ways, own)
    by_chance = np.zeros_like(shown)
    for right, ahead in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        aside = (ASIDE_PX * pixels)[:, None] * (right * across + ahead * up) / np.sqrt(2.0)
        by_chance += _shares(matching, points + aside[own], ways, own)[0] / 4
    in_sight, shows = inside > SHOWN, shown >= SHOWN
    excess = (shown - by_chance).sum(axis=1) / np.maximum(in_sight.sum(axis=1), 1)
    coherence = _coherence(matching.every_camera.centres, segments.middles, in_sight, shows)
    return (excess >= LEAST_EXCESS) & (shows.sum(axis=1) >= LEAST_VIEWS) & (coherence >= COHERENT), excess


def _coherence(centres: np.ndarray, middles: np.ndarray, in_sight: np.ndarray, shows: np.ndarray) -> np.ndarray:
    """(n,) the mean over the views that show a segment of the share of the BESIDE views beside them that do.

    centres: (V, 3) of the cameras. middles: (n, 3). in_sight, shows: (n, V) bool.
    """
    total = np.zeros(len(middles))
    towards = centres - middles[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-300)
    for view in range(len(centres)):
        cosines = np.where(in_sight, (towards * towards[:, view, None]).sum(axis=2), -2.0)
        cosines[:, view] = -2.0
        beside = np.argsort(-cosines, axis=1, kind="stable")[:, :BESIDE]
        there = np.take_along_axis(in_sight, beside, axis=1) & (beside != view)
        share = (np.take_along_axis(shows, beside, axis=1) & there).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        total += shows[:, view] * share
    return total / np.maximum(shows.sum(axis=1), 1)


def _shares(
    matching: "EdgelMatching", points: np.ndarray, ways: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n, V) shares of the places on each segment that a view shows, and that it has in its image."""
    about, counts = EdgelsAbout.of(matching, points, ways[own], SHOWN_PX), np.bincount(own, minlength=len(ways))
    shown, inside = (
        np.stack([np.bincount(own, column, len(ways)) for column in there.T], axis=1) / counts[:, None]
        for there in (about.there, about.inside)
    )
    return shown, inside


def likely(matching: "EdgelMatching", segments: Segments) -> Segments:
    """Of each run that one of its Segments which the views show most, if they show any as they show edges."""
    step = max(AT_ONCE // matching.edgels.view_count, 1)
    parts = [is_shown(matching, segments.keep(slice(at, at + step))) for at in range(0, len(segments), step)]
    if not parts:
        return segments
    shown, excess = (np.concatenate(column) for column in zip(*parts, strict=True))
    segments, excess = segments.keep(shown), excess[shown]
    order = np.lexsort((-excess, segments.runs))
    return segments.keep(np.sort(order[np.flatnonzero(np.diff(segments.runs[order], prepend=-1))]))
