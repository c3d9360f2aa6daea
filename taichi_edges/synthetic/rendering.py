"""Posed views of a part: cameras on rings, edge maps and shaded pictures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from taichi_edges.synthetic.drawing import Imperfections, draw_edge_map
from taichi_edges.synthetic.visibility import ray_scene, sample_contours, sample_edges, visible_from
from taichi_edges.views.cameras import camera_centre, project
from taichi_edges.views.light import light_of_srgb, srgb_of_light
from taichi_edges.views.views import Views

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

    from taichi_edges.synthetic.solids import Part

__all__ = ["Imperfections", "render_edge_maps", "render_pictures", "render_views", "ring_cameras"]

ELEVATIONS = (22.0, 52.0, -32.0)  # degrees above the horizon, one ring each; from below, the underside shows
FIELD_OF_VIEW = 40.0  # degrees
FIRST_AZIMUTH = 17.0  # degrees: no camera looks straight along a side of the cube
CUBE_CENTRE = np.full(3, 0.5)
CUBE_RADIUS = np.sqrt(3.0) / 2.0  # of the sphere about the unit cube, which just fits into every view
SAMPLE_PX = 0.4  # spacing of the samples along an edge, in pixels at the centre of the cube

# Directions towards three lamps and their colours: no two faces of a part come out alike, so that a detector which
# reads the pictures finds every edge.
LAMPS = np.array([[0.35, -0.55, 0.76], [-0.85, 0.15, 0.50], [0.30, 0.55, -0.65]])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)
LAMP_COLOURS = np.array([[0.44, 0.50, 0.53], [0.18, 0.26, 0.36], [0.26, 0.24, 0.30]])
AMBIENT = np.array([0.07, 0.09, 0.12])
GLOOM = 0.4  # how much darker the floor of the cube is than its middle; sets parallel faces at different heights apart
SUPERSAMPLING = 2  # rays along each side of a pixel of the pictures


def ring_cameras(
    view_count: int, image_size: int, elevations: Sequence[float] = ELEVATIONS, field_of_view: float = FIELD_OF_VIEW
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras evenly around the unit cube, on one ring for each elevation in turn, looking at its centre, z upwards.

    image_size: pixels, width and height. elevations, field_of_view: degrees. The whole cube is in every view.
    Returns intrinsics (V, 3, 3), pixel centres at integers, and world_to_camera (V, 3, 4), OpenCV axes.
    """
    half = np.radians(field_of_view) / 2.0
    focal, middle = image_size / 2.0 / np.tan(half), (image_size - 1) / 2.0
    intrinsics = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    views = np.arange(view_count)
    azimuths = np.radians(FIRST_AZIMUTH) + 2.0 * np.pi * views / view_count
    heights = np.radians(np.asarray(elevations))[views % len(elevations)]
    outward = np.stack(
        [np.cos(heights) * np.cos(azimuths), np.cos(heights) * np.sin(azimuths), np.sin(heights)], axis=1
    )
    centres = CUBE_CENTRE + CUBE_RADIUS / np.sin(half) * outward
    poses = np.stack([look_at(centre, CUBE_CENTRE) for centre in centres])
    return np.repeat(intrinsics[None], view_count, axis=0), poses


def look_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(3, 4) world_to_camera of a camera at `centre` that looks at `target`, the world's z upwards in the picture."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ centre])


def pixel_size(intrinsics: np.ndarray, world_to_camera: np.ndarray) -> float:
    """World units that a pixel spans at the centre of the cube, in the view where they are the fewest."""
    depths = (world_to_camera[:, :, :3] @ CUBE_CENTRE + world_to_camera[:, :, 3])[:, 2]
    return float((depths / intrinsics[:, 0, 0]).min())


def render_views(
    part: "Part", view_count: int, image_size: int, imperfections: Imperfections, generator: np.random.Generator
) -> tuple[Views, np.ndarray]:
    """Edge maps and pictures of a part from `ring_cameras`.

    image_size: pixels, width and height. generator: numpy.random.Generator, of which the imperfections draw.
    Returns Views (image_paths '': the caller saves the pictures) and the pictures (V, H, W, 3) uint8 RGB.
    """
    cameras = ring_cameras(view_count, image_size)
    edge_maps = render_edge_maps(part, *cameras, image_size, imperfections, generator)
    names = tuple(f"{part.name}_{view:03d}" for view in range(view_count))
    views = Views(names, edge_maps, *cameras, image_paths=("",) * view_count)
    return views, render_pictures(part, *cameras, image_size)


def render_edge_maps(
    part: "Part",
    intrinsics: np.ndarray,
    world_to_camera: np.ndarray,
    image_size: int,
    imperfections: Imperfections,
    generator: np.random.Generator,
) -> np.ndarray:
    """(V, H, W) uint8 edge maps of a part from given cameras (V, 3, 3) and (V, 3, 4)."""
    scene = ray_scene(part)
    spacing = SAMPLE_PX * pixel_size(intrinsics, world_to_camera)
    edges = sample_edges(part, spacing)
    edge_maps = np.empty((len(intrinsics), image_size, image_size), np.uint8)
    for view, (lens, pose) in enumerate(zip(intrinsics, world_to_camera, strict=True)):
        centre = camera_centre(pose)
        samples = edges.with_further(sample_contours(part, centre, spacing)) if imperfections.contours else edges
        pixels, _ = project(samples.points, lens, pose)
        visible = visible_from(scene, samples, centre) & np.isfinite(pixels).all(axis=1)
        edge_maps[view] = draw_edge_map(
            pixels, samples.chains, samples.strokes, visible, image_size, imperfections, generator
        )
    return edge_maps


def render_pictures(part: "Part", intrinsics: np.ndarray, world_to_camera: np.ndarray, image_size: int) -> np.ndarray:
    """(V, H, W, 3) uint8 RGB shaded pictures on white."""
    scene = ray_scene(part)
    return np.stack(
        [render_picture(part, scene, *camera, image_size) for camera in zip(intrinsics, world_to_camera, strict=True)]
    )


def render_picture(
    part: "Part", scene: "RaycastingScene", lens: np.ndarray, pose: np.ndarray, image_size: int
) -> np.ndarray:
    """(H, W, 3) uint8 RGB: one shaded picture on white. A pixel holds the mean light over its area, as in a camera."""
    fine = image_size * SUPERSAMPLING
    steps = (np.arange(fine, dtype=np.float32) + 0.5) / SUPERSAMPLING - 0.5  # pixel centres at integers
    columns, rows = np.meshgrid(steps, steps)
    on_sensor = np.stack([columns, rows, np.ones_like(columns)], axis=-1).reshape(-1, 3)
    # In C order, which makes the product five times as fast.
    directions = on_sensor @ (pose[:, :3].T @ np.linalg.inv(lens)).T.astype(np.float32, order="C")
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3], rays[:, 3:] = camera_centre(pose), directions
    hits = scene.cast_rays(rays)
    depths = hits["t_hit"].numpy()
    hit = np.isfinite(depths)
    heights = rays[hit, 2] + depths[hit] * rays[hit, 5]
    colours = np.ones((fine * fine, 3), np.float32)
    normals = interpolated_normals(part, hits["primitive_ids"].numpy()[hit], hits["primitive_uvs"].numpy()[hit])
    colours[hit] = light_of_srgb(shade(normals, heights))
    picture = cv2.resize(colours.reshape(fine, fine, 3), (image_size, image_size), interpolation=cv2.INTER_AREA)
    return np.rint(255.0 * srgb_of_light(picture)).astype(np.uint8)


def interpolated_normals(part: "Part", triangles: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals at points of triangles (n,), given by the weights (n, 2) of the second and third corner."""
    weights = np.column_stack([1.0 - barycentric.sum(axis=1), barycentric])
    normals = np.einsum("nc,nck->nk", weights, part.corner_normals[triangles])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def shade(normals: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals and (n,) heights in the cube -> (n, 3) RGB in 0..1.

    The lamps are soft: their light wraps half-way round the back of the part.
    """
    wrapped = (0.5 + 0.5 * normals @ LAMPS.T) ** 2
    dimmed = 1.0 + 2.0 * GLOOM * (heights[:, None] - 0.5)
    return np.clip((AMBIENT + wrapped @ LAMP_COLOURS) * dimmed, 0.0, 1.0)
