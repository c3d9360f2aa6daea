"""Calibration: biases planted in the edge maps of a synthetic part are found, and corrected, from the inputs alone."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from taichi_edges.calibration import consensus as consensus_module
from taichi_edges.calibration.backgrounds import flooded, image_steps, look_beside, sample, smooth_step
from taichi_edges.calibration.calibration import calibrate, sides_of
from taichi_edges.calibration.consensus import Consensus, across, edgel_table
from taichi_edges.calibration.offsets import (
    Observations,
    camera_leverage,
    fit_offsets,
    neighbourhoods,
    solve_offsets,
    standard_errors,
)
from taichi_edges.detectors.ridges import single_width, trace_ridges
from taichi_edges.synthetic.drawing import Imperfections, draw_edge_map
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import (
    SAMPLE_PX,
    camera_centre,
    pixel_size,
    render_edge_maps,
    render_picture,
    ring_cameras,
)
from taichi_edges.synthetic.visibility import ray_scene, sample_contours, sample_edges, visible_from
from taichi_edges.views.cameras import project
from taichi_edges.views.views import Views

SIZE, VIEWS, FINE = 260, 14, 3  # px, views, rays along each side of a pixel of the alpha channel
SHIFT, OFFSET = (-0.5, 0.7), 1.2  # px, planted
SEED_NOISE = 1.0  # px, standard deviation of the seeds across the true edges
UNKNOWN = np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class Part:
    """A part as its cameras see it: what is drawn into the edge maps, and how far that is outside its outline."""

    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    samples: list  # of each view: pixels (n, 2), chains, strokes, visible, distances (n,) px outside, outward (n, 2)
    image_paths: tuple
    points: np.ndarray
    directions: np.ndarray
    pixel: float


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """The bracket: straight edges and arcs, two through-holes, a smooth bend with contours."""
    folder, solid = tmp_path_factory.mktemp("images"), PARTS["bracket"]()
    intrinsics, poses = ring_cameras(VIEWS, SIZE)
    scene, pixel = ray_scene(solid), pixel_size(intrinsics, poses)
    edges = sample_edges(solid, SAMPLE_PX * pixel)
    samples, paths = [], []
    for view, camera in enumerate(zip(intrinsics, poses, strict=True)):
        _lens, pose = camera
        drawn = edges.with_further(sample_contours(solid, camera_centre(pose), SAMPLE_PX * pixel))
        pixels, _ = project(drawn.points, *camera)
        visible = visible_from(scene, drawn, camera_centre(pose))
        alpha = coverage(scene, *camera)
        paths.append(str(folder / f"{view}.png"))
        write_straight(paths[-1], render_picture(solid, scene, *camera, SIZE), alpha)
        samples.append((pixels, drawn.chains, drawn.strokes, visible, *outline_at(alpha, pixels)))
    chosen, directions = along_chains(edges)
    return Part(intrinsics, poses, samples, tuple(paths), edges.points[chosen], directions, pixel)


def coverage(scene, lens, pose):
    """(H, W) float: share of each pixel that the part covers."""
    steps = ((np.arange(SIZE * FINE) + 0.5) / FINE - 0.5).astype(np.float32)
    on_sensor = np.stack([*np.meshgrid(steps, steps), np.ones((SIZE * FINE,) * 2, np.float32)], axis=-1).reshape(-1, 3)
    directions = on_sensor @ (pose[:, :3].T @ np.linalg.inv(lens)).T.astype(np.float32)
    origins = np.broadcast_to(camera_centre(pose).astype(np.float32), directions.shape)
    hit = np.isfinite(scene.cast_rays(np.concatenate([origins, directions], axis=1))["t_hit"].numpy())
    return hit.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))


def write_straight(path, picture, alpha):
    """A picture on white as RGBA with straight alpha; where alpha is 0 the colours are meaningless, here dark."""
    straight = (picture - 255.0 * (1 - alpha[:, :, None])) / np.maximum(alpha[:, :, None], 1e-3)
    channels = np.clip(np.concatenate([straight[:, :, ::-1], 255 * alpha[:, :, None]], axis=2), 0, 255)
    cv2.imwrite(path, np.rint(channels).astype(np.uint8))


def outline_at(alpha, pixels):
    """How far (n,) px each of the pixels (n, 2) is outside the outline, about, and its normal (n, 2) outwards."""
    outside = (alpha < 0.5).astype(np.uint8)
    distance = cv2.distanceTransform(outside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - outside, cv2.DIST_L2, 5)
    smooth = cv2.GaussianBlur(distance, (0, 0), 2.0)
    slopes = np.stack([cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))], axis=-1)
    zero = np.zeros(1)
    outward = np.concatenate([sample(slopes[:, :, axis], pixels, pixels, zero) for axis in (0, 1)], axis=1)
    return sample(distance, pixels, pixels, zero)[:, 0], outward / np.linalg.norm(outward, axis=1, keepdims=True)


def along_chains(edges, every=5):
    """Indices of samples along the edges, and unit directions there."""
    inner = np.flatnonzero(
        (edges.chains[2:] == edges.chains[:-2]) & (np.linalg.norm(edges.points[2:] - edges.points[:-2], axis=1) > 0)
    )[::every]
    directions = edges.points[inner + 2] - edges.points[inner]
    return inner + 1, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@lru_cache
def planted(part, shift=(0.0, 0.0), offset=0.0, width=2.4, images=True):
    """Views of the part's edge maps, shifted and with silhouettes `offset` px outside; and their edgels."""
    maps, imperfections = [], replace(Imperfections.none(), width_px=width)
    for pixels, chains, strokes, visible, distances, outward in part.samples:
        moves = offset * smooth_step(2.5 - np.abs(distances))[:, None] * outward
        places = pixels + moves + np.asarray(shift)
        maps.append(draw_edge_map(places, chains, strokes, visible, SIZE, imperfections, np.random.default_rng(0)))
    names = tuple(str(view) for view in range(VIEWS))
    paths = part.image_paths if images else ("",) * VIEWS
    views = Views(names, np.stack(maps), part.intrinsics, part.world_to_camera, paths)
    return views, trace_ridges(views.edge_maps, width, 0.3)


def seeds(part, generator):
    """True points of the edges, moved at random, and directions along them."""
    return part.points + generator.normal(0, SEED_NOISE * part.pixel, part.points.shape), part.directions


def true_errors(part, edgels):
    """(n,) px from each edgel to the nearest visible true line, across it."""
    errors = []
    for view, (pixels, _, _, visible, _, _) in enumerate(part.samples):
        points, normals, _ = edgels.of_view(view)
        nearest = pixels[visible][cKDTree(pixels[visible]).query(points)[1]]
        errors.append(np.abs(((points - nearest) * normals).sum(axis=1)))
    return np.concatenate(errors)


@pytest.mark.slow(reason="calibrates many views")
@pytest.mark.parametrize("width", [2.4, 4.5])
@pytest.mark.parametrize("images", [True, False])
def test_planted_shift_and_offset_are_found_and_corrected(part, generator, images, width):
    views, edgels = planted(part, SHIFT, OFFSET, width, images)
    corrected, found = calibrate(views, edgels, *seeds(part, generator))
    assert found.shift == pytest.approx(SHIFT, abs=0.1)
    assert found.silhouette == pytest.approx(OFFSET, abs=0.1)
    assert found.shift_applied and found.silhouette_applied
    assert {found.shift_method, found.silhouette_method} == {"images" if images else "points"}
    assert np.median(true_errors(part, edgels)) > 0.5
    assert np.median(true_errors(part, corrected)) < 0.1
    assert np.nanmedian(np.abs(found.residuals)) < 0.1
    assert np.isfinite(found.residuals).mean() > 0.5  # points that few of the views see explain nothing


@pytest.mark.slow(reason="calibrates many views")
def test_with_images_the_rims_of_through_holes_are_corrected_too(part, generator):
    views, edgels = planted(part, SHIFT, OFFSET)
    _, found = calibrate(views, edgels, *seeds(part, generator))
    without = calibrate(replace(views, image_paths=("",) * VIEWS), edgels, *seeds(part, generator))[1]
    silhouettes = (found.on_silhouette > 0.9).sum()
    assert silhouettes > 1.03 * (without.on_silhouette > 0.9).sum()


@pytest.mark.slow(reason="calibrates many views")
@pytest.mark.parametrize("images", [True, False])
def test_without_bias_nothing_moves(part, generator, images):
    views, edgels = planted(part, images=images)
    corrected, found = calibrate(views, edgels, *seeds(part, generator))
    assert not found.shift_applied and not found.silhouette_applied
    np.testing.assert_allclose(found.shift, 0, atol=0.05)
    assert found.silhouette == pytest.approx(0, abs=0.05)
    np.testing.assert_array_equal(corrected.points, edgels.points)


@pytest.mark.slow(reason="calibrates many views")
def test_opaque_pictures_measure_the_shift_but_never_the_silhouettes(part, generator, tmp_path):
    views, edgels = planted(part, SHIFT, OFFSET)
    paths = tuple(str(tmp_path / f"{view}.png") for view in range(VIEWS))
    for path, source in zip(paths, views.image_paths, strict=True):
        cv2.imwrite(path, cv2.imread(source, cv2.IMREAD_UNCHANGED)[:, :, :3])
    _, found = calibrate(replace(views, image_paths=paths), edgels, *seeds(part, generator))
    assert found.shift == pytest.approx(SHIFT, abs=0.1)
    assert found.silhouette == pytest.approx(OFFSET, abs=0.15)
    assert found.silhouette_method == "points"


@pytest.mark.slow(reason="calibrates many views")
def test_given_values_are_taken_and_zeros_switch_off(part, generator):
    views, edgels = planted(part, SHIFT, OFFSET)
    corrected, found = calibrate(views, edgels, *seeds(part, generator), fixed_shift=(2.0, -1.0), fixed_silhouette=0.0)
    np.testing.assert_array_equal(found.shift, [2.0, -1.0])
    np.testing.assert_allclose(corrected.points - edgels.points, np.tile([-2.0, 1.0], (len(edgels), 1)), atol=1e-4)
    assert (found.shift_method, found.shift_applied, found.silhouette_applied) == ("fixed", True, False)
    _, found = calibrate(views, edgels, *seeds(part, generator), fixed_shift=SHIFT)
    assert (found.shift_method, found.silhouette_method) == ("fixed", "images")
    assert found.silhouette == pytest.approx(OFFSET, abs=0.1)


@pytest.mark.slow(reason="calibrates many views")
def test_too_few_points_and_no_images_leave_the_edgels_alone(part, generator):
    views, edgels = planted(part, SHIFT, OFFSET, images=False)
    points, directions = seeds(part, generator)
    corrected, found = calibrate(views, edgels, points[:20], directions[:20])
    np.testing.assert_array_equal(corrected.points, edgels.points)
    assert (found.shift_method, found.silhouette_method) == ("none", "none")
    assert "20 3D points are too few" in found.reason and np.isnan(found.residuals).all()
    assert found.facts()["shift_error_px"] == [None, None]
    corrected, found = calibrate(views, edgels, points[:0], directions[:0], fixed_silhouette=OFFSET)
    assert found.silhouette_applied and not np.array_equal(corrected.points, edgels.points)


@pytest.mark.slow(reason="calibrates many views")
def test_points_that_the_views_do_not_agree_on_say_nothing(part, generator, monkeypatch):
    views, edgels = planted(part, SHIFT, OFFSET, images=False)
    monkeypatch.setattr(consensus_module, "MOST_RESIDUAL", 0.001)
    _, found = calibrate(views, edgels, *seeds(part, generator))
    assert "agree on 3D points to" in found.reason and not found.shift_applied and not found.silhouette_applied


@pytest.mark.slow(reason="calibrates many views")
def test_errors_through_points_cover_cameras_that_are_a_little_wrong(part, generator):
    views, edgels = planted(part, SHIFT, OFFSET, images=False)
    cameras = generator.normal(0, 0.1, (VIEWS, 2))
    _, found = calibrate(views, edgels.moved(cameras[edgels.views]), *seeds(part, generator))
    assert np.abs(found.shift_error).max() < 0.4 and found.silhouette_error < 0.2
    assert (np.abs(found.shift - SHIFT) < 4 * found.shift_error).all()
    assert abs(found.silhouette - OFFSET) < 4 * found.silhouette_error


def unbiased(name, generator, views=12, size=300, smooth=0):
    """Views of a part's edge maps, contours and imperfections included but no bias; their edgels; seeds on the edges.

    smooth: number of further seeds, on lines along smooth surfaces, as contours make them.
    """
    solid, cameras = PARTS[name](), ring_cameras(views, size)
    pixel = pixel_size(*cameras)
    maps = render_edge_maps(solid, *cameras, size, Imperfections(), generator)
    edges = sample_edges(solid, SAMPLE_PX * pixel)
    chosen, directions = along_chains(edges, every=10)
    points = edges.points[chosen]
    if smooth:
        ends = solid.vertices[solid.mesh_edges.ends[~solid.mesh_edges.sharp]]
        along = ends[:, 1] - ends[:, 0]
        lengths = np.linalg.norm(along, axis=1)
        some = generator.choice(np.flatnonzero(lengths > 5 * pixel), smooth)
        points = np.concatenate([points, ends[some, 0] + generator.random((smooth, 1)) * along[some]])
        directions = np.concatenate([directions, along[some] / lengths[some, None]])
    points = points + generator.normal(0, SEED_NOISE * pixel, points.shape)
    found = Views(tuple(map(str, range(views))), maps, *cameras, ("",) * views)
    return found, trace_ridges(maps, Imperfections().width_px, 0.3), points, directions


@pytest.mark.slow(reason="calibrates many views")
def test_chance_pairs_between_thin_bars_are_no_bias(generator):
    # Bars of 3 px, whose lines blend: nearly all points have one or two edgels, with which they agree to nothing.
    views, edgels, *seeds = unbiased("frame", generator)
    corrected, found = calibrate(views, edgels, *seeds)
    assert not found.shift_applied and not found.silhouette_applied
    np.testing.assert_array_equal(corrected.points, edgels.points)


@pytest.mark.slow(reason="calibrates many views")
def test_contours_of_a_slim_shaft_are_no_bias(generator):
    # Seen from anywhere a contour lies the radius, some pixels, outside the axis.
    views, edgels, *seeds = unbiased("shaft", generator, size=400, smooth=1000)
    corrected, found = calibrate(views, edgels, *seeds)
    assert not found.shift_applied and not found.silhouette_applied
    np.testing.assert_array_equal(corrected.points, edgels.points)


@pytest.mark.slow(reason="calibrates many views")
def test_images_that_show_other_edges_than_the_maps_say_nothing(part, generator):
    views, edgels = planted(part, SHIFT, OFFSET)
    assert calibrate(views, edgels, *seeds(part, generator))[1].shift_method == "images"
    scattered = edgels.moved(generator.normal(0, 1.5, (len(edgels), 2)))
    _, found = calibrate(views, scattered, *seeds(part, generator))
    assert "images" not in (found.shift_method, found.silhouette_method)


@pytest.mark.slow(reason="calibrates many views")
@pytest.mark.parametrize("leaked", [0, 3])
def test_silhouettes_of_views_whose_background_leaked_do_not_count(part, generator, leaked):
    values, views, edgels = np.array([OFFSET, *SHIFT]), *planted(part, images=False)
    points, directions = seeds(part, generator)
    consensus = Consensus(views, edgels, sides_of(views, edgels), points, directions)
    observations = observations_of(generator, 20000, 400, values, np.zeros((400, 2)), 0.1)
    inside = (observations.views < leaked) & (observations.silhouette > 0)
    observations.offsets[inside] -= OFFSET
    observations = observations.keep(observations.views < VIEWS)
    kept = consensus.without_odd_views(observations, UNKNOWN)
    np.testing.assert_array_equal(np.unique(kept.views[kept.silhouette > 0]), np.arange(leaked, VIEWS))
    assert (kept.silhouette == 0).sum() == (observations.silhouette == 0).sum()
    np.testing.assert_allclose(fit_offsets(kept, UNKNOWN, len(consensus.points)).values, values, atol=0.03)


@pytest.mark.slow(reason="calibrates many views")
def test_maps_without_edges_are_no_problem(part, generator):
    views, _ = planted(part, images=True)
    empty = replace(views, edge_maps=np.zeros_like(views.edge_maps))
    edgels = trace_ridges(empty.edge_maps, 2.4, 0.3)
    corrected, found = calibrate(empty, edgels, *seeds(part, generator))
    assert len(corrected) == 0 and found.reason and not found.shift_applied


@pytest.mark.slow(reason="calibrates many views")
@pytest.mark.parametrize("images", [True, False])
def test_neither_threads_nor_the_order_of_the_points_matter(part, generator, images):
    views, edgels = planted(part, SHIFT, OFFSET, images=images)
    points, directions = seeds(part, generator)
    once, first = calibrate(views, edgels, points, directions, threads=1)
    again, second = calibrate(views, edgels, points, directions, threads=3)
    np.testing.assert_array_equal(once.points, again.points)
    np.testing.assert_array_equal(first.residuals, second.residuals)
    assert first.facts() == second.facts()
    order = generator.permutation(len(points))
    third = calibrate(views, edgels, points[order], directions[order])[1]
    np.testing.assert_allclose(third.shift, first.shift, atol=1e-6)  # sums in another order
    assert third.silhouette == pytest.approx(first.silhouette, abs=1e-6)


def observations_of(generator, count, points, values, displacements, noise):
    """Random observations of so many points that fulfil the model up to noise."""
    angles, owners = generator.uniform(0, 2 * np.pi, count), generator.integers(points, size=count)
    normals, slopes = np.stack([np.cos(angles), np.sin(angles)], axis=1), generator.normal(size=(count, 2))
    silhouette = (generator.random(count) < 0.5).astype(float)
    offsets = np.column_stack([silhouette, normals]) @ values + (slopes * displacements[owners]).sum(axis=1)
    offsets += generator.normal(0, noise, count)
    views = generator.integers(20, size=count)
    return Observations(offsets, normals, silhouette, np.arange(count), views, owners, slopes)


def test_eliminated_points_give_what_dense_least_squares_give(generator):
    values, displacements = np.array([1.2, -0.4, 0.3]), generator.normal(0, 2, (30, 2))
    observations = observations_of(generator, 900, 30, values, displacements, 0.05)
    fit = fit_offsets(observations, UNKNOWN, 30)
    dense = np.zeros((900, 63))
    dense[:, :3] = observations.columns
    dense[np.arange(900)[:, None], 3 + 2 * observations.owners[:, None] + [0, 1]] = observations.slopes
    roots = np.sqrt(fit.weights)
    prior = np.diag(np.concatenate([np.full(3, 0.01), np.full(60, 0.1)]))  # one over 100 px and 10 px
    matrix, right = np.vstack([dense * roots[:, None], prior]), np.append(observations.offsets * roots, np.zeros(63))
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    # The last weights were made of the last residuals, the solution of those before: they have all but settled.
    np.testing.assert_allclose(fit.values, expected[:3], atol=1e-3)
    np.testing.assert_allclose(fit.displacements.reshape(-1), expected[3:], atol=1e-3)
    np.testing.assert_allclose(fit.values, values, atol=0.03)


def test_leverage_of_the_cameras_is_what_moving_views_does(generator):
    observations = observations_of(generator, 900, 30, np.zeros(3), np.zeros((30, 2)), 0.05)
    fit = fit_offsets(observations, UNKNOWN, 30)
    found = []
    for view, axis in np.ndindex(20, 2):
        moved = np.where(observations.views == view, 1e-4 * observations.normals[:, axis], 0.0)
        again = solve_offsets(replace(observations, offsets=moved), fit.weights, UNKNOWN, 30)[0]
        found.append(again / 1e-4)
    expected = np.linalg.norm(found, axis=0)
    np.testing.assert_allclose(camera_leverage(observations, fit, UNKNOWN, 30), expected, rtol=1e-6)


def test_a_third_of_outliers_does_not_move_the_fit(generator):
    values, displacements = np.array([1.2, -0.4, 0.3]), generator.normal(0, 2, (30, 2))
    observations = observations_of(generator, 3000, 30, values, displacements, 0.1)
    observations.offsets[::3] += generator.uniform(1, 5, 1000)
    np.testing.assert_allclose(fit_offsets(observations, UNKNOWN, 30).values, values, atol=0.1)


def test_standard_errors_are_those_of_repeated_experiments(generator):
    values, errors = [], []
    for _ in range(60):
        observations = observations_of(generator, 600, 20, np.array([1.0, 0.5, 0.0]), np.zeros((20, 2)), 0.2)
        per_view = generator.normal(0, 0.2, (20, 2))  # what all observations of a view share
        observations.offsets[:] += (observations.normals * per_view[observations.views]).sum(axis=1)
        plain = replace(observations, owners=None, slopes=None)
        fit = fit_offsets(plain, UNKNOWN)
        values.append(fit.values)
        errors.append(standard_errors(plain, fit, UNKNOWN))
    spread, claimed = np.std(values, axis=0), np.median(errors, axis=0)
    # Two errors that 60 repetitions and 10 blocks make: 9 and 24 %; both variances together claim up to sqrt 2.
    assert (claimed > 0.7 * spread).all() and (claimed < 2.0 * spread).all()


def test_what_nothing_observes_has_no_small_error(generator):
    observations = observations_of(generator, 600, 20, np.array([0.0, 0.5, 0.0]), np.zeros((20, 2)), 0.1)
    inside = observations.keep(observations.silhouette == 0)
    fit = fit_offsets(inside, UNKNOWN, 20)
    errors = standard_errors(inside, fit, UNKNOWN, generator.random((20, 3)))
    assert fit.values[0] == pytest.approx(0) and errors[0] > 1 and errors[1:].max() < 0.1


def test_neighbourhoods_are_equally_large_and_compact(generator):
    points = generator.random((160, 3))
    labels = neighbourhoods(points)
    np.testing.assert_array_equal(np.bincount(labels), np.full(16, 10))
    assert np.mean([np.ptp(points[labels == label], axis=0).mean() for label in range(16)]) < 0.5


def test_flood_fills_the_outside_but_does_not_leak_through_gaps():
    edge_map = np.zeros((80, 90), np.uint8)
    cv2.rectangle(edge_map, (20, 20), (60, 60), 255, 2)
    edge_map[18:23, 37:43] = 0  # a gap of 6 px
    background = flooded(edge_map)
    assert background[25:56, 25:56].max() == 0 and background[5:15].min() == 1 and background[20:60, 65:].min() == 1
    edge_map[18:23, 30:50] = 0
    assert flooded(edge_map)[40, 40] == 1


@pytest.mark.parametrize("place", [-2.3, 0.0, 1.6])
def test_steps_of_images_are_found_at_their_place(place):
    columns = np.tile(np.arange(60.0), (40, 1))
    grey = (100.0 * np.clip(columns - (30 + place) + 0.5, 0, 1)).astype(np.float32)  # a step, pixels integrate it
    points = np.stack([np.full(20, 30.0), np.arange(10.0, 30)], axis=1)
    np.testing.assert_allclose(image_steps(grey, points, np.tile([1.0, 0.0], (20, 1))), place, atol=0.05)
    assert np.isnan(image_steps(np.full_like(grey, 7), points, np.tile([1.0, 0.0], (20, 1)))).all()


def test_two_steps_next_to_each_other_are_none():
    columns = np.tile(np.arange(60.0), (40, 1))
    grey = np.where(np.abs(columns - 30) < 2, 100.0, 0.0).astype(np.float32)  # a dark or bright line
    points = np.stack([np.full(20, 31.0), np.arange(10.0, 30)], axis=1)
    assert np.isnan(image_steps(grey, points, np.tile([1.0, 0.0], (20, 1)))).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_depth_of_an_outline_is_measured_outwards_whatever_way_the_normal_points(sign, tmp_path):
    columns = np.tile(np.arange(80.0), (60, 1))
    covered = np.clip(41.3 - columns + 0.5, 0, 1)  # the object ends at 41.3
    image = np.dstack([np.full((60, 80, 3), 90.0), 255 * covered])
    cv2.imwrite(str(tmp_path / "image.png"), np.rint(image).astype(np.uint8))
    points, normals = np.array([[42.5, 20.0], [42.5, 30.0], [20.0, 30.0]]), sign * np.tile([1.0, 0.0], (3, 1))
    sides = look_beside(np.zeros((60, 80), np.uint8), str(tmp_path / "image.png"), points, normals, 2.4)
    np.testing.assert_allclose(sides.depths[:2], -1.2, atol=0.02)
    np.testing.assert_array_equal(sides.outward[:2], [[1, 0], [1, 0]])
    np.testing.assert_array_equal(sides.silhouettes(), [1, 1, 0])
    np.testing.assert_array_equal(sides.interior, [False, False, True])


def test_samples_are_bilinear_and_the_border_goes_on():
    image = np.add.outer(10.0 * np.arange(5), np.arange(6.0))
    values = sample(image, np.array([[1.5, 2.25], [4.0, 3.5]]), np.array([[1.0, 0.0], [0.0, 1.0]]), np.arange(3.0))
    np.testing.assert_allclose(values, [[24, 25, 26], [39, 44, 44]])


def test_a_walk_cannot_slip_through_a_diagonal_line():
    places = np.stack([np.arange(5.0, 15), np.arange(15.0, 5, -1)], axis=1)
    table = edgel_table(places, (30, 30))
    for start in np.arange(0, 3, 0.1):
        steps = np.rint(start + np.arange(20)).astype(int)
        assert (table[steps + 1, np.rint(np.arange(20)).astype(int) + 1] >= 0).any()
    assert table[16, 6] == 0 and table[15, 6] >= 0 and table[1, 1] == -1


def test_the_two_directions_across_are_orthonormal(generator):
    directions = generator.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    frames = np.concatenate([across(directions), directions[:, None]], axis=1)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)


@pytest.mark.slow(reason="calibrates many views")
def test_points_move_to_where_the_edgels_are(part, generator):
    views, edgels = planted(part, images=False)
    sides = sides_of(views, edgels)
    points, directions = seeds(part, generator)
    consensus = Consensus(views, edgels, sides, points, directions)
    consensus.estimate(np.zeros(3), np.zeros(3))

    def off(places):  # px across the edges
        moved = np.einsum("nkj,nj->nk", across(directions), places - part.points) / part.pixel
        return np.median(np.linalg.norm(moved, axis=1))

    assert off(points) > 0.9 and off(consensus.points) < 0.25


@pytest.mark.parametrize("gap", [1.75, 3.0])
def test_ridges_of_wide_bands_have_no_bias_until_the_bands_blend(gap):
    width, rows = 7.0, np.arange(100.0)[:, None]
    first, second = (np.exp(-0.5 * ((rows - place) / (width / 2.355)) ** 2) for place in (40.3, 40.3 + gap * width))
    edge_map = np.rint(255 * np.tile(np.maximum(first, second), (1, 60))).astype(np.uint8)
    edgels = trace_ridges(edge_map[None], width, 0.3)
    rows = edgels.points[:, 1]
    assert np.abs(np.abs(rows - 40.3 - gap * width / 2) - gap * width / 2).max() < 0.05


@pytest.mark.parametrize("gap", [3.2, 12.0])
def test_width_of_single_lines_is_measured_where_lines_blend(gap):
    width, rows = 2.5, np.arange(100.0)[:, None]
    places = np.concatenate([place + gap * np.arange(2) for place in (20.3, 44.6, 68.9)])
    bands = np.exp(-0.5 * ((rows - places) / (width / 2.355)) ** 2).max(axis=1, keepdims=True)
    edge_map = np.rint(255 * np.tile(bands, (1, 60))).astype(np.uint8)
    # Smoothed as for lines of 3.5 px, ridges 3.2 px apart are drawn together, away from their free flanks.
    assert single_width(edge_map[None], 3.5, 0.3) == pytest.approx(width, abs=0.7)
    assert single_width(edge_map[None], width, 0.3) == pytest.approx(width, abs=0.35)
    edgels = trace_ridges(edge_map[None], 3.5, 0.3)
    nearest = np.abs(edgels.points[:, 1:] - places).min(axis=1)
    assert len(edgels) == 6 * 60 and nearest.max() < 0.3
    assert len(trace_ridges(np.zeros((1, 40, 40), np.uint8), 2.5, 0.3)) == 0
