"""What `run.py` does with its options: load the scene, run the corridor, print the summary, show the window."""

import os
import sys
from dataclasses import replace
from pathlib import Path

from taichi_edges.corridor.pipeline import STAGES, Run, expand, run_stages
from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import read_facts
from taichi_edges.progress import make_progress
from taichi_edges.scene.scene_file import is_source, load_scene

MOST_THREADS = 256  # each has a plane of its own to draw into


def run_command(options):
    """Run what the parsed command line `options` asks for; mistakes of the user raise UserError."""
    data_root = _data_root(options.data)
    config = load_scene(options.scene, options.preset, options.set, options.seed, options.scale, data_root)
    if options.show:
        _refuse_vain_show(options.until)
    run = Run(
        config=config,
        folder=Path(options.out) / config.name,
        data_root=data_root,
        threads=_threads(options.threads),
        arch=options.arch,
        progress=make_progress(options.quiet),
    )
    if config.source.reader == "auto":
        run = with_reader(run)
    if is_source(Path(options.scene)):
        _refuse_results_of_another(run)
    record = run_stages(run, options.stage, options.until)
    print_summary(run, record, options.until)
    if options.show:
        show(run)


def _refuse_vain_show(until):
    """UserError where --show cannot show anything in the end."""
    from taichi_edges.exporters.viewer import has_display

    if until and list(STAGES).index(until) < list(STAGES).index("refine"):
        raise UserError(f"--show needs the edges, but --until {until} stops before refine; leave one of them out")
    if not has_display():
        problem = "--show: there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set)"
        raise UserError(f"{problem}; run without it and open edges.ply, edges.step or overlays.png")


def with_reader(run):
    """The run with the reader that fits what is at its source.path; says which it is."""
    from taichi_edges.readers.recognition import recognised_source

    path = run.data_path(run.config.source.path, "source.path")
    source, found = recognised_source(path, run.config.source)
    run.progress.say(f"{path}: read as {found}")
    return replace(run, config=run.config.model_copy(update={"source": source}))


def _refuse_results_of_another(run):
    """UserError where the run's folder holds the results of another source: folders in two places may be called alike.

    Only where the name is the folder's; in a scene file the user has chosen it.
    """
    try:
        scene = read_facts(run.path("run.json"))["scene"]
        before, name = Path(scene["source"]["path"]), scene["name"]
    except (KeyError, TypeError):
        return
    before = before if before.is_absolute() else (run.data_root or Path()) / before
    if name == run.config.name and before.resolve() != Path(run.config.source.path).resolve():
        problem = f"holds the results of {before}"
        raise UserError(f"{run.folder}: {problem}; name others with --out FOLDER or --set name=NAME, or delete it")


def _data_root(option):
    """The folder of --data, or else of TAICHI_EDGES_DATA; None where neither is given."""
    origin, data = ("--data", option) if option else ("TAICHI_EDGES_DATA", os.environ.get("TAICHI_EDGES_DATA"))
    if not data:
        return None
    folder = expand(data, origin)
    if not folder.is_dir():
        raise UserError(f"{origin}: {data} is not a folder; name the folder that holds the scenes' data")
    return folder.resolve()


def _threads(wanted):
    """Threads to use: what the user wants, or all that this process may use."""
    if wanted is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not 1 <= wanted <= MOST_THREADS:
        bound = "at least 1" if wanted < 1 else f"at most {MOST_THREADS}"
        raise UserError(f"--threads {wanted}: must be {bound}")
    return wanted


def print_summary(run, record, until=None):
    """The metrics and the time of every stage, as two tables (plain lines where the output is not a terminal)."""
    names = list(STAGES)
    done = [name for name in names[: names.index(until) + 1 if until else None] if name in record["stages"]]
    rows = []
    for name in done:
        stage = record["stages"][name]
        seconds = f"{stage['seconds']:.1f} s" + ("" if name in record["ran"] else " (earlier)")
        rows.append((name, seconds, f"{stage['peak_memory_mib']:.0f} MiB"))
    if "evaluate" in done:
        from taichi_edges.evaluation.metrics import metrics_rows, rows_alone

        metrics = record["stages"]["evaluate"]["facts"]
        found = rows_alone if metrics["ground_truth"] is None else metrics_rows
        _print_table(f"{run.config.name}: metrics", ("metric", "value"), found(metrics))
    _print_table(f"{run.config.name}: stages", ("stage", "time", "peak memory"), rows)
    files = ", ".join(result_files(record["stages"], done))
    print(f"results: {run.folder}/" + (f"  ({files})" if files else ""))


def result_files(stages, done):
    """What to open of the stages that are done: the edges as far as they have come, and what shows them."""
    edges = [name for stage, name in (("fit", "edges_fit.json"), ("refine", "edges.json")) if stage in done][-1:]
    exported = stages["export"]["facts"]["files"] if "export" in done else []
    prepared = [name for name in stages["prepare"]["facts"]["files"] if name == "detection.png"]
    return [name for name in (*edges, *exported, *prepared) if "/" not in name]


def _print_table(title, headings, rows):
    if not sys.stdout.isatty():
        print(title)
        widths = [max(len(row[column]) for row in rows) for column in range(len(headings))] if rows else []
        for row in rows:
            print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for column, heading in enumerate(headings):
        table.add_column(heading, justify="right" if column else "left")
    for row in rows:
        table.add_row(*row)
    Console(highlight=False).print(table)


def show(run):
    """An Open3D window of the oriented points and the edges."""
    from taichi_edges.exporters.point_cloud import read_oriented_points
    from taichi_edges.exporters.viewer import show as show_window
    from taichi_edges.geometry.wireframe import read_wireframe

    for artefact in ("points.ply", "edges.json"):
        if not run.path(artefact).exists():
            raise UserError(f"{run.path(artefact)}: not there yet; --show needs the refine stage, run without --until")
    points, directions = read_oriented_points(run.path("points.ply"))
    files = [str(run.path(name)) for name in ("points.ply", "edges.ply", "edges.step", "overlays.png")]
    show_window(points, directions, read_wireframe(run.path("edges.json"))[0], files)
