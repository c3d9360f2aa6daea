"""What a wireframe must have beyond points in the right places: corners that are closed, no loose ends, exact curves.

Points of a true edge are no measure of these: three edges that stop 4 mm before their corner recall all of it at 5 mm.

Terms, for truth and prediction alike (docs/metrics.md has them with pictures in words):
edge      one source of an EdgeSet, or one primitive of the truth; its pieces are polylines.
end       an end of a piece, unless another piece of the same edge, or the piece itself, goes on from there smoothly.
joined    two ends, or an end and a point along another piece, that are at most JOINED apart.
joint     a point where two true edges, or more, end, or where one ends on another.
corner    a joint where some two of the edges meet at more than CORNER_DEGREES; otherwise a tangential joint.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taichi_edges.evaluation.dense_curves import dense_curves, middle_samples
from taichi_edges.evaluation.duplicates import DUPLICATE_COSINE
from taichi_edges.evaluation.primitives import CORNER_DEGREES, JOINED, grouped

REACH = 0.005  # normalised units: EMAP's finest threshold; an edge that ends farther from a corner has missed it
NEAR_CORNER = 0.010  # normalised units: twice REACH; an end this close to a corner was meant for it, or ran past it
FOLLOWED_SHARE = 0.5  # of the shorter of the two edges; a line that runs past its fillet is parallel to 30 % of it
FOLLOW_SPACING = 0.002  # normalised units between the samples that tell which edge follows which
EXACT_SPACING = 0.001  # normalised units between the samples that exact distances are taken from
UNIT_MM = 1000.0  # "mm" in one normalised unit


@dataclass(frozen=True)
class Wireframe:
    """Edges as a graph sees them.

    polylines: list of (m, 3) pieces. edges: (P,) int, the edge of each piece, numbered from 0.
    """

    polylines: list
    edges: np.ndarray

    @cached_property
    def dense(self):
        """DenseCurves of the pieces."""
        return dense_curves(self.polylines)

    @cached_property
    def lengths(self):
        """(E,) the length of each edge."""
        sizes = [np.linalg.norm(np.diff(polyline, axis=0), axis=1).sum() for polyline in self.polylines]
        return np.bincount(self.edges, weights=sizes)

    @cached_property
    def ends(self):
        """The Ends of all edges."""
        return edge_ends(self.polylines, self.edges)

    @cached_property
    def contacts(self):
        """Two (k,) arrays, an end and a piece that it is joined with: another's interior, or any other end."""
        return contacts_of(self)


@dataclass(frozen=True)
class Ends:
    """points: (k, 3). outward: (k, 3) unit direction into the edge. pieces, edges: (k,) whose end it is."""

    points: np.ndarray
    outward: np.ndarray
    pieces: np.ndarray
    edges: np.ndarray


def wireframe(polylines, sources):
    """Pieces (m, 3) and the (P,) source of each -> Wireframe; pieces of no length are left out."""
    sizes = np.array([np.ptp(polyline, axis=0).max() for polyline in polylines])
    kept = np.flatnonzero(sizes > 0)
    _, edges = np.unique(np.asarray(sources, dtype=np.int64)[kept], return_inverse=True)
    return Wireframe([polylines[index] for index in kept], edges)


def edge_ends(polylines, edges):
    """The Ends of the pieces at which the edge does not go on."""
    if not polylines:
        return Ends(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    pieces = np.repeat(np.arange(len(polylines)), 2)
    points = np.array([point for polyline in polylines for point in (polyline[0], polyline[-1])])
    outward = np.array([direction_from(p) for polyline in polylines for p in (polyline, polyline[::-1])])
    one, other = close_pairs(points).T
    angle_cosine = -(outward[one] * outward[other]).sum(axis=1)
    goes_on = (edges[pieces[one]] == edges[pieces[other]]) & (angle_cosine >= np.cos(np.radians(CORNER_DEGREES)))
    kept = np.ones(len(points), dtype=bool)
    kept[np.concatenate([one[goes_on], other[goes_on]])] = False
    return Ends(points[kept], outward[kept], pieces[kept], edges[pieces[kept]])


def direction_from(polyline):
    """(m, 3) polyline -> unit direction of its first chord that has a length."""
    chords = np.diff(polyline, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    first = int(np.argmax(lengths > 0))
    return chords[first] / lengths[first]


def close_pairs(points):
    """(k, 2) pairs of the points that are at most JOINED apart, in ascending order."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.zeros((0, 2), np.int64)
    pairs = cKDTree(points).query_pairs(JOINED, output_type="ndarray")
    return pairs[np.lexsort(pairs.T[::-1])]


def contacts_of(frame):
    """The `contacts` of a Wireframe. An end is always near its own piece: only the piece's other end counts there."""
    ends = frame.ends
    at, pieces, _, _ = frame.dense.within(ends.points, JOINED)
    foreign = pieces != ends.pieces[at]
    one, other = close_pairs(ends.points).T
    return (
        np.concatenate([at[foreign], one, other]),
        np.concatenate([pieces[foreign], ends.pieces[other], ends.pieces[one]]),
    )


# ---------------------------------------------------------------------------------------------------------- joints


@dataclass(frozen=True)
class Joint:
    """A point where true edges meet.

    point: (3,). ends: {edge: how many of its ends are here}. passing: tuple of the edges that pass through, on which
    others end. angle: degrees, the greatest one between two of their directions, without regard to their sense.
    """

    point: np.ndarray
    ends: dict
    passing: tuple
    angle: float

    @property
    def is_corner(self):
        """Do some edges meet at an angle here? Otherwise all touch, or continue each other."""
        return self.angle > CORNER_DEGREES


def find_joints(truth):
    """Wireframe of the true edges, each of one piece -> list of Joint; an end that meets no other edge is none."""
    ends = truth.ends
    joints = []
    for group in grouped(len(ends.points), close_pairs(ends.points).tolist()):
        point = ends.points[group].mean(axis=0)
        _, passing, vertices, _ = truth.dense.within(point[None], JOINED)
        through = ~np.isin(passing, ends.edges[group])
        counts = {int(edge): int(np.count_nonzero(ends.edges[group] == edge)) for edge in ends.edges[group]}
        directions = np.concatenate([ends.outward[group], truth.dense.tangents[vertices[through]]])
        if len(directions) > 1:
            angle = widest_angle(directions)
            joints.append(Joint(point, counts, tuple(int(edge) for edge in passing[through]), angle))
    return joints


def widest_angle(directions):
    """(k, 3) unit directions -> the greatest angle between two of them in degrees, their sense disregarded."""
    return float(np.degrees(np.arccos(np.clip(np.abs(directions @ directions.T).min(), 0.0, 1.0))))


def followers(predicted, truth):
    """(predicted edges, true edges) bool: does the one follow the other?

    A sample of a predicted edge belongs to the nearest true edge within REACH that is parallel to it there. An edge
    follows another if the samples that belong to it are FOLLOWED_SHARE of the length of the shorter one, or more. So
    one predicted edge can follow many true ones, but a line that runs on into the fillet does not follow the fillet.
    """
    points, tangents, steps, pieces, _ = middle_samples(predicted.polylines, FOLLOW_SPACING)
    at, true_pieces, vertices, distances = truth.dense.within(points, REACH)
    parallel = np.abs((tangents[at] * truth.dense.tangents[vertices]).sum(axis=1)) >= DUPLICATE_COSINE
    at, true_pieces, distances = at[parallel], true_pieces[parallel], distances[parallel]
    order = np.lexsort((true_pieces, distances, at))
    at, true_pieces = at[order], true_pieces[order]
    nearest = np.concatenate([[True], np.diff(at) != 0])[: len(at)]
    at, true_edges = at[nearest], truth.edges[true_pieces[nearest]]
    shared = np.zeros((len(predicted.lengths), len(truth.lengths)))
    np.add.at(shared, (predicted.edges[pieces[at]], true_edges), steps[at])
    return shared >= FOLLOWED_SHARE * np.minimum(predicted.lengths[:, None], truth.lengths[None])


@dataclass(frozen=True)
class Arrivals:
    """What of a prediction comes within REACH of a joint.

    ends: (k,) indices of the predicted ends. edges: (a,) ascending, the predicted edges that follow one of the joint's.
    """

    ends: np.ndarray
    edges: np.ndarray


def judge_joints(predicted, truth, joints):
    """For each joint, whether it is reached and whether it is closed: (J, 2) bool."""
    points = np.array([joint.point for joint in joints]).reshape(-1, 3)
    follows = followers(predicted, truth)
    at, pieces, _, _ = predicted.dense.within(points, REACH)
    end_distances = np.linalg.norm(predicted.ends.points[None] - points[:, None], axis=2)
    verdicts = np.zeros((len(joints), 2), dtype=bool)
    for number, joint in enumerate(joints):
        true_edges = [*joint.ends, *joint.passing]
        near = np.unique(predicted.edges[pieces[at == number]])
        arrived = near[follows[near][:, true_edges].any(axis=1)]
        arrivals = Arrivals(np.flatnonzero(end_distances[number] <= REACH), arrived)
        groups = joined_groups(predicted, arrivals)
        verdicts[number] = [
            all_served(predicted, follows, joint, arrivals, arrivals.edges),
            any(all_served(predicted, follows, joint, arrivals, group) for group in groups),
        ]
    return verdicts


def joined_groups(predicted, arrivals):
    """The edges that arrive at a joint, in groups that are joined there: list of (g,) indices of edges."""
    place = {int(edge): index for index, edge in enumerate(arrivals.edges)}
    ends, pieces = predicted.contacts
    here = np.isin(ends, arrivals.ends)
    pairs = [
        (place[int(one)], place[int(other)])
        for one, other in zip(predicted.ends.edges[ends[here]], predicted.edges[pieces[here]], strict=True)
        if int(one) in place and int(other) in place
    ]
    return [arrivals.edges[group] for group in grouped(len(place), pairs)]


def all_served(predicted, follows, joint, arrivals, edges):
    """Is every true edge of the joint served by one of the predicted edges (g,)?

    A true edge that ends here wants an end of an edge that follows it, as many ends as it has; an edge that follows two
    of the ends, and passes, serves them as well. One that passes through wants an edge that follows it.
    """
    end_counts = np.bincount(predicted.ends.edges[arrivals.ends], minlength=len(follows))
    wanted = {**joint.ends, **dict.fromkeys(joint.passing, 1)}
    followed = sum(count * follows[edges, true_edge] for true_edge, count in wanted.items())
    passes = (end_counts[edges] == 0) & (followed > 1)
    for true_edge, count in wanted.items():
        mine = follows[edges, true_edge]
        serving = mine.sum() if true_edge in joint.passing else (end_counts[edges] + count * passes)[mine].sum()
        if serving < count:
            return False
    return True


def joint_metrics(predicted, truth):
    """Numbers of corners and tangential joints, and the shares of them that the prediction reaches and closes."""
    joints = find_joints(truth)
    verdicts = judge_joints(predicted, truth, joints)
    corner = np.array([joint.is_corner for joint in joints], dtype=bool)
    metrics = {}
    for name, chosen in (("corners", verdicts[corner]), ("tangential_joints", verdicts[~corner])):
        reached, closed = (int(count) for count in chosen.sum(axis=0))
        metrics[name] = len(chosen)
        metrics[f"{name}_closed"] = closed
        metrics[f"{name}_closed_percent"] = 100.0 * closed / len(chosen) if len(chosen) else None
        metrics[f"{name}_reached_percent"] = 100.0 * reached / len(chosen) if len(chosen) else None
    return metrics | true_end_metrics(predicted, truth, joints, corner)


# ------------------------------------------------------------------------------------------------------- free ends


def free_ends(frame):
    """(f, 3) the ends of edges that nothing is joined with."""
    joined = np.zeros(len(frame.ends.points), dtype=bool)
    joined[frame.contacts[0]] = True
    return frame.ends.points[~joined]


def true_end_metrics(predicted, truth, joints, corner):
    """Which of the free ends of the prediction lie at a true corner, and which where no true edge ends at all."""
    loose = free_ends(predicted)
    places = np.array([joint.point for joint in joints]).reshape(-1, 3)
    true_ends = np.concatenate([truth.ends.points, places])
    return {
        "free_ends_at_corners": int(np.count_nonzero(nearest(loose, places[corner]) <= NEAR_CORNER)),
        "false_free_ends": int(np.count_nonzero(nearest(loose, true_ends) > NEAR_CORNER)),
        "true_free_ends": len(free_ends(truth)),
    }


def nearest(points, others):
    """(n,) distances from each of the points to the nearest of the others; infinite where there is none."""
    apart = np.linalg.norm(points[:, None] - others[None], axis=2)
    return apart.min(axis=1, initial=np.inf)


# ------------------------------------------------------------------------------------------------- exact distances


def exact_metrics(predicted, truth):
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


def curve_distances(one, other):
    """(n,) distances from samples along the one Wireframe to the nearest points of the other."""
    points = middle_samples(one.polylines, EXACT_SPACING)[0]
    return other.dense.distances(points)


def share_within_percent(distances):
    """Percent of the distances that are at most REACH, 5 mm; 0 of none."""
    return 100.0 * float(np.mean(distances <= REACH)) if len(distances) else 0.0


# --------------------------------------------------------------------------------------------------------- in all


def wireframe_metrics(predicted, truth):
    """All the metrics of a predicted Wireframe. truth: that of the primitives, or None where only samples are known."""
    known = truth if truth is not None else wireframe([], [])
    metrics = joint_metrics(predicted, known) | exact_metrics(predicted, known)
    if truth is None:
        metrics = dict.fromkeys(metrics)
    return {"free_ends": len(free_ends(predicted)), **metrics}
