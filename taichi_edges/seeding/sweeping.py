"""Seeds by sweeping: along the viewing ray of an edgel, the depths at which other views see an edge of one direction.

Where views are many and edges few, every edgel is lifted, against all views around (`lifting`). In photographs of a
building a tenth of all pixels lies beside an edgel, and a place is in sight of a few views: places where several of
them show some edge are everywhere. What tells them apart is the direction: the edgel and that of another view each span
a plane with their camera, the planes meet in a line, and that line must be the same for the other views (Fabbri and
Kimia, "3D Curve Sketch", 2010).
And edges are long: the places that the edgels of one edge find lie along a line, those found by chance do not.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_edges.arrays.columns import Columns
from taichi_edges.detectors.chains import chain_lengths
from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.points import F32_1D, F32_2D, I32_1D, I32_2D, U8_3D
from taichi_edges.seeding.boxes import through_box
from taichi_edges.seeding.starts import ACROSS_PX, ALONG_PX, LEAST_SEEDS
from taichi_edges.splatting.gaussians import Gaussians, orient_gaussians
from taichi_edges.views.cameras import NEAR, SWEPT_FROM, inside_image, project
from taichi_edges.views.views import Views, pixel_size

if TYPE_CHECKING:
    from taichi_edges.progress import Progress
    from taichi_edges.views.edgels import Edgels

EVERY_PX = 8  # one edgel in each cell of this size is a reference
LEAST_CHAIN = 20  # edgels; on shorter chains none is
MOST_NEIGHBORS = 6  # views that a reference is compared with
LEAST_ANGLE, MOST_ANGLE = np.radians(1.5), np.radians(50.0)  # between the rays of a reference and of its neighbours
GRID = 12  # points along each side of the box that tell which views see the same
STEP_PX = 1.5  # by which a place moves at most, in the neighbour with the longest baseline
BINS = 12  # of directions in the viewing plane of the reference, 15 degrees each
ANGLES = 2 * BINS  # that are told apart: what agrees lies in one bin, or in two beside each other
CODES = 254  # directions of edgels in a byte; 0 stands for no edgel
LEAST_SINE = 0.03  # of the angle between viewing planes; others have no line in common that could be compared
CANDIDATES = 4  # depths kept for each reference
TOGETHER = 3  # neighbours that must agree
NEARBY_PX, ASIDE_PX = 8.0, 1.5  # candidates on the same line, along it and across
ALIGNED = np.cos(np.radians(30.0))  # and so much in the same direction: a bin is 15 degrees wide
LEAST_COMPANIONS = 2  # of a seed
SEARCHED = 20_000  # candidates whose companions are looked for at the same time
THINNED_PX = 3.0  # one seed in each cell of this size
BATCH_BYTES = 64 << 20  # distances from edgels that are kept at the same time
MARGIN = 2.0  # times the seeds that there is room for: some are false
SIGHTED = 2000  # seeds that tell how many views see a place

OnDevice = np.ndarray | ti.Ndarray


@dataclass(frozen=True)
class Agreements(Columns):
    """Places on the rays of edgels where the neighbours of their views agree on the direction of an edge.

    points, directions: (n, 3) unit cube. views: (n,) that agree, the reference included. pixel: (n,) size of a pixel at
    each point, unit-cube units.
    """

    points: np.ndarray
    directions: np.ndarray
    views: np.ndarray
    pixel: np.ndarray


NOWHERE = Agreements(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros(0))


@dataclass(frozen=True)
class SweepSeeds(Agreements):
    """The Agreements of all views. companions: (n,) see `companions_of`. references: edgels whose rays were swept."""

    companions: np.ndarray
    references: int


@ti.kernel
def stamp_directions(first: ti.i32, starts: I32_1D, elements: F32_2D, nearest: U8_3D, codes: U8_3D):
    """In the 3 x 3 pixels about each edgel the code of its direction; of the nearest one's where there are several.

    elements: (e, 3) u, v, code. nearest: (b, H, W), 255 everywhere, for the views from `first`. codes: (V, H, W).
    """
    for own in range(nearest.shape[0]):
        view = first + own
        for e in range(starts[view], starts[view + 1]):
            column, row = ti.cast(ti.round(elements[e, 0]), ti.i32), ti.cast(ti.round(elements[e, 1]), ti.i32)
            for down in range(-1, 2):
                for right in range(-1, 2):
                    y, x = row + down, column + right
                    if y >= 0 and x >= 0 and y < codes.shape[1] and x < codes.shape[2]:
                        du, dv = elements[e, 0] - x, elements[e, 1] - y
                        distance = ti.cast(ti.min(255.0, 100.0 * ti.sqrt(du * du + dv * dv)), ti.u8)
                        if distance < nearest[own, y, x]:
                            nearest[own, y, x] = distance
                            codes[view, y, x] = ti.cast(elements[e, 2], ti.u8)


@ti.kernel
def sweep_rays(
    rays: F32_2D,
    normals: F32_2D,
    ranges: F32_2D,
    step: ti.f32,
    epipoles: F32_2D,
    cameras: F32_2D,
    neighbors: I32_1D,
    codes: U8_3D,
    cosines: F32_1D,
    sines: F32_1D,
    needed: ti.i32,
    found: I32_2D,
    counts: I32_2D,
):
    """For each reference the depths at which most neighbours agree on a direction.

    rays: (n, 3) directions, depth 1. normals: (n, 3) of the viewing planes. ranges: (n, 2) inverse depths. epipoles:
    (m, 3) projections of the reference's centre; cameras (m, 9) the 3x3 parts of theirs. found: (n, CANDIDATES) step
    times ANGLES plus angle; counts: neighbours that agree.
    """
    for i in range(rays.shape[0]):
        ray = ti.Vector([rays[i, 0], rays[i, 1], rays[i, 2]])
        normal = ti.Vector([normals[i, 0], normals[i, 1], normals[i, 2]])
        e1 = ray.normalized()
        e2 = normal.cross(e1)
        steps = ti.cast((ranges[i, 1] - ranges[i, 0]) / step, ti.i32) + 1
        first, last, slot = 0, -10, 0
        for k in range(steps):
            inverse = ranges[i, 0] + k * step
            tally, agreeing = ti.u64(0), 0
            for m in range(neighbors.shape[0]):
                h = ti.Vector([0.0, 0.0, 0.0])
                for a in ti.static(range(3)):
                    h[a] = inverse * epipoles[m, a]
                    for b in ti.static(range(3)):
                        h[a] += cameras[m, 3 * a + b] * ray[b]
                if h[2] > NEAR * inverse:
                    u, v = h[0] / h[2], h[1] / h[2]
                    column, row = ti.cast(ti.floor(u + 0.5), ti.i32), ti.cast(ti.floor(v + 0.5), ti.i32)
                    if row >= 0 and column >= 0 and row < codes.shape[1] and column < codes.shape[2]:
                        code = ti.cast(codes[neighbors[m], row, column], ti.i32)
                        if code > 0:
                            c, s = cosines[code], sines[code]
                            offset = -(c * u + s * v)
                            other = ti.Vector([0.0, 0.0, 0.0])
                            for b in ti.static(range(3)):
                                other[b] = c * cameras[m, b] + s * cameras[m, 3 + b] + offset * cameras[m, 6 + b]
                            p, q = other.dot(e2), -other.dot(e1)
                            if p * p + q * q >= LEAST_SINE * LEAST_SINE * other.dot(other):
                                angle = ti.atan2(q, p) * (BINS / np.pi)
                                angle -= ti.floor(angle / BINS) * BINS
                                one = ti.min(ti.cast(ti.floor(angle), ti.i32), BINS - 1)
                                # bin b holds angles b .. b + 2, so that every direction lies well inside one
                                before = (one + BINS - 1) % BINS
                                tally += (ti.u64(1) << ti.cast(4 * one, ti.u64)) + (
                                    ti.u64(1) << ti.cast(4 * before, ti.u64)
                                )
                                agreeing += 1
            if agreeing >= needed:
                best, middle = most_agreeing(tally)
                if best >= needed:
                    if k - last > 2:  # another depth: it takes the place of the weakest
                        slot = 0
                        for c in ti.static(range(1, CANDIDATES)):
                            if counts[i, c] < counts[i, slot]:
                                slot = c
                        if best > counts[i, slot]:
                            counts[i, slot], found[i, slot] = best, k * ANGLES + middle
                            first, last = k, k
                    else:
                        last = k
                        if best > counts[i, slot]:
                            counts[i, slot], found[i, slot] = best, k * ANGLES + middle
                            first = k
                        elif best == counts[i, slot]:  # lines are drawn wide: the edge is in the middle
                            found[i, slot] = (first + k) // 2 * ANGLES + found[i, slot] % ANGLES


@ti.func
def most_agreeing(tally):
    """The largest count of a tally, and the angle of the directions there, in halves of a bin, 0..ANGLES - 1."""
    best, winner = 0, 0
    for b in range(BINS):
        count = count_in(tally, b)
        if count > best:
            best, winner = count, b
    if winner == 0 and count_in(tally, BINS - 1) == best:
        winner = BINS - 1
    # The middle of bins b and b + 1 is where b + 1 begins; where the next two hold as many, all lie in b + 1.
    both = 1 if count_in(tally, (winner + 1) % BINS) == best else 0
    return best, (2 * winner + 2 + both) % ANGLES


@ti.func
def count_in(tally, b):
    """How many of a tally's directions lie in the bins b and b + 1."""
    return ti.cast(tally >> ti.cast(4 * b, ti.u64) & ti.u64(15), ti.i32)


@dataclass(frozen=True)
class DirectionMaps:
    """On the device. codes: (V, H, W) uint8, of directions, see `stamp_directions`. cosines, sines: (CODES + 1,)."""

    codes: OnDevice
    cosines: OnDevice
    sines: OnDevice


def direction_maps(edgels: "Edgels", height: int, width: int) -> DirectionMaps:
    """The DirectionMaps of Edgels. height, width: pixels."""
    angles = np.arctan2(edgels.normals[:, 1], edgels.normals[:, 0]) % np.pi
    code = np.minimum(np.floor(angles / np.pi * CODES), CODES - 1) + 1
    elements = np.column_stack([edgels.points, code]).astype(np.float32)
    codes = upload(np.zeros((edgels.view_count, height, width), np.uint8))
    starts, elements = upload(edgels.starts.astype(np.int32)), upload(elements)
    batch = max(BATCH_BYTES // (height * width), 1)
    for first in range(0, edgels.view_count, batch):
        size = min(batch, edgels.view_count - first)
        stamp_directions(first, starts, elements, upload(np.full((size, height, width), 255, np.uint8)), codes)
    middles = (np.arange(-1, CODES) + 0.5) / CODES * np.pi
    cosines, sines = (upload(of(middles).astype(np.float32)) for of in (np.cos, np.sin))
    return DirectionMaps(codes, cosines, sines)


def neighbor_views(views: Views) -> list[np.ndarray]:
    """For each view the indices of at most MOST_NEIGHBORS views that see the same from elsewhere, the best first."""
    axes = [np.linspace(low, high, GRID) for low, high in zip(*views.box, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cameras = zip(views.intrinsics, views.world_to_camera, strict=True)
    seen = np.array([inside_image(project(grid, k, pose)[0], views.width, views.height) for k, pose in cameras])
    centres = camera_centres(views)
    towards = grid - centres[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-12)
    chosen = []
    for view in range(len(views)):
        cosines = (towards * towards[view]).sum(axis=2)
        good = seen & seen[view] & (cosines < np.cos(LEAST_ANGLE)) & (cosines > np.cos(MOST_ANGLE))
        chosen.append(best_and_apart(good.sum(axis=1), centres, view))
    return chosen


def can_sweep(views: Views) -> bool:
    """Whether any view has enough neighbours to be swept."""
    return any(len(others) >= TOGETHER for others in neighbor_views(views))


def best_and_apart(counts: np.ndarray, centres: np.ndarray, view: int) -> np.ndarray:
    """Indices of at most MOST_NEIGHBORS views with the largest counts that are not 0, the best first.

    Of equal ones that which is farthest from those before it, and from the view: where all see the whole scene, they
    shall not be six beside each other. counts: (V,). centres: (V, 3) of the cameras.
    """
    found: list[int] = []
    apart = np.linalg.norm(centres - centres[view], axis=1)
    counts = counts.copy()
    while len(found) < MOST_NEIGHBORS and counts.any():
        found.append(int(np.argmax(np.where(counts == counts.max(), apart, -1.0))))
        apart = np.minimum(apart, np.linalg.norm(centres - centres[found[-1]], axis=1))
        counts[found[-1]] = 0
    return np.array(found, np.int64)


def camera_centres(views: Views) -> np.ndarray:
    """(V, 3) unit cube."""
    rotations, offsets = views.world_to_camera[:, :, :3], views.world_to_camera[:, :, 3]
    return -np.einsum("vji,vj->vi", rotations, offsets)


def sweep_view(views: Views, view: int, chosen: np.ndarray, others: np.ndarray, maps: DirectionMaps) -> Agreements:
    """Agreements on the rays of the chosen edgels of a view.

    chosen: (m,) bool, of its edgels. others: indices of its neighbours, at least TOGETHER. maps: DirectionMaps.
    The step in inverse depth is that of STEP_PX along the epipolar line of the farthest neighbour: 1 / NEAR of it
    are far fewer than the 2^31 / ANGLES that a candidate can tell.
    """
    assert views.edgels is not None
    pixels, normals, _ = views.edgels.of_view(view)
    pixels, normals = pixels[chosen].astype(np.float64), normals[chosen].astype(np.float64)
    lens, pose = views.intrinsics[view], views.world_to_camera[view]
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    rays = homogeneous @ np.linalg.inv(lens).T @ pose[:, :3]
    planes = np.column_stack([normals, -(normals * pixels).sum(axis=1)]) @ (lens @ pose[:, :3])
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    centres = camera_centres(views)
    centre = centres[view]
    near, far = through_box(centre, rays, views.box)
    # Nearer, fewer than TOGETHER neighbours look from directions that MOST_ANGLE allows.
    baselines = np.linalg.norm(centres[others] - centre, axis=1)
    near = np.maximum(near, max(SWEPT_FROM, np.sort(baselines)[TOGETHER - 1] / np.tan(MOST_ANGLE)))
    good = far > near
    if not good.any():
        return NOWHERE
    rays, planes, near, far = rays[good], planes[good], near[good], far[good]
    projections = views.intrinsics[others] @ views.world_to_camera[others]
    epipoles = projections @ np.append(centre, 1.0)
    step = STEP_PX / float((views.intrinsics[others, 0, 0] * baselines).max())
    found = upload(np.zeros((len(rays), CANDIDATES), np.int32))
    counts = upload(np.zeros((len(rays), CANDIDATES), np.int32))
    f32 = [upload(np.ascontiguousarray(a, np.float32)) for a in (rays, planes, np.column_stack([1 / far, 1 / near]))]
    pair = upload(epipoles.astype(np.float32)), upload(projections[:, :, :3].reshape(-1, 9).astype(np.float32))
    tables = upload(others.astype(np.int32)), maps.codes, maps.cosines, maps.sines
    sweep_rays(*f32, step, *pair, *tables, TOGETHER, found, counts)
    found, counts = download(found), download(counts)
    which, slot = np.nonzero(counts >= TOGETHER)
    inverse = 1 / far[which] + (found[which, slot] // ANGLES) * step
    angle = (found[which, slot] % ANGLES) * np.pi / ANGLES
    e1 = rays[which] / np.linalg.norm(rays[which], axis=1, keepdims=True)
    e2 = np.cross(planes[which], e1)
    directions = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    points, pixel = centre + rays[which] / inverse[:, None], 1 / (inverse * lens[0, 0])
    return Agreements(points, directions, counts[which, slot] + 1, pixel)


def references(edgels: "Edgels", lengths: np.ndarray) -> np.ndarray:
    """(e,) bool: one of the Edgels in each cell of EVERY_PX px, that on the longest chain, if this is long.

    lengths: (e,) edgels on the chain of each.
    """
    good = np.flatnonzero(lengths >= LEAST_CHAIN)
    cells = np.floor(edgels.points[good] / EVERY_PX).astype(np.int64)
    keys = (edgels.views[good] * 100_000 + cells[:, 1]) * 100_000 + cells[:, 0]
    order = np.lexsort((-lengths[good], keys))
    first = np.unique(keys[order], return_index=True)[1]
    chosen = np.zeros(len(edgels), bool)
    chosen[good[order[first]]] = True
    return chosen


def sweep_seeds(views: Views, report: Callable[[int], None] | None = None) -> SweepSeeds:
    """SweepSeeds of all views. ti.init must have been called. report: called with the number of views done."""
    edgels = views.edgels
    assert edgels is not None
    maps = direction_maps(edgels, views.height, views.width)
    chosen = references(edgels, chain_lengths(edgels))
    parts = [NOWHERE]
    for view, others in enumerate(neighbor_views(views)):
        some = chosen[edgels.starts[view] : edgels.starts[view + 1]]
        if len(others) >= TOGETHER and some.any():
            parts.append(sweep_view(views, view, some, others, maps))
        if report is not None:
            report(view + 1)
    found = Agreements.joined(parts)
    companions = companions_of(found)
    return SweepSeeds(found.points, found.directions, found.views, found.pixel, companions, int(chosen.sum()))


def companions_of(found: Agreements) -> np.ndarray:
    """(n,) of each of the Agreements: how many views more than chance's agree on others nearby on the same line.

    Two views always agree. What is nearby is a matter of pixels at the place, and is looked for among those of about
    its pixel size.
    """
    points, directions, pixel = found.points, found.directions, found.pixel
    companions = np.zeros(len(points), int)
    octaves = np.floor(np.log2(pixel)).astype(int)
    for octave in np.unique(octaves):
        about = np.flatnonzero(np.abs(octaves - octave) <= 1)
        tree, own = cKDTree(points[about]), np.flatnonzero(octaves == octave)
        for first in range(0, len(own), SEARCHED):
            some = own[first : first + SEARCHED]
            reach = NEARBY_PX * 2.0 ** (octave + 0.5)
            pairs = cKDTree(points[some]).sparse_distance_matrix(tree, reach, output_type="ndarray")
            one, other = some[pairs["i"]], about[pairs["j"]]
            apart, direction = points[other] - points[one], directions[one]
            across = np.linalg.norm(apart - (apart * direction).sum(axis=1)[:, None] * direction, axis=1)
            aligned = np.abs((direction * directions[other]).sum(axis=1)) >= ALIGNED
            same = (one != other) & aligned & (across <= ASIDE_PX * pixel[one])
            np.add.at(companions, one[same], found.views[other[same]] - 2)
    return companions


def swept_gaussians(views: Views, count: int, opacity: float, progress: "Progress") -> Gaussians | None:
    """At most `count` Gaussians where views agree on the direction of an edge, laid along it; None if too few.

    ti.init must have been called. opacity: 0..1. progress: Progress.
    """
    with progress.track("sweep", len(views)) as report:
        seeds = sweep_seeds(views, report)
    chosen = best_seeds(seeds, views, count)
    if len(chosen) < min(LEAST_SEEDS, count):
        return None
    along, across = ALONG_PX * pixel_size(views), ACROSS_PX * pixel_size(views)
    return orient_gaussians(seeds.points[chosen], seeds.directions[chosen], along, across, opacity)


def best_seeds(seeds: SweepSeeds, views: Views, count: int) -> np.ndarray:
    """Indices, rising, of the SweepSeeds with most companions, one in each cell of THINNED_PX, at most `count`.

    Nor more than MARGIN times those that the edges have room for: a place on an edge is a reference in each view that
    has it in sight. Where many views see everything, chance finds companions for most candidates.
    """
    order = np.argsort(-seeds.companions, kind="stable")
    order = order[: np.count_nonzero(seeds.companions >= LEAST_COMPANIONS)]
    cells = np.floor(seeds.points[order] / (THINNED_PX * pixel_size(views))).astype(np.int64)
    best = order[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
    room = seeds.references * EVERY_PX / THINNED_PX / max(views_in_sight(views, seeds.points[best]), 1.0)
    return np.sort(best[: min(count, int(np.ceil(MARGIN * room)))])


def views_in_sight(views: Views, points: np.ndarray) -> float:
    """Mean number of views that have a point in their image, over (n, 3) points; 0 where there are none."""
    some = points[:: -(-len(points) // SIGHTED)] if len(points) else points
    inside = [inside_image(views.project(some, view)[0], views.width, views.height).sum() for view in range(len(views))]
    return sum(inside) / max(len(some), 1)
