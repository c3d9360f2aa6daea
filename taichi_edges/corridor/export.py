"""The stage `export`: files for other programs, and pictures."""

from typing import TYPE_CHECKING, Any

from taichi_edges.corridor.edgels_of_views import with_whole_paths
from taichi_edges.geometry.wireframe import read_wireframe
from taichi_edges.views.views import read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run


def export(run: "Run") -> dict[str, Any]:
    """`edges.json`, `views.npz` -> `edges.ply`, `.obj`, `.dxf`, `.step`, pictures in `overlays/`, `overlays.png`."""
    from taichi_edges.exporters import EXPORTERS
    from taichi_edges.exporters.overlays import contact_sheet, draw_overlays

    wireframe = read_wireframe(run.path("edges.json"))
    views = with_whole_paths(run, read_views(run.path("views.npz")))
    written = []
    for suffix, write in EXPORTERS.items():
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
