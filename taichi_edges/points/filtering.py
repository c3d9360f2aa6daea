"""From trained Gaussians to oriented points: which centres are trusted (paper 3.3 and release), and where they belong.

With `filter.refine` a centre is a first guess. It moves to where the viewing planes of its edgels meet, must explain
edgels that nothing else explains, and must stay on them as the viewpoint moves. What edgels are left over are voted on
once more, for edges seen in few views; and all is grown along its tangents.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.columns import Columns
from taichi_edges.evidence.explaining import Explained, explain, unexplained
from taichi_edges.evidence.support import exclusive_support

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.viewing_planes import RefinedPoints
    from taichi_edges.scene.settings import FilterConfig
    from taichi_edges.views.views import Views

AROUND = 9  # points, itself included, over which the steadiness of a point is a median
CONTINUED = 0.5  # views that may be fewer where an edge goes on
# An edge that fewer views see than so many times the least must be seen from different directions: neighbouring views
# see an occluding contour in one place as well.
FEW_VIEWS = 2.0
RARE = 0.8  # of a harvested point's support, which those that continue it need
HARVEST_KEEP = 0.06  # share of the views that must see one of the edges left over


@dataclass(frozen=True)
class FilterCounts:
    """How many Gaussians came in, how many points each filter took away, and how many were found beyond them."""

    gaussians: int
    low_opacity: int
    low_support: int
    unsteady: int = 0
    harvested: int = 0
    grown: int = 0
    outliers: int = 0


@dataclass(frozen=True)
class TrustedPoints(Columns):
    """Oriented points that are left.

    points, directions: (n, 3) float64, unit cube, unit vectors. explained: what edgels say about them, Explained; None
    where they are not refined.
    """

    points: np.ndarray
    directions: np.ndarray
    explained: Explained | None = None


def filter_points(
    means: np.ndarray,
    directions: np.ndarray,
    opacities: np.ndarray,
    views: "Views",
    config: "FilterConfig",
    edge_threshold: float,
    generator: np.random.Generator,
) -> tuple[TrustedPoints, FilterCounts]:
    """The centres that are opaque, supported by the edge maps and not isolated; refined if the scene wants that.

    means: (n, 3) unit cube. directions: (n, 3) unit vectors. opacities: (n,). config: the scene's `filter` section.
    generator: numpy.random.Generator, for what is left to chance in the harvest. ti.init must have been called.
    Returns TrustedPoints and FilterCounts.
    """
    opaque = np.asarray(opacities) >= config.min_opacity
    points, directions = (np.asarray(array, dtype=np.float64)[opaque] for array in (means, directions))
    if config.refine:
        trusted, filtered = refined_points(points, directions, views, config, edge_threshold, generator)
    else:
        on_edges = _on_edge_pixels(points, views, config.min_support, edge_threshold)
        trusted, filtered = TrustedPoints(points, directions).keep(on_edges), {"low_support": int((~on_edges).sum())}
    inliers = statistical_inliers(trusted.points, config.outlier_neighbors, config.outlier_deviations)
    counts = FilterCounts(
        gaussians=len(opaque),
        low_opacity=int((~opaque).sum()),
        **filtered,
        outliers=len(trusted) - len(inliers),
    )
    return trusted.keep(inliers), counts


def _on_edge_pixels(points: np.ndarray, views: "Views", least: float, edge_threshold: float) -> np.ndarray:
    """(n,) bool: which points fall on edge pixels of their own in this share of the views that could see them.

    Those are the views that have a point in front of the camera and inside the image; that an edge is hidden in many of
    them is why the share asked for is small.
    """
    support = exclusive_support(views, points, edge_threshold)
    return (support >= least) & (support > 0)


def refined_points(
    points: np.ndarray,
    directions: np.ndarray,
    views: "Views",
    config: "FilterConfig",
    edge_threshold: float,
    generator: np.random.Generator,
) -> tuple[TrustedPoints, dict[str, int]]:
    """TrustedPoints on the edges that the edgels of the views agree on. Arguments as for `filter_points`.

    Returns also the counts of FilterCounts that this is about.
    """
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.viewing_planes import RefinedPoints, refine_points
    from taichi_edges.points.growing import grow_points

    matching = EdgelMatching(views, config.min_views - CONTINUED)
    found = refine_points(matching, points, directions)
    first = judge(matching, found, config)
    refined, more = found.keep(first.steady), found.keep(slice(0))
    if config.harvest:  # what an unsteady point explains is a contour, and no edge is to be looked for in it
        more = harvest(matching, found.keep(first.supported), views, config, edge_threshold, generator)
        refined = RefinedPoints.joined([refined, more])
    before = len(refined)
    if config.grow:
        rare = np.minimum(config.grow, RARE * more.support)
        least = np.concatenate([np.full(before - len(more), config.grow), rare])
        refined = grow_points(matching, refined, least)
    last = judge(matching, refined, config)
    counts = {"low_support": first.weak + last.weak, "unsteady": first.unsteady + last.unsteady}
    counts |= {"harvested": len(more), "grown": len(refined) - before}
    return TrustedPoints(refined.points, refined.directions, last.explained).keep(last.steady), counts


@dataclass(frozen=True)
class Trust(Columns):
    """What is thought of n RefinedPoints, whose Explained is `explained`.

    supported: (n,) bool, which of them have edgels of their own. steady: (n,) bool, which of these stay on them as the
    viewpoint moves.
    """

    supported: np.ndarray
    steady: np.ndarray
    explained: Explained

    @property
    def weak(self) -> int:
        """How many are not supported."""
        return int((~self.supported).sum())

    @property
    def unsteady(self) -> int:
        """How many are supported, but not steady."""
        return int((self.supported & ~self.steady).sum())


def judge(matching: "EdgelMatching", refined: "RefinedPoints", config: "FilterConfig") -> Trust:
    """The Trust of RefinedPoints.

    An occluding contour is not steady: its support comes from views that happen to look from similar directions.
    Steadiness is a matter of an edge and not of a point, so the median of a neighbourhood decides, and leniently: there
    will be surer evidence when the edges are known (`contours.steady_edges`).
    """
    explained = explain(matching, refined)
    apart = (refined.views >= FEW_VIEWS * config.min_views) | (
        refined.spread >= np.sin(np.radians(config.min_angle)) ** 2
    )
    supported = (explained.support >= config.min_support) & (refined.views >= config.min_views) & apart
    steady, places = supported.copy(), refined.points[supported]
    if len(places):
        around = cKDTree(places).query(places, min(AROUND, len(places)))[1].reshape(len(places), -1)
        typical = np.median(explained.relative_steadiness[supported][around], axis=1)
        steady[supported] = typical >= config.min_steadiness
    return Trust(supported, steady, explained)


def harvest(
    matching: "EdgelMatching",
    refined: "RefinedPoints",
    views: "Views",
    config: "FilterConfig",
    edge_threshold: float,
    generator: np.random.Generator,
) -> "RefinedPoints":
    """RefinedPoints on edges that few views see, voted for by the edgels that the `refined` ones leave unexplained."""
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.viewing_planes import refine_points
    from taichi_edges.seeding.voting import vote_seeds
    from taichi_edges.views.drawing import draw_edge_maps

    edgels = matching.edgels.keep(unexplained(matching, refined))
    left = replace(views, edgels=edgels, edge_maps=draw_edge_maps(edgels, views.height, views.width))
    seeds = vote_seeds(left, edge_threshold, generator, keep=HARVEST_KEEP)
    matching = EdgelMatching(left, matching.least_views)
    found = refine_points(matching, seeds.points, seeds.directions)
    return found.keep(judge(matching, found, config).steady)


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
