"""Edgels lifted into space: their candidates lie on the edges that several views see."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import arc, blank_views, distances_to, joined, line, pixel_of, tangents, views_of
from scipy.spatial import cKDTree

from taichi_edges.seeding.lifting import CANDIDATES, LEAST_ANGLE, MOST_VIEWS, lift_edgels, neighboring_views
from taichi_edges.seeding.proposals import likely_points
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import camera_centre, ring_cameras
from taichi_edges.views.edgels import Edgels

A = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
RIM = arc([0.5, 0.5, 0.6], 0.25)
UPRIGHT = line([0.3, 0.7, 0.2], [0.3, 0.7, 0.8])
NOISE_PX = 0.1
TOLERANCE = 5 * NOISE_PX


def misses(lifted, curve, pixel):
    """(e,) px from the first candidate of each edgel to a curve; infinite where there is none."""
    away = distances_to(curve, lifted.points[:, 0]) / pixel
    return np.where(lifted.evidence[:, 0] > 0, away, np.inf)


def without_edgels(count):
    """Blank views whose edgels have been looked for."""
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    return replace(blank_views(count), edgels=Edgels.of_views([none] * count))


def test_candidates_lie_on_the_edges_of_a_part_and_run_along_them(taichi, generator):
    curves = [line(*ends) for ends in PARTS["block"]().edges.lines]
    views = views_of(curves, generator, noise_px=NOISE_PX, apart=1.0)
    lifted = lift_edgels(views, TOLERANCE)
    assert lifted.points.shape == lifted.directions.shape == (len(views.edgels), CANDIDATES, 3)
    assert (np.diff(lifted.evidence, axis=1) <= 0).all() and (lifted.evidence[:, 0] > 0).mean() > 0.99
    s = np.linspace(0, 1, 2000)
    tree, along = cKDTree(np.concatenate([curve(s) for curve in curves])), [tangents(curve, s) for curve in curves]
    away, nearest = tree.query(lifted.points[:, 0])
    away /= pixel_of(views)
    # The edgel itself is off, and the one of another view that tells the depth, both across the ray.
    assert np.median(away) < 2 * NOISE_PX and (away < 6 * NOISE_PX).mean() > 0.95
    aligned = np.abs((np.concatenate(along)[nearest] * lifted.directions[:, 0]).sum(axis=1))
    inner = away < 6 * NOISE_PX
    assert np.median(aligned[inner]) > np.cos(np.radians(3))
    np.testing.assert_allclose(np.linalg.norm(lifted.directions, axis=2), 1.0, atol=1e-6)


def test_an_edge_on_a_side_of_the_scene_box_is_lifted_too(taichi, generator):
    side = line([0.0, 0.2, 0.3], [0.0, 0.8, 0.4])
    for box, bounds in (("whole", [[0.0, 0, 0], [1, 1, 1]]), ("tight", [[0.0, 0.2, 0.3], [1.0, 0.8, 0.9]])):
        views = replace(views_of([side], generator, noise_px=NOISE_PX, apart=1.0), box=np.array(bounds))
        away = misses(lift_edgels(views, TOLERANCE), side, pixel_of(views))
        assert (away < 6 * NOISE_PX).mean() > 0.97, box


def test_what_lies_beyond_the_box_is_not_looked_for(taichi, generator):
    far = line([0.2, 0.2, 0.2], [0.3, 0.8, 0.2])
    views = replace(views_of([far], generator, apart=1.0), box=np.array([[0.5, 0.1, 0.4], [0.9, 0.9, 0.9]]))
    lifted = lift_edgels(views, TOLERANCE)
    found = lifted.points[lifted.evidence[:, 0] > 0, 0]
    margin = 0.04 * np.ptp(views.box, axis=0)
    assert ((found >= views.box[0] - margin) & (found <= views.box[1] + margin)).all()


def test_an_edge_that_four_of_24_views_see_has_candidates_in_all_of_them(taichi, generator):
    """What two other views say outweighs what others have by chance, if not for every edgel; see `test_tracing.py`."""
    others, rare = (views_of(curves, generator, NOISE_PX, apart=1.0) for curves in ([A, RIM], [UPRIGHT]))
    views, is_rare = joined(others, rare, seeing=(0, 1, 2, 3))
    lifted = lift_edgels(views, TOLERANCE)
    away = distances_to(UPRIGHT, lifted.points.reshape(-1, 3)).reshape(-1, CANDIDATES) / pixel_of(views)
    away[lifted.evidence <= 0] = np.inf
    assert (away[is_rare].min(axis=1) < 8 * NOISE_PX).mean() > 0.85
    for view in range(4):
        assert (misses(lifted, UPRIGHT, pixel_of(views))[is_rare & (views.edgels.views == view)] < 0.8).mean() > 0.2


@pytest.mark.parametrize("count", [1, 24])
def test_blank_views_give_nothing(taichi, count):
    views = without_edgels(count)
    assert lift_edgels(views, TOLERANCE).points.shape == (0, CANDIDATES, 3)
    points, directions = likely_points(views, 100)
    assert points.shape == directions.shape == (0, 3)


def test_one_view_alone_gives_nothing(taichi, generator):
    alone = views_of([A, RIM], generator, count=1)
    assert (lift_edgels(alone, TOLERANCE).evidence == 0).all() and len(likely_points(alone, 100)[0]) == 0
    one_of_many = [([A] if view == 5 else []) for view in range(8)]
    parts = [views_of(curves, generator, count=8).edgels.of_view(view) for view, curves in enumerate(one_of_many)]
    seen_once = replace(blank_views(8), edgels=Edgels.of_views(parts))
    assert len(seen_once.edgels) > 100 and (lift_edgels(seen_once, TOLERANCE).evidence == 0).all()


def test_only_the_chosen_edgels_are_lifted(taichi, generator):
    views = views_of([A, UPRIGHT], generator, noise_px=NOISE_PX, count=8)
    every, some = lift_edgels(views, TOLERANCE), np.arange(len(views.edgels)) % 7 == 0
    chosen = lift_edgels(views, TOLERANCE, some)
    assert (chosen.evidence[~some] == 0).all()
    np.testing.assert_array_equal(chosen.points[some], every.points[some])


def test_likely_points_lie_on_edges_though_the_maps_are_shifted(taichi, generator):
    views = views_of([A, RIM, UPRIGHT], generator, noise_px=0.2, apart=1.0)
    views = replace(views, edgels=views.edgels.moved(np.array([0.5, -0.4])))
    points, directions = likely_points(views, 300)
    away = np.min([distances_to(curve, points) for curve in (A, RIM, UPRIGHT)], axis=0) / pixel_of(views)
    assert len(points) == len(directions) == 300 and (away < 3).mean() > 0.95


def test_views_are_compared_with_those_from_elsewhere_not_from_behind():
    centres = np.array([camera_centre(pose) for pose in ring_cameras(80, 400)[1]])
    towards = centres - 0.5
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    apart = np.arccos(np.clip(towards @ towards.T, -1, 1))
    for view, others in enumerate(neighboring_views(centres, np.full(3, 0.5))):
        assert view not in others and len(set(others.tolist())) == len(others) <= MOST_VIEWS
        assert apart[view, others].min() >= LEAST_ANGLE and apart[view, others].max() < np.radians(66)
    assert [len(others) for others in neighboring_views(centres[:1], np.full(3, 0.5))] == [0]
    twice = np.repeat(centres[:2], 2, axis=0)  # two pictures from one place tell no depth
    assert [len(others) for others in neighboring_views(twice, np.full(3, 0.5))] == [2] * 4


@pytest.mark.slow(reason="starts Taichi anew")
def test_candidates_do_not_depend_on_threads(start_taichi, generator):
    views, found = views_of([A, RIM], generator, noise_px=0.2, count=8), []
    for threads in (1, 2):
        start_taichi("f32", threads)
        found.append(lift_edgels(views, TOLERANCE))
    for name in ("points", "directions", "evidence", "parallax"):
        np.testing.assert_array_equal(*(getattr(lifted, name) for lifted in found))
