"""COLMAP models, lenses and structure from motion: the one module that knows pycolmap (4 or later).

COLMAP puts the centre of the top-left pixel at (0.5, 0.5); what leaves this module has it at (0, 0), see `cameras`.
"""

import functools
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np  # before pycolmap, always: the other way round the process dies later, 'free(): invalid pointer'

from taichi_edges.errors import UserError, did_you_mean
from taichi_edges.files.artefacts import file_state
from taichi_edges.progress import Progress

if TYPE_CHECKING:
    import pycolmap

HALF_PIXEL = 0.5  # between COLMAP's pixel coordinates and ours
MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")  # the last two from COLMAP 3.12 on
NEEDED_FILES = MODEL_FILES[:3]
LAST_PAIRED = 80  # images; of more, not every pair is matched
NEIGHBOURS = 10  # images after each, in the order of their names, with which it is then matched; and 2^i farther ones
FEATURE_SIZE = 2000  # px of the longest side, to which images are shrunk for it: 24 megapixels take 2 GiB and 30 s each
RICH = 10  # images of one camera from which on they determine tangential distortion, too
SMALLEST_MODEL = 3  # images
PAIRS_AT_ONCE = 40  # matched between two reports
MODEL_SUFFIXES = (".bin", ".txt")  # in the order in which COLMAP looks for them


def _colmap() -> ModuleType:
    """pycolmap, silent: what it would log comes as an exception as well, or is no concern of the user's."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    return pycolmap


def colmap_version() -> str:
    """Of pycolmap: what COLMAP has computed belongs to it."""
    return version("pycolmap")


@dataclass(frozen=True)
class Lens:
    """A camera model of COLMAP: its name there, the (width, height) in pixels it is for, its parameters.

    The parameters are COLMAP's too: the centre of the first pixel is (0.5, 0.5).
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def camera(self) -> "pycolmap.Camera":
        """The pycolmap Camera; UserError where there is no such model, or it has other parameters."""
        pycolmap = _colmap()
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
    def is_pinhole(self) -> bool:
        """Whether its pictures are those of a pinhole camera as they are."""
        camera = self.camera()
        return camera.is_undistorted() and not camera.is_perspective_fisheye()


@dataclass(frozen=True)
class SfmModel:
    """A model of structure from motion, in its own frame.

    names: (V,) of the registered images. lenses: (V,). camera_to_world: (V, 4, 4), OpenCV axes.
    points: (n, 3). errors: (n,) mean reprojection error, px. track_lengths: (n,) images that see each point.
    """

    names: list[str]
    lenses: list[Lens]
    camera_to_world: np.ndarray
    points: np.ndarray
    errors: np.ndarray
    track_lengths: np.ndarray


def model_files(folder: Path) -> list[Path]:
    """The files of the COLMAP model in a folder, [] where there is none. UserError where it is there in part."""
    for suffix in MODEL_SUFFIXES:
        found = [folder / f"{name}{suffix}" for name in MODEL_FILES if (folder / f"{name}{suffix}").is_file()]
        missing = [f"{name}{suffix}" for name in NEEDED_FILES if folder / f"{name}{suffix}" not in found]
        if not missing:
            return found
        if len(missing) < len(NEEDED_FILES):
            raise UserError(f"{folder}: a COLMAP model without {' and '.join(missing)}; copy or export all of it")
    return []


def read_model(folder: Path) -> SfmModel:
    """The SfmModel of a folder with `model_files`; read once, as long as the files stay the same."""
    return _model_of(folder, tuple(file_state(path) for path in model_files(folder)))


@functools.lru_cache(maxsize=8)
def _model_of(folder: Path, _states: tuple[tuple[int, ...], ...]) -> SfmModel:
    pycolmap = _colmap()
    try:
        model = pycolmap.Reconstruction(str(folder))
        _refuse_cut_cameras(folder / "cameras.bin", model)
        return as_model(model)
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        reason = str(error) or type(error).__name__
        raise UserError(f"{folder}: not a COLMAP model that can be read ({reason}); export or copy it again") from error


def _refuse_cut_cameras(path: Path, model: "pycolmap.Reconstruction") -> None:
    """ValueError where a binary file of cameras ends early, the one that pycolmap does not notice."""
    whole = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if path.is_file() and path.stat().st_size < whole:
        raise ValueError(f"{path.name} is truncated")


def as_model(model: "pycolmap.Reconstruction") -> SfmModel:
    """The SfmModel of a pycolmap Reconstruction."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    lenses = {number: _lens(camera) for number, camera in model.cameras.items()}
    points = list(model.points3D.values())
    return SfmModel(
        names=[image.name for image in images],
        lenses=[lenses[image.camera_id] for image in images],
        camera_to_world=np.array([_camera_to_world(image) for image in images]).reshape(-1, 4, 4),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        errors=np.array([point.error for point in points]),
        track_lengths=np.array([point.track.length() for point in points], dtype=int),
    )


def _lens(camera: "pycolmap.Camera") -> Lens:
    return Lens(camera.model.name, camera.width, camera.height, tuple(float(value) for value in camera.params))


def _camera_to_world(image: "pycolmap.Image") -> np.ndarray:
    return np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])


def undistorted(lens: Lens) -> tuple[np.ndarray, tuple[int, int]]:
    """The pinhole camera, without distortion, that shows what the lens shows: intrinsics (3, 3) and (width, height).

    As large as the lens's picture or a little smaller, so that (nearly) no pixel of it is empty. Pixel centres at
    integers.
    """
    pycolmap = _colmap()
    camera = lens.camera()
    if not lens.is_pinhole:
        camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    intrinsics = camera.calibration_matrix()
    intrinsics[:2, 2] -= HALF_PIXEL
    return intrinsics, (camera.width, camera.height)


def distorted_pixels(lens: Lens, rays: np.ndarray) -> np.ndarray:
    """(n, 2) pixels, centres at integers, at which a lens shows (n, 3) camera directions; NaN where it cannot."""
    pixels = lens.camera().img_from_cam(np.ascontiguousarray(rays, dtype=np.float64))
    return np.asarray(pixels) - HALF_PIXEL


def solve_poses(
    images: Path,
    names: Sequence[str],
    groups: Sequence[list[str]],
    folder: Path,
    seed: int,
    threads: int,
    progress: Progress,
    masks: Path | None = None,
) -> list[str]:
    """Structure from motion on the CPU; the COLMAP model with the most images is written to `folder`/sparse.

    images: the folder of the images. names: (V,) relative paths. groups: lists of names that share a camera.
    masks: a folder of PNG files named `<name>.png`, 0 where features do not count; None without.
    The same seed gives the same model, whatever the number of threads. Returns the names of the registered images,
    [] where there is no model.
    """
    folder.mkdir(parents=True, exist_ok=True)
    database = folder / "database.db"
    database.unlink(missing_ok=True)
    try:
        _extract(database, images, names, groups, masks, threads, progress)
        numbers = _numbered(database)
        _match(database, folder / "pairs.txt", [numbers[name] for name in names], seed, threads, progress)
        model = _map(database, images, folder / "models", len(names), seed, progress)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"{images}: structure from motion failed ({error}); see whether all images open") from error
    if model is None:
        return []
    named = {number: name for name, number in numbers.items()}
    for image in model.images.values():
        image.name = named[image.name]
    (folder / "sparse").mkdir(exist_ok=True)
    model.write(str(folder / "sparse"))
    database.unlink()  # a megabyte for each image
    shutil.rmtree(folder / "models")
    return sorted(image.name for image in model.images.values() if image.has_pose)


def _extract(
    database: Path,
    images: Path,
    names: Sequence[str],
    groups: Sequence[list[str]],
    masks: Path | None,
    threads: int,
    progress: Progress,
) -> None:
    """Cameras, in the order of the groups, then features, some images at a time."""
    pycolmap = _colmap()
    pycolmap.Database.open(str(database)).close()
    for group in groups:
        reader = pycolmap.ImageReaderOptions(camera_model="OPENCV" if len(group) >= RICH else "SIMPLE_RADIAL")
        pycolmap.import_images(str(database), str(images), pycolmap.CameraMode.SINGLE, group, reader)
    options = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False, max_image_size=FEATURE_SIZE)
    reader = pycolmap.ImageReaderOptions(mask_path=str(masks)) if masks else pycolmap.ImageReaderOptions()
    single, device = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu  # images keep the cameras that they have
    with progress.track("find features", len(names)) as report:
        for start in range(0, len(names), threads):
            some = names[start : start + threads]
            pycolmap.extract_features(str(database), str(images), some, single, reader, options, device)
            report(min(start + threads, len(names)))


def _numbered(database: Path) -> dict[str, str]:
    """Give the images of a database numbers for names: a list of pairs knows no blanks. Returns {name: number}."""
    numbers = {}
    with _colmap().Database.open(str(database)) as opened:
        for image in opened.read_all_images():
            numbers[image.name] = f"{image.image_id:06d}"
            image.name = numbers[image.name]
            opened.update_image(image)
    return numbers


def _match(database: Path, listing: Path, names: Sequence[str], seed: int, threads: int, progress: Progress) -> None:
    """Features of pairs of images, some pairs at a time."""
    pycolmap = _colmap()
    pairs = image_pairs(names)
    options = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    with progress.track("match features", len(pairs)) as report:
        for start in range(0, len(pairs), PAIRS_AT_ONCE):
            some = pairs[start : start + PAIRS_AT_ONCE]
            listing.write_text("".join(f"{first} {second}\n" for first, second in some), encoding="utf-8")
            pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listing))
            pycolmap.match_image_pairs(str(database), options, pairing, verification, pycolmap.Device.cpu)
            report(min(start + PAIRS_AT_ONCE, len(pairs)))
    listing.unlink()


def image_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """The pairs to match: all of up to LAST_PAIRED images; of more, each with those that follow, near and far."""
    count = len(names)
    steps: Sequence[int] = range(1, count)
    if count > LAST_PAIRED:
        steps = sorted({*range(1, NEIGHBOURS + 1), *(1 << power for power in range(count.bit_length()))})
    return [(names[i], names[i + step]) for i in range(count) for step in steps if i + step < count]


def _map(
    database: Path, images: Path, folder: Path, count: int, seed: int, progress: Progress
) -> "pycolmap.Reconstruction | None":
    """The pycolmap Reconstruction with the most images, None without one."""
    pycolmap = _colmap()
    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions(
        # More threads add up the residuals in an order that nobody knows.
        num_threads=1,
        random_seed=seed,
        min_model_size=SMALLEST_MODEL,
        extract_colors=False,
    )
    options.mapper.num_threads = 1
    options.mapper.random_seed = options.triangulation.random_seed = seed
    folder.mkdir(exist_ok=True)
    done = [0]

    def another(registered: int) -> None:
        done[0] = min(done[0] + registered, count)
        report(done[0], f"{done[0]} images placed")

    with progress.track("place cameras", count) as report:
        models = pycolmap.incremental_mapping(
            str(database), str(images), str(folder), options, "", lambda: another(2), lambda: another(1)
        )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def known_focal_length(path: Path) -> float | None:
    """Focal length in pixels that an image's EXIF tells, None where it tells none. UserError: not an image."""
    try:
        camera = _colmap().infer_camera_from_image(str(path))
    except (ValueError, RuntimeError) as error:
        raise UserError(f"{path}: not an image that COLMAP can read; write it again, or leave it out") from error
    return camera.mean_focal_length() if camera.has_prior_focal_length else None
