"""Milliseconds of a view step and of its parts, beside plain C and beside the slow twin: `python benchmarks/splat.py`.

The competitors take turns within one run, so that the ratios of their medians hold on a busy machine.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.edge_scene import make_scene, scatter_gaussians
from benchmarks.floor import Floor, FloorMissing, assert_same, compile_floor
from benchmarks.machine import machine_line
from benchmarks.markdown import table
from benchmarks.twin import load_twin, random_direction, splat_slopes, time_twin
from benchmarks.view_step import (
    PARTS,
    ROUND,
    do_round,
    dump_round,
    dump_step,
    make_splatter,
    medians,
    start,
    time_round,
)
from taichi_edges.corridor.machine import available_threads
from taichi_edges.synthetic.rendering import pixel_size

TWIN_REPEATS = 3


@dataclass(frozen=True)
class Result:
    """What was measured at one number of Gaussians, milliseconds.

    pixels: selected ones of a view, on average. smallest: transmittance. rounds: {part: ms per step} of each round of
    view steps. floors: (forward, backward) per step of each round in C; empty without it. twin: medians (loss,
    gradient) of the slow twin, scaled up.
    """

    count: int
    pixels: int
    smallest: float
    rounds: list
    floors: list
    twin: tuple

    @property
    def parts(self):
        """{part: median}."""
        return medians(self.rounds)


def measure(scene, count, library, twin, options):
    """Result for `count` Gaussians. library: the C floor's, or None."""
    generator = np.random.default_rng(count)
    gaussians = scatter_gaussians(scene, count, generator)
    splatter = make_splatter(scene, count, options.arch, options.threads)
    splatter.load(gaussians)
    do_round(splatter, 0)
    given, step, camera = dump_round(splatter), dump_step(splatter, 0), (scene.intrinsics[0], scene.world_to_camera[0])
    rounds, floors, twins = [], [], []
    if library:
        floor = Floor(library, count, splatter.selection.capacity, options.threads)
        direction = random_direction(count, pixel_size(scene.intrinsics, scene.world_to_camera), generator)
        assert_same(step, floor.step(given, 0), splat_slopes(twin, gaussians, camera, direction), direction)
    for number in range(1, 1 + options.repeats):
        rounds.append(time_round(splatter, number))
        if library:
            floors.append(floor.run_round(dump_round(splatter)))
        if len(twins) < TWIN_REPEATS:
            twins.append(time_twin(twin, splatter, gaussians, camera))
    return Result(
        count,
        round(float(np.mean(given.counts))),
        float(step.transmittance.min()),
        rounds,
        floors,
        tuple(float(x) for x in np.median(twins, axis=0)),
    )


def print_steps(results):
    """The table of milliseconds."""
    extra = dict.fromkeys(part for result in results for part in result.parts if part not in PARTS)
    extra = [part for part in extra if part not in ("step", "launches")]
    measured = "launches" in results[0].parts
    columns = [*PARTS, *extra, "launches", "step"] if measured else ["step"]
    rows = []
    for result in results:
        parts = result.parts
        share = [f"{100 * parts['launches'] / parts['step']:.0f}"] if measured else []
        rows.append([result.count, result.pixels, *(parts[part] for part in columns), *share])
    print(table(["Gaussians", "pixels", *columns, *(["launches %"] if measured else [])], rows))


def print_ratios(results, reason):
    """The table of ratios. reason: why there is no C floor, or ''."""
    rows = []
    for result in results:
        loss, gradient = twin_ratios(result)
        scaled = [f"{loss:.0f}", f"{gradient:.1e}", f"{result.smallest:.0e}"]
        rows.append([result.count, *floor_row(result), *scaled])
    headings = ["Gaussians", "C forward ms", "C backward ms", "forward / C", "backward / C", "both / C"]
    print(table([*headings, "both / C, fastest", "twin / loss", "twin / gradient", "smallest T"], rows))
    if reason:
        print(f"\nNo C floor: {reason}.")


def floor_row(result):
    """C's forward and backward; Taichi's time over it: forward, backward, both, and both of the fastest rounds."""
    ours = [(times.get("forward"), times.get("backward")) for times in result.rounds]
    if not result.floors or not all(all(times) for times in ours):
        return [None] * 6
    taichi, floor = np.median(ours, axis=0), np.median(result.floors, axis=0)
    fastest = np.sum(ours, axis=1).min() / np.sum(result.floors, axis=1).min()
    return [float(x) for x in (*floor, *taichi / floor, taichi.sum() / floor.sum(), fastest)]


def twin_ratios(result):
    """The twin's time over Taichi's: of the loss, and of the loss with its gradient (the whole step)."""
    parts = result.parts
    return result.twin[0] / (parts.get("forward") or parts["step"]), result.twin[1] / parts["step"]


def parse_arguments(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/splat.py", description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[2_000, 10_000, 50_000, 200_000], help="Gaussians")
    parser.add_argument("--threads", type=int, default=available_threads(), help="of Taichi and of the C floor alike")
    parser.add_argument("--size", type=int, default=800, help="width and height of the views, pixels")
    parser.add_argument("--repeats", type=int, default=7, help=f"turns of {ROUND} view steps; medians are printed")
    parser.add_argument("--arch", choices=("cpu", "cuda", "vulkan"), default="cpu")
    return parser.parse_args(arguments)


def main(arguments=None):
    """Measure and print. Returns the Results."""
    options = parse_arguments(arguments)
    try:
        library, reason = compile_floor(), ""
    except FloorMissing as error:
        library, reason = None, str(error)
    start(options.arch, options.threads)
    scene, twin = make_scene(ROUND, options.size, options.size), load_twin()
    results = [measure(scene, count, library, twin, options) for count in options.sizes]
    view, turns = f"{options.size} x {options.size} px", f"medians of {options.repeats} turns of {ROUND} steps"
    print(f"{machine_line()}\n{options.arch}, {options.threads} threads, {view}, {turns}, ms\n")
    print_steps(results)
    print()
    print_ratios(results, reason)
    return results


if __name__ == "__main__":
    main()
