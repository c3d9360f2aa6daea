"""All edges of a wireframe moved at once to where the edgels of all views say they are.

Least squares over everything that has a say, each in units of its own standard deviation:

edgels      the distance, px, of an edge from each of its edgels. Errors along an edge are alike over CORRELATED_PX, and
            so many pixels count as one observation. Geman and McClure's weights leave out what is not the edge's.
the start   an edge was known to START_PX before. Where the edgels say nothing it stays there, and keeps its ends.
free ends   where no other edge is met, an end does not move along its edge, of which edgels say nothing.
joints      where two edges, at least one of them curved, run on into each other, their tangents agree.
contacts    a vertex lies on the edge it touches.
relations   what else edges are to each other, see `regularities`.

Unknowns are the vertices, which edges share, and what each shape has of its own (`charts`). Edgels near corners are
off, so the ends of an edge are where it meets others and not where its edgels end.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import methodcaller
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags, identity
from scipy.sparse.linalg import spsolve

from taichi_edges.arrays.robust import widening
from taichi_edges.evidence.edge_support import SPACING_PX, EdgeSamples, support_of
from taichi_edges.geometry.shapes import Shape, middles_of
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.refinement.charts import derivatives, moved, nearest_parameters, neighbors, own_unknowns

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.plane_equations import PlaneEquations

RADII_PX = (3.0, 2.0, 1.5, 1.0, 1.0)  # of the edgels that are looked at, round by round
CORRELATED_PX = 40.0  # along an edge: pixels that count as one observation; 20 to 55 in images and in learned maps
LEAST_NOISE_PX = 0.05  # of the edgels; the best detector's
TIGHT_RADIUS_PX, SCALE_NOISES = 1.0, 3.0  # so near to the edgels their noise says which of them are the edge's
START_PX = 1.0  # standard deviation of the edges that are given
END_PX, MOST_ENDS = 3.0, 0.25  # edgels so near to an end say nothing; at most so much of the length at either end
PIN_PX = 0.01  # standard deviation of a free end along its edge
CONTACT_PX = 0.05  # and of a vertex from the edge it touches
SMOOTH = np.radians(10.0)  # tangents of curves that differ by less run on into each other
SMOOTH_DEVIATION = np.radians(1.0)  # of these; where they disagree by several, it is a corner after all
MOST_STRETCH = 1.6  # an edge that becomes longer or shorter by such a factor has flipped
MOST_PX = 8.0  # an edge that moves farther than this is lost
PLACES = np.linspace(0.0, 1.0, 9)  # parameters at which that is measured
POLISHING, HARD = 4, 1e8  # rounds at the end in which contacts and relations become exact, and their weight there
COLLAPSED = 0.01  # of the length of an edge: ends nearer to each other are one
RIDGE = 1e-9  # relative; keeps what nothing speaks about where it is


@dataclass(frozen=True)
class Constraint:
    """Something that edges are to each other. hard: it is exact in the end.

    edges: indices of these edges, each once. values: function of their shapes, in this order -> (m,), 0 where it holds.
    deviation: standard deviation of the values. about: function of a shape; where there is one, `values` is of what it
    gives, which is found but once for all constraints.
    """

    edges: tuple[int, ...]
    values: Callable[..., np.ndarray]
    deviation: float
    hard: bool = False
    about: Callable[[Shape], np.ndarray] | None = None


@dataclass(frozen=True)
class Layout:
    """Where the unknowns of each edge stand among all: first the vertices, three each, then what each edge has alone.

    columns: one int array for each edge, the ends first. size: number of unknowns.
    """

    columns: tuple[np.ndarray, ...]
    size: int

    @staticmethod
    def of(wireframe: Wireframe) -> "Layout":
        """The Layout of a Wireframe."""
        columns, size = [], 3 * len(wireframe.vertices)
        for edge in wireframe.edges:
            ends = [3 * vertex + axis for vertex in edge.vertices for axis in range(3)]
            own = own_unknowns(edge.shape)
            columns.append(np.array([*ends, *range(size, size + own)], dtype=np.int64))
            size += own
        return Layout(tuple(columns), size)

    def moved(self, wireframe: Wireframe, step: np.ndarray) -> Wireframe:
        """The Wireframe after a (size,) step."""
        vertices = wireframe.vertices + step[: 3 * len(wireframe.vertices)].reshape(-1, 3)
        edges = []
        for edge, columns in zip(wireframe.edges, self.columns, strict=True):
            own = step[columns[3 * len(edge.vertices) :]]
            ends = vertices[list(edge.vertices)] if edge.vertices else None
            edges.append(replace(edge, shape=moved(edge.shape, ends, own)))
        return replace(wireframe, vertices=vertices, edges=tuple(edges))


class Equations:
    """Normal equations, block by block: the sum of weight |values + derivatives step|^2 is to be least."""

    def __init__(self, size: int) -> None:
        self.size, self.target = size, np.zeros(size)
        self.rows: list[np.ndarray] = []
        self.columns: list[np.ndarray] = []
        self.entries: list[np.ndarray] = []

    def add_block(self, unknowns: np.ndarray, matrix: np.ndarray, gradient: np.ndarray) -> None:
        """A (k, k) matrix and (k,) gradient for (k,) unknowns, of which some may be the same."""
        rows, columns = np.meshgrid(unknowns, unknowns, indexing="ij")
        self.rows.append(rows.ravel())
        self.columns.append(columns.ravel())
        self.entries.append(matrix.ravel())
        np.add.at(self.target, unknowns, gradient)

    def add(self, unknowns: np.ndarray, values: np.ndarray, slopes: np.ndarray, weight: float) -> None:
        """Values (m,) with their derivatives (m, k) by (k,) unknowns."""
        self.add_block(unknowns, weight * slopes.T @ slopes, weight * slopes.T @ values)

    def matrix(self) -> csc_matrix:
        """Sparse (size, size)."""
        if not self.rows:
            return coo_matrix((self.size, self.size)).tocsc()
        entries, rows, columns = map(np.concatenate, (self.entries, self.rows, self.columns))
        return coo_matrix((entries, (rows, columns)), shape=(self.size, self.size)).tocsc()


def solve(matrix: csc_matrix, gradient: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The (size,) step to the minimum; 0 for the unknowns that are not free, (size,) bool."""
    step, unknowns = np.zeros(len(gradient)), np.flatnonzero(free)
    matrix = matrix[unknowns][:, unknowns]
    scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-12 * matrix.diagonal().max(initial=1e-300)))
    scaled = diags(scale) @ matrix @ diags(scale) + RIDGE * identity(len(unknowns))
    found = spsolve(scaled.tocsc(), -gradient[unknowns] * scale, permc_spec="MMD_AT_PLUS_A")
    step[unknowns] = found * scale
    return step


@dataclass(frozen=True)
class Problem:
    """What stays the same during an adjustment.

    start: the Wireframe it begins with. layout: of its unknowns. pixels: (E,) size of one at each edge, unit-cube
    units. relations: Constraints.
    """

    start: Wireframe
    layout: Layout
    pixels: np.ndarray
    relations: tuple[Constraint, ...] = ()


def adjusted(
    wireframe: Wireframe,
    matching: "EdgelMatching",
    relations: Iterable[Constraint] = (),
    radii: Sequence[float] = RADII_PX,
) -> Wireframe:
    """The Wireframe whose edges agree best with the edgels of all views, without evidence (see `edge_support`).

    matching: EdgelMatching. relations: Constraints. radii: px, one for each round.
    """
    if not len(wireframe):
        return wireframe
    wireframe = replace(wireframe, edges=tuple(replace(edge, evidence=None) for edge in wireframe.edges))
    pixels = matching.pixel_at(middles_of(wireframe.shapes))
    problem = Problem(wireframe, Layout.of(wireframe), pixels, tuple(relations))
    for radius in radii:
        image = image_equations(problem, wireframe, matching, radius)
        wireframe = _stepped(problem, wireframe, image)
    return touching(_polished(problem, wireframe, image.matrix()))


def image_equations(problem: Problem, wireframe: Wireframe, matching: "EdgelMatching", radius: float) -> Equations:
    """Equations of the edgels, the start and the free ends."""
    support = support_of(matching, wireframe.shapes, radius)
    samples = support.samples
    noise = max(support.noise_px, LEAST_NOISE_PX)
    widest = matching.scale_px
    scale = widest if radius > TIGHT_RADIUS_PX else min(widest, SCALE_NOISES * noise)
    counted = _counted(wireframe, samples, problem.pixels) * support.certainty  # what agrees by chance says nothing
    said = matching.equations_of(samples.points, support.edgels, scale)
    said = said.weighed(counted * SPACING_PX / CORRELATED_PX / noise**2)
    planes, pulls = _across(said, samples.directions)
    equations = Equations(problem.layout.size)
    for number, unknowns in enumerate(problem.layout.columns):
        part = samples.of(number)
        parameters = samples.parameters[part]
        slopes = derivatives(neighbors_of(wireframe, number), methodcaller("at", parameters))  # (n, 3, k)
        before = samples.points[part] - problem.start.edges[number].shape.at(parameters)
        weight = 1.0 / (len(before) * (START_PX * problem.pixels[number]) ** 2)
        _add_places(equations, unknowns, slopes, planes[part] + weight * np.eye(3), pulls[part] + weight * before)
    _pin_free_ends(equations, wireframe, problem.start, PIN_PX * problem.pixels)
    return equations


def _counted(wireframe: Wireframe, samples: EdgeSamples, pixels: np.ndarray) -> np.ndarray:
    """(n,) float: 0 for samples too near to an end of their edge, or to a vertex that touches it; 1 otherwise."""
    counted = np.ones(len(samples))
    for number, edge in enumerate(wireframe.edges):
        part = samples.of(number)
        if not edge.shape.closed:
            margin = min(END_PX * pixels[number] / max(edge.shape.length, 1e-300), MOST_ENDS)
            position = (np.arange(part.stop - part.start) + 0.5) / (part.stop - part.start)
            counted[part] = (position >= margin) & (position <= 1 - margin)
    for vertex, number in wireframe.contacts:
        part = samples.of(number)
        away = np.linalg.norm(samples.points[part] - wireframe.vertices[vertex], axis=1)
        counted[part] *= away > END_PX * pixels[number]
    return counted


def _across(said: "PlaneEquations", directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3, 3) matrices and (n, 3) gradients of PlaneEquations; what they say along the edge is left out."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return across @ said.matrices @ across, (across @ said.gradients[:, :, None])[:, :, 0]


def _add_places(
    equations: Equations, unknowns: np.ndarray, slopes: np.ndarray, matrices: np.ndarray, gradients: np.ndarray
) -> None:
    """Add what is said about (n,) places: matrices (n, 3, 3), gradients (n, 3); slopes (n, 3, k) by the unknowns."""
    flat = slopes.reshape(-1, len(unknowns))
    weighted = (matrices @ slopes).reshape(-1, len(unknowns))
    equations.add_block(unknowns, flat.T @ weighted, flat.T @ gradients.ravel())


def _pin_free_ends(equations: Equations, wireframe: Wireframe, start: Wireframe, deviations: np.ndarray) -> None:
    """A vertex in which a single edge ends, and which touches no other, does not move along that edge.

    deviations: (E,).
    """
    degrees = wireframe.degrees
    for edge, deviation in zip(wireframe.edges, deviations.tolist(), strict=True):
        for end, vertex in enumerate(edge.vertices):
            if degrees[vertex] == 1:
                along = edge.shape.tangents(np.array([float(end)]))
                unknowns = 3 * vertex + np.arange(3)
                gone = along @ (wireframe.vertices[vertex] - start.vertices[vertex])
                equations.add(unknowns, gone, along, 1.0 / deviation**2)


def _ends(wireframe: Wireframe, number: int) -> np.ndarray | None:
    """(2, 3) vertices of an edge, None for a closed one."""
    vertices = wireframe.edges[number].vertices
    return wireframe.vertices[list(vertices)] if vertices else None


def neighbors_of(wireframe: Wireframe, number: int) -> list[tuple[Shape, Shape]]:
    """See `charts.neighbors`."""
    return neighbors(wireframe.edges[number].shape, _ends(wireframe, number))


def _stepped(problem: Problem, wireframe: Wireframe, image: Equations) -> Wireframe:
    """The Wireframe after one step; edges that would flip or be lost stay where they are, and so do their ends.

    image: Equations at the Wireframe.
    """
    layout, start = problem.layout, problem.start.shapes
    constraints = [*smooth_joints(wireframe), *contacts(wireframe, problem.pixels), *problem.relations]
    joined = constrained(layout, wireframe, constraints)
    matrix, target = image.matrix() + joined.matrix(), image.target + joined.target
    free = np.ones(layout.size, bool)
    while free.any():
        there = layout.moved(wireframe, solve(matrix, target, free))
        pairs = enumerate(zip(start, there.shapes, strict=True))
        lost = [number for number, pair in pairs if _is_lost(*pair, MOST_PX * problem.pixels[number])]
        lost = [number for number in lost if free[layout.columns[number]].any()]
        if not lost:
            return there
        for number in lost:
            free[layout.columns[number]] = False
    return wireframe


def _is_lost(before: Shape, after: Shape, most: float) -> bool:
    """Whether an edge has changed its length as only a flip does, or is farther away than `most`."""
    stretch = max(after.length, 1e-300) / max(before.length, 1e-300)
    moved_by = np.linalg.norm(after.at(PLACES) - before.at(PLACES), axis=1).max()
    return not (1.0 / MOST_STRETCH <= stretch <= MOST_STRETCH and moved_by <= most)


def _polished(problem: Problem, wireframe: Wireframe, matrix: csc_matrix) -> Wireframe:
    """The Wireframe moved to where the hard constraints hold exactly, by as little as `matrix` (of the edgels) says."""
    for _ in range(POLISHING):
        constraints = [c for c in (*contacts(wireframe, problem.pixels), *problem.relations) if c.hard]
        if not constraints:
            break
        joined = constrained(problem.layout, wireframe, constraints, HARD)
        step = solve(matrix + joined.matrix(), joined.target, np.ones(problem.layout.size, bool))
        wireframe = problem.layout.moved(wireframe, step)
    return wireframe


def touching(wireframe: Wireframe) -> Wireframe:
    """The Wireframe with the vertices that touch edges exactly on these."""
    for _ in range(POLISHING if len(wireframe.contacts) else 0):
        vertices = wireframe.vertices.copy()
        for vertex, number in wireframe.contacts.tolist():
            touched = wireframe.edges[number].shape
            vertices[vertex] = touched.at(nearest_parameters(touched, vertices[vertex][None]))[0]
        for edge in wireframe.edges:  # both ends at one place of another edge: nothing would be left of it
            ends = list(edge.vertices)
            if len(set(ends)) == 2 and np.linalg.norm(np.subtract(*vertices[ends])) < COLLAPSED * edge.shape.length:
                vertices[ends] = wireframe.vertices[ends]
        wireframe = with_vertices(wireframe, vertices)
    return wireframe


def with_vertices(wireframe: Wireframe, vertices: np.ndarray) -> Wireframe:
    """The Wireframe with its vertices moved to (V, 3), and its edges with them."""
    edges = []
    for edge in wireframe.edges:
        ends = list(edge.vertices)
        if ends and (vertices[ends] != wireframe.vertices[ends]).any():
            edge = replace(edge, shape=moved(edge.shape, vertices[ends], np.zeros(own_unknowns(edge.shape))))
        edges.append(edge)
    return replace(wireframe, vertices=vertices, edges=tuple(edges))


def constrained(
    layout: Layout, wireframe: Wireframe, constraints: Iterable[Constraint], hard: float | None = None
) -> Equations:
    """Equations of the constraints at a Wireframe. hard: by how much more they weigh than their deviations say."""
    equations = Equations(layout.size)
    described: dict[tuple[int, Any], tuple[Any, list[tuple[Any, Any]]]] = {}
    for constraint in constraints:
        for number in constraint.edges:
            if (number, constraint.about) not in described:
                described[number, constraint.about] = _described(wireframe, number, constraint.about)
        here, nearby = zip(*(described[number, constraint.about] for number in constraint.edges), strict=True)
        slopes = []
        for place, pairs in enumerate(nearby):
            slopes.append(derivatives(pairs, partial(_replaced, constraint.values, here, place)))
        unknowns = np.concatenate([layout.columns[number] for number in constraint.edges])
        weight = 1.0 / constraint.deviation**2 * (hard or 1.0)
        equations.add(unknowns, constraint.values(*here), np.concatenate(slopes, axis=-1), weight)
    return equations


def _described(
    wireframe: Wireframe, number: int, about: Callable[[Shape], np.ndarray] | None
) -> tuple[Any, list[tuple[Any, Any]]]:
    """An edge's shape and its neighbors, or what `about` gives of each."""
    shape, pairs = wireframe.edges[number].shape, neighbors_of(wireframe, number)
    return (about(shape), [(about(one), about(other)) for one, other in pairs]) if about else (shape, pairs)


def _replaced(values: Callable[..., np.ndarray], arguments: Sequence[Any], place: int, argument: Any) -> np.ndarray:
    """Values of some arguments, of which one has been replaced."""
    return values(*arguments[:place], argument, *arguments[place + 1 :])


def smooth_joints(wireframe: Wireframe) -> Iterator[Constraint]:
    """Constraints of the tangents of two edges, at least one of them curved, that alone meet in a vertex, smoothly."""
    meeting: dict[int, list[tuple[int, int]]] = {}
    for number, edge in enumerate(wireframe.edges):
        for end, vertex in enumerate(edge.vertices):
            meeting.setdefault(vertex, []).append((number, end))
    degrees = wireframe.degrees
    for vertex, pair in meeting.items():
        if len(pair) != 2 or degrees[vertex] != 2 or pair[0][0] == pair[1][0]:
            continue
        (one, end), (other, other_end) = pair
        shapes = wireframe.edges[one].shape, wireframe.edges[other].shape
        values = _turn(end, other_end)
        off = float(np.linalg.norm(values(*shapes)))
        if {shape.kind for shape in shapes} != {"line"} and off < SMOOTH:
            deviation = SMOOTH_DEVIATION * widening((off / (3 * SMOOTH_DEVIATION)) ** 2)
            yield Constraint((one, other), values, deviation)


def _turn(end: int, other_end: int) -> Callable[[Shape, Shape], np.ndarray]:
    """Function of two shapes: difference of the tangents where one ends and the other goes on."""
    sign = 1.0 if end != other_end else -1.0

    def values(shape: Shape, other: Shape) -> np.ndarray:
        ahead, on = shape.tangents(np.array([float(end)]))[0], other.tangents(np.array([float(other_end)]))[0]
        return ahead - sign * on

    return values


def contacts(wireframe: Wireframe, pixels: np.ndarray) -> Iterator[Constraint]:
    """Constraints of the vertices that touch edges. pixels: (E,) size of one at each edge, unit-cube units."""
    ending: dict[int, tuple[int, int]] = {}
    for number, edge in enumerate(wireframe.edges):
        for end, vertex in enumerate(edge.vertices):
            ending.setdefault(vertex, (number, end))
    for vertex, number in wireframe.contacts.tolist():
        if vertex in ending and ending[vertex][0] != number:
            touched, place = wireframe.edges[number].shape, wireframe.vertices[vertex]
            values = _offset(touched, ending[vertex][1], nearest_parameters(touched, place[None]))
            both = (ending[vertex][0], number)
            yield Constraint(both, values, CONTACT_PX * float(pixels[list(both)].mean()), hard=True)


def _offset(touched: Shape, end: int, parameters: np.ndarray) -> Callable[[Shape, Shape], np.ndarray]:
    """Function of two shapes: how far, across the other, the one ends from the place on the other."""
    sides = np.linalg.svd(touched.tangents(parameters))[2][1:]

    def values(shape: Shape, other: Shape) -> np.ndarray:
        return sides @ (shape.ends[end] - other.at(parameters)[0])

    return values
