"""Edgels: edge elements, the sub-pixel points of 2D edges with the direction across each.

Whatever detects edges gives edgels; the edge maps that the splatting learns from are drawn through them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

MOST_SINE = 0.35  # of the angle between an edgel and a direction: 20 degrees, as a bend or noise may turn it


@dataclass(frozen=True)
class Edgels:
    """The edgels of V views, one view after the other.

    starts:    (V + 1,) int64; those of view v are starts[v] .. starts[v + 1] - 1.
    points:    (n, 2) float32 pixels (u, v), centres at integers.
    normals:   (n, 2) float32 unit vectors across the edge, sign arbitrary.
    strengths: (n,) float32 in 0..1: how sure the detector is.
    blurs:     (n,) float32 pixels: standard deviation of what the edge itself is blurred by in the picture, beyond what
               a pixel blurs; 0 of a sharp one. NaN where that is not known.
    outlines:  (n,) bool: on the outline of the object, which the transparency of a picture shows. Their normals point
               to the object.
    """

    starts: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    strengths: np.ndarray
    blurs: np.ndarray
    outlines: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.points)
        assert self.points.shape == self.normals.shape == (count, 2)
        assert self.strengths.shape == self.blurs.shape == self.outlines.shape == (count,)
        assert self.starts[0] == 0 and self.starts[-1] == count, self.starts

    @staticmethod
    def of_views(views: Iterable[tuple[np.ndarray, ...]]) -> "Edgels":
        """From an iterable with (points, normals, strengths) for each view, or with all five columns."""
        filled = [view if len(view) == 5 else (*view, *_unknown(len(view[0]))) for view in views]
        columns = list(zip(*filled, strict=True)) or [()] * 5
        starts = np.concatenate([[0], np.cumsum([len(points) for points in columns[0]])]).astype(np.int64)
        shapes = ((0, 2), (0, 2), (0,), (0,), (0,))
        joined = [np.concatenate([np.zeros(shape), *column]) for shape, column in zip(shapes, columns, strict=True)]
        points, normals, strengths, blurs = (np.ascontiguousarray(array, np.float32) for array in joined[:4])
        return Edgels(starts, points, normals, strengths, blurs, joined[4].astype(bool))

    @property
    def view_count(self) -> int:
        """Number of views, those without an edgel included."""
        return len(self.starts) - 1

    @property
    def views(self) -> np.ndarray:
        """(n,) int64: the view of each edgel."""
        return np.repeat(np.arange(self.view_count), np.diff(self.starts))

    def __len__(self) -> int:
        return len(self.points)

    def of_view(self, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (m, 2), normals (m, 2) and strengths (m,) of one view."""
        part = slice(self.starts[view], self.starts[view + 1])
        return self.points[part], self.normals[part], self.strengths[part]

    def keep(self, chosen: np.ndarray) -> "Edgels":
        """Only the chosen edgels. chosen: (n,) bool."""
        before = np.concatenate([[0], np.cumsum(chosen)]).astype(np.int64)
        return Edgels(before[self.starts], *(column[chosen] for column in self._columns))

    def of_some(self, views: Sequence[int]) -> "Edgels":
        """Those of some views, in that order."""
        parts = [slice(self.starts[view], self.starts[view + 1]) for view in views]
        return Edgels.of_views(tuple(column[part] for column in self._columns) for part in parts)

    @property
    def _columns(self) -> tuple[np.ndarray, ...]:
        return self.points, self.normals, self.strengths, self.blurs, self.outlines

    def moved(self, offsets: np.ndarray) -> "Edgels":
        """The same edgels, their points moved by (n, 2) pixels."""
        return replace(self, points=(self.points + offsets).astype(np.float32))


def _unknown(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Blurs and outlines of edgels of which neither is known."""
    return np.full(count, np.nan), np.zeros(count, bool)
