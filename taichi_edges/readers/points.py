"""Points to start from, given as a file: from structure from motion, a scan, or an earlier run."""

import numpy as np

from taichi_edges.errors import UserError


def read_points(path, box):
    """The finite points of a PLY (or any point cloud Open3D reads) that lie in the box. (n, 3) float64, input units.

    box: (2, 3) corners, input units.
    """
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        points = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    if len(points) == 0:
        raise UserError(f"source.points: {path} holds no points that can be read; give a PLY with x, y and z")
    finite = points[np.isfinite(points).all(axis=1)]
    inside = inside_box(finite, box)
    if len(inside) == 0:
        raise UserError(
            f"source.points: none of the {len(points)} points of {path} lies in the box; correct box or the file"
        )
    return inside


def inside_box(points, box):
    """Those of the (n, 3) points that lie in the box, (2, 3) corners."""
    low, high = np.asarray(box, dtype=np.float64)
    return points[((points >= low) & (points <= high)).all(axis=1)]
