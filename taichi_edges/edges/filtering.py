"""From trained Gaussians to oriented points: which centres are trusted (paper 3.3 and release)."""

from dataclasses import dataclass

import numpy as np

from taichi_edges.support import exclusive_support


@dataclass(frozen=True)
class FilterCounts:
    """How many Gaussians came in and how many each filter took away, in this order."""

    gaussians: int
    low_opacity: int
    low_support: int
    outliers: int


def filter_points(means, directions, opacities, views, config, edge_threshold):
    """The centres that are opaque, supported by the edge maps and not isolated.

    means: (n, 3) unit cube. directions: (n, 3) unit vectors. opacities: (n,). config: the scene's `filter` section.
    Support counts, among the views that have the point in front of the camera (z > 0) and inside the image, those in
    which it falls on an edge pixel that is not explained by a better point elsewhere (`exclusive_support`); that an
    edge is hidden in many views is why the share asked for is small. ti.init must have been called.
    Returns points (m, 3) float64, directions (m, 3) float64 and FilterCounts.
    """
    points = np.asarray(means, dtype=np.float64)
    opaque = np.asarray(opacities) >= config.min_opacity
    supported = opaque.copy()
    support = exclusive_support(views, points[opaque], edge_threshold)
    supported[opaque] = (support >= config.min_support) & (support > 0)
    kept = np.flatnonzero(supported)
    inliers = kept[statistical_inliers(points[kept], config.outlier_neighbors, config.outlier_deviations)]
    counts = FilterCounts(
        gaussians=len(points),
        low_opacity=int((~opaque).sum()),
        low_support=int(opaque.sum() - supported.sum()),
        outliers=len(kept) - len(inliers),
    )
    return points[inliers], np.asarray(directions, dtype=np.float64)[inliers], counts


def statistical_inliers(points, neighbors, deviations):
    """Indices of the points whose mean distance to their neighbours is at most mean + deviations * std over all points.

    Open3D's statistical outlier removal. neighbors 0 switches it off.
    """
    if neighbors == 0 or len(points) <= neighbors:
        return np.arange(len(points))
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    _, indices = cloud.remove_statistical_outlier(nb_neighbors=neighbors, std_ratio=deviations)
    return np.sort(np.asarray(indices, dtype=np.int64))
