"""Wireframes: edges that share vertices, what is left when some go, and the file that holds them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from placed_shapes import KINDS, Placing, any_shape

from taichi_edges.errors import UserError
from taichi_edges.geometry.edge_set import EdgeSet, write_edges
from taichi_edges.geometry.shapes import Line, Spline
from taichi_edges.geometry.wireframe import (
    Edge,
    Evidence,
    Wireframe,
    read_wireframe,
    wireframe_and_about,
    write_wireframe,
)

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SEEN = Evidence(7, 0.25, 0.1 + 0.2, 1 / 3)  # numbers that a few decimals would not keep


@pytest.fixture
def square():
    """Four lines round a square, and a fifth from the middle of the first one to nowhere."""
    vertices = np.concatenate([SQUARE, [[0.5, 0, 0], [0.5, 0, 1]]])
    pairs = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5)]
    edges = tuple(Edge(Line(vertices[list(pair)]), pair) for pair in pairs)
    return Wireframe(vertices, edges, np.array([[4, 0]]))


@pytest.fixture
def mixed(generator):
    """A loose edge of every kind in no order, some with Evidence, the first one's end on the third one."""
    kinds = generator.permutation(KINDS).tolist()
    loose = Wireframe.loose([any_shape(kind, generator) for kind in ["line", *kinds, "line"]])
    edges = [replace(edge, evidence=SEEN if number % 2 else None) for number, edge in enumerate(loose.edges)]
    return replace(loose, edges=tuple(edges), contacts=np.array([[0, 2]]))


def same(one, other):
    """Are two wireframes the same, bit for bit?"""
    equal = np.array_equal(one.vertices, other.vertices) and np.array_equal(one.contacts, other.contacts)
    edges = zip(one.edges, other.edges, strict=True)
    return equal and all(a.vertices == b.vertices and a.evidence == b.evidence and alike(a, b) for a, b in edges)


def alike(edge, other):
    """Are two shapes the same, bit for bit?"""
    one, two = vars(edge.shape), vars(other.shape)
    fields = type(edge.shape).__dataclass_fields__
    return type(edge.shape) is type(other.shape) and all(np.array_equal(one[name], two[name]) for name in fields)


# ------------------------------------------------------------------------------------------------------------- graph


def test_loose_edges_end_in_vertices_of_their_own(mixed):
    ends = [end for edge in mixed.edges for end in edge.vertices]
    assert sorted(ends) == list(range(len(mixed.vertices)))
    for edge in mixed.edges:
        assert len(edge.vertices) == (0 if edge.shape.closed else 2)
        if edge.vertices:
            np.testing.assert_array_equal(mixed.vertices[list(edge.vertices)], edge.shape.ends)


def test_no_shapes_are_an_empty_wireframe(tmp_path):
    nothing = Wireframe.loose([])
    assert len(nothing) == 0 and nothing.vertices.shape == (0, 3) and len(nothing.degrees) == 0
    assert len(nothing.edge_set()) == 0 and len(nothing.keep(np.zeros(0, bool))) == 0
    assert len(nothing.transformed(lambda points: points, 1.0)) == 0
    write_wireframe(tmp_path / "edges.json", nothing, {})
    assert same(read_wireframe(tmp_path / "edges.json"), nothing)


def test_degree_counts_ends_and_edges_passing_by(square):
    np.testing.assert_array_equal(square.degrees, [2, 2, 2, 2, 2, 1])


def test_kept_edges_keep_their_vertices_and_no_others(square):
    kept = square.keep(np.array([True, False, False, True, True]))
    assert len(kept) == 3 and len(kept.vertices) == 5  # the corner where both others met is gone
    for edge in kept.edges:
        np.testing.assert_array_equal(kept.vertices[list(edge.vertices)], edge.shape.ends)
    np.testing.assert_array_equal(kept.vertices[kept.contacts[:, 0]], [[0.5, 0, 0]])
    np.testing.assert_array_equal(kept.contacts[:, 1], [0])


@pytest.mark.parametrize("gone", [0, 4])
def test_contact_goes_with_either_of_its_edges(square, gone):
    kept = square.keep(np.arange(5) != gone)
    assert len(kept.contacts) == 0 and kept.contacts.shape == (0, 2)


def test_all_kept_is_the_same(mixed):
    assert same(mixed.keep(np.ones(len(mixed), bool)), mixed)


def test_sources_of_the_edge_set_are_the_edges(mixed):
    edges = mixed.edge_set()
    for number, shape in enumerate(mixed.shapes):
        if shape.kind == "line":
            np.testing.assert_array_equal(edges.lines[edges.line_sources == number], [shape.points])
        else:
            np.testing.assert_array_equal(edges.curves[edges.curve_sources == number], shape.cubics())
    assert len(edges.lines) + len(edges.curves) == sum(len(shape.cubics()) for shape in mixed.shapes)


def test_similarity_moves_vertices_with_shapes_and_lengths_with_the_scale(mixed, generator):
    place = Placing(generator)
    moved = mixed.transformed(place, place.scale)
    for before, after in zip(mixed.edges, moved.edges, strict=True):
        assert after.shape.length == pytest.approx(place.scale * before.shape.length, rel=1e-9)
        if after.vertices:
            np.testing.assert_allclose(after.shape.ends, moved.vertices[list(after.vertices)], atol=1e-12)
        if before.evidence:
            longer = before.evidence.supported_length * place.scale
            assert after.evidence == replace(before.evidence, supported_length=longer)
    np.testing.assert_array_equal(moved.contacts, mixed.contacts)


# -------------------------------------------------------------------------------------------------------------- file


def test_file_keeps_every_bit(mixed, tmp_path):
    write_wireframe(tmp_path / "edges.json", mixed, {"counts": {"line": 3}})
    found, rest = wireframe_and_about(tmp_path / "edges.json")
    assert same(found, mixed) and rest["counts"] == {"line": 3}


def test_written_twice_is_the_same_file(mixed, tmp_path):
    write_wireframe(tmp_path / "one.json", mixed, {})
    write_wireframe(tmp_path / "two.json", read_wireframe(tmp_path / "one.json"), {})
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_readers_of_emaps_files_find_all_edges(mixed, tmp_path):
    write_wireframe(tmp_path / "edges.json", mixed, {})
    content = json.loads((tmp_path / "edges.json").read_text())
    edges = mixed.edge_set()
    np.testing.assert_array_equal(content["lines_end_pts"], edges.lines)
    np.testing.assert_array_equal(content["curves_ctl_pts"], edges.curves)


def test_emaps_file_is_loose_edges(tmp_path, generator):
    lines, curves = generator.random((3, 2, 3)), generator.random((2, 4, 3))
    (tmp_path / "edges.json").write_text(
        json.dumps({"lines_end_pts": lines.tolist(), "curves_ctl_pts": curves.tolist()})
    )
    found, rest = wireframe_and_about(tmp_path / "edges.json")
    assert [shape.kind for shape in found.shapes] == ["line"] * 3 + ["spline"] * 2 and not rest
    np.testing.assert_array_equal([shape.points for shape in found.shapes[:3]], lines)
    np.testing.assert_array_equal([shape.curves[0] for shape in found.shapes[3:]], curves)
    assert len(found.vertices) == 10 and (found.degrees == 1).all()


def test_pieces_of_one_source_are_one_edge(tmp_path, generator):
    chain, loop = (any_shape(kind, generator).curves for kind in ("spline", "loop"))
    sources = np.repeat([7, 2], [len(chain), len(loop)])
    edges = EdgeSet(np.zeros((0, 2, 3)), np.concatenate([chain, loop]), np.zeros(0, np.int64), sources)
    write_edges(tmp_path / "edges.json", edges, {})
    found = read_wireframe(tmp_path / "edges.json")
    assert [shape.closed for shape in found.shapes] == [False, True]
    np.testing.assert_array_equal(found.shapes[0].curves, chain)
    np.testing.assert_array_equal(found.shapes[1].curves, loop)


def line_content():
    """A file of two lines that meet, as JSON values; and the key of an edge that has none."""
    edges = [{"kind": "line", "vertices": [0, 1]}, {"kind": "line", "vertices": [1, 2]}]
    return {
        "curves_ctl_pts": [],
        "lines_end_pts": SQUARE[[[0, 1], [1, 2]]].tolist(),
        "line_sources": [0, 1],
        "curve_sources": [],
        "vertices": SQUARE[:3].tolist(),
        "edges": edges,
        "contacts": [],
    }


ARC_KEYS = {"kind": "arc", "vertices": [0, 1], "centre": [0, 0, 0], "half_axes": [[1, 0, 0], [0, 1, 0]]}
SPLINE = {"kind": "spline", "vertices": [0, 1], "closed": False}
DAMAGES = {
    "no vertices": {"vertices": None},
    "vertices of two numbers": {"vertices": [[0, 0], [1, 1]]},
    "a word for a vertex": {"vertices": [["a", 0, 0]]},
    "a vertex too few": {"vertices": SQUARE[:2].tolist()},
    "no contacts": {"contacts": None},
    "a contact of three": {"contacts": [[0, 1, 2]]},
    "a contact with no edge": {"contacts": [[0, 2]]},
    "a contact with a negative edge": {"contacts": [[0, -1]]},
    "a contact of no vertex": {"contacts": [[3, 0]]},
    "an edge without kind": {"edges": [{"vertices": [0, 1]}] * 2},
    "an edge that is a number": {"edges": [1, 2]},
    "an edge without vertices": {"edges": [{"kind": "line"}] * 2},
    "an edge that ends in one vertex": {"edges": [{"kind": "line", "vertices": [0]}] * 2},
    "an edge that ends in a half": {"edges": [{"kind": "line", "vertices": [0, 0.5]}] * 2},
    "an edge that ends in words": {"edges": [{"kind": "line", "vertices": ["a", "b"]}] * 2},
    "a negative vertex": {"edges": [{"kind": "line", "vertices": [0, -1]}] * 2},
    "an unknown kind": {"edges": [{"kind": "conic", "vertices": [0, 1]}] * 2},
    "more edges than points": {"edges": [{"kind": "line", "vertices": [0, 1]}] * 3},
    "a spline without cubics": {"edges": [SPLINE, SPLINE]},
    "an arc without angles": {"edges": [ARC_KEYS] * 2},
    "an arc of three angles": {"edges": [ARC_KEYS | {"angles_rad": [0, 1, 2]}] * 2},
    "angles that are words": {"edges": [ARC_KEYS | {"angles_rad": ["a", "b"]}] * 2},
    "an arc of three axes": {"edges": [ARC_KEYS | {"half_axes": np.eye(3).tolist(), "angles_rad": [0, 1]}] * 2},
    "a centre of two numbers": {"edges": [ARC_KEYS | {"centre": [0, 0], "angles_rad": [0, 1]}] * 2},
    "half the evidence": {"edges": [{"kind": "line", "vertices": [0, 1], "confidence": 1.0}] * 2},
}


def test_the_undamaged_file_is_read(tmp_path):
    (tmp_path / "edges.json").write_text(json.dumps(line_content()))
    assert len(read_wireframe(tmp_path / "edges.json")) == 2


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_file_is_refused_in_one_line_that_names_it(tmp_path, damage):
    content = line_content() | DAMAGES[damage]
    content = {key: value for key, value in content.items() if value is not None}
    (tmp_path / "edges.json").write_text(json.dumps(content))
    with pytest.raises(UserError) as error:
        read_wireframe(tmp_path / "edges.json")
    assert str(error.value).startswith(f"{tmp_path / 'edges.json'}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"edges": []}'])
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "edges.json").write_text(text)
    with pytest.raises(UserError, match="edges.json: not an edge file"):
        read_wireframe(tmp_path / "edges.json")


def test_closed_spline_has_no_vertices(generator):
    loop = any_shape("loop", generator)
    assert isinstance(loop, Spline) and Wireframe.loose([loop]).edges[0].vertices == ()
