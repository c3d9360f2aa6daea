"""What lies on the two sides of edgels: the background of a view, and where colour images have the same edges.

The background comes from the colour image's alpha channel where there is one. Else it is what can be flooded from the
border of the edge map without crossing a line; photographs of a scene without a border of its own have none.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.arrays.columns import Columns
from taichi_edges.calibration.offsets import Observations
from taichi_edges.detectors.ridges import gaussian_derivatives
from taichi_edges.views.edgels import Edgels

FAINT = 0.15  # of full scale; where an edge map is brighter, the flood does not pass
CLOSED_GAP = 4.0  # px; half the width of the gaps in an outline through which the flood does not leak
ALONG_STEP = 0.5  # px between samples of a profile across an edgel
# Samples across an edgel, px outward: an exact outline lies between BEYOND on either side of the edgel, and what it
# bounds is at least as thick. For flooded backgrounds they begin where the flood has stopped.
BEYOND, SIDE = 3.0, 2.5
FLOOD_WIDTHS, FLOOD_MARGIN = 0.85, 1.5  # line widths, and px: where a flooded background begins beside a ridge
CLEAR = 0.9  # of the samples on each side, from which on an edgel is surely on a silhouette
DEPTH_FULL, DEPTH_NONE = 1.5, 3.0  # px off the usual distance to the background: surely a silhouette, surely none
INTERIOR = 8.0  # px; edgels without background that near, beyond the line's own width, are inside
STEP_REACH = 4.0  # px to each side in which an image's edge is looked for
STEP_SIGMA = 1.0  # px; smoothing of the image before its gradient is taken
LEAST_STEP = 1.5  # grey levels per px: weaker gradients are noise
MOST_OBSERVATIONS = 150_000  # more, evenly spread over the views, would tell no more
ALONE = 0.5  # other gradients across the edgel are lower than this share of the highest


@dataclass(frozen=True)
class Sides(Columns):
    """What lies beside n edgels.

    outward:    (n, 2) unit vectors across the edge towards the background; just normals where there is none.
    contrast:   (n,) 0..1: how surely background is on the outward side and none on the other.
    depths:     (n,) px from the edgel outward to where the background begins; NaN where `contrast` is 0.
    interior:   (n,) bool: no background anywhere near.
    steps:      (n,) px along `outward` from the edgel to the edge in the colour image; NaN where it shows none.
    from_alpha: (n,) bool: the background of the view is that of an image's alpha channel.
    """

    outward: np.ndarray
    contrast: np.ndarray
    depths: np.ndarray
    interior: np.ndarray
    steps: np.ndarray
    from_alpha: np.ndarray

    def silhouettes(self, shift: ArrayLike = (0.0, 0.0)) -> np.ndarray:
        """(n,) 0..1: how surely each edgel, of maps shifted by so many px, is on a silhouette.

        That is where the background begins as far from it as it usually does; an edge farther inside is another one.
        """
        depths = self.depths + self.outward @ np.asarray(shift)
        weights = self.contrast.copy()
        for alpha in (False, True):
            some = (self.from_alpha == alpha) & (self.contrast > 0)
            if some.any():
                off = np.abs(depths[some] - np.median(depths[some]))
                weights[some] *= smooth_step((DEPTH_NONE - off) / (DEPTH_NONE - DEPTH_FULL))
        return weights

    def correct(self, edgels: Edgels, values: np.ndarray) -> tuple[Edgels, np.ndarray]:
        """The n edgels without the biases (3,) px: outward offset of silhouettes, shift; and (n,) `silhouettes`."""
        weights = self.silhouettes(values[1:])
        return edgels.moved(-values[1:] - values[0] * weights[:, None] * self.outward), weights

    def observations(self, views: np.ndarray, shift: ArrayLike = (0.0, 0.0)) -> Observations:
        """Observations of the edgels of maps shifted by so many px against the images. views: (n,) int.

        Silhouettes are held against the outline in the alpha channel only: an image without one may show the object
        as dilated as the detector saw it.
        """
        outlines = self.from_alpha & (self.silhouettes(shift) >= CLEAR)
        places = np.where(outlines, self.depths, self.steps)
        chosen = np.flatnonzero((outlines | self.interior) & np.isfinite(places))
        chosen = chosen[:: len(chosen) // MOST_OBSERVATIONS + 1]
        flags = outlines[chosen].astype(np.float64)
        return Observations(-places[chosen], self.outward[chosen], flags, chosen, views[chosen])


def smooth_step(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, and smooth in between."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def look_beside(
    edge_map: np.ndarray, image_path: Path | str, points: np.ndarray, normals: np.ndarray, width_px: float
) -> Sides:
    """Sides of the edgels (n, 2), (n, 2) of one view, whose lines are about `width_px` wide."""
    grey, alpha = read_picture(image_path, edge_map.shape)
    if alpha is not None:
        background, first = 1.0 - alpha, BEYOND
    else:
        background, first = flooded(edge_map), FLOOD_WIDTHS * width_px + FLOOD_MARGIN
    reach = first + SIDE
    along = np.arange(-reach, reach + ALONG_STEP / 2, ALONG_STEP)
    profiles = sample(background, points, normals, along)
    turned = profiles[:, along > 0].sum(axis=1) < profiles[:, along < 0].sum(axis=1)
    outward = np.where(turned[:, None], -normals, normals)
    profiles = np.where(turned[:, None], profiles[:, ::-1], profiles)
    outside, inside = profiles[:, along >= first].mean(axis=1), profiles[:, along <= -first].mean(axis=1)
    contrast = smooth_step((outside - 0.5) / (CLEAR - 0.5)) * smooth_step((0.5 - inside) / (CLEAR - 0.5))
    depths = np.where(contrast > 0, reach + ALONG_STEP * (0.5 - profiles.sum(axis=1)), np.nan)
    away = cv2.distanceTransform((background < 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    interior = sample(away, points, normals, np.zeros(1))[:, 0] > first + INTERIOR
    steps = np.full(len(points), np.nan) if grey is None else image_steps(grey, points, outward)
    return Sides(outward, contrast, depths, interior, steps, np.full(len(points), alpha is not None))


def read_picture(path: Path | str, shape: tuple[int, ...]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Grey values (H, W) float32, composited over white, and alpha (H, W) float32 in 0..1; None for what there is not.

    An image of another size than the edge map says nothing about its pixels.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path else None
    if image is not None and image.dtype == np.uint16:
        image = (image // 257).astype(np.uint8)
    if image is None or image.shape[:2] != shape or image.dtype != np.uint8:
        return None, None
    if image.ndim == 2:
        return image.astype(np.float32), None
    alpha = image[:, :, 3].astype(np.float32) / 255.0 if image.shape[2] == 4 else None
    grey = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY).astype(np.float32)
    if alpha is None or alpha.min() >= 0.5:  # opaque: a photograph
        return grey, None
    return alpha * grey + 255.0 * (1.0 - alpha), alpha


def flooded(edge_map: np.ndarray) -> np.ndarray:
    """(H, W) float32: 1 where the background is, flooded from the border of an edge map, else 0."""
    dark = (edge_map < 255 * FAINT).astype(np.uint8)
    open_ = (cv2.distanceTransform(np.pad(dark, 1, constant_values=1), cv2.DIST_L2, 5) > CLOSED_GAP).astype(np.uint8)
    labels = cv2.connectedComponents(open_, connectivity=4)[1]
    border = np.zeros(labels.max() + 1, bool)
    border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    border[0] = False
    core = border[labels][1:-1, 1:-1]
    near = cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 5) <= CLOSED_GAP + 0.5
    return (near & (dark > 0)).astype(np.float32)


def sample(image: np.ndarray, points: np.ndarray, directions: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(n, k) bilinear values of an (H, W) image at points (n, 2) + along (k,) * directions (n, 2), pixels (u, v).

    Outside the image its border goes on.
    """
    height, width = image.shape
    u = np.clip(points[:, :1] + directions[:, :1] * along, 0, width - 1)
    v = np.clip(points[:, 1:] + directions[:, 1:] * along, 0, height - 1)
    left, top = np.minimum(u.astype(np.int64), width - 2), np.minimum(v.astype(np.int64), height - 2)
    right, down, corner, flat = u - left, v - top, top * width + left, image.reshape(-1)
    upper = flat[corner] * (1 - right) + flat[corner + 1] * right
    lower = flat[corner + width] * (1 - right) + flat[corner + width + 1] * right
    return upper * (1 - down) + lower * down


def image_steps(grey: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n,) px along `directions` from each point to the one strong step of an image's brightness across it, or NaN."""
    along = np.arange(-STEP_REACH - 1, STEP_REACH + 1.25, ALONG_STEP)
    slopes, derivatives = 0.0, gaussian_derivatives(grey, STEP_SIGMA)
    for axis in (0, 1):
        slopes = slopes + sample(next(derivatives), points, directions, along) * directions[:, axis, None]
    slopes, width = np.abs(slopes), round(1 / ALONG_STEP)  # samples in a pixel
    middle = np.clip(slopes.argmax(axis=1), width, len(along) - 1 - width)
    rows = np.arange(len(points))
    before, peak, after = (slopes[rows, middle + step] for step in (-width, 0, width))
    with np.errstate(divide="ignore", invalid="ignore"):
        top = 0.5 * (before - after) / (before - 2 * peak + after)
    far = np.abs(along - along[middle][:, None]) > 2.5 * STEP_SIGMA
    alone = np.where(far, slopes, 0).max(axis=1) < ALONE * peak
    good = alone & (np.abs(along[middle]) <= STEP_REACH) & (peak >= LEAST_STEP) & (np.abs(top) <= ALONG_STEP)
    return np.where(good, along[middle] + top, np.nan)
