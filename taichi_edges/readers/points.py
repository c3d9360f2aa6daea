"""Points to start from, given as a file: from structure from motion, a scan, or an earlier run."""

import functools
import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import file_state


def read_points(path: Path | str, box: ArrayLike) -> np.ndarray:
    """The finite points of a PLY (or any point cloud Open3D reads) that lie in the box. (n, 3) float64, input units.

    box: (2, 3) corners, input units.
    """
    points = read_cloud(path, "source.points")
    inside = inside_box(points, box)
    if len(inside) == 0:
        raise UserError(
            f"source.points: none of the {len(points)} points of {path} lies in the box; correct box or the file"
        )
    return inside


def read_cloud(path: Path | str, origin: str) -> np.ndarray:
    """(n, 3) float64, the finite points of a point cloud. origin: the key that names the file, for messages."""
    return _cloud_of(os.fspath(path), file_state(path), origin)


@functools.lru_cache(maxsize=1)
def _cloud_of(path: str, _state: tuple[int, ...], origin: str) -> np.ndarray:
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        points = np.asarray(o3d.io.read_point_cloud(Path(path)).points)
    if len(points) == 0:
        raise UserError(f"{origin}: {path} holds no points that can be read; give a PLY with x, y and z")
    return points[np.isfinite(points).all(axis=1)]


def inside_box(points: np.ndarray, box: ArrayLike) -> np.ndarray:
    """Those of the (n, 3) points that lie in the box, (2, 3) corners."""
    low, high = np.asarray(box, dtype=np.float64)
    return points[((points >= low) & (points <= high)).all(axis=1)]
