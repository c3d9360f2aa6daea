"""Where straight 2D runs of edgels meet edges whose place is known: anchors, which give the runs their depth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.ranges import ragged
from taichi_edges.geometry.shapes import Shape

if TYPE_CHECKING:
    from taichi_edges.detectors.straight_runs import StraightRuns
    from taichi_edges.views.cameras import Cameras

BEYOND_PX = 8.0  # between the ends of edges that meet, see `junctions.REACH_PX`
LEAST_CROSSING = 0.3  # sine of the angle in the image at which an anchor is met
PLACE_PX, SHAPE_PX = 4.0, 1.5  # spacing of the places on runs and on shapes
CLOSE_PX = 6.0  # where such places are so near, runs may meet shapes


@dataclass(frozen=True)
class Anchors(Columns):
    """Where runs meet known shapes in the image, sorted by the run.

    runs, shapes: (n,) indices. points: (n, 3) on the shape, in the run's viewing plane. ways: (n,) px along the run.
    pixels: (n,) size of one there, in the run's view, unit-cube units.
    """

    runs: np.ndarray
    shapes: np.ndarray
    points: np.ndarray
    ways: np.ndarray
    pixels: np.ndarray

    def sorted(self) -> "Anchors":
        """The same in order of their runs, and along these."""
        return self.keep(np.lexsort((self.ways, self.runs)))

    def with_further(self, others: "Anchors", count: int) -> "Anchors":
        """These and the other Anchors, those on further shapes, where there are `count` shapes so far."""
        return Anchors.joined([self, replace(others, shapes=others.shapes + count)]).sorted()


def anchors_of(runs: "StraightRuns", shapes: Sequence[Shape], cameras: "Cameras", pixels: np.ndarray) -> Anchors:
    """The Anchors of StraightRuns on shapes. pixels: (S,) size of one at each shape, unit-cube units."""
    pieces = pieces_of(shapes, pixels)
    found, piece = near_pairs(runs, pieces, cameras)
    views, starts = runs.views[found], runs.ends[found, 0]
    middles, halves = pieces.points[piece], pieces.halves[piece]
    lines = np.column_stack([-runs.along[found][:, 1], runs.along[found][:, 0]])
    lines = np.column_stack([lines, -(lines * starts).sum(axis=1)])  # homogeneous: 0 on the line of the run
    planes = np.einsum("ni,nij->nj", lines, cameras.matrices[views])
    steep = (planes[:, :3] * halves).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = -((planes[:, :3] * middles).sum(axis=1) + planes[:, 3]) / steep
    within = np.abs(steps) <= 1.0 + 1e-6
    found, piece, views, steps = found[within], piece[within], views[within], steps[within]
    points = middles[within] + steps[:, None] * halves[within]
    places, depths = cameras.project(points, views)
    ahead, _ = cameras.project(points + halves[within], views)
    ways = ((places - starts[within]) * runs.along[found]).sum(axis=1)
    heading = (ahead - places) / np.linalg.norm(ahead - places, axis=1, keepdims=True)
    sine = np.abs(heading[:, 0] * runs.along[found][:, 1] - heading[:, 1] * runs.along[found][:, 0])
    good = (sine >= LEAST_CROSSING) & (ways >= -BEYOND_PX) & (ways <= runs.lengths[found] + BEYOND_PX)
    anchors = Anchors(found, pieces.shapes[piece], points, ways, depths / cameras.focal[views]).keep(good)
    return once(anchors)


def once(anchors: Anchors) -> Anchors:
    """The Anchors sorted by run and place along it, without those that two pieces of one shape share."""
    order = np.lexsort((anchors.ways, anchors.shapes, anchors.runs))
    anchors = anchors.keep(order)
    again = (np.diff(anchors.runs) == 0) & (np.diff(anchors.shapes) == 0) & (np.diff(anchors.ways) < 1.0)
    anchors = anchors.keep(np.append(True, ~again)[: len(anchors)])
    return anchors.sorted()


@dataclass(frozen=True)
class ShapePieces:
    """Short straight pieces of shapes. points: (n, 3) their middles. halves: (n, 3) from there to an end.

    shapes: (n,) indices.
    """

    points: np.ndarray
    halves: np.ndarray
    shapes: np.ndarray


def pieces_of(shapes: Sequence[Shape], pixels: np.ndarray) -> ShapePieces:
    """The ShapePieces of shapes; lines and arcs go on a little beyond their ends. pixels: as of `anchors_of`."""
    points, halves, counts = [np.zeros((0, 3))], [np.zeros((0, 3))], []
    for shape, pixel in zip(shapes, pixels.tolist(), strict=True):
        beyond = BEYOND_PX * pixel / shape.length if shape.kind in ("line", "arc") else 0.0
        count = max(int(np.ceil(shape.length * (1 + 2 * beyond) / (SHAPE_PX * pixel))), 1)
        bounds = shape.at(np.linspace(-beyond, 1 + beyond, count + 1))
        points.append(0.5 * (bounds[1:] + bounds[:-1]))
        halves.append(0.5 * (bounds[1:] - bounds[:-1]))
        counts.append(count)
    return ShapePieces(np.concatenate(points), np.concatenate(halves), np.repeat(np.arange(len(shapes)), counts))


def near_pairs(runs: "StraightRuns", pieces: ShapePieces, cameras: "Cameras") -> tuple[np.ndarray, np.ndarray]:
    """(k,) runs and (k,) pieces that come close to each other in the run's view, each pair once."""
    found, piece = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    every = np.arange(len(pieces.points))
    for view in np.unique(runs.views):
        mine = np.flatnonzero(runs.views == view)
        pixels, _ = cameras.project(pieces.points, np.full(len(every), view))
        low, high = runs.ends[mine].reshape(-1, 2).min(axis=0), runs.ends[mine].reshape(-1, 2).max(axis=0)
        seen = every[((pixels >= low - CLOSE_PX) & (pixels <= high + CLOSE_PX)).all(axis=1)]
        places, owners = places_on(runs, mine)
        near = cKDTree(places).sparse_distance_matrix(cKDTree(pixels[seen]), CLOSE_PX, output_type="ndarray")
        pairs = np.unique(owners[near["i"]] * len(every) + seen[near["j"]])
        found.append(pairs // len(every))
        piece.append(pairs % len(every))
    return np.concatenate(found), np.concatenate(piece)


def places_on(runs: "StraightRuns", chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m, 2) px places on the chosen runs, some beyond their ends, and (m,) the run of each."""
    counts = np.ceil((runs.lengths[chosen] + 2 * BEYOND_PX) / PLACE_PX).astype(np.int64) + 1
    of, number = ragged(counts)
    owners, share = chosen[of], number / (counts - 1)[of]
    ways = share * (runs.lengths[owners] + 2 * BEYOND_PX) - BEYOND_PX
    return runs.ends[owners, 0] + ways[:, None] * runs.along[owners], owners
