"""EMAP's layout (ABC-NEF_Edge, Replica_Edge, DTU_Edge): `meta_data.json`, `color/`, a folder for each edge detector.

`camtoworld` has OpenCV axes, pixel centres at integers. `scene_box.aabb` is the box of the scene; `worldtogt` leads to
the frame of the ground truth. Images are PNG or, in Replica_Edge, JPEG, the maps of PiDiNet always PNG.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.readers.companions import companion, edge_paths, mask_paths
from taichi_edges.readers.frames import Frames, matrix, read_json

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

IMAGE_FOLDERS = ("color", "images", "image", "rgb")


def read_emap(path: Path, config: "SourceConfig") -> Frames:
    """Frames of an EMAP folder, or of a file like its meta_data.json. config: the scene's `source` section."""
    where = path if path.is_file() else path / "meta_data.json"
    folder = where.parent
    content = read_json(where, "an EMAP folder holds meta_data.json")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{where}: has no 'frames'; is this EMAP's meta_data.json?")
    images = config.images or next((name for name in IMAGE_FOLDERS if (folder / name).is_dir()), "")
    names = [_name(frame, where) for frame in frames]
    masks, warnings = mask_paths(folder, config, names)
    return Frames(
        where=where,
        names=[name.rsplit(".", 1)[0] for name in names],
        edge_paths=edge_paths(folder, config, names),
        image_paths=[companion(folder / images, name) or folder / images / name if images else "" for name in names],
        intrinsics=[partial(_intrinsics, frame, name, where) for frame, name in zip(frames, names, strict=True)],
        camera_to_world=[frame.get("camtoworld") for frame in frames],
        opengl=False,
        size=_size(content, where),
        input_to_truth=_input_to_truth(content, where),
        mask_paths=masks,
        box=_scene_box(content, where),
        warnings=warnings,
    )


def _name(frame: Any, where: Path) -> str:
    if not isinstance(frame, dict) or not isinstance(frame.get("rgb_path"), str) or not frame["rgb_path"]:
        raise UserError(f"{where}: a frame without rgb_path; every frame names its image")
    return frame["rgb_path"]


def _input_to_truth(content: dict[str, Any], where: Path) -> np.ndarray:
    values = matrix(content.get("worldtogt", np.eye(4)), (4, 4), where, "worldtogt")
    if not np.isfinite(values).all():
        raise UserError(f"{where}: worldtogt holds values that are not finite; correct it or leave it out")
    if np.linalg.matrix_rank(values) < 4:
        raise UserError(f"{where}: worldtogt cannot be inverted; correct it or leave it out")
    return values


def _scene_box(content: dict[str, Any], where: Path) -> np.ndarray | None:
    """(2, 3) corners of the box the file gives, None without one."""
    box = content.get("scene_box")
    if not isinstance(box, dict) or box.get("aabb") is None:
        return None
    corners = matrix(box["aabb"], (2, 3), where, "scene_box.aabb")
    if not (np.isfinite(corners).all() and (corners[1] > corners[0]).all()):
        raise UserError(f"{where}: scene_box.aabb must be two corners, the second greater than the first in x, y and z")
    return corners


def _intrinsics(frame: dict[str, Any], name: str, where: Path, width: int, height: int) -> np.ndarray:
    """The 3x3 part of EMAP's 3x3 or 4x4 intrinsics, whatever the image size."""
    values = np.asarray(frame.get("intrinsics"), dtype=object)
    rows = 4 if values.shape == (4, 4) else 3
    return matrix(frame.get("intrinsics"), (rows, rows), where, f"intrinsics of {name}")[:3, :3]


def _size(content: dict[str, Any], where: Path) -> tuple[int, int] | None:
    if "width" not in content and "height" not in content:
        return None
    sides: list[Any] = [content.get("width"), content.get("height")]
    if not all(type(side) in (int, float) and side > 0 and side == int(side) for side in sides):
        found = " and ".join(map(str, sides))
        raise UserError(f"{where}: width and height must both be whole numbers of pixels, not {found}")
    return int(sides[0]), int(sides[1])
