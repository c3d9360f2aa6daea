"""Points refined by the viewing planes of their edgels, explaining away, and the filters built on them."""

import numpy as np
import pytest
from edgel_scenes import (
    SIZE,
    arc,
    blank_views,
    centre,
    displaced,
    distances_to,
    either_errors,
    line,
    pixel_of,
    tangents,
    views_of,
)

from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.explaining import explained_support
from taichi_edges.evidence.viewing_planes import RADII_PX, refine_points
from taichi_edges.kernels.edgel_grid import CELL
from taichi_edges.points.filtering import filter_points
from taichi_edges.scene.settings import FilterConfig
from taichi_edges.synthetic.rendering import ring_cameras
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import read_views, write_views

A = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
RIM = arc([0.5, 0.5, 0.6], 0.25)


def test_edgels_keep_their_views():
    edgels = Edgels.of_views(
        [(np.ones((2, 2)), np.ones((2, 2)), np.ones(2)), (np.zeros((0, 2)),) * 2 + (np.zeros(0),)]
        + [(np.full((1, 2), 7.0), np.ones((1, 2)), np.array([0.5]))]
    )
    assert edgels.view_count == 3 and len(edgels) == 3
    np.testing.assert_array_equal(edgels.views, [0, 0, 2])
    assert len(edgels.of_view(1)[0]) == 0 and edgels.of_view(2)[2] == [0.5]
    kept = edgels.keep(np.array([False, True, True]))
    np.testing.assert_array_equal(kept.views, [0, 2])
    np.testing.assert_allclose(edgels.moved(np.array([1.0, -1.0])).points[2], [8, 6])
    assert len(Edgels.of_views([])) == 0


def test_edgels_know_blur_and_outline_where_the_detector_tells_them():
    none, known = [(np.ones((2, 2)), np.ones((2, 2)), np.ones(2))], (np.ones((1, 2)), np.ones((1, 2)), np.ones(1))
    edgels = Edgels.of_views([*none, (*known, np.array([0.5]), np.array([True]))])
    assert edgels.outlines.tolist() == [False, False, True]
    np.testing.assert_array_equal(edgels.blurs, np.array([np.nan, np.nan, 0.5], np.float32))
    kept = edgels.keep(np.array([False, True, True]))
    assert kept.blurs[1] == 0.5 and kept.outlines.tolist() == [False, True]
    some = edgels.of_some([1, 0, 1])
    assert some.starts.tolist() == [0, 1, 3, 4] and some.outlines.tolist() == [True, False, False, True]
    np.testing.assert_array_equal(some.blurs, np.array([0.5, np.nan, np.nan, 0.5], np.float32))


@pytest.mark.parametrize("blur", [None, 0.7])
def test_edgels_survive_the_disk(tmp_path, generator, blur):
    views = views_of([A], generator, count=3, blur=blur)
    again = read_views(write_views(tmp_path / "views.npz", views))
    for name in ("starts", "points", "normals", "strengths", "blurs"):
        np.testing.assert_array_equal(getattr(again.edgels, name), getattr(views.edgels, name))
    assert read_views(write_views(tmp_path / "blank.npz", blank_views(2))).edgels is None


@pytest.mark.parametrize("curve", [A, RIM], ids=["line", "circle"])
def test_displaced_points_return_to_the_edge(taichi, generator, curve):
    views = views_of([curve], generator)
    pixel = pixel_of(views)
    points, along = displaced(curve, 300, 2.0 * pixel, generator)
    refined = refine_points(EdgelMatching(views), points, along)
    assert distances_to(curve, refined.points).max() < 0.1 * pixel
    # An error of 0.1 px over the 3 px around a point would be 2 degrees.
    s = np.linspace(0, 1, 4000)
    nearest = np.linalg.norm(refined.points[:, None] - curve(s)[None], axis=2).argmin(axis=1)
    assert np.abs((refined.directions * tangents(curve, s[nearest])).sum(axis=1)).min() > np.cos(np.radians(2))
    assert refined.support.min() > 0.9 and refined.views.min() > 0.9 * len(views)


@either_errors()
def test_noise_of_the_edgels_averages_out(taichi, generator, errors):
    views = views_of([A], generator, noise_px=0.4, errors=errors)
    points, along = displaced(A, 300, 1.0 * pixel_of(views), generator)
    refined = refine_points(EdgelMatching(views), points, along)
    # 24 views, of which each dimension across the edge gets half: 0.4 / sqrt(12) = 0.12 px a dimension, 0.16 in all;
    # the robust weights lose some.
    assert np.median(distances_to(A, refined.points)) < 0.25 * pixel_of(views)


def test_another_edge_beside_it_in_some_views_does_not_pull(taichi, generator):
    views = views_of([A], generator)
    spoilt = []
    for view in range(len(views)):
        points, normals, strengths = views.edgels.of_view(view)
        moved = points + 1.5 * normals if view % 3 == 0 else points  # hidden here; another line 1.5 px beside it
        spoilt.append((moved, normals, strengths))
    object.__setattr__(views, "edgels", Edgels.of_views(spoilt))
    points, along = displaced(A, 200, 0.5 * pixel_of(views), generator)
    refined = refine_points(EdgelMatching(views), points, along)
    assert np.median(distances_to(A, refined.points)) < 0.1 * pixel_of(views)


def test_edgels_across_the_direction_are_no_match(taichi, generator):
    views = views_of([A], generator)
    points, along = displaced(A, 50, 0.0, generator)
    across = np.cross(along, np.cross(along, [0.0, 0.0, 1.0]) + 0.0)
    refined = refine_points(EdgelMatching(views), points, across / np.linalg.norm(across, axis=1, keepdims=True))
    assert refined.support.max() < 0.5


def test_faint_edgels_count_for_less(taichi, generator):
    points, along = displaced(A, 20, 0.0, generator)
    sure, faint = (
        refine_points(EdgelMatching(views_of([A], generator, strength=strength)), points, along)
        for strength in (1.0, 0.3)
    )
    np.testing.assert_allclose(faint.views, 0.3 * sure.views, rtol=0.05)


def test_points_no_view_sees_stay_where_they_are(taichi, generator):
    matching = EdgelMatching(views_of([A], generator, count=6))
    far = np.array([[0.5, 0.5, 50.0], [100.0, 0.0, 0.0], [0.5, 0.9, 0.9]])
    refined = refine_points(matching, far, np.tile([1.0, 0, 0], (3, 1)))
    np.testing.assert_array_equal(refined.points, far)
    assert (refined.support == 0).all()
    assert len(refine_points(matching, np.zeros((0, 3)), np.zeros((0, 3)))) == 0


@pytest.mark.slow(reason="starts Taichi anew")
def test_matching_does_not_depend_on_threads(start_taichi, generator):
    views = views_of([A, RIM], generator, noise_px=0.3)
    points, along = displaced(RIM, 200, pixel_of(views), generator)
    found = []
    for threads in (1, 2):
        start_taichi("f32", threads)
        matching = EdgelMatching(views)
        refined = refine_points(matching, points, along)
        found.append((refined.points, refined.support, *matching.matches(points, along, slice(3, 9), 2.0)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow(reason="starts Taichi anew")
@pytest.mark.parametrize("arch", ["vulkan", "cuda"])
def test_a_gpu_matches_as_the_cpu_does(start_taichi, generator, arch):
    views = views_of([A, RIM], generator, noise_px=0.3, count=6)
    points, along = displaced(RIM, 100, pixel_of(views), generator)
    found = {}
    for device in ("cpu", arch):
        start_taichi("f32", 1, device)
        matching = EdgelMatching(views)
        equations = matching.equations(points, along, 2.0, 0.5)
        numbers = (equations.matrices.reshape(-1, 9), equations.gradients, equations.weights, equations.views)
        found[device] = np.column_stack(numbers), *matching.matches(points, along, slice(0, 6), 2.0)
    same = found["cpu"][1] == found[arch][1]
    assert same.mean() > 0.99  # where two edgels are equally near, rounding decides
    np.testing.assert_array_equal(found["cpu"][3], found[arch][3])
    np.testing.assert_allclose(found["cpu"][2][same], found[arch][2][same], atol=1e-3)
    whole = same.all(axis=1)
    np.testing.assert_allclose(found["cpu"][0][whole], found[arch][0][whole], rtol=1e-2, atol=1.0)


def test_matches_are_the_nearest_edgels_brute_force(taichi, generator):
    views = views_of([A, RIM], generator, noise_px=1.0, count=4)
    points, along = displaced(A, 60, 3 * pixel_of(views), generator)
    matches, residuals, inside = EdgelMatching(views).matches(points, along, slice(0, 4), 3.0)
    assert inside.all() and max(RADII_PX) <= CELL
    for view in range(4):
        pixels, _ = views.project(points, view)
        ahead, _ = views.project(points + 1e-4 * along, view)
        images = (ahead - pixels) / np.linalg.norm(ahead - pixels, axis=1, keepdims=True)
        edgels, normals, _ = views.edgels.of_view(view)
        apart = np.linalg.norm(pixels[:, None] - edgels[None], axis=2)
        sines = np.abs(images @ normals.T)
        apart[sines > 0.35] = np.inf
        expected = np.where(apart.min(axis=1) < 3.0, apart.argmin(axis=1) + views.edgels.starts[view], -1)
        clear = np.abs(sines - 0.35).min(axis=1) > 1e-4  # not decided by rounding
        agree = expected[clear] == matches[clear, view]
        assert agree.mean() > 0.98  # two edgels may be equally near
        chosen = (matches[:, view] >= 0) & (expected == matches[:, view])
        at = matches[chosen, view] - views.edgels.starts[view]
        signed = ((pixels[chosen] - edgels[at]) * normals[at]).sum(axis=1)
        np.testing.assert_allclose(residuals[chosen, view], signed, atol=2e-3)


def narrow_cameras(count=16):
    """Cameras that look from similar directions: a point behind an edge projects onto it in many of them."""
    return tuple(array[:count] for array in ring_cameras(40 * count, SIZE, elevations=(30.0,)))


def test_a_ghost_behind_an_edge_has_no_support_of_its_own(taichi, generator):
    views = views_of([A], generator, cameras=narrow_cameras(), count=16)
    matching, pixel = EdgelMatching(views), pixel_of(views)
    edge, along = displaced(A, 200, 0.0, generator)
    away = edge - centre(views, 8)
    ghost = edge + 12 * pixel * away / np.linalg.norm(away, axis=1, keepdims=True)
    both = refine_points(matching, np.concatenate([edge, ghost]), np.tile(along, (2, 1)), radii=(1.0,))
    assert np.median(distances_to(A, both.points[200:])) > 4 * pixel
    support = explained_support(matching, both)
    assert np.median(both.support[200:]) > 0.3  # it lies on edgels in many views
    assert support[:200].min() > 0.8
    assert np.median(support[200:]) < 0.05


def noisy_means(curves, generator, views, count=300):
    """Points as training leaves them: half a pixel off, directions 10 degrees off, and some strays."""
    points, along = zip(*(displaced(curve, count, 0.7 * pixel_of(views), generator) for curve in curves), strict=True)
    strays = generator.uniform(0.2, 0.8, (60, 3))
    means, directions = np.concatenate([*points, strays]), np.concatenate([*along, generator.normal(size=(60, 3))])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions + generator.normal(0, 0.1, means.shape)
    return means, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@either_errors()
def test_filter_refines_keeps_edges_and_drops_strays(taichi, generator, errors):
    curves = (A, RIM, line([0.3, 0.7, 0.2], [0.3, 0.7, 0.8]))
    views = views_of(curves, generator, noise_px=0.1, hidden=0.3, errors=errors)
    means, directions = noisy_means(curves, generator, views)
    opacities = np.full(len(means), 0.9)
    opacities[:50] = 0.1
    config = FilterConfig(refine=True, min_opacity=0.2, outlier_neighbors=0)
    found, counts = filter_points(means, directions, opacities, views, config, 0.5)
    off = np.min([distances_to(curve, found.points) for curve in curves], axis=0)
    assert np.median(off) < 0.1 * pixel_of(views) and (off < pixel_of(views)).mean() > 0.99
    assert len(found.points) == len(found.directions) > 0.9 * (900 - 50)
    assert counts.gaussians == len(means) and counts.low_opacity == 50
    assert len(found) == counts.gaussians - counts.low_opacity - counts.low_support
