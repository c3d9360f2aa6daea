"""From trained Gaussians to oriented points: which centres are trusted (paper 3.3 and release), and where they belong.

With `filter.refine` a centre is a first guess. It moves to where the viewing planes of its edgels meet, and must have
enough of them: those of Gaussians that were laid along strokes go on in order, others must explain edgels that nothing
else explains.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.evidence.explaining import explained_support
from taichi_edges.evidence.lying import EdgelsAbout
from taichi_edges.evidence.noise import ON_NOISES, RADII_NOISES, SCALE_NOISES, noise_of
from taichi_edges.evidence.support import exclusive_support
from taichi_edges.evidence.viewing_planes import refine_points

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.scene.settings import FilterConfig
    from taichi_edges.views.views import Views

ROUNDS = 2  # what others explained that are gone by then is looked at again


@dataclass(frozen=True)
class FilterCounts:
    """How many Gaussians came in, and how many points each filter took away."""

    gaussians: int
    low_opacity: int
    low_support: int
    outliers: int = 0


@dataclass(frozen=True)
class TrustedPoints(Columns):
    """Oriented points that are left.

    points, directions: (n, 3) float64, unit cube, unit vectors.
    """

    points: np.ndarray
    directions: np.ndarray


def filter_points(
    means: np.ndarray,
    directions: np.ndarray,
    opacities: np.ndarray,
    views: "Views",
    config: "FilterConfig",
    edge_threshold: float,
) -> tuple[TrustedPoints, FilterCounts]:
    """The centres that are opaque, supported by the edge maps and not isolated; refined if the scene wants that.

    means: (n, 3) unit cube. directions: (n, 3) unit vectors. opacities: (n,). config: the scene's `filter` section.
    ti.init must have been called. Returns TrustedPoints and FilterCounts.
    """
    opaque = np.asarray(opacities) >= config.min_opacity
    points, directions = (np.asarray(array, dtype=np.float64)[opaque] for array in (means, directions))
    if config.refine:
        trusted = refined_points(points, directions, views, config)
    else:
        on_edges = _on_edge_pixels(points, views, config.min_support, edge_threshold)
        trusted = TrustedPoints(points, directions).keep(on_edges)
    inliers = statistical_inliers(trusted.points, config.outlier_neighbors, config.outlier_deviations)
    counts = FilterCounts(
        gaussians=len(opaque),
        low_opacity=int((~opaque).sum()),
        low_support=len(points) - len(trusted),
        outliers=len(trusted) - len(inliers),
    )
    return trusted.keep(inliers), counts


def points_on_strokes(
    matching: "EdgelMatching",
    points: np.ndarray,
    directions: np.ndarray,
    opacities: np.ndarray,
    strokes: np.ndarray,
    min_opacity: float,
    trained: bool,
) -> tuple[TrustedPoints, np.ndarray, float, FilterCounts]:
    """The centres along strokes that are opaque and on an edge, moved to where its viewing planes meet.

    points, directions: (n, 3) unit cube, unit vectors. opacities: (n,). strokes: (n,) int. trained: has training moved
    them? If not they stay: they are where all edgels of their stroke together have put them. Returns TrustedPoints, the
    (k,) stroke of each, the noise of the edgels, px, and FilterCounts. Without their neighbours on the stroke, points
    of a gap are no edge: what goes is what fewer views see than `matching.least_views`.
    """
    opaque = np.asarray(opacities) >= min_opacity
    points, directions = (np.asarray(array, dtype=np.float64)[opaque] for array in (points, directions))
    strokes, placed = strokes[opaque], TrustedPoints(points, directions)
    noise = noise_of(matching, refine_points(matching, points, directions))
    if trained:
        radii = tuple(factor * noise for factor in RADII_NOISES)
        moved = refine_points(matching, points, directions, radii, SCALE_NOISES * noise)
        placed = TrustedPoints(moved.points, moved.directions)
    about = EdgelsAbout.of(matching, placed.points, placed.directions, ON_NOISES * noise)
    seen = about.closeness(ON_NOISES * noise).sum(axis=1) >= matching.least_views
    counts = FilterCounts(len(opaque), int((~opaque).sum()), int((~seen).sum()))
    return placed.keep(seen), strokes[seen], noise, counts


def _on_edge_pixels(points: np.ndarray, views: "Views", least: float, edge_threshold: float) -> np.ndarray:
    """(n,) bool: which points fall on edge pixels of their own in this share of the views that could see them.

    Those are the views that have a point in front of the camera and inside the image; that an edge is hidden in many of
    them is why the share asked for is small.
    """
    support = exclusive_support(views, points, edge_threshold)
    return (support >= least) & (support > 0)


def refined_points(points: np.ndarray, directions: np.ndarray, views: "Views", config: "FilterConfig") -> TrustedPoints:
    """TrustedPoints on the edges that the edgels of the views agree on. Arguments as for `filter_points`."""
    from taichi_edges.evidence.edgel_matching import EdgelMatching

    matching = EdgelMatching(views, config.min_views)
    found = refine_points(matching, points, directions)
    found = found.keep(found.views >= config.min_views)
    for _ in range(ROUNDS):
        found = found.keep(explained_support(matching, found) >= config.min_support)
    return TrustedPoints(found.points, found.directions)


def statistical_inliers(points: np.ndarray, neighbors: int, deviations: float) -> np.ndarray:
    """Indices of the points whose mean distance to their neighbours is at most mean + deviations * std over all points.

    Open3D's statistical outlier removal. neighbors 0 switches it off.
    """
    if neighbors == 0 or len(points) <= neighbors:
        return np.arange(len(points))
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    _, indices = cloud.remove_statistical_outlier(nb_neighbors=neighbors, std_ratio=deviations)
    return np.sort(np.asarray(indices, dtype=np.int64))
