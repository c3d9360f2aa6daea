"""The stages: each reads the artefacts of those before it from the run's folder and writes its own.

A stage is a plain function of a Run that returns the facts it found (JSON-able), which `run.json` keeps; the fact
"files", where there is one, lists what it wrote beyond its artefacts. A stage reads only what is on disk, so a resumed
run cannot differ from an unbroken one. What takes long to import (SciPy, OpenCV, Open3D, Taichi) is imported by the
stage that needs it: a run that is up to date, and a mistake in the scene file, shall not wait for it. The first stage
is in `preparing`.
"""

import csv
import io
import json
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from taichi_edges.artefacts import replacing, write_json, write_text
from taichi_edges.cameras import transform
from taichi_edges.edge_set import read_edges
from taichi_edges.errors import UserError
from taichi_edges.findings import amount
from taichi_edges.preparing import listed_frames, posed_frames, with_whole_paths
from taichi_edges.views import pixel_size, read_views
from taichi_edges.wireframe import read_wireframe, write_wireframe

WRONG_CAMERAS = "poses or intrinsics may not be those of these images (their order, axes or scale)"
HARDLY_BETTER = 1.5  # times chance: right cameras give three times as much and more


def train(run):
    """`views.npz` -> `gaussians.ply` (input frame) and `train_log.csv`."""
    from taichi_edges.exporters.splats import write_gaussians
    from taichi_edges.kernels.device import start_taichi
    from taichi_edges.splatting.training import Training

    config, views = run.config.train, read_views(run.path("views.npz"))
    generator = np.random.default_rng(run.config.seed)
    start_taichi(run.arch, run.threads, run.config.seed, run.kernel_cache)
    start = _start(run, views, generator)
    training = Training(views, config, generator, run.threads, run.arch)
    gaussians, records = training.run(start, run.progress)
    rows = [("step", "seconds", "loss", "gaussians")]
    rows += [(r.step, f"{r.seconds:.3f}", f"{r.loss:.6f}", r.gaussians) for r in records]
    _write_csv(run.path("train_log.csv"), rows)
    similarity = views.similarity
    write_gaussians(
        run.path("gaussians.ply"),
        similarity.to_input(gaussians.means).astype(np.float32),
        gaussians.log_scales - np.float32(np.log(similarity.scale)),
        gaussians.quaternions,
        gaussians.opacity_logits,
    )
    loss = records[-1].loss if np.isfinite(records[-1].loss) else None  # no step may have measured it alone
    return {"gaussians": len(gaussians), "view_steps": records[-1].step, "final_loss": loss}


def _start(run, views, generator):
    """The Gaussians that training starts from, as `train.seeds` says."""
    from taichi_edges.exporters.ply import read_vertices, stack_fields
    from taichi_edges.splatting.gaussians import start_gaussians
    from taichi_edges.splatting.seeding import LEAST_VOTED, given_points, random_points, voted_gaussians

    config = run.config.train
    seeds = config.seeds
    if seeds in ("votes", "sweep"):
        found, seeds = _swept(run, views) if seeds == "sweep" else (None, seeds)
        if seeds == "votes":
            found = voted_gaussians(views, config.edge_threshold, config.gaussians, config.initial_opacity, generator)
        if found is not None:
            return found
        seeds = "points" if run.path("seeds.ply").is_file() else "random"
        instead = {"points": "the given points", "random": "random points"}[seeds]
        found = f"the views agree on an edge in fewer than {LEAST_VOTED} places"
        run.progress.warn(f"{found}: {WRONG_CAMERAS}; the training starts from {instead} instead")
    if seeds == "random" or not run.path("seeds.ply").is_file():
        points = random_points(config.gaussians, views.box, generator)
    else:
        given = stack_fields(read_vertices(run.path("seeds.ply"), ("x", "y", "z")), ("x", "y", "z"))
        points = given_points(views.similarity.to_unit(given.astype(np.float64)), config.gaussians, generator)
        if seeds == "auto":  # structure from motion finds few points where there is no texture
            more = random_points(config.gaussians - len(points), views.box, generator)
            points = np.concatenate([points, more])
    return start_gaussians(points, generator, config.initial_scale, config.initial_opacity)


def _swept(run, views):
    """Gaussians by sweeping, None where views agree in too few places; and the seeds to use: 'votes' if none can be."""
    from taichi_edges.splatting.sweeping import TOGETHER, can_sweep, swept_gaussians

    found = swept_gaussians(views, run.config.train.gaussians, run.config.train.initial_opacity, run.progress)
    if found is not None or can_sweep(views):
        return found, "sweep"
    problem = f"fewer than {TOGETHER + 1} views see the same, and the sweep needs so many"
    run.progress.warn(f"{problem}: take more pictures, each from near the one before; the training starts from votes")
    return None, "votes"


def seed_files(run):
    """The points that training may start from, where the scene or the layout has some."""
    return [run.path("seeds.ply")]


def _write_csv(path, rows):
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(path, text.getvalue())


def cluster(run):
    """`gaussians.ply`, `views.npz` -> `points.ply` (filtered oriented points, input frame) and `clusters.npz`."""
    from taichi_edges.edges.assembly import assemble
    from taichi_edges.edges.contours import without_contours
    from taichi_edges.edges.filtering import FEW_VIEWS, filter_points
    from taichi_edges.exporters.point_cloud import write_oriented_points
    from taichi_edges.exporters.splats import read_gaussians
    from taichi_edges.kernels.device import is_running, start_taichi
    from taichi_edges.splatting.gaussians import Gaussians

    if not is_running(run.arch, run.threads):  # after the training it is
        start_taichi(run.arch, run.threads, run.config.seed, run.kernel_cache)
    views = read_views(run.path("views.npz"))
    gaussians = Gaussians(*read_gaussians(run.path("gaussians.ply")))
    means = views.similarity.to_unit(gaussians.means.astype(np.float64))
    threshold, generator = run.config.train.edge_threshold, np.random.default_rng(run.config.seed)
    points, directions, explained, counts = filter_points(
        means, gaussians.directions(), gaussians.opacities, views, run.config.filter, threshold, generator
    )
    if len(points) == 0:
        problem = f"none of {len(means)} Gaussians passed the filters ({_in_words(asdict(counts))})"
        cure = "train longer, or lower filter.min_opacity or filter.min_support"
        if run.config.filter.refine and len(views) < FEW_VIEWS * run.config.filter.min_views:
            seen = f"an edge must be seen in {run.config.filter.min_views:g} views at full strength"
            cure = f"{len(views)} views are too few, {seen}: take more, or set filter.refine: false"
        raise UserError(f"{run.path('gaussians.ply')}: {problem}; {cure}")
    found = assemble(points, directions, run.config.cluster, pixel_size(views))
    found, contours = without_contours(found, points, directions, explained, views, run.config.filter)
    labels = found.labels
    write_oriented_points(run.path("points.ply"), views.similarity.to_input(points), directions, labels)
    with replacing(run.path("clusters.npz")) as unfinished, open(unfinished, "wb") as file:
        np.savez_compressed(file, points=points, directions=directions, **asdict(found))
    found = {"points": len(points), "clusters": int(labels.max() + 1), "unclustered": int((labels < 0).sum())}
    return {**asdict(counts), **found, "contours": contours}


def _in_words(counts):
    """'5 low opacity, 3 outliers' from a dict of counts, without those that are zero and the number of all."""
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n and name != "gaussians")


def fit(run):
    """`clusters.npz` -> `edges_fit.json` (input frame): edges that do not meet yet."""
    from taichi_edges.edges.assembly import fit_assembly

    views = read_views(run.path("views.npz"))
    with np.load(run.path("clusters.npz")) as archive:
        parts = (archive[name] for name in ("points", "labels", "shared", "arcs"))
        edges, counts = fit_assembly(*parts, run.config.fit)
    clusters = {kind: counts[kind] for kind in ("line", "curve", "loop", "short", "degenerate")}
    about = {"frame": "input", "clusters": clusters, "scene": run.config.name, "seed": run.config.seed}
    write_wireframe(run.path("edges_fit.json"), _in_input_frame(edges, views), about)
    if len(edges) == 0:
        run.progress.warn(f"no edge was found in {sum(clusters.values())} clusters; see the counts in run.json")
    kinds = {f"{kind}_clusters": count for kind, count in clusters.items()}
    pieces = edges.edge_set()
    return {"lines": len(pieces.lines), "curves": len(pieces.curves), **kinds}


def _in_input_frame(wireframe, views):
    """A Wireframe in the unit cube, in the frame of the input."""
    return wireframe.transformed(views.similarity.to_input, 1.0 / views.similarity.scale)


def refine(run):
    """`edges_fit.json`, `views.npz` -> `edges.json` (input frame): edges that meet, and what the images say of each."""
    from taichi_edges.edges.refinement import refine_wireframe
    from taichi_edges.kernels.device import is_running, start_taichi

    views = read_views(run.path("views.npz"))
    loose, about = read_wireframe(run.path("edges_fit.json"))
    loose = loose.transformed(views.similarity.to_unit, views.similarity.scale)
    if run.config.refine.enabled and len(loose) and not is_running(run.arch, run.threads):
        start_taichi(run.arch, run.threads, run.config.seed, run.kernel_cache)
    wireframe, counts = refine_wireframe(loose, views, run.config.refine)
    if len(loose) and not len(wireframe):
        found = f"the images support none of the {amount(len(loose), 'edge')} that were fitted"
        run.progress.warn(f"{found}; look at detection.png, or set refine.enabled: false to keep them")
    write_wireframe(run.path("edges.json"), _in_input_frame(wireframe, views), about)
    return {"edges": len(wireframe), "vertices": len(wireframe.vertices), **asdict(counts)}


def truth_path(run):
    """The ground truth of the scene, or None: what the scene names, or what the synthetic source wrote."""
    if run.config.evaluation.truth:
        return run.data_path(run.config.evaluation.truth, "evaluation.truth")
    return run.path("truth.json") if run.config.source.reader == "synthetic" else None


def evaluate(run):
    """`edges.json` -> `metrics.json` and `metrics.csv`: EMAP's protocol, corners, free ends; without a truth fewer.

    And what the held-out views say. Lengths are in the frame of the truth, in the unit cube where there is none. With a
    scan for a truth also `pseudo_truth.ply`, its points on edges (input frame).
    """
    from taichi_edges.evaluation.held_out import held_out_metrics
    from taichi_edges.evaluation.metrics import evaluate as measure
    from taichi_edges.evaluation.metrics import exact_polylines, measure_alone

    edges, _ = read_edges(run.path("edges.json"))
    views, held_out = read_views(run.path("views.npz")), read_views(run.path("held_out.npz"))
    unit, truth = edges.transformed(views.similarity.to_unit), _ground_truth(run, views, held_out)
    if truth is None:
        metrics = measure_alone(unit)
    else:
        metrics = measure(
            edges.transformed(partial(transform, views.input_to_truth)) if truth.own_frame else unit, truth
        )
    metrics |= held_out_metrics(exact_polylines(unit), views, held_out)
    _warn_of_chance(metrics, run.progress)
    metrics["ground_truth"] = truth and truth.source
    write_json(run.path("metrics.json"), metrics)
    _write_csv(run.path("metrics.csv"), [("metric", "value"), *metrics.items()])
    return {**metrics, "files": _write_pseudo_truth(run, views, truth)}


def _warn_of_chance(metrics, progress):
    """Say so where the edges are hardly better in the held-out views than edges displaced at random would be."""
    found, chance = (metrics.get(f"held_out_{name}_percent") for name in ("precision", "chance"))
    if found is not None and chance is not None and found < HARDLY_BETTER * chance:
        problem = f"only {found:.0f} % of the edges fit the held-out views, where chance alone gives {chance:.0f} %"
        progress.warn(f"{problem}: {WRONG_CAMERAS}")


def _ground_truth(run, views, held_out):
    """The GroundTruth of the scene, or None. views, held_out: Views that found its edges, and the others."""
    from taichi_edges.evaluation.ground_truth import read_ground_truth, read_sampled_ply
    from taichi_edges.evaluation.projected_curves import Camera
    from taichi_edges.evaluation.pseudo_truth import Votes, points_in_box, pseudo_truth

    path, config, from_truth = truth_path(run), run.config.evaluation, np.linalg.inv(views.input_to_truth)

    def to_unit(points):
        return views.similarity.to_unit(transform(from_truth, points))

    if path is None or config.kind != "scan":
        return read_ground_truth(path, to_unit) if path else None
    points = points_in_box(read_sampled_ply(path, to_unit).points, views.box, str(path))
    cameras = {some.names[view]: Camera.of(some, view) for some in (views, held_out) for view in range(len(some))}
    maps = _scan_maps(run, views, held_out)
    with run.progress.track("scan", len(maps)) as report:
        votes = Votes.of(points, [cameras[name] for name in maps], maps.values(), config.scan.threshold, report)
    return pseudo_truth(points, votes, config.scan, str(path))


def _scan_maps(run, views, held_out):
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
    options = {"threads": run.threads, "progress": run.progress, "kinds": ("edge_paths",)}
    frames = undistorted_frames(frames, made, source.max_size, source.gamma, **options)
    maps = dict(zip(frames.names, read_edge_maps(frames, run.progress, run.threads), strict=True))
    if next(iter(maps.values())).shape != views.edge_maps.shape[1:]:
        problem = f"its maps are not {views.width} x {views.height} px as the scene's views are"
        raise UserError(f"evaluation.scan.edges: {folder}: {problem}; write them in that size")
    return {name: maps[name] for name in names}


def _write_pseudo_truth(run, views, truth):
    """The names of the files written: the points of the GroundTruth, if they are those of a scan on edges."""
    path = run.path("pseudo_truth.ply")
    if run.config.evaluation.kind != "scan":
        path.unlink(missing_ok=True)  # of an older run with other settings
        return []
    from taichi_edges.exporters.ply import write_float_vertices

    write_float_vertices(path, ("x", "y", "z"), views.similarity.to_input(truth.points))
    return [path.name]


def export(run):
    """`edges.json`, `views.npz` -> `edges.ply`, `.obj`, `.dxf`, `.step`, pictures in `overlays/`, `overlays.png`."""
    from taichi_edges.exporters import EXPORTERS
    from taichi_edges.exporters.overlays import contact_sheet, draw_overlays

    wireframe, _ = read_wireframe(run.path("edges.json"))
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


def picture_files(run):
    """The colour images that the overlays are drawn on; those of a synthetic scene are its own."""
    source = run.config.source
    if source.reader == "synthetic":
        return []
    return [Path(path) for path in listed_frames(run).image_paths if path and Path(path).is_file()]


def truth_files(run):
    """Every file the ground truth consists of."""
    from taichi_edges.evaluation.ground_truth import refuse_unknown

    path = truth_path(run)
    if path is None:
        return []
    if run.config.evaluation.truth:  # that of a synthetic scene may still have to be written
        refuse_unknown(path)
    truth = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [Path(path)]
    return truth + _scan_map_files(run)


def _scan_map_files(run):
    """The edge maps that the points of a scan are held against, where the scene names a folder of its own for them."""
    source, config = run.config.source, run.config.evaluation
    if config.kind != "scan" or not config.scan.edges or source.reader == "synthetic":
        return []
    frames = listed_frames(run, edges=config.scan.edges)
    return [Path(path) for path in frames.edge_paths if path and Path(path).is_file()]


def read_facts(path):
    """A JSON artefact as a dict; {} where it is not there or damaged (then the stage runs again)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
