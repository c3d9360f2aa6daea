"""The stage `evaluate`: the edges against the ground truth where there is one, and against held-out views."""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.corridor.findings import WRONG_CAMERAS
from taichi_edges.corridor.sources import listed_frames, posed_frames, truth_path
from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import write_csv, write_json
from taichi_edges.geometry.edge_set import read_edges
from taichi_edges.views.cameras import transform
from taichi_edges.views.views import Views, read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.evaluation.ground_truth import GroundTruth
    from taichi_edges.progress import Progress

HARDLY_BETTER = 1.5  # times chance: right cameras give three times as much and more


def evaluate(run: "Run") -> dict[str, Any]:
    """`edges.json` -> `metrics.json` and `metrics.csv`: EMAP's protocol, corners, free ends; without a truth fewer.

    And what the held-out views say. Lengths are in the frame of the truth, in the unit cube where there is none. With a
    scan for a truth also `pseudo_truth.ply`, its points on edges (input frame).
    """
    from taichi_edges.evaluation.held_out import held_out_metrics
    from taichi_edges.evaluation.metrics import evaluate as measure
    from taichi_edges.evaluation.metrics import exact_polylines, measure_alone

    edges = read_edges(run.path("edges.json"))
    views, held_out = read_views(run.path("views.npz")), read_views(run.path("held_out.npz"))
    unit, truth = edges.transformed(views.similarity.to_unit), ground_truth_of(run, views, held_out)
    if truth is None:
        scores = measure_alone(unit)
    else:
        scores = measure(
            edges.transformed(partial(transform, views.input_to_truth)) if truth.own_frame else unit, truth
        )
    scores |= held_out_metrics(exact_polylines(unit), views, held_out)
    warn_of_chance(scores, run.progress)
    metrics = {**scores, "ground_truth": None if truth is None else truth.source}
    write_json(run.path("metrics.json"), metrics)
    write_csv(run.path("metrics.csv"), [("metric", "value"), *metrics.items()])
    return {**metrics, "files": _write_pseudo_truth(run, views, truth)}


def warn_of_chance(metrics: Mapping[str, float | None], progress: "Progress") -> None:
    """Say so where the edges are hardly better in the held-out views than edges displaced at random would be."""
    found, chance = (metrics.get(f"held_out_{name}_percent") for name in ("precision", "chance"))
    if found is not None and chance is not None and found < HARDLY_BETTER * chance:
        problem = f"only {found:.0f} % of the edges fit the held-out views, where chance alone gives {chance:.0f} %"
        progress.warn(f"{problem}: {WRONG_CAMERAS}")


def ground_truth_of(run: "Run", views: Views, held_out: Views) -> "GroundTruth | None":
    """The GroundTruth of the scene, or None. views, held_out: Views that found its edges, and the others."""
    from taichi_edges.evaluation.ground_truth import read_ground_truth, read_sampled_ply
    from taichi_edges.evaluation.pseudo_truth import Votes, points_in_box, pseudo_truth

    path, config, from_truth = truth_path(run), run.config.evaluation, np.linalg.inv(views.input_to_truth)

    def to_unit(points: np.ndarray) -> np.ndarray:
        return views.similarity.to_unit(transform(from_truth, points))

    if path is None or config.kind != "scan":
        return read_ground_truth(path, to_unit) if path else None
    points = points_in_box(read_sampled_ply(path, to_unit).points, views.box, str(path))
    cameras = {some.names[view]: some.camera(view) for some in (views, held_out) for view in range(len(some))}
    maps = scan_maps(run, views, held_out)
    with run.progress.track("scan", len(maps)) as report:
        votes = Votes.of(points, [cameras[name] for name in maps], maps.values(), config.scan.threshold, report)
    return pseudo_truth(points, votes, config.scan, str(path))


def scan_maps(run: "Run", views: Views, held_out: Views) -> dict[str, np.ndarray]:
    """{name of a view: (H, W) uint8 edge map} that a scan's points are projected on."""
    folder, source = run.config.evaluation.scan.edges, run.config.source
    names = [*views.names, *held_out.names]
    if not folder:
        return dict(zip(names, [*views.edge_maps, *held_out.edge_maps], strict=True))
    if source.reader == "synthetic":
        raise UserError("evaluation.scan.edges: a synthetic scene has no folders of maps; leave it out")
    from taichi_edges.readers.frames import chosen_frames, subset
    from taichi_edges.readers.images import read_edge_maps
    from taichi_edges.readers.undistortion import undistorted_frames

    frames, made = chosen_frames(listed_frames(run, edges=folder), source.skip), run.path("undistorted_for_scan")
    frames = posed_frames(run, frames, edges=folder)
    frames = subset(frames, [frames.names.index(name) for name in names])  # prepare may have left some views out
    frames = undistorted_frames(
        frames, made, source.max_size, source.gamma, run.threads, run.progress, kinds=("edge_paths",)
    )
    maps = dict(zip(frames.names, read_edge_maps(frames, run.progress, run.threads), strict=True))
    if next(iter(maps.values())).shape != views.edge_maps.shape[1:]:
        problem = f"its maps are not {views.width} x {views.height} px as the scene's views are"
        raise UserError(f"evaluation.scan.edges: {folder}: {problem}; write them in that size")
    return {name: maps[name] for name in names}


def _write_pseudo_truth(run: "Run", views: Views, truth: "GroundTruth | None") -> list[str]:
    """The names of the files written: the points of the GroundTruth, if they are those of a scan on edges."""
    path = run.path("pseudo_truth.ply")
    if truth is None or run.config.evaluation.kind != "scan":
        path.unlink(missing_ok=True)  # of an older run with other settings
        return []
    from taichi_edges.files.ply import write_float_vertices

    write_float_vertices(path, ("x", "y", "z"), views.similarity.to_input(truth.points))
    return [path.name]
