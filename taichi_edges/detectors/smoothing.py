"""Normals of edgels from the places of those around them.

A parabola is laid through the edgels around each. A straight line would do where there are as many to one side as to
the other; at the ends of bent edges it would be a chord. Noise of 0.15 px in the 17 edgels within 8 px turns a normal
by 0.4 degrees; that of a single edgel may be off by several.
"""

from dataclasses import replace

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.edgel_grid import CELL, EdgelGrid
from taichi_edges.kernels.points import F32_2D, I32_1D
from taichi_edges.views.edgels import Edgels

REACH_PX = 8.0  # to either side, at most a cell
BESIDE_PX, BEND = 0.5, 1 / 80  # an edgel so far beside, and a bend of radius 40 px, are still the same edge
LEAST_COSINE = 0.94  # between the normals, 20 degrees: single ones are noisy
LEAST_AROUND, LEAST_SPREAD = 6, 0.25  # edgels, and the variance of their places along the edge, px^2
NOISE_PX, USUAL_BEND = 0.15, 1 / 160  # of edgels, across the edge; half the curvature of a radius of 80 px


@ti.kernel
def measure_normals(rows: ti.i32, columns: ti.i32, starts: I32_1D, cells: I32_1D, elements: F32_2D, normals: F32_2D):
    """normals (n, 2): across the parabola through the edgels around each that continue it, on the side they were.

    starts, elements: as in EdgelGrid. cells: (n,) the cell of each element. Elements with few around keep theirs.
    """
    for e in range(elements.shape[0]):
        u, v, a, b = elements[e, 0], elements[e, 1], elements[e, 2], elements[e, 3]
        view_row = cells[e] // columns
        column, row, view = cells[e] % columns, view_row % rows, view_row // rows
        moments = ti.Matrix.zero(ti.f32, 3, 3)  # of 1, t, t^2: t px along the edge, y across it
        sums = ti.Vector([0.0, 0.0, 0.0])
        for r in range(ti.max(row - 1, 0), ti.min(row + 2, rows)):
            line = (view * rows + r) * columns
            for k in range(starts[line + ti.max(column - 1, 0)], starts[line + ti.min(column + 2, columns)]):
                du, dv = elements[k, 0] - u, elements[k, 1] - v
                y, t = du * a + dv * b, du * b - dv * a
                same = ti.abs(elements[k, 2] * a + elements[k, 3] * b) >= LEAST_COSINE
                if same and ti.abs(t) <= REACH_PX and ti.abs(y) <= BESIDE_PX + BEND * t * t:
                    powers = ti.Vector([1.0, t, t * t])
                    moments += powers.outer_product(powers)
                    sums += y * powers
        normals[e, 0], normals[e, 1] = a, b
        n, st, stt = moments[0, 0], moments[0, 1], moments[1, 1]
        if n >= LEAST_AROUND and stt / n - (st / n) ** 2 >= LEAST_SPREAD:
            # Where the edgels lie to one side, noise passes for a bend: it is held to be about as small as USUAL_BEND.
            moments[2, 2] += (NOISE_PX / USUAL_BEND) ** 2
            slope = (moments.inverse() @ sums)[1]
            # The edge runs along (b, -a) + slope (a, b).
            length = ti.sqrt(1.0 + slope * slope)
            normals[e, 0], normals[e, 1] = (a - slope * b) / length, (b + slope * a) / length


def with_smooth_normals(edgels: Edgels, height: int, width: int, rounds: int = 2) -> Edgels:
    """The Edgels with the normals of the edge around each. The later rounds choose what is around by better ones.

    ti.init must have been called. height, width: pixels.
    """
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
