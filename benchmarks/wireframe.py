"""What every step after the training is worth: `python benchmarks/wireframe.py [SCENE ...]`; with --hard, hard parts.

A scene is prepared and trained once, into a folder of its own below --out; the steps after that are done anew, in this
process. Each row of a table adds one step to the row before; `strokes` starts anew, from the order that the Gaussians
were laid in.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.machine import benchmark_cache, machine_line
from benchmarks.markdown import table
from benchmarks.pipeline import ROOT, missing_data
from taichi_edges.corridor import cluster, evaluate, fit
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.machine import available_threads
from taichi_edges.corridor.pipeline import Run, run_stages
from taichi_edges.evidence.edge_support import support_along
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.viewing_planes import refine_points
from taichi_edges.geometry.wireframe import Wireframe, read_wireframe, write_wireframe
from taichi_edges.refinement.completion import completed
from taichi_edges.refinement.continuation import continued
from taichi_edges.refinement.junctions import connected
from taichi_edges.refinement.stage import refine_wireframe, whole_edges, yardstick_of
from taichi_edges.strokes.assembly import assemble, fit_clusters
from taichi_edges.strokes.clustering import grow_clusters
from taichi_edges.strokes.clusters import Clusters, read_clusters
from taichi_edges.synthetic.hard_parts import HARD_PARTS
from taichi_edges.views.views import read_views

SCENES = ("abc_00004926_images", "abc_00000006_images", "cad_plate", "demo")
DETECTORS = {"images": "subpixel", "maps": "auto"}  # of a synthetic part: our own on its pictures, or its drawn maps
SCORES = {
    "Acc mm": ("accuracy_mm", "{:.2f}"),
    "Comp mm": ("completeness_mm", "{:.2f}"),
    "F5 %": ("f_score_5mm_percent", "{:.1f}"),
}
DUPLICATED = {"duplicated %": ("excess_duplicated_length_percent", "{:.1f}")}
SHAPE = {
    "length %": ("predicted_to_true_length_percent", "{:.1f}"),
    "corners closed %": ("corners_closed_percent", "{:.0f}"),
}
LOOSE_ENDS = {"free ends at corners": ("free_ends_at_corners", "{}")}
MEAN = {"exact mean mm": ("exact_mean_mm", "{:.2f}")}
WORST = {"exact p95 mm": ("exact_p95_mm", "{:.2f}")}


# Edges that do not meet yet: functions of a trained Run -> loose Wireframe in the unit cube --------------------------


def trained_points(run):
    """Points (n, 3) and directions (n, 3), unit cube: the trained centres that pass the paper's filters, unordered."""
    section = run.config.filter.model_copy(update={"refine": False})
    cluster.cluster(replace(run, config=run.config.model_copy(update={"filter": section})))
    clusters = read_clusters(run.path("clusters.npz"))
    return clusters.points, clusters.directions


def traversed(run):
    """The paper's clusters, those of graph traversal, and a line or curve through each of them."""
    points, directions = trained_points(run)
    clusters = Clusters.of(points, directions, grow_clusters(points, directions, run.config.cluster))
    return fit_clusters(clusters, run.config.fit)[0]


def claimed(run):
    """The same points, claimed by whole lines and arcs before graph traversal takes what is left."""
    return fitted(run, *trained_points(run))


def on_viewing_planes(run):
    """The same points, moved to where the viewing planes of their edgels meet."""
    matching = EdgelMatching(read_views(run.path("views.npz")))
    refined = refine_points(matching, *trained_points(run))
    return fitted(run, refined.points, refined.directions)


def fitted(run, points, directions):
    """The edges of oriented points."""
    return fit_clusters(assemble(points, directions, run.config.cluster), run.config.fit)[0]


def strokes(run):
    """The edges of the stages `cluster` and `fit`: each stroke cut into stretches, the best shape for each of these."""
    cluster.cluster(run)
    fit.fit(run)
    views = read_views(run.path("views.npz"))
    return read_wireframe(run.path("edges_fit.json")).transformed(views.similarity.to_unit, views.similarity.scale)


# From these to a wireframe: functions of a loose Wireframe, the Views, and the scene's `refine` section --------------


def as_fitted(loose, views, config):
    """The edges as they are."""
    return loose


def merged(loose, views, config):
    """Strokes that continue each other are one edge."""
    matching = EdgelMatching(views)
    yardstick, seen = yardstick_of(loose.shapes, matching), partial(support_along, matching)
    return Wireframe.loose(continued(loose.shapes, yardstick, matching.pixel_at, seen)[0])


def extended(loose, views, config):
    """Free ends go as far as the images show the edge, what they do not show goes; then strokes are merged again."""
    return Wireframe.loose(whole_edges(loose.shapes, EdgelMatching(views), config)[0])


def joined(loose, views, config):
    """Edges end in shared vertices, and short lines that are missing between these are found."""
    matching = EdgelMatching(views)
    shapes = whole_edges(loose.shapes, matching, config)[0]
    return completed(connected(shapes, matching.pixel_at), matching)[0]


def refined(loose, views, config):
    """The whole stage `refine`: all edges adjusted together to the edgels of all views as well."""
    return refine_wireframe(loose, views, config.model_copy(update={"enabled": True}))[0]


@dataclass(frozen=True)
class Step:
    """A row: its name; a function of the Run that gives loose edges, and one that makes a wireframe of them."""

    name: str
    loose: Callable
    refine: Callable = as_fitted


STEPS = (
    Step("as trained, graph traversal", traversed),
    Step("+ whole lines and arcs", claimed),
    Step("+ viewing planes", on_viewing_planes),
    Step("strokes", strokes),
    Step("+ merging", strokes, merged),
    Step("+ extents", strokes, extended),
    Step("+ shared vertices", strokes, joined),
    Step("+ joint adjustment: the default", strokes, refined),
)


# Measuring ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """One row. metrics: as in metrics.json. seconds: of the processor, from the trained Gaussians to these edges."""

    metrics: dict
    seconds: float


def ablation(run):
    """{name of the step: Measured} of a trained Run; what steps have in common is done, and timed, once."""
    views, known, found = read_views(run.path("views.npz")), {}, {}
    for step in STEPS:
        if step.loose not in known:
            known[step.loose] = timed(step.loose, run)
        loose, before = known[step.loose]
        wireframe, after = timed(step.refine, loose, views, run.config.refine)
        found[step.name] = Measured(evaluated(run, wireframe, views), before + after)
    return found


def timed(function, *arguments):
    """What the function returns, and the seconds that it takes of the processor, in all threads."""
    started = time.process_time()
    found = function(*arguments)
    return found, time.process_time() - started


def evaluated(run, wireframe, views):
    """The metrics of a Wireframe in the unit cube."""
    similarity = views.similarity
    write_wireframe(
        run.path("edges.json"), wireframe.transformed(similarity.to_input, 1.0 / similarity.scale), {"frame": "input"}
    )
    return evaluate.evaluate(run)


def trained(run):
    """The Run, prepared and trained unless it is already."""
    run_stages(run, until="train")
    return run


def with_kernels(run):
    """The trained Run; what follows has been done once, so that nobody's seconds are those of loading kernels."""
    run_stages(run, start="cluster", until="refine")
    return run


def measure_part(run):
    """Measured of the stages after the training, which are run anew."""
    _, seconds = timed(run_stages, run, "cluster", "refine")
    return Measured(evaluate.evaluate(run), seconds)


def cells(measured, columns):
    """The cells of a row. columns: {heading: (key of the metrics, format)}, or {heading: function of Measured}."""
    found = []
    for column in columns.values():
        if callable(column):
            found.append(column(measured))
        else:
            value = measured.metrics[column[0]]
            found.append(None if value is None else column[1].format(value))
    return found


EDGES = {"edges (true)": lambda measured: f"{measured.metrics['edges']} ({measured.metrics['true_edges']})"}
SECONDS = {"CPU s": lambda measured: f"{measured.seconds:.1f}"}
STEP_COLUMNS = SCORES | EDGES | DUPLICATED | SHAPE | LOOSE_ENDS | MEAN | WORST | SECONDS
PART_COLUMNS = SCORES | EDGES | SHAPE | WORST | SECONDS


def scene_path(name):
    """The file of a scene: a path, or the name of one in scenes/."""
    return Path(name) if name.endswith((".yaml", ".yml")) else ROOT / "scenes" / f"{name}.yaml"


def parse_arguments(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/wireframe.py", description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="*", help=f"names or files (default: {' '.join(SCENES)}; with --hard: none)")
    parser.add_argument("--hard", action="store_true", help="the hard synthetic parts, from images and from maps")
    parser.add_argument("--parts", nargs="+", choices=HARD_PARTS, default=list(HARD_PARTS), help="which of these")
    parser.add_argument("--out", type=Path, default=benchmark_cache() / "wireframe", help="folder of trained scenes")
    parser.add_argument("--threads", type=int, default=available_threads())
    return parser.parse_args(arguments)


def make_run(config, options):
    """The Run of a scene below --out."""
    data = os.environ.get("TAICHI_EDGES_DATA")
    return Run(config, options.out / config.name, Path(data) if data else None, options.threads)


def print_ablation(name, options):
    """Measure one scene and print its table."""
    path, data = scene_path(name), os.environ.get("TAICHI_EDGES_DATA")
    reason = missing_data(path, Path(data) if data else None)
    if reason:
        print(f"\nSkipped {path.stem}: {reason}", flush=True)
        return
    found = ablation(with_kernels(trained(make_run(load_scene(path, "fast"), options))))
    print(f"\n{path.stem}\n")
    print(table(["step", *STEP_COLUMNS], [[step, *cells(row, STEP_COLUMNS)] for step, row in found.items()]))
    sys.stdout.flush()


def print_parts(options):
    """Measure the hard parts and print their table."""
    runs = {}
    for part, source in product(options.parts, DETECTORS):
        settings = [f"name={part}_{source}", f"source.part={part}", f"source.detector={DETECTORS[source]}"]
        runs[part, source] = trained(make_run(load_scene(ROOT / "scenes/demo.yaml", "fast", settings), options))
    with_kernels(next(iter(runs.values())))
    rows = [[*names, *cells(measure_part(run), PART_COLUMNS)] for names, run in runs.items()]
    print(f"\nThe hard parts\n\n{table(['part', 'from', *PART_COLUMNS], rows)}")


def main(arguments=None):
    """Measure and print."""
    options = parse_arguments(arguments)
    print(f"{machine_line()}\n{options.threads} threads, preset fast")
    print("CPU s: processor time of all threads, from the trained Gaussians on", flush=True)
    for name in options.scene or (() if options.hard else SCENES):
        print_ablation(name, options)
    if options.hard:
        print_parts(options)


if __name__ == "__main__":
    main()
