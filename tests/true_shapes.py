"""Hand-made ground truths, and truths written as predictions."""

import itertools

import numpy as np

from taichi_edges.evaluation.ground_truth import GroundTruth
from taichi_edges.geometry.bezier import bernstein
from taichi_edges.geometry.edge_set import EdgeSet


def line(start, end):
    """(2, 3) end points."""
    return np.array([start, end], dtype=np.float64)


def truth_of(*polylines, spacing=0.0005):
    """GroundTruth of polylines, every segment sampled every `spacing`, both ends included."""
    polylines = tuple(np.asarray(polyline, dtype=np.float64) for polyline in polylines)
    points, length = [], 0.0
    for polyline in polylines:
        for start, end in itertools.pairwise(polyline):
            size = np.linalg.norm(end - start)
            points.append(start + np.linspace(0, 1, int(np.ceil(size / spacing)) + 1)[:, None] * (end - start))
            length += size
    return GroundTruth(np.concatenate(points), polylines, ("line",) * len(polylines), length, "made by the test")


def fit_cubic(points):
    """(m, 3) points -> the (4, 3) cubic through both ends, least squares in the chord-length parameter."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    weights = bernstein(arc / arc[-1])
    inner = np.linalg.lstsq(weights[:, 1:3], points - weights[:, [0, 3]] @ points[[0, -1]], rcond=None)[0]
    return np.stack([points[0], *inner, points[-1]])


def truth_as_edges(truth):
    """The truth as a prediction: every straight curve one line from end to end, every other one a chain of cubics
    fitted to at most 11 vertices each."""
    segments = 10  # a third of a right angle, and less: such a cubic stays within 0.02 mm of the vertices
    lines, curves, sources = [], [], []
    for number, (polyline, kind) in enumerate(zip(truth.curves, truth.kinds, strict=True)):
        if kind == "line":
            lines.append(polyline[[0, -1]])
            continue
        pieces = int(np.ceil((len(polyline) - 1) / segments))
        borders = np.linspace(0, len(polyline) - 1, pieces + 1).astype(int)
        curves += [fit_cubic(polyline[a : b + 1]) for a, b in itertools.pairwise(borders)]
        sources += [number] * pieces
    line_sources = len(truth.curves) + np.arange(len(lines))
    return EdgeSet(np.array(lines), np.array(curves), line_sources, np.array(sources))


def circle_pieces(count, radius=0.2, centre=(0.5, 0.5, 0.5)):
    """(count, 4, 3) cubics of one circle in the xy plane."""
    angles = np.linspace(0.0, 2 * np.pi, count + 1)
    handle = 4 / 3 * np.tan(np.pi / count / 2)
    point = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    tangent = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], axis=1) * handle
    pieces = np.stack([point[:-1], point[:-1] + tangent[:-1], point[1:] - tangent[1:], point[1:]], axis=1)
    return np.asarray(centre) + radius * pieces


def assert_perfect(metrics):
    """The metrics are those of a wireframe that is the truth."""
    assert metrics["corners_closed"] == metrics["corners"]
    assert metrics["tangential_joints_closed"] == metrics["tangential_joints"]
    assert metrics["free_ends"] == metrics["true_free_ends"]
    assert metrics["free_ends_at_corners"] == metrics["false_free_ends"] == 0
    assert max(metrics["exact_p95_mm"], metrics["exact_completeness_p95_mm"]) < 0.02  # cubics fitted to the vertices
    assert metrics["exact_precision_5mm_percent"] == metrics["exact_recall_5mm_percent"] == 100.0
    assert abs(metrics["excess_duplicated_length_percent"]) < 0.1
