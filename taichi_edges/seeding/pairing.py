"""Straight 2D runs of the views, paired in space: segments on which several views agree.

A straight run of edgels and its camera span a plane, far more exact than that of one edgel, and so does a run of
another view. The two planes meet in a line, on which the first run spans a segment, from the inverse depth of its one
end to that of the other; it is a candidate if it covers the second run. Of wrong pairs these segments are anywhere;
those of right ones coincide, with both ends. How much an agreement says is a matter of chance, as for single edgels
(`lifting`): a view with many candidates, or one in whose picture the depths hardly show, agrees with anything.

So whole 2D edges are matched where single edgels are not enough: in photographs, among texture, and for edges along a
row of cameras, whose depth only all edgels together can tell.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_edges.arrays.columns import Columns
from taichi_edges.detectors.straight_runs import StraightRuns
from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.points import F32_1D, F32_2D, F32_3D, I32_1D, I32_2D
from taichi_edges.seeding.lifting import (
    APART_PX,
    LEAST_PARALLAX,
    TURNED_BY_CHANCE,
    WRONG,
    Rays,
    depth_ranges,
    homogeneous,
    neighboring_views,
    turned,
    workers_for,
)
from taichi_edges.views.cameras import NEAR
from taichi_edges.views.views import Views

CANDIDATES = 4  # segments kept for each run
MOST_PAIRS = 768  # of a run with those of other views; more are not looked at
PAIR_PX = 1.0  # by which the ends of two candidates may differ in the views: both runs and the poses are off
COVERED, LEAST_COVERED_PX = 0.5, 5.0  # of the shorter one of two runs by the other, seen in the other one's view
LEAST_EVIDENCE = 4.0  # of a candidate: two views that look from elsewhere and agree give 6


@dataclass(frozen=True)
class Segments(Columns):
    """Straight segments in space. ends: (n, 2, 3) unit cube. runs: (n,) index of the run that each is of."""

    ends: np.ndarray
    runs: np.ndarray

    @property
    def middles(self) -> np.ndarray:
        """(n, 3)."""
        return self.ends.mean(axis=1)

    @property
    def lengths(self) -> np.ndarray:
        """(n,) unit-cube units."""
        return np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1)

    @property
    def ways(self) -> np.ndarray:
        """(n, 3) unit vectors along them."""
        return (self.ends[:, 1] - self.ends[:, 0]) / np.maximum(self.lengths, 1e-300)[:, None]


@ti.kernel
def pair_runs(
    workers: ti.i32,
    lanes: ti.i32,
    first_rays: F32_2D,
    last_rays: F32_2D,
    ranges: F32_2D,
    centre: F32_1D,
    others: I32_1D,
    starts: I32_1D,
    planes: F32_2D,
    ends: F32_2D,
    cameras: F32_3D,
    tolerance: ti.f32,
    pairs: F32_3D,
    whose: I32_2D,
    scores: F32_2D,
    counts: I32_2D,
    found: F32_2D,
):
    """The best segments of each run of one view.

    first_rays, last_rays: (n, 3) of its ends, depth 1. ranges: (n, 2) inverse depths. centre: (3,) of the camera.
    others: the views that it is compared with, whose runs are starts[view] .. starts[view + 1] - 1 of planes (r, 4),
    px across the run in its view, and ends (r, 4), px. cameras: (V, 3, 4). tolerance: px. pairs (workers, MOST_PAIRS,
    5), whose, scores (workers, MOST_PAIRS), counts (workers, V): scratch. found: (n, 3 CANDIDATES) inverse depths of
    both ends and the evidence of each.
    """
    for item in range(workers * lanes):
        if item % lanes == 0:
            worker = item // lanes
            eye = ti.Vector([centre[0], centre[1], centre[2]])
            i = worker
            while i < first_rays.shape[0]:
                low, high = ranges[i, 0], ranges[i, 1]
                one = ti.Vector([first_rays[i, 0], first_rays[i, 1], first_rays[i, 2]])
                two = ti.Vector([last_rays[i, 0], last_rays[i, 1], last_rays[i, 2]])
                count = 0
                for m in range(others.shape[0]):
                    counts[worker, m] = 0
                    epipole = homogeneous(cameras, others[m], eye)
                    at_one, at_two = turned(cameras, others[m], one), turned(cameras, others[m], two)
                    for s in range(starts[others[m]], starts[others[m] + 1]):
                        plane = ti.Vector([planes[s, 0], planes[s, 1], planes[s, 2]])
                        offset = plane.dot(eye) + planes[s, 3]
                        offset = offset if ti.abs(offset) > 1e-12 else 1e-12
                        first, last = -plane.dot(one) / offset, -plane.dot(two) / offset
                        if ti.min(first, last) >= low and ti.max(first, last) <= high and count < MOST_PAIRS:
                            h, g = first * epipole + at_one, last * epipole + at_two
                            if h[2] > NEAR * first and g[2] > NEAR * last:
                                right, down = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                                length = ti.sqrt(right * right + down * down)
                                a = ((h[0] / h[2] - ends[s, 0]) * right + (h[1] / h[2] - ends[s, 1]) * down) / length
                                b = ((g[0] / g[2] - ends[s, 0]) * right + (g[1] / g[2] - ends[s, 1]) * down) / length
                                seen, common = ti.abs(b - a), ti.min(ti.max(a, b), length) - ti.max(ti.min(a, b), 0.0)
                                if common >= COVERED * ti.min(seen, length) and common >= LEAST_COVERED_PX:
                                    pairs[worker, count, 0], pairs[worker, count, 1] = first, last
                                    pairs[worker, count, 2] = ti.abs(offset / h[2])
                                    pairs[worker, count, 3] = ti.abs(offset / g[2])
                                    pairs[worker, count, 4] = ti.min(1.0, common / seen)
                                    whose[worker, count] = m
                                    counts[worker, m] += 1
                                    count += 1
                most = 0.0
                for k in range(count):
                    most = ti.max(most, ti.min(pairs[worker, k, 2], pairs[worker, k, 3]))
                for k in range(count):
                    scores[worker, k] = 0.0
                    if ti.min(pairs[worker, k, 2], pairs[worker, k, 3]) >= LEAST_PARALLAX * most:
                        scores[worker, k] = agreement(worker, k, count, high - low, tolerance, pairs, whose, counts)
                for c in range(CANDIDATES):
                    best, which = 0.0, -1
                    for k in range(count):
                        if scores[worker, k] > best:
                            best, which = scores[worker, k], k
                    if which >= 0:
                        first, last = pairs[worker, which, 0], pairs[worker, which, 1]
                        found[i, 3 * c], found[i, 3 * c + 1], found[i, 3 * c + 2] = first, last, best
                        for k in range(count):
                            apart = ti.max(ti.abs(pairs[worker, k, 0] - first), ti.abs(pairs[worker, k, 1] - last))
                            if apart * most < APART_PX:
                                scores[worker, k] = 0.0
                i += workers


@ti.func
def agreement(worker, own, count, span, tolerance, pairs: ti.template(), whose: ti.template(), counts: ti.template()):
    """Log likelihood ratio that an edge is on the segment of a pair: what each view says that has one there, too.

    A view counts once, by that of its segments that says most. Those of a view follow each other.
    """
    total, best, view = 0.0, 0.0, -1
    for k in range(count):
        if whose[worker, k] != view:
            total += best
            best, view = 0.0, whose[worker, k]
        off = ti.max(
            ti.abs(pairs[worker, k, 0] - pairs[worker, own, 0]) * pairs[worker, k, 2],
            ti.abs(pairs[worker, k, 1] - pairs[worker, own, 1]) * pairs[worker, k, 3],
        )
        if off < tolerance:
            slope = ti.min(pairs[worker, k, 2], pairs[worker, k, 3])
            expected = counts[worker, whose[worker, k]] * 2.0 * tolerance / (slope * span)
            close = pairs[worker, k, 4] * (1.0 - (off / tolerance) ** 2)
            best = ti.max(best, close * -ti.log(TURNED_BY_CHANCE * ti.min(1.0, expected) + WRONG))
    return total + best


def paired_runs(views: Views, runs: StraightRuns, report: Callable[[int], None] | None = None) -> Segments:
    """The Segments of StraightRuns of Views, at most CANDIDATES of each. ti.init must have been called.

    report: called with the number of views that are done.
    """
    rays = Rays.of(views)
    inverse = np.linalg.inv(rays.projections[:, :, :3])[runs.views]
    homogeneous_ends = np.concatenate([runs.ends, np.ones((len(runs), 2, 1))], axis=2)
    directions = np.einsum("nij,nkj->nki", inverse, homogeneous_ends)  # (n, 2, 3)
    along = runs.along
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    lines = np.column_stack([normals, -(normals * runs.ends[:, 0]).sum(axis=1)])
    planes = np.einsum("nj,njk->nk", lines, rays.projections[runs.views])
    starts = np.searchsorted(runs.views, np.arange(len(views) + 1))
    scene = [upload(np.asarray(array, np.float32)) for array in (planes, runs.ends.reshape(-1, 4), rays.projections)]
    bounds, found = upload(starts.astype(np.int32)), np.zeros((len(runs), CANDIDATES, 3))
    for view, others in enumerate(neighboring_views(rays.centres, views.box.mean(axis=0))):
        own = np.arange(starts[view], starts[view + 1])
        if len(own) and len(others):
            both = [depth_ranges(views, rays.centres[view], directions[own, end]) for end in (0, 1)]
            ranges = np.column_stack([np.minimum(*(r[:, 0] for r in both)), np.maximum(*(r[:, 1] for r in both))])
            ranges[np.any([r[:, 0] > r[:, 1] for r in both], axis=0)] = 1.0, 0.0
            workers, lanes = workers_for(len(own))
            scratch = [upload(np.zeros((workers, MOST_PAIRS, 5), np.float32))]
            scratch += [upload(np.zeros((workers, MOST_PAIRS), kind)) for kind in (np.int32, np.float32)]
            scratch += [upload(np.zeros((workers, len(others)), np.int32))]
            floats = [directions[own, 0], directions[own, 1], ranges, rays.centres[view]]
            best = upload(np.zeros((len(own), 3 * CANDIDATES), np.float32))
            pair_runs(
                workers,
                lanes,
                *(upload(np.ascontiguousarray(array, np.float32)) for array in floats),
                upload(others.astype(np.int32)),
                bounds,
                *scene,
                PAIR_PX,
                *scratch,
                best,
            )
            found[own] = download(best).reshape(-1, CANDIDATES, 3)
        if report is not None:
            report(view + 1)
    run, which = np.nonzero(found[:, :, 2] >= LEAST_EVIDENCE)
    depths = 1.0 / found[run, which, :2]
    return Segments(rays.centres[runs.views[run]][:, None] + depths[:, :, None] * directions[run], run)
