"""The joints of the true edges, and whether a prediction closes them.

joint     a point where two true edges, or more, end, or where one ends on another.
corner    a joint where some two of the edges meet at more than CORNER_DEGREES; otherwise a tangential joint.
reached   every true edge that ends there has a predicted edge that follows it and ends within REACH.
closed    reached by edges that are joined with each other there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taichi_edges.evaluation.dense_curves import middle_samples
from taichi_edges.evaluation.duplicates import DUPLICATE_COSINE
from taichi_edges.evaluation.edge_graph import EdgeGraph, close_pairs
from taichi_edges.evaluation.primitives import CORNER_DEGREES, JOINED, grouped

REACH = 0.005  # normalised units: EMAP's finest threshold; an edge that ends farther from a corner has missed it
FOLLOWED_SHARE = 0.5  # of the shorter of the two edges; a line that runs past its fillet is parallel to 30 % of it
FOLLOW_SPACING = 0.002  # normalised units between the samples that tell which edge follows which


@dataclass(frozen=True)
class Joint:
    """A point where true edges meet.

    point: (3,). ends: {edge: how many of its ends are here}. passing: tuple of the edges that pass through, on which
    others end. angle: degrees, the greatest one between two of their directions, without regard to their sense.
    """

    point: np.ndarray
    ends: dict[int, int]
    passing: tuple[int, ...]
    angle: float

    @property
    def is_corner(self) -> bool:
        """Do some edges meet at an angle here? Otherwise all touch, or continue each other."""
        return self.angle > CORNER_DEGREES


def find_joints(truth: EdgeGraph) -> list[Joint]:
    """EdgeGraph of the true edges, each of one piece -> list of Joint; an end that meets no other edge is none."""
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


def widest_angle(directions: np.ndarray) -> float:
    """(k, 3) unit directions -> the greatest angle between two of them in degrees, their sense disregarded."""
    return float(np.degrees(np.arccos(np.clip(np.abs(directions @ directions.T).min(), 0.0, 1.0))))


def followers(predicted: EdgeGraph, truth: EdgeGraph) -> np.ndarray:
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
    """The predicted edges that come within reach of a joint and follow one of its true edges.

    edges: (a,) int, ascending. follows: {true edge: (a,) bool}. ends: (e,) int, the predicted ends within reach.
    end_counts: (a,) how many of them each edge has. passes: (a,) bool: it has none, and follows two of the true ends,
    or a true edge that passes. (What follows a single true end and runs on past it serves nothing.)
    """

    edges: np.ndarray
    follows: dict[int, np.ndarray]
    ends: np.ndarray
    end_counts: np.ndarray
    passes: np.ndarray


def judge_joints(
    predicted: EdgeGraph, follows: np.ndarray, joints: Sequence[Joint], reach: float = REACH
) -> np.ndarray:
    """For each joint, whether it is reached and whether it is closed: (J, 2) bool.

    follows: as from `followers`. reach: how near to a joint an edge has to end, normalised units.
    """
    points = np.array([joint.point for joint in joints]).reshape(-1, 3)
    at, pieces, _, _ = predicted.dense.within(points, reach)
    end_distances = np.linalg.norm(predicted.ends.points[None] - points[:, None], axis=2)
    verdicts = np.zeros((len(joints), 2), dtype=bool)
    for number, joint in enumerate(joints):
        near = np.unique(predicted.edges[pieces[at == number]])
        arrivals = arrivals_at(predicted, joint, follows, near, np.flatnonzero(end_distances[number] <= reach))
        groups = joined_groups(predicted, joint, arrivals, reach)
        verdicts[number] = [
            all_served(joint, arrivals, np.arange(len(arrivals.edges))),
            any(all_served(joint, arrivals, group) for group in groups),
        ]
    return verdicts


def arrivals_at(
    predicted: EdgeGraph, joint: Joint, follows: np.ndarray, near: np.ndarray, ends: np.ndarray
) -> Arrivals:
    """The Arrivals at a joint. follows: as from `followers`. near, ends: the edges and the ends within reach of it."""
    edges = near[follows[near][:, [*joint.ends, *joint.passing]].any(axis=1)]
    followed = {true_edge: follows[edges, true_edge] for true_edge in (*joint.ends, *joint.passing)}
    end_counts = np.bincount(predicted.ends.edges[ends], minlength=len(follows))[edges]
    ways = sum(followed[true_edge] * joint.ends.get(true_edge, 2) for true_edge in followed)
    return Arrivals(edges, followed, ends, end_counts, (end_counts == 0) & (ways > 1))


def joined_groups(predicted: EdgeGraph, joint: Joint, arrivals: Arrivals, reach: float) -> list[list[int]]:
    """The edges that are joined at a joint: list of lists of indices into `arrivals.edges`.

    An end joins what it touches. Edges without an end here are joined if they touch each other and both pass.
    """
    place = {int(edge): index for index, edge in enumerate(arrivals.edges)}
    ends, pieces = predicted.contacts
    here = np.isin(ends, arrivals.ends)
    met = zip(predicted.ends.edges[ends[here]].tolist(), predicted.edges[pieces[here]].tolist(), strict=True)
    pairs = [(place[one], place[other]) for one, other in met if one in place and other in place]
    if np.count_nonzero(arrivals.passes) > 1:
        touching = touching_edges(predicted, joint, arrivals.edges, reach)
        pairs += [pair for pair in touching if arrivals.passes[list(pair)].all()]
    return grouped(len(place), pairs)


def touching_edges(predicted: EdgeGraph, joint: Joint, edges: np.ndarray, reach: float) -> list[tuple[int, int]]:
    """List of pairs of indices into `edges`, predicted ones that come within JOINED of each other near the joint."""
    dense = predicted.dense
    vertices = np.array(dense.tree.query_ball_point(joint.point, reach), dtype=np.int64)
    owners = predicted.edges[dense.owners[vertices]]
    at, pieces, _, _ = dense.within(dense.points[vertices], JOINED)
    pairs = np.unique(np.stack([owners[at], predicted.edges[pieces]], axis=1), axis=0)
    pairs = pairs[np.isin(pairs, edges).all(axis=1)]
    return [tuple(pair) for pair in np.searchsorted(edges, pairs).tolist()]


def all_served(joint: Joint, arrivals: Arrivals, chosen: np.ndarray | list[int]) -> bool:
    """Is every true edge of the joint served by the chosen (c,) indices into `arrivals.edges`?

    A true edge that ends here wants ends of edges that follow it, as many as it has; an edge that follows it and passes
    serves them all. A true edge that passes wants an edge that follows it.
    """
    for true_edge, follows in arrivals.follows.items():
        mine = follows[chosen]
        wanted = joint.ends.get(true_edge, 0)
        serving = arrivals.end_counts[chosen] + wanted * arrivals.passes[chosen]
        if not mine.any() or serving[mine].sum() < wanted:
            return False
    return True
