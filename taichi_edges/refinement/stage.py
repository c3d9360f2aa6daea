"""From single edges to a wireframe: connected, minimal, in agreement with the images."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.evidence.edge_support import (
    Support,
    claims_of,
    evidence_of,
    steadiness_of_edges,
    support_along,
    support_of,
    support_of_places,
    support_share,
)
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.noise import LEAST_NOISE_PX, MOST_NOISE_PX
from taichi_edges.evidence.verdict import marks_of, probabilities
from taichi_edges.fitting.model_selection import Yardstick
from taichi_edges.geometry.shapes import Shape
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.refinement.adjustment import adjusted
from taichi_edges.refinement.anchoring import anchored_lines
from taichi_edges.refinement.completion import completed
from taichi_edges.refinement.continuation import continued
from taichi_edges.refinement.extents import extended
from taichi_edges.refinement.junctions import connected
from taichi_edges.refinement.regularities import found_relations, regularised

if TYPE_CHECKING:
    from taichi_edges.scene.settings import RefineConfig
    from taichi_edges.views.views import Views

NOISE_PX = 0.2  # by which an edge is off its shape, beyond the noise: next to other edges every detector is biased
LEAST_LENGTH_PX = 0.1  # of a stroke; a shorter one has no direction
WIDE_GAP_PX = 24.0  # between strokes that continue each other, where their ends are still free after the first pass
MOST_COMPARED = 150  # edges whose relations are counted where nobody asked for them: there are as many as its square
LEAST_CONFIDENCE = 0.2  # of an edge, see `edge_support.evidence_of`
LENIENT = 0.75  # of the steadiness, for edges that have not been adjusted
HOPELESS = 0.1  # of the least confidence, for strokes: pieces of an edge are less sure than all of it
DOUBTED = 0.3  # of the least confidence, for the same: ends that are not in place yet tell against an edge
LEAST_SUPPORTED = 0.33  # of the length of an edge; where edges touch, only one of them owns the edgels


@dataclass(frozen=True)
class RefineCounts:
    """What the refinement did.

    circles: arcs that became whole circles. joined: strokes that became part of others. duplicates: strokes that
    repeated others. anchored: lines that got their depth from edges that they meet. lines: added between vertices.
    unsupported: edges left out as the images do not show them.
    relations: {kind: (how many were found, how many of these were imposed)}; what those imply is not imposed again.
    """

    circles: int = 0
    joined: int = 0
    duplicates: int = 0
    anchored: int = 0
    lines: int = 0
    unsupported: int = 0
    relations: dict[str, tuple[int, int]] = field(default_factory=dict)


def refine_wireframe(loose: Wireframe, views: "Views", config: "RefineConfig") -> tuple[Wireframe, RefineCounts]:
    """The Wireframe of `loose` edges, in the unit cube, and RefineCounts.

    views: Views. config: the scene's `refine` section. ti.init must have been called.
    """
    if not config.enabled or not len(loose):
        return loose, RefineCounts()
    matching = EdgelMatching(views, config.min_views)
    strokes = [shape for shape in loose.shapes if shape.length >= LEAST_LENGTH_PX * matching.pixel]
    shapes, counts = whole_edges(strokes, matching, config)
    anchored = anchored_lines(matching, shapes) if config.anchor else []
    wireframe, lines = completed(connected([*shapes, *anchored], matching.pixel), matching)
    wireframe, relations = related(adjusted(wireframe, matching), matching, config.regularise)
    judged = with_evidence(wireframe, matching, config)
    unsupported = counts.unsupported + len(wireframe) - len(judged)
    counts = replace(counts, anchored=len(anchored), lines=lines, unsupported=unsupported, relations=relations)
    return judged, counts


def whole_edges(
    shapes: Sequence[Shape], matching: EdgelMatching, config: "RefineConfig"
) -> tuple[list[Shape], RefineCounts]:
    """The shapes of whole edges from those of strokes, and RefineCounts of what that took.

    Free ends are extended only when it is known which are free, and then some more strokes continue each other.
    """
    yardstick, seen = yardstick_of(shapes, matching), partial(support_along, matching)
    likely = not_hopeless(matching, shapes, config)
    hopeless = len(shapes) - len(likely)
    shapes, first = continued(likely, yardstick, seen)
    kept = with_support(matching, shapes, config)
    longer, second = continued(with_longer_ends(matching, kept), yardstick, seen, WIDE_GAP_PX)
    found = with_support(matching, longer, config)
    unsupported = hopeless + len(shapes) - len(kept) + len(longer) - len(found)
    return found, RefineCounts(**asdict(first + second), unsupported=unsupported)


def yardstick_of(shapes: Sequence[Shape], matching: EdgelMatching) -> Yardstick:
    """The Yardstick of strokes: the noise of their edgels, and by how much edges are off beyond it."""
    noise = np.hypot(NOISE_PX, support_of(matching, shapes).noise_px)
    return Yardstick(noise * matching.pixel, matching.pixel)


def related(
    wireframe: Wireframe, matching: EdgelMatching, impose: bool
) -> tuple[Wireframe, dict[str, tuple[int, int]]]:
    """The Wireframe, with the relations that its edges have if these are to be imposed; and RefineCounts.relations."""
    if impose:
        return regularised(wireframe, matching)
    if len(wireframe) > MOST_COMPARED:
        return wireframe, {}
    return wireframe, {kind: (count, 0) for kind, count in found_relations(wireframe, matching)[0].items()}


def with_evidence(wireframe: Wireframe, matching: EdgelMatching, config: "RefineConfig") -> Wireframe:
    """The Wireframe with what the images say about each edge, and without those they do not support."""
    support = support_of(matching, wireframe.shapes)
    found = evidence_of(support)
    if config.verdict:
        likely = probabilities(marks_of(matching, wireframe.shapes, edgel_noise(support)))
        found = [replace(of, confidence=float(p)) for of, p in zip(found, likely, strict=True)]
    edges = tuple(replace(edge, evidence=of) for edge, of in zip(wireframe.edges, found, strict=True))
    least = config.min_confidence if config.verdict else LEAST_CONFIDENCE
    sure = np.array([of.confidence >= least for of in found], dtype=bool)
    return replace(wireframe, edges=edges).keep(sure & is_edge(matching, support, wireframe.shapes, config))


def edgel_noise(support: Support) -> float:
    """Standard deviation of the edgels of a Support across their edges, px."""
    return float(np.clip(support.noise_px, LEAST_NOISE_PX, MOST_NOISE_PX))


def not_hopeless(matching: EdgelMatching, shapes: Sequence[Shape], config: "RefineConfig") -> list[Shape]:
    """The strokes that may be part of an edge: what hardly can would lead others astray, and takes time."""
    if not config.verdict or not len(shapes):
        return list(shapes)
    likely = probabilities(marks_of(matching, shapes, edgel_noise(support_of(matching, shapes))))
    return [shape for shape, p in zip(shapes, likely, strict=True) if p >= HOPELESS * config.min_confidence]


def with_support(matching: EdgelMatching, shapes: Sequence[Shape], config: "RefineConfig") -> list[Shape]:
    """The shapes that the images support; their places are not exact yet."""
    support = support_of(matching, shapes)
    kept = is_edge(matching, support, shapes, config, LENIENT)
    if config.verdict:
        kept &= probabilities(marks_of(matching, shapes, edgel_noise(support))) >= DOUBTED * config.min_confidence
    return [shape for shape, keep in zip(shapes, kept, strict=True) if keep]


def is_edge(
    matching: EdgelMatching, support: Support, shapes: Sequence[Shape], config: "RefineConfig", lenience: float = 1.0
) -> np.ndarray:
    """(E,) bool: enough of a shape is supported, by enough views, and its edgels stay on it as the viewpoint moves.

    config: the scene's `refine` section. lenience: factor on what it asks for.
    """
    enough = support.supported_lengths >= LEAST_SUPPORTED * np.array([shape.length for shape in shapes])
    if config.min_support:
        enough &= support_share(matching, support) >= lenience * config.min_support
    return enough & (steadiness_of_edges(matching, support) >= lenience * config.min_steadiness)


def with_longer_ends(matching: EdgelMatching, shapes: Sequence[Shape]) -> list[Shape]:
    """The shapes, ends that would meet no other extended as far as the images show them."""
    wireframe, claims = connected(shapes, matching.pixel), claims_of(matching, shapes)
    degrees = wireframe.degrees
    free = [[side for side, end in enumerate(edge.vertices) if degrees[end] == 1] for edge in wireframe.edges]

    def seen(numbers: list[int], places: list[tuple[Shape, np.ndarray]]) -> list[np.ndarray]:
        return support_of_places(matching, places, claims, numbers)

    return extended(shapes, free, seen, matching.pixel)
