"""Pseudo ground truth from a dense scan: the points of its surface that lie on edges in the images.

Paper, 4.1, after EMAP (scripts/get_gt_points_DTU.py): a point counts where its projection hits edge pixels in enough
views. EMAP counts all views, and takes a share of them that was chosen for each scene. Here those count that see the
point, the scan itself being what hides it, so that one share serves edges that all views see and those that few do.

The flaws that the paper names remain. The points lie within a band about each edge, as wide as the lines of the maps;
and edges that the maps do not show in most of the views that see them have none.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.evaluation.ground_truth import GroundTruth
from taichi_edges.evaluation.metrics import average_per_voxel
from taichi_edges.views.cameras import NEAR, Camera

if TYPE_CHECKING:
    from taichi_edges.scene.settings import ScanConfig

VOXELS_PER_UNIT = 256  # EMAP: 256 voxels over [-1, 1] on each axis, of a frame in which a scene is two units long
CELL_PX = 2  # side of the cells of a depth buffer, at least; doubled until it has no holes, that is until
FULL = (
    8  # so many points are in a cell on average: of points at random, one cell in 3000 that should have some has none
)
STEEP = 4.0  # tangent of the slope up to which a surface does not hide itself within a cell: 76 degrees
CHUNK = 1 << 20  # points projected at once


@dataclass(frozen=True)
class Votes:
    """seen: (n,) number of views that see each point of a scan. on_edge: (n,) in how many of them it is on an edge."""

    seen: np.ndarray
    on_edge: np.ndarray

    @staticmethod
    def of(
        points: np.ndarray,
        cameras: Iterable[Camera],
        edge_maps: Iterable[np.ndarray],
        threshold: float,
        report: Callable[[int], None] = lambda done: None,
    ) -> "Votes":
        """Of (n, 3) points in the unit cube. cameras: list of Camera. edge_maps: as many (H, W) uint8.

        threshold: of full scale, that an edge pixel exceeds. report: called with the number of views that are done.
        """
        seen, on_edge = np.zeros((2, len(points)), np.int16)
        for view, (camera, edge_map) in enumerate(zip(cameras, edge_maps, strict=True)):
            at, rows, columns, depths = _in_sight(points, camera)
            front = _front_most(rows, columns, depths, camera)
            seen[at[front]] += 1
            on_edge[at[front]] += edge_map[rows[front], columns[front]] > 255.0 * threshold
            report(view + 1)
        return Votes(seen, on_edge)

    def chosen(self, share: float, views: int) -> np.ndarray:
        """(n,) bool: on an edge in more than this share of the views that see it, which are at least so many."""
        return (self.seen >= views) & (self.on_edge > share * self.seen)


def pseudo_truth(points: np.ndarray, votes: Votes, config: "ScanConfig", name: str) -> GroundTruth:
    """The GroundTruth of (n, 3) points of a scan, unit cube, and the Votes for them. config: `evaluation.scan`.

    name: of the scan, for messages.
    """
    chosen = votes.chosen(config.share, config.views)
    if not chosen.any():
        most = 100.0 * float((votes.on_edge / np.maximum(votes.seen, 1))[votes.seen >= config.views].max(initial=0.0))
        found = f"no point lies on edges in more than {100 * config.share:g} % of the {config.views} or more views"
        cure = "put the scan into the frame of the cameras, or lower evaluation.scan.share or .threshold"
        raise UserError(f"{name}: {found} that see it (at most {most:.0f} %); {cure}")
    averaged = average_per_voxel(points[chosen].astype(np.float32), VOXELS_PER_UNIT).astype(np.float64)
    source = f"{np.count_nonzero(chosen)} of {len(points)} points of {name} that project on edges"
    return GroundTruth(averaged, (), (), None, source)


def points_in_box(points: np.ndarray, box: np.ndarray, name: str) -> np.ndarray:
    """Those of the (n, 3) points that lie in the (2, 3) box; UserError where none does. name: of their file."""
    inside = ((points >= box[0]) & (points <= box[1])).all(axis=1)
    if not inside.any():
        low, high = (", ".join(f"{x:.3g}" for x in corner) for corner in (points.min(axis=0), points.max(axis=0)))
        spread = f"they reach from ({low}) to ({high}) where the box is the unit cube"
        raise UserError(f"{name}: none of its {len(points)} points is in the scene box: {spread}; correct its frame")
    return points[inside]


def _in_sight(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, ...]:
    """Indices of the (n, 3) points that the image has, and rows and columns of their pixels (int32), depths (float32).

    A chunk at a time: of millions of points, those in float64 would be the most of the memory.
    """
    matrix, found = camera.intrinsics @ camera.world_to_camera, []
    for start in range(0, len(points), CHUNK):
        u, v, depths = matrix[:, :3] @ points[start : start + CHUNK].T + matrix[:, 3:]
        shares = 1.0 / np.maximum(depths, NEAR)
        columns, rows = np.rint(u * shares), np.rint(v * shares)
        inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height) & (depths > NEAR)
        at = np.flatnonzero(inside)
        kinds = (np.int32, np.int32, np.float32)
        found.append(
            (at + start, *(a[at].astype(kind) for a, kind in zip((rows, columns, depths), kinds, strict=True)))
        )
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def _front_most(rows: np.ndarray, columns: np.ndarray, depths: np.ndarray, camera: Camera) -> np.ndarray:
    """(n,) bool: which points no other point of the scan hides, by a depth buffer of cells without holes."""
    side = CELL_PX
    while True:
        cells = rows // side * (camera.width // side + 1) + columns // side
        counts = np.bincount(cells)
        if len(rows) >= FULL * np.count_nonzero(counts) or side > max(camera.width, camera.height):
            break
        side *= 2
    nearest = np.full(len(counts), np.inf, np.float32)
    np.minimum.at(nearest, cells, depths)
    return depths <= nearest[cells] * np.float32(1.0 + STEEP * side / camera.intrinsics[0, 0])
