"""Lines, arcs of circles and ellipses, chains of cubics: what they say of themselves agrees with slow twins."""

import numpy as np
import pytest
from placed_shapes import KINDS, PLANE, Placing, any_shape

from taichi_edges.fitting.arcs import Arc, through_three
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.geometry.shapes import EllipticArc, Line, bounds_of, near_bounds, polyline

NAMES = {"long_arc": "arc", "long_elliptic_arc": "elliptic_arc", "loop": "spline"}
HALF_STEP = 1e-6  # of the parameter, over which slow tangents are differences


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def shape(kind, generator):
    return any_shape(kind, generator)


def test_shape_knows_its_kind(shape, kind):
    assert shape.kind == NAMES.get(kind, kind)
    assert shape.closed == (kind in ("circle", "ellipse", "loop"))


def test_length_is_that_of_many_chords(shape):
    chords = np.diff(shape.at(np.linspace(0, 1, 30_001)), axis=0)
    # Both sum chords or exact terms; an ellipse's LENGTH_CHORDS are off by (2 pi / 256)^2 / 24 = 3e-5 at the most.
    assert shape.length == pytest.approx(
        np.linalg.norm(chords, axis=1).sum(), rel=5e-3 if shape.kind == "spline" else 5e-5
    )


def test_ends_are_where_the_parameters_are_0_and_1(shape):
    np.testing.assert_allclose(shape.ends, shape.at(np.array([0.0, 1.0])), atol=1e-15)
    assert np.allclose(*shape.ends, atol=1e-12) == shape.closed


def test_tangents_are_the_slow_ones(shape, generator):
    t = generator.uniform(0.01, 0.99, 50)
    slow = shape.at(t + HALF_STEP) - shape.at(t - HALF_STEP)
    slow /= np.linalg.norm(slow, axis=1, keepdims=True)
    found = shape.tangents(t)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    # Differences of places near 0.5 lose 1e-16 / (2e-6 * length); those over a joint of a chain see its bend.
    assert (np.linalg.norm(found - slow, axis=1) < 1e-5).all()


@pytest.mark.parametrize("parameters", [0.3, np.array([0.1, 0.9]), np.zeros((0,)), np.array([[0.2], [0.4]])])
def test_as_many_places_as_parameters(shape, parameters):
    if np.ndim(parameters) > 1 and shape.kind == "spline":
        parameters = np.ravel(parameters)  # a chain looks its cubics up by a flat list
    assert shape.at(parameters).shape == shape.tangents(parameters).shape == (*np.shape(parameters), 3)


def test_cubics_follow_the_shape_and_each_other(shape):
    cubics = shape.cubics()
    np.testing.assert_array_equal(cubics[1:, 0], cubics[:-1, 3])
    assert not shape.closed or np.array_equal(cubics[0, 0], cubics[-1, 3])
    fine = np.linspace(0, 1, 21)
    places = evaluate_bezier(cubics, fine)
    exact = shape.at((np.arange(len(cubics))[:, None] + fine) / len(cubics)) if shape.kind != "spline" else places
    # A cubic over a quarter round runs 3e-4 of the radius outside; along it, its parameter is off by some percent.
    reach = np.linalg.norm(np.ptp(exact.reshape(-1, 3), axis=0))
    nearest = np.linalg.norm(places.reshape(-1, 1, 3) - shape.at(np.linspace(0, 1, 4001)), axis=2).min(axis=1)
    assert nearest.max() < 3e-4 * reach + shape.length / 4000
    assert np.linalg.norm(places - exact, axis=2).max() < 0.02 * reach


def test_similarity_moves_every_place(shape, generator):
    place, t = Placing(generator), np.linspace(0, 1, 30)
    moved = shape.transformed(place)
    assert moved.kind == shape.kind and moved.closed == shape.closed
    np.testing.assert_allclose(moved.at(t), place(shape.at(t)), atol=1e-12)
    assert moved.length == pytest.approx(place.scale * shape.length, rel=1e-9)


def test_mirrored_shape_is_the_mirror_image(shape):
    t = np.linspace(0, 1, 30)
    moved = shape.transformed(lambda points: points * [1, 1, -1])
    np.testing.assert_allclose(moved.at(t), shape.at(t) * [1, 1, -1], atol=1e-12)


def test_polyline_runs_from_end_to_end_along_the_shape(shape):
    points = polyline(shape, chords=16)
    np.testing.assert_allclose(points[[0, -1]], shape.ends, atol=1e-15)
    assert len(points) == (2 if shape.kind == "line" else 16 * len(shape.cubics()) + 1)
    # Chords of a sixteenth of a quarter round are (pi / 32)^2 / 24 = 4e-4 shorter, at the sharp end of an ellipse four
    # times as much; the random chains turn sharply.
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert length == pytest.approx(shape.length, rel=0.02 if shape.kind == "spline" else 2e-3)


@pytest.mark.parametrize("kind", ["line", "arc", "elliptic_arc"])
@pytest.mark.parametrize("parameter", [-0.1, 1.1])
def test_lines_and_arcs_go_on_beyond_their_ends(generator, kind, parameter):
    shape, wider = any_shape(kind, generator), np.array([-0.2, 1.2])
    longer = Line(shape.at(wider)) if kind == "line" else shape.over(*shape.angles(wider))
    np.testing.assert_allclose(shape.at(parameter), longer.at((parameter + 0.2) / 1.4), atol=1e-12)
    np.testing.assert_allclose(shape.tangents(parameter), longer.tangents((parameter + 0.2) / 1.4), atol=1e-12)


def test_bounds_hold_the_shapes_and_find_what_is_near_them(generator):
    shapes = [any_shape(kind, generator) for kind in KINDS for _ in range(5)]
    bounds, points = bounds_of(shapes), generator.uniform(0.4, 0.6, (4, 3))
    for (low, high), shape in zip(bounds, shapes, strict=True):
        places = shape.at(np.linspace(0, 1, 200))
        assert (places >= low - 1e-12).all() and (places <= high + 1e-12).all()
    gaps = [np.linalg.norm(shape.at(np.linspace(0, 1, 500))[:, None] - points, axis=2).min() for shape in shapes]
    for margin in (0.0, 0.02, 0.1):
        assert set(np.flatnonzero(np.array(gaps) <= margin)) <= set(near_bounds(bounds, points, margin).tolist())
    assert len(near_bounds(bounds, points + 10.0, 0.1)) == len(near_bounds(bounds_of([]), points, 1.0)) == 0


# ----------------------------------------------------------------------------------------------- ellipses and circles


@pytest.mark.parametrize("seed", range(5))
def test_conjugate_diameters_give_the_principal_axes(generator, seed):
    place = Placing(generator)
    diameters = place(generator.uniform(-0.2, 0.2, (2, 3)) * [1, 1, 0]) - place(np.zeros((1, 3)))
    centre, low, high = place(np.zeros((1, 3)))[0], *np.sort(generator.uniform(-4, 4, 2))
    found, t = EllipticArc.conjugate(centre, diameters, low, high), np.linspace(low, high, 40)[:, None]
    expected = centre + np.cos(t) * diameters[0] + np.sin(t) * diameters[1]
    np.testing.assert_allclose(found.at(np.linspace(0, 1, 40)), expected, atol=1e-12)
    assert abs(found.axes[0] @ found.axes[1]) < 1e-12
    np.testing.assert_allclose(found.radii, np.linalg.svd(diameters)[1], rtol=1e-9, atol=1e-12)  # longer first


@pytest.mark.parametrize("swapped", [False, True])
def test_axes_stay_as_they_are_the_longer_one_first(swapped, generator):
    axes = 0.2 * PLANE * [[1.0], [0.4]]
    found = EllipticArc.conjugate(np.zeros(3), axes[::-1] if swapped else axes, 0.0, 2 * np.pi)
    assert found.kind == "ellipse"
    np.testing.assert_allclose(np.abs(found.axes), axes, atol=1e-15)


def test_circle_of_any_two_conjugate_diameters(generator):
    turn = generator.uniform(0, 2 * np.pi)
    diameters = 0.1 * np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0]])
    found = EllipticArc.conjugate(np.zeros(3), diameters, 0.0, 2 * np.pi)
    assert found.kind == "circle" and found.length == pytest.approx(0.2 * np.pi, rel=1e-12)


def test_tangents_turn_about_the_normal(generator):
    arc = any_shape("arc", generator)
    t = np.linspace(0, 1, 9)
    turning = np.cross(arc.at(t) - arc.centre, arc.tangents(t))
    np.testing.assert_allclose(turning, np.tile(arc.radii[0] * arc.normal, (9, 1)), atol=1e-12)


def test_whole_round_is_closed_and_less_is_not(generator):
    circle = any_shape("circle", generator)
    assert circle.over(1.0, 1.0 + 2 * np.pi).closed and not circle.over(1.0, 1.0 + 2 * np.pi - 1e-6).closed


# ------------------------------------------------------------------------------------------------ from arcs to shapes


@pytest.mark.parametrize("angle", [1e-4, 0.1, 1.5, 3.1, 3.3, 5.0, 6.2])
def test_arc_through_three_points_passes_all_of_them(generator, angle):
    place = Placing(generator)
    t = np.array([0.0, generator.uniform(0.2, 0.8), 1.0])
    points = place(0.2 * np.stack([np.cos(angle * t), np.sin(angle * t), 0 * t], axis=1))
    shape = through_three(*points).shape()
    # Three places with errors of 1e-16 say where an arc of 1e-4 radians has its middle to 1e-16, its ends likewise.
    np.testing.assert_allclose(shape.ends, points[[0, 2]], atol=1e-11)
    assert shape.length == pytest.approx(0.2 * place.scale * angle, rel=1e-6)
    middle = shape.at(t[1:2])[0]
    assert np.linalg.norm(middle - points[1]) < 1e-9


def test_no_arc_through_three_points_on_a_line(generator):
    start, end = generator.random((2, 3))
    assert through_three(start, 0.5 * (start + end), end) is None
    assert through_three(start, start, end) is None


@pytest.mark.parametrize("bend", [0.0, 1e-12, 2.0, 20.0])
@pytest.mark.parametrize("closed", [False, True])
def test_shape_of_an_arc_is_where_the_arc_is(generator, bend, closed):
    tangent, inward = np.linalg.qr(generator.normal(size=(3, 2)))[0].T
    arc = Arc(generator.random(3), tangent, bend * inward, -0.03, 0.1)
    if closed and bend > 1:
        arc = arc.over(0.02, 0.02 + arc.round)
    shape, t = arc.shape(), np.linspace(0, 1, 20)
    assert shape.closed == arc.closed and shape.kind == ("line" if bend < 1 else "circle" if closed else "arc")
    np.testing.assert_allclose(shape.at(t), arc.at(arc.low + t * arc.length), atol=1e-12)
    assert shape.length == pytest.approx(arc.length, rel=1e-12)
