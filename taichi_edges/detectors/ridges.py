"""Centre lines of a detector's edge maps, at sub-pixel accuracy (Steger, "An unbiased detector of curvilinear
structures", PAMI 1998).

A learned detector answers with bands of 2 to 10 pixels. Trained on a band, Gaussians settle anywhere in it, and a line
is defined only up to its width. Its ridge is where the detector means the edge to be.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from taichi_edges.views.edgels import Edgels

SIGMA_PER_WIDTH = 0.29  # 1 / (2 sqrt 3): the smallest scale at which a bar of that width has one ridge (Steger, eq. 17)
MIN_SIGMA = 0.65  # px; below, the derivative of the Gaussian is not sampled well
# Rounds, views, and edgels in each of them, across which the width of single lines is measured.
WIDTH_ROUNDS, WIDTH_VIEWS, WIDTH_EDGELS = 3, 8, 500
PROFILE_STEP = 0.25  # px between samples of a profile across a line
MIN_CURVATURE = 0.1  # of that of a line as narrow as the scale; on a flank rounding alone leaves a faint curvature
HALF_PIXEL = 0.6  # px; a ridge half-way between two pixels is 0.5 from either or, by the curvature's error, some more
HALF_DIAGONAL = 0.72  # px; of a pixel, or a rounding more
MIN_PIXELS = 6  # a ridge of fewer is no line


def _reach(sigma: float) -> int:
    """Pixels from which a derivative takes its value, to each side."""
    return int(np.ceil(4 * sigma))


def gaussian_derivatives(image: np.ndarray, sigma: float) -> Iterator[np.ndarray]:
    """First and second derivatives of an (H, W) float32 image smoothed by `sigma` pixels: gx, gy, gxx, gxy, gyy.

    They come one after the other, so that whoever wants them at a few pixels does not hold five images.
    """
    x = np.arange(-_reach(sigma), _reach(sigma) + 1, dtype=np.float64)
    smooth = np.exp(-0.5 * (x / sigma) ** 2)
    smooth /= smooth.sum()
    # Correlation kernels; normalised so that they differentiate x and x^2 / 2 exactly.
    first = x * smooth
    first /= (first * x).sum()
    second = (x**2 / sigma**2 - 1) * smooth
    second -= second.mean()
    second /= (second * x**2 / 2).sum()
    pairs = ((first, smooth), (smooth, first), (second, smooth), (first, first), (smooth, second))
    for along, down in pairs:
        yield cv2.sepFilter2D(image, cv2.CV_32F, along, down, borderType=cv2.BORDER_REPLICATE)


def ridge_points(edge_map: np.ndarray, sigma: float, threshold: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sub-pixel points on the ridges of an edge map.

    edge_map: (H, W) uint8. sigma: smoothing scale, pixels. threshold: 0..1; the map's value a ridge needs.
    Returns points (n, 2) as (u, v), pixel centres at integers; unit normals (n, 2) across the line; values (n,) 0..1.
    """
    top, left, edge_map = _window(edge_map, threshold, _reach(sigma))
    image = edge_map.astype(np.float32)
    image /= 255.0
    bright = image >= threshold
    rows, columns = np.nonzero(bright)  # a few percent of the pixels: what follows is computed for them alone
    gx, gy, gxx, gxy, gyy = (derivative[rows, columns] for derivative in gaussian_derivatives(image, sigma))
    values = image[rows, columns]
    # Across the line: the eigenvector of the Hessian with the most negative eigenvalue.
    angle = 0.5 * np.arctan2(2 * gxy, gxx - gyy)  # of the largest eigenvalue
    nx, ny = -np.sin(angle), np.cos(angle)
    curvature = gxx * nx * nx + 2 * gxy * nx * ny + gyy * ny * ny
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(gx * nx + gy * ny) / curvature
    du, dv = offset * nx, offset * ny
    sharp = curvature < -MIN_CURVATURE * values / sigma**2
    bright[rows, columns] = sharp & _is_nearest(bright.shape, sharp, rows, columns, du, dv)
    on_ridge = _without_specks(bright, rows, columns)
    points = np.stack([left + columns + du, top + rows + dv], axis=1)[on_ridge]
    return points, np.stack([nx, ny], axis=1)[on_ridge], values[on_ridge]


def _is_nearest(
    shape: tuple[int, ...], sharp: np.ndarray, rows: np.ndarray, columns: np.ndarray, du: np.ndarray, dv: np.ndarray
) -> np.ndarray:
    """(n,) bool: which pixels are the nearest to their ridge, (du, dv) px away; of two half-way, one at least."""
    farthest = np.maximum(np.abs(du), np.abs(dv))
    inside = farthest <= 0.5
    claimed = np.zeros(shape, bool)
    claimed[rows, columns] = sharp & inside
    almost = np.flatnonzero(sharp & ~inside & (farthest <= HALF_PIXEL) & (np.hypot(du, dv) <= HALF_DIAGONAL))
    beyond_row = rows[almost] + np.where(np.abs(dv[almost]) > 0.5, np.sign(dv[almost]), 0).astype(int)
    beyond_column = columns[almost] + np.where(np.abs(du[almost]) > 0.5, np.sign(du[almost]), 0).astype(int)
    beyond = np.clip(beyond_row, 0, shape[0] - 1), np.clip(beyond_column, 0, shape[1] - 1)
    inside[almost] = ~claimed[beyond]
    return inside


def _window(edge_map: np.ndarray, threshold: float, margin: int) -> tuple[int, int, np.ndarray]:
    """Top row, left column and pixels of the part of a map that holds all its bright pixels, `margin` around them."""
    bright = edge_map >= np.count_nonzero(np.arange(256, dtype=np.float32) / 255.0 < threshold)
    spans = []
    for axis, size in ((1, edge_map.shape[0]), (0, edge_map.shape[1])):
        found = np.flatnonzero(bright.any(axis=axis))
        spans.append((max(found[0] - margin, 0), min(found[-1] + margin + 1, size)) if len(found) else (0, 1))
    (top, bottom), (left, right) = spans
    return top, left, edge_map[top:bottom, left:right]


def _without_specks(mask: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(n,) bool: which of the pixels, some of a (H, W) bool mask, are of a connected piece of at least MIN_PIXELS."""
    labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)[1][rows, columns]
    return (labels > 0) & (np.bincount(labels) >= MIN_PIXELS)[labels]


def trace_ridges(edge_maps: np.ndarray, width_px: float, threshold: float, threads: int | None = None) -> Edgels:
    """Edgels on the ridges of edge maps, some of them at a time; strengths are the maps' values there.

    edge_maps: (V, H, W) uint8 with lines about `width_px` wide. threshold: 0..1; ridges with lower values are dropped.
    """
    for _ in range(WIDTH_ROUNDS):  # smoothed less, ridges are drawn less to each other, and flanks seem less far
        width_px = min(width_px, single_width(edge_maps[:: -(-len(edge_maps) // WIDTH_VIEWS)], width_px, threshold))
    sigma = _sigma(width_px)
    with ThreadPoolExecutor(threads) as pool:  # OpenCV and NumPy release the lock in the long loops
        return Edgels.of_views(pool.map(lambda edge_map: ridge_points(edge_map, sigma, threshold), edge_maps))


def _sigma(width_px: float) -> float:
    return max(MIN_SIGMA, SIGMA_PER_WIDTH * width_px)


def single_width(edge_maps: Iterable[np.ndarray], width_px: float, threshold: float) -> float:
    """Typical full width at half maximum, px, of single lines in maps whose lines are about `width_px` wide.

    Lines beside each other, as those of thin bars, blend into bands; smoothed as if one line were that wide, they would
    become one ridge, or two that are drawn towards each other. But a line keeps its flank on the side where it is free.
    """
    halves = []
    for edge_map in edge_maps:
        points, normals, _ = ridge_points(edge_map, _sigma(width_px), threshold)
        chosen = np.linspace(0, len(points) - 1, min(len(points), WIDTH_EDGELS)).astype(np.int64)
        sides = [_half_width(edge_map, points[chosen], sign * normals[chosen], 2 * width_px) for sign in (1, -1)]
        halves.append(np.minimum(*sides))
    return 2.0 * float(np.median(np.concatenate([*halves, [width_px / 2]])))


def _half_width(edge_map: np.ndarray, points: np.ndarray, directions: np.ndarray, reach: float) -> np.ndarray:
    """(n,) px from points (n, 2) on ridges along unit `directions` to half of the map's value; `reach` if beyond."""
    if not len(points):
        return np.zeros(0)
    along = np.arange(0, reach + PROFILE_STEP, PROFILE_STEP)
    places = (points[:, None] + along[:, None] * directions[:, None]).astype(np.float32)
    # OpenCV's types do not know that one map of both coordinates needs no second.
    profiles = cv2.remap(edge_map, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    profiles = profiles.astype(np.float64)
    below = profiles < profiles[:, :1] / 2
    first, rows = below.argmax(axis=1), np.arange(len(points))
    before, after, half = profiles[rows, first - 1], profiles[rows, first], profiles[:, 0] / 2
    crossing = along[first] - PROFILE_STEP * (half - after) / np.maximum(before - after, 1e-9)
    return np.where(below.any(axis=1), crossing, reach)
