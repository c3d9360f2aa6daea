"""Strokes traced along paths of edgels, and the proposals that explain all of them once."""

import numpy as np
import pytest
from edgel_scenes import arc, centre, distances_to, joined, line, pixel_of, tangents, views_of

from taichi_edges.detectors.paths import ordered_paths
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.seeding.lifting import lift_edgels
from taichi_edges.seeding.proposals import explaining, noise_of_views, propose, runs_of
from taichi_edges.seeding.tracing import SHORTEST, Strokes, traced

A = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
RIM = arc([0.5, 0.5, 0.6], 0.25)
UPRIGHT = line([0.3, 0.7, 0.2], [0.3, 0.7, 0.8])
CURVES = (A, RIM, UPRIGHT)
TOLERANCE = 0.4


def traced_strokes(views, tolerance=TOLERANCE):
    return traced(views, lift_edgels(views, tolerance), ordered_paths(views.edgels), tolerance)


def parts_of(strokes):
    """A slice for each stroke."""
    return [slice(first, last) for first, last in zip(strokes.starts[:-1], strokes.starts[1:], strict=True)]


def nearest_of(curves, points, pixel):
    """(n,) px to the nearest curve, and (n,) which it is."""
    away = np.stack([distances_to(curve, points) for curve in curves]) / pixel
    return away.min(axis=0), away.argmin(axis=0)


def apart_in(views, view, point, along, offset):
    """Px between the images of two parallel lines of direction `along`, `offset` apart, in one view."""
    towards = point - centre(views, view)
    side = np.cross(towards / np.linalg.norm(towards), along)
    return abs(side @ offset) / np.linalg.norm(side) / pixel_of(views)


def test_strokes_are_points_in_order_along_edges(taichi, generator):
    views = views_of(CURVES, generator, noise_px=0.05, apart=1.0)
    strokes = traced_strokes(views)
    away, _ = nearest_of(CURVES, strokes.points, pixel_of(views))
    assert np.median(away) < 0.1 and (away < 0.4).mean() > 0.98
    assert np.bincount(strokes.numbers).min() >= SHORTEST and (np.diff(strokes.numbers) >= 0).all()
    longest = max(parts_of(strokes), key=lambda part: part.stop - part.start)
    steps = np.diff(strokes.points[longest], axis=0)
    assert ((steps[1:] * steps[:-1]).sum(axis=1) > 0).mean() > 0.95
    aligned = np.abs((steps * strokes.directions[longest][:-1]).sum(axis=1)) / np.linalg.norm(steps, axis=1)
    assert np.median(aligned) > np.cos(np.radians(10))


@pytest.mark.parametrize("offset", [[0, 1, 0], [0, 0, 1], [0, 0.6, 0.8]], ids=["level", "above", "slanted"])
def test_a_stroke_does_not_jump_between_edges_two_pixels_apart(taichi, generator, offset):
    start, end = np.array([0.2, 0.5, 0.5]), np.array([0.8, 0.5, 0.5])
    offset = 2 * pixel_of(views_of([], generator)) * np.array(offset)
    pair = [line(start, end), line(start + offset, end + offset)]
    views = views_of(pair, generator, noise_px=0.05, apart=1.0)
    strokes = traced_strokes(views)
    away, which = nearest_of(pair, strokes.points, pixel_of(views))
    assert np.quantile(away, 0.99) < 0.3
    for part in parts_of(strokes):
        view = views.edgels.views[strokes.edgels[part][0]]
        # Where one hides the other, nobody can tell which of them an edgel is of.
        if apart_in(views, view, start, np.array([1.0, 0, 0]), offset) > 1.0:
            assert np.ptp(which[part]) == 0


def test_each_edge_is_explained_once(taichi, generator):
    views = views_of(CURVES, generator, noise_px=0.1, apart=1.0)
    strokes, pixel = propose(views, EdgelMatching(views)), pixel_of(views)
    away, which = nearest_of(CURVES, strokes.points, pixel)
    assert away.max() < 0.5
    for number, curve in enumerate(CURVES):
        s = np.linspace(0, 1, 400)
        near = [strokes.points[part] for part in parts_of(strokes) if (which[part] == number).all()]
        covered = np.array([distances_to(lambda _, some=some: some, curve(s)) < 2.5 * pixel for some in near])
        assert covered.any(axis=0).mean() > 0.97  # their ends are a matter of the noise
        assert covered.sum(axis=0).mean() < 1.25
    found = propose(views, EdgelMatching(views))
    np.testing.assert_array_equal(found.points, strokes.points)


@pytest.mark.parametrize("seeing", [(0, 1, 2, 3), (3, 5, 7, 9), (0, 2, 4, 6)])
def test_an_edge_that_four_of_24_views_see_is_found(taichi, generator, seeing):
    others, rare = (views_of(curves, generator, 0.1, apart=1.0) for curves in ([A, RIM], [UPRIGHT]))
    views, _ = joined(others, rare, seeing)
    points, pixel = propose(views, EdgelMatching(views)).points, pixel_of(views)
    assert (distances_to(lambda _: points, UPRIGHT(np.linspace(0, 1, 300))) < 2.5 * pixel).mean() > 0.85
    assert (nearest_of(CURVES, points, pixel)[0] > 1).mean() < 0.02


def test_of_two_strokes_on_an_edge_the_longer_one_stays(taichi, generator):
    views = views_of([A], generator, noise_px=0.05, apart=1.0)
    s = [np.linspace(0.1, 0.9, 120), np.linspace(0.3, 0.6, 45)]
    points, along = (np.concatenate([of(some) for some in s]) for of in (A, lambda some: tangents(A, some)))
    numbers = np.repeat([0, 1], [120, 45])
    for order in (np.arange(165), np.roll(np.arange(165), 45)):
        strokes = Strokes(points[order], along[order], order, np.where(numbers[order] == numbers[order[0]], 0, 1))
        kept = explaining(EdgelMatching(views), strokes, 0.5)
        assert sorted(kept.edgels.tolist()) == list(range(120))


def test_runs_hold_short_gaps_and_no_lonely_points():
    good = np.array([1, 1, 1, 0, 0, 1, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 1, 1], bool)
    assert runs_of(good) == [(0, 7), (17, 21)]
    assert runs_of(np.zeros(9, bool)) == runs_of(np.zeros(0, bool)) == []


@pytest.mark.parametrize("noise_px", [0.1, 0.3])
def test_the_noise_of_the_edgels_is_measured(taichi, generator, noise_px):
    views = views_of(CURVES, generator, noise_px=noise_px, apart=1.0)
    assert noise_of_views(views, EdgelMatching(views)) == pytest.approx(noise_px, rel=0.3)


def test_blank_views_and_one_view_alone_propose_nothing(taichi, generator):
    for views in (views_of([], generator), views_of([A], generator, count=1)):
        found = propose(views, EdgelMatching(views))
        assert len(found) == 0 and found.starts.tolist() == [0]
