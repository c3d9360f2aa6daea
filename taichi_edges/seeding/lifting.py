"""Edgels lifted into space: the depths at which other views see an edge that runs the same way.

An edgel with its camera spans a plane, and so does each edgel of another view that the viewing ray of the first can
meet: the two planes intersect in a line, which is where the edge would be if both were pictures of it. Of wrong pairs
these lines are anywhere along the ray; those of right ones coincide, within what the detector is off. So each edgel
asks every view that looks from elsewhere, and the depths at which most of them agree are its candidates. How much an
agreement says is a matter of chance: a view with many edges, or one in whose picture the depth hardly shows, agrees
with anything.

No threshold on a share of the views: an edge on one face, in sight of a tenth of the views, stands out as clearly on
its own ray as the outline of the whole does on another.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import download, threads, upload
from taichi_edges.kernels.points import F32_1D, F32_2D, F32_3D, I32_1D, I32_2D
from taichi_edges.seeding.boxes import through_box
from taichi_edges.views.cameras import NEAR, TRIED_FROM, Cameras
from taichi_edges.views.views import Views

if TYPE_CHECKING:
    from collections.abc import Callable

MOST_ANGLE = np.radians(65.0)  # between two viewing directions; from farther round, other sides of things are seen
LEAST_ANGLE = np.radians(1.5)  # nearer views tell no depth
LEAST_VIEWS, MOST_VIEWS = 6, 32  # that an edgel is compared with; fewer than the first: also views from farther round
MARGIN = 0.03  # of the box, by which edges may lie beyond it: outlines of what fills it lie on its sides
CANDIDATES = 3  # depths kept for each edgel
MOST_MEETINGS = 768  # of a viewing ray with edgels of other views; more are not looked at
HALF_EDGEL_PX = 0.6  # edgels are about 1 px apart: a ray that crosses an edge there meets one, or two
REACH = 2.5  # times that: within so much of the ray's picture edgels are tried, seen from the epipole
LEAST_SINE = 0.05  # of the angle between two planes; of flatter pairs the line is nowhere in particular
TURNED_SINE = 0.3  # of the angle between two lines on the same ray that may be one edge: 17 degrees
TURNED_BY_CHANCE = 0.2  # share of all directions within that
WRONG = 0.02  # share of agreements that are of other edges however clear they look: what one view can say at most
LEAST_PARALLAX = 0.15  # of the largest on a ray: what tells less of the depth is no candidate itself
APART_PX = 1.5  # candidates of one edgel are so far apart, in the view that tells their depths best
FEW = 0.02  # share of the rays that may pass nearer to the other camera than the reach is made for
LANES = 512  # Taichi gives a CPU thread so many items of a loop at least


@dataclass(frozen=True)
class Lifted:
    """Candidates for where in space each of e edgels is, CANDIDATES of each, the likeliest first.

    points, directions: (e, CANDIDATES, 3) unit cube, and unit vectors along the edge. evidence: (e, CANDIDATES) log
    likelihood ratio that the edge is there, over that the views agree by chance; 0 where there is no candidate.
    parallax: (e, CANDIDATES) px by which the view that tells the depth best would see a unit of inverse depth.
    """

    points: np.ndarray
    directions: np.ndarray
    evidence: np.ndarray
    parallax: np.ndarray


@ti.kernel
def lift_rays(
    workers: ti.i32,
    lanes: ti.i32,
    rays: F32_2D,
    normals: F32_2D,
    ranges: F32_2D,
    centre: F32_1D,
    angles: F32_2D,
    others: I32_1D,
    reach: F32_1D,
    starts: I32_1D,
    order: I32_1D,
    around: F32_1D,
    planes: F32_2D,
    edgels: F32_2D,
    cameras: F32_3D,
    tolerance: ti.f32,
    depths: F32_2D,
    slopes: F32_2D,
    turns: F32_2D,
    scores: F32_2D,
    whose: I32_2D,
    meetings: I32_2D,
    rising: I32_2D,
    found: F32_2D,
):
    """The best inverse depths on each viewing ray of one view.

    rays: (n, 3), depth 1. normals: (n, 3) unit, of the viewing planes. ranges: (n, 2) inverse depths. centre: (3,) of
    the camera. angles: (m, n) of the rays about the line to each of m other cameras, whose views are `others`. Of
    these, starts: (m + 1,) where the edgels of each begin in `order`, indices in the order of their angles `around`;
    reach: (m,) radians. planes: (e, 4), edgels: (e, 4) of all views; cameras: (V, 3, 4). depths, slopes, turns, scores,
    whose, meetings, rising: (workers, MOST_MEETINGS) scratch. found: (n, 4 CANDIDATES) inverse depth, angle in the
    viewing plane, evidence and parallax of each.
    """
    for item in range(workers * lanes):
        if item % lanes == 0:
            worker = item // lanes
            eye = ti.Vector([centre[0], centre[1], centre[2]])
            i = worker
            while i < rays.shape[0]:
                ray = ti.Vector([rays[i, 0], rays[i, 1], rays[i, 2]])
                normal = ti.Vector([normals[i, 0], normals[i, 1], normals[i, 2]])
                first = ray.normalized()
                second = normal.cross(first)
                count = 0
                for m in range(others.shape[0]):
                    meetings[worker, m] = 0
                    at = first_from(around, starts[m], starts[m + 1], angles[m, i] - reach[m])
                    while at < starts[m + 1] and around[at] <= angles[m, i] + reach[m] and count < MOST_MEETINGS:
                        e = order[at]
                        plane = ti.Vector([planes[e, 0], planes[e, 1], planes[e, 2]])
                        offset = plane.dot(eye) + planes[e, 3]
                        depth = -plane.dot(ray) / (offset if ti.abs(offset) > 1e-12 else 1e-12)
                        if depth >= ranges[i, 0] and depth <= ranges[i, 1]:
                            h = depth * homogeneous(cameras, others[m], eye) + turned(cameras, others[m], ray)
                            line = plane.cross(normal)
                            if h[2] > NEAR * depth and line.norm() > LEAST_SINE * plane.norm():
                                right, down = h[0] / h[2] - edgels[e, 0], h[1] / h[2] - edgels[e, 1]
                                if ti.abs(down * edgels[e, 2] - right * edgels[e, 3]) <= HALF_EDGEL_PX:
                                    depths[worker, count] = depth
                                    slopes[worker, count] = ti.abs(offset / h[2])
                                    turns[worker, count] = ti.atan2(line.dot(second), line.dot(first))
                                    whose[worker, count] = m
                                    meetings[worker, m] += 1
                                    count += 1
                        at += 1
                most = 0.0
                for k in range(count):
                    most = ti.max(most, slopes[worker, k])
                span = ranges[i, 1] - ranges[i, 0]
                telling = sort_telling(worker, count, LEAST_PARALLAX * most, depths, slopes, rising)
                reached = tolerance / ti.max(LEAST_PARALLAX * most, 1e-12)
                for k in range(count):
                    scores[worker, k] = 0.0
                for at in range(telling):
                    scores[worker, rising[worker, at]] = evidence_at(
                        worker, at, telling, span, tolerance, reached, depths, slopes, turns, whose, meetings, rising
                    )
                for c in range(CANDIDATES):
                    best, which = 0.0, -1
                    for k in range(count):
                        if scores[worker, k] > best:
                            best, which = scores[worker, k], k
                    if which >= 0:
                        found[i, 4 * c], found[i, 4 * c + 1] = depths[worker, which], turns[worker, which]
                        found[i, 4 * c + 2], found[i, 4 * c + 3] = best, most
                        for k in range(count):
                            if ti.abs(depths[worker, k] - depths[worker, which]) * most < APART_PX:
                                scores[worker, k] = 0.0
                i += workers


@ti.func
def first_from(values: ti.template(), low, high, least):
    """Index of the first of the rising values[low .. high - 1] that is at least `least`."""
    while low < high:
        middle = (low + high) // 2
        if values[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low


@ti.func
def turned(cameras: ti.template(), view, way):
    """The 3x3 part of a camera times a vector."""
    h = ti.Vector([0.0, 0.0, 0.0])
    for a in ti.static(range(3)):
        h[a] = cameras[view, a, 0] * way[0] + cameras[view, a, 1] * way[1] + cameras[view, a, 2] * way[2]
    return h


@ti.func
def homogeneous(cameras: ti.template(), view, point):
    """The projection (u d, v d, d) of a point."""
    return turned(cameras, view, point) + ti.Vector([cameras[view, a, 3] for a in ti.static(range(3))])


@ti.func
def sort_telling(worker, count, least, depths: ti.template(), slopes: ti.template(), rising: ti.template()):
    """How many of the meetings tell the depth, with a slope of at least `least`; `rising` their indices by depth.

    Shell's sort: insertion sort at a distance of 40, 13, 4 and 1.
    """
    telling = 0
    for k in range(count):
        if slopes[worker, k] >= least:
            rising[worker, telling] = k
            telling += 1
    gap = 40
    while gap > 0:
        for at in range(gap, telling):
            k = rising[worker, at]
            depth, to = depths[worker, k], at
            while to >= gap and depths[worker, rising[worker, to - gap]] > depth:
                rising[worker, to] = rising[worker, to - gap]
                to -= gap
            rising[worker, to] = k
        gap //= 3
    return telling


@ti.func
def evidence_at(
    worker,
    at,
    telling,
    span,
    tolerance,
    reached,
    depths: ti.template(),
    slopes: ti.template(),
    turns: ti.template(),
    whose: ti.template(),
    meetings: ti.template(),
    rising: ti.template(),
):
    """Log likelihood ratio that the edge is at a meeting: what each view says that has one there, too.

    at: of the `telling` meetings in the order of their depths; those farther than `reached` are out of tolerance. A
    view counts once, by the nearest of its meetings that runs the same way.
    """
    own = rising[worker, at]
    total, seen = 0.0, ti.u64(0)
    below, above = at - 1, at
    while True:
        down, up = 2.0 * reached, 2.0 * reached
        if below >= 0:
            down = depths[worker, own] - depths[worker, rising[worker, below]]
        if above < telling:
            up = depths[worker, rising[worker, above]] - depths[worker, own]
        apart = ti.min(down, up)
        if apart > reached:
            break
        k = 0
        if up <= down:
            k = rising[worker, above]
            above += 1
        else:
            k = rising[worker, below]
            below -= 1
        off, bit = apart * slopes[worker, k], ti.u64(1) << ti.cast(whose[worker, k], ti.u64)
        turned_by = ti.abs(ti.sin(turns[worker, k] - turns[worker, own]))
        if off < tolerance and (seen & bit) == 0 and turned_by < TURNED_SINE:
            seen |= bit
            expected = meetings[worker, whose[worker, k]] * 2.0 * tolerance / (slopes[worker, k] * span)
            close = 1.0 - (off / tolerance) ** 2
            total += close * -ti.log(TURNED_BY_CHANCE * ti.min(1.0, expected) + WRONG)
    return total


@dataclass(frozen=True)
class Rays:
    """The viewing rays and planes of all edgels, float64.

    directions: (e, 3) depth 1. planes: (e, 4), slope 1 px across the edgel. centres: (V, 3). projections: (V, 3, 4).
    """

    directions: np.ndarray
    planes: np.ndarray
    centres: np.ndarray
    projections: np.ndarray

    @staticmethod
    def of(views: Views) -> "Rays":
        """Those of the edgels of Views."""
        edgels = views.edgels
        assert edgels is not None
        own, projections = edgels.views, views.intrinsics @ views.world_to_camera
        points, normals = edgels.points.astype(np.float64), edgels.normals.astype(np.float64)
        inverse = np.linalg.inv(projections[:, :, :3])
        centres = Cameras.of(projections).centres
        directions = np.einsum("nij,nj->ni", inverse[own], np.column_stack([points, np.ones(len(points))]))
        lines = np.column_stack([normals, -(normals * points).sum(axis=1)])
        return Rays(directions, np.einsum("nj,njk->nk", lines, projections[own]), centres, projections)


def neighboring_views(centres: np.ndarray, middle: np.ndarray) -> list[np.ndarray]:
    """For each view the indices of those that it is compared with: at most MOST_VIEWS, far from each other.

    centres: (V, 3) of the cameras. middle: (3,) of the scene.
    """
    towards = centres - middle
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    apart = np.arccos(np.clip(towards @ towards.T, -1.0, 1.0))
    chosen = []
    for view, angles in enumerate(apart):
        order = np.argsort(angles, kind="stable")
        order = order[(order != view) & (angles[order] >= LEAST_ANGLE)]
        near = order[: max(np.count_nonzero(angles[order] <= MOST_ANGLE), LEAST_VIEWS)]
        chosen.append(np.sort(_spread_out(near, apart)) if len(near) > MOST_VIEWS else near)
    return chosen


def _spread_out(views: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """MOST_VIEWS of some views: the first, then always the one that is farthest from those before it."""
    found, nearest = [0], apart[views[0], views]
    while len(found) < MOST_VIEWS:
        found.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, apart[views[found[-1]], views])
    return views[found]


def lift_edgels(
    views: Views, tolerance: float, chosen: np.ndarray | None = None, report: "Callable[[int], None] | None" = None
) -> Lifted:
    """Lifted of the edgels of Views. ti.init must have been called.

    tolerance: px, by which edgels of an edge may disagree. chosen: (e,) bool, which edgels are to be lifted; None: all.
    report: called with the number of views that are done.
    """
    edgels, rays = views.edgels, Rays.of(views)
    assert edgels is not None
    elements = upload(np.column_stack([edgels.points, edgels.normals]).astype(np.float32))
    planes, cameras = upload(rays.planes.astype(np.float32)), upload(rays.projections.astype(np.float32))
    found = np.zeros((len(edgels), 4 * CANDIDATES), np.float32)
    bounds = np.asarray(edgels.starts)
    for view, others in enumerate(neighboring_views(rays.centres, views.box.mean(axis=0))):
        own = np.arange(bounds[view], bounds[view + 1])
        own = own if chosen is None else own[chosen[own]]
        if len(own) and len(others):
            found[own] = _lift_view(views, rays, view, own, others, (planes, elements, cameras), tolerance)
        if report is not None:
            report(view + 1)
    return _in_space(edgels.views, rays, found)


def _lift_view(
    views: Views,
    rays: Rays,
    view: int,
    own: np.ndarray,
    others: np.ndarray,
    scene: tuple,
    tolerance: float,
) -> np.ndarray:
    """(n, 4 CANDIDATES) of some edgels of a view, see `lift_rays`. scene: planes, edgels and cameras, uploaded."""
    eye, directions = rays.centres[view], rays.directions[own]
    ranges = depth_ranges(views, eye, directions)
    assert views.edgels is not None
    angles, order, around, reach = [], [], [], []
    bounds, middle = views.edgels.starts, views.box.mean(axis=0)
    for other in others:
        turn = _AnglesAbout(eye, rays.centres[other], middle)
        part = np.arange(bounds[other], bounds[other + 1])
        theirs, wide = turn.of(rays.directions[part])
        rising = np.argsort(theirs, kind="stable")
        angles.append(turn.of(directions)[0])
        order.append(part[rising])
        around.append(theirs[rising])
        reach.append(REACH * HALF_EDGEL_PX / views.intrinsics[other, 0, 0] / max(wide, 1e-3))
    starts = np.concatenate([[0], np.cumsum([len(part) for part in order])])
    workers, lanes = workers_for(len(own))
    scratch = [upload(np.zeros((workers, MOST_MEETINGS), np.float32)) for _ in range(4)]
    scratch += [upload(np.zeros((workers, MOST_MEETINGS), np.int32)) for _ in range(3)]
    normals = rays.planes[own, :3]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    floats = [directions, normals, ranges, eye, np.array(angles)]
    floats = [upload(np.ascontiguousarray(array, np.float32)) for array in floats]
    indices = [upload(np.asarray(array, np.int32)) for array in (others, starts, np.concatenate(order))]
    found = upload(np.zeros((len(own), 4 * CANDIDATES), np.float32))
    lift_rays(
        workers,
        lanes,
        *floats,
        indices[0],
        upload(np.array(reach, np.float32)),
        *indices[1:],
        upload(np.concatenate(around).astype(np.float32)),
        *scene,
        tolerance,
        *scratch,
        found,
    )
    return download(found)


def depth_ranges(views: Views, eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n, 2) least and greatest inverse depth on viewing rays of a camera, as far as they are in the box; none: 1, 0.

    eye: (3,) of the camera. directions: (n, 3) depth 1.
    """
    grown = views.box + MARGIN * np.ptp(views.box, axis=0) * [[-1.0], [1.0]]
    near, far = through_box(eye, directions, grown)
    near = np.maximum(near, TRIED_FROM)
    meets = far > near
    depths = np.where(meets[:, None], np.column_stack([far, near]), 1.0)
    return np.where(meets[:, None], 1.0 / depths, [[1.0, 0.0]])


def workers_for(count: int) -> tuple[int, int]:
    """How many workers share a kernel's `count` rays, each with memory of its own, and how many lanes each of them has.

    On a CPU as many as there are threads.
    """
    on_cpu = ti.lang.impl.current_cfg().arch == ti.cpu
    return (threads(), LANES) if on_cpu else (count, 1)


class _AnglesAbout:
    """Angles of viewing rays about the line through two cameras: those of rays that can meet are equal."""

    def __init__(self, eye: np.ndarray, other: np.ndarray, middle: np.ndarray) -> None:
        """eye, other: (3,) the cameras. middle: (3,) what both look at; its own angle is 0."""
        base = (other - eye) / np.linalg.norm(other - eye)
        side = (middle - eye) - ((middle - eye) @ base) * base
        if np.linalg.norm(side) < 1e-9:  # one camera looks past the other: any side will do
            side = np.cross(base, np.eye(3)[np.argmin(np.abs(base))])
        self.side = side / np.linalg.norm(side)
        self.up = np.cross(base, self.side)

    def of(self, directions: np.ndarray) -> tuple[np.ndarray, float]:
        """(n,) radians, of (n, 3) rays of either camera; and how far from the line nearly all are at depth 1."""
        along, across = directions @ self.side, directions @ self.up
        wide = float(np.quantile(np.hypot(along, across), FEW)) if len(directions) else 1.0
        return np.arctan2(across, along), wide


def _in_space(own: np.ndarray, rays: Rays, found: np.ndarray) -> Lifted:
    """Lifted from what `lift_rays` found. own: (e,) view of each edgel."""
    depth, turn, evidence, parallax = np.moveaxis(found.reshape(len(found), CANDIDATES, 4), 2, 0).astype(np.float64)
    first = rays.directions / np.linalg.norm(rays.directions, axis=1, keepdims=True)
    normals = rays.planes[:, :3] / np.linalg.norm(rays.planes[:, :3], axis=1, keepdims=True)
    second = np.cross(normals, first)
    far = 1.0 / np.where(evidence > 0, depth, np.inf)
    points = rays.centres[own][:, None] + rays.directions[:, None] * far[:, :, None]
    directions = np.cos(turn)[:, :, None] * first[:, None] + np.sin(turn)[:, :, None] * second[:, None]
    return Lifted(points, directions, evidence, parallax)
