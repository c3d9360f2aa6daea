"""The layout of NEF, which is NeRF's "Blender" layout: `transforms_<split>.json`, OpenGL axes, images named in it.

Intrinsics are per frame (`camera_intrinsics`, 3x3, pixel centres at integers) or follow from `camera_angle_x`, the
horizontal field of view in radians; then the principal point is the image's centre, (size - 1) / 2.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.readers.companions import mask_folder, mask_paths
from taichi_edges.readers.frames import Frames, matrix, read_json

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig


def read_nerf(path: Path, config: "SourceConfig") -> Frames:
    """Frames of a NEF folder, or of one of its files. config: the scene's `source` section."""
    where = path if path.is_file() else path / f"transforms_{config.split}.json"
    folder = where.parent
    content = read_json(where, "a NEF folder holds transforms_<split>.json")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{where}: has no 'frames'; is this a transforms file of NEF or NeRF (Blender)?")
    paths = [_file_path(frame, where) for frame in frames]
    # NEF's frames name edge maps, which are grey, those of other NeRF scenes photographs.
    masks, warnings = _masks(folder, config, paths)
    own_images = not config.edges and not config.images and _is_colour(folder / paths[0])
    return Frames(
        where=where,
        names=[path.stem for path in paths],
        edge_paths=["" if own_images else folder / (config.edges or path.parent) / path.name for path in paths],
        image_paths=[folder / path if own_images else _image(folder, config, path) for path in paths],
        intrinsics=[
            partial(_intrinsics, frame, content, path.stem, where) for frame, path in zip(frames, paths, strict=True)
        ],
        camera_to_world=[frame.get("transform_matrix") for frame in frames],
        opengl=True,
        mask_paths=masks,
        warnings=warnings,
    )


def _masks(folder: Path, config: "SourceConfig", paths: list[Path]) -> tuple[Sequence[Path | str], tuple[str, ...]]:
    """As `mask_paths`: masks at the images' own paths below their folder, or all of them beside each other in it."""
    masks = mask_folder(folder, config)
    nested = masks is not None and any((masks / path.parent).is_dir() for path in paths)
    return mask_paths(folder, config, [str(path) if nested else path.name for path in paths])


def _image(folder: Path, config: "SourceConfig", path: Path) -> Path | str:
    """Path of the colour image that belongs to a frame's file; '' where the scene names no folder of them."""
    return folder / config.images / path.name if config.images else ""


def _is_colour(path: Path) -> bool:
    """Whether there is an image at `path` with transparency, or with channels that differ."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None or image.ndim == 2:
        return False
    return image.shape[2] == 4 or bool((image != image[:, :, :1]).any())


def _file_path(frame: Any, where: Path) -> Path:
    """Relative path of the frame's image; the layout leaves the suffix out."""
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise UserError(f"{where}: a frame without file_path; every frame names its image")
    path = Path(frame["file_path"])
    if not path.name:
        raise UserError(f"{where}: a frame with the file_path '{path}'; every frame names its image")
    return path if path.suffix.lower() in (".png", ".jpg", ".jpeg") else path.with_name(path.name + ".png")


def _intrinsics(
    frame: dict[str, Any], content: dict[str, Any], name: str, where: Path, width: int, height: int
) -> np.ndarray:
    """(3, 3): the frame's own, or those that the field of view means for an image of this size."""
    if "camera_intrinsics" in frame:
        return matrix(frame["camera_intrinsics"], (3, 3), where, f"camera_intrinsics of {name}")
    angle = frame.get("camera_angle_x", content.get("camera_angle_x"))
    if angle is None:
        raise UserError(f"{where}: {name} has neither camera_intrinsics nor camera_angle_x; add one of them")
    if type(angle) not in (int, float) or not 0 < angle < np.pi:
        raise UserError(f"{where}: camera_angle_x of {name} must be between 0 and pi radians, not {angle}")
    focal = 0.5 * width / np.tan(0.5 * angle)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
