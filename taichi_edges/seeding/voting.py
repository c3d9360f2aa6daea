"""Seeds where many views agree that an edge passes: multi-view voting on distance transforms, coarse to fine."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_edges.evidence.support import exclusive_support
from taichi_edges.kernels import device
from taichi_edges.kernels.points import (
    F32_1D,
    F32_2D,
    F32_3D,
    I32_1D,
    I32_2D,
    U8_3D,
    blocks_of,
    load_camera,
    load_point,
    nearest_pixel,
)
from taichi_edges.views.cameras import DRAWN_FROM
from taichi_edges.views.views import Views, pixel_size

STEPS_PER_PIXEL, FARTHEST = 4, 255  # distances are kept in quarter pixels, one byte each
HALF_DIAGONAL = np.sqrt(3) / 2  # of a unit cell
FINEST_PX = 1.5  # cell size of the last level, pixels at the median depth
LEVELS = 3  # each halves the cell; more where the first would have more than MOST_FIRST cells
MOST_FIRST, MOST_CELLS = 2_000_000, 1 << 24  # cells of the first level; of any: a level with more is not entered
KEEP = 0.2  # share of the views that must see an edge in a cell; hidden and faint edges are seen by few
CHANCE_POINTS, CHANCE_QUANTILE = 20_000, 0.97  # a seed scores higher than this share of random points in the box
SUPPRESS_PX = 3.3  # a seed is the best, or nearly, within this many pixels at the median depth
NEARLY = 0.8
ALONG_PX, NEIGHBOURHOODS = 8, 2048  # radius that tells a seed's direction; how many are looked at together
LEAST_SUPPORT = 0.05  # share of the views whose edge pixels are a seed's own (see `exclusive_support`)
BATCH_BYTES = 512 << 20  # distance maps that are kept at the same time
CHUNK = 1 << 21  # points that are scored at the same time
EIGHTHS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int32)  # of a cell of size 2
AROUND = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)])
HALF_AROUND = AROUND[14:]  # of each two opposite neighbours the one that comes later

Batch = tuple[slice, np.ndarray | ti.Ndarray]  # some views, and their distance maps on the device


@dataclass(frozen=True)
class Seeds:
    """points: (n, 3) unit cube. directions: (n, 3) unit vectors along the local line of seeds.

    pixel: size of a pixel at the scene, unit-cube units.
    """

    points: np.ndarray
    directions: np.ndarray
    pixel: float


def distance_maps(edge_maps: np.ndarray, threshold: float, threads: int = 1) -> np.ndarray:
    """(V, H, W) uint8: distance to the nearest edge pixel in quarter pixels, rounded down, at most 255."""
    maps, level = np.empty_like(edge_maps), int(np.ceil(threshold * 255))

    def measure(view: int) -> None:
        # OpenCV's stubs know no comparison with a number.
        off_edges = cv2.compare(edge_maps[view], level, cv2.CMP_LT)  # type: ignore[call-overload]
        distances = cv2.distanceTransform(off_edges, cv2.DIST_L2, 5)
        np.minimum(distances, FARTHEST / STEPS_PER_PIXEL, out=distances)  # without edges they are beyond all integers
        cv2.convertScaleAbs(distances, maps[view], STEPS_PER_PIXEL, -0.4999)  # which rounds to the nearest

    with ThreadPoolExecutor(threads) as pool:  # OpenCV lets go of the interpreter
        list(pool.map(measure, range(len(maps))))
    return maps


class DistanceBatches:
    """Iterates over (slice of the views, their distance maps on the device), the views a batch at a time.

    The maps are made anew in every pass, except where one batch holds all views.
    """

    def __init__(self, edge_maps: np.ndarray, threshold: float) -> None:
        self.edge_maps, self.threshold = edge_maps, threshold
        self.size = max(BATCH_BYTES // edge_maps[0].size, 1)
        self.kept: list[Batch] = []

    def __iter__(self) -> Iterator[Batch]:
        yield from self.kept or self._make()

    def _make(self) -> Iterator[Batch]:
        for first in range(0, len(self.edge_maps), self.size):
            batch = slice(first, min(first + self.size, len(self.edge_maps)))
            made = batch, device.upload(distance_maps(self.edge_maps[batch], self.threshold, device.threads()))
            if self.size >= len(self.edge_maps):
                self.kept = [made]
            yield made


@ti.func
def distance_at(distances: ti.template(), view, h):
    """The distance map's value where the projection h falls, -1 outside the image and too near to the camera."""
    found = -1
    if h[2] > DRAWN_FROM:
        row, column = nearest_pixel(h)
        if row >= 0 and row < distances.shape[1] and column >= 0 and column < distances.shape[2]:
            found = ti.cast(distances[view, row, column], ti.i32)
    return found


@ti.kernel
def count_near(
    size: ti.i32,
    blocks: ti.i32,
    view: ti.i32,
    cells: I32_2D,
    split: ti.i32,
    projections: F32_3D,
    distances: U8_3D,
    radius: ti.f32,
    later: ti.i32,
    needed: ti.i32,
    near: I32_1D,
):
    """Adds 1 to `near` where one view of a batch has an edge within `radius` of a cell, in steps at depth 1.

    cells: (n, 3) integer coordinates, which `projections` take. split: 0, or 1 where 8 cells in turn are the eighths of
    one in `cells`. later: views after this one. Cells with `needed` views, or past getting them, are left alone.
    """
    for block in range(blocks):
        camera = load_camera(projections, view)
        for i in range(block * size, ti.min((block + 1) * size, near.shape[0])):
            if near[i] < needed and near[i] + later + 1 >= needed:
                parent = i >> (3 * split)
                cell = ti.Vector([(cells[parent, axis] << split) + (i >> (2 - axis) & split) for axis in range(3)])
                h = camera @ ti.Vector([cell[0], cell[1], cell[2], 1.0])
                distance = distance_at(distances, view, h)
                if distance >= 0 and distance * h[2] <= radius:
                    near[i] = near[i] + 1  # += would be atomic


@ti.kernel
def add_scores(
    size: ti.i32,
    blocks: ti.i32,
    view: ti.i32,
    points: F32_2D,
    projections: F32_3D,
    distances: U8_3D,
    falloff: F32_1D,
    scores: F32_1D,
):
    """Adds the `falloff` at the distances where the points (n, 3) project to in one view of a batch."""
    for block in range(blocks):
        camera = load_camera(projections, view)
        for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
            distance = distance_at(distances, view, camera @ load_point(points, i))
            if distance >= 0:
                scores[i] = scores[i] + falloff[distance]


def vote_seeds(
    views: Views, threshold: float, generator: np.random.Generator, most: int | None = None, keep: float = KEEP
) -> Seeds:
    """Seeds of the whole scene box, at most so many, drawn at random. ti.init must have been called.

    threshold: of full scale. generator: jitters the finest cells, and draws. keep: share of the views that must see an
    edge in a cell.
    """
    pixel = pixel_size(views)
    distances = DistanceBatches(views.edge_maps, threshold)
    cells, size = vote_cells(views, distances, pixel, keep)
    points, scores = score_cells(views, distances, cells, size, generator)
    points = points[nearly_best(points, scores, SUPPRESS_PX * pixel)]
    points = points[exclusive_support(views, points, threshold) >= LEAST_SUPPORT]
    chosen = points
    if most is not None and len(points) > most:
        chosen = points[np.sort(generator.choice(len(points), most, replace=False))]
    return Seeds(chosen, line_directions(chosen, points, ALONG_PX * pixel), pixel)


def vote_cells(views: Views, distances: DistanceBatches, pixel: float, keep: float = KEEP) -> tuple[np.ndarray, float]:
    """The finest cells in which enough views see an edge, and their size, unit-cube units.

    Cells are (n, 3) int32, counted from the first corner of the box. pixel: size of a pixel, unit-cube units.
    """
    extent = views.box[1] - views.box[0]
    levels = LEVELS
    while np.prod(np.ceil(extent / (pixel * FINEST_PX * 2 ** (levels - 1)))) > MOST_FIRST:
        levels += 1
    size = pixel * FINEST_PX * 2 ** (levels - 1)
    cells = np.indices(np.ceil(extent / size).astype(int), np.int32).reshape(3, -1).T
    cells = cells[np.flatnonzero(see_edges(views, distances, cells, 0, size, keep))]
    for _ in range(levels - 1):
        if 8 * len(cells) > MOST_CELLS:
            break
        size /= 2
        kept = np.flatnonzero(see_edges(views, distances, cells, 1, size, keep))
        cells = 2 * cells[kept >> 3] + EIGHTHS[kept & 7]
    return cells, size


def see_edges(
    views: Views, distances: DistanceBatches, cells: np.ndarray, split: int, size: float, keep: float = KEEP
) -> np.ndarray:
    """(n,) bool, or (8 n,) where they are `split` in eighths: whether enough views see an edge in a cell.

    That is, within the projected radius of its circumscribed sphere. cells: (n, 3). size: of one after the split.
    """
    near = np.zeros(len(cells) << (3 * split), np.int32)
    if len(cells) == 0:
        return near > 0
    near, cells = device.upload(near), device.upload(cells)
    needed = int(np.ceil(keep * len(views) - 1e-9))
    radius = STEPS_PER_PIXEL * float(np.median(views.intrinsics[:, 0, 0])) * size * HALF_DIAGONAL
    centres = np.vstack([np.column_stack([size * np.eye(3), views.box[0] + size / 2]), [0, 0, 0, 1]])  # of the cells
    projections = (views.intrinsics @ views.world_to_camera @ centres).astype(np.float32)
    for batch, maps in distances:
        cameras = device.upload(projections[batch])
        for view in range(batch.stop - batch.start):
            later = len(views) - 1 - batch.start - view
            count_near(*blocks_of(near), view, cells, split, cameras, maps, radius, later, needed, near)
    return device.download(near) >= needed


def score_cells(
    views: Views, distances: DistanceBatches, cells: np.ndarray, size: float, generator: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """One random point in each cell, where it scores better than chance: (n, 3) points and (n,) scores."""
    low, high = views.box
    random = low + generator.random((CHANCE_POINTS, 3)) * (high - low)
    chance = np.quantile(mean_scores(views, distances, random), CHANCE_QUANTILE)
    found = [(np.zeros((0, 3)), np.zeros(0, np.float32))]
    for first in range(0, len(cells), CHUNK):
        points = cells[first : first + CHUNK]
        points = low + (points + generator.random(points.shape)) * size
        scores = mean_scores(views, distances, points)
        found.append((points[scores > chance], scores[scores > chance]))
    return tuple(np.concatenate(arrays) for arrays in zip(*found, strict=True))


def mean_scores(views: Views, distances: DistanceBatches, points: np.ndarray) -> np.ndarray:
    """(n,) float32: mean over the views of exp(-d^2 / 2), d pixels from a point's projection to the nearest edge."""
    scores = device.upload(np.zeros(len(points), np.float32))
    points = device.upload(points.astype(np.float32))
    falloff = device.upload(np.exp(-0.5 * (np.arange(FARTHEST + 1) / STEPS_PER_PIXEL) ** 2).astype(np.float32))
    projections = (views.intrinsics @ views.world_to_camera).astype(np.float32)
    for batch, maps in distances:
        cameras = device.upload(projections[batch])
        for view in range(batch.stop - batch.start):
            add_scores(*blocks_of(points), view, points, cameras, maps, falloff, scores)
    return device.download(scores) / np.float32(len(views))


def nearly_best(points: np.ndarray, scores: np.ndarray, radius: float) -> np.ndarray:
    """(n,) bool: those with at least NEARLY the best score within about `radius` (3^3 cells of half the radius)."""
    if len(points) == 0:
        return np.zeros(0, bool)
    cells = np.floor(points / (radius / 2)).astype(np.int64)
    cells -= cells.min(axis=0)
    rows, columns = cells[:, 1].max() + 2, cells[:, 2].max() + 2  # with a gap, lest neighbours wrap round
    strides = np.array([rows * columns, columns, 1])
    occupied, cell = np.unique(cells @ strides, return_inverse=True)
    best = np.zeros(len(occupied), scores.dtype)
    np.maximum.at(best, cell, scores)
    around = best.copy()
    for step in HALF_AROUND @ strides:
        place = np.minimum(np.searchsorted(occupied, occupied + step), len(occupied) - 1)
        one = np.flatnonzero(occupied[place] == occupied + step)
        other = place[one]
        around[one] = np.maximum(around[one], best[other])
        around[other] = np.maximum(around[other], best[one])
    return scores >= NEARLY * around[cell]


def line_directions(points: np.ndarray, others: np.ndarray, radius: float) -> np.ndarray:
    """(n, 3) unit vectors: the first principal axis of those of the `others` that lie within `radius` of each point."""
    tree = cKDTree(others)
    directions = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    rows, columns = np.triu_indices(3)
    for first in range(0, len(points), NEIGHBOURHOODS):
        some = points[first : first + NEIGHBOURHOODS]
        pairs = cKDTree(some).sparse_distance_matrix(tree, radius, output_type="ndarray")
        of, offsets = pairs["i"], others[pairs["j"]] - some[pairs["i"]]
        counts = np.bincount(of, minlength=len(some))
        mean_over = partial(_mean_by, of, np.maximum(counts, 1))
        means, products = mean_over(offsets), mean_over(offsets[:, rows] * offsets[:, columns])
        covariances = np.empty((len(some), 3, 3))
        spreads = products - means[:, rows] * means[:, columns]
        covariances[:, rows, columns] = covariances[:, columns, rows] = spreads
        axes = np.linalg.eigh(covariances)[1][:, :, 2]
        directions[first : first + NEIGHBOURHOODS][counts >= 3] = axes[counts >= 3]
    return directions


def _mean_by(group: np.ndarray, counts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(g, m) means of the rows of `values` (n, m) by their `group` (n,), of which `counts` (g,) rows each belong to."""
    return np.stack([np.bincount(group, column, len(counts)) for column in values.T], axis=1) / counts[:, None]
