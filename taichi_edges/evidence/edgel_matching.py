"""Which edgels the views show at 3D points that know their direction, and what those say about where the points are.

Sums run over the views in order, so no result depends on the number of threads.
"""

from functools import cached_property
from types import FunctionType

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_edges.arrays import robust
from taichi_edges.evidence.plane_equations import GRADIENT, NUMBERS, VIEWS, WEIGHT, PlaneEquations
from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.edgel_grid import EdgelGrid, cells_around
from taichi_edges.kernels.points import F32_1D, F32_2D, F32_3D, I32_1D, I32_2D, blocks_of, load_camera, load_point
from taichi_edges.views.cameras import NEAR, Cameras
from taichi_edges.views.edgels import MOST_SINE
from taichi_edges.views.views import Views, pixel_size

OWNED_PX, OWNED_MOST = 2.0, 6  # neighbours of an edgel: those so near, itself included, at most so many,
OWNED_BESIDE_PX = 0.5  # and no farther to the side: an edge may run beside another
APART = 100.0  # px; views are laid out so far apart when one tree holds the edgels of all of them
LEAST_VIEWS = 2.5  # of full strength; two planes always meet

# Taichi reads types and knows none of NumPy's: the same code without them.
_weight = robust.geman_mcclure
geman_mcclure = ti.func(FunctionType(_weight.__code__, {}, _weight.__name__, _weight.__defaults__))


class EdgelMatching:
    """Matches points that know their direction with the edgels of all views.

    edgels: those of the views. pixel: size of a pixel at the scene, unit-cube units, see `pixel_at`. scale_px: residual
    at which the weight of an edgel has fallen to a quarter. least_views: that show an edge which goes on, each counted
    by its weight.
    """

    def __init__(self, views: Views, least_views: float = LEAST_VIEWS) -> None:
        assert views.edgels is not None
        self.edgels, self.pixel = views.edgels, pixel_size(views)
        self.scale_px, self.least_views = views.tolerance_px, least_views
        self.grid = EdgelGrid(views.edgels, views.height, views.width)
        self.size = views.height, views.width
        self.cameras = upload((views.intrinsics @ views.world_to_camera).astype(np.float32))

    @property
    def projections(self) -> np.ndarray:
        """(V, 3, 4) intrinsics @ world_to_camera, rounded to float32 as the kernels have them."""
        return download(self.cameras).astype(np.float64)

    @cached_property
    def every_camera(self) -> Cameras:
        """The Cameras of `projections`."""
        return Cameras.of(self.projections)

    def pixel_at(self, points: np.ndarray) -> np.ndarray:
        """(n,) size of a pixel at each of (n, 3) points, see `Cameras.pixel_at`; at the scene where no view has it."""
        height, width = self.size
        return self.every_camera.pixel_at(points, width, height, self.pixel)

    @cached_property
    def neighbors(self) -> np.ndarray:
        """(n, OWNED_MOST) indices of the edgels before and after each on its 2D edge, itself included and repeated."""
        points, own = self.edgels.points, np.arange(len(self.edgels))[:, None]
        places = np.column_stack([points, APART * self.edgels.views])
        distances, near = cKDTree(places).query(places, OWNED_MOST, distance_upper_bound=OWNED_PX)
        near = np.where(np.isfinite(distances), near, own)
        beside = np.abs(np.einsum("nkc,nc->nk", points[near] - points[:, None], self.edgels.normals))
        return np.where(beside <= OWNED_BESIDE_PX, near, own)

    @cached_property
    def plane_normals(self) -> np.ndarray:
        """(e, 3) normals of the edgels' viewing planes in space, not of unit length."""
        return np.einsum("nj,njk->nk", self._lines, self.projections[self.edgels.views, :, :3])

    @property
    def _lines(self) -> np.ndarray:
        """(e, 3) the edgels as homogeneous lines."""
        points, normals = self.edgels.points.astype(np.float64), self.edgels.normals.astype(np.float64)
        return np.column_stack([normals, -(normals * points).sum(axis=1)])

    @cached_property
    def edgel_blurs(self) -> np.ndarray:
        """(e + 1,) blurs of the edgels, px; the last one, that of no edgel, NaN."""
        return np.append(self.edgels.blurs, np.float32(np.nan))

    @cached_property
    def densities(self) -> list[tuple[float, float]]:
        """[(sum of strengths, px^2)] of the edgels of each view that has any, and of the box around them."""
        views = [self.edgels.of_view(view) for view in range(self.edgels.view_count)]
        return [(some.sum(), np.prod(np.ptp(points, axis=0) + 1.0)) for points, _, some in views if len(points)]

    @cached_property
    def outline_grid(self) -> EdgelGrid:
        """The edgels on outlines, alone."""
        return EdgelGrid(self.edgels.keep(self.edgels.outlines), *self.size)

    def outside(self, points: np.ndarray, directions: np.ndarray, radius: float) -> np.ndarray:
        """(n, V) px by which points lie beyond the outline of the object; 0 inside, and where the outline is farther
        than `radius`. points, directions: (n, 3).
        """
        if not self.edgels.outlines.any():
            return np.zeros((len(points), self.edgels.view_count), np.float32)
        found, residuals, _ = self._matches(
            self.outline_grid, points, directions, (0, self.edgels.view_count), radius, 1.0
        )
        return np.where(found >= 0, np.maximum(-residuals, 0.0), 0.0)

    def equations(self, points: np.ndarray, directions: np.ndarray, radius: float, scale: float) -> PlaneEquations:
        """PlaneEquations of the edgels next to points.

        points, directions: (n, 3). radius: px, of the edgels looked at. scale: px, of the robust weights.
        """
        if len(points) == 0:
            return PlaneEquations.of(np.zeros((0, NUMBERS), np.float32))
        equations = upload(np.zeros((len(points), NUMBERS), np.float32))
        points, directions = (upload(np.asarray(array, np.float32)) for array in (points, directions))
        grid = (self.grid.rows, self.grid.columns, self.grid.starts, self.grid.elements)
        gates = float(radius), MOST_SINE, float(scale)
        edgels = (*self.size, *grid, self.grid.strengths)
        add_equations(*blocks_of(points), points, directions, self.cameras, *edgels, *gates, equations)
        return PlaneEquations.of(download(equations))

    @cached_property
    def planes(self) -> np.ndarray | ti.Ndarray:
        """(e, 5) float32, where kernels run: position, normal and strength of each edgel."""
        columns = [self.edgels.points, self.edgels.normals, self.edgels.strengths[:, None]]
        return upload(np.concatenate(columns, axis=1).astype(np.float32))

    def equations_of(self, points: np.ndarray, edgels: np.ndarray, scale: float) -> PlaneEquations:
        """`equations` of the edgels that each point is said to have: (n, V) int32 index into Edgels, -1 none.

        In how many images the points are is not asked.
        """
        equations = upload(np.zeros((len(points), NUMBERS), np.float32))
        points, edgels = upload(np.asarray(points, np.float32)), upload(np.asarray(edgels, np.int32))
        if points.shape[0]:
            add_equations_of(*blocks_of(points), points, self.cameras, edgels, self.planes, float(scale), equations)
        return PlaneEquations.of(download(equations))

    def matches(
        self, points: np.ndarray, directions: np.ndarray, views: slice, radius: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(n, v) int32: the edgel, an index into Edgels, that each point has in some views (a slice); -1 none.

        Also (n, v) float32, its distance across the edgel, px, signed along the normal; and (n, v) bool, whether the
        view has the point in its image.
        """
        return self._matches(self.grid, points, directions, (views.start, views.stop), radius, MOST_SINE)

    def _matches(
        self,
        edgels: EdgelGrid,
        points: np.ndarray,
        directions: np.ndarray,
        views: tuple[int, int],
        radius: float,
        most_sine: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`matches` with the edgels of a grid, in the views from the first to before the last."""
        first, last = views
        found = upload(np.full((len(points), last - first), -2, np.int32))
        residuals = upload(np.zeros(found.shape, np.float32))
        points, directions = (upload(np.asarray(array, np.float32)) for array in (points, directions))
        grid = (edgels.rows, edgels.columns, edgels.starts, edgels.elements)
        gates = float(radius), float(most_sine)
        if points.shape[0]:
            find_matches(
                *blocks_of(points),
                first,
                points,
                directions,
                self.cameras,
                *self.size,
                *grid,
                *gates,
                found,
                residuals,
            )
        found = download(found)
        return edgels.order[np.maximum(found, -1)], download(residuals), found > -2


@ti.func
def project_line(camera, point, direction):
    """Pixel (u, v), its derivative by the point (2, 3), the direction's unit image, and whether it is in front."""
    h = camera @ point
    front = h[2] > NEAR
    depth = ti.max(h[2], NEAR)
    pixel = ti.Vector([h[0], h[1]]) / depth
    slopes = ti.Matrix(
        [[(camera[axis, j] - pixel[axis] * camera[2, j]) / depth for j in ti.static(range(3))] for axis in range(2)]
    )
    image = slopes @ direction
    return pixel, slopes, image / ti.max(image.norm(), 1e-12), front


@ti.func
def nearest_edgel(view, pixel, along, radius, most_sine, rows, columns, starts: ti.template(), elements: ti.template()):
    """Index in `elements` of the edgel nearest to a pixel that runs along the unit vector `along`; -1 where none is."""
    nearest, best = -1, radius * radius
    first_row, last_row, first_column, last_column = cells_around(pixel, radius, rows, columns)
    for row in range(first_row, last_row + 1):
        line = (view * rows + row) * columns
        for element in range(starts[line + first_column], starts[line + last_column + 1]):
            du, dv = elements[element, 0] - pixel[0], elements[element, 1] - pixel[1]
            squared = du * du + dv * dv
            if squared < best:
                sine = ti.abs(elements[element, 2] * along[0] + elements[element, 3] * along[1])
                if sine <= most_sine:
                    nearest, best = element, squared
    return nearest


@ti.func
def is_inside(pixel, height, width):
    """Whether a pixel position rounds to a pixel of the image."""
    return pixel[0] >= -0.5 and pixel[1] >= -0.5 and pixel[0] < width - 0.5 and pixel[1] < height - 0.5


@ti.func
def add_plane(i, row, pixel, slopes, planes: ti.template(), strength, scale, equations: ti.template()):
    """Adds the viewing plane of an edgel, u, v and normal in `row` of `planes`, to equations[i], see PlaneEquations.

    pixel, slopes: of the point, see `project_line`. strength: of the edgel.
    """
    normal = ti.Vector([planes[row, 2], planes[row, 3]])
    residual = normal.dot(pixel - ti.Vector([planes[row, 0], planes[row, 1]]))
    slope = normal @ slopes
    weight = geman_mcclure((residual / scale) ** 2, strength)
    k = 0
    for a in ti.static(range(3)):
        for b in ti.static(range(a, 3)):
            equations[i, k] = equations[i, k] + weight * slope[a] * slope[b]  # += would be atomic
            k += 1
    for a in ti.static(range(3)):
        equations[i, GRADIENT + a] = equations[i, GRADIENT + a] + weight * residual * slope[a]
    equations[i, WEIGHT] = equations[i, WEIGHT] + weight


@ti.kernel
def add_equations(
    size: ti.i32,
    blocks: ti.i32,
    points: F32_2D,
    directions: F32_2D,
    cameras: F32_3D,
    height: ti.i32,
    width: ti.i32,
    rows: ti.i32,
    columns: ti.i32,
    starts: I32_1D,
    elements: F32_2D,
    strengths: F32_1D,
    radius: ti.f32,
    most_sine: ti.f32,
    scale: ti.f32,
    equations: F32_2D,
):
    """equations (n, NUMBERS): the sums of PlaneEquations over the edgels matched by each point.

    radius: px, of the edgels looked at. scale: px, of the robust weights.
    """
    for block in range(blocks):
        for view in range(cameras.shape[0]):
            camera = load_camera(cameras, view)
            for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
                direction = ti.Vector([directions[i, 0], directions[i, 1], directions[i, 2]])
                pixel, slopes, along, front = project_line(camera, load_point(points, i), direction)
                if front and is_inside(pixel, height, width):
                    equations[i, VIEWS] = equations[i, VIEWS] + 1.0  # += would be atomic
                    element = nearest_edgel(view, pixel, along, radius, most_sine, rows, columns, starts, elements)
                    if element >= 0:
                        add_plane(i, element, pixel, slopes, elements, strengths[element], scale, equations)


@ti.kernel
def find_matches(
    size: ti.i32,
    blocks: ti.i32,
    first: ti.i32,
    points: F32_2D,
    directions: F32_2D,
    cameras: F32_3D,
    height: ti.i32,
    width: ti.i32,
    rows: ti.i32,
    columns: ti.i32,
    starts: I32_1D,
    elements: F32_2D,
    radius: ti.f32,
    most_sine: ti.f32,
    found: I32_2D,
    residuals: F32_2D,
):
    """found (n, v): the element matched by each point in the views from `first` on, -1 none, -2 not in the image."""
    for block in range(blocks):
        for column in range(found.shape[1]):
            view = first + column
            camera = load_camera(cameras, view)
            for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
                direction = ti.Vector([directions[i, 0], directions[i, 1], directions[i, 2]])
                pixel, _, along, front = project_line(camera, load_point(points, i), direction)
                if front and is_inside(pixel, height, width):
                    element = nearest_edgel(view, pixel, along, radius, most_sine, rows, columns, starts, elements)
                    found[i, column] = element
                    if element >= 0:
                        du, dv = pixel[0] - elements[element, 0], pixel[1] - elements[element, 1]
                        residuals[i, column] = du * elements[element, 2] + dv * elements[element, 3]


@ti.kernel
def add_equations_of(
    size: ti.i32,
    blocks: ti.i32,
    points: F32_2D,
    cameras: F32_3D,
    edgels: I32_2D,
    planes: F32_2D,
    scale: ti.f32,
    equations: F32_2D,
):
    """The sums of `add_equations` over edgels (n, V) that are known, -1 none; planes (e, 5) as in EdgelMatching."""
    for block in range(blocks):
        for view in range(cameras.shape[0]):
            camera = load_camera(cameras, view)
            for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
                edgel = edgels[i, view]
                if edgel >= 0:
                    pixel, slopes, _, _ = project_line(camera, load_point(points, i), ti.Vector([1.0, 0.0, 0.0]))
                    add_plane(i, edgel, pixel, slopes, planes, planes[edgel, 4], scale, equations)
