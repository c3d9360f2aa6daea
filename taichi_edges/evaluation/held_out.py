"""Edges against views that were held out of everything that found them: a truth that every scene has.

The edges are projected into each of these views and held against the sub-pixel edgels there. What is hidden there must
not count as wrong. No surface is known, but the views that the edges were made from say from where each place of an
edge is seen: a place that they see, but not those that look from nearly the direction of the held-out view, is expected
to be hidden from there, and is not judged. A place that no more of them see than would by chance is judged: it is on an
edge that does not exist.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taichi_edges.evaluation.edgel_index import EdgelIndex
from taichi_edges.evaluation.projected_curves import Chords, Traces
from taichi_edges.views.edgels import MOST_SINE
from taichi_edges.views.splitting import LEAST_LEFT
from taichi_edges.views.views import Views, pixel_size

MATCH_PX = 1.5  # an edge and an edgel so near are one, if they are parallel too (MOST_SINE); as in `edge_support`
REACH_PX = 3.0  # within which residuals are looked at: what is this far off is no match, but neither hidden
SPACING_PX = 0.75  # of the samples of a projected edge: edgels are about 1 px apart
PLACE_PX = 4.0  # between the places of an edge that the views are asked about, at the middle of the scene box
MOST_PLACES = 20_000  # of all edges; where these are longer, the places are farther apart
NEIGHBORS = 8  # views nearest by direction that say whether a place is visible from there, by angle^-2 each,
VISIBLE = 0.7  # and how much of their weight must see it: of the true edges of synthetic parts, one in twenty of the
# places that are hidden passes, and three in four of those that are visible
LEAST_ANGLE = 1e-6  # radians^2; directions nearer than a milliradian are one
SURE = 3.0  # standard deviations beyond the number of views that would see an edgel at a place by chance
ASIDE_PX = 12.0  # displacement at which agreement is chance: farther than edges are wrong, within the same texture
ASIDE_EVERY = 4  # samples that are displaced: chance needs no more


# ------------------------------------------------------------------------------------------------------- visibility


@dataclass(frozen=True)
class Visibility:
    """What views show of some places on edges.

    places: (n, 3). inside, seen: (n, V) bool: the view has the place in its image; it has an edgel within REACH_PX.
    towards: (n, V, 3) unit directions to the cameras. real: (n,) bool, more views match it than would by chance.
    """

    places: np.ndarray
    inside: np.ndarray
    seen: np.ndarray
    towards: np.ndarray
    real: np.ndarray

    @staticmethod
    def of(places: np.ndarray, tangents: np.ndarray, views: Views) -> "Visibility":
        """Of (n, 3) places with unit tangents, unit cube, in Views."""
        assert views.edgels is not None
        inside, seen, matched = np.zeros((3, len(places), len(views)), bool)
        towards, chance = np.zeros((len(places), len(views), 3)), np.zeros(len(views))
        for view in range(len(views)):
            camera, (points, normals, _) = views.camera(view), views.edgels.of_view(view)
            pixels, along, inside[:, view] = camera.project_lines(places, tangents)
            there = np.flatnonzero(inside[:, view])
            index = EdgelIndex.of(points, normals, views.width, views.height)
            at, _, away = index.agreeing(pixels[there], along[there], REACH_PX)
            seen[there[at], view] = True
            matched[there[at[np.abs(away) <= MATCH_PX]], view] = True
            towards[:, view] = _unit(camera.centre - places)
            chance[view] = chance_of_match(points)
        expected, variance = inside @ chance, inside @ (chance * (1.0 - chance))
        enough = np.maximum(expected + SURE * np.sqrt(variance), LEAST_LEFT)
        return Visibility(places, inside, seen, towards, matched.sum(axis=1) >= enough)

    def judged_from(self, centre: np.ndarray) -> np.ndarray:
        """(n,) bool: which places a view from `centre` (3,) ought to show, or are nowhere to be seen."""
        cosines = np.einsum("nvc,nc->nv", self.towards, _unit(centre - self.places))
        nearest = np.argsort(np.where(self.inside, -cosines, np.inf), axis=1, kind="stable")[:, :NEIGHBORS]
        cosines, inside, seen = (np.take_along_axis(of, nearest, axis=1) for of in (cosines, self.inside, self.seen))
        weights = inside / np.maximum(2.0 - 2.0 * cosines, LEAST_ANGLE)
        return ~self.real | ((weights * seen).sum(axis=1) >= VISIBLE * weights.sum(axis=1))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def chance_of_match(points: np.ndarray) -> float:
    """Share of the places of an image within whose MATCH_PX some edgel happens to run their way. points: (e, 2)."""
    if not len(points):
        return 0.0
    density = len(points) / np.prod(np.ptp(points, axis=0) + 1.0)  # px of edge for each px^2
    turned = 2.0 * np.arcsin(MOST_SINE) / np.pi
    return 1.0 - np.exp(-2.0 * MATCH_PX * density * turned)


# ---------------------------------------------------------------------------------------------------------- metrics


@dataclass(frozen=True)
class Score:
    """What held-out views say, sums over them that divide into shares.

    length, judged, matched: px of projected edges, of these the judged ones, and of these the matched ones. displaced,
    by_chance: px of judged edges that were displaced, and of these the matched ones. edgels, explained: strengths of
    the edgels, and of those that edges explain; long_edgels, long_explained: of those on long edges. residuals:
    distances of the judged samples from their edgels, px.
    """

    length: float
    judged: float
    matched: float
    displaced: float
    by_chance: float
    edgels: float
    explained: float
    long_edgels: float
    long_explained: float
    residuals: np.ndarray


def held_out_metrics(polylines: Sequence[np.ndarray], training: Views, held_out: Views) -> dict[str, float | None]:
    """The metrics of edges in held-out views, a dict that JSON can hold; None where a number does not exist.

    polylines: list of (m, 3), unit cube. training: Views that the edges were made from. held_out: Views.
    """
    scores = []
    chords = Chords.of(polylines)
    if len(held_out):
        spacing = max(PLACE_PX * pixel_size(training), chords.travelled[-1] / MOST_PLACES)
        places, tangents, ends = chords.places(spacing)
        visibility = Visibility.of(places, tangents, training)
        scores = [score_view(chords, ends, visibility, held_out, view) for view in range(len(held_out))]
    return {"held_out_views": len(held_out), **metrics_of(scores)}


def score_view(chords: Chords, ends: np.ndarray, visibility: Visibility, views: Views, view: int) -> Score:
    """Score of Chords in one of some Views. ends: (n,) where on the Chords the stretch of each place ends."""
    assert views.edgels is not None
    camera, (points, normals, strengths) = views.camera(view), views.edgels.of_view(view)
    index = EdgelIndex.of(points, normals, views.width, views.height)
    traces = chords.in_image(camera, SPACING_PX)
    place = np.minimum(np.searchsorted(ends, traces.travelled), len(ends) - 1)
    judged = visibility.judged_from(camera.centre)[place] if len(traces) else np.zeros(0, bool)
    at, edgels, beside = index.agreeing(traces.pixels, traces.along, REACH_PX)
    away = np.linalg.norm(traces.pixels[at] - points[edgels], axis=1)
    distances = np.full(len(traces), np.inf)
    np.minimum.at(distances, at, away)
    nearest = (away == distances[at]) & judged[at]
    explained = np.zeros(len(points), bool)
    explained[edgels[away <= MATCH_PX]] = True
    long = index.on_long_edges()
    matched = judged & (distances <= MATCH_PX)
    displaced, by_chance = _displaced(index, traces, judged)
    return Score(
        length=float(traces.lengths.sum()),
        judged=float(traces.lengths[judged].sum()),
        matched=float(traces.lengths[matched].sum()),
        displaced=displaced,
        by_chance=by_chance,
        edgels=float(strengths.sum(dtype=np.float64)),
        explained=float(strengths[explained].sum(dtype=np.float64)),
        long_edgels=float(strengths[long].sum(dtype=np.float64)),
        long_explained=float(strengths[long & explained].sum(dtype=np.float64)),
        residuals=np.abs(beside[nearest]),
    )


def _displaced(index: EdgelIndex, traces: Traces, judged: np.ndarray) -> tuple[float, float]:
    """Length of judged samples that are displaced to both sides, and of those of them that match there, px."""
    some = np.flatnonzero(judged)[::ASIDE_EVERY]
    length = matched = 0.0
    for side in (-ASIDE_PX, ASIDE_PX):
        along = traces.along[some]
        places = traces.pixels[some] + side * np.stack([-along[:, 1], along[:, 0]], axis=1)
        found = np.unique(index.agreeing(places, along, MATCH_PX)[0])
        length, matched = length + traces.lengths[some].sum(), matched + traces.lengths[some[found]].sum()
    return float(length), float(matched)


def metrics_of(scores: Sequence[Score]) -> dict[str, float | None]:
    """The shares and residuals of all views together."""

    def percent(part: str, whole: str) -> float | None:
        total = sum(getattr(score, whole) for score in scores)
        return 100.0 * sum(getattr(score, part) for score in scores) / total if total else None

    residuals = np.concatenate([np.zeros(0), *(score.residuals for score in scores)])
    precision, recall = percent("matched", "judged"), percent("long_explained", "long_edgels")
    both = (precision or 0.0) + (recall or 0.0)
    return {
        "held_out_precision_percent": precision,
        "held_out_chance_percent": percent("by_chance", "displaced"),
        "held_out_judged_percent": percent("judged", "length"),
        "held_out_recall_percent": percent("explained", "edgels"),
        "held_out_recall_long_percent": recall,
        "held_out_f_score_percent": (2.0 * (precision or 0.0) * (recall or 0.0) / both if both else 0.0)
        if scores
        else None,
        "held_out_residual_median_px": float(np.median(residuals)) if len(residuals) else None,
        "held_out_residual_p90_px": float(np.percentile(residuals, 90)) if len(residuals) else None,
    }
