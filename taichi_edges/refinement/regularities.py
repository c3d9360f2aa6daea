"""What edges of a designed thing are to each other: parallel, perpendicular, of equal radius, coaxial, coplanar.

A relation is a hypothesis with fewer unknowns than the edges have without it. Imposing it raises the sum of squared
residuals, in units of their standard deviation; how much is known beforehand from the equations of the adjustment:
d^T S^-1 d for a relation that is off by d, with the covariance S. By BIC it is there if that is at most ln n for every
unknown that it takes away, n observations. So a wedge of 2 degrees stays one where the images tell it from none, and
what has been imposed counts when the next relation is judged.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.evidence.edge_support import SPACING_PX, Support, support_of
from taichi_edges.fitting.arcs import cross
from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline, middles_of
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.refinement.adjustment import (
    CORRELATED_PX,
    LEAST_NOISE_PX,
    Constraint,
    Layout,
    Problem,
    adjusted,
    constrained,
    contacts,
    image_equations,
    neighbors_of,
    smooth_joints,
)
from taichi_edges.refinement.charts import STEP, derivatives

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching

KINDS = ("parallel", "perpendicular", "equal_radius", "coaxial", "coplanar")
MOST_TURN = np.radians(2.0)  # what is farther from parallel or perpendicular is no candidate; by chance 1 pair in 30 is
MOST_OFF_PX, MOST_RATIO = 3.0, 0.05  # distances and radii, likewise
DEVIATION = 1e-4  # of what is imposed, radians or unit-cube units, until it is made exact
IMPLIED = 1e-6  # standard deviation of what other relations imply
LEAST_TOLD = 1e-12  # of what is told most about an unknown: what nothing is told about stays a number
CLOSE = 2e-3  # how far it may be off as these are linear
RADIUS_PX = 1.0  # of the edgels from which covariances come
CHECKS = 4  # adjustments after which relations that the images contradict have been given up
DIRECTION, PLACE, RADIUS = slice(0, 3), slice(3, 6), 6


def features(shape: Shape) -> np.ndarray:
    """(7,) what relations are about: direction of a line or normal of a plane, middle or centre, radius (0: none)."""
    if isinstance(shape, Line):
        return np.concatenate([shape.tangents(0.5), shape.at(0.5), [0.0]])
    assert isinstance(shape, EllipticArc)  # a spline has no relations
    radius = shape.radii.mean() if shape.circular else 0.0
    normal = cross(*shape.axes)
    return np.concatenate([normal / np.sqrt(normal @ normal), shape.centre, [radius]])


@dataclass(frozen=True)
class Relation:
    """kind: one of KINDS. edges: indices, each once. values: function of their features -> (m,), 0 where it holds."""

    kind: str
    edges: tuple[int, ...]
    values: Callable[..., np.ndarray]

    def constraint(self) -> Constraint:
        """The Constraint that makes it hold."""
        return Constraint(self.edges, self.values, DEVIATION, hard=True, about=features)


def regularised(wireframe: Wireframe, matching: "EdgelMatching") -> tuple[Wireframe, dict[str, tuple[int, int]]]:
    """An adjusted Wireframe with the relations that its edges have as far as the images can tell.

    matching: EdgelMatching. Returns the Wireframe, and {kind: (number found, number of these that were imposed)}; the
    others follow from those.
    """
    found, imposed = found_relations(wireframe, matching)
    before, relations, regular = support_of(matching, wireframe.shapes, RADIUS_PX), imposed, wireframe
    for _ in range(CHECKS):
        if not relations:
            break
        regular = adjusted(
            wireframe, matching, [relation.constraint() for relation in relations], radii=(RADIUS_PX,) * 2
        )
        risen = _risen(before, support_of(matching, regular.shapes, RADIUS_PX), relations)
        if not risen:
            break
        relations = [relation for relation in relations if not risen & set(relation.edges)]
        regular = wireframe
    else:
        relations = []
    lost = Counter(relation.kind for relation in imposed) - Counter(relation.kind for relation in relations)
    kept = Counter(relation.kind for relation in relations)
    return regular, {kind: (found[kind] - lost[kind], kept[kind]) for kind in KINDS}


def found_relations(wireframe: Wireframe, matching: "EdgelMatching") -> tuple[Counter[str], list[Relation]]:
    """Counter of the relations found by kind, and the list of those that the others do not imply."""
    counts: Counter[str] = Counter()
    imposed = []
    judge, pixels = Judge.of(wireframe, matching), matching.pixel_at(middles_of(wireframe.shapes))
    for kind in KINDS:
        candidates = [(relation, judge.linear(relation)) for relation in RELATIONS[kind](wireframe, pixels)]
        for relation, linear in sorted(candidates, key=lambda pair: judge.rise(pair[1])):
            if judge.rise(linear) <= judge.allowed:
                counts[kind] += 1
                if judge.impose(linear):
                    imposed.append(relation)
    return counts, imposed


@dataclass(frozen=True)
class Linear:
    """values: (m,) of a relation. slopes: (m, k) their derivatives by (k,) `unknowns`, each once."""

    values: np.ndarray
    slopes: np.ndarray
    unknowns: np.ndarray


@dataclass(frozen=True)
class PrincipalAxes:
    """The values of a Linear relation on the axes (m, m) on which their errors are independent.

    off: (m,) values there. variances: (m,) and free: (m,) bool, whether they are more than 0: others are implied.
    reach: (size, m) covariances of all unknowns with the values.
    """

    off: np.ndarray
    variances: np.ndarray
    free: np.ndarray
    axes: np.ndarray
    reach: np.ndarray


class Judge:
    """What is known of the edges: linear, with a covariance, and with what has been imposed so far.

    allowed: rise of the sum of squares for each unknown less, ln n.
    """

    @staticmethod
    def of(wireframe: Wireframe, matching: "EdgelMatching") -> "Judge":
        """From the equations of an adjusted Wireframe."""
        layout, pixels = Layout.of(wireframe), matching.pixel_at(middles_of(wireframe.shapes))
        problem = Problem(wireframe, layout, pixels)
        image = image_equations(problem, wireframe, matching, RADIUS_PX)
        joints = [*smooth_joints(wireframe), *contacts(wireframe, pixels)]
        matrix = (image.matrix() + constrained(layout, wireframe, joints).matrix()).toarray()
        told = np.diag(matrix)
        scale = 1.0 / np.sqrt(np.maximum(told, LEAST_TOLD * told.max(initial=1e-300)))
        covariance = (
            np.linalg.inv(matrix * scale * scale[:, None] + 1e-12 * np.eye(len(scale))) * scale * scale[:, None]
        )
        support = support_of(matching, wireframe.shapes, RADIUS_PX)
        observations = (support.edgels >= 0).sum() * SPACING_PX / CORRELATED_PX
        return Judge(wireframe, layout, covariance, np.log(max(observations, 2.0)))

    def __init__(self, wireframe: Wireframe, layout: Layout, covariance: np.ndarray, allowed: float) -> None:
        self.columns, self.covariance, self.allowed = layout.columns, covariance, allowed
        self.shift = np.zeros(layout.size)
        self.features: dict[int, np.ndarray] = {}
        self.slopes: dict[int, np.ndarray] = {}
        for number, shape in enumerate(wireframe.shapes):
            if not isinstance(shape, Spline):
                self.features[number] = features(shape)
                self.slopes[number] = derivatives(neighbors_of(wireframe, number), features)

    def linear(self, relation: Relation) -> Linear:
        """A relation as a Linear one, at the wireframe as it was given."""
        given = np.concatenate([self.features[number] for number in relation.edges])
        pieces = len(relation.edges)

        def values(step: np.ndarray | float) -> np.ndarray:
            return relation.values(*(given + step).reshape(pieces, -1))

        by_features = np.stack([(values(s) - values(-s)) / (2 * STEP) for s in STEP * np.eye(len(given))], axis=1)
        blocks = zip(np.split(by_features, pieces, axis=1), relation.edges, strict=True)
        slopes = np.concatenate([block @ self.slopes[number] for block, number in blocks], axis=1)
        unknowns = np.concatenate([self.columns[number] for number in relation.edges])
        each = np.unique(unknowns)  # edges that share a vertex share unknowns
        summed = np.zeros((len(slopes), len(each)))
        np.add.at(summed.T, np.searchsorted(each, unknowns), slopes.T)
        return Linear(values(0.0), summed, each)

    def rise(self, linear: Linear) -> float:
        """Rise of the sum of squares for each unknown that a relation takes away; 0 where it is implied."""
        if not (np.isfinite(linear.slopes).all() and np.isfinite(linear.values).all()):
            return np.inf  # a shape that has degenerated has no relations
        found = self._axes(linear)
        off, free = found.off, found.free
        if (np.abs(off[~free]) > CLOSE).any():
            return np.inf
        return float((off[free] ** 2 / found.variances[free]).sum() / max(free.sum(), 1))

    def impose(self, linear: Linear) -> bool:
        """Take a relation for granted. Returns whether it was not implied already."""
        found = self._axes(linear)
        free, axes = found.free, found.axes[:, found.free]
        gain = found.reach @ (axes / found.variances[free])
        self.shift -= gain @ found.off[free]
        self.covariance -= gain @ (found.reach @ axes).T
        return bool(free.any())

    def _axes(self, linear: Linear) -> PrincipalAxes:
        """The PrincipalAxes of a Linear relation, by what is known so far."""
        reach = self.covariance[:, linear.unknowns] @ linear.slopes.T
        variances, axes = np.linalg.eigh(linear.slopes @ reach[linear.unknowns])
        off = axes.T @ (linear.values + linear.slopes @ self.shift[linear.unknowns])
        return PrincipalAxes(off, variances, variances > IMPLIED**2, axes, reach)


def _risen(before: Support, after: Support, relations: Sequence[Relation]) -> set[int]:
    """Set of the edges whose own residuals have risen by more than their relations are worth."""
    noise = max(before.noise_px, LEAST_NOISE_PX)
    observations = before.samples.sums((before.edgels >= 0).sum(axis=1)) * SPACING_PX / CORRELATED_PX
    rise = observations * (after.residual_px**2 - before.residual_px**2) / noise**2
    related = Counter(number for relation in relations for number in relation.edges)
    allowed = 2.0 * np.log(max(observations.sum(), 2.0))
    return {number for number in related if rise[number] > allowed * max(related[number], 1)}


def _of_kind(wireframe: Wireframe, *kinds: str) -> list[tuple[int, np.ndarray]]:
    """[(index, features)] of the edges of some kinds."""
    return [(number, features(shape)) for number, shape in enumerate(wireframe.shapes) if shape.kind in kinds]


LINES, ROUND, FLAT = ("line",), ("arc", "circle"), ("arc", "circle", "elliptic_arc", "ellipse")


def _parallel(wireframe: Wireframe, pixels: np.ndarray) -> Iterator[Relation]:
    """Directions of lines, and normals of arcs."""
    for (one, a), (other, b) in combinations(_of_kind(wireframe, *LINES, *FLAT), 2):
        if np.linalg.norm(cross(a[DIRECTION], b[DIRECTION])) < np.sin(MOST_TURN):
            yield Relation("parallel", (one, other), partial(_cross, _sides(a[DIRECTION])))


def _perpendicular(wireframe: Wireframe, pixels: np.ndarray) -> Iterator[Relation]:
    """Likewise."""
    for (one, a), (other, b) in combinations(_of_kind(wireframe, *LINES, *FLAT), 2):
        if abs(a[DIRECTION] @ b[DIRECTION]) < np.sin(MOST_TURN):
            yield Relation("perpendicular", (one, other), _cosine)


def _equal_radius(wireframe: Wireframe, pixels: np.ndarray) -> Iterator[Relation]:
    """Arcs and circles."""
    for (one, a), (other, b) in combinations(_of_kind(wireframe, *ROUND), 2):
        if abs(a[RADIUS] - b[RADIUS]) < min(MOST_OFF_PX * pixels[[one, other]].mean(), MOST_RATIO * a[RADIUS]):
            yield Relation("equal_radius", (one, other), _radii)


def _coaxial(wireframe: Wireframe, pixels: np.ndarray) -> Iterator[Relation]:
    """Arcs and circles: the centre of one on the axis of the other."""
    for (one, a), (other, b) in combinations(_of_kind(wireframe, *ROUND), 2):
        axis = a[DIRECTION]
        parallel = np.linalg.norm(cross(axis, b[DIRECTION])) < np.sin(MOST_TURN)
        if parallel and np.linalg.norm(cross(axis, b[PLACE] - a[PLACE])) < MOST_OFF_PX * pixels[[one, other]].mean():
            yield Relation("coaxial", (one, other), partial(_off_axis, _sides(axis)))


def _coplanar(wireframe: Wireframe, pixels: np.ndarray) -> Iterator[Relation]:
    """Lines and arcs in the plane of an arc, or in that of two lines that share a vertex."""
    planes: list[tuple[np.ndarray, np.ndarray, float]] = []
    edges = dict(_of_kind(wireframe, *LINES, *FLAT))
    for members in _plane_spans(wireframe, edges):
        normal, place = _plane(*(edges[number] for number in members))
        pixel = float(pixels[list(members)].mean())
        if any(_in_plane(normal, place, other, where, 0.5 * (pixel + its)) for other, where, its in planes):
            continue
        planes.append((normal, place, pixel))
        for number, feature in edges.items():
            flat = wireframe.shapes[number].kind != "line"
            if number not in members and _lies_in(normal, place, feature, flat, 0.5 * (pixel + pixels[number])):
                sides = _sides(normal)
                yield Relation("coplanar", (*members, number), partial(_off_plane, sides if flat else None))


def _plane_spans(wireframe: Wireframe, edges: dict[int, np.ndarray]) -> Iterator[tuple[int, ...]]:
    """Tuples of edges that span a plane: arcs and circles, then pairs of lines that share a vertex."""
    yield from ((number,) for number in edges if wireframe.shapes[number].kind != "line")
    for one, other in combinations([number for number in edges if wireframe.shapes[number].kind == "line"], 2):
        meet = set(wireframe.edges[one].vertices) & set(wireframe.edges[other].vertices)
        if meet and np.linalg.norm(cross(edges[one][DIRECTION], edges[other][DIRECTION])) > 0.5:
            yield one, other


def _plane(*span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal and a place of the plane of an arc, or of two lines."""
    if len(span) == 1:
        return span[0][DIRECTION], span[0][PLACE]
    normal = cross(span[0][DIRECTION], span[1][DIRECTION])
    return normal / np.linalg.norm(normal), span[0][PLACE]


def _in_plane(normal: np.ndarray, place: np.ndarray, other: np.ndarray, where: np.ndarray, pixel: float) -> bool:
    """Whether two planes are one, as far as candidates go."""
    turned = np.linalg.norm(cross(normal, other)) < np.sin(MOST_TURN)
    return turned and abs((place - where) @ other) < MOST_OFF_PX * pixel


def _lies_in(normal: np.ndarray, place: np.ndarray, feature: np.ndarray, flat: bool, pixel: float) -> bool:
    """Whether an edge is in a plane, as far as candidates go."""
    turn = np.linalg.norm(cross(normal, feature[DIRECTION])) if flat else abs(normal @ feature[DIRECTION])
    return turn < np.sin(MOST_TURN) and abs(normal @ (feature[PLACE] - place)) < MOST_OFF_PX * pixel


def _sides(direction: np.ndarray) -> np.ndarray:
    """(2, 3) unit vectors across a direction."""
    return np.linalg.svd(direction[None])[2][1:]


def _cross(sides: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return sides @ cross(a[DIRECTION], b[DIRECTION])


def _cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[DIRECTION] @ b[DIRECTION]])


def _radii(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[RADIUS] - b[RADIUS]])


def _off_axis(sides: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return sides @ cross(a[DIRECTION], b[PLACE] - a[PLACE])


def _off_plane(sides: np.ndarray | None, *span: np.ndarray) -> np.ndarray:
    """The last of the features against the plane of the others. sides: across its normal, None for a line."""
    normal, place = _plane(*span[:-1])
    last = span[-1]
    turn = [normal @ last[DIRECTION]] if sides is None else sides @ cross(normal, last[DIRECTION])
    return np.array([*turn, normal @ (last[PLACE] - place)])


RELATIONS = {
    "parallel": _parallel,
    "perpendicular": _perpendicular,
    "equal_radius": _equal_radius,
    "coaxial": _coaxial,
    "coplanar": _coplanar,
}
