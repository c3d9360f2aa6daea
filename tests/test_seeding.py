"""Seeds by multi-view voting lie on the edges of a part, along them, and cover them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from taichi_edges.splatting.gaussians import orient_gaussians
from taichi_edges.splatting.seeding import random_points
from taichi_edges.splatting.voting import line_directions, nearly_best, vote_seeds
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import Imperfections, render_views


@pytest.fixture(scope="module")
def part():
    return PARTS["block"]()


@pytest.fixture(scope="module")
def views(part):
    return render_views(part, 18, 200, Imperfections(), np.random.default_rng(5))[0]


@pytest.fixture
def seeds(start_taichi, views):
    start_taichi("f32", 2)
    return vote_seeds(views, 0.5, np.random.default_rng(0))


def test_seeds_cover_the_edges_and_few_lie_elsewhere(seeds, part):
    truth, tangents, _ = part.edges.sample(0.002)
    to_truth, nearest = cKDTree(truth).query(seeds.points)
    # What matters is that no edge goes without seeds; those a few pixels off (a pixel is 9 mm here) are pulled in by
    # the training. A random point of the cube lies within six pixels of an edge once in ten times, within two in 100.
    assert (cKDTree(seeds.points).query(truth)[0] < 2 * seeds.pixel).mean() > 0.99
    assert (to_truth < 2 * seeds.pixel).mean() > 0.75
    assert (to_truth < 6 * seeds.pixel).mean() > 0.95
    along = np.abs((seeds.directions * tangents[nearest]).sum(axis=1))
    corners = cKDTree(part.edges.lines.reshape(-1, 3)).query(seeds.points)[0] < 8 * seeds.pixel
    assert np.median(along[(to_truth < 2 * seeds.pixel) & ~corners]) > 0.95


def test_the_same_generator_gives_the_same_seeds(start_taichi, views):
    start_taichi("f32", 2)
    one, other = (vote_seeds(views, 0.5, np.random.default_rng(7)) for _ in range(2))
    assert one.points.tobytes() == other.points.tobytes()


def test_maps_without_agreement_give_no_seeds(start_taichi, views):
    start_taichi("f32", 2)
    blank = type(views)(**{**vars(views), "edge_maps": np.zeros_like(views.edge_maps)})
    assert len(vote_seeds(blank, 0.5, np.random.default_rng(0)).points) == 0


def test_suppression_keeps_the_best_of_each_neighbourhood():
    points = np.array([[0.5, 0.5, 0.5], [0.501, 0.5, 0.5], [0.9, 0.5, 0.5]])
    assert nearly_best(points, np.array([0.9, 0.5, 0.3]), 0.02).tolist() == [True, False, True]
    assert nearly_best(np.zeros((0, 3)), np.zeros(0), 0.02).shape == (0,)


def test_directions_follow_a_line_and_lonely_points_get_some_unit_vector():
    line = np.linspace([0.1, 0.2, 0.3], [0.3, 0.4, 0.4], 30)
    directions = line_directions(np.concatenate([line, [[0.9, 0.9, 0.9]]]), 0.05)
    unit = np.array([2, 2, 1]) / 3
    assert np.abs(directions[:30] @ unit).min() == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(directions[30]) == pytest.approx(1.0)


def test_oriented_gaussians_point_along_their_directions(generator):
    directions = generator.normal(size=(50, 3))
    directions = np.concatenate([directions, [[1, 0, 0], [-1, 0, 0], [0, 1, 0]]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gaussians = orient_gaussians(np.zeros((53, 3)), directions, along=0.01, across=0.003, opacity=0.3)
    assert np.abs((gaussians.directions() * directions).sum(axis=1)).min() == pytest.approx(1.0, abs=1e-6)
    assert gaussians.scales[0] == pytest.approx([0.01, 0.003, 0.003])
    assert gaussians.opacities == pytest.approx(0.3)


def test_random_points_fill_the_box(generator):
    box = np.array([[0.0, 0.2, 0.4], [1.0, 0.4, 0.5]])
    points = random_points(1000, box, generator)
    assert (points >= box[0]).all() and (points <= box[1]).all()
    assert np.ptp(points, axis=0) == pytest.approx(box[1] - box[0], rel=0.05)
