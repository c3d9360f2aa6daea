"""What the command does with its options: run the corridor, print the summary, show the window."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from taichi_edges.corridor.pipeline import Run, run_stages
from taichi_edges.corridor.reconstruction import open_run, stages_until
from taichi_edges.corridor.stages import STAGES
from taichi_edges.errors import UserError
from taichi_edges.scene.paths import data_folder, expand

if TYPE_CHECKING:
    from argparse import Namespace


def run_command(options: "Namespace") -> None:
    """Run what the parsed command line `options` asks for; mistakes of the user raise UserError."""
    if options.show:
        _refuse_vain_show(options.until)
    options.data, options.out = data_folder(options.data, "--data"), expand(options.out, "--out")
    names = ("out", "data", "preset", "scale", "seed", "threads", "arch", "quiet")
    run = open_run(options.scene, options.set, **{name: getattr(options, name) for name in names})
    record = run_stages(run, options.stage, options.until)
    print_summary(run, record, options.until)
    if options.show:
        show(run)


def _refuse_vain_show(until: str | None) -> None:
    """UserError where --show cannot show anything in the end."""
    from taichi_edges.exporters.viewer import has_display

    if until and list(STAGES).index(until) < list(STAGES).index("refine"):
        raise UserError(f"--show needs the edges, but --until {until} stops before refine; leave one of them out")
    if not has_display():
        problem = "--show: there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set)"
        raise UserError(f"{problem}; run without it and open edges.ply, edges.step or overlays.png")


def print_summary(run: Run, record: dict[str, Any], until: str | None = None) -> None:
    """The metrics and the time of every stage, as two tables (plain lines where the output is not a terminal)."""
    done, rows = stages_until(record, until), []
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


def result_files(stages: dict[str, Any], done: Sequence[str]) -> list[str]:
    """What to open of the stages that are done: the edges as far as they have come, and what shows them."""
    edges = [name for stage, name in (("fit", "edges_fit.json"), ("refine", "edges.json")) if stage in done][-1:]
    contours = stages["refine"]["facts"].get("files", []) if "refine" in done else []
    exported = stages["export"]["facts"]["files"] if "export" in done else []
    prepared = [name for name in stages["prepare"]["facts"]["files"] if name == "detection.png"]
    return [name for name in (*edges, *contours, *exported, *prepared) if "/" not in name]


def _print_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
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


def show(run: Run) -> None:
    """An Open3D window of the oriented points and the edges."""
    from taichi_edges.exporters.viewer import show as show_window
    from taichi_edges.files.point_cloud import read_oriented_points
    from taichi_edges.geometry.wireframe import read_wireframe

    for artefact in ("points.ply", "edges.json"):
        if not run.path(artefact).exists():
            raise UserError(f"{run.path(artefact)}: not there yet; --show needs the refine stage, run without --until")
    points, directions = read_oriented_points(run.path("points.ply"))
    files = [str(run.path(name)) for name in ("points.ply", "edges.ply", "edges.step", "overlays.png")]
    show_window(points, directions, read_wireframe(run.path("edges.json")), files)
