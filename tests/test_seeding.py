"""Where training starts: Gaussians along strokes, random ones or given ones."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import blank_views
from told import Told

from taichi_edges.corridor import train
from taichi_edges.corridor.pipeline import Run
from taichi_edges.files.ply import write_float_vertices
from taichi_edges.scene.settings import SceneConfig
from taichi_edges.seeding.starts import ACROSS_PX, ALONG_PX, random_points, stroke_gaussians
from taichi_edges.seeding.tracing import Strokes
from taichi_edges.splatting.gaussians import orient_gaussians
from taichi_edges.views.edgels import Edgels


@pytest.mark.parametrize("points, named", [("", "random points"), ("cloud.ply", "the given points")])
def test_without_agreement_the_training_starts_from_the_given_or_random_points(
    taichi, tmp_path, generator, points, named
):
    given = generator.random((80, 3)).astype(np.float32)
    if points:
        write_float_vertices(tmp_path / "seeds.ply", ("x", "y", "z"), given)
    source = {"reader": "emap", "path": "there", "points": points}
    config = SceneConfig(source=source, train={"seeds": "lift", "gaussians": 300})
    told, none = Told(), (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    blank = replace(blank_views(8), edgels=Edgels.of_views([none] * 8))
    gaussians, strokes = train.start_of_training(Run(config, tmp_path, progress=told), blank, np.random.default_rng(0))
    assert len(told.warnings) == 1 and told.warnings[0].endswith(f"the training starts from {named} instead")
    assert "poses or intrinsics may not be those of these images" in told.warnings[0]
    assert strokes is None and len(gaussians) == (80 if points else 300)
    if points:
        np.testing.assert_allclose(gaussians.means, given, atol=1e-6)


def test_gaussians_lie_along_strokes_evenly_and_know_which(generator):
    points, numbers = generator.random((90, 3)), np.repeat([0, 1, 2], 30)
    along = np.tile([0.0, 0.6, 0.8], (90, 1))
    strokes = Strokes(points, along, np.arange(90), numbers)
    pixels = generator.uniform(0.001, 0.004, 90)
    for most, step in ((90, 1), (89, 2), (30, 3)):
        gaussians, own = stroke_gaussians(strokes, pixels, most, 0.3)
        np.testing.assert_allclose(gaussians.scales, pixels[::step, None] * [ALONG_PX, ACROSS_PX, ACROSS_PX], rtol=1e-5)
        np.testing.assert_allclose(gaussians.means, points[::step], atol=1e-6)
        np.testing.assert_array_equal(own, numbers[::step])
        assert gaussians.opacities == pytest.approx(0.3)
        assert np.abs(gaussians.directions() @ along[0]).min() == pytest.approx(1.0, abs=1e-6)


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
