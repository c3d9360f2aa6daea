"""The stage `fit`: a shape for each cluster of points."""

from typing import TYPE_CHECKING, Any

from taichi_edges.geometry.wireframe import write_wireframe
from taichi_edges.views.cameras import Cameras
from taichi_edges.views.views import pixel_size, read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run


def fit(run: "Run") -> dict[str, Any]:
    """`clusters.npz`, `views.npz` -> `edges_fit.json` (input frame): edges that do not meet yet."""
    from taichi_edges.strokes.assembly import fit_clusters, fit_strokes
    from taichi_edges.strokes.clusters import read_clusters

    views, found = read_views(run.path("views.npz")), read_clusters(run.path("clusters.npz"))
    if found.noise_px:
        cameras = Cameras.of(views.intrinsics @ views.world_to_camera)
        pixels = cameras.pixel_at(found.points, views.width, views.height, pixel_size(views))
        edges, counts = fit_strokes(found, pixels)
    else:
        edges, counts = fit_clusters(found, run.config.fit)
    clusters = {kind: counts[kind] for kind in ("line", "curve", "loop", "short", "degenerate")}
    about = {"frame": "input", "clusters": clusters, "scene": run.config.name, "seed": run.config.seed}
    write_wireframe(
        run.path("edges_fit.json"), edges.transformed(views.similarity.to_input, 1.0 / views.similarity.scale), about
    )
    if len(edges) == 0:
        run.progress.warn(f"no edge was found in {sum(clusters.values())} clusters; see the counts in run.json")
    kinds = {f"{kind}_clusters": count for kind, count in clusters.items()}
    pieces = edges.edge_set()
    return {"lines": len(pieces.lines), "curves": len(pieces.curves), **kinds}
