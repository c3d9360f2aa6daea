"""IDR's layout of DTU scenes, which NeuS and many others share: `image/`, `mask/`, and `cameras_sphere.npz`.

`world_mat_i` (4, 4) projects the world, millimetres in DTU, to the pixels of the i-th image (of the images sorted by
name); pixel centres at integers. `scale_mat_i` brings the unit sphere around the object to the world. What comes out is
in the world's frame, and the box is the one around that sphere.
"""

import zipfile
import zlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.readers.companions import mask_folder
from taichi_edges.readers.frames import Frames, folders_in, matrix
from taichi_edges.readers.image_files import files_of_views, first_folder, image_files, refuse_missing

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
IMAGE_FOLDERS = ("image", "images", "rgb")
NO_SKEW = 1e-5  # of the focal length: below, it is the rounding of a matrix stored as float32


def read_idr(path: Path, config: "SourceConfig") -> Frames:
    """Frames of an IDR folder, or of one of its camera files. config: the scene's `source` section."""
    where = path if path.is_file() else camera_file(path)
    folder, cameras = where.parent, _read_cameras(where)
    images = _images(folder, config.images)
    names = [image.stem for image in images]
    _check_count(where, cameras, images)
    parts = [_camera(cameras, index, name, where, name in config.skip) for index, name in enumerate(names)]
    return Frames(
        where=where,
        names=names,
        edge_paths=files_of_views(folder / config.edges, names, "edge map") if config.edges else [""] * len(names),
        image_paths=images,
        intrinsics=[partial(_of_any_size, intrinsics) for intrinsics, _ in parts],
        camera_to_world=[pose for _, pose in parts],
        opengl=False,
        mask_paths=_masks(folder, names, config),
        box=_box_of_sphere(cameras, where),
    )


def camera_file(folder: Path) -> Path:
    """The file of cameras in a folder; where there is none, the name that it should have."""
    return next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), folder / CAMERA_FILES[0])


def _read_cameras(where: Path) -> dict[str, np.ndarray]:
    """{key: array} of the archive."""
    try:
        with np.load(where) as archive:
            return dict(archive)
    except FileNotFoundError as error:
        known = f"IDR's folders hold {CAMERA_FILES[0]} or {CAMERA_FILES[1]}"
        raise UserError(f"{where}: not found; {known}; check source.path and source.reader") from error
    except (OSError, EOFError, ValueError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{where}: not an .npz archive that can be read ({error}); download it again") from error


def _images(folder: Path, given: str) -> list[Path]:
    """The images, sorted by name: the i-th belongs to world_mat_i."""
    wanted = folder / given if given else first_folder(folder, IMAGE_FOLDERS)
    images = image_files(wanted)
    if not images:
        names = given or " or ".join(IMAGE_FOLDERS)
        raise UserError(f"{folder}: no images in {names}; set source.images (there are: {folders_in(folder)})")
    return images


def _check_count(where: Path, cameras: dict[str, np.ndarray], images: list[Path]) -> None:
    """As many matrices as images: else nobody knows which belong together."""
    count = sum(key.startswith("world_mat_") and not key.startswith("world_mat_inv_") for key in cameras)
    if count == 0:
        raise UserError(f"{where}: holds no world_mat_0; are these the cameras of IDR's layout?")
    if count != len(images):
        problem = f"{count} cameras (world_mat_i) for {len(images)} images in {images[0].parent.name}"
        raise UserError(f"{where}: {problem}; the i-th image, by name, goes with world_mat_i: put back what is missing")


def _masks(folder: Path, names: list[str], config: "SourceConfig") -> list[Path]:
    """The paths of the masks; none where there is no folder of them."""
    masks = mask_folder(folder, config)
    if masks is None or not (config.masks or image_files(masks)):
        return []
    paths = files_of_views(masks, names, "mask")
    refuse_missing(masks, paths, names, "mask", config.skip)
    return paths


def _camera(
    cameras: dict[str, np.ndarray], index: int, name: str, where: Path, skipped: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) and camera-to-world (4, 4) of the i-th image; those of a view to skip may be broken."""
    key = f"world_mat_{index}"
    if skipped:
        return np.eye(3), np.eye(4)
    values = cameras.get(key)
    rows = 3 if values is not None and values.shape == (3, 4) else 4
    projection = matrix(values, (rows, 4), where, f"{key}, of {name},")[:3]
    if not np.isfinite(projection).all():
        raise UserError(f"{where}: {key}, of {name}, is not finite; export it again, or name the view in source.skip")
    if np.linalg.matrix_rank(projection[:, :3]) < 3:
        raise UserError(f"{where}: {key}, of {name}, is no camera's projection; export it again")
    return decompose(projection)


def decompose(projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3), K[2, 2] = 1, focal lengths positive, and camera-to-world (4, 4) of a (3, 4) projection.

    A projection says the same when it is multiplied by any number; the rotation is a proper one in any case.
    """
    projection = projection * np.sign(np.linalg.det(projection[:, :3]))
    # RQ by way of QR: what is upper triangular about the other diagonal comes last.
    flip = np.eye(3)[::-1]
    orthogonal, triangular = np.linalg.qr((flip @ projection[:, :3]).T)
    intrinsics, rotation = flip @ triangular.T @ flip, flip @ orthogonal.T
    signs = np.sign(np.diag(intrinsics))
    intrinsics, rotation = intrinsics * signs, signs[:, None] * rotation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -np.linalg.solve(projection[:, :3], projection[:, 3])
    intrinsics = np.triu(intrinsics) / intrinsics[2, 2]
    if abs(intrinsics[0, 1]) < NO_SKEW * intrinsics[0, 0]:
        intrinsics[0, 1] = 0.0
    return intrinsics, pose


def _box_of_sphere(cameras: dict[str, np.ndarray], where: Path) -> np.ndarray:
    """(2, 3) corners of the box around what scale_mat_0 makes of the unit sphere, world units."""
    scale = matrix(cameras.get("scale_mat_0"), (4, 4), where, "scale_mat_0")
    reach = np.linalg.norm(scale[:3, :3], axis=1)
    if not (np.isfinite(scale).all() and (reach > 0).all()):
        raise UserError(f"{where}: scale_mat_0 holds values that are no sphere's; export it again")
    return np.array([scale[:3, 3] - reach, scale[:3, 3] + reach])


def _of_any_size(intrinsics: np.ndarray, width: int, height: int) -> np.ndarray:
    return intrinsics
