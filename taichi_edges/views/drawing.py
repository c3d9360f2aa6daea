"""Edge maps drawn through edgels: lines of one width, centred where the detector means the edge to be."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from taichi_edges.views.edgels import Edgels

DRAWN_SIGMA = 1.0  # px; about what DexiNed draws (FWHM 2.4 px), wide enough to pull a Gaussian from 3 px away
PATCH = 3  # px; half size of the patch in which an edgel is drawn
DRAWN_AT_ONCE = 256  # points; few enough that their patches stay in the cache and in memory that is there already


def draw_edge_maps(edgels: Edgels, height: int, width: int, threads: int | None = None) -> np.ndarray:
    """(V, H, W) uint8 edge maps through the edgels, some views at a time.

    Every line is drawn at full height, or a weak one would teach its Gaussians to be faint, and be narrower from a
    threshold on: how sure an edgel is weighs in the loss instead.
    """

    def draw(view: int) -> np.ndarray:
        points, normals, _ = edgels.of_view(view)
        return draw_lines(points, normals, np.ones(len(points), np.float32), height, width)

    with ThreadPoolExecutor(threads) as pool:  # NumPy releases the lock in the long loops
        return np.stack(list(pool.map(draw, range(edgels.view_count))))


def draw_lines(
    points: np.ndarray, normals: np.ndarray, values: np.ndarray, height: int, width: int, sigma: float = DRAWN_SIGMA
) -> np.ndarray:
    """(H, W) uint8 map of lines through the points: a Gaussian profile of `sigma` pixels across each, `value` high.

    A calibration may have moved points out of the image; those farther out than the patch is wide draw nothing.
    """
    pixels = np.rint(points)
    near = ((pixels >= -PATCH) & (pixels < np.array([width, height]) + PATCH)).all(axis=1)
    points, normals, values = points[near], normals[near], values[near]
    margin = 2 * PATCH  # a patch around the farthest point
    image = np.zeros((height + 2 * margin, width + 2 * margin), np.float32)
    for start in range(0, len(points), DRAWN_AT_ONCE):
        part = slice(start, start + DRAWN_AT_ONCE)
        _draw_patches(image, points[part], normals[part], values[part], sigma)
    image *= 255
    return np.rint(image, out=image)[margin:-margin, margin:-margin].astype(np.uint8)


def _draw_patches(image: np.ndarray, points: np.ndarray, normals: np.ndarray, values: np.ndarray, sigma: float) -> None:
    """Draw some of the points into `image`, which is 2 PATCH pixels larger on every side."""
    centres = np.rint(points)
    patch = np.arange(2 * PATCH + 1)  # offsets from the point, and pixels: (n, 1, 7) right, (n, 7, 1) down
    right = (centres - points)[:, 0, None, None] + (patch - PATCH)
    down = (centres - points)[:, 1, None, None] + (patch - PATCH)[:, None]
    across_squared = (right * normals[:, 0, None, None] + down * normals[:, 1, None, None]) ** 2
    along_squared = right**2 + down**2 - across_squared
    # Each point draws its line no farther than to the next one, or a curve's chords would stand out.
    profiles = np.exp(-0.5 * (across_squared + np.maximum(along_squared - 1.0, 0.0)) / sigma**2)
    heights = (values[:, None, None] * profiles).astype(np.float32)
    columns, rows = centres.astype(np.int64).T[:, :, None, None]
    places = (rows + PATCH + patch[:, None]) * image.shape[1] + columns + PATCH + patch
    np.maximum.at(image.reshape(-1), places.ravel(), heights.ravel())  # fast in one dimension and one type only
