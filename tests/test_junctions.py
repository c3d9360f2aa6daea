"""Loose edges whose ends are a little off meet where they should, and nowhere else."""

from itertools import combinations

import numpy as np
import pytest
from edgel_scenes import pixel_everywhere
from placed_shapes import PLANE, Placing, any_shape

from taichi_edges.fitting.distances import distances_to
from taichi_edges.geometry.shapes import EllipticArc, Line, Spline
from taichi_edges.refinement.junctions import MEETING_PX, REACH_PX, connected

PIXEL = 0.0025  # unit-cube units
PIXEL_AT = pixel_everywhere(PIXEL)
SEEDS = range(4)
OFF = 0.15  # pixels: how far places of an edge are off, usually


def line(start, end):
    return Line(np.array([start, end], dtype=float))


def stretched(shape, start, end):
    """A line or an arc, longer by so much at its ends; shorter where that is negative."""
    parameters = np.array([-start, shape.length + end]) / shape.length
    return Line(shape.at(parameters)) if shape.kind == "line" else shape.over(*shape.angles(parameters))


def loosened(shapes, generator, along=3.0, off=OFF):
    """The shapes as fits find them, anywhere: ends off by up to `along` pixels, places by about `off`."""
    place, found = Placing(generator, scale=1.0), []
    for shape in shapes:
        shape = shape if shape.closed else stretched(shape, *generator.uniform(-along, along, 2) * PIXEL)
        step = off * PIXEL * generator.normal(size=3)
        found.append(shape.transformed(place).transformed(lambda points, step=step: points + step))
    return found, place


def box(low, high):
    """The twelve lines of a box, and its (8, 3) corners."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    places = np.asarray(low) + corners * (np.asarray(high) - low)
    pairs = [(i, j) for i, j in combinations(range(8), 2) if np.abs(corners[i] - corners[j]).sum() == 1]
    return [Line(places[list(pair)]) for pair in pairs], places


def check(wireframe, shapes):
    """What holds of every wireframe of some shapes."""
    assert [shape.kind for shape in wireframe.shapes] == [shape.kind for shape in shapes]
    used = sorted({end for edge in wireframe.edges for end in edge.vertices})
    assert used == list(range(len(wireframe.vertices)))
    for edge, before in zip(wireframe.edges, shapes, strict=True):
        assert len(edge.vertices) == len(set(edge.vertices)) == (0 if before.closed else 2)
        if edge.vertices:
            np.testing.assert_allclose(edge.shape.ends, wireframe.vertices[list(edge.vertices)], atol=1e-12)
            assert np.linalg.norm(edge.shape.ends - before.ends, axis=1).max() <= (REACH_PX + 2 * MEETING_PX) * PIXEL
    for vertex, edge in wireframe.contacts:
        assert vertex not in wireframe.edges[edge].vertices
        assert distances_to(wireframe.shapes[edge], wireframe.vertices[vertex : vertex + 1])[0] < MEETING_PX * PIXEL


def nearest(points, wanted):
    """(n,) distances of wanted points to the nearest of others."""
    return np.linalg.norm(np.asarray(wanted)[:, None] - points, axis=2).min(axis=1)


# ------------------------------------------------------------------------------------------------------------ corners


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("along", [0.0, 2.0, 5.0])
def test_cube_closes(generator, along, seed):
    lines, corners = box([-0.15, -0.2, -0.1], [0.15, 0.2, 0.1])
    shapes, place = loosened(lines, generator, along)
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert len(found.vertices) == 8 and (found.degrees == 3).all() and len(found.contacts) == 0
    # Two of the three lines say where a corner is along each axis, each off by OFF: 5.7 standard deviations.
    assert nearest(found.vertices, place(corners)).max() < 4 * OFF * PIXEL


@pytest.mark.parametrize("seed", SEEDS)
def test_thin_plate_closes_on_both_sides(generator, seed):
    """Corners as near to each other as the reach of an end: 6 px."""
    lines, corners = box([-0.15, -0.2, 0], [0.15, 0.2, 6 * PIXEL])
    shapes, place = loosened(lines, generator, 1.5)
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert len(found.vertices) == 8 and (found.degrees == 3).all()
    assert nearest(found.vertices, place(corners)).max() < 4 * OFF * PIXEL


@pytest.mark.parametrize("seed", SEEDS)
def test_exact_corners_stay_exact(generator, seed):
    lines, corners = box([-0.15, -0.2, -0.1], [0.15, 0.2, 0.1])
    shapes, place = loosened(lines, generator, 0.0, 0.0)
    assert nearest(connected(shapes, PIXEL_AT).vertices, place(corners)).max() < 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_order_of_the_edges_does_not_matter(generator, seed):
    shapes, _ = loosened(box([-0.15, -0.2, -0.1], [0.15, 0.2, 0.1])[0], generator)
    order = generator.permutation(12)
    one, other = connected(shapes, PIXEL_AT), connected([shapes[n] for n in order], PIXEL_AT)
    assert nearest(other.vertices, one.vertices).max() < 0.05 * PIXEL


def test_same_twice(generator):
    shapes, _ = loosened(box([-0.15, -0.2, -0.1], [0.15, 0.2, 0.1])[0], generator)
    np.testing.assert_array_equal(connected(shapes, PIXEL_AT).vertices, connected(shapes, PIXEL_AT).vertices)


@pytest.mark.parametrize("gap", [2.5, 3.5])
def test_ends_farther_than_they_reach_stay_free(generator, gap):
    """Two lines across each other, the gap between their ends in reaches."""
    shapes, _ = loosened(
        [line((gap * REACH_PX * PIXEL, 0, 0), (0.3, 0, 0)), line((0, 0, 0), (0, 0.3, 0))], generator, 0, 0
    )
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert (found.degrees == 1).all() and len(found.contacts) == 0
    np.testing.assert_array_equal(found.vertices, np.concatenate([shape.ends for shape in shapes]))


def test_lines_that_pass_each_other_stay_free(generator):
    """Askew, four pixels apart where they come nearest."""
    shapes, _ = loosened([line((0, 0, 0), (0.3, 0, 0)), line((0, 0, 4 * PIXEL), (0, 0.3, 4 * PIXEL))], generator, 0, 0)
    assert (connected(shapes, PIXEL_AT).degrees == 1).all()


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("apart", [3.0, 5.0])
def test_parallel_bars_keep_their_ends(generator, apart, seed):
    """A bar of two parallel lines, each of them closed by a line across at each end, and one beside it."""
    bars = [line((0, y * PIXEL, 0), (0.3, y * PIXEL, 0)) for y in (0, apart)]
    shapes, place = loosened(
        [*bars, line((0, 0, 0), (0, 0, 0.2)), line((0.3, apart * PIXEL, 0), (0.3, 0.2, 0.1))], generator, 1.0
    )
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    for edge, before in zip(found.edges[:2], bars, strict=True):
        assert np.linalg.norm(edge.shape.ends - place(before.points), axis=1).max() < (1.0 + 5 * OFF) * PIXEL
    assert set(found.edges[0].vertices) & set(found.edges[2].vertices)
    assert set(found.edges[1].vertices) & set(found.edges[3].vertices)
    assert not set(found.edges[0].vertices) & set(found.edges[1].vertices)


def test_lines_side_by_side_do_not_meet(generator):
    pair = [line((0, 0, 0), (0.3, 0, 0)), line((0, 0.8 * PIXEL, 0), (0.3, 0.8 * PIXEL, 0))]
    shapes, _ = loosened(pair, generator, 0, 0)
    assert len(connected(shapes, PIXEL_AT).vertices) == 4


@pytest.mark.parametrize("kind", ["line", "arc", "spline"])
def test_no_edge_ends_twice_in_one_vertex(generator, kind):
    """Short edges, whose two ends are nearer to each other than they reach."""
    for shape in (any_shape(kind, generator) for _ in range(5)):
        middle = shape.at(0.5)
        small = shape.transformed(lambda points, s=4 * PIXEL / shape.length: middle + s * (points - middle))
        stem = line(small.ends[0], small.ends[0] + [0.1, 0.2, 0.1])
        found = connected([small, stem, line(small.ends[1], small.ends[1] - [0.2, 0.1, 0.1])], PIXEL_AT)
        assert all(len(set(edge.vertices)) == 2 for edge in found.edges)


# ----------------------------------------------------------------------------------------------------- smooth joints


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("radius", [0.02, 0.05, 0.1])
def test_line_meets_its_fillet_in_the_tangent_point(generator, radius, seed):
    fillet = EllipticArc(np.zeros(3), radius * PLANE, -np.pi / 2, 0.0)
    true = [line((-0.2, -radius, 0), (0, -radius, 0)), fillet, line((radius, 0, 0), (radius, 0.25, 0))]
    shapes, place = loosened(true, generator, 2.0, 0.05)
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert len(found.vertices) == 4 and np.sort(found.degrees).tolist() == [1, 1, 2, 2]
    joints = found.vertices[found.degrees == 2]
    # The arc leaves the line by s^2 / 2 r: within an error e of their places, s = sqrt(2 r e) is the same to them.
    error = np.sqrt(2 * radius * 3 * 0.05 * PIXEL) + PIXEL
    assert nearest(joints, place([[0, -radius, 0], [radius, 0, 0]])).max() < error
    arc = found.shapes[1]
    turns = [arc.tangents(side) @ found.shapes[other].tangents(0.5) for side, other in ((0.0, 0), (1.0, 2))]
    assert np.arccos(np.clip(turns, -1, 1)).max() < error / radius


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("angle", [0.3, 2.0, 3.0, 3.3, 5.0, 6.0])
def test_arc_keeps_its_side(generator, angle, seed):
    """Its ends are moved to those of two lines; arcs of more than half a round do not become the rest of it."""
    arc = EllipticArc(np.zeros(3), 0.1 * PLANE, 0.0, angle)
    lines = [line(end, end + [0, 0, way]) for end, way in zip(arc.ends, (0.2, -0.2), strict=True)]
    shapes, place = loosened([arc, *lines], generator, 2.0)
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert (found.degrees == 2).sum() == 2
    assert found.shapes[0].length == pytest.approx(shapes[0].length, abs=6 * PIXEL)
    middle = arc.transformed(place).at(np.array([0.5]))
    # The middle is off as the arc was, by OFF along each axis, and stays while the ends move: six standard deviations.
    assert distances_to(found.shapes[0], middle)[0] < 6 * OFF * PIXEL


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["spline", "elliptic_arc"])
def test_other_curves_end_exactly_where_they_meet(generator, kind, seed):
    curve = any_shape(kind, generator)
    stems = [line(end, end + way) for end, way in zip(curve.ends, generator.normal(size=(2, 3)), strict=True)]
    for number, stem in enumerate(stems):  # across the curve, so that they do not run on along it
        along = curve.tangents(float(number))
        way = np.cross(along, generator.normal(size=3))
        start = stem.points[0] + generator.uniform(0.2, 3.0) * PIXEL * way / np.linalg.norm(way)
        stems[number] = line(start, start + 0.2 * way / np.linalg.norm(way))
    shapes = [curve, *stems]
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert (found.degrees == 2).sum() == 2
    if kind == "spline":
        np.testing.assert_array_equal(found.shapes[0].ends, found.vertices[list(found.edges[0].vertices)])
    assert distances_to(curve, found.shapes[0].at(np.linspace(0.1, 0.9, 30))).max() < MEETING_PX * PIXEL


# ---------------------------------------------------------------------------------------------------------- contacts


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["line", "arc", "circle", "spline", "loop", "ellipse"])
def test_end_on_the_middle_of_an_edge_is_a_contact(generator, kind, seed):
    touched, t = Line(np.zeros((2, 3))), generator.uniform(0.35, 0.65)
    while touched.length < 24 * PIXEL:  # nearer to its ends than they reach, these would meet
        touched = any_shape(kind, generator)
    place, along = touched.at(np.array([t]))[0], touched.tangents(t)
    far = place
    while distances_to(touched, far[None])[0] < 24 * PIXEL:  # the far end must not meet it as well
        way = np.cross(along, generator.normal(size=3))
        way /= np.linalg.norm(way)
        far = place + 0.3 * way
    start = place + generator.uniform(-4, 4) * PIXEL * way
    found = connected([touched, line(start, far)], PIXEL_AT)
    check(found, [touched, line(start, far)])
    vertex, edge = found.contacts[0]
    assert len(found.contacts) == 1 and edge == 0 and vertex == found.edges[1].vertices[0]
    assert np.linalg.norm(found.vertices[vertex] - place) < PIXEL and found.degrees[vertex] == 2


@pytest.mark.parametrize("seed", SEEDS)
def test_corner_on_a_face_of_another_part_is_one_contact(generator, seed):
    """Two lines meet in a third one, between its ends."""
    true = [line((-0.2, 0, 0), (0.2, 0, 0)), line((0, 0, 0), (0, 0.2, 0)), line((0, 0, 0), (0.05, 0, 0.2))]
    shapes, _place = loosened(true, generator, 2.0, 0.1)
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert len(found.vertices) == 5 and len(found.contacts) == 1 and found.contacts[0, 1] == 0
    assert found.degrees[found.contacts[0, 0]] == 3


def test_end_near_nothing_is_free(generator):
    shapes = [line((0, 0, 0), (0.3, 0, 0)), line((0.1, 12 * PIXEL, 0), (0.1, 0.2, 0))]
    found = connected(shapes, PIXEL_AT)
    assert len(found.contacts) == 0 and (found.degrees == 1).all()


@pytest.mark.parametrize("shapes", [[], [any_shape("circle", np.random.default_rng(0))], [Line(np.eye(3)[:2])]])
def test_hardly_anything_to_connect(shapes):
    found = connected(shapes, PIXEL_AT)
    check(found, shapes)
    assert found.vertices.shape == (2 * sum(not shape.closed for shape in shapes), 3)
    assert len(found) == len(shapes) and found.contacts.shape == (0, 2)


def test_closed_spline_stays_as_it_is(generator):
    loop = any_shape("loop", generator)
    assert isinstance(loop, Spline) and connected([loop], PIXEL_AT).shapes == [loop]
