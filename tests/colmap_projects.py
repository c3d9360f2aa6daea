"""COLMAP projects whose truth is known: models written by pycolmap, pictures drawn through its lenses."""

import cv2
import numpy as np  # before pycolmap: see photogrammetry
import pycolmap

from taichi_edges.synthetic.rendering import interpolated_normals, shade
from taichi_edges.synthetic.visibility import ray_scene
from taichi_edges.views.cameras import invert_pose
from taichi_edges.views.light import light_of_srgb, srgb_of_light

# (fx, fy, cx, cy and what the model adds) of every model that a pinhole camera can show, for pictures of 320 x 240 px.
LENSES = {
    "SIMPLE_PINHOLE": (300, 160.5, 119),
    "PINHOLE": (300, 310, 160.5, 119),
    "SIMPLE_RADIAL": (300, 160.5, 119, -0.08),
    "RADIAL": (300, 160.5, 119, -0.08, 0.03),
    "OPENCV": (300, 310, 160.5, 119, -0.1, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (300, 310, 160.5, 119, -0.1, 0.02, 0.003, -0.002, 0.01, 0.02, 0.01, 0.005),
    "FOV": (300, 310, 160.5, 119, 0.6),
    "OPENCV_FISHEYE": (300, 310, 160.5, 119, 0.03, -0.01, 0.002, 0.001),
    "SIMPLE_RADIAL_FISHEYE": (300, 160.5, 119, 0.03),
    "RADIAL_FISHEYE": (300, 160.5, 119, 0.03, -0.01),
    "SIMPLE_FISHEYE": (300, 160.5, 119),
    "FISHEYE": (300, 310, 160.5, 119),
    "THIN_PRISM_FISHEYE": (300, 310, 160.5, 119, 0.03, -0.01, 0.002, 0.001, 0.001, 0.002, 0.01, -0.01),
    "RAD_TAN_THIN_PRISM_FISHEYE": (300, 310, 160.5, 119, 0.03, -0.01, 0, 0, 0, 0, 0.002, 0.001, 0.01, 0, -0.01, 0),
    "SIMPLE_DIVISION": (300, 160.5, 119, -0.08),
    "DIVISION": (300, 310, 160.5, 119, -0.08),
    "EUCM": (300, 310, 160.5, 119, 0.5, 1.1),
}
SIZE = (320, 240)


def camera(model="OPENCV", number=1, size=SIZE, params=None):
    """A pycolmap Camera."""
    return pycolmap.Camera(
        model=model, width=size[0], height=size[1], params=list(params or LENSES[model]), camera_id=number
    )


def write_model(folder, names, cameras, world_to_camera, points, text=False):
    """A COLMAP model. names: (V,). cameras: (V,) pycolmap Cameras. world_to_camera: (V, 3, 4). points: (n, 3).

    Every image sees every point.
    """
    model = pycolmap.Reconstruction()
    for lens in {lens.camera_id: lens for lens in cameras}.values():
        model.add_camera_with_trivial_rig(lens)
    for number, (name, lens, pose) in enumerate(zip(names, cameras, world_to_camera, strict=True), 1):
        pixels = lens.img_from_cam(points @ pose[:, :3].T + pose[:, 3])
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=lens.camera_id, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for index, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(number, index) for number in range(1, len(names) + 1)])
        model.add_point3D(point, track)
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))


def rays_of(lens, supersampling):
    """(H s, W s, 3) directions, z = 1, through every sample of a picture."""
    steps = [(np.arange(side * supersampling) + 0.5) / supersampling for side in (lens.width, lens.height)]
    pixels = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    rays = np.column_stack([lens.cam_from_img(pixels), np.ones(len(pixels))])
    return rays.reshape(lens.height * supersampling, lens.width * supersampling, 3)


def picture_of(part, lens, world_to_camera, scene=None, supersampling=2):
    """(H, W, 3) uint8 BGR: a part as a lens sees it, as `synthetic.rendering` draws it for pinhole cameras."""
    directions = rays_of(lens, supersampling)
    rays = np.empty((*directions.shape[:2], 6), np.float32)
    rays[..., :3], rays[..., 3:] = invert_pose(world_to_camera)[:, 3], directions @ world_to_camera[:, :3]
    flat = rays.reshape(-1, 6)
    hits = (scene or ray_scene(part)).cast_rays(flat)
    depths = hits["t_hit"].numpy()
    hit = np.isfinite(depths)
    colours = np.ones((len(flat), 3), np.float32)
    normals = interpolated_normals(part, hits["primitive_ids"].numpy()[hit], hits["primitive_uvs"].numpy()[hit])
    colours[hit] = light_of_srgb(shade(normals, flat[hit, 2] + depths[hit] * flat[hit, 5]))
    light = cv2.resize(colours.reshape(*rays.shape[:2], 3), (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    return np.rint(255 * srgb_of_light(light)).astype(np.uint8)[:, :, ::-1]


def picture_of_polygon(lens, corners):
    """(H, W) uint8: a bright convex polygon on a plane at depth 1. corners: (n, 2), anticlockwise where y is up.

    A pixel is covered as a straight edge at its distance covers it, which holds but for the corners.
    """
    rays = rays_of(lens, 1)[..., :2]
    covered = np.ones(rays.shape[:2])
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        inside = along[0] * (rays[..., 1] - start[1]) - along[1] * (rays[..., 0] - start[0])
        pixels = inside / np.hypot(*np.gradient(inside))
        covered = np.minimum(covered, np.clip(pixels + 0.5, 0, 1))
    return np.rint(255 * srgb_of_light(0.1 + 0.6 * covered)).astype(np.uint8)
