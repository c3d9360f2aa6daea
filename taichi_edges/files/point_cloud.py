"""Oriented points as a PLY: the directions are the normals, the clusters the colours."""

from pathlib import Path

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import replacing
from taichi_edges.files.palette import label_colours
from taichi_edges.files.ply import read_vertices, stack_fields

POINT_FIELDS = ("x", "y", "z")
DIRECTION_FIELDS = ("nx", "ny", "nz")


def write_oriented_points(
    path: Path | str, points: np.ndarray, directions: np.ndarray, labels: np.ndarray | None = None
) -> Path:
    """Write a binary PLY with the directions as normals, in float64 if the points or directions are, else in float32.

    points: (n, 3) world units. directions: (n, 3). labels: (n,) int cluster of each point, -1 for none; they become
    colours, and an int property `label` (a scalar field in CloudCompare).
    """
    import open3d as o3d

    points, directions = np.asarray(points), np.asarray(directions)
    assert points.shape == directions.shape == (len(points), 3), (points.shape, directions.shape)
    if len(points) == 0:
        raise UserError(f"{path}: there are no points to write; the stage before kept none, loosen its thresholds")
    dtype = np.result_type(points, directions, np.float32)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points, dtype)))
    cloud.point.normals = o3d.core.Tensor(np.ascontiguousarray(directions, dtype))
    if labels is not None:
        assert np.shape(labels) == (len(points),), np.shape(labels)
        cloud.point.colors = o3d.core.Tensor(label_colours(labels))
        cloud.point["label"] = o3d.core.Tensor(np.array(labels, np.int32).reshape(-1, 1))
    with replacing(path) as unfinished:
        if not o3d.t.io.write_point_cloud(str(unfinished), cloud):
            raise UserError(f"{path}: Open3D could not write it; is the disk full?")
    return Path(path)


def read_oriented_points(path: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Read what `write_oriented_points` wrote. Returns points (n, 3) and directions (n, 3), float32 or float64."""
    vertices = read_vertices(path, POINT_FIELDS + DIRECTION_FIELDS)
    return stack_fields(vertices, POINT_FIELDS), stack_fields(vertices, DIRECTION_FIELDS)
