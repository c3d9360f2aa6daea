"""The layout of EMAP's ABC-NEF_Edge: `meta_data.json`, `camtoworld` with OpenCV axes, one folder for each detector."""

from functools import partial

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.readers.frames import Frames, matrix, read_json


def read_emap(folder, config):
    """Frames of an EMAP folder. config: the scene's `source` section."""
    where = folder / "meta_data.json"
    content = read_json(where, "an EMAP folder holds meta_data.json")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{where}: has no 'frames'; is this EMAP's meta_data.json?")
    images = config.images or ("color" if (folder / "color").is_dir() else "")
    names = [_name(frame, where) for frame in frames]
    return Frames(
        where=where,
        names=[name.rsplit(".", 1)[0] for name in names],
        edge_paths=[folder / config.edges / name if config.edges else "" for name in names],
        image_paths=[folder / images / name if images else "" for name in names],
        intrinsics=[partial(_intrinsics, frame, name, where) for frame, name in zip(frames, names, strict=True)],
        camera_to_world=[frame.get("camtoworld") for frame in frames],
        opengl=False,
        size=_size(content, where),
        input_to_truth=_input_to_truth(content, where),
    )


def _name(frame, where):
    if not isinstance(frame, dict) or not isinstance(frame.get("rgb_path"), str) or not frame["rgb_path"]:
        raise UserError(f"{where}: a frame without rgb_path; every frame names its image")
    return frame["rgb_path"]


def _input_to_truth(content, where):
    values = matrix(content.get("worldtogt", np.eye(4)), (4, 4), where, "worldtogt")
    if not np.isfinite(values).all():
        raise UserError(f"{where}: worldtogt holds values that are not finite; correct it or leave it out")
    if np.linalg.matrix_rank(values) < 4:
        raise UserError(f"{where}: worldtogt cannot be inverted; correct it or leave it out")
    return values


def _intrinsics(frame, name, where, width, height):
    """The 3x3 part of EMAP's 3x3 or 4x4 intrinsics, whatever the image size."""
    values = np.asarray(frame.get("intrinsics"), dtype=object)
    rows = 4 if values.shape == (4, 4) else 3
    return matrix(frame.get("intrinsics"), (rows, rows), where, f"intrinsics of {name}")[:3, :3]


def _size(content, where):
    if "width" not in content and "height" not in content:
        return None
    sides = content.get("width"), content.get("height")
    if not all(type(side) in (int, float) and side > 0 and side == int(side) for side in sides):
        found = " and ".join(map(str, sides))
        raise UserError(f"{where}: width and height must both be whole numbers of pixels, not {found}")
    return int(sides[0]), int(sides[1])
