"""A strict reader of the STEP files that we write: what a CAD kernel must be able to rely on, and the geometry in them.

Every reference must be to an entity of a type that is allowed there, every attribute of its type, no entity without a
use. The attributes are those of ISO 10303-41, -42, -43, and of the schema of AP214.
"""

import re

import numpy as np
from scipy.interpolate import BSpline

TOKEN = re.compile(
    r"\s*(?:(?P<text>'(?:[^']|'')*')|(?P<reference>#\d+)|(?P<real>[+-]?\d+\.\d*(?:E[+-]?\d+)?)|(?P<integer>[+-]?\d+)"
    r"|(?P<enumeration>\.\w+\.)|(?P<keyword>[A-Z]\w*)|(?P<mark>[(),;=$*]))"
)
CURVES = ("LINE", "CIRCLE", "ELLIPSE", "B_SPLINE_CURVE_WITH_KNOTS")
ATTRIBUTES = {
    "CARTESIAN_POINT": ["text", ["real"]],
    "DIRECTION": ["text", ["real"]],
    "VECTOR": ["text", ("DIRECTION",), "real"],
    "LINE": ["text", ("CARTESIAN_POINT",), ("VECTOR",)],
    "AXIS2_PLACEMENT_3D": ["text", ("CARTESIAN_POINT",), ("DIRECTION",), ("DIRECTION",)],
    "CIRCLE": ["text", ("AXIS2_PLACEMENT_3D",), "real"],
    "ELLIPSE": ["text", ("AXIS2_PLACEMENT_3D",), "real", "real"],
    "B_SPLINE_CURVE_WITH_KNOTS": [
        *("text", "integer", [("CARTESIAN_POINT",)], "enumeration", "enumeration", "enumeration"),
        *(["integer"], ["real"], "enumeration"),
    ],
    "VERTEX_POINT": ["text", ("CARTESIAN_POINT",)],
    "EDGE_CURVE": ["text", ("VERTEX_POINT",), ("VERTEX_POINT",), CURVES, "enumeration"],
    "CONNECTED_EDGE_SET": ["text", [("EDGE_CURVE",)]],
    "EDGE_BASED_WIREFRAME_MODEL": ["text", [("CONNECTED_EDGE_SET",)]],
    "EDGE_BASED_WIREFRAME_SHAPE_REPRESENTATION": [
        *("text", [("AXIS2_PLACEMENT_3D", "EDGE_BASED_WIREFRAME_MODEL")]),
        ("REPRESENTATION_CONTEXT",),
    ],
    "GEOMETRIC_REPRESENTATION_CONTEXT": ["integer"],
    "GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT": [[("UNCERTAINTY_MEASURE_WITH_UNIT",)]],
    "GLOBAL_UNIT_ASSIGNED_CONTEXT": [[("LENGTH_UNIT", "PLANE_ANGLE_UNIT", "SOLID_ANGLE_UNIT")]],
    "REPRESENTATION_CONTEXT": ["text", "text"],
    "UNCERTAINTY_MEASURE_WITH_UNIT": ["LENGTH_MEASURE", ("LENGTH_UNIT",), "text", "text"],
    "LENGTH_UNIT": [],
    "PLANE_ANGLE_UNIT": [],
    "SOLID_ANGLE_UNIT": [],
    "NAMED_UNIT": ["*"],
    "SI_UNIT": ["enumeration or $", "enumeration"],
    "APPLICATION_CONTEXT": ["text"],
    "APPLICATION_PROTOCOL_DEFINITION": ["text", "text", "integer", ("APPLICATION_CONTEXT",)],
    "PRODUCT_CONTEXT": ["text", ("APPLICATION_CONTEXT",), "text"],
    "PRODUCT": ["text", "text", "text", [("PRODUCT_CONTEXT",)]],
    "PRODUCT_RELATED_PRODUCT_CATEGORY": ["text", "text or $", [("PRODUCT",)]],
    "PRODUCT_DEFINITION_FORMATION": ["text", "text", ("PRODUCT",)],
    "PRODUCT_DEFINITION_CONTEXT": ["text", ("APPLICATION_CONTEXT",), "text"],
    "PRODUCT_DEFINITION": ["text", "text", ("PRODUCT_DEFINITION_FORMATION",), ("PRODUCT_DEFINITION_CONTEXT",)],
    "PRODUCT_DEFINITION_SHAPE": ["text", "text", ("PRODUCT_DEFINITION",)],
    "SHAPE_DEFINITION_REPRESENTATION": [
        *(("PRODUCT_DEFINITION_SHAPE",), ("EDGE_BASED_WIREFRAME_SHAPE_REPRESENTATION",))
    ],
}
ROOTS = {"SHAPE_DEFINITION_REPRESENTATION", "APPLICATION_PROTOCOL_DEFINITION", "PRODUCT_RELATED_PRODUCT_CATEGORY"}


def tokens_of(text):
    """(kind, text) of every token; ValueError where there is none."""
    at, end, found = 0, len(text.rstrip()), []
    while at < end:
        match = TOKEN.match(text, at)
        if not match:
            raise ValueError(f"no token at {text[at : at + 40]!r}")
        found.append((match.lastgroup, match.group(match.lastgroup)))
        at = match.end()
    return found


def values_of(tokens, at):
    """The values within the parentheses that open at `at`, (kind, value) each, and where they close."""
    assert tokens[at] == ("mark", "("), tokens[at]
    values, at = [], at + 1
    while tokens[at] != ("mark", ")"):
        kind, text = tokens[at]
        if (kind, text) == ("mark", "("):
            inner, at = values_of(tokens, at)
            values.append(("list", inner))
        elif kind == "keyword":
            inner, at = values_of(tokens, at + 1)
            values.append((text, inner))
        else:
            assert kind != "mark" or text in "$*", (kind, text)
            values.append((text if kind == "mark" else kind, text))
        at += 1
        if tokens[at] == ("mark", ","):
            at += 1
            assert tokens[at] != ("mark", ")")
        else:
            assert tokens[at] == ("mark", ")"), tokens[at]
    return values, at


def read_entities(path):
    """{reference: {keyword: values}} of a file, after all checks."""
    text = path.read_bytes().decode("ascii")
    head, data, tail = re.fullmatch(
        r"(ISO-10303-21;\nHEADER;\n.*?ENDSEC;\n)DATA;\n(.*)(ENDSEC;\n.*)", text, re.DOTALL
    ).groups()
    assert tail == "ENDSEC;\nEND-ISO-10303-21;\n"
    assert re.findall(r"^(\w+)\(", head, re.MULTILINE) == ["FILE_DESCRIPTION", "FILE_NAME", "FILE_SCHEMA"]
    entities = {}
    for line in data.splitlines():
        tokens = tokens_of(line)
        assert tokens[0][0] == "reference" and tokens[1] == ("mark", "=") and tokens[-1] == ("mark", ";"), line
        assert tokens[0][1] not in entities, line
        entities[tokens[0][1]] = _parts(tokens[2:-1])
    used = set()
    for reference, parts in entities.items():
        for keyword, values in parts.items():
            _check(entities, used, ATTRIBUTES[keyword], values, f"{reference} {keyword}")
    unused = {keyword for reference in set(entities) - used for keyword in entities[reference]}
    assert unused == ROOTS
    return entities


def _parts(tokens):
    """{keyword: values} of a simple or complex entity."""
    if tokens[0][0] == "keyword":
        values, end = values_of(tokens, 1)
        assert end == len(tokens) - 1
        return {tokens[0][1]: values}
    parts, at = {}, 1
    while tokens[at] != ("mark", ")"):
        assert tokens[at][0] == "keyword"
        parts[tokens[at][1]], end = values_of(tokens, at + 1)
        at = end + 1
    assert at == len(tokens) - 1 and list(parts) == sorted(parts)
    return parts


def _check(entities, used, wanted, values, where):
    """Are the values what is wanted? Notes the references that are used."""
    assert len(wanted) == len(values), where
    for want, (kind, value) in zip(wanted, values, strict=True):
        if isinstance(want, list):
            assert kind == "list" and value, where
            _check(entities, used, want * len(value), value, where)
        elif isinstance(want, tuple):
            assert kind == "reference" and set(want) & set(entities[value]), where
            used.add(value)
        elif want == "LENGTH_MEASURE":
            assert kind == want and [inner for inner, _ in value] == ["real"], where
        else:
            assert kind in want.split(" or "), (where, want, kind)


class StepEdge:
    """An EDGE_CURVE of a file: name, keyword of its curve, the two vertices' references, what it is made of."""

    def __init__(self, entities, values):
        self._entities = entities
        name, first, last, curve, sense = (value for _, value in values)
        self.name, self.vertices = name[1:-1].replace("''", "'"), (first, last)
        ((self.keyword, self._curve),) = entities[curve].items()
        assert sense == ".T."

    def _of(self, reference):
        (values,) = self._entities[reference].values()
        return [value for _, value in values]

    def numbers(self, reference):
        """(3,) of a point or a direction."""
        return np.array([float(number) for _, number in self._of(reference)[1]])

    @property
    def ends(self):
        """(2, 3) where its vertices are."""
        return np.array([self.numbers(self._of(vertex)[1]) for vertex in self.vertices])

    @property
    def placement(self):
        """(3,) centre and (3, 3) x, y, z of a circle or an ellipse."""
        _, centre, z, x = self._of(self._curve[1][1])
        z, x = self.numbers(z), self.numbers(x)
        np.testing.assert_allclose([z @ z, x @ x, z @ x], [1, 1, 0], atol=1e-12)
        return self.numbers(centre), np.array([x, np.cross(z, x), z])

    @property
    def radii(self):
        """(1,) or (2,)."""
        return np.array([float(value) for _, value in self._curve[2:]])

    @property
    def spline(self):
        """The B-spline as SciPy's, and its distinct knots."""
        _, degree, control, _, _, _, multiplicities, knots, _ = (value for _, value in self._curve)
        control = np.array([self.numbers(point) for _, point in control])
        knots = np.array([float(knot) for _, knot in knots])
        all_knots = np.repeat(knots, [int(each) for _, each in multiplicities])
        assert len(all_knots) == len(control) + int(degree) + 1
        return BSpline(all_knots, control, int(degree)), knots

    def at(self, parameters):
        """(n, 3) points, parameters from 0 to 1 along its own parameter, from the first vertex to the last."""
        parameters = np.asarray(parameters)[:, None]
        if self.keyword == "LINE":
            start, along = self.numbers(self._curve[1][1]), self._of(self._curve[2][1])
            length = float(along[2])
            return start + parameters * length * self.numbers(along[1])
        if self.keyword == "B_SPLINE_CURVE_WITH_KNOTS":
            return self.spline[0](parameters[:, 0])
        centre, (x, y, _) = self.placement
        radii = np.broadcast_to(self.radii, 2)
        low, high = (np.arctan2((end - centre) @ y / radii[1], (end - centre) @ x / radii[0]) for end in self.ends)
        if self.vertices[0] == self.vertices[1] or high <= low:
            high += 2 * np.pi
        t = low + parameters * (high - low)
        return centre + radii[0] * np.cos(t) * x + radii[1] * np.sin(t) * y


def read_step(path):
    """The StepEdges of a file, by the order of its EDGE_CURVEs, and its connected sets of their references' order."""
    entities = read_entities(path)
    curves = [(reference, parts["EDGE_CURVE"]) for reference, parts in entities.items() if "EDGE_CURVE" in parts]
    order = {reference: number for number, (reference, _) in enumerate(curves)}
    sets = [parts["CONNECTED_EDGE_SET"][1][1] for parts in entities.values() if "CONNECTED_EDGE_SET" in parts]
    return [StepEdge(entities, values) for _, values in curves], [[order[name] for _, name in each] for each in sets]
