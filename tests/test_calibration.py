"""Calibration: biases planted in the edge maps of a synthetic part are found, and corrected, from the inputs alone."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from taichi_edges.cameras import project
from taichi_edges.detectors.backgrounds import flooded, image_steps, look_beside, sample, smooth_step
from taichi_edges.detectors.calibration import calibrate
from taichi_edges.detectors.consensus import across, edgel_table
from taichi_edges.detectors.offsets import Observations, fit_offsets, neighbourhoods, standard_errors
from taichi_edges.detectors.ridges import trace_ridges
from taichi_edges.edgels import Edgels
from taichi_edges.synthetic.drawing import Imperfections, draw_edge_map
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import SAMPLE_PX, camera_centre, pixel_size, render_picture, ring_cameras
from taichi_edges.synthetic.visibility import ray_scene, sample_contours, sample_edges, visible_from
from taichi_edges.views import Views

SIZE, VIEWS, FINE = 300, 15, 4  # px, views, rays along each side of a pixel of the alpha channel
SHIFT, OFFSET = (-0.5, 0.7), 1.2  # px, planted
SEED_NOISE = 1.0  # px, standard deviation of the seeds across the true edges
UNKNOWN = np.full(3, np.nan)


@dataclass(frozen=True)
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
    for view, camera in enumerate(zip(intrinsics, poses)):
        lens, pose = camera
        drawn = edges.joined(sample_contours(solid, camera_centre(pose), SAMPLE_PX * pixel))
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
    """(n,) px from each edgel to the nearest visible true line."""
    errors = []
    for view, (pixels, _, _, visible, _, _) in enumerate(part.samples):
        points, normals, _ = edgels.of_view(view)
        lines = pixels[visible]
        nearest = np.array([((lines - point) ** 2).sum(axis=1).argmin() for point in points])
        errors.append(np.abs(((points - lines[nearest]) * normals).sum(axis=1)))
    return np.concatenate(errors)


@pytest.mark.parametrize("width", [2.4, 4.5])
@pytest.mark.parametrize("images", [True, False])
def test_planted_shift_and_offset_are_found_and_corrected(part, generator, images, width):
    views, edgels = planted(part, SHIFT, OFFSET, width, images)
    corrected, found = calibrate(views, edgels, *seeds(part, generator))
    print(found.facts())
    assert found.shift == pytest.approx(SHIFT, abs=0.1)
    assert found.silhouette == pytest.approx(OFFSET, abs=0.1 if images else 0.15)
    assert found.shift_applied and found.silhouette_applied
    assert (found.shift_method, found.silhouette_method) == (("images",) * 2 if images else ("points",) * 2)
    before, after = true_errors(part, edgels), true_errors(part, corrected)
    print(np.median(before), np.median(after), np.mean(before), np.mean(after))


@pytest.mark.parametrize("images", [True, False])
def test_without_bias_nothing_moves(part, generator, images):
    views, edgels = planted(part, images=images)
    corrected, found = calibrate(views, edgels, *seeds(part, generator))
    print(found.facts())
    assert not found.shift_applied and not found.silhouette_applied
    np.testing.assert_array_equal(corrected.points, edgels.points)
