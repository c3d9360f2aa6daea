"""How the time from points to a wireframe grows with the scene: `python benchmarks/scale.py`.

A street of equal facades stands side by side, each with as many points, strokes and edgels as the next, before views
that see all of it; so four facades should take four times as long as one. With --points, the clustering and the fit
have instead copies of the points of a run (its `clusters.npz`) side by side. Exponents are of processor time, which
others on the machine hardly lengthen.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.machine import benchmark_cache, machine_line
from benchmarks.markdown import table
from benchmarks.scaling import slope_text
from taichi_edges.corridor.machine import available_threads, peak_memory_mib, reset_peak_memory
from taichi_edges.geometry.shapes import EllipticArc, Line
from taichi_edges.kernels.device import start_taichi
from taichi_edges.refinement.stage import refine_wireframe
from taichi_edges.scene.settings import ClusterConfig, FitConfig, RefineConfig
from taichi_edges.strokes.assembly import assemble, fit_clusters
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import Views

WIDTH, FRAME, DEEP = 0.1, 0.02, 0.03  # unit-cube units: of a bay, the wall about its window, and how far that is set in
PIXEL, DEPTH, FOCAL = 5e-4, 2.0, 4000.0  # unit-cube units; distance of the views; px: DEPTH / FOCAL is a pixel
EYES = np.array(
    [[x, y] for x in (-0.5, 0.0, 0.5) for y in (-0.3, 0.0, 0.3)]
)  # where the views stand, beside the middle
SPACING_PX, NOISE_PX, STRAYS = 2.0, 0.3, 0.1  # of the points; strays for each of them
STEPS = ("cluster", "fit", "refine")


def facade(rows, columns, left):
    """Shapes of rows x columns windows, set in, every other row arched. left: where the facade begins, along x."""
    shapes = []
    for row, column in np.ndindex(rows, columns):
        low = np.array([left + column * WIDTH, row * WIDTH, 0.0]) + FRAME
        for depth in (0.0, DEEP):
            size = WIDTH - 2 * FRAME
            corners = low + [[0, 0, depth], [size, 0, depth], [size, 0.7 * size, depth], [0, 0.7 * size, depth]]
            sides = [corners[[k, (k + 1) % 4]] for k in range(4)]
            shapes += [Line(side) for side in sides[: 4 - row % 2]]
            if row % 2:
                middle, half = corners[[2, 3]].mean(axis=0), 0.5 * size
                shapes.append(EllipticArc(middle, half * np.eye(3)[:2], 0.0, np.pi))
    return shapes


def oriented_points(shapes, generator):
    """Noisy points (n, 3) on shapes and strays beside them, and directions (n, 3)."""
    places = [(np.arange(int(s.length / (SPACING_PX * PIXEL))) + 0.5) * SPACING_PX * PIXEL / s.length for s in shapes]
    points = np.concatenate([shape.at(some) for shape, some in zip(shapes, places, strict=True)])
    directions = np.concatenate([shape.tangents(some) for shape, some in zip(shapes, places, strict=True)])
    strays = generator.choice(len(points), int(STRAYS * len(points)), replace=False)
    points = points + generator.normal(0, NOISE_PX * PIXEL, points.shape)
    aside = points[strays] + generator.normal(0, 20 * PIXEL, (len(strays), 3))
    directions = directions + generator.normal(0, 0.03, directions.shape)
    points, directions = (
        np.concatenate([points, aside]),
        np.concatenate([directions, generator.normal(size=aside.shape)]),
    )
    return points, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def street_views(shapes, width, generator):
    """Views of shapes, with their edgels: side by side, in images as wide as the street, `width`."""
    high, wide = 1200, int(width / PIXEL) + 1200
    poses, of_views = [], []
    intrinsics = np.array([[FOCAL, 0, 0], [0, FOCAL, 0], [0, 0, 1.0]])
    intrinsics = np.tile(intrinsics, (len(EYES), 1, 1))
    for number, eye in enumerate(EYES):
        poses.append(np.column_stack([np.eye(3), [-eye[0], -eye[1], DEPTH]]))
        intrinsics[number, :2, 2] = 200 + FOCAL / DEPTH * eye + 50
        of_views.append(edgels_of(shapes, intrinsics[number] @ poses[-1], generator))
    maps, names = np.zeros((len(EYES), high, wide), np.uint8), tuple(map(str, range(len(EYES))))
    box = np.array([[0.0, 0, -0.5], [width, 1, 0.5]])
    return Views(names, maps, intrinsics, np.array(poses), ("",) * len(EYES), box=box, edgels=Edgels.of_views(of_views))


def edgels_of(shapes, camera, generator):
    """Points, normals and strengths of the edgels of shapes, a pixel apart, in one view. camera: (3, 4)."""
    places = [np.arange(0.0, 1.0, PIXEL / shape.length) for shape in shapes]
    points = np.concatenate([shape.at(some) for shape, some in zip(shapes, places, strict=True)])
    ahead = points + 1e-5 * np.concatenate([s.tangents(some) for s, some in zip(shapes, places, strict=True)])
    pixels, there = ((h[:, :2] / h[:, 2:]) for h in (np.c_[p, np.ones(len(p))] @ camera.T for p in (points, ahead)))
    along = there - pixels
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    pixels = pixels + generator.normal(0, 0.1, (len(pixels), 1)) * normals
    return pixels, normals, np.ones(len(pixels))


def side_by_side(points, directions, copies):
    """Points (n, 3) and directions several times, one copy beside the other along x."""
    step = 1.05 * np.ptp(points[:, 0])
    moved = [points + np.array([copy * step, 0.0, 0.0]) for copy in range(copies)]
    return np.concatenate(moved), np.tile(directions, (copies, 1))


def measure(copies, options, given):
    """{step: (seconds on the clock, of all threads, peak MiB, what there is of it)} of so many facades."""
    generator, found = np.random.default_rng(0), {}
    length = options.windows * WIDTH
    shapes = [shape for copy in range(copies) for shape in facade(options.windows, options.windows, copy * length)]
    points, directions = side_by_side(*given, copies) if given else oriented_points(shapes, generator)

    def timed(step, size, function):
        reset_peak_memory()
        clock, processor = time.perf_counter(), time.process_time()
        result = function()
        found[step] = time.perf_counter() - clock, time.process_time() - processor, peak_memory_mib(), size
        return result

    clusters = timed("cluster", len(points), lambda: assemble(points, directions, ClusterConfig()))
    loose, _ = timed("fit", len(clusters.arcs), lambda: fit_clusters(clusters, FitConfig()))
    if not given:
        views = street_views(shapes, copies * length, generator)
        timed("refine", len(loose), lambda: refine_wireframe(loose, views, RefineConfig(enabled=True)))
    return found


def parse_arguments(arguments=None):
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/scale.py", description=__doc__.splitlines()[0])
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 2, 4], help="facades, or copies of the points")
    parser.add_argument("--windows", type=int, default=5, help="in a row of a facade, and in a column")
    parser.add_argument("--points", type=Path, help="an npz file with points and directions, such as a clusters.npz")
    parser.add_argument("--threads", type=int, default=available_threads())
    return parser.parse_args(arguments)


def main(arguments=None):
    """Measure and print. Returns {copies: {step: numbers}}."""
    options, given = parse_arguments(arguments), None
    start_taichi("cpu", options.threads, 0, benchmark_cache())
    if options.points:
        with np.load(options.points) as archive:
            given = archive["points"], archive["directions"]
    copies = sorted(set(options.copies))
    measure(1, parse_arguments(["--windows", "2"]), None)  # compiles the kernels
    found = {count: measure(count, options, given) for count in copies}
    rows = [[count, step, size, *times] for count in copies for step, (*times, size) in found[count].items()]
    headings = ["copies", "step", "points or edges", "seconds", "seconds of all threads", "peak MiB"]
    print(f"{machine_line()}\n\n{table(headings, rows)}\n\nExponents of the seconds of all threads:\n")
    steps = [step for step in STEPS if step in found[copies[0]]]
    exponents = [[step, slope_text(copies, [found[count][step][1] for count in copies])] for step in steps]
    print(table(["step", "exponent"], exponents))
    return found


if __name__ == "__main__":
    main()
