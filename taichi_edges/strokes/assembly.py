"""From oriented points to the points of every edge: graph traversal, whole lines and arcs, what is left, merging."""

from dataclasses import dataclass

import numpy as np

from taichi_edges.fitting.arcs import Arc
from taichi_edges.geometry.shapes import Line
from taichi_edges.strokes.arc_growth import Cloud
from taichi_edges.strokes.branches import separate_branches
from taichi_edges.strokes.claiming import claims
from taichi_edges.strokes.cluster_fits import NOISE_FLOOR, ClusterFit, fit_cluster, fit_line, wireframe_of
from taichi_edges.strokes.clustering import grow_clusters, seed_order
from taichi_edges.strokes.free_curves import free_curves
from taichi_edges.strokes.merging import merged
from taichi_edges.strokes.neighbors import UNASSIGNED, alignment, members_of_clusters, neighbor_graph
from taichi_edges.strokes.noise import MOST_NOISE, measured_scale
from taichi_edges.strokes.segmentation import split_clusters

HALO = 0.5  # of a point's neighbours: where so many lie on an edge, the point is a stray one of it
MOST_NOISE_PX = 3.0  # an edgel so far off would not have been the edge's
ARC_NUMBERS = 12  # origin, tangent, bend; low, high, closed


@dataclass(frozen=True)
class Assembly:
    """The points of every edge.

    labels: (n,) the edge each point belongs to, UNASSIGNED for none. shared: (k, 2) point, and an edge it lies on as
    well. arcs: (m, ARC_NUMBERS) what is known of each edge already, see `pack_arc`; NaN for a free curve.
    """

    labels: np.ndarray
    shared: np.ndarray
    arcs: np.ndarray

    def keep(self, chosen):
        """Only the chosen edges, renumbered. chosen: (m,) bool."""
        numbers = np.append(np.where(chosen, np.cumsum(chosen) - 1, UNASSIGNED), UNASSIGNED)
        shared = self.shared[chosen[self.shared[:, 1]]]
        shared = np.stack([shared[:, 0], numbers[shared[:, 1]]], axis=1)
        return Assembly(numbers[self.labels], shared, self.arcs[chosen])


def assemble(points, directions, config, pixel=np.inf):
    """The Assembly of oriented points.

    points: (n, 3) unit cube. directions: (n, 3) unit vectors, sign arbitrary. config: the scene's `cluster` section.
    pixel: size of a pixel at the scene, unit-cube units.
    """
    if len(points) < 2:
        return Assembly(np.full(len(points), UNASSIGNED), np.zeros((0, 2), int), np.zeros((0, ARC_NUMBERS)))
    graph = neighbor_graph(points, config.neighbors, config.max_gap)
    aligned = alignment(directions, graph)
    seeds = seed_order(points, directions, graph, aligned)
    follows = (graph.indices >= 0) & (aligned >= config.theta)
    neighbors = [row[good] for row, good in zip(graph.indices, follows, strict=True)]
    most = min(MOST_NOISE, MOST_NOISE_PX * pixel)
    cloud = Cloud(points, directions, measured_scale(points, directions, neighbors, seeds, config.max_gap, most))
    found, ledger = claims(cloud, neighbors, seeds, config.min_points)
    pieces = merged(cloud, found, ledger.noise)
    free, replaced = free_curves(cloud, pieces, config)
    pieces = [piece for number, piece in enumerate(pieces) if number not in replaced]
    labels, shared = np.full(len(points), UNASSIGNED), [np.zeros((0, 2), int)]
    for number, piece in enumerate(pieces):
        labels[piece.own] = number
        shared.append(np.stack([piece.shared, np.full(len(piece.shared), number)], axis=1))
    arcs = np.array([pack_arc(piece.arc) for piece in pieces]).reshape(-1, ARC_NUMBERS)
    left = left_over(cloud, graph, ledger.owner, config)
    labels = np.where(left >= 0, left + len(pieces), labels)
    for number, members in enumerate(free, start=len(pieces) + left.max() + 1):
        labels[members] = number
    unknown = np.full((left.max() + 1 + len(free), ARC_NUMBERS), np.nan)
    return without_empty(Assembly(labels, np.concatenate(shared), np.concatenate([arcs, unknown])))


def without_empty(assembly):
    """The Assembly without edges that have lost all of their points to a free curve."""
    used = np.zeros(len(assembly.arcs), bool)
    used[assembly.labels[assembly.labels >= 0]] = True
    return assembly.keep(used)


def left_over(cloud, graph, owner, config):
    """(n,) labels of the clusters that graph traversal finds in what no line or arc has claimed.

    What has mostly claimed points around it is their halo, and no edge of its own. graph: NeighborGraph of the points.
    """
    labels, present = np.full(len(owner), UNASSIGNED), graph.indices >= 0
    claimed = (present & (owner[graph.indices] >= 0)).sum(axis=1)
    left = np.flatnonzero((owner < 0) & (claimed < HALO * present.sum(axis=1)))
    if len(left) < config.min_points:
        return labels
    points, directions = cloud.points[left], cloud.directions[left]
    found = separate_branches(points, grow_clusters(points, directions, config), config.min_points)
    labels[left] = split_clusters(points, found, config.min_points)
    return labels


def pack_arc(arc):
    """(ARC_NUMBERS,) of an Arc: origin, tangent, bend, low, high, closed; NaN for None."""
    if arc is None:
        return np.full(ARC_NUMBERS, np.nan)
    return np.concatenate([arc.origin, arc.tangent, arc.bend, [arc.low, arc.high, arc.closed]])


def unpack_arc(numbers):
    """The Arc of (ARC_NUMBERS,) numbers, or None."""
    if np.isnan(numbers).any():
        return None
    return Arc(numbers[:3], numbers[3:6], numbers[6:9], float(numbers[9]), float(numbers[10]), bool(numbers[11]))


def fit_assembly(points, labels, shared, arcs, config):
    """The loose Wireframe of an Assembly, and the dict kind -> number of edges.

    points: (n, 3) unit cube; the others as in Assembly. config: the scene's `fit` section.
    """
    own = members_of_clusters(labels)
    also = sharers(shared, len(arcs))
    members = [np.concatenate(pair) for pair in zip(own, also, strict=True)]
    fits = (fit_edge(points[some], unpack_arc(arc), config) for some, arc in zip(members, arcs, strict=True))
    return wireframe_of(fits)


def sharers(shared, count):
    """The points of each of `count` edges that they share with others: a list of index arrays."""
    order = np.argsort(shared[:, 1], kind="stable")
    bounds = np.searchsorted(shared[order, 1], np.arange(count + 1))
    return [shared[order[start:end], 0] for start, end in zip(bounds[:-1], bounds[1:], strict=True)]


def fit_edge(points, arc, config):
    """The Fit of one edge: its line or arc as it is, if the paper's ratio of errors keeps the arc, or `fit_cluster`."""
    if arc is None:
        return fit_cluster(points, config)
    if arc.length < config.min_length:
        return ClusterFit("short")
    if arc.curvature > 0:
        error = np.linalg.norm(arc.coordinates(points)[1], axis=1).mean()
        if max(error, NOISE_FLOOR) <= config.delta * fit_line(points, config.line_tolerance)[1]:
            return ClusterFit("loop" if arc.closed else "curve", arc.shape())
        return ClusterFit("line", Line(fit_line(points, config.line_tolerance)[0]))
    return ClusterFit("line", arc.shape())
