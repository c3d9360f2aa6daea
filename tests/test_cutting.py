"""Strokes cut into straight and bent stretches, and the shapes of these."""

from itertools import pairwise

import numpy as np
import pytest

from taichi_edges.fitting.model_selection import Yardstick
from taichi_edges.strokes.assembly import assemble_strokes, fit_strokes
from taichi_edges.strokes.cutting import cut_stroke, shape_of_stretch, step_length, track_through

PIXEL = 1 / 400
YARDSTICK = Yardstick(0.3 * PIXEL, PIXEL)
NOISE = 0.1 * PIXEL


def straight(start, along, length):
    """Points a pixel apart from a start on, px; the end is left out."""
    return np.asarray(start, float) + np.arange(length)[:, None] * np.asarray(along, float)


def bend(centre, radius, first, last):
    """Points a pixel apart along an arc, px, angles in radians."""
    angles = first + np.arange(0, abs(last - first), 1 / radius) * np.sign(last - first)
    return np.asarray(centre) + radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])


def noisy(generator, *parts):
    """Points in the unit cube of parts in pixels, off by the noise, turned into some direction."""
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    points = PIXEL * np.concatenate(parts) @ turn.T + 0.5
    return points + NOISE * generator.normal(size=points.shape)


def slot(generator, radius=40, length=60):
    """A line, a quarter of a circle that is tangent to it, and a line; and where these begin and end."""
    parts = (
        straight([-length, -radius, 0], [1, 0, 0], length),
        bend([0, 0, 0], radius, -np.pi / 2, 0),
        straight([radius, 0, 0], [0, 1, 0], length),
    )
    return noisy(generator, *parts), np.cumsum([0, *map(len, parts)])


def test_line_arc_line_is_cut_at_the_joints(generator):
    points, bounds = slot(generator)
    stretches = cut_stroke(points, YARDSTICK)
    found = [stretches[0].start, *(stretch.stop for stretch in stretches)]
    # Where a tangent arc leaves its line by less than the noise, nobody can tell: x^2 / 2 r = 0.3 px for x = 5 px.
    assert len(stretches) == 3 and np.abs(np.array(found) - bounds).max() <= 8
    shapes = [shape_of_stretch(points[stretch], YARDSTICK) for stretch in stretches]
    assert [shape.kind for shape in shapes] == ["line", "arc", "line"]
    assert shapes[1].radii == pytest.approx(40 * PIXEL, rel=0.15)


def test_a_corner_is_a_cut(generator):
    points = noisy(generator, straight([-50, 0, 0], [1, 0, 0], 50), straight([0, 0, 0], [0, 1, 0], 30))
    one, other = cut_stroke(points, YARDSTICK)
    assert abs(one.stop - 50) <= 2 and one.stop == other.start
    assert all(shape_of_stretch(points[part], YARDSTICK).kind == "line" for part in (one, other))


def test_a_straight_stroke_stays_whole_whichever_way_it_runs(generator):
    points = noisy(generator, straight([0, 0, 0], [1, 0, 0], 200))
    for some in (points, points[::-1]):
        assert cut_stroke(some, YARDSTICK) == [slice(0, 200)]
        assert shape_of_stretch(some, YARDSTICK).length == pytest.approx(199 * PIXEL, rel=0.01)


@pytest.mark.parametrize("radius", [10, 30, 100])
def test_a_circle_comes_back_closed(generator, radius):
    points = noisy(generator, bend([0, 0, 0], radius, 0, 2 * np.pi))
    circle = shape_of_stretch(points, YARDSTICK)
    assert track_through(points, PIXEL).closed and circle.closed and circle.kind == "circle"
    assert circle.radii == pytest.approx(radius * PIXEL, rel=0.01)
    half = shape_of_stretch(points[: len(points) // 2], YARDSTICK)
    assert not half.closed and half.kind == "arc"


@pytest.mark.parametrize("radius", [10, 30, 100])
def test_stretches_of_a_circle_are_arcs_of_it(generator, radius):
    points = noisy(generator, bend([0, 0, 0], radius, 0, 2 * np.pi))
    shapes = [shape_of_stretch(points[stretch], YARDSTICK) for stretch in cut_stroke(points, YARDSTICK)]
    assert len(shapes) <= 5 and all(shape.kind in ("arc", "circle") for shape in shapes)
    assert np.array([shape.radii for shape in shapes]) == pytest.approx(radius * PIXEL, rel=0.1)


def test_stretches_follow_each_other_without_a_gap(generator):
    points = noisy(generator, bend([0, 0, 0], 20, 0, 4), straight([30, 0, 0], [0, 0, 1], 25), np.zeros((1, 3)))
    stretches = cut_stroke(points, YARDSTICK)
    assert stretches[0].start == 0 and stretches[-1].stop == len(points)
    assert all(one.stop == other.start for one, other in pairwise(stretches))


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_hardly_any_points_are_one_stretch_and_no_edge_if_too_short(count):
    points = PIXEL * straight([0, 0, 0], [0.2, 0, 0], count)
    assert cut_stroke(points, YARDSTICK) == [slice(0, count)]
    assert shape_of_stretch(points, YARDSTICK) is None
    assert step_length(points) >= 0


def test_strokes_become_the_edges_of_their_stretches(generator):
    points, _ = slot(generator)
    circle = noisy(generator, bend([0, 0, 0], 30, 0, 2))
    every, strokes = np.concatenate([points, circle]), np.repeat([0, 4], [len(points), len(circle)])
    pixels = np.full(len(every), PIXEL)
    clusters = assemble_strokes(every, np.tile([1.0, 0, 0], (len(every), 1)), strokes, pixels, YARDSTICK)
    assert (
        clusters.noise_px == pytest.approx(YARDSTICK.noise / PIXEL)
        and len(clusters.arcs) == 4
        and (np.diff(clusters.labels) >= 0).all()
    )
    edges, counts = fit_strokes(clusters, pixels)
    assert (counts["line"], counts["curve"], len(edges)) == (2, 2, 4)


def kinds_and_counts(parts, pixels):
    """The kinds of the edges of strokes, and the number of points of each. pixels: (n,) size of one at each point."""
    points, strokes = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    clusters = assemble_strokes(points, np.tile([1.0, 0, 0], (len(points), 1)), strokes, pixels, YARDSTICK)
    kinds = [shape.kind for shape in fit_strokes(clusters, pixels)[0].shapes]
    return kinds, np.bincount(clusters.labels).tolist()


def test_a_stroke_twice_as_far_is_cut_and_fitted_as_the_near_one(generator):
    """All is twice as large there, noise as well: the views show the same. With one pixel for both, noise is a bend."""
    near, _ = slot(generator)
    near += 3 * NOISE * generator.normal(size=near.shape)
    parts, pixels = [near, 2 * near], np.repeat([PIXEL, 2 * PIXEL], len(near))
    kinds, counts = kinds_and_counts(parts, pixels)
    assert kinds == ["line", "arc", "line"] * 2 and counts[:3] == counts[3:]
    assert len(kinds_and_counts(parts, np.full(2 * len(near), PIXEL))[0]) > 6
