"""EMAP's metrics of a set of edges against the ground truth, and beside them what judges a wireframe.

`duplicates`, `primitives` and `wireframe_metrics` measure what EMAP's metrics do not show; docs/metrics.md lists all.

Protocol (EMAP, src/eval/eval_ABC.py and eval_util.py). The prediction is sampled at int(length // 0.005) points per
edge, uniform in the parameter, both ends included, cast to float32 and averaged per voxel of a 256^3 grid over
[-1, 1]^3. Accuracy is the mean distance from these points to the nearest true one, completeness the other way round.
Precision, recall and F count the points that are nearer than 5, 10 and 20 mm, strictly.

One "mm" is 0.001 of the normalised unit. Edges and truth must be in the same frame, the normalised one.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.evaluation.dense_curves import STEP
from taichi_edges.evaluation.duplicates import duplicated_percent
from taichi_edges.evaluation.edge_graph import EdgeGraph, edge_graph, free_ends
from taichi_edges.evaluation.primitives import true_primitives
from taichi_edges.evaluation.wireframe_metrics import wireframe_metrics
from taichi_edges.geometry.bezier import evaluate_bezier

if TYPE_CHECKING:
    from taichi_edges.evaluation.ground_truth import GroundTruth
    from taichi_edges.geometry.edge_set import EdgeSet

SAMPLE_SPACING = 0.005  # normalised units, EMAP sample_resolution
VOXELS_PER_UNIT = 128  # EMAP: 256 voxels over [-1, 1] on each axis
THRESHOLDS_MM = (5, 10, 20)  # EMAP
UNIT_MM = 1000.0  # "mm" in one normalised unit
HELD_OUT_SHARES = ("precision", "chance", "judged", "recall_long", "recall", "f_score")  # of what is printed
FEWEST_CHORDS = 16  # of a cubic, for exact distances; one of 90 degrees is met to 0.1 % of its radius


def evaluate(edges: "EdgeSet", truth: "GroundTruth") -> dict[str, float | None]:
    """The metrics of `edges`, an EdgeSet, against `truth`, a GroundTruth in the same frame.

    Returns a dict of floats and ints that JSON can hold; None where a number does not exist: distances of a prediction
    without points, shares of corners that do not exist, all that asks for the curves of a truth that is known by its
    samples only.
    """
    refuse_unbounded(edges)
    sources = piece_sources(edges)
    true = true_wireframe(truth)
    metrics = count_metrics(edges, truth, sources, true) | length_metrics(edges, truth, sources)
    metrics |= wireframe_metrics(edge_graph(exact_polylines(edges), sources), true)
    return metrics | point_metrics(sample_prediction(edges), truth.points.astype(np.float32))


def measure_alone(edges: "EdgeSet") -> dict[str, float | None]:
    """What can be said of `edges`, an EdgeSet in the normalised frame, without a truth; the keys are `evaluate`'s."""
    refuse_unbounded(edges)
    sources = piece_sources(edges)
    return {
        "lines": len(edges.lines),
        "curves": len(edges.curves),
        "edges": len(np.unique(sources)),
        "predicted_length_units": float(edges.lengths.sum()),
        "duplicated_length_percent": duplicated_percent(edges.polylines(), sources),
        "free_ends": len(free_ends(edge_graph(exact_polylines(edges), sources))),
    }


def count_metrics(
    edges: "EdgeSet", truth: "GroundTruth", sources: np.ndarray, true: EdgeGraph | None
) -> dict[str, float | None]:
    """How many pieces and edges there are. true: the EdgeGraph of the true primitives, or None."""
    count = len(np.unique(sources))
    return {
        "lines": len(edges.lines),
        "curves": len(edges.curves),
        "edges": count,
        "true_edges": len(true.polylines) if true else None,
        "true_edges_as_filed": len(truth.curves) or None,
        "edges_to_true_edges": count / len(true.polylines) if true else None,
    }


def length_metrics(edges: "EdgeSet", truth: "GroundTruth", sources: np.ndarray) -> dict[str, float | None]:
    """Lengths, and how much of them repeats what has been said."""
    length = float(edges.lengths.sum())
    duplicated = duplicated_percent(edges.polylines(), sources)
    metrics = {
        "predicted_length_units": length,
        "true_length_units": truth.length,
        "predicted_to_true_length_percent": 100.0 * length / truth.length if truth.length else None,
        "duplicated_length_percent": duplicated,
        "true_duplicated_length_percent": None,
        "excess_duplicated_length_percent": None,
    }
    if truth.curves:
        true_share = duplicated_percent(truth.curves, np.arange(len(truth.curves)))
        metrics["true_duplicated_length_percent"] = true_share
        metrics["excess_duplicated_length_percent"] = duplicated - true_share
    return metrics


def exact_polylines(edges: "EdgeSet") -> list[np.ndarray]:
    """One (m, 3) polyline for each piece, lines first, with chords of about STEP: 0.01 mm off at a radius of 3 mm."""
    counts = np.maximum(np.ceil(edges.lengths[len(edges.lines) :] / STEP), FEWEST_CHORDS).astype(int)
    cubics = zip(edges.curves, counts, strict=True)
    return [*edges.lines, *(evaluate_bezier(control, np.linspace(0.0, 1.0, count + 1)) for control, count in cubics)]


def true_wireframe(truth: "GroundTruth") -> EdgeGraph | None:
    """The EdgeGraph of the primitives of a GroundTruth; None where only samples are known."""
    if not truth.curves:
        return None
    primitives = true_primitives(truth.curves, truth.kinds)
    return edge_graph(primitives, np.arange(len(primitives)))


def refuse_unbounded(edges: "EdgeSet", where: str = "") -> None:
    """UserError for an edge with a coordinate that is not finite: no distance to it exists. where: 'edges.json: '."""
    finite = [np.isfinite(part).all(axis=(1, 2)) for part in (edges.lines, edges.curves)]
    for name, good in zip(("line", "curve"), finite, strict=True):
        if not good.all():
            number, problem = int(np.argmin(good)), "its points are not finite numbers"
            raise UserError(f"{where}{name} {number}: {problem}; drop it before scoring")


def piece_sources(edges: "EdgeSet") -> np.ndarray:
    """(L + C,) the source of every piece, lines first; a piece without one (-1) becomes a source of its own."""
    sources = np.concatenate([edges.line_sources, edges.curve_sources]).astype(np.int64)
    alone = sources < 0
    sources[alone] = sources.max(initial=0) + 1 + np.arange(np.count_nonzero(alone))
    return sources


# ------------------------------------------------------------------------------------------------- EMAP's metrics


def sample_prediction(edges: "EdgeSet") -> np.ndarray:
    """EMAP's points of a prediction: (n, 3) float32, one for each voxel that an edge passes through.

    An edge shorter than SAMPLE_SPACING gets no point. Outside [-1, 1]^3 the grid simply goes on, as it does in the
    library that EMAP calls (point_cloud_utils): points out there are averaged like the others and count against
    precision, rather than vanish.
    """
    samples = [np.zeros((0, 3))]
    for points, length in zip([*edges.lines, *edges.curves], edges.lengths, strict=True):
        parameters = np.linspace(0.0, 1.0, int(length // SAMPLE_SPACING))
        if len(points) == 2:
            samples.append(points[0] + parameters[:, None] * (points[1] - points[0]))
        else:
            samples.append(evaluate_bezier(points, parameters))
    return average_per_voxel(np.concatenate(samples).astype(np.float32))


def average_per_voxel(points: np.ndarray, per_unit: int = VOXELS_PER_UNIT) -> np.ndarray:
    """(n, 3) float32 -> (m, 3) float32, the mean of the points of each voxel, `per_unit` on a unit, that has any."""
    if not len(points):
        return points
    voxels = np.floor((points + np.float32(1.0)) * np.float32(per_unit)).astype(np.int64)
    _, owner, counts = np.unique(voxels, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(owner.ravel(), weights=points[:, axis], minlength=len(counts)) for axis in range(3)]
    return (np.stack(sums, axis=1) / counts[:, None]).astype(np.float32)


def point_metrics(predicted: np.ndarray, true: np.ndarray) -> dict[str, float | None]:
    """Distances and shares between (p, 3) predicted and (t, 3) true points, both float32."""
    to_true, to_predicted = nearest_distances(predicted, true), nearest_distances(true, predicted)
    metrics = {
        "accuracy_mm": UNIT_MM * float(to_true.mean(dtype=np.float64)) if len(predicted) else None,
        "completeness_mm": UNIT_MM * float(to_predicted.mean(dtype=np.float64)) if len(predicted) else None,
    }
    for threshold in THRESHOLDS_MM:
        precision = share_nearer_percent(to_true, threshold)
        recall = share_nearer_percent(to_predicted, threshold)
        both = precision + recall
        metrics[f"precision_{threshold}mm_percent"] = precision
        metrics[f"recall_{threshold}mm_percent"] = recall
        metrics[f"f_score_{threshold}mm_percent"] = 2.0 * precision * recall / both if both else 0.0
    return metrics


def nearest_distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n,) float32 distances from each of the points to the nearest of the others; infinite where there is none."""
    if not len(others):
        return np.full(len(points), np.inf, dtype=np.float32)
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)[0].astype(np.float32)


def share_nearer_percent(distances: np.ndarray, threshold_mm: float) -> float:
    """Percent of the float32 distances strictly below the threshold; compared in float32, as EMAP does."""
    if not len(distances):
        return 0.0
    return 100.0 * int(np.count_nonzero(distances < np.float32(threshold_mm / UNIT_MM))) / len(distances)


# ---------------------------------------------------------------------------------------------------- for printing


def metrics_rows(metrics: Mapping[str, float | None]) -> list[tuple[str, str]]:
    """The dict of `evaluate` as rows (label, value with unit) for printing."""
    metrics = defaultdict(lambda: None, metrics)  # a run that an earlier version has scored lacks some
    true_length = number_text(metrics["true_length_units"])
    true_duplicated = number_text(metrics["true_duplicated_length_percent"], "{:.1f} %")
    rows = [
        ("lines, curves", f"{metrics['lines']}, {metrics['curves']}"),
        ("edges", f"{metrics['edges']} (truth {number_text(metrics['true_edges'], '{:d}')})"),
        ("length", f"{metrics['predicted_length_units']:.2f} units (truth {true_length})"),
        ("length / true length", number_text(metrics["predicted_to_true_length_percent"], "{:.1f} %")),
        (
            "duplicated length",
            f"{metrics['duplicated_length_percent']:.1f} % (truth {true_duplicated})",
        ),
        ("corners closed", joints_text(metrics, "corners")),
        ("tangential joints closed", joints_text(metrics, "tangential_joints")),
        ("free ends", free_ends_text(metrics)),
        ("distance to true curves", spread_text(metrics, ("exact_mean_mm", "exact_median_mm", "exact_p95_mm"))),
        ("distance of true curves", spread_text(metrics, ("exact_completeness_mean_mm", "exact_completeness_p95_mm"))),
        ("true length within 5 mm", number_text(metrics["exact_recall_5mm_percent"], "{:.1f} %")),
        ("accuracy", number_text(metrics["accuracy_mm"], "{:.2f} mm")),
        ("completeness", number_text(metrics["completeness_mm"], "{:.2f} mm")),
    ]
    for threshold in THRESHOLDS_MM:
        for label, key in (("precision", "precision"), ("recall", "recall"), ("F-score", "f_score")):
            rows.append((f"{label} at {threshold} mm", f"{metrics[f'{key}_{threshold}mm_percent']:.1f} %"))
    return rows + held_out_rows(metrics)


def rows_alone(metrics: Mapping[str, float | None]) -> list[tuple[str, str]]:
    """The dict of `measure_alone` as rows (label, value with unit) for printing."""
    metrics = defaultdict(lambda: None, metrics)  # a run that an earlier version has measured lacks some
    return [
        ("lines, curves", f"{metrics['lines']}, {metrics['curves']}"),
        ("edges", number_text(metrics["edges"], "{:d}")),
        ("length", number_text(metrics["predicted_length_units"], "{:.2f} units")),
        ("duplicated length", number_text(metrics["duplicated_length_percent"], "{:.1f} %")),
        ("free ends", number_text(metrics["free_ends"], "{:d}")),
        *held_out_rows(metrics),
        ("ground truth", "none"),
    ]


def held_out_rows(metrics: Mapping[str, float | None]) -> list[tuple[str, str]]:
    """What the held-out views say (`held_out.held_out_metrics`) as rows; none where there are none."""
    if not metrics["held_out_views"]:
        return []
    percent = {key: number_text(metrics[f"held_out_{key}_percent"], "{:.1f} %") for key in HELD_OUT_SHARES}
    aside = f"by chance {percent['chance']}; judged: {percent['judged']} of the length"
    return [
        ("held-out views", number_text(metrics["held_out_views"], "{:d}")),
        ("held-out precision", f"{percent['precision']} ({aside})"),
        ("held-out recall", f"{percent['recall_long']} of long edges, {percent['recall']} of all"),
        ("held-out F-score", percent["f_score"]),
        ("held-out distance", spread_text(metrics, ("held_out_residual_median_px", "held_out_residual_p90_px"))),
    ]


def number_text(value: float | None, pattern: str = "{:.2f}") -> str:
    """The value in the pattern, or 'unknown' for None."""
    return "unknown" if value is None else pattern.format(value)


def joints_text(metrics: Mapping[str, float | None], name: str) -> str:
    """'10 of 12 (reached: 91.7 %)', 'none in the truth' or 'unknown'."""
    if not metrics[name]:
        return "unknown" if metrics[name] is None else "none in the truth"
    return f"{metrics[f'{name}_closed']} of {metrics[name]} (reached: {metrics[f'{name}_reached_percent']:.1f} %)"


def free_ends_text(metrics: Mapping[str, float | None]) -> str:
    """'14 (6 at corners, 3 at no true end)', only the number where the true curves are unknown."""
    if metrics["false_free_ends"] is None:
        return number_text(metrics["free_ends"], "{:d}")
    places = f"{metrics['free_ends_at_corners']} at corners, {metrics['false_free_ends']} at no true end"
    return f"{metrics['free_ends']} ({places})"


def spread_text(metrics: Mapping[str, float | None], keys: Sequence[str]) -> str:
    """'0.31 mm mean, 0.22 mm median, 0.95 mm p95', of those of the keys, in their units; 'unknown' where they are."""
    if metrics[keys[0]] is None:
        return "unknown"
    return ", ".join(f"{metrics[key]:.2f} {key.split('_')[-1]} {key.split('_')[-2]}" for key in keys)
