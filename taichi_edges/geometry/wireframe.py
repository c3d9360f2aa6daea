"""Wireframe: edges with the vertices they meet in, and the file `edges.json`.

The file holds EMAP's keys `curves_ctl_pts` (n, 4, 3) and `lines_end_pts` (n, 2, 3), so that whoever reads EMAP's edges
reads these, and beside them what makes them a graph:

vertices        (V, 3) points where edges end.
edges           one object for each edge: `kind` (line, arc, circle, elliptic_arc, ellipse, spline); `vertices`, the two
                it ends in (none if closed); of arcs and ellipses `centre`, `half_axes` (2, 3) and `angles_rad` [from,
                to]; and what the images say about it, see Evidence.
contacts        [vertex, edge] pairs: the vertex lies on the edge between its ends (a T-junction).
line_sources, curve_sources
                the edge that each of EMAP's lines and cubics is a piece of.
"""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from operator import index
from pathlib import Path
from typing import Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.geometry.edge_set import EdgeSet, edges_and_about, write_edges
from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline


@dataclass(frozen=True)
class Evidence:
    """What the images say about an edge.

    views: number of views that see it, on half of its length at least. supported_length: length that enough views see,
    units of the frame. residual_px: root mean square distance of its edgels from it, px. confidence: 0 to 1.
    """

    views: int
    supported_length: float
    residual_px: float
    confidence: float


@dataclass(frozen=True)
class Edge:
    """shape: Line, EllipticArc or Spline. vertices: indices of the two it ends in, () if closed. evidence: or None."""

    shape: Shape
    vertices: tuple[int, ...] = ()
    evidence: Evidence | None = None


@dataclass(frozen=True)
class Wireframe:
    """A graph of edges.

    vertices: (V, 3). edges: in order. contacts: (k, 2) int, vertex and an edge it lies on between its ends.
    An edge's shape ends exactly in its vertices.
    """

    vertices: np.ndarray
    edges: tuple[Edge, ...]
    contacts: np.ndarray

    @staticmethod
    def loose(shapes: Iterable[Shape]) -> "Wireframe":
        """The Wireframe in which every shape is an edge that meets no other."""
        vertices, edges = [np.zeros((0, 3))], []
        for shape in shapes:
            ends = () if shape.closed else (2 * len(vertices) - 2, 2 * len(vertices) - 1)
            edges.append(Edge(shape, ends))
            if ends:
                vertices.append(shape.ends)
        return Wireframe(np.concatenate(vertices), tuple(edges), np.zeros((0, 2), np.int64))

    def __len__(self) -> int:
        return len(self.edges)

    @property
    def shapes(self) -> list[Shape]:
        """The shapes of the edges, in order."""
        return [edge.shape for edge in self.edges]

    @property
    def degrees(self) -> np.ndarray:
        """(V,) how many edges meet in each vertex: those that end there, and those it lies on."""
        ends = [end for edge in self.edges for end in edge.vertices]
        meeting = np.concatenate([np.array(ends, np.int64), self.contacts[:, 0]])
        return np.bincount(meeting, minlength=len(self.vertices))

    def edge_set(self) -> EdgeSet:
        """The same as an EdgeSet, whose sources are the indices of the edges."""
        lines = [(number, shape) for number, shape in enumerate(self.shapes) if isinstance(shape, Line)]
        curves = [(number, shape.cubics()) for number, shape in enumerate(self.shapes) if not isinstance(shape, Line)]
        return EdgeSet(
            np.array([shape.points for _, shape in lines]).reshape(-1, 2, 3),
            np.concatenate([np.zeros((0, 4, 3)), *(cubics for _, cubics in curves)]),
            np.array([number for number, _ in lines], dtype=np.int64),
            np.array([number for number, cubics in curves for _ in cubics], dtype=np.int64),
        )

    def keep(self, chosen: np.ndarray) -> "Wireframe":
        """Only the chosen edges, (E,) bool, and the vertices that these end in."""
        kept = np.flatnonzero(chosen)
        used = np.unique([end for number in kept for end in self.edges[number].vertices]).astype(np.int64)
        vertex, edge = np.full(len(self.vertices), -1), np.full(len(self.edges), -1)
        vertex[used], edge[kept] = np.arange(len(used)), np.arange(len(kept))
        chosen_edges = (self.edges[number] for number in kept)
        edges = tuple(replace(old, vertices=tuple(int(vertex[end]) for end in old.vertices)) for old in chosen_edges)
        contacts = np.stack([vertex[self.contacts[:, 0]], edge[self.contacts[:, 1]]], axis=1)
        return Wireframe(self.vertices[used], edges, contacts[(contacts >= 0).all(axis=1)])

    def transformed(self, function: Callable[[np.ndarray], np.ndarray], scale: float) -> "Wireframe":
        """The same wireframe with `function`, a similarity (n, 3) -> (n, 3), applied. scale: by which lengths grow."""
        edges = []
        for edge in self.edges:
            seen = edge.evidence
            if seen is not None:
                seen = replace(seen, supported_length=seen.supported_length * scale)
            edges.append(Edge(edge.shape.transformed(function), edge.vertices, seen))
        return Wireframe(function(self.vertices), tuple(edges), self.contacts)


def write_wireframe(path: Path | str, wireframe: Wireframe, about: dict[str, Any]) -> Path:
    """Write `edges.json`, see above. wireframe: in the frame of the input. about: further keys, JSON values only."""
    graph = {
        "vertices": wireframe.vertices.tolist(),
        "edges": [_described(edge) for edge in wireframe.edges],
        "contacts": wireframe.contacts.tolist(),
    }
    return write_edges(path, wireframe.edge_set(), {**graph, **about})


def read_wireframe(path: Path | str) -> Wireframe:
    """The Wireframe of an `edges.json`.

    A file without the keys of the graph (EMAP's) gives loose edges, each source a line or a chain of cubics.
    """
    return wireframe_and_about(path)[0]


def wireframe_and_about(path: Path | str) -> tuple[Wireframe, dict[str, Any]]:
    """The Wireframe of an `edges.json`, as `read_wireframe` gives it, and the dict of its other keys."""
    edges, content = edges_and_about(path)
    if "edges" not in content or not isinstance(content["edges"], list):
        return Wireframe.loose(_shapes_of_sources(edges)), content
    try:
        vertices = np.asarray(content.pop("vertices"), dtype=np.float64).reshape(-1, 3)
        contacts = np.asarray(content.pop("contacts"), dtype=np.int64).reshape(-1, 2)
        found = tuple(_undescribed(number, of, edges) for number, of in enumerate(content.pop("edges")))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        problem = f"its vertices, edges and contacts are no wireframe ({type(error).__name__}: {error})"
        raise UserError(f"{path}: {problem}; run the refine stage again") from error
    named = [*(end for edge in found for end in edge.vertices), *contacts[:, 0]]
    touched = contacts[:, 1].tolist()
    if any(not 0 <= end < len(vertices) for end in named) or any(not 0 <= edge < len(found) for edge in touched):
        raise UserError(f"{path}: it names vertices or edges that are not there; run the refine stage again")
    return Wireframe(vertices, found, contacts), content


def _described(edge: Edge) -> dict[str, Any]:
    """An Edge as JSON values."""
    shape = edge.shape
    text: dict[str, Any] = {"kind": shape.kind, "vertices": list(edge.vertices)}
    if isinstance(shape, EllipticArc):
        text |= {"centre": shape.centre.tolist(), "half_axes": shape.axes.tolist()}
        text["angles_rad"] = [shape.low, shape.high]
    if isinstance(shape, Spline):
        text["closed"] = shape.closed
    return text | (asdict(edge.evidence) if edge.evidence else {})


def _undescribed(number: int, described: dict[str, Any], edges: EdgeSet) -> Edge:
    """The Edge of JSON values; `edges` is the EdgeSet that holds its points. ValueError and others if it is none."""
    evidence, vertices = None, tuple(index(end) for end in described["vertices"])
    if "confidence" in described:
        views, *rest = (described[key] for key in Evidence.__dataclass_fields__)
        evidence = Evidence(index(views), *map(float, rest))
    shape = _shape_of(number, described, edges)
    if len(vertices) != (0 if shape.closed else 2):
        raise ValueError(f"edge {number} of kind {described['kind']} ends in {len(vertices)} vertices")
    return Edge(shape, vertices, evidence)


def _shape_of(number: int, described: dict[str, Any], edges: EdgeSet) -> Shape:
    """The shape of an edge of which all is given as JSON values, except the points in `edges`."""
    if "half_axes" in described:
        centre, axes = (np.array(described[key], dtype=np.float64) for key in ("centre", "half_axes"))
        return EllipticArc(centre.reshape(3), axes.reshape(2, 3), *map(float, described["angles_rad"]))
    if described["kind"] == "line":
        return Line(edges.lines[edges.line_sources == number][0])
    curves = edges.curves[edges.curve_sources == number]
    if not len(curves):
        raise ValueError(f"edge {number} has no points")
    return Spline(curves, bool(described["closed"]))


def _shapes_of_sources(edges: EdgeSet) -> list[Shape]:
    """The shapes of an EdgeSet without a graph."""
    chains: dict[int, list[np.ndarray]] = {}
    for source, curve in zip(edges.curve_sources.tolist(), edges.curves, strict=True):
        chains.setdefault(source, []).append(curve)
    splines = [np.array(chain) for chain in chains.values()]
    closed = (bool((s[0, 0] == s[-1, 3]).all()) for s in splines)
    return [*map(Line, edges.lines), *map(Spline, splines, closed)]
