"""Milliseconds of a view step and of its parts, beside plain C and beside the slow twin: `python -m benchmarks.splat`.

The competitors take turns within one run, so that the ratios of their medians hold on a busy machine.
"""

import argparse
from dataclasses import dataclass

import numpy as np

from benchmarks.edge_scene import make_scene, scatter_gaussians
from benchmarks.floor import Floor, FloorMissing, assert_same, compile_floor
from benchmarks.machine import available_threads, machine_line
from benchmarks.markdown import table
from benchmarks.twin import load_twin, random_direction, splat_slopes, time_twin
from benchmarks.view_step import PARTS, dump_step, make_splatter, medians, start, time_step, view_step
from taichi_edges.synthetic.rendering import pixel_size

VIEWS = 8
WARM_UP_STEPS = 3
TURN = 3  # steps, or passes of the C floor, in a turn: after the first the caches hold what is its own
TWIN_REPEATS = 3


@dataclass(frozen=True)
class Result:
    """What was measured at one number of Gaussians, milliseconds.

    pixels: selected ones, on average. smallest: transmittance. steps: {part: ms} of each step. floors: (forward,
    backward) of each pass in C; empty without it. twin: medians (loss, gradient) of the slow twin, scaled up.
    """

    count: int
    pixels: int
    smallest: float
    steps: list
    floors: list
    twin: tuple

    @property
    def parts(self):
        """{part: median}."""
        return medians(self.steps)


def measure(scene, count, floor, twin, options):
    """Result for `count` Gaussians. floor: Floor or None."""
    generator = np.random.default_rng(count)
    gaussians = scatter_gaussians(scene, count, generator)
    splatter = make_splatter(scene, count, options.arch, options.threads)
    splatter.load(gaussians)
    for number in range(1, WARM_UP_STEPS + 1):
        view_step(splatter, number % VIEWS, number)
    steps, floors, twins, pixels = [], [], [], []
    for number in range(WARM_UP_STEPS + 1, WARM_UP_STEPS + 1 + options.repeats):
        view = number % VIEWS
        camera = scene.intrinsics[view], scene.world_to_camera[view]
        steps += [time_step(splatter, view, number) for _ in range(TURN)]
        dumped = dump_step(splatter, view, number)
        pixels.append(len(dumped.pixels))
        if floor:
            passes = [floor.run(dumped) for _ in range(TURN)]
            if not floors:  # once is enough, and the judge is slow
                _, *results = passes[0]
                pixel = pixel_size(scene.intrinsics, scene.world_to_camera)
                direction = random_direction(count, pixel, generator)
                assert_same(dumped, *results, splat_slopes(twin, gaussians, camera, direction), direction)
            floors += [milliseconds for milliseconds, *_ in passes]
        if len(twins) < TWIN_REPEATS:
            twins.append(time_twin(twin, splatter, gaussians, camera))
    return Result(
        count,
        round(float(np.mean(pixels))),
        float(dumped.transmittance.min()),
        steps,
        floors,
        tuple(float(x) for x in np.median(twins, axis=0)),
    )


def print_steps(results):
    """The table of milliseconds."""
    extra = dict.fromkeys(part for result in results for part in result.parts if part not in PARTS)
    extra = [part for part in extra if part not in ("step", "launches")]
    measured = "launches" in results[0].parts
    columns = [*PARTS, *extra, "launches", "step"] if measured else ["step"]
    rows = [[result.count, result.pixels, *(result.parts[part] for part in columns)] for result in results]
    print(table(["Gaussians", "pixels", *columns], rows))


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
    """C's forward and backward; Taichi's time over it: forward, backward, both, and both of the fastest passes."""
    passes = [(step.get("forward"), step.get("backward")) for step in result.steps]
    if not result.floors or not all(all(times) for times in passes):
        return [None] * 6
    ours, floor = np.median(passes, axis=0), np.median(result.floors, axis=0)
    fastest = np.sum(passes, axis=1).min() / np.sum(result.floors, axis=1).min()
    return [float(x) for x in (*floor, *ours / floor, ours.sum() / floor.sum(), fastest)]


def twin_ratios(result):
    """The twin's time over Taichi's: of the loss, and of the loss with its gradient (the whole step)."""
    parts = result.parts
    until_loss = sum(parts.get(part, 0.0) for part in ("project", "forward", "loss")) or parts["step"]
    return result.twin[0] / until_loss, result.twin[1] / parts["step"]


def parse_arguments(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.splat", description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[2_000, 10_000, 50_000, 200_000], help="Gaussians")
    parser.add_argument("--threads", type=int, default=available_threads(), help="of Taichi and of the C floor alike")
    parser.add_argument("--size", type=int, default=800, help="width and height of the views, pixels")
    parser.add_argument("--repeats", type=int, default=11, help="turns of three view steps; medians are printed")
    parser.add_argument("--arch", choices=("cpu", "cuda", "vulkan"), default="cpu")
    return parser.parse_args(arguments)


def main(arguments=None):
    """Measure and print. Returns the Results."""
    options = parse_arguments(arguments)
    try:
        floor, reason = Floor(compile_floor(), options.threads), ""
    except FloorMissing as error:
        floor, reason = None, str(error)
    start(options.arch, options.threads)
    scene, twin = make_scene(VIEWS, options.size, options.size), load_twin()
    results = [measure(scene, count, floor, twin, options) for count in options.sizes]
    view, turns = f"{options.size} x {options.size} px", f"medians of {options.repeats} turns of {TURN} steps"
    print(f"{machine_line()}\n{options.arch}, {options.threads} threads, {view}, {turns}, ms\n")
    print_steps(results)
    print()
    print_ratios(results, reason)
    return results


if __name__ == "__main__":
    main()
