"""Free ends follow what the images show: no less, no farther, and never round into the edge itself."""

import numpy as np
import pytest
from edgel_scenes import pixel_everywhere
from placed_shapes import PLANE, Placing, any_shape

from taichi_edges.fitting.distances import distances_to
from taichi_edges.geometry.shapes import EllipticArc, Line
from taichi_edges.refinement import extents
from taichi_edges.refinement.extents import AHEAD_PX, LOST_PX, ROUNDS

PIXEL = 0.0025  # unit-cube units
SEEDS = range(3)


def extended(shape, sides, seen):
    """One shape alone."""
    return extents.extended([shape], [sides], lambda numbers, places: [seen(*places[0])], pixel_everywhere(PIXEL))[0]


def views_of(*shown, views=10.0):
    """`seen` of images that show the shapes and nothing else."""

    def seen(shape, parameters):
        places = shape.at(parameters)
        return np.where(np.min([distances_to(one, places) for one in shown], axis=0) < 0.5 * PIXEL, views, 0.0)

    return seen


def part(shape, low, high):
    """The part of a line or an arc between two parameters."""
    wanted = np.array([low, high])
    return Line(shape.at(wanted)) if shape.kind == "line" else shape.over(*shape.angles(wanted))


@pytest.fixture(params=["line", "arc"])
def whole(request, generator):
    """A line, or an arc of two radians, 0.3 long, anywhere."""
    line, arc = Line(0.3 * PLANE[:1] * [[0], [1]]), EllipticArc(np.zeros(3), 0.15 * PLANE, 0.0, 2.0)
    return (line if request.param == "line" else arc).transformed(Placing(generator, scale=1.0))


@pytest.mark.parametrize("seed", SEEDS)
def test_ends_go_as_far_as_the_images_show(whole, generator, seed):
    low, high = generator.uniform(0.05, 0.3), generator.uniform(0.6, 0.95)
    found = extended(part(whole, low, high), (0, 1), views_of(whole))
    assert found.kind == whole.kind
    # Looked at every pixel, and the places shown are those within half a pixel.
    assert np.linalg.norm(found.ends - whole.ends, axis=1).max() < 1.6 * PIXEL


@pytest.mark.parametrize("side", [0, 1])
def test_other_end_stays(whole, side):
    start = part(whole, 0.3, 0.7)
    found = extended(start, (side,), views_of(whole))
    np.testing.assert_allclose(found.ends[1 - side], start.ends[1 - side], atol=1e-12)
    assert np.linalg.norm(found.ends[side] - whole.ends[side]) < 1.6 * PIXEL


def test_extended_edge_lies_where_it_did(whole):
    found = extended(part(whole, 0.3, 0.7), (0, 1), views_of(whole))
    assert distances_to(whole, found.at(np.linspace(0.02, 0.98, 50))).max() < 1e-12


def test_nothing_ahead_nothing_changes(whole):
    start = part(whole, 0.3, 0.7)
    found = extended(start, (0, 1), views_of(start))
    assert np.linalg.norm(found.ends - start.ends, axis=1).max() < 1.01 * PIXEL
    assert extended(start, (), views_of(whole)) is start


@pytest.mark.parametrize("gap", [LOST_PX - 2, LOST_PX + 2])
def test_short_losses_are_bridged_and_long_ones_are_ends(whole, gap):
    lost = gap * PIXEL / whole.length
    seen = views_of(part(whole, 0, 0.6), part(whole, 0.6 + lost, 1))
    found = extended(part(whole, 0.0, 0.5), (1,), seen)
    wanted = whole if gap < LOST_PX else part(whole, 0, 0.6)
    assert np.linalg.norm(found.ends[1] - wanted.ends[1]) < 1.6 * PIXEL


def test_long_way_takes_several_rounds_but_not_for_ever(generator):
    line = Line(np.array([[0.0, 0, 0], [0.1, 0, 0]])).transformed(Placing(generator, scale=1.0))
    everywhere = Line(line.at(np.array([-20.0, 20.0])))
    found = extended(line, (1,), views_of(everywhere))
    assert found.length == pytest.approx(0.1 + ROUNDS * AHEAD_PX * PIXEL, abs=2 * PIXEL)


def test_fewer_views_than_a_quarter_of_the_usual_ones_show_nothing(whole):
    start = part(whole, 0.3, 0.7)
    strong, weak = views_of(start, views=12.0), views_of(whole, views=2.0)
    found = extended(start, (0, 1), lambda *of: np.maximum(strong(*of), weak(*of)))
    assert found.length < start.length + 2.1 * PIXEL


@pytest.mark.parametrize("angle", [4.0, 5.5, 6.2])
def test_arc_does_not_run_into_itself(generator, angle):
    arc = EllipticArc(np.zeros(3), 0.04 * PLANE, 0.0, angle).transformed(Placing(generator, scale=1.0))
    found = extended(arc, (0, 1), views_of(arc.over(0, 2 * np.pi)))
    assert arc.length <= found.length < 2 * np.pi * 0.04 and not found.closed


@pytest.mark.parametrize("kind", ["circle", "ellipse", "elliptic_arc", "spline", "loop"])
def test_other_shapes_stay_as_they_are(generator, kind):
    shape = any_shape(kind, generator)
    assert extended(shape, (0, 1), lambda shape, parameters: np.full(len(parameters), 10.0)) is shape
