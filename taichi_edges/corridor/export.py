"""The stage `export`: files for other programs, and pictures."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_edges.corridor.edgels_of_views import with_whole_paths
from taichi_edges.geometry.wireframe import read_wireframe, wireframe_and_about
from taichi_edges.views.views import read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.geometry.shapes import Shape


def export(run: "Run") -> dict[str, Any]:
    """`edges.json`, `views.npz` -> `edges.ply`, `.obj`, `.dxf`, `.step`, pictures in `overlays/`, `overlays.png`.

    With `refine.contours` those of `contours.json` in the DXF.
    """
    from taichi_edges.exporters import EXPORTERS
    from taichi_edges.exporters.dxf import write_dxf
    from taichi_edges.exporters.overlays import contact_sheet, draw_overlays

    wireframe = read_wireframe(run.path("edges.json"))
    views = with_whole_paths(run, read_views(run.path("views.npz")))
    writers: dict[str, Callable[..., Path]] = {**EXPORTERS, ".dxf": partial(write_dxf, contours=_contours(run))}
    written = []
    for suffix, write in writers.items():
        path = run.path(f"edges{suffix}")
        if len(wireframe):
            write(path, wireframe)
            written.append(path.name)
        else:
            path.unlink(missing_ok=True)  # an older run's edges must not pass for this one's
    for stale in run.path("overlays").glob("*.png"):
        stale.unlink()
    unit = wireframe.transformed(views.similarity.to_unit, views.similarity.scale)
    pictures = draw_overlays(run.path("overlays"), views, unit)
    contact_sheet(pictures, run.path("overlays.png"))
    return {"files": [*written, "overlays.png", *(f"overlays/{path.name}" for path in pictures)]}


def _contours(run: "Run") -> "list[tuple[Shape, dict[str, float]]]":
    """The contours that were asked for, each with what is told about its radius."""
    path = run.path("contours.json")
    if not run.config.refine.contours or not path.exists():
        return []
    contours, about = wireframe_and_about(path)
    names = ("radius", "radius_px", "radius_uncertainty_px")
    radii = zip(*(about[name] for name in names), strict=True)
    return [(shape, dict(zip(names, told, strict=True))) for shape, told in zip(contours.shapes, radii, strict=True)]
