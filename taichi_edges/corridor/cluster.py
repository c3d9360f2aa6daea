"""The stage `cluster`: from Gaussians to oriented points, each with the edge that it lies on."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.views.views import pixel_size, read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run


def cluster(run: "Run") -> dict[str, Any]:
    """`gaussians.ply`, `views.npz` -> `points.ply` (filtered oriented points, input frame) and `clusters.npz`."""
    from taichi_edges.files.point_cloud import write_oriented_points
    from taichi_edges.files.splats import read_gaussians
    from taichi_edges.kernels.device import is_running, kernel_cache, start_taichi
    from taichi_edges.points.filtering import FEW_VIEWS, filter_points
    from taichi_edges.splatting.gaussians import Gaussians
    from taichi_edges.strokes.assembly import assemble
    from taichi_edges.strokes.clusters import write_clusters
    from taichi_edges.strokes.contours import without_contours

    if not is_running(run.arch, run.threads):  # after the training it is
        start_taichi(run.arch, run.threads, run.config.seed, kernel_cache())
    views = read_views(run.path("views.npz"))
    gaussians = Gaussians(*read_gaussians(run.path("gaussians.ply")))
    means = views.similarity.to_unit(gaussians.means.astype(np.float64))
    threshold, generator = run.config.train.edge_threshold, np.random.default_rng(run.config.seed)
    trusted, counts = filter_points(
        means, gaussians.directions(), gaussians.opacities, views, run.config.filter, threshold, generator
    )
    if len(trusted) == 0:
        problem = f"none of {len(means)} Gaussians passed the filters ({_in_words(asdict(counts))})"
        cure = "train longer, or lower filter.min_opacity or filter.min_support"
        if run.config.filter.refine and len(views) < FEW_VIEWS * run.config.filter.min_views:
            seen = f"an edge must be seen in {run.config.filter.min_views:g} views at full strength"
            cure = f"{len(views)} views are too few, {seen}: take more, or set filter.refine: false"
        raise UserError(f"{run.path('gaussians.ply')}: {problem}; {cure}")
    clusters = assemble(trusted.points, trusted.directions, run.config.cluster, pixel_size(views))
    clusters, contours = without_contours(clusters, trusted.explained, views, run.config.filter)
    points, labels = views.similarity.to_input(clusters.points), clusters.labels
    write_oriented_points(run.path("points.ply"), points, clusters.directions, labels)
    write_clusters(run.path("clusters.npz"), clusters)
    numbers = {"points": len(points), "clusters": len(clusters.arcs), "unclustered": int((labels < 0).sum())}
    return {**asdict(counts), **numbers, "contours": contours}


def _in_words(counts: Mapping[str, int]) -> str:
    """'5 low opacity, 3 outliers' from a dict of counts, without those that are zero and the number of all."""
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n and name != "gaussians")
