"""How well edges of photographs come out, rendered ones with exact truth above all: `python benchmarks/photographs.py`.

The rendered courtyard and desk of the data root, whose creases are known, and the real castle and scan 37, of which
views that were held out tell; each by the command a user types, with three seeds. One table against the truth: creases
found (all, along the row of the cameras, upright, others, straight, curved), and of the length found how much lies on
a crease, on a surface elsewhere (texture, shadows), and in the air. One of what views that were held out say, of edges
that are there twice, of free ends, and of what a run takes. Means over the seeds; in brackets the spread.
"""

import argparse
import json
import os
import sys
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

if not __package__:  # run as a script: the project's root takes the place of this folder
    sys.path[0] = str(Path(__file__).resolve().parent.parent)

from benchmarks.machine import benchmark_cache, machine_line, maxrss_mib
from benchmarks.markdown import table
from benchmarks.pipeline import ROOT, run_command
from taichi_edges.corridor.machine import available_threads
from taichi_edges.evaluation.dense_curves import middle_samples
from taichi_edges.geometry.edge_set import read_edges
from taichi_edges.views.cameras import Cameras
from taichi_edges.views.views import read_views

SCENES = ("photoreal_courtyard", "photoreal_desk", "castle_p19", "dtu_scan37")
SEEN_BY = 4  # views that must see a place of a crease, for it to count
TOLERANCES = {
    0.02: 0.03,
    0.01: 0.015,
    0.002: 0.002,
}  # spacing of the truth: about 3 px at the usual distance, both metres
SAME_WAY = np.cos(np.radians(15.0))  # between an edge and the crease that it lies on
ALONG_ROW = np.cos(np.radians(20.0))  # between a crease and the line that the cameras stand along
ROW = 3.0  # how much farther the cameras reach along the line than across it, for them to stand along one
CHORDS = 200  # of a cubic
UPRIGHT = np.cos(np.radians(18.0))  # between a crease and the z axis of the rendered scenes


@dataclass(frozen=True)
class Creases:
    """Places on the true creases of a rendered scene that SEEN_BY views see, and on all.

    points, directions: (n, 3) metres. seen: (n,) bool. curved: (n,) bool. near: metres. spacing: of the places.
    """

    points: np.ndarray
    directions: np.ndarray
    seen: np.ndarray
    curved: np.ndarray
    near: float
    spacing: float


@cache
def creases_of(folder: Path) -> Creases:
    """The Creases of a rendered scene, from its `truth.npz`."""
    with np.load(folder / "truth.npz") as truth:
        spacing = round(float(truth["step"]), 6)
        directions = truth["directions"].astype(float)
        views, curved = truth["views"], truth["curved"].astype(bool)
        return Creases(
            truth["points"].astype(float), directions, views >= SEEN_BY, curved, TOLERANCES[spacing], spacing
        )


def distances_to(
    points: np.ndarray, directions: np.ndarray, others: np.ndarray, ways: np.ndarray, reach: float
) -> np.ndarray:
    """(n,) from oriented points to the nearest of others that runs the same way; infinite beyond `reach`."""
    found = np.full(len(points), np.inf)
    if len(points) and len(others):
        pairs = cKDTree(points).sparse_distance_matrix(cKDTree(others), reach, output_type="ndarray")
        same = np.abs((directions[pairs["i"]] * ways[pairs["j"]]).sum(axis=1)) > SAME_WAY
        np.minimum.at(found, pairs["i"][same], pairs["v"][same])
    return found


def row_of(centres: np.ndarray) -> np.ndarray | None:
    """(3,) unit vector along which the cameras, (V, 3), stand; None where they stand around."""
    _, sizes, ways = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    return ways[0] if sizes[0] > ROW * sizes[1] else None


def against_truth(folder: Path, scene: Path) -> dict:
    """Figures of a finished run against the Creases of its scene: shares in percent."""
    import open3d as o3d

    truth, edges = creases_of(scene), read_edges(folder / "edges.json")
    points, directions, *_ = middle_samples(edges.polylines(CHORDS), truth.spacing)
    found = np.isfinite(distances_to(truth.points, truth.directions, points, directions, truth.near))
    on_crease = np.isfinite(distances_to(points, directions, truth.points, truth.directions, truth.near))
    views = read_views(folder / "views.npz")
    cameras = Cameras.of(views.intrinsics @ views.world_to_camera)
    row = row_of(views.similarity.to_input(cameras.centres))
    along = np.abs(truth.directions @ row) > ALONG_ROW if row is not None else np.zeros(len(found), bool)
    upright = ~along & (np.abs(truth.directions[:, 2]) > UPRIGHT)
    kinds = {
        "found %": np.ones(len(found), bool),
        "along the row %": along,
        "upright %": upright,
        "other %": ~along & ~upright,
        "lines %": ~truth.curved,
        "curves %": truth.curved,
    }
    figures = {
        name: 100.0 * found[kind & truth.seen].mean() if (kind & truth.seen).any() else None
        for name, kind in kinds.items()
    }
    mesh = o3d.t.geometry.TriangleMesh.from_legacy(o3d.io.read_triangle_mesh(str(scene / "mesh.ply")))
    surface = o3d.t.geometry.RaycastingScene()
    surface.add_triangles(mesh)
    off = surface.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy() if len(points) else np.zeros(0)
    in_air = ~on_crease & (off > truth.near / 2)
    shares = {"on a crease %": on_crease, "on a surface %": ~on_crease & ~in_air, "in the air %": in_air}
    return figures | {name: 100.0 * share.mean() if len(points) else None for name, share in shares.items()}


def run_scene(name: str, seed: int, folder: Path, settings: list[str], threads: int) -> dict:
    """Run the command a user types into a new folder; its figures, the processor's seconds and the memory."""
    command = [sys.executable, str(ROOT / "run.py"), str(ROOT / f"scenes/{name}.yaml"), "--out", str(folder.parent)]
    command += ["--seed", str(seed), "--threads", str(threads), "--quiet", "--stage", "prepare"]
    command += [part for setting in settings for part in ("--set", setting)]
    wall, usage = run_command(command, benchmark_cache())
    stages = json.loads((folder / "run.json").read_text())["stages"]
    memory = max(maxrss_mib(usage), *(stage["peak_memory_mib"] for stage in stages.values()))
    return {"s": wall, "CPU s": usage.ru_utime + usage.ru_stime, "peak MiB": memory}


def figures_of(name: str, folder: Path, data: Path) -> dict:
    """Figures of a finished run."""
    metrics = json.loads((folder / "metrics.json").read_text())
    known = name.removeprefix("photoreal_")
    figures = against_truth(folder, data / "photoreal" / known) if known != name else {}
    return figures | {
        "edges": float(metrics["edges"]),
        "held-out precision %": metrics["held_out_precision_percent"],
        "by chance %": metrics["held_out_chance_percent"],
        "recall of long %": metrics["held_out_recall_long_percent"],
        "median px": metrics["held_out_residual_median_px"],
        "there twice %": metrics["duplicated_length_percent"],
        "free ends an edge": metrics["free_ends"] / max(metrics["edges"], 1),
    }


def cell(values: list) -> str | None:
    """'38.2 (1.4)': the mean and the spread, greatest less least; None where there is no number."""
    if None in values or not values:
        return None
    digits = 2 if np.mean(values) < 3 else 1 if np.mean(values) < 200 else 0
    spread = f" ({max(values) - min(values):.{digits}f})" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{spread}"


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python benchmarks/photographs.py", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--out", type=Path, default=Path("runs/photographs"), help="where the runs go")
    parser.add_argument("--keep", action="store_true", help="take finished runs as they are")
    parser.add_argument("--threads", type=int, default=available_threads())
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> dict[str, list[dict]]:
    """Run, print the tables, and return {scene: [figures of each seed]}."""
    options = parse_arguments(arguments)
    if not os.environ.get("TAICHI_EDGES_DATA"):
        raise SystemExit("set TAICHI_EDGES_DATA to the folder with the photographs")
    data, done = Path(os.environ["TAICHI_EDGES_DATA"]), {}
    for name, seed in product(options.scenes, options.seeds):
        folder = options.out.absolute() / f"seed{seed}" / name
        kept = options.keep and (folder / "metrics.json").is_file()
        took = {} if kept else run_scene(name, seed, folder, options.settings, options.threads)
        figures = figures_of(name, folder, data) | took
        done.setdefault(name, []).append(figures)
        print(f"  {name} (seed {seed}): {figures['edges']:.0f} edges", file=sys.stderr, flush=True)
    print(f"{machine_line()}, {options.threads} threads, seeds {', '.join(map(str, options.seeds))}")
    for columns in (TRUTH, OTHERS):
        rows = [
            [name, *(cell([figures.get(column) for figures in of_seeds]) for column in columns)]
            for name, of_seeds in done.items()
            if columns[0] in of_seeds[0]
        ]
        print(f"\n{table(['scene', *columns], rows)}" if rows else "", flush=True)
    return done


TRUTH = ["found %", "along the row %", "upright %", "other %", "lines %", "curves %"]
TRUTH += ["on a crease %", "on a surface %", "in the air %"]
OTHERS = ["edges", "held-out precision %", "by chance %", "recall of long %", "median px"]
OTHERS += ["there twice %", "free ends an edge", "s", "CPU s", "peak MiB"]


if __name__ == "__main__":
    main()
