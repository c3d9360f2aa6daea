"""Many arcs at once are what each is alone, and fewer places are looked at without one that counts being missed."""

import numpy as np
import pytest

from taichi_edges.fitting.arc_batch import ArcBatch, fit_batch
from taichi_edges.fitting.arcs import Arc, fit_arc
from taichi_edges.fitting.distances import distances_to
from taichi_edges.fitting.model_selection import track_of
from taichi_edges.geometry.shapes import EllipticArc, Line
from taichi_edges.refinement.continuation import Places
from taichi_edges.strokes.arc_growth import Cloud, Scale, all_unbroken, unbroken
from taichi_edges.strokes.merging import EndGrid, Piece

ROUNDING = 1e-9  # of lengths of about 1, after sums in another order


def arcs_and_points(generator, bends=(0.0, 0.7, 3.0, 11.0), count=40):
    """Arcs anywhere, some of them lines; noisy points along each with directions, (t, 3), and their arcs' numbers."""
    arcs = []
    for bend in bends:
        tangent, aside = np.linalg.qr(generator.normal(size=(3, 2)))[0].T
        arcs.append(Arc(generator.random(3), tangent, bend * aside, -0.1, 0.15))
    along = generator.uniform(-0.1, 0.15, (len(arcs), count))
    points = np.concatenate([arc.at(some) for arc, some in zip(arcs, along, strict=True)])
    directions = np.concatenate([arc.tangents(some) for arc, some in zip(arcs, along, strict=True)])
    points = points + generator.normal(0, 1e-3, points.shape)
    return arcs, points, directions, np.repeat(np.arange(len(arcs)), count)


def test_coordinates_places_and_tangents_are_those_of_each(generator):
    arcs, points, _, of = arcs_and_points(generator)
    batch = ArcBatch.of(arcs)
    along, offsets = batch.coordinates(points, of)
    for number, arc in enumerate(arcs):
        own = of == number
        wanted = arc.coordinates(points[own])
        np.testing.assert_allclose(along[own], wanted[0], atol=ROUNDING)
        np.testing.assert_allclose(offsets[own], wanted[1], atol=ROUNDING)
        np.testing.assert_allclose(batch.at(along, of)[own], arc.at(wanted[0]), atol=ROUNDING)
        np.testing.assert_allclose(batch.tangents(along, of)[own], arc.tangents(wanted[0]), atol=ROUNDING)


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("lever", [0.0, 0.02])
def test_fit_is_that_of_each(generator, straight, lever):
    arcs, points, directions, of = arcs_and_points(generator)
    found = fit_batch(ArcBatch.of(arcs), points, directions, of, np.full(len(arcs), lever), 3e-3, straight)
    for number, (arc, fitted) in enumerate(zip(arcs, found, strict=True)):
        own = of == number
        wanted = fit_arc(arc, points[own], directions[own], lever, 3e-3, straight)
        for name in ("origin", "tangent", "bend"):
            np.testing.assert_allclose(getattr(fitted, name), getattr(wanted, name), atol=ROUNDING)


def test_whole_circles_close(generator):
    batch = ArcBatch.of(arcs_and_points(generator)[0])
    circles = batch.over(batch.low, batch.low + np.minimum(batch.round, 10.0))
    np.testing.assert_array_equal(circles.closed, [False, True, True, True])
    for arc, middle in zip(batch, batch.recentred(), strict=True):
        np.testing.assert_allclose(
            middle.at(np.array([middle.low, middle.high])), arc.at([arc.low, arc.high]), atol=1e-12
        )


def test_inliers_are_those_of_each(generator):
    arcs, points, directions, _ = arcs_and_points(generator, count=200)
    cloud, batch = Cloud(points, directions, Scale(1e-3, 0.02, 0.03)), ArcBatch.of(arcs)
    found = cloud.inliers_of(batch, batch.low, batch.high)
    for number, arc in enumerate(arcs):
        own, wanted = found.keep(found.of == number), cloud.inliers(arc, arc.low, arc.high)
        np.testing.assert_array_equal(own.members, wanted.members)
        np.testing.assert_allclose(own.along, wanted.along, atol=ROUNDING)
        np.testing.assert_allclose(own.squared, wanted.squared, rtol=1e-6, atol=ROUNDING)
        assert len(wanted) > 100


def test_unbroken_stretches_are_those_of_each(generator):
    low, high, gap = np.array([0.2, 0.4, 5.0, 0.0]), np.array([0.4, 0.5, 6.0, 1.0]), np.array([0.02, 0.05, 0.1, 0.03])
    of = np.repeat(np.arange(4), 60)
    along = generator.random(len(of))
    found = all_unbroken(of, along, low, high, gap)
    for number in range(4):
        own = of == number
        np.testing.assert_array_equal(found[own], unbroken(along[own], low[number], high[number], gap[number]))
    assert found.any() and not found[of == 2].any()


def test_ends_near_an_end_are_found_across_cells(generator):
    starts = generator.random((60, 3)) * 0.3
    arcs = [Arc(start, np.array([1.0, 0, 0]), np.zeros(3), 0.0, 0.05) for start in starts]
    grid, none = EndGrid(0.06), np.zeros(0)
    for number, arc in enumerate(arcs):
        grid.add(number, Piece(arc, None, none, none, none, 0.0))
    places = {(number, side): arc.at([arc.low, arc.high])[side] for number, arc in enumerate(arcs) for side in (0, 1)}
    for end, place in places.items():
        wanted = {other for other, there in places.items() if np.linalg.norm(there - place) <= 0.06}
        assert set(grid.near(end)) == wanted


@pytest.mark.parametrize("radius", [0.02, 0.4, 30.0])
def test_no_place_about_a_circle_is_missed(generator, radius):
    strokes = [Line(start + [[0, 0, 0], end]) for start, end in generator.uniform(0, 0.2, (200, 2, 3))]
    places, alive = Places([track_of(stroke, 2e-3) for stroke in strokes]), generator.random(200) < 0.8
    circle = EllipticArc(np.array([0.1 - radius, 0.1, 0.1]), radius * np.eye(3)[:2], 0.0, 2 * np.pi)
    wanted = (distances_to(circle, places.points) <= 0.01) & alive[places.owners]
    np.testing.assert_array_equal(places.about(circle, 0.01, alive), np.flatnonzero(wanted))
    assert wanted.any()
