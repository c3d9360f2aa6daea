"""STEP for CAD programs: a wireframe of exact lines, circles, ellipses and B-splines that share their vertices.

ISO 10303-21 text of the schema of AP214, an edge-based wireframe (ISO 10303-501): each edge is an EDGE_CURVE between
VERTEX_POINTs, and edges that hang together by shared vertices are a CONNECTED_EDGE_SET. A T-junction joins none: edges
of this format meet in their vertices only, and to cut the through edge there would make two of one. The name of an edge
is its kind, its index in `edges.json` and what the images say of it. The numbers are those of the input's frame. It has
no unit, but STEP cannot do without, and to kernels it matters: OpenCASCADE, for one, heals gaps of up to 1 mm, and so
merges the corners of an object of that size. So they are metres, or whatever makes the object between a tenth of a
metre and a hundred metres large.
"""

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.exporters.naming import edge_name, evidence_words, refuse_empty
from taichi_edges.exporters.nurbs import DEGREE, joined
from taichi_edges.files.artefacts import write_text

if TYPE_CHECKING:
    from taichi_edges.geometry.shapes import EllipticArc, Line, Spline
    from taichi_edges.geometry.wireframe import Wireframe

SCHEMA = "AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }"
NO_DATE = "1970-01-01T00:00:00"  # the same edges give the same bytes
SMALLEST, RANGE = 0.1, 1000.0  # the longest side of the edges' box in metres: from this to so many times this
PREFIXES = (".MICRO.", ".MILLI.", "$", ".KILO.")  # of the metre, each RANGE times the one before
UNCERTAINTY = 1e-6  # of the longest side of the edges' box: points closer than this are one
HEADER = f"""ISO-10303-21;
HEADER;
FILE_DESCRIPTION(('edges recovered from images'),'2;1');
FILE_NAME('edges','{NO_DATE}',(''),(''),'taichi_edges','taichi_edges','');
FILE_SCHEMA(('{SCHEMA}'));
ENDSEC;
DATA;
"""
FOOTER = "ENDSEC;\nEND-ISO-10303-21;\n"

Value = str | float | Iterable  # of an entity: text, a number, or a list of values


class Token(str):
    """Text that stands in the file as it is: a reference, an enumeration, a typed value."""


TRUE, FALSE, UNSPECIFIED, UNSET, DERIVED = (Token(text) for text in (".T.", ".F.", ".UNSPECIFIED.", "$", "*"))


class Entities:
    """The entities of the file in order; each gets the next number."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, keyword: str, *values: Value) -> Token:
        """Add an entity; returns the reference to it."""
        return self.add_complex((keyword, *values))

    def add_complex(self, *parts: tuple) -> Token:
        """Add an entity of several types, (keyword, *values) each, in the order of the alphabet."""
        written = "".join(f"{keyword}({','.join(map(encoded, values))})" for keyword, *values in parts)
        reference = Token(f"#{len(self.lines) + 1}")
        self.lines.append(f"{reference}={written if len(parts) == 1 else f'({written})'};")
        return reference


def encoded(value: Value) -> str:
    """A value as Part 21 writes it: 3 -> 3, 3.0 -> 3., 1e-9 -> 1.E-09, "it's" -> 'it''s', (1, 2) -> (1,2)."""
    if isinstance(value, Token):
        return value
    if isinstance(value, str):
        return "'" + value.replace("\\", "\\\\").replace("'", "''") + "'"
    if isinstance(value, int | np.integer):
        return str(value)
    if isinstance(value, float):
        mantissa, exponent, power = repr(float(value)).upper().partition("E")
        return (
            mantissa.removesuffix("0" if mantissa.endswith(".0") else "")
            + ("" if "." in mantissa else ".")
            + exponent
            + power
        )
    return f"({','.join(map(encoded, value))})"


def write_step(path: Path | str, wireframe: "Wireframe") -> Path:
    """Write the edges of a Wireframe, in the frame the file shall have, as a STEP file."""
    refuse_empty(path, wireframe)
    entities = Entities()
    edges = _add_edges(entities, wireframe)
    sets = [entities.add("CONNECTED_EDGE_SET", "", [edges[i] for i in part]) for part in connected_parts(wireframe)]
    model = entities.add("EDGE_BASED_WIREFRAME_MODEL", "edges", sets)
    origin = _add_placement(entities, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    size = _longest_side(wireframe)
    context = _add_context(entities, prefix_for(size), UNCERTAINTY * size)
    shape = entities.add("EDGE_BASED_WIREFRAME_SHAPE_REPRESENTATION", "edges", (origin, model), context)
    _add_product(entities, shape)
    return write_text(path, HEADER + "\n".join(entities.lines) + "\n" + FOOTER)


def connected_parts(wireframe: "Wireframe") -> list[list[int]]:
    """The edges that hang together by shared vertices, as lists of their indices, by the first."""
    first_at: dict[int, int] = {}
    parts = [[number] for number in range(len(wireframe))]
    for number, edge in enumerate(wireframe.edges):
        for vertex in edge.vertices:
            other = parts[first_at.setdefault(vertex, number)]
            if other is not parts[number]:
                other += parts[number]
                for moved in parts[number]:
                    parts[moved] = other
    return [sorted(part) for number, part in enumerate(parts) if number == min(part)]


def prefix_for(size: float) -> Token:
    """The prefix of the metre for edges of this size, units of the frame."""
    steps = math.floor(math.log(max(size, 1e-300) / SMALLEST, RANGE))
    return Token(PREFIXES[min(max(PREFIXES.index("$") - steps, 0), len(PREFIXES) - 1)])


def _longest_side(wireframe: "Wireframe") -> float:
    points = np.concatenate([shape.cubics().reshape(-1, 3) for shape in wireframe.shapes])
    return float(np.ptp(points, axis=0).max())


def _add_edges(entities: Entities, wireframe: "Wireframe") -> list[Token]:
    """An EDGE_CURVE for each edge; the references in order. A closed one starts and ends in a vertex of its own."""
    used = {vertex for edge in wireframe.edges for vertex in edge.vertices}
    vertices = {vertex: _add_vertex(entities, wireframe.vertices[vertex]) for vertex in sorted(used)}
    references = []
    for number, edge in enumerate(wireframe.edges):
        if edge.vertices:
            first, last = (vertices[vertex] for vertex in edge.vertices)
        else:
            first = last = _add_vertex(entities, edge.shape.ends[0])
        curve = CURVES[edge.shape.kind](entities, edge.shape)
        words = ", ".join(filter(None, (edge_name(number, edge), evidence_words(edge))))
        references.append(entities.add("EDGE_CURVE", words, first, last, curve, TRUE))
    return references


def _add_vertex(entities: Entities, point: np.ndarray) -> Token:
    return entities.add("VERTEX_POINT", "", _add_point(entities, point))


def _add_point(entities: Entities, point: np.ndarray) -> Token:
    return entities.add("CARTESIAN_POINT", "", np.asarray(point).tolist())


def _add_direction(entities: Entities, direction: np.ndarray) -> Token:
    return entities.add("DIRECTION", "", (direction / np.linalg.norm(direction)).tolist())


def _add_placement(entities: Entities, origin: np.ndarray, z: np.ndarray, x: np.ndarray) -> Token:
    """A coordinate system: (3,) each."""
    parts = _add_point(entities, origin), _add_direction(entities, z), _add_direction(entities, x)
    return entities.add("AXIS2_PLACEMENT_3D", "", *parts)


def _add_line(entities: Entities, line: "Line") -> Token:
    start, end = line.points
    along = entities.add("VECTOR", "", _add_direction(entities, end - start), line.length)
    return entities.add("LINE", "", _add_point(entities, start), along)


def _add_circle(entities: Entities, arc: "EllipticArc") -> Token:
    """Counter-clockwise about its normal, as our angles are: the vertices say where it starts and ends."""
    placement = _add_placement(entities, arc.centre, arc.normal, arc.axes[0])
    return entities.add("CIRCLE", "", placement, float(arc.radii.mean()))


def _add_ellipse(entities: Entities, arc: "EllipticArc") -> Token:
    placement = _add_placement(entities, arc.centre, arc.normal, arc.axes[0])
    return entities.add("ELLIPSE", "", placement, *arc.radii.tolist())


def _add_spline(entities: Entities, spline: "Spline") -> Token:
    same = joined(spline.curves)
    control = [_add_point(entities, point) for point in same.control_points]
    knots = same.multiplicities.tolist(), same.knots.tolist()
    closed = TRUE if spline.closed else FALSE
    form = "", DEGREE, control, UNSPECIFIED, closed, FALSE
    return entities.add("B_SPLINE_CURVE_WITH_KNOTS", *form, *knots, UNSPECIFIED)


CURVES: dict[str, Callable[..., Token]] = {
    "line": _add_line,
    "circle": _add_circle,
    "arc": _add_circle,
    "ellipse": _add_ellipse,
    "elliptic_arc": _add_ellipse,
    "spline": _add_spline,
}


def _add_context(entities: Entities, prefix: Token, uncertainty: float) -> Token:
    """The context of all geometry: three dimensions, metres with a prefix, radians. uncertainty: in this unit."""
    unit = ("NAMED_UNIT", DERIVED)
    length = entities.add_complex(("LENGTH_UNIT",), unit, ("SI_UNIT", prefix, Token(".METRE.")))
    angle = entities.add_complex(unit, ("PLANE_ANGLE_UNIT",), ("SI_UNIT", UNSET, Token(".RADIAN.")))
    solid = entities.add_complex(unit, ("SI_UNIT", UNSET, Token(".STERADIAN.")), ("SOLID_ANGLE_UNIT",))
    measure = Token(f"LENGTH_MEASURE({encoded(uncertainty)})")
    named = "distance_accuracy_value", "points closer than this are one"
    accuracy = entities.add("UNCERTAINTY_MEASURE_WITH_UNIT", measure, length, *named)
    return entities.add_complex(
        ("GEOMETRIC_REPRESENTATION_CONTEXT", 3),
        ("GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT", (accuracy,)),
        ("GLOBAL_UNIT_ASSIGNED_CONTEXT", (length, angle, solid)),
        ("REPRESENTATION_CONTEXT", "", ""),
    )


def _add_product(entities: Entities, shape: Token) -> None:
    """What says that the shape is that of a part: programs start reading here."""
    application = entities.add("APPLICATION_CONTEXT", "core data for automotive mechanical design processes")
    protocol = "international standard", "automotive_design", 2000
    entities.add("APPLICATION_PROTOCOL_DEFINITION", *protocol, application)
    context = entities.add("PRODUCT_CONTEXT", "", application, "mechanical")
    product = entities.add("PRODUCT", "edges", "edges", "", (context,))
    entities.add("PRODUCT_RELATED_PRODUCT_CATEGORY", "part", UNSET, (product,))
    version = entities.add("PRODUCT_DEFINITION_FORMATION", "", "", product)
    stage = entities.add("PRODUCT_DEFINITION_CONTEXT", "part definition", application, "design")
    definition = entities.add("PRODUCT_DEFINITION", "design", "", version, stage)
    of_product = entities.add("PRODUCT_DEFINITION_SHAPE", "", "", definition)
    entities.add("SHAPE_DEFINITION_REPRESENTATION", of_product, shape)
