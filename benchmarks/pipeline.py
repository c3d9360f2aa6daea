"""Whole runs: seconds, memory and metrics of every scene file, `python benchmarks/pipeline.py --preset fast paper`.

Each run is the command a user types, in a process of its own, from the shell to the written exports. On Linux
and macOS: Windows does not tell what a process has used when it is over.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.machine import benchmark_cache, compiled_kernels, machine_line, maxrss_mib
from benchmarks.markdown import table
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.machine import available_threads
from taichi_edges.corridor.pipeline import Run, with_reader
from taichi_edges.corridor.stages import STAGES
from taichi_edges.errors import UserError

ROOT = Path(__file__).resolve().parent.parent
METRICS = {
    "Acc mm": ("accuracy_mm", "{:.2f}"),
    "Comp mm": ("completeness_mm", "{:.2f}"),
    "P5 %": ("precision_5mm_percent", "{:.1f}"),
    "R5 %": ("recall_5mm_percent", "{:.1f}"),
    "F5 %": ("f_score_5mm_percent", "{:.1f}"),
    "F10 %": ("f_score_10mm_percent", "{:.1f}"),
    "true edges": ("true_edges", "{:d}"),
    "edges": ("edges", "{:d}"),
    "length %": ("predicted_to_true_length_percent", "{:.1f}"),
    "corners closed %": ("corners_closed_percent", "{:.0f}"),
    "free ends at corners": ("free_ends_at_corners", "{:d}"),
    "exact mean mm": ("exact_mean_mm", "{:.2f}"),
    "exact p95 mm": ("exact_p95_mm", "{:.2f}"),
}
HELD_OUT = {
    "views held out": ("held_out_views", "{:d}"),
    "precision %": ("held_out_precision_percent", "{:.1f}"),
    "by chance %": ("held_out_chance_percent", "{:.1f}"),
    "judged %": ("held_out_judged_percent", "{:.1f}"),
    "recall %": ("held_out_recall_percent", "{:.1f}"),
    "recall of long edges %": ("held_out_recall_long_percent", "{:.1f}"),
    "F %": ("held_out_f_score_percent", "{:.1f}"),
    "median px": ("held_out_residual_median_px", "{:.2f}"),
    "p90 px": ("held_out_residual_p90_px", "{:.2f}"),
    "edges": ("edges", "{:d}"),
}


@dataclass(frozen=True)
class Measured:
    """One run.

    wall: seconds of the whole command. processor: seconds of all its threads, which others on the machine hardly
    lengthen. stages: {name: (seconds, peak MiB)}. peak: MiB of the process. metrics: as in metrics.json. compiled: how
    many kernels had to be compiled.
    """

    wall: float
    processor: float
    stages: dict
    peak: float
    metrics: dict
    compiled: int


def missing_data(scene, data_root):
    """Why a scene cannot run here, or None."""
    try:
        run = Run(load_scene(str(scene), data_root=data_root), Path("nowhere"), data_root)
        run = with_reader(run)
        for stage in STAGES.values():
            stage.outside(run)
    except UserError as error:
        return str(error)
    return None


def run_command(command, cache):
    """Seconds that a command takes, and its `resource` usage. cache: XDG_CACHE_HOME. SystemExit where it fails."""
    with tempfile.TemporaryFile("w+") as messages:
        environment, started = {**os.environ, "XDG_CACHE_HOME": str(cache)}, time.perf_counter()
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=messages, env=environment, cwd=ROOT, text=True
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            messages.seek(0)
            raise SystemExit(f"{' '.join(command)}\nended with status {process.returncode}:\n{messages.read()}")
    return wall, usage


def run_scene(scene, preset, seed, options, cache):
    """Run the command once in a new folder; its artefacts are thrown away. Returns Measured.

    preset, seed: None for those of the scene. cache: XDG_CACHE_HOME.
    """
    known = compiled_kernels(cache)
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, str(ROOT / "run.py"), str(scene), "--out", out, "--quiet"]
        command += ["--threads", str(options.threads), "--arch", options.arch]
        command += ["--preset", preset] if preset else []
        command += ["--seed", str(seed)] if seed is not None else []
        wall, usage = run_command(command, cache)
        (folder,) = Path(out).iterdir()
        record = json.loads((folder / "run.json").read_text())
        metrics = json.loads((folder / "metrics.json").read_text())
    stages = {name: (stage["seconds"], stage["peak_memory_mib"]) for name, stage in record["stages"].items()}
    # The stages reset the system's record of the peak, so that of the process covers only what comes after the last.
    peak = max(maxrss_mib(usage), *(peak for _, peak in stages.values()))
    processor = usage.ru_utime + usage.ru_stime
    return Measured(wall, processor, stages, peak, metrics, len(compiled_kernels(cache) - known))


def measure(scene, preset, seed, options):
    """`options.repeats` runs that found their kernels compiled, or with --cold as many that did not."""
    if options.cold:
        return [run_cold(scene, preset, seed, options) for _ in range(options.repeats)]
    first = run_scene(scene, preset, seed, options, benchmark_cache())
    if first.compiled:
        print(f"{scene.stem}: {first.compiled} kernels had to be compiled; that run does not count", file=sys.stderr)
    runs = [] if first.compiled else [first]
    more = options.repeats - len(runs)
    return runs + [run_scene(scene, preset, seed, options, benchmark_cache()) for _ in range(more)]


def run_cold(scene, preset, seed, options):
    """One run with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as cache:
        return run_scene(scene, preset, seed, options, cache)


def seconds_row(runs):
    """Medians: whole command, processor time, each stage, what lies outside (imports, summary), peak memory."""
    wall, processor = median([run.wall for run in runs]), median([run.processor for run in runs])
    stages = [median([run.stages[name][0] for run in runs]) for name in STAGES]
    outside = median([run.wall - sum(seconds for seconds, _ in run.stages.values()) for run in runs])
    return [wall, processor, *stages, outside, f"{median([run.peak for run in runs]):.0f}"]


def memory_row(runs):
    """Medians of the peak memory of each stage."""
    return [f"{median([run.stages[name][1] for run in runs]):.0f}" for name in STAGES]


def metrics_row(runs):
    """What the runs found, against the ground truth. runs: one of each seed."""
    if runs[0].metrics["ground_truth"] is None:
        return [None] * len(METRICS)
    return _cells(runs, METRICS)


def held_out_row(runs):
    """What the views say that were held out, whether there is a ground truth or not. runs: one of each seed."""
    return _cells(runs, HELD_OUT)


def _cells(runs, columns):
    """The text of some metrics, None where there is no number: counts as a range, means of everything else.

    columns: {heading: (key, pattern)}.
    """
    cells = []
    for key, pattern in columns.values():
        values = [run.metrics[key] for run in runs]
        if None in values:
            cells.append(None)
        elif pattern == "{:d}":
            cells.append("-".join(pattern.format(count) for count in sorted({min(values), max(values)})))
        else:
            cells.append(pattern.format(np.mean(values)))
    return cells


def median(values):
    """As a float."""
    return float(np.median(values))


def parse_arguments(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/pipeline.py", description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, nargs="+", help="scene files (default: all in scenes/)")
    parser.add_argument("--preset", choices=("fast", "paper"), nargs="+", default=[None], help="default: the scene's")
    parser.add_argument("--seeds", type=int, nargs="+", default=[None], help="default: the scene's")
    parser.add_argument("--threads", type=int, default=available_threads())
    parser.add_argument("--arch", choices=("cpu", "cuda", "vulkan"), default="cpu")
    parser.add_argument("--repeats", type=int, default=1, help="runs with each seed; medians are printed")
    parser.add_argument("--cold", action="store_true", help="compile all kernels anew in every run")
    return parser.parse_args(arguments)


def main(arguments=None):
    """Measure and print. Returns {(scene, preset): {seed: runs}}."""
    options = parse_arguments(arguments)
    data = os.environ.get("TAICHI_EDGES_DATA")
    scenes = options.scene or sorted((ROOT / "scenes").glob("*.yaml"))
    skipped = {scene: missing_data(scene, Path(data) if data else None) for scene in scenes}
    found = {}
    for scene in (scene for scene in scenes if not skipped[scene]):
        for preset in options.preset:
            runs = {seed: measure(scene.resolve(), preset, seed, options) for seed in options.seeds}
            found[scene.stem, preset or "its own"] = runs
    all_runs = {key: [run for runs in of_seeds.values() for run in runs] for key, of_seeds in found.items()}
    of_each_seed = {key: [runs[0] for runs in of_seeds.values()] for key, of_seeds in found.items()}
    cache = "empty kernel cache" if options.cold else "kernels compiled before"
    seeds = "" if options.seeds == [None] else f" with each of the seeds {', '.join(map(str, options.seeds))}"
    print(machine_line())
    print(f"{options.arch}, {options.threads} threads, {cache}, medians of {options.repeats} runs{seeds}")
    heads = ["scene", "preset"]
    print("\nSeconds, and peak memory of the process:\n")
    columns = [*heads, "whole command", "of all threads", *STAGES, "outside stages", "peak MiB"]
    print(table(columns, [[*key, *seconds_row(runs)] for key, runs in all_runs.items()]))
    print("\nPeak memory of each stage, MiB:\n")
    print(table([*heads, *STAGES], [[*key, *memory_row(runs)] for key, runs in all_runs.items()]))
    print("\nWhat they found, means over the seeds:\n")
    print(table([*heads, *METRICS], [[*key, *metrics_row(runs)] for key, runs in of_each_seed.items()]))
    print("\nWhat views that were held out say of it (docs/metrics.md):\n")
    print(table([*heads, *HELD_OUT], [[*key, *held_out_row(runs)] for key, runs in of_each_seed.items()]))
    for scene, reason in skipped.items():
        if reason:
            print(f"\nSkipped {scene.stem}: {reason}")
    return found


if __name__ == "__main__":
    main()
