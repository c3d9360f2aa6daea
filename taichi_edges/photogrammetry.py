"""COLMAP models and lenses: the one module that knows pycolmap (4 or later).

COLMAP puts the centre of the top-left pixel at (0.5, 0.5); what leaves this module has it at (0, 0), see `cameras`.
"""

from dataclasses import dataclass

import numpy as np

from taichi_edges.errors import UserError

HALF_PIXEL = 0.5  # between COLMAP's pixel coordinates and ours


@dataclass(frozen=True)
class Lens:
    """A camera model of COLMAP: its name there, the (width, height) in pixels it is for, its parameters."""

    model: str
    width: int
    height: int
    params: tuple

    def camera(self):
        """The pycolmap Camera."""
        import pycolmap

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))


@dataclass(frozen=True)
class Reconstruction:
    """A model of structure from motion, in its own frame.

    names: (V,) of the registered images. lenses: (V,) Lens. camera_to_world: (V, 4, 4), OpenCV axes.
    points: (n, 3). errors: (n,) mean reprojection error, px. track_lengths: (n,) images that see each point.
    """

    names: list
    lenses: list
    camera_to_world: np.ndarray
    points: np.ndarray
    errors: np.ndarray
    track_lengths: np.ndarray


def read_reconstruction(folder):
    """The Reconstruction of a folder with cameras, images, points3D as .bin or .txt."""
    import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, IndexError) as error:
        raise UserError(f"{folder}: not a COLMAP model that can be read ({error}); export it again") from error
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    points = list(model.points3D.values())
    return Reconstruction(
        names=[image.name for image in images],
        lenses=[_lens(model.cameras[image.camera_id]) for image in images],
        camera_to_world=np.array([_camera_to_world(image) for image in images]).reshape(-1, 4, 4),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        errors=np.array([point.error for point in points]),
        track_lengths=np.array([point.track.length() for point in points], dtype=int),
    )


def _lens(camera):
    return Lens(camera.model.name, camera.width, camera.height, tuple(float(value) for value in camera.params))


def _camera_to_world(image):
    return np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])


def undistorted(lens):
    """The pinhole camera, without distortion, that shows what the lens shows: intrinsics (3, 3) and (width, height).

    Pixel centres at integers.
    """
    import pycolmap

    camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens.camera())
    intrinsics = camera.calibration_matrix()
    intrinsics[:2, 2] -= HALF_PIXEL
    return intrinsics, (camera.width, camera.height)


def undistortion_map(lens, intrinsics, size):
    """Where in the image of the lens each pixel of an undistorted image lies, (H, W, 2) float32, as cv2.remap wants."""
    width, height = size
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    rays = pixels @ np.linalg.inv(intrinsics).T
    return (lens.camera().img_from_cam(rays).reshape(height, width, 2) - HALF_PIXEL).astype(np.float32)
