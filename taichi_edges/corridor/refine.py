"""The stage `refine`: edges that meet, in agreement with the edgels of all views."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_edges.corridor.findings import doubt_of_refine
from taichi_edges.errors import amount
from taichi_edges.geometry.wireframe import Wireframe, wireframe_and_about, write_wireframe
from taichi_edges.views.views import Views, read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.scene.settings import RefineConfig


def refine(run: "Run") -> dict[str, Any]:
    """`edges_fit.json`, `views.npz` -> `edges.json` (input frame): edges that meet, and what the images say of each.

    With `refine.contours` also `contours.json`.
    """
    from taichi_edges.kernels.device import is_running, kernel_cache, start_taichi
    from taichi_edges.refinement.stage import refine_wireframe

    config, views = run.config.refine, read_views(run.path("views.npz"))
    loose, about = wireframe_and_about(run.path("edges_fit.json"))
    loose = loose.transformed(views.similarity.to_unit, views.similarity.scale)
    if config.enabled and len(loose) and not is_running(run.arch, run.threads):
        start_taichi(run.arch, run.threads, run.config.seed, kernel_cache())
    wireframe, counts = refine_wireframe(loose, views, config)
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
    path = run.path("contours.json")
    path.unlink(missing_ok=True)  # an older run's contours must not pass for this one's
    if config.contours and not (config.verdict and config.enabled):
        run.progress.warn(
            "refine.contours: no contours are told without refine.enabled and refine.verdict: set both true"
        )
    elif config.contours and len(loose):
        facts |= {"contours": _write_contours(path, config, loose, wireframe, views, about), "files": [path.name]}
    return facts


def _write_contours(
    path: Path, config: "RefineConfig", loose: Wireframe, wireframe: Wireframe, views: Views, about: dict[str, Any]
) -> int:
    """Write the contours among the loose edges, which are in the unit cube; how many there are."""
    from taichi_edges.refinement.contours import found_contours

    shapes, rounding, pixels = found_contours(loose, wireframe, views, config)
    to_input, scale = views.similarity.to_input, 1.0 / views.similarity.scale
    radii = {
        "radius": (scale * pixels * rounding.radius_px).tolist(),
        "radius_px": rounding.radius_px.tolist(),
        "radius_uncertainty_px": rounding.uncertainty_px.tolist(),
    }
    contours = Wireframe.loose(shapes).transformed(to_input, scale)
    write_wireframe(path, contours, {"kind": "contour", **radii, **about})
    return len(contours)
