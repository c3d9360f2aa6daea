"""The slow twins of the kernels over points and views, in float64 NumPy and view by view."""

import numpy as np
from scipy.ndimage import map_coordinates

from taichi_edges.evidence.support import CLAIM, OWNER_ROUNDS, SAME_EDGE, line_width
from taichi_edges.views.cameras import inside_image


def edge_strength(views, points):
    """(n,) mean of the bilinear map values, 0..1, and (n,) the number of views that have a point in the image."""
    total, seen = np.zeros(len(points)), np.zeros(len(points), int)
    for view in range(len(views)):
        pixels, _ = views.project(points, view)
        inside = inside_image(pixels, views.width, views.height)
        rows_first = pixels[inside][:, ::-1].T
        total[inside] += map_coordinates(views.edge_maps[view], rows_first, np.float64, order=1, mode="nearest")
        seen += inside
    return total / np.maximum(seen, 1) / 255.0, seen


def exclusive_support(views, points, threshold, strength):
    """The support of points whose strength is known."""
    width_px, width = line_width(views, threshold)
    support = strength
    for _ in range(OWNER_ROUNDS):
        support = owned_share(views, points, support + 1e-3 * strength, threshold, CLAIM * width_px, SAME_EDGE * width)
    return support


def owned_share(views, points, strength, threshold, claim_px, reach):
    """One round: in every view each point paints a disc, the strongest last, and sees whose disc is at its pixel."""
    supported, seen = np.zeros(len(points)), np.zeros(len(points), int)
    rows, columns = np.indices((views.height, views.width))
    for view in range(len(views)):
        pixels, _ = views.project(points, view)
        inside = inside_image(pixels, views.width, views.height)
        seen += inside
        nearest = np.rint(np.where(inside[:, None], pixels, 0)).astype(int)
        owner = np.full((views.height, views.width), -1)
        for i in np.argsort(strength, kind="stable"):
            if inside[i]:
                owner[(rows - nearest[i, 1]) ** 2 + (columns - nearest[i, 0]) ** 2 <= claim_px**2] = i
        for i in np.flatnonzero(inside):
            column, row = nearest[i]
            on_edge = views.edge_maps[view, row, column] >= threshold * 255
            supported[i] += on_edge and np.linalg.norm(points[owner[row, column]] - points[i]) <= reach
    return supported / np.maximum(seen, 1)


def between_pixels(pixels, margin=1e-3):
    """(n,) bool: which pixels (n, 2) are so near to the border between two that float32 may round them otherwise."""
    return (np.abs(pixels - np.floor(pixels) - 0.5) < margin).any(axis=1)
