"""The stage `train`: Gaussians, optimised until they lie on edges."""

from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.corridor.findings import WRONG_CAMERAS
from taichi_edges.files.artefacts import write_csv
from taichi_edges.views.views import Views, read_views

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.splatting.gaussians import Gaussians


def train(run: "Run") -> dict[str, Any]:
    """`views.npz` -> `gaussians.ply` (input frame) and `train_log.csv`."""
    from taichi_edges.files.splats import write_gaussians
    from taichi_edges.kernels.device import kernel_cache, start_taichi
    from taichi_edges.splatting.training import LogRecord, Training

    config, views = run.config.train, read_views(run.path("views.npz"))
    generator = np.random.default_rng(run.config.seed)
    start_taichi(run.arch, run.threads, run.config.seed, kernel_cache())
    start, strokes = start_of_training(run, views, generator)
    gaussians, records = start, list[LogRecord]()
    trained = config.enabled or strokes is None  # what lies along no stroke is nowhere in particular yet
    if trained:
        gaussians, records = Training(views, config, generator, run.threads, run.arch).run(start, run.progress)
    rows = [(r.step, f"{r.seconds:.3f}", f"{r.loss:.6f}", r.gaussians) for r in records]
    write_csv(run.path("train_log.csv"), [("step", "seconds", "loss", "gaussians"), *rows])
    similarity = views.similarity
    in_order = not (trained and config.density.changes_number)  # who is left, or a copy, has no place in it
    write_gaussians(
        run.path("gaussians.ply"),
        similarity.to_input(gaussians.means.astype(np.float64)),
        gaussians.log_scales - np.float32(np.log(similarity.scale)),
        gaussians.quaternions,
        gaussians.opacity_logits,
        strokes if in_order else None,
    )
    last = records[-1] if records else LogRecord(0, 0.0, np.nan, len(gaussians))
    loss = last.loss if np.isfinite(last.loss) else None  # no step may have measured it alone
    return {"gaussians": len(gaussians), "view_steps": last.step, "final_loss": loss}


def start_of_training(
    run: "Run", views: Views, generator: np.random.Generator
) -> "tuple[Gaussians, np.ndarray | None]":
    """The Gaussians that training starts from, as `train.seeds` says; and (n,) the stroke of each, None without."""
    from taichi_edges.files.ply import read_vertices, stack_fields
    from taichi_edges.seeding.starts import LEAST_SEEDS, given_points, random_points
    from taichi_edges.splatting.gaussians import start_gaussians

    config = run.config.train
    seeds: str = config.seeds
    if seeds in ("lift", "pair"):
        found, strokes = _proposed(run, views)
        if found is not None:
            return found, strokes
        seeds = "points" if run.path("seeds.ply").is_file() else "random"
        instead = {"points": "the given points", "random": "random points"}[seeds]
        problem = f"the views agree on an edge in fewer than {LEAST_SEEDS} places"
        run.progress.warn(f"{problem}: {WRONG_CAMERAS}; the training starts from {instead} instead")
    if seeds == "random" or not run.path("seeds.ply").is_file():
        points = random_points(config.gaussians, views.box, generator)
    else:
        given = stack_fields(read_vertices(run.path("seeds.ply"), ("x", "y", "z")), ("x", "y", "z"))
        points = given_points(views.similarity.to_unit(given.astype(np.float64)), config.gaussians, generator)
        if seeds == "auto":  # structure from motion finds few points where there is no texture
            more = random_points(config.gaussians - len(points), views.box, generator)
            points = np.concatenate([points, more])
    return start_gaussians(points, generator, config.initial_scale, config.initial_opacity), None


def _proposed(run: "Run", views: Views) -> "tuple[Gaussians | None, np.ndarray | None]":
    """Gaussians laid along the strokes that explain the edgels, and their strokes; None where they are too few."""
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.seeding.proposals import propose, propose_straight
    from taichi_edges.seeding.segments import LEAST_VIEWS
    from taichi_edges.seeding.starts import LEAST_SEEDS, stroke_gaussians

    config, paired = run.config.train, run.config.train.seeds == "pair"
    if paired and len(views) < LEAST_VIEWS:
        problem = f"{len(views)} views, and an edge is believed that {LEAST_VIEWS} show"
        cure = "take more pictures, each from near the one before"
        run.progress.warn(f"{problem}: {cure}; the edgels are lifted instead")
        paired = False
    matching = EdgelMatching(views, run.config.filter.min_views)
    with run.progress.track("pair" if paired else "lift", len(views)) as report:
        strokes = (propose_straight if paired else propose)(views, matching, report)
    if len(strokes) < min(LEAST_SEEDS, config.gaussians):
        return None, None
    return stroke_gaussians(strokes, matching.pixel_at(strokes.points), config.gaussians, config.initial_opacity)
