"""Which edgels of a view are near which places of it, and which of them form long edges."""

from dataclasses import dataclass

import numpy as np

from taichi_edges.arrays.components import components
from taichi_edges.views.edgels import MOST_SINE

LINK_PX = 2.0  # edgels that follow each other are about a pixel apart; one may be missing
LINK_BESIDE_PX = 0.7  # across both of two edgels that follow each other: half the diagonal of a pixel
LONG_PX = 30.0  # extent of a chain from which on it is a long edge; few strokes of a texture run so far
MOST_WINDING = np.pi  # length of a long edge by its extent: that of a full circle


@dataclass(frozen=True)
class EdgelIndex:
    """The edgels of one view, to be looked up by pixel.

    points, normals: (e, 2) float32, of the edgels. order: (e,) int32 indices, pixel by pixel. starts: (H * W + 1,)
    int32, where in `order` each pixel begins. size: (width, height), pixels.
    """

    points: np.ndarray
    normals: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    size: tuple[int, int]

    @staticmethod
    def of(points: np.ndarray, normals: np.ndarray, width: int, height: int) -> "EdgelIndex":
        """Of the (e, 2) points and unit normals of a view."""
        columns, rows = np.clip(np.rint(points.T), 0, [[width - 1], [height - 1]]).astype(np.int32)
        pixels = rows * np.int32(width) + columns
        starts = np.zeros(width * height + 1, np.int32)
        np.cumsum(np.bincount(pixels, minlength=width * height), out=starts[1:])
        order = np.argsort(pixels, kind="stable").astype(np.int32)
        points, normals = (np.asarray(array, np.float32) for array in (points, normals))
        return EdgelIndex(points, normals, order, starts, (width, height))

    def pairs(self, places: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which edgels lie within `radius` px of which of the (n, 2) places.

        Returns the index of the place, ascending, that of the edgel, and the (k, 2) px from the edgel to the place.
        """
        (width, height), places = self.size, np.asarray(places, np.float32)
        last_pixel = np.array([width - 1, height - 1])
        first = np.clip(np.rint(places - radius), 0, last_pixel).astype(np.int32)
        last = np.clip(np.rint(places + radius), 0, last_pixel).astype(np.int32)
        rows = first[:, 1:] + np.arange(int(np.ceil(2 * radius)) + 1, dtype=np.int32)
        # The pixels of a row follow each other, and so do their edgels: one stretch for each place and row.
        offsets = np.minimum(rows, height - 1) * np.int32(width)
        begin, end = self.starts[offsets + first[:, :1]], self.starts[offsets + last[:, :1] + 1]
        counts = np.where(rows <= last[:, 1:], end - begin, 0).ravel()
        ahead = begin.ravel() - np.cumsum(counts, dtype=np.int32) + counts
        at = np.repeat(np.arange(len(places), dtype=np.int32), counts.reshape(rows.shape).sum(axis=1))
        found = self.order[np.repeat(ahead, counts) + np.arange(len(at), dtype=np.int32)]
        away = places[at] - self.points[found]
        near = away[:, 0] ** 2 + away[:, 1] ** 2 <= np.float32(radius**2)
        return at[near], found[near], away[near]

    def agreeing(
        self, places: np.ndarray, directions: np.ndarray, radius: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The `pairs` of places with unit directions (n, 2) and edgels that run the same way.

        Returns the index of the place, ascending, that of the edgel, and the (k,) px from the edgel across it.
        """
        at, found, away = self.pairs(places, radius)
        normals, along = self.normals[found], directions[at]
        agree = np.abs(normals[:, 0] * along[:, 0] + normals[:, 1] * along[:, 1]) <= MOST_SINE
        return at[agree], found[agree], (normals[:, 0] * away[:, 0] + normals[:, 1] * away[:, 1])[agree]

    def on_long_edges(self) -> np.ndarray:
        """(e,) bool: which edgels belong to chains that extend over LONG_PX and do not wind like a texture's."""
        along = np.stack([-self.normals[:, 1], self.normals[:, 0]], axis=1)
        one, other, away = self.pairs(self.points, LINK_PX)
        follow = one < other
        one, other, away = one[follow], other[follow], away[follow]
        beside = [np.abs((self.normals[side] * away).sum(axis=1)) <= LINK_BESIDE_PX for side in (one, other)]
        parallel = np.abs((self.normals[one] * along[other]).sum(axis=1)) <= MOST_SINE
        linked = beside[0] & beside[1] & parallel
        chains = components(len(along), one[linked], other[linked])
        lengths, extents = self._chain_sizes(chains)
        return ((extents >= LONG_PX) & (lengths <= MOST_WINDING * extents))[chains]

    def _chain_sizes(self, chains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(c,) pixels that each chain covers, and (c,) px of the diagonal of its bounding box. chains: (e,) int."""
        columns, rows = np.clip(np.rint(self.points.T).astype(np.int64), 0, np.array(self.size)[:, None] - 1)
        pixels = self.size[0] * self.size[1]
        covered = np.unique(chains.astype(np.int64) * pixels + rows * self.size[0] + columns) // pixels
        lengths = np.bincount(covered)
        low, high = np.full((len(lengths), 2), np.inf), np.full((len(lengths), 2), -np.inf)
        np.minimum.at(low, chains, self.points)
        np.maximum.at(high, chains, self.points)
        return lengths, np.linalg.norm(high - low, axis=1)
