"""From oriented points to the points of every edge: graph traversal, whole lines and arcs, what is left, merging."""

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.fitting.arcs import Arc
from taichi_edges.fitting.model_selection import Yardstick
from taichi_edges.geometry.shapes import Line
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.strokes.arc_growth import Cloud
from taichi_edges.strokes.branches import separate_branches
from taichi_edges.strokes.claiming import claims
from taichi_edges.strokes.cluster_fits import NOISE_FLOOR, ClusterFit, fit_cluster, fit_line, wireframe_of
from taichi_edges.strokes.clustering import grow_clusters, seed_order
from taichi_edges.strokes.clusters import Clusters
from taichi_edges.strokes.cutting import cut_stroke, shape_of_stretch
from taichi_edges.strokes.free_curves import free_curves
from taichi_edges.strokes.merging import merged
from taichi_edges.strokes.neighbors import UNASSIGNED, NeighborGraph, alignment, members_of_clusters, neighbor_graph
from taichi_edges.strokes.noise import MOST_NOISE, measured_scale
from taichi_edges.strokes.segmentation import split_clusters
from taichi_edges.strokes.small_circles import small_circles

if TYPE_CHECKING:
    from taichi_edges.scene.settings import ClusterConfig, FitConfig

HALO = 0.5  # of a point's neighbours: where so many lie on an edge, the point is a stray one of it
MOST_NOISE_PX = 3.0  # an edgel so far off would not have been the edge's


def assemble(points: np.ndarray, directions: np.ndarray, config: "ClusterConfig", pixel: float = np.inf) -> Clusters:
    """The Clusters of oriented points.

    points: (n, 3) unit cube. directions: (n, 3) unit vectors, sign arbitrary. config: the scene's `cluster` section.
    pixel: size of a pixel at the scene, unit-cube units.
    """
    if len(points) < 2:
        return Clusters.of(points, directions, np.full(len(points), UNASSIGNED))
    graph = neighbor_graph(points, config.neighbors, config.max_gap)
    aligned = alignment(directions, graph)
    seeds = seed_order(points, directions, graph, aligned)
    follows = (graph.indices >= 0) & (aligned >= config.theta)
    neighbors = [row[good] for row, good in zip(graph.indices, follows, strict=True)]
    most = min(MOST_NOISE, MOST_NOISE_PX * pixel)
    cloud = Cloud(points, directions, measured_scale(points, directions, neighbors, seeds, config.max_gap, most))
    found, taken = claims(cloud, neighbors, seeds, config.min_points)
    pieces = merged(cloud, found, taken.noise)
    free, replaced = free_curves(cloud, pieces, config)
    pieces = [piece for number, piece in enumerate(pieces) if number not in replaced]
    labels, shared = np.full(len(points), UNASSIGNED), [np.zeros((0, 2), int)]
    for number, piece in enumerate(pieces):
        labels[piece.own] = number
        shared.append(np.stack([piece.shared, np.full(len(piece.shared), number)], axis=1))
    left = left_over(cloud, graph, taken.owner, config)
    labels, traversed = np.where(left >= 0, left + len(pieces), labels), int(left.max()) + 1
    for number, members in enumerate(free, start=len(pieces) + traversed):
        labels[members] = number
    arcs = (*(piece.arc for piece in pieces), *[None] * (traversed + len(free)))
    return without_empty(Clusters(points, directions, labels, np.concatenate(shared), arcs))


def without_empty(clusters: Clusters) -> Clusters:
    """The Clusters without edges that have lost all of their points to a free curve."""
    used = np.zeros(len(clusters.arcs), bool)
    used[clusters.labels[clusters.labels >= 0]] = True
    return clusters.keep(used)


def left_over(cloud: Cloud, graph: NeighborGraph, owner: np.ndarray, config: "ClusterConfig") -> np.ndarray:
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


def assemble_strokes(
    points: np.ndarray, directions: np.ndarray, strokes: np.ndarray, pixels: np.ndarray, yardstick: Yardstick
) -> Clusters:
    """The Clusters of oriented points that are in order along strokes: small circles, and of each stroke its stretches.

    points, directions: (n, 3) unit cube, unit vectors. strokes: (n,) int, rising. pixels: (n,) size of a pixel at each
    point, unit-cube units. yardstick: Yardstick where a pixel has any size. A stroke has the median pixel of its
    points: some of them may be in fewer images than the rest.
    """
    labels = np.full(len(points), UNASSIGNED)
    circles = small_circles(points, directions, strokes, pixels, yardstick)
    for number, (_, members) in enumerate(circles):
        labels[members] = number
    left, count = np.flatnonzero(labels == UNASSIGNED), len(circles)
    for members in np.split(left, np.flatnonzero(np.diff(strokes[left])) + 1) if len(left) else ():
        own = yardstick.at(float(np.median(pixels[members])))
        for stretch in cut_stroke(points[members], own):
            labels[members[stretch]] = count
            count += 1
    arcs = (*(circle for circle, _ in circles), *[None] * (count - len(circles)))
    return Clusters(points, directions, labels, np.zeros((0, 2), np.int64), arcs, yardstick.at(1.0).noise)


def fit_strokes(clusters: Clusters, pixels: np.ndarray) -> tuple[Wireframe, dict[str, int]]:
    """The loose Wireframe of Clusters whose points are in order, and the dict kind -> number of edges.

    pixels: (n,) size of a pixel at each point, unit-cube units; an edge has the median of its points.
    """
    yardstick, fits = Yardstick(clusters.noise_px, 1.0), []
    for members, circle in zip(members_of_clusters(clusters.labels), clusters.arcs, strict=True):
        own = yardstick.at(float(np.median(pixels[members])))
        shape = circle.shape() if circle else shape_of_stretch(clusters.points[np.sort(members)], own)
        kind = "short" if shape is None else "loop" if shape.closed else "line" if shape.kind == "line" else "curve"
        fits.append(ClusterFit(kind, shape))
    return wireframe_of(fits)


def fit_clusters(clusters: Clusters, config: "FitConfig") -> tuple[Wireframe, dict[str, int]]:
    """The loose Wireframe of Clusters, and the dict kind -> number of edges. config: the scene's `fit` section."""
    own = members_of_clusters(clusters.labels)
    also = sharers(clusters.shared, len(clusters.arcs))
    members = [np.concatenate(pair) for pair in zip(own, also, strict=True)]
    pairs = zip(members, clusters.arcs, strict=True)
    return wireframe_of(fit_edge(clusters.points[some], arc, config) for some, arc in pairs)


def sharers(shared: np.ndarray, count: int) -> list[np.ndarray]:
    """The points of each of `count` edges that they share with others: a list of index arrays."""
    order = np.argsort(shared[:, 1], kind="stable")
    bounds = np.searchsorted(shared[order, 1], np.arange(count + 1))
    return [shared[order[start:end], 0] for start, end in pairwise(bounds)]


def fit_edge(points: np.ndarray, arc: Arc | None, config: "FitConfig") -> ClusterFit:
    """The ClusterFit of one edge: its line or arc as it is, if the paper's ratio keeps that, or `fit_cluster`."""
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
