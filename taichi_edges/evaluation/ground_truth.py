"""The true edges of a scene, from whatever form they come in: an ABC folder, a sampled PLY, or an edge file.

ABC folder     `*_features_*.yml` (the CAD curves), `*_trimesh_*.obj` (their vertices, raw CAD units) and `stats.json`
               (the bounding box). Without the obj the vertices are rebuilt from the parameters of lines and circles.
Sampled PLY    points only: the curves and their length stay unknown.
Edge file      EMAP's keys (`read_edges`), or a list `edges` of {edge, kind: line or bezier, p: control points}.

An ABC folder defines a normalised frame of its own (x_norm = x_raw * s + 0.5 - s * centre, s = 1 / longest side of the
model's bounding box). A PLY or an edge file is in the truth frame of the scene, and comes into the scene's unit cube by
the function `to_unit`, so that a "mm" means the same whatever the units of the input.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from taichi_edges.errors import UserError, did_you_mean, name_some
from taichi_edges.geometry.edge_set import EdgeSet, read_edges
from taichi_edges.scene.paths import expand
from taichi_edges.views.cameras import Similarity

ABC_SPACING = 0.005  # raw CAD units (!), EMAP get_gt_points: the spacing in the unit cube differs from model to model
EDGE_FILE_SPACING = 0.0005  # normalised units: a tenth of the finest threshold, so the sampling does not show
CURVE_SEGMENTS = 128  # chords of each cubic of an edge file: 90 degrees at radius 0.5, the largest, to 0.01 mm
INTERIOR_FACTOR = 1000.0  # ABC stores the interior vert_parameters of circles and B-splines multiplied by this
SAME_VERTEX = 1e-4  # of the longest side: two curves that share a vertex must rebuild it this closely
SAME_JOINT = 1e-6  # normalised units: pieces of one edge whose ends are this close are one curve
MALFORMED = (KeyError, IndexError, TypeError, ValueError, AttributeError)


@dataclass(frozen=True)
class GroundTruth:
    """The true edges, in a normalised frame: the model's own (`own_frame`), or the unit cube of the scene.

    points: (n, 3) float64 samples, what a prediction is scored against.
    curves: tuple of (m, 3) polylines, one for each true edge; empty where only samples are known.
    kinds:  tuple of 'line' or 'curve', one for each polyline.
    length: total length in normalised units, or None where only samples are known.
    source: what was read, in words.
    own_frame: predictions go into the truth frame of the scene to be compared; otherwise into its unit cube.
    """

    points: np.ndarray
    curves: tuple[np.ndarray, ...]
    kinds: tuple[str, ...]
    length: float | None
    source: str
    own_frame: bool = False


def as_it_is(points: np.ndarray) -> np.ndarray:
    """(n, 3) points that are normalised already."""
    return points


def read_ground_truth(path: Path | str, to_unit: Callable[[np.ndarray], np.ndarray] = as_it_is) -> GroundTruth:
    """Read the ground truth at `path`: an ABC folder, a sampled `.ply` or an edge `.json`. Returns a GroundTruth.

    to_unit: affine function (n, 3) -> (n, 3) from the scene's truth frame to its unit cube, for `.ply` and `.json`.
    """
    path = expand(path, "truth")
    check_truth_path(path)
    return read_abc(path) if path.is_dir() else FILE_READERS[path.suffix.lower()](path, to_unit)


def check_truth_path(path: Path) -> None:
    """UserError for what cannot be a ground truth, by names alone: quick enough to ask before the training."""
    if path.is_dir():
        if only_file(path, "*_features_*.yml") is None:
            raise UserError(f"{path}: no *_features_*.yml in it; give an ABC folder, a sampled .ply or an edge .json")
        return
    if not path.exists():
        raise UserError(f"{path}: no such ground truth; give an ABC folder, a sampled .ply or an edge .json")
    if path.suffix.lower() not in FILE_READERS:
        raise UserError(f"{path}: not a ground truth; give an ABC folder, a sampled .ply or an edge .json")


def polyline_length(polyline: np.ndarray) -> float:
    """(m, 3) polyline -> its length."""
    return float(np.linalg.norm(np.diff(polyline, axis=0), axis=1).sum())


# ---------------------------------------------------------------------------------------------------- ABC folders


def read_abc(folder: Path) -> GroundTruth:
    """The sharp curves of an ABC folder, sampled as EMAP samples them."""
    features = only_file(folder, "*_features_*.yml")
    assert features is not None, "see check_truth_path"
    sharp = read_sharp_curves(features)
    frame = read_frame(folder / "stats.json", scene=features.name.split("_")[0])
    mesh = only_file(folder, "*_trimesh_*.obj")
    if mesh is not None:
        raw, source = look_up_vertices(sharp, mesh, features), f"ABC curves, vertices of {mesh.name}"
    else:
        raw, source = rebuild_vertices(sharp, 1.0 / frame.scale, features), f"ABC curves, rebuilt from {features.name}"
    points = np.concatenate([sample_mesh_segments(polyline) for polyline in raw])
    if not len(points):
        raise UserError(f"{features}: every mesh segment is shorter than {ABC_SPACING} CAD units; give a sampled .ply")
    curves = tuple(frame.to_unit(polyline) for polyline in raw)
    kinds = tuple("line" if curve["type"] == "Line" else "curve" for curve in sharp)
    return GroundTruth(frame.to_unit(points), curves, kinds, sum(map(polyline_length, curves)), source, own_frame=True)


def only_file(folder: Path, pattern: str) -> Path | None:
    """The one file of `folder` that matches, or None; several are refused, for any choice could be the wrong one."""
    found = sorted(folder.glob(pattern))
    if len(found) > 1:
        names = name_some([file.name for file in found])
        raise UserError(f"{folder}: {len(found)} files match {pattern} ({names}); keep one")
    return found[0] if found else None


def read_sharp_curves(path: Path) -> list[dict[str, Any]]:
    """The sharp curves of a features yml, as the dicts they are. Raises UserError where there are none."""
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml is 10 times faster
    try:
        text = path.read_text(encoding="utf-8")
        curves = text.partition("\nsurfaces:")[0]  # ABC's own order: what follows is not needed, and 98 % of the file
        content = yaml.load(curves if curves.startswith("curves:") else text, Loader=loader)
        sharp = [curve for curve in content["curves"] if curve["sharp"]]
        described = all({"type", "vert_indices", "vert_parameters"} <= curve.keys() for curve in sharp)
    except (OSError, yaml.YAMLError, *MALFORMED) as error:
        raise UserError(f"{path}: not an ABC features file ({one_line(error)}); copy it again") from error
    if not sharp or not described:
        what = "a sharp curve lacks type, vert_indices or vert_parameters" if sharp else "it has no sharp curve"
        raise UserError(f"{path}: {what}; this model cannot be scored")
    return sharp


def read_frame(path: Path, scene: str) -> Similarity:
    """The Similarity from raw CAD units to the unit cube around 0.5, from the `bbox` of the scene in stats.json."""
    stats = read_json(path, "the bounding box (bbox) of the model by scene id")
    if not isinstance(stats, dict) or scene not in stats:
        known = list(stats) if isinstance(stats, dict) else []
        raise UserError(f"{path}: no scene '{scene}' in it{did_you_mean(scene, known)}; it must be keyed by scene id")
    try:
        low, high, extent = np.asarray(stats[scene]["bbox"], dtype=np.float64).reshape(3, 3)
        scale = 1.0 / float(extent.max())
    except (ZeroDivisionError, *MALFORMED) as error:
        raise UserError(f"{path}: {scene}: bbox must be 9 numbers: minimum, maximum, range; copy it again") from error
    return Similarity(scale, tuple(float(x) for x in 0.5 - scale * (low + high) / 2))


def look_up_vertices(sharp: list[dict[str, Any]], mesh: Path, features: Path) -> list[np.ndarray]:
    """One (m, 3) polyline in raw CAD units for each curve, from the vertices of the obj."""
    try:
        with open(mesh, encoding="utf-8") as file:
            vertices = np.array([line.split()[1:4] for line in file if line.startswith("v ")], dtype=np.float64)
        return [vertices[curve["vert_indices"]].reshape(-1, 3) for curve in sharp]
    except (OSError, *MALFORMED) as error:
        what = f"does not hold the vertices of {features.name} ({one_line(error)})"
        raise UserError(f"{mesh}: {what}; copy both again") from error


def rebuild_vertices(sharp: list[dict[str, Any]], longest_side: float, features: Path) -> list[np.ndarray]:
    """One (m, 3) polyline in raw CAD units for each curve, from the curve's own parameters.

    Curves that meet share vertex indices. A shared vertex that two curves put in different places means that the
    parameters were not understood, and is refused.
    """
    polylines: list[np.ndarray] = []
    seen: dict[int, np.ndarray] = {}
    for number, curve in enumerate(sharp):
        polyline = rebuild_curve(curve)
        missing = f"its vertices need {features.stem.replace('features', 'trimesh')}.obj, which is not there"
        if polyline is None:
            raise UserError(f"{features}: sharp curve {number} ({curve['type']}) cannot be rebuilt; {missing}")
        for vertex, point in zip(curve["vert_indices"], polyline, strict=True):
            if np.linalg.norm(seen.setdefault(vertex, point) - point) > SAME_VERTEX * longest_side:
                raise UserError(f"{features}: sharp curve {number} ({curve['type']}) misses its neighbours; {missing}")
        polylines.append(polyline)
    return polylines


def rebuild_curve(curve: dict[str, Any]) -> np.ndarray | None:
    """The (m, 3) vertices of a Line or a Circle in raw CAD units; None for other types and malformed curves."""
    try:
        t = true_parameters(curve["vert_parameters"])
        location = np.asarray(curve["location"], dtype=np.float64)
        if t is None or len(t) != len(curve["vert_indices"]):
            return None
        if curve["type"] == "Line":
            return location + np.outer(t, curve["direction"])
        if curve["type"] == "Circle":
            unit_circle = np.outer(np.cos(t), curve["x_axis"]) + np.outer(np.sin(t), curve["y_axis"])
            return location + curve["radius"] * unit_circle
    except MALFORMED:
        pass
    return None


def true_parameters(stored: list[float]) -> np.ndarray | None:
    """(m,) stored vert_parameters -> the true ones, or None.

    The first and the last are always stored as they are; those between may be multiplied by INTERIOR_FACTOR. Vertices
    follow each other along the curve, so the true reading is the one that runs from the first to the last without
    turning back; a factor of 1000 never leaves both readings in order.
    """
    for factor in (1.0, INTERIOR_FACTOR):
        parameters = np.array(stored, dtype=np.float64)
        parameters[1:-1] /= factor
        steps = np.diff(parameters)
        if len(steps) and ((steps >= 0).all() or (steps <= 0).all()):
            return parameters
    return None


def sample_mesh_segments(polyline: np.ndarray) -> np.ndarray:
    """EMAP's samples of one curve (get_gt_points): (m, 3) raw vertices -> (n, 3) raw points.

    Each mesh segment gets int(length // ABC_SPACING) points, both ends included, from its end back to its start.
    That order is EMAP's, and shows where a segment gets a single point.
    """
    samples = [np.zeros((0, 3))]
    for start, end in pairwise(polyline):
        count = int(np.linalg.norm(end - start) // ABC_SPACING)
        weights = np.linspace(0.0, 1.0, count)[:, None]
        samples.append(weights * start + (1.0 - weights) * end)
    return np.concatenate(samples)


# ---------------------------------------------------------------------------------------------------- single files


def read_sampled_ply(path: Path, to_unit: Callable[[np.ndarray], np.ndarray] = as_it_is) -> GroundTruth:
    """A point cloud as the truth: no curves, no length. to_unit: as in `read_ground_truth`."""
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        points = np.asarray(open3d.io.read_point_cloud(str(path)).points, dtype=np.float64)
    if not len(points) or not np.isfinite(points).all():
        raise UserError(f"{path}: no readable points in it; give a PLY with x, y, z of every sample")
    return GroundTruth(to_unit(points), (), (), None, f"sampled points of {path.name}")


def read_edge_file(path: Path, to_unit: Callable[[np.ndarray], np.ndarray] = as_it_is) -> GroundTruth:
    """An edge file as the truth, of EMAP's kind or with a list `edges`, sampled every EDGE_FILE_SPACING.

    to_unit: as in `read_ground_truth`.
    """
    content = read_json(path, "edges")
    if isinstance(content, dict) and {"lines_end_pts", "curves_ctl_pts"} & content.keys():
        edges = read_edges(path)  # first, for a file of ours may have a key `edges` as well: their number
    elif isinstance(content, dict) and isinstance(content.get("edges"), list):
        edges = edges_of_list(path, content["edges"])
    else:
        raise UserError(f"{path}: not an edge file; it needs curves_ctl_pts and lines_end_pts, or a list of edges")
    if len(edges.line_sources) != len(edges.lines) or len(edges.curve_sources) != len(edges.curves):
        raise UserError(f"{path}: line_sources and curve_sources do not match the edges; remove both of them")
    if not len(edges) or not all(np.isfinite(part).all() for part in (edges.lines, edges.curves)):
        raise UserError(f"{path}: no edge in it, or one that is not finite; a ground truth needs edges")
    edges = edges.transformed(to_unit)
    curves, kinds = join_pieces(edges)
    points = edges.sample(EDGE_FILE_SPACING)[0]
    return GroundTruth(points, curves, kinds, float(edges.lengths.sum()), f"edges of {path.name}")


def edges_of_list(path: Path, entries: list[dict[str, Any]]) -> EdgeSet:
    """Entries {edge: number, kind: line or bezier, p: (2, 3) or (4, 3)} -> EdgeSet, the number being the source."""
    points: dict[str, list[np.ndarray]] = {"line": [], "bezier": []}
    sources: dict[str, list[int]] = {"line": [], "bezier": []}
    for number, entry in enumerate(entries):
        try:
            shape = {"line": (2, 3), "bezier": (4, 3)}[entry["kind"]]
            points[entry["kind"]].append(np.array(entry["p"], dtype=np.float64).reshape(shape))
            sources[entry["kind"]].append(int(entry.get("edge", -1)))
        except MALFORMED as error:
            raise UserError(f"{path}: edges[{number}]: needs kind line with 2 points p, or bezier with 4") from error
    lines = np.array(points["line"]).reshape(-1, 2, 3)
    curves = np.array(points["bezier"]).reshape(-1, 4, 3)
    return EdgeSet(lines, curves, *(np.array(sources[kind], dtype=np.int64) for kind in ("line", "bezier")))


def join_pieces(edges: EdgeSet) -> tuple[tuple[np.ndarray, ...], tuple[str, ...]]:
    """EdgeSet -> tuple of (m, 3) polylines and tuple of their kinds, one for each edge.

    A Bezier piece that starts where the piece before it ends, and shares its source, goes on with that polyline.
    """
    pieces = edges.polylines(CURVE_SEGMENTS)
    curves, kinds = pieces[: len(edges.lines)], ["line"] * len(edges.lines)
    previous = -1
    for piece, source in zip(pieces[len(edges.lines) :], edges.curve_sources, strict=True):
        if source == previous >= 0 and np.linalg.norm(curves[-1][-1] - piece[0]) < SAME_JOINT:
            curves[-1] = np.concatenate([curves[-1], piece[1:]])
        else:
            curves.append(piece)
            kinds.append("curve")
        previous = source
    return tuple(curves), tuple(kinds)


def read_json(path: Path, what: str) -> Any:
    """The content of a JSON file; UserError where it is missing or broken. what: what it should hold, in words."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); it holds {what}") from error
    except ValueError as error:
        raise UserError(f"{path}: broken JSON ({one_line(error)}); copy it again") from error


def one_line(error: Exception) -> str:
    """The first line of an exception's text, with its kind where the text alone (a missing key) says little."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]}" if text else type(error).__name__


FILE_READERS = {".ply": read_sampled_ply, ".json": read_edge_file}
