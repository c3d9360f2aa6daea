"""IDR's layout of DTU scenes: `image/`, `mask/`, and `cameras_sphere.npz`.

`world_mat_i` (4, 4) projects the world to pixels, `scale_mat_i` brings the unit sphere around the object to the world.
"""

from functools import partial

import cv2
import numpy as np

from taichi_edges.readers.frames import Frames


def read_idr(folder, config):
    """Frames of an IDR folder. config: the scene's `source` section."""
    where = folder / "cameras_sphere.npz"
    with np.load(where) as archive:
        cameras = dict(archive)
    images = sorted((folder / (config.images or "image")).glob("*.[pj][np]g"))
    masks = folder / "mask"
    parts = [_decomposed(cameras[f"world_mat_{i}"]) for i in range(len(images))]
    scale = cameras["scale_mat_0"]
    corners = np.array([[-1.0, -1, -1], [1, 1, 1]])
    return Frames(
        where=where,
        names=[path.stem for path in images],
        edge_paths=[folder / config.edges / f"{int(path.stem):06d}.png" if config.edges else "" for path in images],
        image_paths=images,
        intrinsics=[partial(_constant, intrinsics) for intrinsics, _ in parts],
        camera_to_world=[pose for _, pose in parts],
        opengl=False,
        mask_paths=[masks / f"{int(path.stem):03d}.png" for path in images],
        box=corners * scale[0, 0] + scale[:3, 3],
    )


def _constant(value, width, height):
    return value


def _decomposed(projection):
    """Intrinsics (3, 3) and camera-to-world (4, 4) of a projection matrix."""
    intrinsics, rotation, centre = cv2.decomposeProjectionMatrix(projection[:3].astype(np.float64))[:3]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, centre[:3, 0] / centre[3, 0]
    return intrinsics / intrinsics[2, 2], pose
