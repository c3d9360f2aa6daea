"""The edgels of all views in a grid of cells, for look-ups by kernels."""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import upload

if TYPE_CHECKING:
    from taichi_edges.views.edgels import Edgels

CELL = 8  # px; side of the cells in which edgels are looked up, at least the largest radius


class EdgelGrid:
    """The edgels of all views in cells of CELL x CELL pixels, for look-ups by kernels.

    starts: (V * rows * columns + 1,) int32, where each cell begins in `elements` (n, 4): u, v and the unit normal.
    strengths: (n,) float32 of the elements. order: (n + 1,) int32, the index in Edgels of each element, then -1 for
    none. rows, columns: cells in a view.
    """

    def __init__(self, edgels: "Edgels", height: int, width: int) -> None:
        self.rows, self.columns = -(-height // CELL), -(-width // CELL)
        inside = np.clip(np.floor(edgels.points / CELL).astype(np.int64), 0, [self.columns - 1, self.rows - 1])
        cells = (edgels.views * self.rows + inside[:, 1]) * self.columns + inside[:, 0]
        order = np.argsort(cells, kind="stable")
        counts = np.bincount(cells, minlength=edgels.view_count * self.rows * self.columns)
        self.starts = upload(np.concatenate([[0], np.cumsum(counts)]).astype(np.int32))
        elements = np.concatenate([edgels.points, edgels.normals], axis=1)[order]
        self.elements = upload(elements.astype(np.float32))
        self.strengths = upload(edgels.strengths[order].astype(np.float32))
        self.order = np.append(order.astype(np.int32), np.int32(-1))


@ti.func
def cells_around(pixel, radius, rows, columns):
    """First and last row, first and last column of the cells that hold the edgels within `radius` px of a pixel."""
    first_column = ti.max(ti.cast(ti.floor((pixel[0] - radius) / CELL), ti.i32), 0)
    last_column = ti.min(ti.cast(ti.floor((pixel[0] + radius) / CELL), ti.i32), columns - 1)
    first_row = ti.max(ti.cast(ti.floor((pixel[1] - radius) / CELL), ti.i32), 0)
    last_row = ti.min(ti.cast(ti.floor((pixel[1] + radius) / CELL), ti.i32), rows - 1)
    return first_row, last_row, first_column, last_column
