"""What the edge maps say for and against single 3D points: the width of the lines, and support that is not shared.

Support is computed by Taichi (imported where it is used): ti.init must have been called.
"""

import weakref

import cv2
import numpy as np

from taichi_edges.views.views import Views, pixel_size

OWNER_ROUNDS = 4  # owners whose own support turns out weak lose their pixels in the next round
CLAIM = 0.8  # a point claims the pixels within this many line widths of its projection
SAME_EDGE = 2.5  # a pixel supports the points within this many line widths (in 3D) of its owner
WIDTH_VIEWS = 64  # the width of the lines is measured in so many views at most

# (id of Views, threshold): line width in pixels; an entry goes with its Views.
known_widths: dict[tuple[int, float], float] = {}


def line_width(views: Views, threshold: float) -> tuple[float, float]:
    """Typical width of the lines in the edge maps: pixels, and unit-cube units at the middle of the scene box.

    threshold: of full scale. Measured once for each Views.
    """
    key = (id(views), threshold)
    if key not in known_widths:
        known_widths[key] = _measure_width(views.edge_maps[:: -(-len(views) // WIDTH_VIEWS)], threshold)
        weakref.finalize(views, known_widths.pop, key, None)
    return known_widths[key], known_widths[key] * pixel_size(views)


def _measure_width(edge_maps: np.ndarray, threshold: float) -> float:
    """Pixels. Inside a band of w pixels the distance from a pixel's centre to that of the nearest pixel outside is
    (w + 2) / 4 on average.
    """
    distances, pixels = 0.0, 0
    for edge_map in edge_maps:
        edges = (edge_map >= threshold * 255).astype(np.uint8)
        if edges.all():  # no line, and no distance to measure
            continue
        distances += float(cv2.distanceTransform(edges, cv2.DIST_L2, 5).sum())
        pixels += int(edges.sum())
    return max(4.0 * distances / max(pixels, 1) - 2.0, 1.0)


def exclusive_support(views: Views, points: np.ndarray, threshold: float) -> np.ndarray:
    """Share of the views in which a point lies on an edge pixel that no better point elsewhere explains.

    points: (n, 3) unit cube. threshold: of full scale. In every view the strongest point that projects near a pixel
    owns it, and the pixel supports only its owner and what lies beside the owner in 3D: points on the same edge. A
    stray point that merely projects onto the lines of other edges, and a hidden edge behind a visible one, get nothing
    from those views. Strength is the mean map value first, then the support found in the round before.
    Returns (n,) in 0..1, relative to the views that have the point in front of the camera and inside the image.
    """
    from taichi_edges.evidence.pixel_owners import PixelOwners

    support = np.zeros(len(points))
    points, finite = _finite(points)
    if len(points):
        width_px, width = line_width(views, threshold)
        evidence = PixelOwners(views, points, threshold)
        owned = evidence.strength
        for _ in range(OWNER_ROUNDS):
            owned = evidence.owned_share(owned + 1e-3 * evidence.strength, CLAIM * width_px, SAME_EDGE * width)
        support[finite] = owned
    return support


def _finite(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of the (n, 3) points that are finite numbers, as float32, and which they are, (n,) bool."""
    with np.errstate(over="ignore"):
        points = np.asarray(points, np.float32)
    finite = np.isfinite(points).all(axis=1)
    return points[finite], finite
