"""From single edges to a wireframe: connected, minimal, in agreement with the images."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from taichi_edges.edges.adjustment import adjusted
from taichi_edges.edges.completion import completed
from taichi_edges.edges.continuation import Merging, continued
from taichi_edges.edges.evidence import claims_of, support_along, supported
from taichi_edges.edges.extents import extended
from taichi_edges.edges.junctions import connected
from taichi_edges.edges.model_selection import Yardstick
from taichi_edges.kernels.edgel_matching import EdgelMatching

NOISE_PX = 0.2  # by which a place on an edge may be off its shape, at least: next to other edges every detector is
STRETCH_PX = 4.0  # length of an edge on which the errors go together
WIDE_GAP_PX = 24.0  # between strokes that continue each other, where their ends are still free after the first pass
LEAST_SUPPORTED = 0.33  # of the length of an edge; where edges touch, only one of them owns the edgels


@dataclass(frozen=True)
class RefineCounts:
    """What the refinement did: circles completed, strokes joined to others, lines added between
    vertices, and what was left out."""

    circles: int = 0
    joined: int = 0
    duplicates: int = 0
    lines: int = 0
    unsupported: int = 0


def refine_wireframe(loose, views, config):
    """The Wireframe of `loose` edges, in the unit cube, and RefineCounts.

    views: Views. config: the scene's `refine` section. ti.init must have been called.
    """
    if not config.enabled or not len(loose):
        return loose, RefineCounts()
    matching = EdgelMatching(views)
    yardstick = Yardstick(NOISE_PX * matching.pixel, STRETCH_PX * matching.pixel)
    seen, pixel = partial(support_along, matching), matching.pixel
    shapes, first = continued(loose.shapes, yardstick, pixel, seen)
    kept = with_support(matching, shapes)
    shapes, second = continued(with_longer_ends(matching, kept), yardstick, pixel, seen, WIDE_GAP_PX)
    wireframe, lines = completed(connected(with_support(matching, shapes), pixel), matching)
    wireframe = adjusted(wireframe, matching)
    judged = with_evidence(wireframe, matching)
    counts = [getattr(first, name) + getattr(second, name) for name in Merging.__dataclass_fields__]
    return judged, RefineCounts(*counts, lines, len(shapes) + lines - len(judged))


def with_evidence(wireframe, matching):
    """The Wireframe with what the images say about each edge, without those they do not support."""
    found = supported(matching, wireframe.shapes)
    edges = [replace(edge, evidence=of) for edge, of in zip(wireframe.edges, found, strict=True)]
    kept = [edge.evidence.supported_length >= LEAST_SUPPORTED * edge.shape.length for edge in edges]
    return replace(wireframe, edges=tuple(edges)).keep(np.array(kept, dtype=bool))


def with_support(matching, shapes):
    """The shapes that the images support on a third of their length, at least."""
    pairs = zip(shapes, supported(matching, shapes), strict=True)
    return [shape for shape, found in pairs if found.supported_length >= LEAST_SUPPORTED * shape.length]


def with_longer_ends(matching, shapes):
    """The shapes, ends that would meet no other extended as far as the images show them."""
    wireframe, claims = connected(shapes, matching.pixel), claims_of(matching, shapes)
    degrees = wireframe.degrees
    longer = []
    for number, (shape, edge) in enumerate(zip(shapes, wireframe.edges, strict=True)):
        free = [side for side, end in enumerate(edge.vertices) if degrees[end] == 1]
        seen = partial(support_along, matching, claims=claims, own=number)
        longer.append(extended(shape, free, seen, matching.pixel) if free else shape)
    return longer
