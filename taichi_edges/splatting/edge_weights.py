"""How much each edge pixel counts in the loss: the detector's strength as a weight, not as a lower target.

A weak edge is as white as a sure one, and its Gaussians as opaque; where the two contradict each other, the sure one
wins. Only edge pixels have weights of their own, a few percent of all.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from taichi_edges.views.edgels import Edgels

REACH_PX = 2  # an edge pixel has the strength of the strongest edgel so near, in columns and in rows; lines are 2.4 px


@dataclass(frozen=True)
class EdgeWeights:
    """Weights of the edge pixels of V views, one after the other by view, row and column.

    starts: (V, H) int32, which pixel is the first of a row. values: (n,) uint8, 255 is 1. means: (V,) mean weights,
    1 of a view without edge pixels.
    """

    starts: np.ndarray
    values: np.ndarray
    means: np.ndarray


def weigh_edge_pixels(edge_maps: np.ndarray, level: int, edgels: "Edgels", share: float) -> EdgeWeights:
    """EdgeWeights 1 - share + share * strength; an edge pixel that no edgel is near has strength 0.

    edge_maps: (V, H, W) uint8, edge pixels are those of at least `level`. edgels: Edgels. share: 0..1.
    """
    counts = np.zeros(edge_maps.shape[:2], np.int64)
    values, means = [np.zeros(0, np.uint8)], np.ones(len(edge_maps))
    for view, edge_map in enumerate(edge_maps):
        edges = edge_map >= level
        counts[view] = np.count_nonzero(edges, axis=1)
        strengths = _strength_map(edgels, view, edge_map.shape)[edges].astype(np.float64)
        values.append(np.rint(255.0 * (1.0 - share) + share * strengths).astype(np.uint8))
        if len(strengths):
            means[view] = max(values[-1].mean(), 1.0) / 255.0  # not 0, by which the weights are divided
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).reshape(counts.shape)
    return EdgeWeights(starts.astype(np.int32), np.concatenate(values), means)


def _strength_map(edgels: "Edgels", view: int, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) uint8: the largest strength, 0..255, of the edgels within REACH_PX of a pixel; 0 where there is none."""
    points, _, strengths = edgels.of_view(view)
    columns, rows = np.rint(points).astype(np.int64).T
    inside = (columns >= 0) & (rows >= 0) & (columns < shape[1]) & (rows < shape[0])
    strongest = np.zeros(shape, np.uint8)
    np.maximum.at(strongest, (rows[inside], columns[inside]), np.rint(255 * strengths[inside]).astype(np.uint8))
    return cv2.dilate(strongest, np.ones((2 * REACH_PX + 1,) * 2, np.uint8))
