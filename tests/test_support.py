"""What edge maps say about 3D points: strength, and support that is not shared with stray points."""

import numpy as np
import pytest

from taichi_edges.detectors.ridges import draw_ridges
from taichi_edges.support import edge_strength, exclusive_support, line_width
from taichi_edges.synthetic.rendering import ring_cameras
from taichi_edges.views import Views

SIZE, VIEWS = 200, 24


def scene(*segments):
    """Views of straight 3D segments, none of them hidden, drawn as clean lines."""
    intrinsics, poses = ring_cameras(VIEWS, SIZE)
    blank = np.zeros((VIEWS, SIZE, SIZE), np.uint8)
    views = Views(tuple(map(str, range(VIEWS))), blank, intrinsics, poses, ("",) * VIEWS)
    maps = []
    for view in range(VIEWS):
        drawn = np.zeros((SIZE, SIZE), np.uint8)
        for start, end in segments:
            pixels, _ = views.project(np.linspace(start, end, 400), view)
            along = pixels[-1] - pixels[0]
            normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
            inside = ((pixels > 0) & (pixels < SIZE - 1)).all(axis=1)
            points = pixels[inside]
            drawn = np.maximum(
                drawn, draw_ridges(points, np.tile(normal, (len(points), 1)), np.ones(len(points)), SIZE, SIZE)
            )
        maps.append(drawn)
    return Views(views.names, np.stack(maps), intrinsics, poses, ("",) * VIEWS)


A = (np.array([0.2, 0.3, 0.3]), np.array([0.8, 0.3, 0.3]))
B = (np.array([0.2, 0.7, 0.6]), np.array([0.8, 0.7, 0.6]))


def test_points_on_an_edge_are_supported_and_strays_are_not():
    views = scene(A, B)
    on_edges = np.concatenate([np.linspace(*A, 60), np.linspace(*B, 60)])
    strays = np.random.default_rng(3).uniform(0.2, 0.8, (400, 3))
    off = np.minimum(*(np.linalg.norm(np.cross(strays - s, e - s), axis=1) / np.linalg.norm(e - s) for s, e in (A, B)))
    strays = strays[off > 0.1]
    support = exclusive_support(views, np.concatenate([on_edges, strays]), 0.5)
    assert support[: len(on_edges)].min() > 0.5
    assert np.quantile(support[len(on_edges) :], 0.99) < 0.1
    assert edge_strength(views, on_edges).mean() > 0.8


def test_a_stray_point_shares_no_support_with_the_edge_it_projects_onto():
    views = scene(A)
    camera = -views.world_to_camera[0, :, :3].T @ views.world_to_camera[0, :, 3]
    middle = (A[0] + A[1]) / 2
    behind = middle + 0.2 * (middle - camera) / np.linalg.norm(middle - camera)  # same pixel in view 0
    alone = exclusive_support(views, behind[None], 0.5)[0]
    beside = exclusive_support(views, np.concatenate([np.linspace(*A, 60), behind[None]]), 0.5)[-1]
    assert alone > 0
    assert beside == 0


def test_points_no_view_sees_have_neither_strength_nor_support():
    views = scene(A)
    far = np.array([[0.5, 0.5, 50.0], [100.0, 0.0, 0.0]])
    assert edge_strength(views, far) == pytest.approx([0, 0])
    assert exclusive_support(views, far, 0.5) == pytest.approx([0, 0])


def test_a_map_without_background_does_not_count_for_the_width_of_the_lines():
    views = scene(A)
    maps = views.edge_maps.copy()
    maps[0] = 255
    whitened = Views(views.names, maps, views.intrinsics, views.world_to_camera, views.image_paths)
    assert line_width(whitened, 0.5)[0] == pytest.approx(line_width(views, 0.5)[0], rel=0.05)
