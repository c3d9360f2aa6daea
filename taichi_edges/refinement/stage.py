"""From single edges to a wireframe: connected, minimal, in agreement with the images."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.evidence.edge_support import (
    EdgeSamples,
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
from taichi_edges.evidence.lying import EdgelsAbout
from taichi_edges.evidence.noise import LEAST_NOISE_PX, MOST_NOISE_PX, ON_NOISES
from taichi_edges.evidence.verdict import marks_of, probabilities, reasons
from taichi_edges.fitting.model_selection import Yardstick
from taichi_edges.geometry.shapes import Shape, middles_of
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
    doubted: {mark: how many edges the verdict left out that it spoke most against}, see `verdict.MARKS`.
    likely_percent: of the length of the edges, how much the verdict expects to be right; None without a verdict.
    shown_percent: of the edgels, how many lie on the edges; None without a verdict.
    relations: {kind: (how many were found, how many of these were imposed)}; what those imply is not imposed again.
    """

    circles: int = 0
    joined: int = 0
    duplicates: int = 0
    anchored: int = 0
    lines: int = 0
    unsupported: int = 0
    doubted: dict[str, int] = field(default_factory=dict)
    likely_percent: float | None = None
    shown_percent: float | None = None
    relations: dict[str, tuple[int, int]] = field(default_factory=dict)


def refine_wireframe(loose: Wireframe, views: "Views", config: "RefineConfig") -> tuple[Wireframe, RefineCounts]:
    """The Wireframe of `loose` edges, in the unit cube, and RefineCounts.

    views: Views. config: the scene's `refine` section. ti.init must have been called.
    """
    if not config.enabled or not len(loose):
        return loose, RefineCounts()
    matching = EdgelMatching(views, config.min_views)
    shapes, counts = whole_edges(strokes_of(loose, matching), matching, config)
    anchored = anchored_lines(matching, shapes) if config.anchor else []
    wireframe, lines = completed(connected([*shapes, *anchored], matching.pixel_at), matching)
    wireframe, relations = related(adjusted(wireframe, matching), matching, config.regularise)
    judged, doubted, unsupported = with_evidence(wireframe, matching, config)
    counts = replace(
        counts,
        anchored=len(anchored),
        lines=lines,
        unsupported=counts.unsupported + unsupported,
        doubted=dict(Counter(counts.doubted) + doubted),
        relations=relations,
    )
    if config.verdict and len(judged):
        counts = replace(counts, likely_percent=likely_percent(judged), shown_percent=shown_percent(matching, judged))
    return judged, counts


def strokes_of(loose: Wireframe, matching: EdgelMatching) -> list[Shape]:
    """The shapes of loose edges, without those that are too short to have a direction."""
    least = LEAST_LENGTH_PX * matching.pixel_at(middles_of(loose.shapes))
    return [shape for shape, length in zip(loose.shapes, least, strict=True) if shape.length >= length]


def whole_edges(
    shapes: Sequence[Shape], matching: EdgelMatching, config: "RefineConfig"
) -> tuple[list[Shape], RefineCounts]:
    """The shapes of whole edges from those of strokes, and RefineCounts of what that took.

    Free ends are extended only when it is known which are free, and then some more strokes continue each other.
    """
    yardstick, seen = yardstick_of(shapes, matching), partial(support_along, matching)
    likely, hopeless, unseen = not_hopeless(matching, shapes, config)
    shapes, first = continued(likely, yardstick, matching.pixel_at, seen)
    kept, doubted, lost = with_support(matching, shapes, config)
    longer = with_longer_ends(matching, kept)
    longer, second = continued(longer, yardstick, matching.pixel_at, seen, WIDE_GAP_PX)
    found, doubted_too, lost_too = with_support(matching, longer, config)
    counts = asdict(first + second) | {"unsupported": unseen + lost + lost_too}
    return found, RefineCounts(**counts, doubted=dict(hopeless + doubted + doubted_too))


def yardstick_of(shapes: Sequence[Shape], matching: EdgelMatching) -> Yardstick:
    """The Yardstick of strokes at the scene: the noise of their edgels, and by how much edges are off beyond it."""
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


def with_evidence(
    wireframe: Wireframe, matching: EdgelMatching, config: "RefineConfig"
) -> tuple[Wireframe, Counter[str], int]:
    """The Wireframe with what the images say about each edge, and without those they do not support.

    Also {mark: how many the verdict left out for it}, and how many others were left out.
    """
    support = support_of(matching, wireframe.shapes)
    found, doubts = evidence_of(support), np.full(len(wireframe), "", object)
    if config.verdict:
        likely, doubts = judged_shapes(matching, wireframe.shapes, support, config.min_confidence)
        found = [replace(of, confidence=float(p)) for of, p in zip(found, likely, strict=True)]
    edges = tuple(replace(edge, evidence=of) for edge, of in zip(wireframe.edges, found, strict=True))
    sure = doubts == "" if config.verdict else np.array([of.confidence >= LEAST_CONFIDENCE for of in found], bool)
    sure &= is_edge(matching, support, wireframe.shapes, config)
    return replace(wireframe, edges=edges).keep(sure), *left_out(doubts, sure)


def left_out(doubts: np.ndarray, kept: np.ndarray) -> tuple[Counter[str], int]:
    """{mark: how many edges the verdict left out for it}, and how many the images do not support, of (E,) edges."""
    found = Counter(doubts[~kept])
    unsupported = found.pop("", 0) + found.pop("support", 0)
    return found, unsupported


def judged_shapes(
    matching: EdgelMatching, shapes: Sequence[Shape], support: Support, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """(E,) probabilities that shapes are edges; and (E,) the mark that speaks most against each of those that are less
    likely than `least`, '' for the others.
    """
    marks = marks_of(matching, shapes, edgel_noise(support))
    likely = probabilities(marks)
    return likely, np.where(likely >= least, "", np.array(reasons(marks), object))


def likely_percent(wireframe: Wireframe) -> float:
    """Of the length of edges that the verdict has judged, how much it expects to be right."""
    lengths = np.array([shape.length for shape in wireframe.shapes])
    confidences = np.array([edge.evidence.confidence for edge in wireframe.edges if edge.evidence])
    return float(100.0 * (lengths * confidences).sum() / lengths.sum())


def shown_percent(matching: EdgelMatching, wireframe: Wireframe) -> float:
    """Of the edgels of all views, how many lie on the edges."""
    samples = EdgeSamples.along(wireframe.shapes, matching.pixel_at(middles_of(wireframe.shapes)))
    noise = edgel_noise(support_of(matching, wireframe.shapes))
    about = EdgelsAbout.of(matching, samples.points, samples.directions, ON_NOISES * noise)
    shown = np.zeros(len(matching.edgels), bool)
    shown[about.edgels[about.there]] = True
    return float(100.0 * shown[matching.neighbors].any(axis=1).mean())


def edgel_noise(support: Support) -> float:
    """Standard deviation of the edgels of a Support across the edges on which they lie best, px."""
    return float(np.clip(support.least_noise_px, LEAST_NOISE_PX, MOST_NOISE_PX))


def not_hopeless(
    matching: EdgelMatching, shapes: Sequence[Shape], config: "RefineConfig"
) -> tuple[list[Shape], Counter[str], int]:
    """The strokes that may be part of an edge: what hardly can would lead others astray, and takes time.

    The rest as of `with_evidence`.
    """
    if not config.verdict or not len(shapes):
        return list(shapes), Counter(), 0
    _, doubts = judged_shapes(matching, shapes, support_of(matching, shapes), HOPELESS * config.min_confidence)
    return [shape for shape, doubt in zip(shapes, doubts, strict=True) if not doubt], *left_out(doubts, doubts == "")


def with_support(
    matching: EdgelMatching, shapes: Sequence[Shape], config: "RefineConfig"
) -> tuple[list[Shape], Counter[str], int]:
    """The shapes that the images support; their places are not exact yet. The rest as of `with_evidence`."""
    support = support_of(matching, shapes)
    supported, doubts = is_edge(matching, support, shapes, config, LENIENT), np.full(len(shapes), "", object)
    if config.verdict and len(shapes):
        _, doubts = judged_shapes(matching, shapes, support, DOUBTED * config.min_confidence)
    kept = supported & (doubts == "")
    return [shape for shape, keep in zip(shapes, kept, strict=True) if keep], *left_out(doubts, kept)


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
    wireframe, claims = connected(shapes, matching.pixel_at), claims_of(matching, shapes)
    degrees = wireframe.degrees
    free = [[side for side, end in enumerate(edge.vertices) if degrees[end] == 1] for edge in wireframe.edges]

    def seen(numbers: list[int], places: list[tuple[Shape, np.ndarray]]) -> list[np.ndarray]:
        return support_of_places(matching, places, claims, numbers)

    return extended(shapes, free, seen, matching.pixel_at)
