"""Edges and occluding contours told apart: does a round surface explain more of the edgels than a sharp edge does?

The contour of a surface of radius r is where viewing rays touch it. Seen from a direction that is turned by an angle t
about the line, it has moved by r (1 - cos t) away from where a line in space would be: a law with two unknowns, the
radius and the direction from which the line is the contour. An edge is the case of radius 0. So all radii and
directions are tried, and the views counted in which an edgel lies where each says. An edge has its edgels where
radius 0 says, and no radius finds many more; a contour has them on the line in some views, and beside it, as its radius
says, in the others.

To tell how large the radius is takes more (`radii_at`): a line that was fitted to a contour lies in front of the
surface, by some tenths of a pixel, and from half as far a contour moves by twice as many pixels.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_edges.evidence.edgel_matching import EdgelMatching, is_inside, project_line
from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.edgel_grid import cells_around
from taichi_edges.kernels.points import F32_1D, F32_2D, F32_3D, I32_1D, blocks_of, load_camera, load_point

AROUND_PX = 8.0  # edgels so far to the side of a place are looked at
MOST_AROUND = 6  # of them in each view
ALONG_PX = 0.8  # and so far along; edgels are about 1 px apart
MOST_SINE = 0.2  # of their angle with the line, 12 degrees: a contour keeps beside its line
LEAST_RADIUS_PX, RADIUS_STEP, RADII = 1.5, 1.06, 64  # to 60 px; of smaller ones the contour stays within a pixel
DIRECTIONS = 72  # from which the line is the contour, 5 degrees apart
GROWING = 0.06  # of how far a contour has moved: radii and directions that are tried are no closer
DEEPEST, FARTHEST = -1, 4  # a line lies so many tolerances in front of the surface: strokes of real contours do
UNKNOWN = 1e9


@dataclass(frozen=True)
class Rounding:
    """Of n places. views: (n,) that have an edgel on the place. rounded: (n,) that have one where the best radius says,
    at least `views`. around: (n,) that have any within AROUND_PX. least_px, most_px: (n,) range of the radii that
    explain as much; 0 where a sharp edge does.
    """

    views: np.ndarray
    rounded: np.ndarray
    around: np.ndarray
    least_px: np.ndarray
    most_px: np.ndarray

    @property
    def radius_px(self) -> np.ndarray:
        """(n,) the middle of the range."""
        return 0.5 * (self.least_px + self.most_px)

    @property
    def uncertainty_px(self) -> np.ndarray:
        """(n,) half of the range."""
        return 0.5 * (self.most_px - self.least_px)


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
    pixels: F32_1D,
    offsets: F32_3D,
    angles: F32_2D,
    scales: F32_2D,
):
    """offsets (n, V, MOST_AROUND): px to the side of each place, of edgels along it; angles (n, V) of views about it.

    A side is the same in all views: that of direction x (camera - place). offsets: UNKNOWN where there are no more.
    scales (n, V): px in the view for a pixel of the place, of size pixels (n,), to that side.
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
                    side = slopes @ (direction.cross(towards).normalized() * pixels[i])
                    scales[i, view] = side.norm()
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


@ti.kernel
def count_views(offsets: F32_3D, angles: F32_2D, tight: ti.f32, cosines: F32_2D, explained: F32_2D):
    """explained (n, 1 + RADII): the most views that a sharp edge nearby, radius 0, and each radius explain.

    The contour is s r - (r + f) cos t to the side: s tells its two sides, f is by how much the place lies in front of
    the surface. offsets: in pixels of the place. cosines: (n, V) scratch.
    """
    for i in range(offsets.shape[0]):
        for turn in range(DIRECTIONS):
            for view in range(offsets.shape[1]):
                cosines[i, view] = ti.cos(angles[i, view] - turn * (2.0 * np.pi / DIRECTIONS))
            for front in range(DEEPEST, FARTHEST + 1):
                radius = 0.0
                for number in range(1 + RADII):
                    inwards, outwards = 0, 0
                    for view in range(offsets.shape[1]):
                        cosine = cosines[i, view]
                        moved = radius * ((1.0 if cosine > 0 else -1.0) - cosine) - front * tight * cosine
                        if offsets[i, view, 0] < UNKNOWN and ti.abs(moved) < 2.0 * AROUND_PX:
                            outwards += 1 if is_there(offsets, i, view, moved, tight) else 0
                            inwards += 1 if is_there(offsets, i, view, -moved, tight) else 0
                    explained[i, number] = ti.max(explained[i, number], inwards, outwards)
                    radius = ti.max(radius * RADIUS_STEP, LEAST_RADIUS_PX)


@ti.func
def is_there(offsets: ti.template(), i, view, moved, tight):
    """Whether a view has an edgel where the contour would have moved to."""
    found = False
    for k in ti.static(range(MOST_AROUND)):
        if ti.abs(offsets[i, view, k] - moved) <= tight + GROWING * ti.abs(moved):
            found = True
    return found


def rounding_at(matching: EdgelMatching, points: np.ndarray, directions: np.ndarray, tight_px: float) -> Rounding:
    """Rounding at (n, 3) points with (n, 3) unit directions. tight_px: within so much an edgel is where a law says.

    The range holds the first of the radii that explain most, no other; `radii_at` tells it better.
    """
    offsets, angles, _ = _around(matching, points, directions)
    best = upload(np.zeros((len(points), 3), np.float32))
    if len(points):
        try_radii(upload(offsets), upload(angles), tight_px, upload(np.zeros_like(angles)), best)
    sharp, rounded, radius = download(best).T.astype(np.float64)
    return Rounding(sharp, rounded, _around_at_all(offsets), np.abs(radius), np.abs(radius))


def radii_at(matching: EdgelMatching, points: np.ndarray, directions: np.ndarray, tight_px: float) -> Rounding:
    """`rounding_at` places that may lie in front of the surface, or aside of the sharp edge; six times as slow.

    The range holds all radii that explain as many views as the best one less one, and half a step more at either end;
    infinite where the greatest that is tried does.
    """
    offsets, angles, scales = _around(matching, points, directions)
    explained = upload(np.zeros((len(points), 1 + RADII), np.float32))
    if len(points):
        scaled = np.where(offsets < UNKNOWN, offsets / np.where(scales > 0, scales, 1.0)[..., None], offsets)
        count_views(upload(scaled), upload(angles), tight_px, upload(np.zeros_like(angles)), explained)
    counts = download(explained).astype(np.float64)
    enough, radii = counts >= counts.max(axis=1, keepdims=True) - 1, LEAST_RADIUS_PX * RADIUS_STEP ** np.arange(RADII)
    least = np.where(enough[:, 0], 0.0, radii[enough[:, 1:].argmax(axis=1)] * RADIUS_STEP**-0.5)
    most = np.append(radii[:-1] * RADIUS_STEP**0.5, np.inf)[::-1][enough[:, :0:-1].argmax(axis=1)]
    return Rounding(counts[:, 0], counts.max(axis=1), _around_at_all(offsets), least, np.where(enough[:, 0], 0.0, most))


def _around_at_all(offsets: np.ndarray) -> np.ndarray:
    """(n,) views in which any edgel is so near to the place that it is looked at."""
    return (offsets[..., 0] < UNKNOWN).sum(axis=1).astype(np.float64)


def _around(
    matching: EdgelMatching, points: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The offsets, angles and scales of `offsets_around`."""
    count, views = len(points), matching.edgels.view_count
    offsets = upload(np.full((count, views, MOST_AROUND), UNKNOWN, np.float32))
    angles, scales = (upload(np.zeros((count, views), np.float32)) for _ in range(2))
    places, ways = (upload(np.ascontiguousarray(array, np.float32)) for array in (points, directions))
    grid = (matching.grid.rows, matching.grid.columns, matching.grid.starts, matching.grid.elements)
    if count:
        centres = upload(matching.every_camera.centres.astype(np.float32))
        pixels = upload(matching.pixel_at(points).astype(np.float32))
        scene = (matching.cameras, centres, *matching.size, *grid, pixels)
        offsets_around(*blocks_of(places), places, ways, *scene, offsets, angles, scales)
    return download(offsets), download(angles), download(scales)
