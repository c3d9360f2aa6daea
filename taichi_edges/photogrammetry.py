"""COLMAP models and lenses: the one module that knows pycolmap (4 or later).

COLMAP puts the centre of the top-left pixel at (0.5, 0.5); what leaves this module has it at (0, 0), see `cameras`.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taichi_edges.artefacts import file_state
from taichi_edges.errors import UserError, did_you_mean

HALF_PIXEL = 0.5  # between COLMAP's pixel coordinates and ours
MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")  # the last two from COLMAP 3.12 on
NEEDED_FILES = MODEL_FILES[:3]
MODEL_SUFFIXES = (".bin", ".txt")  # in the order in which COLMAP looks for them


@dataclass(frozen=True)
class Lens:
    """A camera model of COLMAP: its name there, the (width, height) in pixels it is for, its parameters.

    The parameters are COLMAP's too: the centre of the first pixel is (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: tuple

    def camera(self):
        """The pycolmap Camera; UserError where there is no such model, or it has other parameters."""
        import pycolmap

        names = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
        if self.model not in names:
            raise UserError(f"COLMAP has no camera model {self.model}{did_you_mean(self.model, names)}")
        size = {"width": int(self.width), "height": int(self.height)}
        camera = pycolmap.Camera(model=self.model, **size, params=list(self.params))
        if not camera.verify_params():
            problem = f"the parameters of {self.model} are {camera.params_info}, but {len(self.params)} are given"
            raise UserError(f"{problem}; correct the cameras")
        if not np.isfinite(self.params).all() or camera.is_spherical():
            what = "not all numbers" if not camera.is_spherical() else "a panorama, which no pinhole camera can show"
            raise UserError(f"the camera {self.model} is {what}; render perspective images from it, or skip its views")
        return camera

    @property
    def is_pinhole(self):
        """Whether its pictures are those of a pinhole camera as they are."""
        camera = self.camera()
        return camera.is_undistorted() and not camera.is_perspective_fisheye()


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


def model_files(folder):
    """The files of the COLMAP model in a folder, [] where there is none. UserError where it is there in part."""
    for suffix in MODEL_SUFFIXES:
        found = [folder / f"{name}{suffix}" for name in MODEL_FILES if (folder / f"{name}{suffix}").is_file()]
        missing = [f"{name}{suffix}" for name in NEEDED_FILES if folder / f"{name}{suffix}" not in found]
        if not missing:
            return found
        if len(missing) < len(NEEDED_FILES):
            raise UserError(f"{folder}: a COLMAP model without {' and '.join(missing)}; copy or export all of it")
    return []


def read_reconstruction(folder):
    """The Reconstruction of a folder with `model_files`; read once, as long as the files stay the same."""
    return _reconstruction_of(Path(folder), tuple(file_state(path) for path in model_files(folder)))


@functools.lru_cache(maxsize=8)
def _reconstruction_of(folder, _states):
    import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
        _refuse_cut_cameras(folder / "cameras.bin", model)
        return as_reconstruction(model)
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        reason = str(error) or type(error).__name__
        raise UserError(f"{folder}: not a COLMAP model that can be read ({reason}); export or copy it again") from error


def _refuse_cut_cameras(path, model):
    """ValueError where a binary file of cameras ends early, the one that pycolmap does not notice."""
    whole = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if path.is_file() and path.stat().st_size < whole:
        raise ValueError(f"{path.name} is truncated")


def as_reconstruction(model):
    """The Reconstruction of a pycolmap Reconstruction."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    lenses = {number: _lens(camera) for number, camera in model.cameras.items()}
    points = list(model.points3D.values())
    return Reconstruction(
        names=[image.name for image in images],
        lenses=[lenses[image.camera_id] for image in images],
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

    As large as the lens's picture or a little smaller, so that (nearly) no pixel of it is empty. Pixel centres at
    integers.
    """
    import pycolmap

    camera = lens.camera()
    if not lens.is_pinhole:
        camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    intrinsics = camera.calibration_matrix()
    intrinsics[:2, 2] -= HALF_PIXEL
    return intrinsics, (camera.width, camera.height)


def distorted_pixels(lens, rays):
    """(n, 2) pixels, centres at integers, at which a lens shows (n, 3) camera directions; NaN where it cannot."""
    return lens.camera().img_from_cam(np.ascontiguousarray(rays, dtype=np.float64)) - HALF_PIXEL
