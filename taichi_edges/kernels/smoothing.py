"""Normals of edgels from the places of those around them: a tenth of a pixel over a dozen is a tenth of a degree."""

from dataclasses import replace

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.edgel_matching import CELL, EdgelGrid
from taichi_edges.kernels.points import F32_2D, I32_1D

REACH_PX = 8.0  # to either side, at most a cell
BESIDE_PX, BEND = 0.5, 1 / 80  # an edgel so far beside, and a bend of radius 40 px, are still the same edge
LEAST_COSINE = 0.94  # between the normals, 20 degrees: single ones are noisy
LEAST_AROUND = 6  # edgels; from fewer no direction is measured


@ti.kernel
def measure_normals(rows: ti.i32, columns: ti.i32, starts: I32_1D, cells: I32_1D, elements: F32_2D, normals: F32_2D):
    """normals (n, 2): across the principal axis of the edgels around each that continue it. cells: (n,) of each."""
    for e in range(elements.shape[0]):
        u, v, a, b = elements[e, 0], elements[e, 1], elements[e, 2], elements[e, 3]
        view_row = cells[e] // columns
        column, row, view = cells[e] % columns, view_row % rows, view_row // rows
        n, su, sv, suu, suv, svv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for r in range(ti.max(row - 1, 0), ti.min(row + 2, rows)):
            line = (view * rows + r) * columns
            for k in range(starts[line + ti.max(column - 1, 0)], starts[line + ti.min(column + 2, columns)]):
                du, dv = elements[k, 0] - u, elements[k, 1] - v
                across, along = ti.abs(du * a + dv * b), ti.abs(du * b - dv * a)
                same = ti.abs(elements[k, 2] * a + elements[k, 3] * b) >= LEAST_COSINE
                if same and along <= REACH_PX and across <= BESIDE_PX + BEND * along * along:
                    n, su, sv = n + 1.0, su + du, sv + dv
                    suu, suv, svv = suu + du * du, suv + du * dv, svv + dv * dv
        normals[e, 0], normals[e, 1] = a, b
        if n >= LEAST_AROUND:
            cuu, cuv, cvv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            angle = 0.5 * ti.atan2(2 * cuv, cuu - cvv)  # of the principal axis
            p, q = -ti.sin(angle), ti.cos(angle)
            sign = 1.0 if p * a + q * b >= 0 else -1.0
            normals[e, 0], normals[e, 1] = sign * p, sign * q


def with_smooth_normals(edgels, height, width, rounds=2):
    """Edgels whose normals are those of the edge around them. The later rounds choose what is around by better ones."""
    for _ in range(rounds if len(edgels) else 0):
        grid = EdgelGrid(edgels, height, width)
        inside = np.clip(np.floor(edgels.points / CELL).astype(np.int64), 0, [grid.columns - 1, grid.rows - 1])
        order = grid.order[: len(edgels)]
        cells = ((edgels.views * grid.rows + inside[:, 1]) * grid.columns + inside[:, 0])[order]
        found = upload(np.zeros((len(edgels), 2), np.float32))
        measure_normals(grid.rows, grid.columns, grid.starts, upload(cells.astype(np.int32)), grid.elements, found)
        normals = np.empty((len(edgels), 2), np.float32)
        normals[order] = download(found)
        edgels = replace(edgels, normals=normals)
    return edgels
