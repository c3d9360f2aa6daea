"""The stage `cluster`: from Gaussians to oriented points, each with the edge that it lies on."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.views.views import pixel_size, read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.splatting.gaussians import Gaussians
    from taichi_edges.strokes.clusters import Clusters
    from taichi_edges.views.views import Views

FEW_VIEWS = 2.0  # times those that an edge needs: of fewer, most edges are seen by too few
BIAS_PX = 0.2  # by which points are off their edge beyond the noise: next to other edges every detector is biased
PLACE_NOISES = 2.0  # of the edgels, that the points of a stroke are off: its errors go together along it


def cluster(run: "Run") -> dict[str, Any]:
    """`gaussians.ply`, `views.npz` -> `points.ply` (filtered oriented points, input frame) and `clusters.npz`."""
    from taichi_edges.files.point_cloud import write_oriented_points
    from taichi_edges.files.splats import read_gaussians, read_strokes
    from taichi_edges.kernels.device import is_running, kernel_cache, start_taichi
    from taichi_edges.splatting.gaussians import Gaussians
    from taichi_edges.strokes.clusters import write_clusters

    if not is_running(run.arch, run.threads):  # after the training it is
        start_taichi(run.arch, run.threads, run.config.seed, kernel_cache())
    views = read_views(run.path("views.npz"))
    gaussians, strokes = Gaussians(*read_gaussians(run.path("gaussians.ply"))), read_strokes(run.path("gaussians.ply"))
    if strokes is not None and run.config.filter.refine:
        clusters, counts = _of_strokes(run, views, gaussians, strokes)
    else:
        clusters, counts = _of_points(run, views, gaussians)
    if len(clusters.points) == 0:
        problem = f"none of {len(gaussians)} Gaussians passed the filters ({_in_words(counts)})"
        cure = "train longer, or lower filter.min_opacity or filter.min_support"
        if run.config.filter.refine and len(views) < FEW_VIEWS * run.config.filter.min_views:
            seen = f"an edge must be seen in {run.config.filter.min_views:g} views"
            cure = f"{len(views)} views are too few, {seen}: take more, or set filter.refine: false"
        raise UserError(f"{run.path('gaussians.ply')}: {problem}; {cure}")
    points, labels = views.similarity.to_input(clusters.points), clusters.labels
    write_oriented_points(run.path("points.ply"), points, clusters.directions, labels)
    write_clusters(run.path("clusters.npz"), clusters)
    numbers = {"points": len(points), "clusters": len(clusters.arcs), "unclustered": int((labels < 0).sum())}
    return {**counts, **numbers}


def _of_strokes(
    run: "Run", views: "Views", gaussians: "Gaussians", strokes: np.ndarray
) -> "tuple[Clusters, dict[str, Any]]":
    """The Clusters of Gaussians that were laid along strokes, (n,) of each, and what was left out."""
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.fitting.model_selection import Yardstick
    from taichi_edges.points.filtering import points_on_strokes
    from taichi_edges.strokes.assembly import assemble_strokes

    means = views.similarity.to_unit(gaussians.means.astype(np.float64))
    matching = EdgelMatching(views, run.config.filter.min_views)
    directions, least = gaussians.directions(), run.config.filter.min_opacity
    trusted, strokes, noise, counts = points_on_strokes(
        matching, means, directions, gaussians.opacities, strokes, least, run.config.train.enabled
    )
    in_px = Yardstick(float(np.hypot(BIAS_PX, PLACE_NOISES * noise)), 1.0)
    pixels = matching.pixel_at(trusted.points)
    clusters = assemble_strokes(trusted.points, trusted.directions, strokes, pixels, in_px)
    return clusters, {**asdict(counts), "edgel_noise_px": noise}


def _of_points(run: "Run", views: "Views", gaussians: "Gaussians") -> "tuple[Clusters, dict[str, Any]]":
    """The Clusters of Gaussians that know nothing of each other, and what was left out."""
    from taichi_edges.points.filtering import filter_points
    from taichi_edges.strokes.assembly import assemble

    means = views.similarity.to_unit(gaussians.means.astype(np.float64))
    threshold = run.config.train.edge_threshold
    trusted, counts = filter_points(
        means, gaussians.directions(), gaussians.opacities, views, run.config.filter, threshold
    )
    clusters = assemble(trusted.points, trusted.directions, run.config.cluster, pixel_size(views))
    return clusters, asdict(counts)


def _in_words(counts: Mapping[str, int]) -> str:
    """'5 low opacity, 3 outliers' from a dict of counts, without those that are zero and the number of all."""
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n and name != "gaussians")
