"""The edgels that the views of a run go on with: traced in maps, masked, calibrated, on long chains; their report."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import Views, write_views

if TYPE_CHECKING:
    from taichi_edges.calibration.calibration import Calibration
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.readers.frames import Frames

WIDEST_PX = 40.0  # of a detector's lines
CALIBRATION_SEEDS = 4000  # 3D points through which a detector's biases are measured, at most


def finish_views(run: "Run", views: Views, frames: "Frames | None" = None) -> dict[str, Any]:
    """Trace and calibrate the edgels where the detector gave maps, write the views and the report; the facts.

    frames: whose masks drop edgels; None where there are none.
    """
    from taichi_edges.views.splitting import choose_held_out, split_views

    facts: dict[str, Any] = {"width_px": views.width, "height_px": views.height}
    residuals: dict[str, Any] = {}
    traced_here = views.edgels is None
    if traced_here:
        views, width = _traced(run, views)
        facts["line_width_px"] = round(width, 2)
    if frames is not None:
        views, dropped = _masked(run, views, frames, redraw=not traced_here)
        facts |= {} if dropped is None else {"masked_edgels": dropped}
    views, held_out = split_views(views, choose_held_out(views.names, run.config.evaluation.held_out))
    facts = {"views": len(views), "held_out": list(held_out.names), **facts}
    if traced_here:
        views, calibration = _calibrated(run, views)
        held_out = _corrected(run, held_out, calibration)
        if calibration is not None:
            facts["calibration"] = calibration.facts()
            residuals = {"residuals": calibration.residuals, "on_silhouette": calibration.on_silhouette}
    if run.config.source.min_chain:
        views, kept = _chained(run, views)
        residuals = {name: values[kept] for name, values in residuals.items()}
    sheet = _write_sheet(run, views, residuals)
    facts["edgels"] = len(_traced_edgels(views))
    write_views(run.path("views.npz"), views)
    write_views(run.path("held_out.npz"), held_out)
    return {**facts, "files": [sheet]}


def _chained(run: "Run", views: Views) -> tuple[Views, np.ndarray]:
    """The views with the edgels on long chains, and maps drawn through these; and which of all edgels those are."""
    from taichi_edges.detectors.chains import with_chain_strengths
    from taichi_edges.kernels.device import kernel_cache, start_taichi
    from taichi_edges.views.drawing import draw_edge_maps

    start_taichi("cpu", run.threads, run.config.seed, kernel_cache())
    edgels, lengths = with_chain_strengths(_traced_edgels(views), views.height, views.width)
    kept = lengths >= run.config.source.min_chain
    edgels = edgels.keep(kept)
    if len(edgels) == 0:
        problem = f"no edge is {run.config.source.min_chain} px long in any of {len(views)} views"
        raise UserError(f"source.min_chain: {problem}; lower it, or look at detection.png of a run with 0")
    maps = draw_edge_maps(edgels, views.height, views.width, run.threads)
    return replace(views, edgels=edgels, edge_maps=maps), kept


def _masked(run: "Run", views: Views, frames: "Frames", redraw: bool) -> tuple[Views, int | None]:
    """The views without the edgels that their masks drop, and how many those are; None without masks.

    redraw: the maps are drawn through the edgels; else they are black where masks are, and drawn anew later, or not.
    """
    from taichi_edges.detectors.masks import blank_outside, has_areas, within_masks
    from taichi_edges.views.drawing import draw_edge_maps

    if not has_areas(frames):
        return views, None
    edgels = _traced_edgels(views)
    kept = within_masks(edgels, frames, (views.width, views.height), run.progress)
    if redraw:
        maps = draw_edge_maps(kept, views.height, views.width, run.threads)
    else:
        maps = blank_outside(views.edge_maps, frames)
    return replace(views, edgels=kept, edge_maps=maps), len(edgels) - len(kept)


def _traced_edgels(views: Views) -> Edgels:
    """Those of views whose maps are traced."""
    assert views.edgels is not None
    return views.edgels


def with_whole_paths(run: "Run", views: Views) -> Views:
    """The views with paths that can be opened: pictures of a synthetic scene lie in the run's own folder."""
    return replace(views, image_paths=tuple(str(run.path(path)) if path else "" for path in views.image_paths))


def _traced(run: "Run", views: Views) -> tuple[Views, float]:
    """The views with the edgels on the ridges of their maps, and the width of the maps' lines, px."""
    from taichi_edges.detectors.ridges import trace_ridges
    from taichi_edges.evidence.support import line_width

    width, _ = line_width(views, run.config.train.edge_threshold)
    if width > WIDEST_PX:
        problem = f"the lines of the edge maps are {width:.0f} px wide; are these photographs?"
        raise UserError(f"{problem} Then name their folder as source.images, and set source.detector: subpixel")
    return replace(
        views, edgels=trace_ridges(views.edge_maps, width, run.config.source.thin_threshold, run.threads)
    ), width


def _calibrated(run: "Run", views: Views) -> "tuple[Views, Calibration | None]":
    """The views with unbiased edgels, and their maps drawn through these if the scene wants that; the Calibration."""
    from taichi_edges.views.drawing import draw_edge_maps

    def redrawn(edgels: Edgels) -> Views:
        maps = draw_edge_maps(edgels, views.height, views.width, run.threads)
        return replace(views, edgels=edgels, edge_maps=maps)

    wanted, edgels = run.config.calibration, _traced_edgels(views)
    calibration: Calibration | None = None
    if (wanted.shift, wanted.silhouette) != ("off", "off") and len(edgels):
        edgels, calibration = _calibrate(run, views, redrawn(edgels))
    if run.config.source.thin:
        return redrawn(edgels), calibration
    if calibration is not None and (calibration.shift_applied or calibration.silhouette_applied):
        run.progress.warn(
            "source.thin is false: the training learns from the maps as they are, only the edgels are corrected"
        )
    return replace(views, edgels=edgels), calibration


def _calibrate(run: "Run", views: Views, thin: Views) -> "tuple[Edgels, Calibration]":
    """The edgels without the detector's biases, and the Calibration. thin: the views with maps drawn thin."""
    from taichi_edges.calibration.calibration import calibrate
    from taichi_edges.kernels.device import kernel_cache, start_taichi
    from taichi_edges.seeding.proposals import likely_points

    start_taichi("cpu", run.threads, run.config.seed, kernel_cache())  # here as everywhere: prepare is no GPU's work
    points, directions = likely_points(thin, CALIBRATION_SEEDS)
    wanted, edgels = run.config.calibration, _traced_edgels(views)
    shift = {"off": (0.0, 0.0), "auto": None}[wanted.shift] if isinstance(wanted.shift, str) else wanted.shift
    fixed = {"off": 0.0, "auto": None}
    silhouette = fixed[wanted.silhouette] if isinstance(wanted.silhouette, str) else wanted.silhouette
    return calibrate(with_whole_paths(run, views), edgels, points, directions, shift, silhouette, run.threads)


def _corrected(run: "Run", views: Views, calibration: "Calibration | None") -> Views:
    """Held-out views, their edgels without the biases that the Calibration, None for none, has found in the others."""
    from taichi_edges.calibration.calibration import sides_of
    from taichi_edges.views.drawing import draw_edge_maps

    if not len(views):
        return views
    edgels = _traced_edgels(views)
    if calibration is not None and len(edgels):
        silhouette = calibration.silhouette_applied * calibration.silhouette
        values = np.array([silhouette, *(calibration.shift_applied * calibration.shift)])
        edgels = sides_of(with_whole_paths(run, views), edgels, run.threads).correct(edgels, values)[0]
    maps = draw_edge_maps(edgels, views.height, views.width, run.threads) if run.config.source.thin else views.edge_maps
    return replace(views, edgels=edgels, edge_maps=maps)


def _write_sheet(run: "Run", views: Views, residuals: dict[str, Any]) -> str:
    """The picture of what the detector gave; its name. residuals: as it takes them, {} where there are none."""
    from taichi_edges.detectors.detection_sheet import write_detection_sheet

    write_detection_sheet(run.path("detection.png"), with_whole_paths(run, views), **residuals)
    return "detection.png"
