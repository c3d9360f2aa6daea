"""What the edge maps say for and against single 3D points: strength, width, and support that is not shared."""

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from taichi_edges.cameras import NEAR, inside_image

OWNER_ROUNDS = 4  # owners whose own support turns out weak lose their pixels in the next round
CLAIM = 0.8  # a point claims the pixels within this many line widths of its projection
SAME_EDGE = 2.5  # a pixel supports the points within this many line widths (in 3D) of its owner


def edge_strength(views, points):
    """Mean value of the edge maps, 0..1 of full scale, at the projections of (n, 3) unit-cube points.

    Over the views that have the point in front of the camera and inside the image; bilinear; 0 where there is none.
    """
    total = np.zeros(len(points))
    seen = np.zeros(len(points), np.int32)
    for view in range(len(views)):
        pixels, _ = views.project(points, view)
        inside = inside_image(pixels, views.width, views.height)
        rows_first = pixels[inside][:, ::-1].T
        total[inside] += map_coordinates(views.edge_maps[view], rows_first, np.float64, order=1, mode="nearest")
        seen += inside
    return total / np.maximum(seen, 1) / 255.0


def line_width(views, threshold):
    """Typical width of the lines in the edge maps: pixels, and unit-cube units at the middle of the scene box.

    threshold: of full scale. Inside a band of w pixels the distance from a pixel's centre to that of the nearest pixel
    outside is (w + 2) / 4 on average.
    """
    distances, pixels = 0.0, 0
    for edge_map in views.edge_maps:
        edges = (edge_map >= threshold * 255).astype(np.uint8)
        if edges.all():  # no line, and no distance to measure
            continue
        distances += float(cv2.distanceTransform(edges, cv2.DIST_L2, 5).sum())
        pixels += int(edges.sum())
    width = max(4.0 * distances / max(pixels, 1) - 2.0, 1.0)
    return float(width), float(width * pixel_size(views))


def pixel_size(views):
    """Size of a pixel at the middle of the scene box, unit-cube units: median over the views."""
    middle = views.box.mean(axis=0, keepdims=True)
    depths = np.array([views.project(middle, view)[1][0] for view in range(len(views))])
    in_front = np.maximum(depths, NEAR)  # a view that looks away says nothing about the scale
    return float(np.median(in_front / views.intrinsics[:, 0, 0]))


def exclusive_support(views, points, threshold):
    """Share of the views in which a point lies on an edge pixel that no better point elsewhere explains.

    points: (n, 3) unit cube. threshold: of full scale. In every view the strongest point that projects near a pixel
    owns it, and the pixel supports only its owner and what lies beside the owner in 3D: points on the same edge. A
    stray point that merely projects onto the lines of other edges, and a hidden edge behind a visible one, get nothing
    from those views. Strength is the mean map value first, then the support found in the round before.
    Returns (n,) in 0..1, relative to the views that have the point in front of the camera and inside the image.
    """
    width_px, width = line_width(views, threshold)
    strength = edge_strength(views, points)
    support = strength
    for _ in range(OWNER_ROUNDS):
        support = _owned_share(views, points, support + 1e-3 * strength, threshold, CLAIM * width_px, SAME_EDGE * width)
    return support


def _owned_share(views, points, strength, threshold, claim_px, reach):
    """One round of `exclusive_support`."""
    supported = np.zeros(len(points))
    seen = np.zeros(len(points), np.int32)
    weakest_first = np.argsort(strength, kind="stable")
    for view in range(len(views)):
        pixels, _ = views.project(points, view)
        inside = inside_image(pixels, views.width, views.height)
        seen += inside
        here = weakest_first[inside[weakest_first]]
        columns, rows = np.rint(pixels[here]).astype(np.int64).T
        owner = _owners(here, rows, columns, views.height, views.width, claim_px)[rows, columns]
        on_edge = views.edge_maps[view, rows, columns] >= threshold * 255
        beside = np.linalg.norm(points[owner] - points[here], axis=1) <= reach
        supported[here] += on_edge & beside
    return supported / np.maximum(seen, 1)


def _owners(points, rows, columns, height, width, radius):
    """(H, W) index of the last of `points` whose pixel lies within `radius` pixels; later points overwrite earlier."""
    margin = int(np.ceil(radius))
    across = np.arange(-margin, margin + 1)
    down, right = (grid.ravel() for grid in np.meshgrid(across, across, indexing="ij"))
    disc = down**2 + right**2 <= radius**2
    owners = np.full((height + 2 * margin, width + 2 * margin), -1)
    targets = (rows[:, None] + down[disc] + margin, columns[:, None] + right[disc] + margin)
    owners[targets] = points[:, None]  # NumPy assigns in order, so the strongest, which come last, stay
    return owners[margin : margin + height, margin : margin + width]
