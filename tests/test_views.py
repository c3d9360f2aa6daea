"""What is written of views is read again, and how large a pixel is at the scene."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import SIZE, blank_views, line, views_of

from taichi_edges.readers.frames import scene_pixel
from taichi_edges.synthetic.rendering import look_at
from taichi_edges.views.cameras import AT_ONCE, Cameras, Similarity
from taichi_edges.views.views import pixel_size, read_views, write_views


@pytest.mark.parametrize("pixel, tolerance", [(None, 0.5), (0.0031, 0.7), (1e-5, 1.25)])
def test_views_are_read_as_they_were_written(tmp_path, generator, pixel, tolerance):
    views = views_of([line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])], generator, count=5)
    similarity, box = Similarity(0.25, (1.0, -2.0, 0.5)), np.array([[0.1, 0, 0], [0.9, 1, 0.5]])
    views = replace(views, similarity=similarity, box=box, pixel=pixel, tolerance_px=tolerance)
    found = read_views(write_views(tmp_path / "views.npz", views))
    assert (found.pixel, found.tolerance_px) == (pixel, tolerance)
    assert (found.names, found.image_paths, found.similarity) == (views.names, views.image_paths, similarity)
    for name in ("edge_maps", "intrinsics", "world_to_camera", "box", "input_to_truth"):
        np.testing.assert_array_equal(getattr(found, name), getattr(views, name))
    for name in ("starts", "points", "normals", "strengths"):
        np.testing.assert_array_equal(getattr(found.edgels, name), getattr(views.edgels, name))
    assert pixel_size(found) == pixel_size(views)


def test_views_before_edgels_are_traced_have_none_when_read(tmp_path):
    assert read_views(write_views(tmp_path / "views.npz", blank_views(2))).edgels is None


def test_a_pixel_is_as_large_as_it_is_said_to_be_or_as_at_the_middle_of_the_box():
    views = blank_views(6)
    middle = np.full((1, 3), 0.5)
    expected = views.project(middle, 0)[1][0] / views.intrinsics[0, 0, 0]  # the ring is as far on all sides
    assert pixel_size(views) == pytest.approx(expected)
    assert pixel_size(replace(views, pixel=0.0123)) == 0.0123


def test_pixel_of_a_scene_is_the_median_of_what_each_view_sees():
    intrinsics = np.repeat(np.array([[[400.0, 0, 199.5], [0, 400, 199.5], [0, 0, 1]]]), 4, axis=0)
    middle, ahead = np.full(3, 0.5), np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    poses = np.stack([look_at(middle, middle + forward) for forward in ahead])
    # A camera turns in the middle of four walls 1, 2, 3 and 4 away, each with a point far behind it, too.
    depths = np.array([1.0, 2.0, 3.0, 4.0])
    walls = [
        middle + depth * forward + shift
        for depth, forward in zip(depths, ahead, strict=True)
        for shift in np.eye(3) * 0.01
    ]
    points = np.array([*walls, middle + 100 * ahead[0]])
    assert scene_pixel(points, intrinsics, poses, (SIZE, SIZE)) == pytest.approx(2.5 / 400, rel=0.01)
    assert scene_pixel(points, intrinsics[:1], poses[:1], (SIZE, SIZE)) == pytest.approx(1.0 / 400, rel=0.01)
    behind = middle - ahead[:1]
    assert scene_pixel(behind, intrinsics[:1], poses[:1], (SIZE, SIZE)) is None
    assert scene_pixel(np.zeros((0, 3)), intrinsics, poses, (SIZE, SIZE)) is None


def test_pixel_at_a_place_is_the_median_of_the_views_that_have_it_in_their_image(generator):
    """Against one place and view after the other; more places than are looked up at once, some of them in no image."""
    views = blank_views(7)
    cameras = Cameras.of(views.intrinsics @ views.world_to_camera)
    points = generator.uniform(-4, 5, (AT_ONCE + 500, 3))
    sizes = np.stack([sizes_in(views, view, points) for view in range(len(views))], axis=1)
    expected = [np.median(some[np.isfinite(some)]) if np.isfinite(some).any() else np.nan for some in sizes]
    assert 100 < np.isnan(expected).sum() < len(points) - 100
    np.testing.assert_allclose(cameras.pixel_at(points, views.width, views.height), expected, rtol=1e-9)
    np.testing.assert_array_equal(cameras.pixel_at(points, views.width, views.height, 0.25)[np.isnan(expected)], 0.25)
    assert cameras.pixel_at(np.zeros((0, 3)), views.width, views.height).shape == (0,)


def sizes_in(views, view, points):
    """(n,) size of a pixel in one view, NaN where it does not have the point in its image."""
    pixels, depths = views.project(points, view)
    inside = (np.abs(pixels - 199.5) < 200).all(axis=1)
    return np.where(inside, depths / views.intrinsics[view, 0, 0], np.nan)


def test_pixel_at_a_place_twice_as_far_is_twice_as_large():
    views = blank_views(1)
    pose = views.world_to_camera[0]
    ahead = pose[2, :3] * np.array([[1.0], [2.0]]) - pose[:, :3].T @ pose[:, 3]
    near, far = Cameras.of(views.intrinsics @ views.world_to_camera).pixel_at(ahead, views.width, views.height)
    assert near == pytest.approx(1 / views.intrinsics[0, 0, 0]) and far == pytest.approx(2 * near)
