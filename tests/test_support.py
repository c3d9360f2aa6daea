"""What edge maps say about 3D points: strength, and support that is not shared with stray points."""

import gc

import cv2
import numpy as np
import pytest
import reference_support as reference

from taichi_edges.evidence import pixel_owners, support
from taichi_edges.evidence.pixel_owners import PixelOwners
from taichi_edges.evidence.support import exclusive_support, line_width
from taichi_edges.synthetic.rendering import ring_cameras
from taichi_edges.views.drawing import draw_lines
from taichi_edges.views.views import Views

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
                drawn, draw_lines(points, np.tile(normal, (len(points), 1)), np.ones(len(points)), SIZE, SIZE)
            )
        maps.append(drawn)
    return Views(views.names, np.stack(maps), intrinsics, poses, ("",) * VIEWS)


A = (np.array([0.2, 0.3, 0.3]), np.array([0.8, 0.3, 0.3]))
B = (np.array([0.2, 0.7, 0.6]), np.array([0.8, 0.7, 0.6]))


def test_points_on_an_edge_are_supported_and_strays_are_not(taichi):
    views = scene(A, B)
    on_edges = np.concatenate([np.linspace(*A, 60), np.linspace(*B, 60)])
    strays = np.random.default_rng(3).uniform(0.2, 0.8, (400, 3))
    off = np.minimum(*(np.linalg.norm(np.cross(strays - s, e - s), axis=1) / np.linalg.norm(e - s) for s, e in (A, B)))
    strays = strays[off > 0.1]
    support = exclusive_support(views, np.concatenate([on_edges, strays]), 0.5)
    assert support[: len(on_edges)].min() > 0.5
    assert np.quantile(support[len(on_edges) :], 0.99) < 0.1
    assert PixelOwners(views, on_edges.astype(np.float32), 0.5).strength.mean() > 0.8


def test_a_stray_point_shares_no_support_with_the_edge_it_projects_onto(taichi):
    views = scene(A)
    camera = -views.world_to_camera[0, :, :3].T @ views.world_to_camera[0, :, 3]
    middle = (A[0] + A[1]) / 2
    behind = middle + 0.2 * (middle - camera) / np.linalg.norm(middle - camera)  # same pixel in view 0
    alone = exclusive_support(views, behind[None], 0.5)[0]
    beside = exclusive_support(views, np.concatenate([np.linspace(*A, 60), behind[None]]), 0.5)[-1]
    assert alone > 0
    assert beside == 0


def test_points_no_view_sees_have_neither_strength_nor_support(taichi):
    views = scene(A)
    far = np.array([[0.5, 0.5, 50.0], [100.0, 0.0, 0.0], [np.nan, 0.5, 0.5], [0.5, np.inf, 0.5], [1e300, 0.5, 0.5]])
    assert PixelOwners(views, far[:2].astype(np.float32), 0.5).strength.tolist() == [0.0] * 2
    assert exclusive_support(views, far, 0.5).tolist() == [0.0] * 5
    on_edge = np.linspace(*A, 20)
    together = exclusive_support(views, np.concatenate([far, on_edge]), 0.5)
    np.testing.assert_array_equal(together, np.append(np.zeros(5), exclusive_support(views, on_edge, 0.5)))


def test_no_points_are_no_error(taichi):
    views = scene(A)
    assert exclusive_support(views, np.zeros((0, 3)), 0.5).shape == (0,)


def test_a_map_without_background_does_not_count_for_the_width_of_the_lines():
    views = scene(A)
    maps = views.edge_maps.copy()
    maps[0] = 255
    whitened = Views(views.names, maps, views.intrinsics, views.world_to_camera, views.image_paths)
    assert line_width(whitened, 0.5)[0] == pytest.approx(line_width(views, 0.5)[0], rel=0.05)


def test_the_width_of_the_lines_is_measured_once(monkeypatch):
    views, measured, transform = scene(A), [], cv2.distanceTransform
    monkeypatch.setattr(cv2, "distanceTransform", lambda *arguments: measured.append(1) or transform(*arguments))
    assert line_width(views, 0.5) == line_width(views, 0.5) and len(measured) == len(views)
    line_width(views, 0.25)
    line_width(scene(A), 0.5)
    assert len(measured) == 3 * len(views)
    known = set(support.known_widths)
    del views
    gc.collect()
    assert len(support.known_widths) < len(known)  # it is forgotten with the views


# ------------------------------------------------------------------------------------------- against the slow twins


def noise(generator, views=7, height=44, width=60):
    """Views with random edge maps, so that every pixel is an edge or not by chance; small, so that borders matter."""
    intrinsics, poses = ring_cameras(views, width)
    intrinsics[:, 1, 2] = (height - 1) / 2
    intrinsics[:, :2, :2] *= 1.4  # part of the cube is outside the images
    maps = generator.integers(0, 256, (views, height, width)).astype(np.uint8)
    return Views(tuple(map(str, range(views))), maps, intrinsics, poses, ("",) * views)


def scattered(views, count, generator):
    """Some `count` points about the cube, in front of and behind the cameras, with clusters that share pixels.

    Without those that fall so near to the border between two pixels that float32 may round them otherwise.
    """
    wide = generator.uniform(-1.5, 2.5, (count // 4, 3))
    centres = generator.uniform(0, 1, (count // 8, 3))
    points = np.concatenate(
        [wide, centres, np.repeat(centres, 5, axis=0) + generator.normal(0, 0.01, (5 * len(centres), 3))]
    )
    points = points.astype(np.float32).astype(np.float64)
    pixels = [views.project(points, view)[0] for view in range(len(views))]
    return points[~np.any([reference.between_pixels(p) for p in pixels], axis=0)]


def test_strength_is_that_of_the_slow_twin(taichi, generator):
    views = noise(generator)
    points = scattered(views, 400, generator)
    expected, seen = reference.edge_strength(views, points)
    shown = PixelOwners(views, points.astype(np.float32), 0.5)
    np.testing.assert_array_equal(shown.seen, np.maximum(seen, 1))
    assert {0, 1, len(views)} <= set(seen.tolist())
    # A coordinate is off by some 1e-5 px in float32, and neighbouring pixels differ by up to 1.
    np.testing.assert_allclose(shown.strength, expected, atol=1e-4)


@pytest.mark.parametrize("claim_px", [0.7, 1.6, 3.3])
def test_owned_shares_are_those_of_the_slow_twin(taichi, generator, claim_px):
    views = noise(generator)
    points = scattered(views, 300, generator)
    strength = generator.permutation(len(points)) // 2 / len(points)  # every value twice: the later point wins
    reach = 0.02
    expected = reference.owned_share(views, points, strength, 0.5, claim_px, reach)
    shown = PixelOwners(views, points.astype(np.float32), 0.5)
    np.testing.assert_array_equal(shown.owned_share(strength, claim_px, reach), expected)
    assert 0 < expected.mean() < 0.5


def test_batches_and_repeated_claims_do_not_change_the_support(taichi, generator, monkeypatch):
    views = noise(generator)
    points = scattered(views, 300, generator)
    shown = PixelOwners(views, points.astype(np.float32), 0.5)
    assert len(shown.batches) == 1
    expected = reference.exclusive_support(views, points, 0.5, shown.strength)
    np.testing.assert_array_equal(exclusive_support(views, points, 0.5), expected)
    monkeypatch.setattr(pixel_owners, "BATCH_BYTES", 3 * 4 * (44 * 60 + len(points)))
    assert len(PixelOwners(views, points.astype(np.float32), 0.5).batches) == 3
    np.testing.assert_array_equal(exclusive_support(views, points, 0.5), expected)
    monkeypatch.setattr(pixel_owners, "LARGEST_I32", 4 * len(points))  # the claims start anew every third time
    np.testing.assert_array_equal(exclusive_support(views, points, 0.5), expected)


@pytest.mark.slow(reason="starts Taichi anew")
def test_support_does_not_depend_on_the_threads(start_taichi, generator):
    views = noise(generator)
    points = generator.uniform(0, 1, (40_000, 3))  # enough for Taichi to use more than one thread
    found = []
    for threads in (1, 2, 2):
        start_taichi("f32", threads)
        found.append(exclusive_support(views, points, 0.5))
    assert found[0].tobytes() == found[1].tobytes() == found[2].tobytes()
