"""Seeds where many views agree that an edge passes: multi-view voting on distance transforms, coarse to fine."""

from dataclasses import dataclass

import cv2
import numpy as np
import taichi as ti
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from taichi_edges.support import exclusive_support, pixel_size

STEPS_PER_PIXEL = 4  # distances are kept in quarter pixels, one byte each
HALF_DIAGONAL = np.sqrt(3) / 2  # of a unit cell
FINEST_PX = 1.5  # cell size of the last level, pixels at the median depth
LEVELS = 3  # each halves the cell
KEEP = 0.2  # share of the views that must see an edge in a cell; hidden and faint edges are seen by few
CHANCE_POINTS, CHANCE_QUANTILE = 20_000, 0.97  # a seed scores higher than this share of random points in the box
SUPPRESS_PX = 3.3  # a seed is the best, or nearly, within this many pixels at the median depth
NEARLY = 0.8
LEAST_SUPPORT = 0.05  # share of the views whose edge pixels are a seed's own (see `exclusive_support`)


@dataclass(frozen=True)
class Seeds:
    """points: (n, 3) unit cube. directions: (n, 3) unit vectors along the local line of seeds.

    pixel: size of a pixel at the scene, unit-cube units.
    """

    points: np.ndarray
    directions: np.ndarray
    pixel: float


def distance_maps(edge_maps, threshold):
    """(V, H, W) uint8: distance to the nearest edge pixel in quarter pixels, at most 255."""
    level = threshold * 255
    maps = [cv2.distanceTransform((m < level).astype(np.uint8), cv2.DIST_L2, 5) for m in edge_maps]
    return np.stack([(np.minimum(m, 255 / STEPS_PER_PIXEL) * STEPS_PER_PIXEL).astype(np.uint8) for m in maps])


@ti.kernel
def count_votes(
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),
    projections: ti.types.ndarray(dtype=ti.f32, ndim=3),
    distances: ti.types.ndarray(dtype=ti.u8, ndim=3),
    radius: ti.f32,
    needed: ti.f32,
    votes: ti.types.ndarray(dtype=ti.f32, ndim=1),
    scores: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    """Share of the views with an edge within `radius` (pixels at depth 1) of a point, and the mean of exp(-d^2 / 2).

    Points that can no longer reach `needed` are given up.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        near, score, view = 0, 0.0, 0
        count = projections.shape[0]
        while view < count:
            u = (
                projections[view, 0, 0] * x
                + projections[view, 0, 1] * y
                + projections[view, 0, 2] * z
                + projections[view, 0, 3]
            )
            v = (
                projections[view, 1, 0] * x
                + projections[view, 1, 1] * y
                + projections[view, 1, 2] * z
                + projections[view, 1, 3]
            )
            w = (
                projections[view, 2, 0] * x
                + projections[view, 2, 1] * y
                + projections[view, 2, 2] * z
                + projections[view, 2, 3]
            )
            if w > 0.05:
                column = ti.cast(ti.floor(u / w + 0.5), ti.i32)
                row = ti.cast(ti.floor(v / w + 0.5), ti.i32)
                if column >= 0 and column < distances.shape[2] and row >= 0 and row < distances.shape[1]:
                    distance = ti.cast(distances[view, row, column], ti.f32) / STEPS_PER_PIXEL
                    if distance <= radius / w:
                        near += 1
                    score += ti.exp(-0.5 * distance * distance)
            view += 1
            if near + count - view < needed * count:
                view = count
        votes[i] = near / ti.cast(count, ti.f32)
        scores[i] = score / ti.cast(count, ti.f32)


def vote_seeds(views, threshold, generator):
    """Seeds of the whole scene box. ti.init must have been called. generator: jitters the finest cells."""
    distances = distance_maps(views.edge_maps, threshold)
    device = ti.ndarray(ti.u8, shape=distances.shape)
    device.from_numpy(distances)
    projections = (views.intrinsics @ views.world_to_camera).astype(np.float32)
    focal = float(np.median(views.intrinsics[:, 0, 0]))
    pixel = pixel_size(views)
    cell = pixel * FINEST_PX * 2 ** (LEVELS - 1)

    def votes_of(points, radius, needed):
        votes, scores = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
        if len(points):
            count_votes(np.ascontiguousarray(points, np.float32), projections, device, radius, needed, votes, scores)
        return votes, scores

    axes = [np.arange(low + cell / 2, high + cell / 2, cell) for low, high in zip(*views.box, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 4
    for level in range(LEVELS):
        votes, _ = votes_of(points, focal * cell * HALF_DIAGONAL, KEEP)
        points = points[votes >= KEEP]
        if level < LEVELS - 1:
            points = (points[:, None] + corners * cell).reshape(-1, 3)
            cell /= 2
    points = points + (generator.random(points.shape) - 0.5) * cell
    _, scores = votes_of(points, focal * cell, 0.0)
    anywhere = views.box[0] + generator.random((CHANCE_POINTS, 3)) * (views.box[1] - views.box[0])
    chance = np.quantile(votes_of(anywhere, 1.0, 0.0)[1], CHANCE_QUANTILE)
    points, scores = points[scores > chance], scores[scores > chance]
    best = nearly_best(points, scores, SUPPRESS_PX * pixel)
    points = points[best]
    own = exclusive_support(views, points, threshold) >= LEAST_SUPPORT
    points = points[own]
    return Seeds(points, line_directions(points, 8 * pixel), pixel)


def nearly_best(points, scores, radius):
    """(n,) bool: those with at least NEARLY the best score within about `radius` (3^3 cells of half the radius)."""
    if len(points) == 0:
        return np.zeros(0, bool)
    cells = np.floor(points / (radius / 2)).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    best = np.zeros(cells.max(axis=0) + 2, np.float32)
    np.maximum.at(best, tuple(cells.T), scores)
    return scores >= NEARLY * maximum_filter(best, size=3)[tuple(cells.T)]


def line_directions(points, radius):
    """(n, 3) unit vectors: the first principal axis of each point's neighbours within `radius`."""
    directions = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    for i, near in enumerate(cKDTree(points).query_ball_point(points, radius)):
        if len(near) >= 3:
            offsets = points[near] - points[near].mean(axis=0)
            directions[i] = np.linalg.eigh(offsets.T @ offsets)[1][:, 2]
    return directions
