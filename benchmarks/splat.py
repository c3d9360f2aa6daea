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
TWIN_REPEATS = 3


@dataclass(frozen=True)
class Result:
    """Medians at one number of Gaussians. parts: ms of Taichi; floor: (forward, backward) ms of C, or None;
    twin: (loss, gradient) ms of the slow twin, scaled up; pixels: selected ones; smallest: transmittance.
    """

    count: int
    pixels: int
    smallest: float
    parts: dict
    floor: tuple | None
    twin: tuple


def measure(scene, count, floor, twin, options):
    """Result for `count` Gaussians. floor: Floor or None."""
    generator = np.random.default_rng(count)
    gaussians = scatter_gaussians(scene, count, generator)
    splatter = make_splatter(scene, count, options.arch, options.threads)
    splatter.load(gaussians)
    for number in range(1, WARM_UP_STEPS + 1):
        view_step(splatter, number % VIEWS, number)
    steps, floors, twins = [], [], []
    for number in range(WARM_UP_STEPS + 1, WARM_UP_STEPS + 1 + options.repeats):
        view = number % VIEWS
        camera = scene.intrinsics[view], scene.world_to_camera[view]
        steps.append(time_step(splatter, view, number))
        dumped = dump_step(splatter, view, number)
        if floor:
            milliseconds, *results = floor.run(dumped)
            if not floors:  # once is enough, and the judge is slow
                pixel = pixel_size(scene.intrinsics, scene.world_to_camera)
                direction = random_direction(count, pixel, generator)
                assert_same(dumped, *results, splat_slopes(twin, gaussians, camera, direction), direction)
            floors.append(milliseconds)
        if len(twins) < TWIN_REPEATS:
            twins.append(time_twin(twin, splatter, gaussians, camera))
    return Result(
        count,
        len(dumped.pixels),
        float(dumped.transmittance.min()),
        medians(steps),
        tuple(float(x) for x in np.median(floors, axis=0)) if floors else None,
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
        forward, backward, both = ratios(result)
        c_forward, c_backward = result.floor or (None, None)
        row = [result.count, c_forward, c_backward, forward, backward, both]
        loss, gradient = twin_ratios(result)
        rows.append([*row, f"{loss:.0f}", f"{gradient:.1e}", f"{result.smallest:.0e}"])
    headings = ["Gaussians", "C forward ms", "C backward ms", "forward / C", "backward / C", "both / C"]
    print(table([*headings, "twin / loss", "twin / gradient", "smallest T"], rows))
    if reason:
        print(f"\nNo C floor: {reason}.")


def ratios(result):
    """Taichi's time over that of C: forward, backward, both; None where one of them was not measured."""
    parts = result.parts
    if result.floor is None or not parts.get("forward") or not parts.get("backward"):
        return None, None, None
    forward, backward = result.floor
    both = (parts["forward"] + parts["backward"]) / (forward + backward)
    return parts["forward"] / forward, parts["backward"] / backward, both


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
    parser.add_argument("--repeats", type=int, default=21, help="view steps measured; medians are printed")
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
    view = f"{options.size} x {options.size} px"
    print(
        f"{machine_line()}\n{options.arch}, {options.threads} threads, {view}, medians of {options.repeats} steps, ms\n"
    )
    print_steps(results)
    print()
    print_ratios(results, reason)
    return results


if __name__ == "__main__":
    main()
