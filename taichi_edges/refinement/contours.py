"""Contours of rounded surfaces: lines that the verdict holds for no edges, and the radius of the surface behind them.

The strokes along a round are each where the contour was in some views (contour generators). They are contours, and no
chance lines or blurred edges, if one radius explains many more views than a sharp edge does, and most of those that
show anything there. All tolerances are pixels and shares.
"""

from collections.abc import Sequence
from dataclasses import astuple
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.evidence.edge_support import EdgeSamples, support_along, support_of
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.rounding import Rounding, radii_at
from taichi_edges.evidence.verdict import SPACING_PX, TIGHT_NOISES, middles
from taichi_edges.fitting.model_selection import Yardstick, track_of
from taichi_edges.geometry.shapes import Shape, middles_of
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.refinement.continuation import beside_others, continued, yardsticks_at
from taichi_edges.refinement.stage import edgel_noise, judged_shapes, strokes_of, yardstick_of

if TYPE_CHECKING:
    from taichi_edges.scene.settings import RefineConfig
    from taichi_edges.views.views import Views

LEAST_LENGTH_PX = 8.0  # of a stroke: radii are told at places 4 px apart, and it shall have two
LEAST_ON_EDGE = 0.5  # of a stroke beside edges that are kept: it is a piece of one of these
MANY_MORE = 1.5  # times the views of a sharp edge: of exact contours 1.7 and more, of sharp edges 1.0
LEAST_SHARE = 0.6  # of the views with edgels about; lines that chance puts between contours of real parts have less
LEAST_TOLD_PX = 5.0  # radii; of fillets of 3 and 5 px on real parts a third is missing
MOST_RANGE = 5 / 3  # greatest over least radius: known to a quarter


def found_contours(
    loose: Wireframe, wireframe: Wireframe, views: "Views", config: "RefineConfig"
) -> tuple[list[Shape], Rounding, np.ndarray]:
    """Contours among the strokes, `loose` edges, that are on no edge of a wireframe; the Rounding of each; and (n,) the
    size of a pixel at each.

    All in the unit cube. config: the scene's `refine` section. ti.init must have been called.
    """
    matching = EdgelMatching(views, config.min_views)
    strokes = strokes_of(loose, matching)
    support, yardstick = support_of(matching, strokes), yardstick_of(strokes, matching)
    likely, _ = judged_shapes(matching, strokes, support, config.min_confidence)
    doubted = [stroke for stroke, p in zip(strokes, likely, strict=True) if p < config.min_confidence]
    yardsticks = yardsticks_at(middles_of(doubted), yardstick, matching.pixel_at)
    pairs = zip(doubted, yardsticks, strict=True)
    alone = [stroke for stroke, own in pairs if stands_alone(stroke, wireframe.shapes, own)]
    tight_px = TIGHT_NOISES * edgel_noise(support)
    seen = partial(support_along, matching)
    joined, _ = continued(rounded(matching, alone, tight_px)[0], yardstick, matching.pixel_at, seen)
    contours, rounding = rounded(matching, joined, tight_px)
    return contours, rounding, matching.pixel_at(middles_of(contours))


def stands_alone(stroke: Shape, edges: Sequence[Shape], yardstick: Yardstick) -> bool:
    """Is a stroke long enough to be a contour, and beside none of the edges?"""
    if stroke.length < LEAST_LENGTH_PX * yardstick.pixel:
        return False
    return bool(beside_others(track_of(stroke, yardstick.pixel), edges, yardstick).mean() < LEAST_ON_EDGE)


def rounded(matching: EdgelMatching, shapes: Sequence[Shape], tight_px: float) -> tuple[list[Shape], Rounding]:
    """Those of the shapes that are contours of round surfaces, and the Rounding of each: medians over its places."""
    samples = EdgeSamples.along(shapes, SPACING_PX * matching.pixel_at(middles_of(shapes)))
    chosen, edges = middles(samples)
    places = radii_at(matching, samples.points[chosen], samples.directions[chosen], tight_px)
    found = Rounding(*(medians(values, edges, len(shapes)) for values in astuple(places)))
    many_more = found.rounded >= np.maximum(MANY_MORE * found.views, LEAST_SHARE * found.around)
    told = (found.least_px >= LEAST_TOLD_PX) & (found.most_px <= MOST_RANGE * found.least_px)
    kept = many_more & told
    contours = [shape for shape, keep in zip(shapes, kept, strict=True) if keep]
    return contours, Rounding(*(values[kept] for values in astuple(found)))


def medians(values: np.ndarray, edges: np.ndarray, count: int) -> np.ndarray:
    """(count,) of those of the (n,) values that are of each edge."""
    return np.array([np.median(values[edges == number]) for number in range(count)])
