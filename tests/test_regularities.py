"""Relations between edges: found within what the images can tell, made exact, and left alone where they do not hold."""

from itertools import combinations

import numpy as np
import pytest
from edgel_scenes import either_errors, views_of

from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.geometry.shapes import EllipticArc, Line
from taichi_edges.geometry.wireframe import Edge, Wireframe
from taichi_edges.refinement.adjustment import adjusted
from taichi_edges.refinement.regularities import KINDS, regularised

TURN = np.linalg.qr(np.array([[0.8, 0.1, -0.2], [0.3, 0.9, 0.1], [0.1, -0.4, 0.7]]))[0]  # the box is aligned to nothing
NOISE_PX = 0.15


def box(lean=0.0):
    """The twelve edges of a box, of which one upright leans over by an angle, as a Wireframe."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.25, 0.2, 0.15]
    corners[1] += [0.3 * np.tan(lean), 0.0, 0.0]  # the upper end of the upright at -x, -y
    pairs = [(a, b) for a, b in combinations(range(8), 2) if (a ^ b).bit_count() == 1]
    vertices = corners @ TURN.T + 0.5
    edges = tuple(Edge(Line(vertices[list(pair)]), pair) for pair in pairs)
    return Wireframe(vertices, edges, np.zeros((0, 2), np.int64))


def rims(radii, centres):
    """Horizontal circles as a Wireframe."""
    axes = np.eye(3)[:2]
    shapes = [EllipticArc(np.array(c), r * axes, 0.0, 2 * np.pi) for r, c in zip(radii, centres, strict=True)]
    return Wireframe.loose(shapes)


def seen(wireframe, generator, errors="white"):
    """EdgelMatching of noisy views of a wireframe, and the wireframe as they show it."""
    curves = [lambda s, shape=shape: shape.at(np.asarray(s)) for shape in wireframe.shapes]
    matching = EdgelMatching(views_of(curves, generator, noise_px=NOISE_PX, count=12, errors=errors))
    return matching, adjusted(wireframe, matching)


def angles(wireframe):
    """(n, n) radians between the lines, 0 to a right angle."""
    directions = np.array([shape.tangents(0.5) for shape in wireframe.shapes])
    return np.arctan2(
        np.linalg.norm(np.cross(directions[:, None], directions), axis=2), np.abs(directions @ directions.T)
    )


def from_right(wireframe):
    """(n, n) radians by which the lines are off from parallel or perpendicular, whichever is nearer."""
    found = angles(wireframe)
    return np.minimum(found, np.pi / 2 - found)


@either_errors("true right angles are refused in 20 of 40 draws")
def test_noisy_box_becomes_exactly_rectangular(taichi, generator, errors):
    true = box()
    matching, noisy = seen(true, generator, errors=errors)
    regular, counts = regularised(noisy, matching)
    assert from_right(noisy).max() > 1e-4
    assert from_right(regular).max() < 1e-6
    assert set(counts) == set(KINDS)
    found, imposed = counts["parallel"]
    assert found == 18 and imposed <= 9  # three groups of four; what others imply is not imposed once more
    for edge in regular.edges:
        np.testing.assert_array_equal(edge.shape.ends, regular.vertices[list(edge.vertices)])
    before, after = (np.linalg.norm(some.vertices - true.vertices, axis=1).mean() for some in (noisy, regular))
    assert after < before


@either_errors("0.1 degrees off, or true relations refused, in 8 of 40 draws")
def test_leaning_edge_is_left_alone(taichi, generator, errors):
    true = box(lean=np.radians(2.0))
    matching, noisy = seen(true, generator, errors=errors)
    regular, _counts = regularised(noisy, matching)
    expected = from_right(true)
    np.testing.assert_allclose(from_right(regular), expected, atol=np.radians(0.1))
    assert (from_right(regular)[expected == 0] < 1e-6).mean() > 0.5  # the rest of the box is made exact
    assert np.linalg.norm(regular.vertices - true.vertices, axis=1).max() < 0.1 * matching.pixel


@either_errors("equal radii are refused in 3 of 40 draws")
def test_equal_radii(taichi, generator, errors):
    true = rims((0.1, 0.1, 0.13), ([0.3, 0.3, 0.4], [0.7, 0.6, 0.4], [0.3, 0.7, 0.4]))
    matching, noisy = seen(true, generator, errors=errors)
    regular, counts = regularised(noisy, matching)
    radii = [shape.radii.mean() for shape in regular.shapes]
    assert radii[0] == pytest.approx(radii[1], abs=1e-8) and radii[2] == pytest.approx(0.13, abs=1e-3)
    assert counts["equal_radius"] == (1, 1) and counts["coaxial"] == (0, 0)
    normals = np.array([shape.normal for shape in regular.shapes])
    assert np.linalg.norm(np.cross(normals[0], normals[1:]), axis=1).max() < 1e-6
    heights = [shape.centre @ normals[0] for shape in regular.shapes]
    assert np.ptp(heights) < 1e-8 and counts["coplanar"][0] == 2


@either_errors("they differ by 0.0025, not by 0.003 within 0.0005, in 1 of 40 draws")
def test_radii_that_differ_stay_different(taichi, generator, errors):
    true = rims((0.1, 0.103), ([0.3, 0.3, 0.4], [0.7, 0.6, 0.4]))  # by half a pixel of these views
    matching, noisy = seen(true, generator, errors=errors)
    regular, counts = regularised(noisy, matching)
    assert counts["equal_radius"] == (0, 0)
    assert np.diff([shape.radii.mean() for shape in regular.shapes]) == pytest.approx(0.003, abs=5e-4)


@either_errors()
def test_coaxial_rims(taichi, generator, errors):
    true = rims((0.1, 0.2), ([0.5, 0.5, 0.4], [0.5, 0.5, 0.6]))
    matching, noisy = seen(true, generator, errors=errors)
    regular, counts = regularised(noisy, matching)
    first, second = regular.shapes
    assert counts["coaxial"] == (1, 1) and counts["coplanar"] == (0, 0)
    assert np.linalg.norm(np.cross(first.normal, second.centre - first.centre)) < 1e-8


def test_nothing_to_relate(taichi, generator):
    matching, noisy = seen(rims((0.1,), ([0.5, 0.5, 0.5],)), generator)
    regular, counts = regularised(noisy, matching)
    assert regular is noisy and set(counts.values()) == {(0, 0)}
    empty = Wireframe.loose([])
    assert regularised(empty, matching)[0] is empty
