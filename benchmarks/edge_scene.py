"""Scenes for the benchmarks: 3D lines and arcs, maps of them as many as wanted in any size, Gaussians along them.

Maps are drawn with OpenCV and nothing hides anything: a thousand of them take seconds, and what a view step costs
depends on how many pixels are edges, not on which of them a camera would really see.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from taichi_edges.splatting.gaussians import start_gaussians
from taichi_edges.synthetic.rendering import pixel_size, ring_cameras
from taichi_edges.views.cameras import project

CURVES = 18  # half of them arcs, 4.5 units long in all: some 4500 edge pixels in a view of 800 x 800
LENGTHS = (0.15, 0.35)  # unit-cube units
SAMPLES = 33  # points on a curve
LINE_WIDTH_PX = 2  # as OpenCV counts; it draws them 3 px wide
NOISE_PX = 2.0  # standard deviation of the Gaussians' distance from their curve
SUBPIXEL_BITS = 4  # of the coordinates that OpenCV draws at


@dataclass(frozen=True, eq=False)
class EdgeScene:
    """curves: (c, SAMPLES, 3) points in the unit cube. The rest is what a Splatter takes."""

    curves: np.ndarray
    edge_maps: np.ndarray
    intrinsics: np.ndarray
    world_to_camera: np.ndarray


def make_scene(view_count, width, height, seed=0):
    """Maps (V, height, width) uint8 of the same curves, from cameras all around."""
    curves = make_curves(np.random.default_rng(seed))
    intrinsics, poses = make_cameras(view_count, width, height)
    edge_maps = np.full((view_count, height, width), 0, np.uint8)  # written to, so that it counts as memory in use
    for edge_map, *camera in zip(edge_maps, intrinsics, poses, strict=True):
        draw(edge_map, curves, *camera)
    return EdgeScene(curves, edge_maps, intrinsics, poses)


def make_curves(generator):
    """(CURVES, SAMPLES, 3): straight lines and quarter circles, anywhere in the unit cube."""
    curves = []
    steps = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    for number in range(CURVES):
        middle, length = generator.uniform(0.15, 0.85, 3), generator.uniform(*LENGTHS)
        along, across = np.linalg.qr(generator.normal(size=(3, 2)))[0].T
        if number % 2:
            curves.append(middle + (steps - 0.5) * length * along)
        else:
            angle, radius = steps * np.pi / 2, length / (np.pi / 2)
            curves.append(middle + radius * (np.cos(angle) * along + np.sin(angle) * across))
    return np.stack(curves)


def make_cameras(view_count, width, height):
    """Cameras on rings around the unit cube, which fills the shorter side of the image."""
    intrinsics, poses = ring_cameras(view_count, min(width, height))
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = (width - 1) / 2.0, (height - 1) / 2.0
    return intrinsics, poses


def draw(edge_map, curves, lens, pose):
    """Draw the curves, LINE_WIDTH_PX wide, into one (H, W) map."""
    pixels, _ = project(curves.reshape(-1, 3), lens, pose)
    fixed_point = np.rint(pixels * (1 << SUBPIXEL_BITS)).astype(np.int32).reshape(len(curves), -1, 1, 2)
    cv2.polylines(edge_map, list(fixed_point), False, 255, LINE_WIDTH_PX, cv2.LINE_8, SUBPIXEL_BITS)


def scatter_gaussians(scene, count, generator):
    """`count` Gaussians as training starts them, evenly along the curves with NOISE_PX of noise around them."""
    starts, ends = scene.curves[:, :-1].reshape(-1, 3), scene.curves[:, 1:].reshape(-1, 3)
    lengths = np.linalg.norm(ends - starts, axis=1)
    chosen = generator.choice(len(starts), count, p=lengths / lengths.sum())
    points = starts[chosen] + generator.random((count, 1)) * (ends - starts)[chosen]
    noise = NOISE_PX * pixel_size(scene.intrinsics, scene.world_to_camera)
    return start_gaussians(points + generator.normal(0.0, noise, points.shape), generator, 0.004, 0.08)
