"""The stage `refine`: edges that meet, in agreement with the edgels of all views."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from taichi_edges.corridor.findings import doubt_of_refine
from taichi_edges.errors import amount
from taichi_edges.geometry.wireframe import wireframe_and_about, write_wireframe
from taichi_edges.views.views import read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run


def refine(run: "Run") -> dict[str, Any]:
    """`edges_fit.json`, `views.npz` -> `edges.json` (input frame): edges that meet, and what the images say of each."""
    from taichi_edges.kernels.device import is_running, kernel_cache, start_taichi
    from taichi_edges.refinement.stage import refine_wireframe

    views = read_views(run.path("views.npz"))
    loose, about = wireframe_and_about(run.path("edges_fit.json"))
    loose = loose.transformed(views.similarity.to_unit, views.similarity.scale)
    if run.config.refine.enabled and len(loose) and not is_running(run.arch, run.threads):
        start_taichi(run.arch, run.threads, run.config.seed, kernel_cache())
    wireframe, counts = refine_wireframe(loose, views, run.config.refine)
    if len(loose) and not len(wireframe):
        found = f"the images support none of the {amount(len(loose), 'edge')} that were fitted"
        run.progress.warn(f"{found}; look at detection.png, or set refine.enabled: false to keep them")
    write_wireframe(
        run.path("edges.json"), wireframe.transformed(views.similarity.to_input, 1.0 / views.similarity.scale), about
    )
    facts = {"edges": len(wireframe), "vertices": len(wireframe.vertices), **asdict(counts)}
    doubt = doubt_of_refine(facts)
    if doubt:
        run.progress.warn(doubt)
    return facts
