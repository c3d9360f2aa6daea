"""DXF and STEP hold exactly the edges that were written: other readers than ours say so."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from part21 import read_step
from scipy.interpolate import BSpline

from taichi_edges.exporters.dxf import APPLICATION, layer_of, write_dxf
from taichi_edges.exporters.nurbs import joined
from taichi_edges.exporters.step import connected_parts, encoded, prefix_for, write_step
from taichi_edges.files.palette import CONTOUR_COLOUR, KIND_COLOURS
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.geometry.edge_set import write_edges
from taichi_edges.geometry.shapes import EllipticArc, Line, Spline
from taichi_edges.geometry.wireframe import Edge, Evidence, Wireframe, read_wireframe, write_wireframe
from taichi_edges.synthetic.parts import PARTS

ROOT = Path(__file__).parent.parent
EXACT = 1e-9  # of the edges' size: sixteen digits go through a few products and, in DXF, through degrees
PLANES = {
    "upright": ([1, 0, 0], [0, 1, 0]),
    "reversed": ([1, 0, 0], [0, -1, 0]),
    "nearly upright": ([1, 0, 0.002], [0, 1, 0.003]),  # there DXF's rule for the plane's axes changes
    "vertical": ([0, 0, 1], [0.6, 0.8, 0]),
    "oblique": ([1, 2, 3], [-2, 1, 0.5]),
}


def in_plane(name, radii):
    """(2, 3) half axes in one of the planes."""
    first, second = (np.array(axis, float) for axis in PLANES[name])
    first /= np.linalg.norm(first)
    second -= second @ first * first
    return np.stack([radii[0] * first, radii[1] * second / np.linalg.norm(second)])


def smooth_chain():
    """A chain of cubics with equal tangents at the joints and handles of all lengths."""
    arc = EllipticArc(np.array([1.0, 2, 3]), in_plane("oblique", (2.0, 0.7)), 0.3, 5.0)
    curves = arc.cubics()
    curves[1:, 1] = curves[1:, 0] + np.array([0.4, 1.7, 3.0])[: len(curves) - 1, None] * (curves[1:, 1] - curves[1:, 0])
    return curves


def every_shape():
    """Every kind of shape, arcs of less and more than half a round in every plane."""
    shapes = [Line(np.array([[0.0, 0, 0], [1, 2, 3]])), Line(np.array([[1.0, 1, -1e-5], [1, 1e-7, 1]]))]
    for plane in PLANES:
        centre = np.array([0.3, -0.2, 1.7])
        for low, high in ((-1.0, -0.4), (2.0, 6.5), (0.7, 0.7 + 2 * np.pi)):
            shapes.append(EllipticArc(centre, in_plane(plane, (0.8, 0.8)), low, high))
            shapes.append(EllipticArc(centre, in_plane(plane, (1.1, 0.3)), low, high))
    loop = EllipticArc(np.array([0.0, 1, 0]), in_plane("oblique", (1.3, 0.4)), 0.0, 2 * np.pi)
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], [[1, 1, 1], [0, 1, 1], [0, 0, 2], [0, 0, 3]]])
    return [*shapes, Spline(smooth_chain()), Spline(smooth_chain()[:1]), Spline(loop.cubics(), True), Spline(corners)]


def house():
    """A square whose fourth side is an arc, a line that ends on one of the sides, a circle; half of them judged."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0, 0], [0.5, 0, 1]])
    lines = [(0, 1), (1, 2), (2, 3), (4, 5)]
    half_round = EllipticArc(np.array([0, 0.5, 0]), in_plane("reversed", (0.5, 0.5))[[1, 0]] * [[-1], [-1]], 0, np.pi)
    edges = [Edge(Line(vertices[list(ends)]), ends, Evidence(1 + ends[0], 0.9, 0.21, 0.5)) for ends in lines]
    edges += [Edge(half_round, (3, 0)), Edge(EllipticArc(np.zeros(3), np.eye(3)[:2], 0, 2 * np.pi))]
    assert np.allclose(half_round.ends, vertices[[3, 0]])
    return Wireframe(vertices, tuple(edges), np.array([[4, 0]]))


def cube():
    """Eight vertices and twelve lines between them, of length 1, a little off."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    ends = [(a, b) for a in range(8) for b in range(a) if np.abs(corners[a] - corners[b]).sum() == 1]
    vertices = corners + np.random.default_rng(0).normal(scale=1e-3, size=(8, 3))
    return Wireframe(vertices, tuple(Edge(Line(vertices[list(e)]), e) for e in ends), np.zeros((0, 2), int))


@pytest.fixture(params=["every shape", "large and far away", "house", "cube", "small cube"])
def wireframe(request):
    if request.param == "house":
        return house()
    if "cube" in request.param:
        scale = 1.0 if request.param == "cube" else 1e-3
        return cube().transformed(lambda points: scale * points, scale)
    every = Wireframe.loose(every_shape())
    return every if request.param == "every shape" else every.transformed(lambda points: 800 * points + 5000, 800.0)


def size_of(wireframe):
    return max(np.abs(shape.cubics()).max() for shape in wireframe.shapes)


def longest_side(wireframe):
    return np.ptp(np.concatenate([shape.cubics().reshape(-1, 3) for shape in wireframe.shapes]), axis=0).max()


def along(shape, knots):
    """(n,) parameters of a file's curve and the (n, 3) points where the shape is then."""
    if shape.kind != "spline":
        return np.linspace(0, 1, 50), shape.at(np.linspace(0, 1, 50))
    assert len(knots) == len(shape.curves) + 1
    fractions = np.linspace(0, 1, 12)
    parameters = (knots[:-1, None] + fractions * np.diff(knots)[:, None]).ravel()
    return parameters, evaluate_bezier(shape.curves, fractions).reshape(-1, 3)


# ------------------------------------------------------------------------------------------------------------ B-splines


def test_smooth_joints_become_double_knots_and_the_curve_stays():
    for curves, multiplicities in ((smooth_chain(), [4, 2, 2, 4]), (every_shape()[-1].curves, [4, 3, 4])):
        same = joined(curves)
        parameters, expected = along(Spline(curves), same.knots)
        spline = BSpline(same.all_knots, same.control_points, 3)
        np.testing.assert_allclose(spline(parameters), expected, rtol=0, atol=1e-13)
        inside = same.knots[1:-1][same.multiplicities[1:-1] == 2]
        slopes = spline.derivative()
        np.testing.assert_allclose(slopes(inside - 1e-12), slopes(inside + 1e-12), atol=1e-8)
        assert same.multiplicities.tolist() == multiplicities
        assert len(same.all_knots) == len(same.control_points) + 4
        assert same.knots[0] == 0 and same.knots[-1] == 1 and (np.diff(same.knots) > 0).all()


def test_joints_that_are_not_smooth_stay_where_they_are():
    """A handle of no length, a tangent that turns back, a corner of a thousandth of a radian."""
    straight = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    for after in ([3, 0, 0], [2.5, 0, 0], [4, 0.001, 0]):
        curves = np.stack([straight, [[3, 0, 0], after, [5, 1, 0], [6, 1, 0]]])
        assert joined(curves).multiplicities.tolist() == [4, 3, 4]
        assert (joined(curves).control_points[3] == [3, 0, 0]).all()


# ------------------------------------------------------------------------------------------------------------------ DXF


def dxf_points(entity, shape):
    """Where the entity says that it is, and where the shape is."""
    if entity.dxftype() == "SPLINE":
        tool = entity.construction_tool()
        parameters, expected = along(shape, np.unique(tool.knots()))
        return np.array([tuple(point) for point in tool.points(parameters)]), expected
    if entity.dxftype() == "LINE":
        return np.array([entity.dxf.start, entity.dxf.end]), shape.ends
    low, high = 0.0, 360.0
    if entity.dxftype() == "ARC":
        low, high = entity.dxf.start_angle, entity.dxf.end_angle
    if entity.dxftype() == "ELLIPSE":
        low, high = entity.dxf.start_param, entity.dxf.end_param
        shape = shape.over(low, high) if shape.closed else shape
    high += (360.0 if entity.dxftype() == "ARC" else 2 * np.pi) * (high <= low)
    found = np.array([tuple(point) for point in entity.vertices(np.linspace(low, high, 50))])
    if entity.dxftype() != "CIRCLE":
        return found, shape.at(np.linspace(0, 1, 50))
    turned = np.linalg.lstsq(shape.axes.T, found[0] - shape.centre, rcond=None)[0]  # where the circle starts is free
    start = np.arctan2(turned[1], turned[0])
    return found, shape.over(start, start + 2 * np.pi).at(np.linspace(0, 1, 50))


def test_dxf_holds_every_edge_exactly(tmp_path, wireframe):
    import ezdxf

    document = ezdxf.readfile(write_dxf(tmp_path / "edges.dxf", wireframe))
    assert not document.audit().errors and not document.audit().fixes
    types = {"line": "LINE", "arc": "ARC", "circle": "CIRCLE", "spline": "SPLINE"}
    entities = list(document.modelspace())
    assert [entity.dxftype() for entity in entities] == [types.get(s.kind, "ELLIPSE") for s in wireframe.shapes]
    for entity, shape in zip(entities, wireframe.shapes, strict=True):
        np.testing.assert_allclose(*dxf_points(entity, shape), rtol=0, atol=EXACT * size_of(wireframe))
        if shape.kind in ("arc", "circle"):
            assert entity.dxf.radius == pytest.approx(shape.radii[0], rel=1e-12)
        if shape.kind in ("ellipse", "elliptic_arc"):
            np.testing.assert_array_equal(tuple(entity.dxf.center), shape.centre)
            assert entity.dxf.ratio == pytest.approx(shape.radii[1] / shape.radii[0], rel=1e-12)


def test_dxf_says_what_the_images_say(tmp_path):
    import ezdxf

    document = ezdxf.readfile(write_dxf(tmp_path / "edges.dxf", house()))
    assert document.header["$INSUNITS"] == 0
    told = []
    for entity, edge in zip(document.modelspace(), house().edges, strict=True):
        assert entity.dxf.layer == layer_of(edge.shape.kind)
        assert document.layers.get(entity.dxf.layer).rgb == KIND_COLOURS[edge.shape.kind]
        pairs = [value for _, value in entity.get_xdata(APPLICATION)]
        told.append(dict(zip(pairs[::2], pairs[1::2], strict=True)))
    judged = {"confidence": 0.5, "residual_px": 0.21, "supported_length": 0.9, "views": 5}
    assert told[3] == {"edge": 3, "name": "line_3", **judged}
    assert told[4] == {"edge": 4, "name": "arc_4"}


def test_dxf_has_contours_in_a_layer_of_their_own(tmp_path):
    import ezdxf

    radii = [{"radius": 0.1, "radius_px": 20.0, "radius_uncertainty_px": 1.5}, {"radius_px": 8.0}]
    contours = [(Line(np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.9]])), radii[0]), (Spline(smooth_chain()), radii[1])]
    without = write_dxf(tmp_path / "without.dxf", house())
    document = ezdxf.readfile(write_dxf(tmp_path / "edges.dxf", house(), contours))
    assert not document.audit().errors and document.layers.get("CONTOURS").rgb == CONTOUR_COLOUR
    edges, found = (list(document.modelspace())[part] for part in (slice(len(house())), slice(len(house()), None)))
    assert {entity.dxf.layer for entity in found} == {"CONTOURS"}
    assert "CONTOURS" not in {entity.dxf.layer for entity in edges}
    for number, (entity, (shape, told)) in enumerate(zip(found, contours, strict=True)):
        np.testing.assert_allclose(*dxf_points(entity, shape), rtol=0, atol=EXACT * size_of(house()))
        pairs = [value for _, value in entity.get_xdata(APPLICATION)]
        assert dict(zip(pairs[::2], pairs[1::2], strict=True)) == {"contour": number, **told}
    assert "CONTOURS" not in ezdxf.readfile(without).layers
    assert write_dxf(tmp_path / "none.dxf", house(), []).read_bytes() == without.read_bytes()


@pytest.mark.parametrize("write", [write_dxf, write_step])
def test_the_same_edges_give_the_same_bytes(tmp_path, write):
    import ezdxf

    before = ezdxf.options.write_fixed_meta_data_for_testing
    first, second = (write(tmp_path / name, house()).read_bytes() for name in ("a", "b"))
    assert first == second
    assert ezdxf.options.write_fixed_meta_data_for_testing == before


@pytest.mark.slow(reason="starts processes")
@pytest.mark.parametrize("suffix", [".dxf", ".step"])
def test_the_same_edges_give_the_same_bytes_in_every_process(tmp_path, suffix):
    """Python orders sets of strings by a random number of the process."""
    source = write_wireframe(tmp_path / "edges.json", house(), {})
    code = (
        "import sys; from taichi_edges.exporters import EXPORTERS; "
        "from taichi_edges.geometry.wireframe import read_wireframe; "
        f"[EXPORTERS[{suffix!r}](path, read_wireframe(sys.argv[1])) for path in sys.argv[2:]]"
    )
    written = set()
    for number in ("1", "4"):  # ezdxf's own order differs between these
        path = tmp_path / f"{number}{suffix}"
        environment = {**os.environ, "PYTHONHASHSEED": number}
        subprocess.run([sys.executable, "-c", code, source, path], check=True, cwd=ROOT, env=environment)
        written.add(path.read_bytes())
    assert len(written) == 1


# ----------------------------------------------------------------------------------------------------------------- STEP


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((3, "3"), (3.0, "3."), (-0.25, "-0.25"), (1e-9, "1.E-09"), (1.5e300, "1.5E+300"), (0.1, "0.1")),
        *((1e22, "1.E+22"), ("it's", "'it''s'"), ((1, 2.0), "(1,2.)"), (np.float64(2), "2."), (np.int64(2), "2")),
    ],
)
def test_values_are_written_as_part_21_wants_them(value, text):
    assert encoded(value) == text
    if isinstance(value, float):
        assert float(text) == value


def test_step_holds_every_edge_exactly(tmp_path, wireframe):
    edges, _ = read_step(write_step(tmp_path / "edges.step", wireframe))
    assert len(edges) == len(wireframe)
    keywords = {"line": "LINE", "arc": "CIRCLE", "circle": "CIRCLE", "spline": "B_SPLINE_CURVE_WITH_KNOTS"}
    for edge, shape in zip(edges, wireframe.shapes, strict=True):
        assert edge.keyword == keywords.get(shape.kind, "ELLIPSE")
        parameters, expected = along(shape, edge.spline[1] if shape.kind == "spline" else None)
        limit = EXACT * size_of(wireframe)
        np.testing.assert_allclose(edge.at(parameters), expected, rtol=0, atol=limit)
        np.testing.assert_allclose(edge.ends, shape.ends, rtol=0, atol=limit)
        if hasattr(shape, "radii"):
            np.testing.assert_allclose(edge.radii, shape.radii[: len(edge.radii)], rtol=1e-12)
            np.testing.assert_array_equal(edge.placement[0], shape.centre)


@pytest.mark.parametrize(
    ("size", "prefix"),
    [(1e-9, ".KILO."), (0.01, ".KILO."), (0.5, "$"), (99, "$"), (2000, ".MILLI."), (5e5, ".MICRO."), (1e99, ".MICRO.")],
)
def test_step_has_the_unit_that_makes_the_object_neither_tiny_nor_huge(size, prefix):
    assert prefix_for(size) == prefix


def test_step_edges_share_their_vertices_and_are_named(tmp_path):
    edges, sets = read_step(write_step(tmp_path / "edges.step", house()))
    meeting = [vertex for edge in edges for vertex in set(edge.vertices)]
    assert sorted(meeting.count(vertex) for vertex in set(meeting)) == [1, 1, 1, 2, 2, 2, 2]
    assert edges[4].vertices == (edges[2].vertices[1], edges[0].vertices[0])
    assert edges[5].vertices[0] == edges[5].vertices[1]  # the circle's own
    assert sets == connected_parts(house()) == [[0, 1, 2, 4], [3], [5]]  # edge 3 touches 0 between its ends
    names = [edge.name for edge in edges]
    assert names[:2] == [
        f"line_{i}, confidence 0.50, {w}, residual 0.21 px" for i, w in enumerate(("1 view", "2 views"))
    ]
    assert names[4:] == ["arc_4", "circle_5"]


def test_parts_that_meet_late_are_one_part():
    """Edges 0 and 1 are joined by 2, which comes last; a loop of one edge joins nothing."""
    spline = Spline(np.zeros((1, 4, 3)))
    ends = [(0, 1), (2, 3), (3, 0), (4, 4), (1, 2)]
    wireframe = Wireframe(np.zeros((5, 3)), tuple(Edge(spline, pair) for pair in ends), np.zeros((0, 2), int))
    assert connected_parts(wireframe) == [[0, 1, 2, 4], [3]]
    assert connected_parts(replace(wireframe, edges=())) == []


@pytest.mark.parametrize("name", ["demo", "wave"])
def test_a_part_of_a_file_without_vertices_goes_through_both(tmp_path, name):
    """As EMAP's files are: pieces that share a number are a chain."""
    import ezdxf

    part = read_wireframe(write_edges(tmp_path / "truth.json", PARTS[name]().edges, {}))
    edges, _ = read_step(write_step(tmp_path / "edges.step", part))
    entities = list(ezdxf.readfile(write_dxf(tmp_path / "edges.dxf", part)).modelspace())
    for edge, entity, shape in zip(edges, entities, part.shapes, strict=True):
        parameters, expected = along(shape, edge.spline[1] if shape.kind == "spline" else None)
        np.testing.assert_allclose(edge.at(parameters), expected, rtol=0, atol=EXACT)
        np.testing.assert_allclose(*dxf_points(entity, shape), rtol=0, atol=EXACT)


# --------------------------------------------------------------------------------------------------------- a CAD kernel


def kernel_edges(path):
    """[(name, TopoDS_Edge, its curve)] that OpenCASCADE reads, in order, and its check of the whole."""
    from OCP.BRepAdaptor import BRepAdaptor_Curve
    from OCP.BRepCheck import BRepCheck_Analyzer
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.STEPControl import STEPControl_Reader
    from OCP.TopAbs import TopAbs_EDGE
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    reader = STEPControl_Reader()
    assert reader.ReadFile(str(path)) == IFSelect_RetDone and reader.TransferRoots() == 1
    shape, found = reader.OneShape(), []
    explorer = TopExp_Explorer(shape, TopAbs_EDGE)
    while explorer.More():
        edge = getattr(TopoDS, "Edge_s", TopoDS.Edge)(explorer.Current())
        entity = reader.WS().TransferReader().EntityFromShapeResult(edge, 1)
        found.append((entity.Name().ToCString(), edge, BRepAdaptor_Curve(edge)))
        explorer.Next()
    found.sort(key=lambda each: int(each[0].split(",")[0].rpartition("_")[2]))
    return found, BRepCheck_Analyzer(shape).IsValid()


def kernel_points(curve, shape, millimetres):
    """Where the kernel's curve is, and where the shape is, both in millimetres."""
    low, high = curve.FirstParameter(), curve.LastParameter()
    if shape.kind == "spline":
        spline = curve.BSpline()
        parameters, expected = along(shape, np.array([spline.Knot(i + 1) for i in range(spline.NbKnots())]))
    else:
        fractions, expected = along(shape, None)
        parameters = low + fractions * (high - low)
    points = (curve.Value(parameter) for parameter in parameters)
    return np.array([(point.X(), point.Y(), point.Z()) for point in points]), millimetres * expected


def test_a_cad_kernel_reads_the_same_edges(tmp_path, wireframe):
    pytest.importorskip("OCP", reason="OpenCASCADE is not installed: pip install 'taichi_edges[cad]'")
    from OCP.BRep import BRep_Tool
    from OCP.GCPnts import GCPnts_AbscissaPoint
    from OCP.GeomAbs import GeomAbs_BSplineCurve, GeomAbs_Circle, GeomAbs_Ellipse, GeomAbs_Line
    from OCP.TopExp import TopExp

    found, valid = kernel_edges(write_step(tmp_path / "edges.step", wireframe))
    assert valid and len(found) == len(wireframe)
    kinds = {"line": GeomAbs_Line, "arc": GeomAbs_Circle, "circle": GeomAbs_Circle, "spline": GeomAbs_BSplineCurve}
    millimetres = {"$": 1e3, ".MILLI.": 1.0, ".KILO.": 1e6}[prefix_for(longest_side(wireframe))]
    limit = EXACT * millimetres * size_of(wireframe)
    vertices = {}
    for (name, body, curve), edge in zip(found, wireframe.edges, strict=True):
        shape = edge.shape
        assert name.startswith(f"{shape.kind}_") and curve.GetType() == kinds.get(shape.kind, GeomAbs_Ellipse)
        np.testing.assert_allclose(*kernel_points(curve, shape, millimetres), rtol=0, atol=limit)
        # Ours is the sum of chords, short by 4e-5 of itself where there is one chord for a fortieth of a round.
        assert GCPnts_AbscissaPoint.Length_s(curve, limit) == pytest.approx(millimetres * shape.length, rel=1e-4)
        if shape.kind in ("arc", "circle"):
            assert curve.Circle().Radius() == pytest.approx(millimetres * shape.radii[0], rel=1e-12)
        for end, of in zip(edge.vertices, (TopExp.FirstVertex_s, TopExp.LastVertex_s), strict=True):
            vertex = of(body, False)
            assert vertex.IsSame(vertices.setdefault(end, vertex))  # edges that meet share it
            assert BRep_Tool.Tolerance_s(vertex) <= 1e-6 * millimetres * longest_side(wireframe)
    different = list(vertices.values())
    assert not any(a.IsSame(b) for number, a in enumerate(different) for b in different[:number])
