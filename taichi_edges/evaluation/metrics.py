"""EMAP's metrics of a set of edges against the ground truth, and what they do not show: lengths and duplicates.

Protocol (EMAP, src/eval/eval_ABC.py and eval_util.py). The prediction is sampled at int(length // 0.005) points per
edge, uniform in the parameter, both ends included, cast to float32 and averaged per voxel of a 256^3 grid over
[-1, 1]^3. Accuracy is the mean distance from these points to the nearest true one, completeness the other way round.
Precision, recall and F count the points that are nearer than 5, 10 and 20 mm, strictly.

One "mm" is 0.001 of the normalised unit. Edges and truth must be in the same frame, the normalised one.
"""

import numpy as np

from taichi_edges.bezier import evaluate_bezier
from taichi_edges.errors import UserError

SAMPLE_SPACING = 0.005  # normalised units, EMAP sample_resolution
VOXELS_PER_UNIT = 128  # EMAP: 256 voxels over [-1, 1] on each axis
THRESHOLDS_MM = (5, 10, 20)  # EMAP
UNIT_MM = 1000.0  # "mm" in one normalised unit

DUPLICATE_SPACING = 0.002  # normalised units between samples: reads a distance of 5 mm at most 0.1 mm too long
DUPLICATE_DISTANCE = 0.005  # normalised units: the finest threshold, below which two edges tell the metrics the same
DUPLICATE_COSINE = 0.9  # between tangents: edges that meet at more than 26 degrees never count as parallel


def evaluate(edges, truth):
    """The metrics of `edges`, an EdgeSet, against `truth`, a GroundTruth in the same frame.

    Returns a dict of floats and ints that JSON can hold; None where a number does not exist: distances of a prediction
    without points, lengths and duplicates of a truth that is known by its samples only.
    """
    refuse_unbounded(edges)
    predicted_length = float(edges.lengths.sum())
    sources = piece_sources(edges)
    metrics = {
        "lines": len(edges.lines),
        "curves": len(edges.curves),
        "edges": len(np.unique(sources)),
        "true_edges": len(truth.curves) or None,
        "predicted_length_units": predicted_length,
        "true_length_units": truth.length,
        "predicted_to_true_length_percent": 100.0 * predicted_length / truth.length if truth.length else None,
        "duplicated_length_percent": duplicated_percent(edges.polylines(), sources),
        "true_duplicated_length_percent": None,
    }
    if truth.curves:
        metrics["true_duplicated_length_percent"] = duplicated_percent(truth.curves, np.arange(len(truth.curves)))
    return metrics | point_metrics(sample_prediction(edges), truth.points.astype(np.float32))


def refuse_unbounded(edges):
    """UserError for an edge with a coordinate that is not finite: no distance to it exists."""
    finite = [np.isfinite(part).all(axis=(1, 2)) for part in (edges.lines, edges.curves)]
    for name, good in zip(("line", "curve"), finite, strict=True):
        if not good.all():
            raise UserError(f"{name} {int(np.argmin(good))}: its points are not finite numbers; drop it before scoring")


def piece_sources(edges):
    """(L + C,) the source of every piece, lines first; a piece without one (-1) becomes a source of its own."""
    sources = np.concatenate([edges.line_sources, edges.curve_sources]).astype(np.int64)
    alone = sources < 0
    sources[alone] = sources.max(initial=0) + 1 + np.arange(np.count_nonzero(alone))
    return sources


# ------------------------------------------------------------------------------------------------- EMAP's metrics


def sample_prediction(edges):
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


def average_per_voxel(points):
    """(n, 3) float32 -> (m, 3) float32, the mean of the points of each voxel that has any."""
    if not len(points):
        return points
    voxels = np.floor((points + np.float32(1.0)) * np.float32(VOXELS_PER_UNIT)).astype(np.int64)
    _, owner, counts = np.unique(voxels, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(owner.ravel(), weights=points[:, axis], minlength=len(counts)) for axis in range(3)]
    return (np.stack(sums, axis=1) / counts[:, None]).astype(np.float32)


def point_metrics(predicted, true):
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


def nearest_distances(points, others):
    """(n,) float32 distances from each of the points to the nearest of the others; infinite where there is none."""
    if not len(others):
        return np.full(len(points), np.inf, dtype=np.float32)
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)[0].astype(np.float32)


def share_nearer_percent(distances, threshold_mm):
    """Percent of the float32 distances strictly below the threshold; compared in float32, as EMAP does."""
    if not len(distances):
        return 0.0
    return 100.0 * int(np.count_nonzero(distances < np.float32(threshold_mm / UNIT_MM))) / len(distances)


# ------------------------------------------------------------------------------------------------------ duplicates


def duplicated_percent(polylines, sources):
    """Percent of the length of the polylines that repeats what another, longer edge says already.

    polylines: list of (m, 3). sources: (P,) int, pieces of one edge share it.
    Pieces are counted one after the other: those of the longest edge (summed over its source) first, equal ones as
    they come. A stretch of a piece is a duplicate where, for one of the pieces counted before it,
    * the nearest point of that piece is at most DUPLICATE_DISTANCE away and not a duplicate itself;
    * the two tangents there are parallel: |cos| >= DUPLICATE_COSINE;
    * that point lies beside the stretch, not before it: where the other piece has already ended, the stretch goes on
      with it and repeats nothing. So pieces of one circle, and lines that continue each other, are no duplicates of
      each other, but a piece that runs back over another is one, even of the same source.
    Edges that meet or cross at more than 26 degrees never count; those that meet at a sharper angle (a spline that
    touches a circle) do, near the corner, and so do true edges less than 5 mm apart: compare with the number of the
    truth itself.
    """
    points, tangents, steps, pieces, ends = middle_samples(polylines)
    total = steps.sum()
    if not total:
        return 0.0
    rank = rank_pieces(np.bincount(pieces, weights=steps, minlength=len(polylines)), sources)
    later, earlier = neighbours_counted_before(points, pieces, rank)
    offset = points[later] - points[earlier]
    parallel = np.abs((tangents[later] * tangents[earlier]).sum(axis=1)) >= DUPLICATE_COSINE
    outward = (offset * tangents[earlier]).sum(axis=1)
    # A sample stands for half a step to each side; the quarter closes the gap where two pieces of a bent curve join.
    reach = steps[earlier] / 2 + steps[later] / 4
    beyond = ((ends[earlier, 0]) & (outward < -reach)) | ((ends[earlier, 1]) & (outward > reach))
    beside = parallel & ~beyond
    duplicated = mark_in_turn(later[beside], earlier[beside], rank[pieces])
    return float(100.0 * steps[duplicated].sum() / total)


def middle_samples(polylines):
    """The middles of equal steps of at most DUPLICATE_SPACING along each polyline; none for one of no length.

    Returns points (n, 3), unit tangents (n, 3), step lengths (n,), the index of the polyline (n,), and (n, 2) bool:
    whether the sample is the first, the last of its polyline.
    """
    parts = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 2), bool))]
    for index, polyline in enumerate(polylines):
        chords = np.diff(polyline, axis=0)
        lengths = np.linalg.norm(chords, axis=1)
        chords, lengths, starts = chords[lengths > 0], lengths[lengths > 0], polyline[:-1][lengths > 0]
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        count = int(np.ceil(arc[-1] / DUPLICATE_SPACING))
        at = (np.arange(count) + 0.5) * arc[-1] / max(count, 1)
        chord = np.minimum(np.searchsorted(arc, at, side="right") - 1, len(lengths) - 1)
        tangents = chords[chord] / lengths[chord, None]
        points = starts[chord] + (at - arc[chord])[:, None] * tangents
        number = np.arange(count)
        ends = np.stack([number == 0, number == count - 1], axis=1)
        parts.append((points, tangents, np.full(count, arc[-1] / max(count, 1)), np.full(count, index), ends))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def rank_pieces(lengths, sources):
    """(P,) lengths and sources -> (P,) the turn in which each piece is counted: 0 for a piece of the longest edge."""
    _, edge = np.unique(sources, return_inverse=True)
    edge_lengths = np.bincount(edge, weights=lengths)
    order = np.lexsort((np.arange(len(lengths)), edge, -edge_lengths[edge]))
    rank = np.empty(len(lengths), dtype=np.int64)
    rank[order] = np.arange(len(lengths))
    return rank


def neighbours_counted_before(points, pieces, rank):
    """For every sample, the nearest sample of each piece counted before its own, if within DUPLICATE_DISTANCE.

    Returns two (k,) index arrays: the sample, and its neighbour on the earlier piece.
    """
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(DUPLICATE_DISTANCE, output_type="ndarray")
    pairs = pairs[pieces[pairs[:, 0]] != pieces[pairs[:, 1]]]
    swap = rank[pieces[pairs[:, 0]]] < rank[pieces[pairs[:, 1]]]
    later, earlier = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])
    distances = np.linalg.norm(points[later] - points[earlier], axis=1)
    order = np.lexsort((distances, pieces[earlier], later))
    later, earlier = later[order], earlier[order]
    nearest = np.ones(len(order), dtype=bool)
    nearest[1:] = (np.diff(later) != 0) | (np.diff(pieces[earlier]) != 0)
    return later[nearest], earlier[nearest]


def mark_in_turn(later, earlier, turns):
    """(n,) bool: the samples that repeat one which is not a duplicate itself, decided turn by turn.

    later, earlier: (k,) pairs of samples. turns: (n,) the turn of every sample.
    """
    duplicated = np.zeros(len(turns), dtype=bool)
    order = np.argsort(turns[later], kind="stable")
    later, earlier = later[order], earlier[order]
    borders = np.flatnonzero(np.diff(turns[later])) + 1
    for now, before in zip(np.split(later, borders), np.split(earlier, borders), strict=True):
        duplicated[now[~duplicated[before]]] = True
    return duplicated


# ---------------------------------------------------------------------------------------------------- for printing


def metrics_rows(metrics):
    """The dict of `evaluate` as rows (label, value with unit) for printing."""
    true_length = number_text(metrics["true_length_units"])
    rows = [
        ("lines, curves", f"{metrics['lines']}, {metrics['curves']}"),
        ("edges", f"{metrics['edges']} (truth {number_text(metrics['true_edges'], '{:d}')})"),
        ("length", f"{metrics['predicted_length_units']:.2f} units (truth {true_length})"),
        ("length / true length", number_text(metrics["predicted_to_true_length_percent"], "{:.1f} %")),
        (
            "duplicated length",
            f"{metrics['duplicated_length_percent']:.1f} % "
            f"(truth {number_text(metrics['true_duplicated_length_percent'], '{:.1f} %')})",
        ),
        ("accuracy", number_text(metrics["accuracy_mm"], "{:.2f} mm")),
        ("completeness", number_text(metrics["completeness_mm"], "{:.2f} mm")),
    ]
    for threshold in THRESHOLDS_MM:
        for label, key in (("precision", "precision"), ("recall", "recall"), ("F-score", "f_score")):
            rows.append((f"{label} at {threshold} mm", f"{metrics[f'{key}_{threshold}mm_percent']:.1f} %"))
    return rows


def number_text(value, pattern="{:.2f}"):
    """The value in the pattern, or 'unknown' for None."""
    return "unknown" if value is None else pattern.format(value)
