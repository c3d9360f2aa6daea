"""Small whole circles are found from points with directions, whatever strokes these come in; nothing else is."""

import numpy as np
import pytest

from taichi_edges.fitting.model_selection import Yardstick
from taichi_edges.strokes.assembly import assemble_strokes, fit_strokes
from taichi_edges.strokes.small_circles import small_circles

PIXEL = 1 / 400
YARDSTICK = Yardstick(0.35 * PIXEL, PIXEL)
CENTRE = np.array([0.4, 0.5, 0.6])


def ring(generator, radius_px, pieces, share=1.0, noise_px=0.12):
    """Points about 0.7 px apart along a circle, in so many strokes, of a share of it; with directions and strokes."""
    frame = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    count = max(int(share * 2 * np.pi * radius_px / 0.7), 6)
    angles = np.linspace(0, share * 2 * np.pi, count, endpoint=False)
    points = CENTRE + radius_px * PIXEL * (np.cos(angles)[:, None] * frame[0] + np.sin(angles)[:, None] * frame[1])
    ways = -np.sin(angles)[:, None] * frame[0] + np.cos(angles)[:, None] * frame[1]
    ways = ways * generator.choice([-1, 1], size=(count, 1)) + 0.1 * generator.normal(size=(count, 3))
    points = points + noise_px * PIXEL * generator.normal(size=points.shape)
    return points, ways / np.linalg.norm(ways, axis=1, keepdims=True), np.arange(count) * pieces // count


def found_among(points, ways, strokes, pixel=PIXEL):
    """Small circles where all pixels are of one size."""
    return small_circles(points, ways, strokes, np.full(len(points), pixel), YARDSTICK)


@pytest.mark.parametrize("pieces", [1, 3])
@pytest.mark.parametrize("radius_px", [1.5, 3.0, 7.0])
def test_a_small_circle_is_found_in_pieces_and_whole(generator, radius_px, pieces):
    points, ways, strokes = ring(generator, radius_px, pieces)
    (circle, members), *others = found_among(points, ways, strokes)
    assert not others and circle.closed and len(members) >= 0.8 * len(points)
    assert 1 / circle.curvature == pytest.approx(radius_px * PIXEL, rel=0.1)
    middle = circle.at(np.linspace(circle.low, circle.high, 40, endpoint=False)).mean(axis=0)
    assert np.linalg.norm(middle - CENTRE) < 0.2 * PIXEL


def test_a_circle_twice_as_far_may_be_twice_as_large(generator):
    points, ways, strokes = ring(generator, 6.0, 3)
    assert len(found_among(2 * points, ways, strokes, 2 * PIXEL)) == 1 and not found_among(2 * points, ways, strokes)


def test_circles_one_above_the_other_are_two(generator):
    points, ways, strokes = ring(generator, 3.0, 2)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    lower = points - 4 * PIXEL * normal
    both = found_among(
        np.concatenate([points, lower]), np.concatenate([ways, ways]), np.concatenate([strokes, strokes + 2])
    )
    assert len(both) == 2 and not set(both[0][1]) & set(both[1][1])


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_an_arc_is_no_circle(generator, share):
    assert found_among(*ring(generator, 5.0, 1, share)) == []


def test_a_square_of_eight_pixels_is_no_circle(generator):
    along = np.arange(-4, 4, 0.7)
    sides = [np.column_stack([along, np.full(len(along), 4.0)]), np.column_stack([np.full(len(along), 4.0), along])]
    flat = np.concatenate([*sides, *(-side for side in sides)])
    ways = np.repeat(np.array([[1.0, 0], [0, 1], [1, 0], [0, 1]]), len(along), axis=0)
    points = CENTRE + PIXEL * np.column_stack([flat, np.zeros(len(flat))])
    points = points + 0.1 * PIXEL * generator.normal(size=points.shape)
    strokes = np.repeat(np.arange(4), len(along))
    assert found_among(points, np.column_stack([ways, np.zeros(len(ways))]), strokes) == []


def test_scattered_short_strokes_are_none(generator):
    count = 60
    starts, ways = generator.uniform(-8, 8, size=(count, 1, 3)), generator.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = CENTRE + PIXEL * (starts + np.arange(4)[None, :, None] * ways[:, None]).reshape(-1, 3)
    assert found_among(points, np.repeat(ways, 4, axis=0), np.repeat(np.arange(count), 4)) == []


def test_nothing_gives_nothing():
    assert found_among(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)) == []
    one = np.array([[0.5, 0.5, 0.5]])
    assert found_among(one, np.eye(3)[:1], np.zeros(1, np.int64)) == []


def test_clusters_of_strokes_hold_the_circle_and_it_is_fitted_as_one(generator):
    points, ways, strokes = ring(generator, 2.0, 3)
    line = CENTRE + PIXEL * (np.array([30.0, 0, 0]) + np.arange(40)[:, None] * np.array([0, 1.0, 0]))
    clusters = assemble_strokes(
        np.concatenate([points, line]),
        np.concatenate([ways, np.tile([0.0, 1.0, 0.0], (40, 1))]),
        np.concatenate([strokes, np.full(40, 3)]),
        pixels := np.full(len(points) + 40, PIXEL),
        YARDSTICK,
    )
    wireframe, counts = fit_strokes(clusters, pixels)
    assert sorted(shape.kind for shape in wireframe.shapes) == ["circle", "line"]
    assert counts["loop"] == 1 and counts["line"] == 1
