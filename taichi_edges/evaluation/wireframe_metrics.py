"""What a wireframe must have beyond points in the right places: closed corners, no loose ends, exact curves.

Points are no measure of these: three edges that stop 4 mm before their corner recall all of it at 5 mm.
"""

from collections.abc import Sequence

import numpy as np

from taichi_edges.evaluation.dense_curves import middle_samples
from taichi_edges.evaluation.edge_graph import EdgeGraph, edge_graph, free_ends
from taichi_edges.evaluation.joints import REACH, Joint, find_joints, followers, judge_joints

# In normalised units, EMAP's coarsest limit. Where a line turns into an arc of radius r, both are s^2 / 2r apart at the
# distance s: 0.5 mm at 10 mm with r = 100 mm. So images tell less of the place of a contact than of a corner's.
TANGENTIAL_REACH = 0.020
NEAR_CORNER = 0.010  # normalised units: twice REACH; an end this close to a corner was meant for it, or ran past it
EXACT_SPACING = 0.001  # normalised units between the samples that exact distances are taken from
UNIT_MM = 1000.0  # "mm" in one normalised unit


def wireframe_metrics(predicted: EdgeGraph, truth: EdgeGraph | None) -> dict[str, float | None]:
    """All the metrics of a predicted EdgeGraph. truth: that of the primitives, or None where only samples are known."""
    known = truth if truth is not None else edge_graph([], [])
    metrics = joint_metrics(predicted, known) | exact_metrics(predicted, known)
    if truth is None:
        metrics = dict.fromkeys(metrics)
    return {"free_ends": len(free_ends(predicted)), **metrics}


def joint_metrics(predicted: EdgeGraph, truth: EdgeGraph) -> dict[str, float | None]:
    """Numbers of corners and tangential joints, and the shares of them that the prediction reaches and closes."""
    joints = find_joints(truth)
    follows = followers(predicted, truth)
    verdicts = judge_joints(predicted, follows, joints)
    corner = np.array([joint.is_corner for joint in joints], dtype=bool)
    metrics: dict[str, float | None] = {}
    for name, chosen in (("corners", verdicts[corner]), ("tangential_joints", verdicts[~corner])):
        reached, closed = (int(count) for count in chosen.sum(axis=0))
        metrics[name] = len(chosen)
        metrics[f"{name}_closed"] = closed
        metrics[f"{name}_closed_percent"] = 100.0 * closed / len(chosen) if len(chosen) else None
        metrics[f"{name}_reached_percent"] = 100.0 * reached / len(chosen) if len(chosen) else None
    tangential = [joint for joint in joints if not joint.is_corner]
    near_enough = judge_joints(predicted, follows, tangential, TANGENTIAL_REACH)[:, 1]
    metrics["tangential_joints_closed_20mm_percent"] = 100.0 * float(near_enough.mean()) if tangential else None
    return metrics | true_end_metrics(predicted, truth, joints)


def true_end_metrics(predicted: EdgeGraph, truth: EdgeGraph, joints: Sequence[Joint]) -> dict[str, float | None]:
    """Which of the free ends of the prediction lie at a true corner, and which where no true edge ends at all."""
    loose = free_ends(predicted)
    corners = np.array([joint.point for joint in joints if joint.is_corner]).reshape(-1, 3)
    return {
        "free_ends_at_corners": int(np.count_nonzero(nearest(loose, corners) <= NEAR_CORNER)),
        "false_free_ends": int(np.count_nonzero(nearest(loose, truth.ends.points) > NEAR_CORNER)),
        "true_free_ends": len(free_ends(truth)),
    }


def nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n,) distances from each of the points to the nearest of the others; infinite where there is none."""
    apart = np.linalg.norm(points[:, None] - others[None], axis=2)
    return apart.min(axis=1, initial=np.inf)


def exact_metrics(predicted: EdgeGraph, truth: EdgeGraph) -> dict[str, float | None]:
    """Distances between the curves themselves, from samples every EXACT_SPACING along each: uniform in arc length."""
    from_predicted = curve_distances(predicted, truth)
    from_true = curve_distances(truth, predicted)
    has_both = len(from_predicted) > 0 and len(from_true) > 0
    return {
        "exact_mean_mm": UNIT_MM * float(from_predicted.mean()) if has_both else None,
        "exact_median_mm": UNIT_MM * float(np.median(from_predicted)) if has_both else None,
        "exact_p95_mm": UNIT_MM * float(np.percentile(from_predicted, 95)) if has_both else None,
        "exact_precision_5mm_percent": share_within_percent(from_predicted),
        "exact_completeness_mean_mm": UNIT_MM * float(from_true.mean()) if has_both else None,
        "exact_completeness_p95_mm": UNIT_MM * float(np.percentile(from_true, 95)) if has_both else None,
        "exact_recall_5mm_percent": share_within_percent(from_true),
    }


def curve_distances(one: EdgeGraph, other: EdgeGraph) -> np.ndarray:
    """(n,) distances from samples along the one EdgeGraph to the nearest points of the other."""
    points = middle_samples(one.polylines, EXACT_SPACING)[0]
    return other.dense.distances(points)


def share_within_percent(distances: np.ndarray) -> float:
    """Percent of the distances that are at most REACH, 5 mm; 0 of none."""
    return 100.0 * float(np.mean(distances <= REACH)) if len(distances) else 0.0
