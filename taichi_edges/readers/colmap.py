"""COLMAP projects: a folder of images beside `sparse/0`, with a model in text or binary files."""

from pathlib import Path

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.photogrammetry import read_reconstruction
from taichi_edges.readers.frames import Frames, folders_beside

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "")
LARGEST_ERROR = 2.0  # px; SfM points that fit worse are left out
SHORTEST_TRACK = 3  # images; a point seen in two lies anywhere along their rays
BOX_SHARE = 0.02  # of the points beyond each side of the box, before the margin
BOX_MARGIN = 0.1  # of the box's size


def read_colmap(folder, config):
    """Frames of a COLMAP project. config: the scene's `source` section."""
    model = _model_folder(folder)
    found = read_reconstruction(model)
    images, edges = folder / (config.images or "images"), config.edges
    good = (found.errors <= LARGEST_ERROR) & (found.track_lengths >= SHORTEST_TRACK)
    points = found.points[good]
    return Frames(
        where=next(path for path in (model / "images.bin", model / "images.txt") if path.is_file()),
        names=[name.rsplit(".", 1)[0] for name in found.names],
        edge_paths=[(folder / edges / name).with_suffix(".png") if edges else "" for name in found.names],
        image_paths=[images / name for name in found.names],
        intrinsics=[],
        camera_to_world=list(found.camera_to_world),
        opengl=False,
        lenses=found.lenses,
        points=points,
        box=robust_box(points),
    )


def _model_folder(folder):
    for name in MODEL_FOLDERS:
        if any((folder / name / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return folder / name
    raise UserError(f"{folder}: no COLMAP model in {', '.join(filter(None, MODEL_FOLDERS))}")


def robust_box(points):
    low, high = np.quantile(points, [BOX_SHARE, 1 - BOX_SHARE], axis=0)
    margin = BOX_MARGIN * (high - low)
    return np.array([low - margin, high + margin])
