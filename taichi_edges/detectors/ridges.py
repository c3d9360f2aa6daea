"""Centre lines of a detector's edge maps, at sub-pixel accuracy (Steger, "An unbiased detector of curvilinear
structures", PAMI 1998), redrawn at one width.

A learned detector answers with bands of 2 to 10 pixels. Trained on a band, Gaussians settle anywhere in it, and a line
is defined only up to its width. Its ridge is where the detector means the edge to be.
"""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

SIGMA_PER_WIDTH = 0.29  # 1 / (2 sqrt 3): the smallest scale at which a bar of that width has one ridge (Steger, eq. 17)
MIN_SIGMA = 0.8  # px; below, the derivative of the Gaussian is not sampled well
DRAWN_SIGMA = 1.0  # px; about what DexiNed draws (FWHM 2.4 px), wide enough to pull a Gaussian from 3 px away
MIN_CURVATURE = 0.1  # of that of a line as narrow as the scale; on a flank rounding alone leaves a faint curvature
MIN_PIXELS = 6  # a ridge of fewer is no line
PATCH = 3  # px; half size of the patch in which a ridge point is drawn


def gaussian_derivatives(image, sigma):
    """First and second derivatives (gx, gy, gxx, gxy, gyy) of an (H, W) float32 image smoothed by `sigma` pixels."""
    reach = int(np.ceil(4 * sigma))
    x = np.arange(-reach, reach + 1, dtype=np.float64)
    smooth = np.exp(-0.5 * (x / sigma) ** 2)
    smooth /= smooth.sum()
    # Correlation kernels; normalised so that they differentiate x and x^2 / 2 exactly.
    first = x * smooth
    first /= (first * x).sum()
    second = (x**2 / sigma**2 - 1) * smooth
    second -= second.mean()
    second /= (second * x**2 / 2).sum()
    pairs = ((first, smooth), (smooth, first), (second, smooth), (first, first), (smooth, second))
    return [cv2.sepFilter2D(image, cv2.CV_32F, along, down, borderType=cv2.BORDER_REPLICATE) for along, down in pairs]


def ridge_points(edge_map, sigma, threshold):
    """Sub-pixel points on the ridges of an edge map.

    edge_map: (H, W) uint8. sigma: smoothing scale, pixels. threshold: 0..1; the map's value a ridge needs.
    Returns points (n, 2) as (u, v), pixel centres at integers; unit normals (n, 2) across the line; values (n,) 0..1.
    """
    image = edge_map.astype(np.float32) / 255.0
    gx, gy, gxx, gxy, gyy = gaussian_derivatives(image, sigma)
    # Across the line: the eigenvector of the Hessian with the most negative eigenvalue.
    angle = 0.5 * np.arctan2(2 * gxy, gxx - gyy)  # of the largest eigenvalue
    nx, ny = -np.sin(angle), np.cos(angle)
    curvature = gxx * nx * nx + 2 * gxy * nx * ny + gyy * ny * ny
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(gx * nx + gy * ny) / curvature
    du, dv = offset * nx, offset * ny
    sharp = curvature < -MIN_CURVATURE * image / sigma**2
    on_ridge = sharp & (np.abs(du) <= 0.5) & (np.abs(dv) <= 0.5) & (image >= threshold)
    on_ridge = _without_specks(on_ridge)
    rows, columns = np.nonzero(on_ridge)
    points = np.stack([columns + du[on_ridge], rows + dv[on_ridge]], axis=1)
    normals = np.stack([nx[on_ridge], ny[on_ridge]], axis=1)
    return points, normals, image[on_ridge]


def _without_specks(mask):
    """The (H, W) bool mask without connected pieces of fewer than MIN_PIXELS: ends of bands, noise."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return mask & (stats[labels, cv2.CC_STAT_AREA] >= MIN_PIXELS)


def draw_ridges(points, normals, values, height, width, sigma=DRAWN_SIGMA):
    """(H, W) uint8 map of lines through the points: a Gaussian profile of `sigma` pixels across each, `value` high."""
    offsets = np.stack(np.meshgrid(*[np.arange(-PATCH, PATCH + 1)] * 2), axis=-1).reshape(-1, 2)
    centres = np.rint(points).astype(np.int64)
    pixels = centres[:, None] + offsets
    away = pixels - points[:, None]
    across = np.einsum("npc,nc->np", away, normals)
    along_squared = (away**2).sum(axis=2) - across**2
    # Each point draws its line no farther than to the next one, or a curve's chords would stand out.
    heights = values[:, None] * np.exp(-0.5 * (across**2 + np.maximum(along_squared - 1.0, 0.0)) / sigma**2)
    image = np.zeros((height + 2 * PATCH, width + 2 * PATCH), np.float32)
    np.maximum.at(image, (pixels[..., 1] + PATCH, pixels[..., 0] + PATCH), heights)
    return np.rint(image[PATCH:-PATCH, PATCH:-PATCH] * 255).astype(np.uint8)


def thin_edge_maps(edge_maps, width_px, threshold):
    """Edge maps reduced to their ridges and redrawn at one width.

    edge_maps: (V, H, W) uint8 with lines about `width_px` wide. threshold: 0..1; ridges with lower values are dropped,
    the others are drawn from half to full height, so that all of them are edge pixels and the sure ones stand out.
    """
    sigma = max(MIN_SIGMA, SIGMA_PER_WIDTH * width_px)
    height, width = edge_maps.shape[1:]

    def thin(edge_map):
        points, normals, values = ridge_points(edge_map, sigma, threshold)
        return draw_ridges(points, normals, 0.5 + 0.5 * values, height, width)

    with ThreadPoolExecutor() as pool:  # OpenCV and NumPy release the lock in the long loops
        return np.stack(list(pool.map(thin, edge_maps)))
