"""What the edgels of all views say about edges whose shapes are known.

The nearest edge owns the edgel: an edge gets no support from its neighbour's edgels. That a view has no edgel where an
edge projects says nothing against it, for it may be hidden there; that the edgels near it are off it does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammainc

from taichi_edges.arrays.robust import NORMAL_MAD, geman_mcclure
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.lying import EdgelsAbout, steadiness
from taichi_edges.evidence.noise import BEST_SUPPORTED, noise_of_best_agreeing
from taichi_edges.geometry.shapes import Shape, middles_of
from taichi_edges.geometry.wireframe import Evidence
from taichi_edges.views.edgels import MOST_SINE

SPACING_PX = 0.5  # of the samples of an edge; edgels are about 1 px apart, so that hardly one of them is missed
MATCH_PX = 1.5  # an edgel within this distance is an edge's, if it is nobody else's
TIE_PX = 0.1  # beyond its ends an edge must be nearer to an edgel than its neighbour is, by so much
CHORDS = 64  # for each cubic: where places at equal distances along a shape are looked for
CORE, CORE_ROUNDS = 3.0, 8  # standard deviations of the core; rounds in which it is found
TIE_NOISES = 3.0  # of the noise: what cannot make the worse of two edges the nearer one
ABOUT, MOST_ABOUT_PX = 6.0, 4.0  # an edgel within so many times the distance at which it is on an edge is about it
TIGHT_PX, TIGHT_NOISES = 0.25, 2.0  # residuals of an edge: within the first, or within so many times the noise
PLANES = 2  # those of two views always meet


@dataclass(frozen=True)
class EdgeSamples:
    """Places at equal distances along each of some shapes, in the middle of the stretches they stand for.

    points, directions: (n, 3), unit vectors. edges: (n,) index of the shape. parameters: (n,) on it, see `shapes`.
    lengths: (n,) of the stretches. starts: (E + 1,) those of shape e are starts[e] .. starts[e + 1] - 1.
    """

    points: np.ndarray
    directions: np.ndarray
    edges: np.ndarray
    parameters: np.ndarray
    lengths: np.ndarray
    starts: np.ndarray

    @staticmethod
    def along(shapes: Sequence[Shape], spacing: float | np.ndarray) -> "EdgeSamples":
        """Samples of shapes, one for each at least. spacing: units of their frame, of all, or (E,) of each."""
        spacings = np.broadcast_to(spacing, len(shapes)).tolist()
        parameters = [spaced(shape, own) for shape, own in zip(shapes, spacings, strict=True)]
        counts = np.array([len(some) for some in parameters], dtype=np.int64)
        pairs = list(zip(shapes, parameters, strict=True))
        return EdgeSamples(
            np.concatenate([np.zeros((0, 3)), *(shape.at(some) for shape, some in pairs)]),
            np.concatenate([np.zeros((0, 3)), *(shape.tangents(some) for shape, some in pairs)]),
            np.repeat(np.arange(len(shapes)), counts),
            np.concatenate([np.zeros(0), *parameters]),
            np.repeat(np.array([shape.length for shape in shapes]) / np.maximum(counts, 1), counts),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        )

    @staticmethod
    def of_points(points: np.ndarray, directions: np.ndarray, edges: np.ndarray, spacing: float) -> "EdgeSamples":
        """Of (n, 3) points with (n, 3) directions on edges 0 .. E - 1, (n,) rising: samples `spacing` apart."""
        counts = np.bincount(edges) if len(edges) else np.zeros(0, np.int64)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return EdgeSamples(points, directions, edges, np.zeros(len(points)), np.full(len(points), spacing), starts)

    def __len__(self) -> int:
        return len(self.points)

    def of(self, edge: int) -> slice:
        """Slice of the samples of one shape."""
        return slice(int(self.starts[edge]), int(self.starts[edge + 1]))

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(E,) or (E, k) sums of values (n,) or (n, k) over the samples of each shape."""
        totals = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0, dtype=np.float64)])
        return totals[self.starts[1:]] - totals[self.starts[:-1]]


def spaced(shape: Shape, spacing: float) -> np.ndarray:
    """(n,) parameters in the middles of stretches of equal length, about `spacing` long."""
    count = max(round(shape.length / spacing), 1)
    middles = (np.arange(count) + 0.5) / count
    if shape.kind in ("line", "arc", "circle"):
        return middles
    grid = np.linspace(0.0, 1.0, CHORDS * len(shape.cubics()) + 1)
    travelled = np.linalg.norm(np.diff(shape.at(grid), axis=0), axis=1).cumsum()
    return np.interp(middles * travelled[-1], np.concatenate([[0.0], travelled]), grid)


@dataclass(frozen=True)
class Claims:
    """Which of some edges each edgel is nearest to.

    owners: (e,) index of the edge, -1 where none is within MATCH_PX. distances: (e,) px from the owner. rivals: (e,) px
    from the nearest edge that is not the owner. Distances are infinite where there is no such edge; a weak edge's count
    as greater, see `support_of`.
    """

    owners: np.ndarray
    distances: np.ndarray
    rivals: np.ndarray

    @staticmethod
    def of(count: int, edgels: np.ndarray, edges: np.ndarray, distances: np.ndarray) -> "Claims":
        """From pairs of edgel and edge: edgels, edges, distances (p,). count: of edgels. Of ties the first wins."""
        owners, nearest, rivals = np.full(count, np.iinfo(np.int64).max), np.full(count, np.inf), np.full(count, np.inf)
        np.minimum.at(nearest, edgels, distances)
        first = distances == nearest[edgels]
        np.minimum.at(owners, edgels[first], edges[first])
        owners[np.isinf(nearest)] = -1
        others = edges != owners[edgels]
        np.minimum.at(rivals, edgels[others], distances[others])
        return Claims(owners, nearest, rivals)

    def beside(self, edges: np.ndarray | int, edgels: np.ndarray | slice = slice(None)) -> np.ndarray:
        """(e,) px from the nearest edge other than a given one, or than (e,) `edges`; of some edgels only, if given."""
        return np.where(self.owners[edgels] == edges, self.rivals[edgels], self.distances[edgels])


@dataclass(frozen=True)
class Support:
    """The edgels of all views that are matched by the samples of some edges and owned by these.

    samples: EdgeSamples. edgels: (n, V) index, -1 where there is none. residuals: (n, V) px. weights: (n, V) strength
    of the edgel times closeness, that of Geman and McClure at the scale of the matching; 0 where there is none. claims:
    Claims. chance: sum of the weights that a place would have by chance. least_views: that must show an edge, each
    counted by its weight.
    """

    samples: EdgeSamples
    edgels: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    claims: Claims
    chance: float
    least_views: float

    @cached_property
    def views(self) -> np.ndarray:
        """(n,) number of views that support each sample, each counted by its weight."""
        return self.weights.sum(axis=1)

    @cached_property
    def certainty(self) -> np.ndarray:
        """(n,) that so many views do not agree by chance, 0 to 1.

        Two viewing planes always meet. How many more do by chance is a matter of Poisson's distribution.
        """
        beyond = self.views - PLANES
        return np.where(beyond > 0, 1.0 - gammainc(np.maximum(beyond, 1e-9), self.chance), 0.0)

    @cached_property
    def noise_px(self) -> float:
        """Standard deviation of the residuals of the best-supported fifth of the samples, px.

        Of their core: close to other edges the tails are these.
        """
        if not len(self.samples):
            return 0.0
        counts = (self.edgels >= 0).sum(axis=1)  # not the weights, which would choose small residuals
        best = counts >= np.quantile(counts, 1 - BEST_SUPPORTED)
        residuals = np.abs(self.residuals[best][self.edgels[best] >= 0])
        noise = MATCH_PX
        for _ in range(CORE_ROUNDS if len(residuals) else 0):
            noise = float(NORMAL_MAD * np.median(residuals[residuals <= max(CORE * noise, residuals.min())]))
        return noise if len(residuals) else 0.0

    @cached_property
    def least_noise_px(self) -> float:
        """`noise_px` of the samples whose edgels agree best, at most that of all."""
        return min(self.noise_px, noise_of_best_agreeing(np.where(self.edgels >= 0, self.residuals, np.nan)))

    @cached_property
    def supported_lengths(self) -> np.ndarray:
        """(E,) length that `least_views` see, each counted by its weight."""
        return self.samples.sums(self.samples.lengths * (self.views >= self.least_views))

    @cached_property
    def residual_px(self) -> np.ndarray:
        """(E,) root mean square distance of the edgels of each edge, px; 0 where there are none."""
        found = (self.edgels >= 0).sum(axis=1)
        squares = np.where(self.edgels >= 0, self.residuals.astype(np.float64) ** 2, 0.0).sum(axis=1)
        return np.sqrt(self.samples.sums(squares) / np.maximum(self.samples.sums(found), 1))


def support_of(matching: EdgelMatching, shapes: Sequence[Shape], radius: float = MATCH_PX) -> Support:
    """The Support of shapes. matching: EdgelMatching. radius: px, of the matches.

    The noise can make an edgel nearer to the wrong one of two edges, so an edge with fewer views on its length than the
    best one counts as farther away, by up to TIE_NOISES times the noise.
    """
    samples = EdgeSamples.along(shapes, SPACING_PX * matching.pixel_at(middles_of(shapes)))
    found = EdgelsAbout.of(matching, samples.points, samples.directions, radius)
    nearest = _owned(matching, samples, found, np.zeros(len(shapes)))
    strengths = samples.sums(nearest.views) / np.maximum(np.diff(samples.starts), 1)
    handicaps = TIE_NOISES * nearest.noise_px * (1.0 - strengths / max(strengths.max(initial=0.0), 1e-300))
    return _owned(matching, samples, found, handicaps)


def _owned(matching: EdgelMatching, samples: EdgeSamples, about: EdgelsAbout, handicaps: np.ndarray) -> Support:
    """The Support of samples with all EdgelsAbout them. handicaps: (E,) px by which edges count as farther away."""
    at, view = np.nonzero(about.there)
    found, edges = about.edgels[at, view], samples.edges[at]
    claims = Claims.of(len(matching.edgels), found, edges, np.abs(about.residuals[at, view]) + handicaps[edges])
    lost, edgels = claims.owners[found] != edges, about.edgels.copy()
    edgels[at[lost], view[lost]] = -1
    weights = _weights(matching, edgels, about.residuals)
    return Support(samples, edgels, about.residuals, weights, claims, chance_weight(matching), matching.least_views)


def evidence_of(support: Support) -> list[Evidence]:
    """One Evidence for each edge of a Support: what the views say when every edgel supports one edge alone.

    `confidence` is the share of the length that is not there by chance (`Support.certainty`), times how well its edgels
    lie on it: 1 as far as the noise explains their distances, their mean square over that beyond.
    """
    samples, lengths = support.samples, support.samples.lengths
    total = np.maximum(samples.sums(lengths), 1e-300)
    seeing = (samples.sums(lengths[:, None] * (support.edgels >= 0)) >= 0.5 * total[:, None]).sum(axis=1)
    tight = max(TIGHT_PX, TIGHT_NOISES * support.noise_px)
    lying = (tight / np.maximum(support.residual_px, tight)) ** 2
    confidence = samples.sums(lengths * support.certainty) / total * lying
    columns = zip(seeing, support.supported_lengths, support.residual_px, confidence, strict=True)
    return [Evidence(int(views), *map(float, rest)) for views, *rest in columns]


def steadiness_of_edges(matching: EdgelMatching, support: Support) -> np.ndarray:
    """(E,) share of the edgels about each edge that lie on it, of those that no other edge owns.

    matching: EdgelMatching. support: Support of the edges.
    """
    samples, tight = support.samples, max(TIGHT_PX, TIGHT_NOISES * support.noise_px)
    about = min(ABOUT * tight, MOST_ABOUT_PX)
    found = EdgelsAbout.of(matching, samples.points, samples.directions, about)
    at, view = np.nonzero(found.there)
    owners = support.claims.owners[found.edgels[at, view]]
    mine = (owners < 0) | (owners == samples.edges[at])
    on = mine & found.within(tight)[at, view]
    numbers, count = samples.edges[at], len(samples.starts) - 1
    return steadiness(*(np.bincount(numbers[some], minlength=count) for some in (on, mine)))


def support_share(matching: EdgelMatching, support: Support) -> np.ndarray:
    """(E,) number of views that support each edge, each counted by its weight, of those that have it in their image."""
    samples = support.samples
    inside = EdgelsAbout.of(matching, samples.points, samples.directions, MATCH_PX).inside.sum(axis=1)
    return samples.sums(support.views) / np.maximum(samples.sums(inside), 1)


def claims_of(matching: EdgelMatching, shapes: Sequence[Shape]) -> Claims:
    """The Claims of shapes, for `support_along`. matching: EdgelMatching."""
    return support_of(matching, shapes).claims


def support_along(
    matching: EdgelMatching, shape: Shape, parameters: np.ndarray, claims: Claims | None = None, own: int = -1
) -> np.ndarray:
    """How many views support places on a shape or beyond its ends, each counted by its weight, see `Support`. (n,)

    parameters: (n,) of the places. claims: Claims of all edges, whose edgels do not count unless they are this shape's
    or farther from all others than from it. own: the index of this shape among those, if it is one of them.
    """
    return support_of_places(matching, [(shape, parameters)], claims, [own])[0]


def support_of_places(
    matching: EdgelMatching,
    places: Sequence[tuple[Shape, np.ndarray]],
    claims: Claims | None = None,
    owns: Sequence[int] = (),
) -> list[np.ndarray]:
    """`support_along` for many shapes at once. places: [(shape, parameters)]. owns: the index of each of the shapes.

    A kernel takes as long to start as to look up some hundred places.
    """
    if not places:
        return []
    points = np.concatenate([shape.at(parameters) for shape, parameters in places])
    directions = np.concatenate([shape.tangents(parameters) for shape, parameters in places])
    counts = np.array([len(parameters) for _, parameters in places])
    found = EdgelsAbout.of(matching, points, directions, MATCH_PX)
    edgels = found.edgels
    if claims is not None:
        at, view = np.nonzero(found.there)
        others = claims.beside(np.repeat(owns, counts)[at], edgels[at, view])
        lost = np.abs(found.residuals[at, view]) + TIE_PX >= others
        edgels[at[lost], view[lost]] = -1
    views = _weights(matching, edgels, found.residuals).sum(axis=1)
    return np.split(views, np.cumsum(counts)[:-1])


def chance_weight(matching: EdgelMatching) -> float:
    """Sum of the weights, over all views, of the edgels that a random place with a random direction has.

    From how densely the edgels fill the part of each image where there are any, a pixel of an edge each.
    """
    total = 0.0
    width = 0.5 * np.pi * matching.scale_px  # integral of Geman and McClure's weight over the distance
    turned = 2 * np.arcsin(MOST_SINE) / np.pi  # share of the directions that an edgel agrees with
    for strengths, area in matching.densities:
        total += float(strengths * width * turned / area)
    return total


def _weights(matching: EdgelMatching, edgels: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """(n, V) strength times closeness of matched edgels, 0 where there is none."""
    weights, at = np.zeros(edgels.shape, np.float32), edgels >= 0
    squared = (residuals[at] / matching.scale_px) ** 2
    weights[at] = geman_mcclure(squared, matching.edgels.strengths[edgels[at]])
    return weights
