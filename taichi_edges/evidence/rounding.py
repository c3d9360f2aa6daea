"""Edges and occluding contours told apart: does a round surface explain more of the edgels than a sharp edge does?

The contour of a surface of radius r is where viewing rays touch it. Seen from a direction that is turned by an angle t
about the line, it has moved by r (1 - cos t) away from where a line in space would be: a law with two unknowns, the
radius and the direction from which the line is the contour. An edge is the case of radius 0. So all radii and
directions are tried, and the views counted in which an edgel lies where each says. An edge has its edgels where
radius 0 says, and no radius finds many more; a contour has them on the line in some views, and beside it, as its radius
says, in the others.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_edges.evidence.edgel_matching import EdgelMatching, is_inside, project_line
from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.edgel_grid import cells_around
from taichi_edges.kernels.points import F32_2D, F32_3D, I32_1D, blocks_of, load_camera, load_point

AROUND_PX = 8.0  # edgels so far to the side of a place are looked at
MOST_AROUND = 6  # of them in each view
ALONG_PX = 0.8  # and so far along; edgels are about 1 px apart
MOST_SINE = 0.2  # of their angle with the line, 12 degrees: a contour keeps beside its line
LEAST_RADIUS_PX, RADIUS_STEP, RADII = 1.5, 1.06, 64  # to 60 px; of smaller ones the contour stays within a pixel
DIRECTIONS = 72  # from which the line is the contour, 5 degrees apart
GROWING = 0.06  # of how far a contour has moved: radii and directions that are tried are no closer
UNKNOWN = 1e9


@dataclass(frozen=True)
class Rounding:
    """Of n places. views: (n,) that have an edgel on the place. rounded: (n,) that have one where the best radius says,
    at least `views`. radius_px: (n,) that radius; 0 where a sharp edge explains as much.
    """

    views: np.ndarray
    rounded: np.ndarray
    radius_px: np.ndarray


@ti.kernel
def offsets_around(
    size: ti.i32,
    blocks: ti.i32,
    points: F32_2D,
    directions: F32_2D,
    cameras: F32_3D,
    centres: F32_2D,
    height: ti.i32,
    width: ti.i32,
    rows: ti.i32,
    columns: ti.i32,
    starts: I32_1D,
    elements: F32_2D,
    offsets: F32_3D,
    angles: F32_2D,
):
    """offsets (n, V, MOST_AROUND): px to the side of each place, of edgels along it; angles (n, V) of views about it.

    A side is the same in all views: that of direction x (camera - place). offsets: UNKNOWN where there are no more.
    """
    for block in range(blocks):
        for view in range(cameras.shape[0]):
            camera = load_camera(cameras, view)
            for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
                direction = ti.Vector([directions[i, 0], directions[i, 1], directions[i, 2]])
                place = ti.Vector([points[i, 0], points[i, 1], points[i, 2]])
                pixel_at, slopes, along, front = project_line(camera, load_point(points, i), direction)
                axis = ti.Vector([1.0, 0.0, 0.0])
                if ti.abs(direction[0]) > 0.6:
                    axis = ti.Vector([0.0, 1.0, 0.0])
                first = axis.cross(direction).normalized()
                second = direction.cross(first)
                towards = ti.Vector([centres[view, a] for a in ti.static(range(3))]) - place
                angles[i, view] = ti.atan2(towards.dot(second), towards.dot(first))
                if front and is_inside(pixel_at, height, width):
                    side = slopes @ direction.cross(towards)
                    across = ti.Vector([-along[1], along[0]])
                    if across.dot(side) < 0:
                        across = -across
                    count = 0
                    first_row, last_row, first_column, last_column = cells_around(pixel_at, AROUND_PX, rows, columns)
                    for row in range(first_row, last_row + 1):
                        line = (view * rows + row) * columns
                        for element in range(starts[line + first_column], starts[line + last_column + 1]):
                            du, dv = elements[element, 0] - pixel_at[0], elements[element, 1] - pixel_at[1]
                            off = du * across[0] + dv * across[1]
                            if ti.abs(du * along[0] + dv * along[1]) <= ALONG_PX and ti.abs(off) <= AROUND_PX:
                                sine = ti.abs(elements[element, 2] * along[0] + elements[element, 3] * along[1])
                                if sine <= MOST_SINE and count < MOST_AROUND:
                                    offsets[i, view, count] = off
                                    count += 1


@ti.kernel
def try_radii(offsets: F32_3D, angles: F32_2D, tight: ti.f32, moves: F32_2D, best: F32_2D):
    """best (n, 3): how many views have an edgel on the place; the most that a radius explains; that radius, px.

    moves: (n, V) scratch.
    """
    for i in range(offsets.shape[0]):
        sharp, any_edgel = 0, 0
        for view in range(offsets.shape[1]):
            sharp += 1 if is_there(offsets, i, view, 0.0, tight) else 0
            any_edgel += 1 if offsets[i, view, 0] < UNKNOWN else 0
        most, winner = sharp, 0.0
        if any_edgel > sharp:
            for turn in range(DIRECTIONS):
                for view in range(offsets.shape[1]):
                    cosine = ti.cos(angles[i, view] - turn * (2.0 * np.pi / DIRECTIONS))
                    # From the other side it is the contour as well, and moves the other way.
                    moves[i, view] = 1.0 - cosine if cosine > 0 else -1.0 - cosine
                radius = LEAST_RADIUS_PX
                for _ in range(RADII):
                    inwards, outwards = 0, 0
                    for view in range(offsets.shape[1]):
                        if offsets[i, view, 0] < UNKNOWN and ti.abs(radius * moves[i, view]) < 2.0 * AROUND_PX:
                            moved = radius * moves[i, view]
                            outwards += 1 if is_there(offsets, i, view, moved, tight) else 0
                            inwards += 1 if is_there(offsets, i, view, -moved, tight) else 0
                    if ti.max(inwards, outwards) > most:
                        most, winner = ti.max(inwards, outwards), radius
                    radius *= RADIUS_STEP
        best[i, 0], best[i, 1], best[i, 2] = sharp, most, winner


@ti.func
def is_there(offsets: ti.template(), i, view, moved, tight):
    """Whether a view has an edgel where the contour would have moved to."""
    found = False
    for k in ti.static(range(MOST_AROUND)):
        if ti.abs(offsets[i, view, k] - moved) <= tight + GROWING * ti.abs(moved):
            found = True
    return found


def rounding_at(matching: EdgelMatching, points: np.ndarray, directions: np.ndarray, tight_px: float) -> Rounding:
    """Rounding at (n, 3) points with (n, 3) unit directions. tight_px: within so much an edgel is where a law says."""
    count, views = len(points), matching.edgels.view_count
    offsets = upload(np.full((count, views, MOST_AROUND), UNKNOWN, np.float32))
    angles = upload(np.zeros((count, views), np.float32))
    places, ways = (upload(np.ascontiguousarray(array, np.float32)) for array in (points, directions))
    grid = (matching.grid.rows, matching.grid.columns, matching.grid.starts, matching.grid.elements)
    if count:
        centres = upload(matching.every_camera.centres.astype(np.float32))
        scene = (matching.cameras, centres, *matching.size, *grid)
        offsets_around(*blocks_of(places), places, ways, *scene, offsets, angles)
    offsets, angles = download(offsets), download(angles)
    best = upload(np.zeros((count, 3), np.float32))
    if count:
        moves = upload(np.zeros((count, views), np.float32))
        try_radii(upload(offsets), upload(angles), tight_px, moves, best)
    sharp, best, radius = download(best).T.astype(np.float64)
    return Rounding(sharp, best, np.abs(radius))
