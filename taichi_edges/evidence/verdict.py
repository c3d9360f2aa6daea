"""How likely an edge is one: a probability from what the edgels of all views say of it.

Three kinds of things pass for edges. A contour of a rounded surface moves over it with the viewpoint: its edgels lie on
one line from some directions, and beside it from others. A rounded edge stays where it is, but the pictures show it
blurred, as a sharp one never is. And lines that chance has put between edges have few edgels, and those lie badly. Each
says something and none says all, so the verdict is a logistic regression over the marks they leave (`MARKS`), all of
them shares, sines and pixels: none depends on the scene's size or units.

The weights were fitted to edges whose truth is known, `benchmarks/parts.py --fit-verdict`: real CAD parts, ABC scenes
and synthetic ones, from pictures and from drawn maps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taichi_edges.arrays.ranges import ragged
from taichi_edges.evidence.edge_support import Claims, EdgeSamples
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.lying import EdgelsAbout, steadiness
from taichi_edges.evidence.noise import ON_NOISES
from taichi_edges.evidence.rounding import rounding_at
from taichi_edges.geometry.shapes import Shape, middles_of

SPACING_PX = 1.0  # of the places on an edge that are looked at
TIGHT_NOISES = 3.0  # within so much of an edge its edgels lie on it
ABOUT_TIGHT, MOST_ABOUT_PX = 6.0, 4.0  # times that, but no more: edgels so near are about the edge
SHOWN = 0.3  # of the places: a view that has edgels on so many shows the edge
TOGETHER = 0.5  # share of the views that show an edge in which another one shows as well: two edges, not one that moves
BLUR_QUANTILE = 0.75  # of the views: outlines are sharp however round the edge is
SHARP_PX = 0.25  # up to so much edges are as sharp as pictures are
MOST_BLUR_PX = 0.75  # more says no more
ENOUGH_SPREAD = 0.5  # sine of the angle between viewing planes, 30 degrees: more says no more
PRIOR = 2.0  # views that say no, added to all: of two or three that agree the share that does is no certainty
PLACES, PLACE_PX = 4, 4.0  # of an edge, where radii are tried: at most so many, so far apart at least
OUTLINE_PX = 6.0  # so far about a place the outline of the object is looked for
OUTSIDE_VIEWS = 2  # that must show a place outside of it: a single outline may be wrong
MOST_OUTSIDE_PX = 0.5  # more says no more
MARKS = ("steadiness", "blur", "spread", "sharpness", "outside")

HARDLY_STEADY = 0.1  # an edge that no more of the edgels about it lie on is shown by none
TYPICAL = (0.75, 0.0, 0.5, 0.84, 0.0)  # medians of the MARKS of edges that are right, as `--fit-verdict` prints them


@dataclass(frozen=True)
class Weights:
    """Of the logistic regression: (k,) for the MARKS, and what is added."""

    marks: tuple[float, ...]
    constant: float


FITTED = Weights((2.12, -6.26, 3.44, 6.02, -5.52), -4.7)  # not chosen: see the module's first lines


def reasons(marks: np.ndarray, weights: Weights = FITTED) -> list[str]:
    """For each of (E, len(MARKS)) marks the name of that which speaks most against an edge, compared with TYPICAL.

    'support' where hardly any edgel lies on it.
    """
    against = (marks - np.array(TYPICAL)) * np.array(weights.marks)
    shown = marks[:, MARKS.index("steadiness")] >= HARDLY_STEADY
    return [MARKS[number] if seen else "support" for number, seen in zip(against.argmin(axis=1), shown, strict=True)]


def probabilities(marks: np.ndarray, weights: Weights = FITTED) -> np.ndarray:
    """(E,) that edges with (E, len(MARKS)) marks are edges."""
    return 1.0 / (1.0 + np.exp(-(marks @ np.array(weights.marks) + weights.constant)))


def marks_of(matching: EdgelMatching, shapes: Sequence[Shape], noise_px: float) -> np.ndarray:
    """(E, len(MARKS)) what the edgels of all views say of shapes. noise_px: of the edgels.

    steadiness: of the edgels about an edge the share that lies on it, those of another edge beside it left out. blur:
    px, see `Edgels.blurs`, beyond SHARP_PX. spread: sine of the angle by which the viewing planes of its edgels lean
    against each other. sharpness: of the views that the contour of some round surface would explain, see `rounding`,
    the share that an edge does. outside: px by which an edge lies beyond the outline of the object, 0 where pictures
    show none: the line about which the contours of a round lie is outside, seen along the round.
    """
    samples = EdgeSamples.along(shapes, SPACING_PX * matching.pixel_at(middles_of(shapes)))
    return marks_along(matching, samples, noise_px)


def marks_along(matching: EdgelMatching, samples: EdgeSamples, noise_px: float) -> np.ndarray:
    """`marks_of` the edges that EdgeSamples lie along, about SPACING_PX apart."""
    count, tight = len(samples.starts) - 1, TIGHT_NOISES * noise_px
    radius = min(ABOUT_TIGHT * tight, MOST_ABOUT_PX)
    about = EdgelsAbout.of(matching, samples.points, samples.directions, radius)
    owners = _owners(matching, samples, about, ON_NOISES * noise_px)
    own = about.within(ON_NOISES * noise_px) & (owners[about.edgels] == samples.edges[:, None])
    on = own & about.within(tight)
    shown = samples.sums(on.astype(np.float64)) / np.maximum(np.diff(samples.starts), 1)[:, None]  # (E, V)
    seeing = shown >= SHOWN
    outside = matching.outside(samples.points, samples.directions, OUTLINE_PX)
    marks = np.zeros((count, len(MARKS)))
    for number in range(count):
        part = samples.of(number)
        here, lying = about.keep(part), on[part]
        marks[number] = (
            _steadiness(here, lying, owners, number, seeing, float(shown[number].sum())),
            _blur(matching, here, lying, seeing[number]),
            _spread(matching, here, lying, seeing[number]),
            0.0,
            _outside(outside[part]),
        )
    marks[:, MARKS.index("sharpness")] = _sharpness(matching, samples, tight)
    return marks


def _sharpness(matching: EdgelMatching, samples: EdgeSamples, tight_px: float) -> np.ndarray:
    """(E,) see `marks_of`, at the middles of parts of each edge."""
    chosen, edge = middles(samples)
    found = rounding_at(matching, samples.points[chosen], samples.directions[chosen], tight_px)
    count = len(samples.starts) - 1
    sharp, rounded = (np.bincount(edge, views, count) for views in (found.views, found.rounded))
    return sharp / np.maximum(rounded + PRIOR * np.bincount(edge, minlength=count), 1.0)


def middles(samples: EdgeSamples) -> tuple[np.ndarray, np.ndarray]:
    """(n,) indices of those of the EdgeSamples, SPACING_PX apart, at which radii are tried: in the middles of equal
    parts of each edge. And (n,) the edges that they are on.
    """
    lengths = np.diff(samples.starts)
    counts = np.clip((lengths * SPACING_PX / PLACE_PX).astype(int), 1, PLACES)
    edge, place = ragged(np.where(lengths > 0, counts, 0))
    return samples.starts[edge] + ((place + 0.5) * lengths[edge] / counts[edge]).astype(int), edge


def _owners(matching: EdgelMatching, samples: EdgeSamples, about: EdgelsAbout, on_px: float) -> np.ndarray:
    """(e + 1,) the shape that each edgel lies on, -1 for none: of several that which more views show; last: -1.

    Where an edge has no edgels of its own and lies beside one that has, it shall not share these.
    """
    near = about.within(on_px)
    strength = samples.sums(about.closeness(on_px).sum(axis=1)) / np.maximum(np.diff(samples.starts), 1)
    at, view = np.nonzero(near)
    edges, edgels = samples.edges[at], about.edgels[at, view]
    rank = np.empty(len(strength))
    rank[np.argsort(-strength, kind="stable")] = np.arange(len(strength))
    claims = Claims.of(len(matching.edgels), edgels, edges, rank[edges])
    owners = claims.owners.copy()
    # The next edgels along a 2D edge are the same edge's, where nobody else is on them.
    neighbors = owners[matching.neighbors].max(axis=1, initial=-1)
    return np.append(np.where(owners < 0, neighbors, owners), -1)


def _steadiness(
    about: EdgelsAbout, on: np.ndarray, owners: np.ndarray, number: int, seeing: np.ndarray, views: float
) -> float:
    """Of the edgels about an edge the share that lies on it, but for those of other edges that show beside it.

    on: (n, V) bool. number: of the edge. seeing: (E, V) bool, which views show which edge. views: that show this one.
    """
    whose = owners[about.edgels[about.there & ~on]]
    others, position = np.unique(whose, return_inverse=True)
    mine = seeing[number]
    together = [(mine & seeing[k]).sum() / max(mine.sum(), 1) if k not in (-1, number) else 0.0 for k in others]
    against = 1.0 - np.clip(np.array(together) / TOGETHER, 0.0, 1.0)
    return float(steadiness(views, views + against[position].sum() / max(len(on), 1) + PRIOR))


def _blur(matching: EdgelMatching, about: EdgelsAbout, on: np.ndarray, mine: np.ndarray) -> float:
    """Px, beyond SHARP_PX: how blurred an edge is in the views that show it, `mine`."""
    if not mine.any():
        return MOST_BLUR_PX - SHARP_PX
    blurs = np.where(on[:, mine], matching.edgel_blurs[about.edgels[:, mine]], np.nan)
    known = np.isfinite(blurs).any(axis=0)
    if not known.any():  # ready maps do not tell
        return 0.0
    typical = float(np.quantile(np.nanmedian(blurs[:, known], axis=0), BLUR_QUANTILE))
    return float(np.clip(typical - SHARP_PX, 0.0, MOST_BLUR_PX - SHARP_PX))


def _spread(matching: EdgelMatching, about: EdgelsAbout, on: np.ndarray, mine: np.ndarray) -> float:
    """Sine of the angle by which viewing planes of an edge lean against each other, one of each view in `mine`."""
    if not mine.any():
        return 0.0
    normals = []
    for view in np.flatnonzero(mine):
        edgels = about.edgels[on[:, view], view]
        normal = matching.plane_normals[edgels[len(edgels) // 2]]
        normals.append(normal / np.linalg.norm(normal))
    values = np.linalg.eigvalsh(np.einsum("ni,nj->ij", normals, normals))
    return min(float(np.sqrt(max(values[1], 0.0) / max(values[2], 1e-12))), ENOUGH_SPREAD)


def _outside(beyond: np.ndarray) -> float:
    """Px by which an edge lies beyond the outline in the views that show it farthest outside. beyond: (n, V) px."""
    if not len(beyond) or beyond.shape[1] < OUTSIDE_VIEWS:
        return 0.0
    return min(float(np.sort(np.median(beyond, axis=0))[-OUTSIDE_VIEWS]), MOST_OUTSIDE_PX)
