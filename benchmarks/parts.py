"""How well parts come out, those that nobody tuned to above all: `python benchmarks/parts.py [--sheets FOLDER]`.

The real CAD parts of the data root (cad/part_*), each with three seeds; the hard synthetic parts from pictures and
from drawn maps, the ABC scenes, the plate and the demo once. One table a group with means, the worst, and the spread
over the seeds; how honest the confidences are; and whether the scores without truth rank scenes as the truth does. A
sheet a part shows where it is lost: the picture; the true edges, found green and missed red; the edges found, false
ones magenta. `--fit-verdict` prints the weights of `evidence/verdict.py`, fitted anew, and what they are worth on
scenes that took no part.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.machine import benchmark_cache, machine_line
from benchmarks.markdown import table
from benchmarks.pipeline import ROOT
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.machine import available_threads
from taichi_edges.corridor.pipeline import Run, run_stages
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.geometry.edge_set import read_edges
from taichi_edges.progress import Progress
from taichi_edges.synthetic.hard_parts import HARD_PARTS

ABC = ("abc_00000006", "abc_00000006_images", "abc_00004926", "abc_00004926_images", "abc_00004926_pidinet")
DETECTORS = {"images": "subpixel", "maps": "auto"}  # of a synthetic part: our own on its pictures, or its drawn maps
NEAR = 0.005  # 5 mm: of the unit cube, as EMAP's protocol has it
SPACING = 0.001  # of the places on edges
SEEN_BY = 8  # views that must see a place of a true edge, for it to count
HIDDEN = 0.003  # a ray that ends less than this before a true edge sees it
FOUND = 0.8  # of a true edge, to be found
LENGTHS = (0.0, 0.01, 0.02, 0.05, 0.1, 9.0)  # of true edges: classes
CHORDS = 400  # of a piece, that is sampled evenly then
BINS = 10  # of confidences
LIKELY = 0.5  # confidence of the edges that are kept
SHEET_PX, SHEET_VIEWS = 640, 3


@dataclass(frozen=True)
class Job:
    """One run. name: of the part or scene. group: of the table it goes into. settings: of `load_scene`."""

    name: str
    group: str
    scene: Path
    settings: tuple[str, ...]
    seed: int


def jobs(data: Path | None, seeds: list[int], only: list[str]) -> list[Job]:
    """All runs, the longest first."""
    found = []
    parts = sorted(data.glob("cad/part_*")) if data else []
    for seed in seeds:
        for part in parts:
            named = (f"name={part.name}", f"source.path=cad/{part.name}")
            truth = f"evaluation.truth=cad/{part.name}/gt_edges.json"
            found.append(Job(part.name, "parts", ROOT / "scenes/cad_plate.yaml", (*named, truth), seed))
    for part in HARD_PARTS:
        for source, detector in DETECTORS.items():
            named = (f"name={part}_{source}", f"source.part={part}", f"source.detector={detector}")
            found.append(Job(f"{part}_{source}", "hard", ROOT / "scenes/demo.yaml", named, seeds[0]))
    known = ("demo", "cad_plate", *ABC) if data else ("demo",)
    found += [Job(scene, "known", ROOT / f"scenes/{scene}.yaml", (), seeds[0]) for scene in known]
    return [job for job in found if not only or job.name in only]


def folder_of(job: Job, out: Path) -> Path:
    """Where the results of a job go."""
    return out / f"seed{job.seed}" / job.name


def run_job(job: Job, out: Path, data: Path | None, keep: bool) -> float | None:
    """Run one job anew; seconds of the processor, exports left out. keep: not if it has been run before; then None."""
    if keep and (folder_of(job, out) / "metrics.json").is_file():
        return None
    config = load_scene(job.scene, "fast", [*job.settings, f"seed={job.seed}"])
    run = Run(config, folder_of(job, out), data, threads=1, progress=Progress())
    started = time.process_time()
    run_stages(run, start="prepare", until="evaluate")
    return time.process_time() - started


# Against the truth ----------------------------------------------------------------------------------------------------


def places_on(pieces: np.ndarray) -> np.ndarray:
    """(n, 3) places SPACING apart on (k, 2, 3) lines or (k, 4, 3) cubics."""
    found = [np.zeros((0, 3))]
    for piece in pieces:
        fine = evaluate_bezier(piece[None], np.linspace(0, 1, CHORDS))[0] if len(piece) == 4 else piece
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
        count = max(1, round(arc[-1] / SPACING))
        at = (np.arange(count) + 0.5) / count * arc[-1]
        found.append(np.stack([np.interp(at, arc, fine[:, axis]) for axis in range(3)], axis=1))
    return np.concatenate(found)


@dataclass(frozen=True)
class Truth:
    """Places on the true edges of a part. points: (n, 3). edges: (n,) the edge. views: (n,) how many see it."""

    points: np.ndarray
    edges: np.ndarray
    views: np.ndarray


@cache
def truth_of(folder: Path) -> Truth:
    """The Truth of a part, from its `gt_edges.json` and `mesh.ply`."""
    import open3d as o3d

    content = json.loads((folder / "gt_edges.json").read_text())
    pieces = [(piece["edge"], places_on([np.array(piece["p"], float)])) for piece in content["edges"]]
    points = np.concatenate([places for _, places in pieces])
    edges = np.concatenate([np.full(len(places), number) for number, places in pieces])
    scene = o3d.t.geometry.RaycastingScene()
    mesh = o3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    views = np.zeros(len(points), int)
    for frame in json.loads((folder / "meta_data.json").read_text())["frames"]:
        ways = points - np.array(frame["camtoworld"])[:3, 3]
        far = np.linalg.norm(ways, axis=1)
        rays = np.concatenate([points - ways, ways / far[:, None]], axis=1).astype(np.float32)
        views += scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() > far - HIDDEN
    return Truth(points, edges, views)


def near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n,) bool: which of the points have one of the others within NEAR."""
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)[0] < NEAR if len(others) else np.zeros(len(points), bool)


def found_by_length(truth: Truth, near_found: np.ndarray) -> np.ndarray:
    """(len(LENGTHS) - 1, 2) of true edges that views see, by length: how many are found, and how many there are."""
    names, number = np.unique(truth.edges, return_inverse=True)
    counts = np.bincount(number)
    share = np.bincount(number, near_found) / counts
    seen = np.array([np.median(truth.views[number == k]) for k in range(len(names))]) >= SEEN_BY
    kind = np.digitize(SPACING * counts, LENGTHS) - 1
    rows = [(kind == k) & seen for k in range(len(LENGTHS) - 1)]
    return np.array([[np.count_nonzero(row & (share >= FOUND)), np.count_nonzero(row)] for row in rows])


def scores_of(job: Job, out: Path, data: Path | None) -> dict:
    """Figures of a finished run; of real parts by what SEEN_BY views see, of others by EMAP's protocol."""
    folder = folder_of(job, out)
    metrics = json.loads((folder / "metrics.json").read_text())
    figures = {name: metrics[f"{key}_5mm_percent"] for name, key in (("P5", "precision"), ("R5", "recall"))}
    figures |= {
        "edges": metrics["edges"],
        "corners": metrics.get("corners_closed"),
        "of corners": metrics.get("corners"),
    }
    figures["held-out F"] = metrics["held_out_f_score_percent"]
    if job.group == "parts" and data:
        truth = truth_of(data / "cad" / job.name)
        edges = read_edges(folder / "edges.json")
        places = np.concatenate([places_on(edges.lines), places_on(edges.curves)])
        near_found, seen = near(truth.points, places), truth.views >= SEEN_BY
        right = near(places, truth.points)
        figures |= {"P5": 100 * right.mean() if len(places) else 0.0, "R5": 100 * near_found[seen].mean()}
        figures |= {"false": SPACING * np.count_nonzero(~right), "length": SPACING * len(places)}
        figures["found"] = found_by_length(truth, near_found)
    figures["F5"] = 2 * figures["P5"] * figures["R5"] / max(figures["P5"] + figures["R5"], 1e-9)
    return figures


# How honest ----------------------------------------------------------------------------------------------------------


def confidences(job: Job, out: Path, data: Path) -> np.ndarray:
    """(k, 3) of the pieces of a part's edges: confidence, length, share of it that is right."""
    path = folder_of(job, out) / "edges.json"
    edges, known = read_edges(path), json.loads(path.read_text())["edges"]
    truth, rows = truth_of(data / "cad" / job.name), []
    for pieces, sources in ((edges.lines, edges.line_sources), (edges.curves, edges.curve_sources)):
        for piece, source in zip(pieces, sources, strict=True):
            places = places_on([piece])
            rows.append((known[source]["confidence"], len(places), near(places, truth.points).mean()))
    return np.array(rows).reshape(-1, 3)


def calibration_error(rows: np.ndarray) -> float:
    """Expected calibration error, 0 to 1, of (k, 3) confidences, lengths and shares that are right."""
    confidence, length, right = rows.T
    bins = np.minimum((confidence * BINS).astype(int), BINS - 1)
    off = np.bincount(bins, length * (confidence - right), BINS)
    return float(np.abs(off).sum() / max(length.sum(), 1e-9))


# The verdict's weights ------------------------------------------------------------------------------------------------


def marks_of_job(job: Job, out: Path, data: Path | None) -> tuple[np.ndarray, ...]:
    """Of all edges of a run that nobody has judged, and then of its strokes: marks (E, k), share that is right (E,),
    length in px (E,), and (E,) bool, which are strokes.
    """
    from taichi_edges.corridor.evaluate import ground_truth_of
    from taichi_edges.evidence.edge_support import EdgeSamples, support_of
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.verdict import marks_of
    from taichi_edges.geometry.shapes import middles_of
    from taichi_edges.geometry.wireframe import read_wireframe
    from taichi_edges.kernels.device import kernel_cache, start_taichi
    from taichi_edges.refinement.stage import edgel_noise, refine_wireframe
    from taichi_edges.views.cameras import transform
    from taichi_edges.views.views import read_views

    folder = folder_of(job, out)
    start_taichi("cpu", 1, 0, kernel_cache())
    config = load_scene(job.scene, "fast", [*job.settings, f"seed={job.seed}"])
    run, views = Run(config, folder, data, threads=1, progress=Progress()), read_views(folder / "views.npz")
    truth = ground_truth_of(run, views, read_views(folder / "held_out.npz"))
    points = truth.points
    if truth.own_frame:
        points = views.similarity.to_unit(transform(np.linalg.inv(views.input_to_truth), points))
    loose = read_wireframe(folder / "edges_fit.json").transformed(views.similarity.to_unit, views.similarity.scale)
    unjudged, _ = refine_wireframe(loose, views, config.refine.model_copy(update={"min_confidence": 0.0}))
    matching, found = EdgelMatching(views), []
    for shapes in (unjudged.shapes, loose.shapes):  # each by itself: the same edge twice would take its own edgels
        marks = marks_of(matching, shapes, edgel_noise(support_of(matching, shapes)))
        samples = EdgeSamples.along(shapes, SPACING)
        right = samples.sums(near(samples.points, points).astype(float)) / np.maximum(np.diff(samples.starts), 1)
        lengths = np.array([shape.length for shape in shapes]) / matching.pixel_at(middles_of(shapes))
        found.append((marks, right, lengths))
    marks, right, lengths = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return marks, right, lengths, np.arange(len(lengths)) >= len(unjudged)


def fitted_weights(marks: np.ndarray, right: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(k + 1,) weights of the marks, then the constant: logistic regression with a little ridge."""
    from scipy.optimize import minimize

    mean, spread = marks.mean(axis=0), marks.std(axis=0) + 1e-9
    columns = np.column_stack([(marks - mean) / spread, np.ones(len(marks))])

    def loss(b: np.ndarray) -> tuple[float, np.ndarray]:
        s = columns @ b
        slope = columns.T @ (weights * (1 / (1 + np.exp(-s)) - right)) + 2 * np.append(b[:-1], 0)
        return float((weights * (np.logaddexp(0, s) - right * s)).sum() + (b[:-1] ** 2).sum()), slope

    b = minimize(loss, np.zeros(columns.shape[1]), jac=True, method="L-BFGS-B").x
    return np.append(b[:-1] / spread, b[-1] - (b[:-1] * mean / spread).sum())


def print_fitted(done: list[Job], out: Path, data: Path | None, pool: ProcessPoolExecutor) -> None:
    """Fit the verdict's weights and print them, with what they are worth on parts that took no part in it."""
    first = [job for job in done if job.seed == done[0].seed]
    found = dict(zip(first, pool.map(marks_of_job, first, [out] * len(first), [data] * len(first)), strict=True))

    def fitted(some: list[Job]) -> np.ndarray:
        # Every scene counts alike, a real part as three: they are what the verdict is for. Strokes count half.
        weights = []
        for job in some:
            weighted = found[job][2] * np.where(found[job][3], 0.5, 1.0)
            weights.append(weighted / weighted.sum() * (600 if job.group == "parts" else 200))
        marks, right, _ = (np.concatenate([found[job][k] for job in some]) for k in range(3))
        return fitted_weights(marks, right, np.concatenate(weights))

    print(f"\nWeights of the verdict, the constant last: {np.round(fitted(first), 2).tolist()}")
    sure = np.concatenate([found[job][0][(found[job][1] >= FOUND) & ~found[job][3]] for job in first])
    print(f"Medians of the marks of edges that are right: {np.round(np.median(sure, axis=0), 2).tolist()}")
    rows = []
    for job in first:
        others = [other for other in first if other.name.split("_")[:2] != job.name.split("_")[:2]]
        b = fitted(others)
        marks, right, length = (column[~found[job][3]] for column in found[job][:3])
        likely = 1 / (1 + np.exp(-(marks @ b[:-1] + b[-1])))
        kept = (length * right)[likely >= LIKELY].sum()
        shares = kept / max(length[likely >= LIKELY].sum(), 1e-9), kept / max((length * right).sum(), 1e-9)
        f = 2 * shares[0] * shares[1] / max(sum(shares), 1e-9)
        rows.append([job.name, calibration_error(np.column_stack([likely, length, right])), *shares, f])
    scenes, groups = list(rows), {"of parts": "parts", "of hard parts": "hard", "of known scenes": "known"}
    for name, group in groups.items():
        some = [row[1:] for row, job in zip(scenes, first, strict=True) if job.group == group]
        rows += [[f"mean {name}", *np.mean(some, axis=0)]] if some else []
    print("\nEach scene by weights fitted to the others: expected calibration error; shares of the length kept that is")
    print("right and of the right length that is kept, and their harmonic mean:\n")
    print(table(["scene", "error", "right", "kept", "F"], rows))


# Sheets ---------------------------------------------------------------------------------------------------------------


def write_sheet(job: Job, out: Path, data: Path, sheets: Path) -> None:
    """A row for each of SHEET_VIEWS views: the picture; true edges; edges found. See the first lines."""
    import cv2

    from taichi_edges.views.views import choose_views, read_views

    folder, truth = folder_of(job, out), truth_of(data / "cad" / job.name)
    views, edges = read_views(folder / "views.npz"), read_edges(folder / "edges.json")
    places = np.concatenate([places_on(edges.lines), places_on(edges.curves)])
    found, right = near(truth.points, places), near(places, truth.points)
    green, red, black, magenta = (0, 150, 0), (0, 0, 230), (0, 0, 0), (255, 0, 255)
    rows = []
    for view in choose_views(views, SHEET_VIEWS):
        picture = cv2.imread(views.image_paths[view], cv2.IMREAD_UNCHANGED)
        share = picture[:, :, 3:] / 255.0 if picture.shape[2] == 4 else 1.0
        picture = (picture[:, :, :3] * share + 255 * (1 - share)).astype(np.uint8)
        edgels = views.edgels.of_view(view)[0]
        low = np.maximum(np.floor(edgels.min(axis=0)).astype(int) - 6, 0)
        side = int(np.ceil((edgels.max(axis=0) - low).max())) + 6
        crop = picture[low[1] : low[1] + side, low[0] : low[0] + side]
        crop = cv2.copyMakeBorder(
            crop, 0, side - crop.shape[0], 0, side - crop.shape[1], cv2.BORDER_CONSTANT, value=(255, 255, 255)
        )
        panels = [cv2.resize(crop, (SHEET_PX, SHEET_PX), interpolation=cv2.INTER_CUBIC)]
        panels += [panels[0] // 2 + 127, np.full_like(panels[0], 255)]
        seen = truth.views >= SEEN_BY
        for panel, points, good, colours in (
            (panels[1], truth.points[seen], found[seen], (green, red)),
            (panels[2], places, right, (black, magenta)),
        ):
            pixels = (views.project(points, view)[0] - low + 0.5) * SHEET_PX / side
            for (u, v), is_good in zip(np.nan_to_num(pixels, nan=-9), good, strict=True):
                cv2.circle(panel, (int(u), int(v)), 1, colours[0] if is_good else colours[1], -1)
        rows.append(np.hstack(panels))
    sheets.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(sheets / f"{job.name}.png"), np.vstack(rows))


# Printing -------------------------------------------------------------------------------------------------------------


def rows_of(done: dict[Job, dict], group: str) -> Iterator[list]:
    """Rows of a group's table: means over the seeds, and in brackets how much F5 spreads over them; mean and worst."""
    by_name: dict[str, list[dict]] = {}
    for job, figures in done.items():
        if job.group == group:
            by_name.setdefault(job.name, []).append(figures)
    means = {}
    for name, runs in by_name.items():
        p5, r5, f5 = (np.mean([run[key] for run in runs]) for key in ("P5", "R5", "F5"))
        spread = np.ptp([run["F5"] for run in runs])
        corners = [f"{run['corners']}/{run['of corners']}" for run in runs if run["of corners"]]
        seconds = [run["seconds"] for run in runs if run["seconds"] is not None]
        means[name] = f5
        yield [
            name,
            f"{p5:.1f}",
            f"{r5:.1f}",
            f"{f5:.1f} ({spread:.1f})",
            runs[0]["edges"],
            *(corners[:1] or [None]),
            f"{np.mean(seconds):.0f}" if seconds else None,
        ]
    if means:
        yield ["mean", None, None, f"{np.mean(list(means.values())):.1f}", None, None, None]
        worst = min(means, key=means.__getitem__)
        yield [f"worst: {worst}", None, None, f"{means[worst]:.1f}", None, None, None]


def print_parts(done: dict[Job, dict], out: Path, data: Path) -> None:
    """What there is to say of the real parts beyond their table."""
    parts = {job: figures for job, figures in done.items() if job.group == "parts"}
    if not parts:
        return
    false, length = (sum(figures[key] for figures in parts.values()) for key in ("false", "length"))
    found = sum(figures["found"] for figures in parts.values())
    names = [f"{1000 * a:g}-{1000 * b:g} mm" for a, b in pairwise(LENGTHS)]
    shares = [f"{name}: {100 * a / max(b, 1):.0f} %" for name, (a, b) in zip(names, found, strict=True)]
    closed, corners = (sum(figures[key] or 0 for figures in parts.values()) for key in ("corners", "of corners"))
    print(f"\nfalse length, share of all found: {100 * false / max(length, 1e-9):.1f} %")
    print(f"true edges found, by length: {', '.join(shares)}")
    print(f"corners closed: {100 * closed / max(corners, 1):.0f} %")
    error = calibration_error(np.concatenate([confidences(job, out, data) for job in parts]))
    print(f"expected calibration error of the confidences: {error:.3f}")


def print_ranks(done: dict[Job, dict]) -> None:
    """Whether the held-out views rank real parts and ABC scenes as the truth does."""
    from scipy.stats import spearmanr

    some = [figures for job, figures in done.items() if job.group == "parts" or job.name in ABC]
    if len(some) > 2:
        rank = spearmanr([figures["held-out F"] for figures in some], [figures["F5"] for figures in some]).statistic
        print(f"\nrank correlation of held-out F with F5, real parts and ABC scenes: {rank:.2f}")


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/parts.py", description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="*", help="names of parts and scenes (default: all)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the real parts; others: the first")
    parser.add_argument("--sheets", type=Path, help="folder for a picture of each real part")
    parser.add_argument("--fit-verdict", action="store_true", help="fit the weights of evidence/verdict.py anew")
    parser.add_argument("--keep", action="store_true", help="measure runs that are there, and run only the others")
    parser.add_argument(
        "--least", type=float, default=0.0, help="F5 in %% that the mean of all must reach, else status 1"
    )
    parser.add_argument("--out", type=Path, default=benchmark_cache() / "parts", help="folder of the runs")
    parser.add_argument(
        "--jobs", type=int, default=available_threads(), help="runs at the same time, of one thread each"
    )
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> dict[Job, dict]:
    """Measure and print. Returns {Job: figures}."""
    options = parse_arguments(arguments)
    data = Path(os.environ["TAICHI_EDGES_DATA"]) if os.environ.get("TAICHI_EDGES_DATA") else None
    todo, started = jobs(data, options.seeds, options.scene), time.perf_counter()
    print(f"{machine_line()}\npreset fast, one thread a run, {options.jobs} at the same time", flush=True)
    done: dict[Job, dict] = {}
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        running = {job: pool.submit(run_job, job, options.out, data, options.keep) for job in todo}
        for job, future in running.items():
            seconds = future.result()
            done[job] = scores_of(job, options.out, data) | {"seconds": seconds}
            took = "" if seconds is None else f", {seconds:.0f} s"
            print(f"  {job.name} (seed {job.seed}): F5 {done[job]['F5']:.1f}{took}", file=sys.stderr, flush=True)
        columns = ["scene", "P5 %", "R5 %", "F5 % (spread)", "edges", "corners closed", "CPU s"]
        for group, title in (("parts", "Real CAD parts"), ("hard", "Hard synthetic parts"), ("known", "Known scenes")):
            rows = list(rows_of(done, group))
            if rows:
                print(f"\n{title}\n\n{table(columns, rows)}")
        if data:
            print_parts(done, options.out, data)
        print_ranks(done)
        print(f"\n{time.perf_counter() - started:.0f} s in all", flush=True)
        if options.sheets and data:
            for job in (job for job in done if job.group == "parts" and job.seed == options.seeds[0]):
                write_sheet(job, options.out, data, options.sheets)
        if options.fit_verdict:
            print_fitted(list(done), options.out, data, pool)
    return done


def reaches(done: dict[Job, dict], least: float) -> bool:
    """Whether the mean F5 is at least so much; says so where not."""
    mean = float(np.mean([figures["F5"] for figures in done.values()])) if done else 0.0
    if mean < least:
        print(f"mean F5 {mean:.1f} %, below {least:g} %", file=sys.stderr)
    return mean >= least


if __name__ == "__main__":
    sys.exit(0 if reaches(main(), parse_arguments().least) else 1)
