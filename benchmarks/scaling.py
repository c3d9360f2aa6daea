"""How time and memory grow with Gaussians, views and pixels: `python benchmarks/scaling.py`.

Each axis is varied alone from a base point. Every point is a process of its own, so that its peak memory is its own; a
process that had to compile kernels is repeated, because a compiler's memory is not what is asked for. Processes cannot
take turns step by step; so beside the time on the clock there is the processor time of all threads, which others on the
machine hardly lengthen, and exponents are those of the latter.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.log_plot import Curve, Panel, draw_panels
from benchmarks.machine import benchmark_cache, compiled_kernels, machine_line, memory_mib
from benchmarks.markdown import table
from taichi_edges.corridor.machine import MIB, available_threads, peak_memory_mib, reset_peak_memory

ROOT = Path(__file__).resolve().parent.parent
AXES = {"gaussians": "Gaussians", "views": "views", "pixels": "width of a square view, pixels"}
ARRAYS = ("maps", "edge_words")  # of EdgeImages
SEED = 0


# One point, in a process of its own --------------------------------------------------------------------------------


def measure_here(count, view_count, width, height, threads, repeats):
    """Time and memory of one point in this process, as a dict. MiB; milliseconds per step; bytes of maps, masks."""
    from benchmarks.edge_scene import make_scene, scatter_gaussians
    from benchmarks.view_step import ROUND, do_round, make_splatter, start

    start("cpu", threads, profile=False)
    begun = memory_mib()
    scene = make_scene(view_count, width, height, SEED)
    with_maps, peaks = memory_mib(), [peak_memory_mib()]
    reset_peak_memory()
    splatter = make_splatter(scene, count, "cpu", threads)
    built, peaks = memory_mib(), [*peaks, peak_memory_mib()]
    reset_peak_memory()
    splatter.load(scatter_gaussians(scene, count, np.random.default_rng(SEED)))
    do_round(splatter, 0)
    milliseconds, processor = [], []
    for number in range(1, 1 + repeats):
        started, used = time.perf_counter(), time.process_time()
        do_round(splatter, number)
        milliseconds.append((time.perf_counter() - started) * 1e3 / ROUND)
        processor.append((time.process_time() - used) * 1e3 / ROUND)
    peaks.append(peak_memory_mib())
    arrays = {name: getattr(splatter.images, name) for name in ARRAYS}
    own = {name: array.nbytes for name, array in arrays.items() if not np.shares_memory(array, scene.edge_maps)}
    return {
        "milliseconds": float(np.median(milliseconds)),
        "processor": float(np.median(processor)),
        "begun": begun,  # Python, NumPy, OpenCV and Taichi alone
        "with_maps": with_maps,  # and the maps of the scene
        "built": built,  # and the Splatter
        "building": peaks[1],  # at most, while it was built
        "stepping": peaks[2],  # at most, while steps were done
        "peak": max(peaks),
        "arrays": {"maps of the reader": scene.edge_maps.nbytes} | own,
        "edge_images": sum(own.values()) + scene.edge_maps.nbytes,
        "edge_pixels": float((scene.edge_maps[:: max(view_count // 50, 1)] > 0).sum(axis=(1, 2)).mean()),
    }


def measure(point, options):
    """`measure_here` in a new process. point: (Gaussians, views, width, height)."""
    settings = [*point, options.threads, options.repeats]
    command = [sys.executable, __file__, "--point", *map(str, settings)]
    for _ in range(2):
        known = compiled_kernels(benchmark_cache())
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} ended with status {done.returncode}")
        if compiled_kernels(benchmark_cache()) == known:
            break
    return json.loads(done.stdout.splitlines()[-1])


# The curves --------------------------------------------------------------------------------------------------------


def curve_points(options):
    """{axis: points (Gaussians, views, width, height)} that differ from the base point in one thing only."""
    gaussians, views, size = options.base
    return {
        "gaussians": [(count, views, size, size) for count in options.gaussians],
        "views": [(gaussians, count, size, size) for count in options.views],
        "pixels": [(gaussians, views, other, other) for other in options.sizes],
    }


def position(axis, point):
    """Where a point stands on an axis."""
    return point[list(AXES).index(axis)]


def slopes(xs, ys):
    """Exponent of y ~ x^e: fitted to all points, and of the last two alone; None for less than two points."""
    if len(set(xs)) < 2:
        return None, None
    logs = np.log(xs), np.log(ys)
    return float(np.polyfit(*logs, 1)[0]), float((logs[1][-1] - logs[1][-2]) / (logs[0][-1] - logs[0][-2]))


def slope_text(xs, ys):
    """'0.98 (0.99 at the end)'."""
    fitted, last = slopes(xs, ys)
    return "-" if fitted is None else f"{round(fitted, 2) + 0.0:.2f} ({round(last, 2) + 0.0:.2f} at the end)"


def series(axis, points, found):
    """{what: (xs, ys)} of one axis: ms per step on the clock and of all threads, peak MiB, MiB of maps and masks."""
    xs = tuple(position(axis, point) for point in points)
    return {
        "clock": (xs, tuple(found[point]["milliseconds"] for point in points)),
        "processor": (xs, tuple(found[point]["processor"] for point in points)),
        "peak": (xs, tuple(found[point]["peak"] for point in points)),
        "maps": (xs, tuple(found[point]["edge_images"] / MIB for point in points)),
    }


def draw_curves(path, curves, found):
    """The picture: time above, memory below, one column for each axis."""
    above, below = [], []
    for axis, points in curves.items():
        of = series(axis, points, found)
        exponent = f"processor: exponent {slope_text(*of['processor'])}"
        times = Curve(exponent, *of["processor"]), Curve("on the clock", *of["clock"])
        above.append(Panel("milliseconds per view step", AXES[axis], times))
        memory = Curve("whole process", *of["peak"]), Curve("edge maps and masks", *of["maps"])
        below.append(Panel("peak memory, MiB", AXES[axis], memory))
    draw_panels(path, [above, below])


def print_points(curves, found):
    """The table of all points, axis by axis."""
    rows = []
    for points in curves.values():
        for point in points:
            of = found[point]
            size = f"{point[2]} x {point[3]}"
            memory = [f"{value:.0f}" for value in (of["peak"], of["edge_images"] / MIB)]
            rows.append([point[0], point[1], size, of["milliseconds"], of["processor"], *memory])
    headings = ["Gaussians", "views", "pixels", "ms per step", "ms of all threads", "peak MiB", "maps and masks MiB"]
    print(table(headings, rows))


def print_exponents(curves, found):
    """The table of exponents."""
    rows = []
    for axis, points in curves.items():
        of = series(axis, points, found)
        rows.append([axis, *(slope_text(*of[what]) for what in ("processor", "peak", "maps"))])
    print(table(["axis", "ms of all threads", "peak memory", "maps and masks"], rows))


def print_large(point, of):
    """What maps and masks of one large scene take, array by array, and what the process takes around them."""
    count, views, width, height = point
    print(f"{views} views of {width} x {height} px, {of['edge_pixels']:.0f} edge pixels in each, {count} Gaussians:\n")
    sizes = of["arrays"] | {"all of these": of["edge_images"]}
    print(table(["array", "bytes", "MiB"], [[name, size, f"{size / MIB:.1f}"] for name, size in sizes.items()]))
    fits = "fit" if of["edge_images"] <= 1024 * MIB else "do NOT fit"
    more = of["peak"] - of["edge_images"] / MIB
    print(f"\nMaps and masks {fits} in 1 GiB; the whole process never takes more than {more:.0f} MiB above them:\n")
    moments = {
        "Taichi started": "begun",
        "maps drawn": "with_maps",
        "while the Splatter is built (peak)": "building",
        "Splatter built": "built",
        "while steps are done (peak)": "stepping",
    }
    print(table(["moment", "resident MiB"], [[label, f"{of[key]:.0f}"] for label, key in moments.items()]))


def parse_arguments(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/scaling.py", description=__doc__.splitlines()[0])
    whole = {"type": int, "nargs": "*"}
    parser.add_argument("--gaussians", **whole, default=[2_000, 5_000, 10_000, 50_000, 200_000, 500_000])
    parser.add_argument("--views", **whole, default=[50, 100, 200, 500, 1_000])
    parser.add_argument("--sizes", **whole, default=[400, 600, 800, 1_200, 1_600], help="of the square views, pixels")
    base = {"type": int, "nargs": 3, "metavar": ("GAUSSIANS", "VIEWS", "PIXELS")}
    parser.add_argument("--base", **base, default=[10_000, 50, 800], help="what does not vary")
    large = {"type": int, "nargs": 3, "metavar": ("VIEWS", "WIDTH", "HEIGHT")}
    parser.add_argument("--large", **large, default=[1_000, 1_200, 680], help="the scene whose memory is broken down")
    parser.add_argument("--threads", type=int, default=available_threads())
    parser.add_argument("--repeats", type=int, default=3, help="rounds of view steps measured at each point")
    parser.add_argument("--pause", type=float, default=0.0, help="seconds between points, for others on the machine")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "scaling.png", help="the picture")
    parser.add_argument("--point", type=int, nargs=6, help=argparse.SUPPRESS)  # the process of one point
    return parser.parse_args(arguments)


def main(arguments=None):
    """Measure, print and draw. Returns {point: what was measured}."""
    options = parse_arguments(arguments)
    if options.point:
        print(json.dumps(measure_here(*options.point)))
        return None
    curves = {axis: sorted(points) for axis, points in curve_points(options).items() if points}
    large = (options.base[0], *options.large)
    found = {}
    for point in dict.fromkeys([*(point for points in curves.values() for point in points), large]):
        print("measuring {} Gaussians, {} views of {} x {} px".format(*point), file=sys.stderr)
        found[point] = measure(point, options)
        time.sleep(options.pause)
    print(f"{machine_line()}\n{options.threads} threads, medians of {options.repeats} rounds of view steps\n")
    print_points(curves, found)
    print("\nExponents (log-log slope over all points, and of the last two):\n")
    print_exponents(curves, found)
    print()
    print_large(large, found[large])
    if curves:
        draw_curves(options.out, curves, found)
        print(f"\n{options.out}")
    return found


if __name__ == "__main__":
    main()
