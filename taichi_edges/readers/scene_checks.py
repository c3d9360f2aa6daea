"""Whether cameras, box and points can be those of one scene, before anything is made of them.

Every message names the likely cause: what is wrong is tried the other way (axes flipped, poses inverted, units a
thousand times larger or smaller), and what then fits is said.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError, name_some
from taichi_edges.views.cameras import OPENGL_TO_OPENCV, Similarity, inside_image, invert_pose, project

if TYPE_CHECKING:
    from taichi_edges.readers.frames import Frames

LEAST_VIEWS = 3  # two viewing planes always meet: only a third tells an edge from chance
BOX_GRIDS = (9, 33)  # points along each side of the scene box that are looked for in every view; if in vain, more
SAME_PLACE = 1e-7  # of the coordinates: rounding, of files in single precision
LEAST_SPREAD = 1 / 200  # of the box's longest side, between cameras: a parallax of 0.3 degrees and less places nothing
SMALLEST_BOX = 8.0  # px across: a box that spans less holds no edges
MOST_POINTS = 2000  # points that are looked for in the views
LEAST_SEEN = 0.2  # share of the points that LEAST_VIEWS must have in their images; a scan may be larger
ENOUGH_SEEN = 0.5  # of the points, where something has been tried: that is it
MOST_VIEWS = 0.5  # of all, must see the box where something has been tried
UNITS = (1000.0, 0.001)  # millimetres for metres, and the other way round
LEAVE_OUT = "or leave such views out with source.skip"


@dataclass(frozen=True)
class CamerasAsRead:
    """intrinsics: (V, 3, 3) pixels. poses: (V, 4, 4) camera-to-world, OpenCV axes, input units. sizes: (V, 2) width and
    height, pixels. opengl: whether they were read with OpenGL axes."""

    intrinsics: np.ndarray
    poses: np.ndarray
    sizes: np.ndarray
    opengl: bool

    def flipped(self) -> "CamerasAsRead":
        """As if the file had the other axes."""
        return replace(self, poses=self.poses @ OPENGL_TO_OPENCV)

    def inverted(self) -> "CamerasAsRead":
        """As if the file had world-to-camera."""
        of_file = self.poses @ OPENGL_TO_OPENCV if self.opengl else self.poses
        inverted = np.tile(np.eye(4), (len(of_file), 1, 1))
        inverted[:, :3] = invert_pose(of_file)
        return replace(self, poses=inverted @ OPENGL_TO_OPENCV if self.opengl else inverted)

    def see(self, points: np.ndarray, similarity: Similarity) -> np.ndarray:
        """(V, n) bool: which views have which of the (n, 3) points in front of them and inside the image.

        In the unit cube of the similarity: what is too near for a camera does not depend on the units of the input.
        """
        points = similarity.to_unit(points)
        poses = into_unit_cube(invert_pose(self.poses), similarity)
        views = zip(self.intrinsics, poses, self.sizes, strict=True)
        return np.array([inside_image(project(points, lens, pose)[0], *size) for lens, pose, size in views])


def into_unit_cube(world_to_camera: np.ndarray, similarity: Similarity) -> np.ndarray:
    """The same cameras for a world that went through the similarity: camera units become unit-cube units too."""
    moved = world_to_camera.copy()
    rotations, translations = world_to_camera[:, :, :3], world_to_camera[:, :, 3]
    moved[:, :, 3] = similarity.scale * translations - rotations @ np.asarray(similarity.offset)
    return moved


def check_views(frames: "Frames") -> None:
    """UserError where there are too few views."""
    count = len(frames.names)
    if count < LEAST_VIEWS:
        problem = "one view only" if count == 1 else f"{count} views only"
        cure = f"an edge in space needs at least {LEAST_VIEWS}; take 20 to 50 pictures from all around"
        raise UserError(f"{frames.where}: {problem}: {cure}")


def check_places(frames: "Frames", poses: np.ndarray) -> None:
    """UserError where the cameras, (V, 4, 4), all stand in one place: nothing has depth then."""
    centres = poses[:, :3, 3]
    if np.ptp(centres, axis=0).max() > SAME_PLACE * max(np.abs(centres).max(), np.finfo(float).tiny):
        return
    same = np.abs(poses - poses[0]).max() < SAME_PLACE
    if same:
        raise UserError(f"{frames.where}: the poses of all {len(poses)} views are the same; export the poses again")
    problem = f"all {len(poses)} cameras stand in one place"
    raise UserError(f"{frames.where}: {problem}, and nothing tells depth; move between pictures, or export poses again")


def check_points(frames: "Frames", cameras: CamerasAsRead) -> None:
    """UserError where the points of the layout, if there are any, are not what the cameras see."""
    if frames.points is None or len(frames.points) < LEAST_VIEWS:
        return
    points = frames.points[:: -(-len(frames.points) // MOST_POINTS)]
    share, trouble = _share_seen(cameras, points)
    if share >= LEAST_SEEN and trouble is None:
        return
    used, other = _axes(cameras)
    trials = {
        f"the poses were read with {used} axes; set source.axes: {other}": (cameras.flipped(), points),
        "the poses seem to be world-to-camera, and this layout has camera-to-world": (cameras.inverted(), points),
        **{f"the points seem to be {_times(1 / factor)}": (cameras, factor * points) for factor in UNITS},
    }
    shares = {cure: seen for cure, trial in trials.items() for seen, wrong in [_share_seen(*trial)] if wrong is None}
    cure = max(shares, key=lambda each: shares[each], default=None)
    if cure is None or shares[cure] < max(ENOUGH_SEEN, 2 * share * (trouble is None)):
        cure = "poses, intrinsics or points are not of these images, or the points are in a frame of their own"
    seen = f"{100 * share:.0f} % of the {len(frames.points)} points are in the images of {LEAST_VIEWS} views"
    raise UserError(f"{frames.where}: {trouble.format('box of the points') if trouble else f'only {seen}'}: {cure}")


def check_box(frames: "Frames", cameras: CamerasAsRead, box: np.ndarray) -> None:
    """UserError where the scene box, (2, 3) corners in input units, is not what the views show."""
    seen = _seen_of_box(cameras, box)
    seeing, most = np.any(seen, axis=1), int(seen.sum(axis=0).max())
    corners = " to ".join("(" + ", ".join(f"{x:g}" for x in corner) + ")" for corner in box)
    if not seeing.any():
        cure = _what_helps(cameras, box, 0) or _where_they_are(cameras)
        raise UserError(f"{frames.where}: 0 of {len(seeing)} views see the scene box {corners}: {cure}")
    _check_scale(frames, cameras, box)
    if most < LEAST_VIEWS:
        problem = f"no part of the scene box {corners} is in sight of {LEAST_VIEWS} views, the most is {most}"
        overlap = "the views do not overlap: take pictures from between them, or correct the poses or the box"
        raise UserError(f"{frames.where}: {problem}; {_what_helps(cameras, box, seeing.sum()) or overlap}")
    names = [name for name, sees in zip(frames.names, seeing, strict=True) if not sees]
    if names:
        which = f"{len(names)} of {len(seeing)} views ({name_some(names)})"
        cure = _what_helps(cameras, box, len(seeing) - 1) or f"correct the box or the pose, {LEAVE_OUT}"
        raise UserError(f"{frames.where}: {which}: the scene box {corners} is not in sight; {cure}")


def views_in_sight(cameras: CamerasAsRead, box: ArrayLike) -> np.ndarray:
    """(V,) bool: which views have some of the (2, 3) box in front of them and inside the image."""
    return np.any(_seen_of_box(cameras, np.asarray(box, dtype=np.float64)), axis=1)


def _share_seen(cameras: CamerasAsRead, points: np.ndarray) -> tuple[float, str | None]:
    """The share of the points that are in the images of enough views, and what is wrong with their scale, or None."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    box = np.array([low, np.maximum(high, low + np.finfo(float).eps * max(np.abs(points).max(), 1e-300))])
    seen = cameras.see(points, Similarity.of_box(box))
    return float((seen.sum(axis=0) >= LEAST_VIEWS).mean()), _scale_trouble(cameras, box)


def _seen_of_box(cameras: CamerasAsRead, box: np.ndarray) -> np.ndarray:
    """(V, n) bool: which views see which points of a grid through the (2, 3) box."""
    for count in BOX_GRIDS:
        axes = [np.linspace(low, high, count) for low, high in zip(*box, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        seen = cameras.see(grid, Similarity.of_box(box))
        if seen.any(axis=1).all() and seen.sum(axis=0).max() >= LEAST_VIEWS:
            break
    return seen


def _axes(cameras: CamerasAsRead) -> tuple[str, str]:
    return ("OpenGL", "opencv") if cameras.opengl else ("OpenCV", "opengl")


def _times(factor: float) -> str:
    """'1000 times too large, in millimetres where the poses are in metres?'."""
    if factor > 1:
        return f"{factor:g} times too large, in millimetres where the poses are in metres?"
    return f"{1 / factor:g} times too small, in metres where the poses are in millimetres?"


def _what_helps(cameras: CamerasAsRead, box: np.ndarray, seeing: int) -> str | None:
    """What makes more than `seeing` views see the box, and most of all views; None where nothing does.

    A few that look its way are chance: cameras all around something always have some that do.
    """
    used, other = _axes(cameras)
    trials = {
        f"the poses were read with {used} axes; set source.axes: {other}": (cameras.flipped(), box),
        "the poses seem to be world-to-camera; this layout has camera-to-world": (cameras.inverted(), box),
        **{f"the box seems to be {_times(1 / factor)}": (cameras, factor * box) for factor in UNITS},
    }
    counts = {
        cure: _seen_of_box(trial, moved).any(axis=1).sum() if _scale_trouble(trial, moved) is None else 0
        for cure, (trial, moved) in trials.items()
    }
    cure = max(counts, key=lambda each: counts[each])
    return cure if counts[cure] > seeing and counts[cure] >= MOST_VIEWS * len(cameras.poses) else None


def _where_they_are(cameras: CamerasAsRead) -> str:
    centre = "(" + ", ".join(f"{x:.3g}" for x in cameras.poses[:, :3, 3].mean(axis=0)) + ")"
    return f"correct the box (the cameras are around {centre}) or source.axes, now {_axes(cameras)[0]}"


def _check_scale(frames: "Frames", cameras: CamerasAsRead, box: np.ndarray) -> None:
    trouble = _scale_trouble(cameras, box)
    if trouble:
        where = f"{frames.where}: {trouble.format('scene box')}"
        raise UserError(f"{where}: is it in other units (metres, millimetres)? Correct box, or export the poses again")


def _scale_trouble(cameras: CamerasAsRead, box: np.ndarray) -> str | None:
    """What is wrong where a box, {} in the text, is far too large or small for the cameras; None where it is not."""
    side = float((box[1] - box[0]).max())
    spread = float(np.linalg.norm(np.ptp(cameras.poses[:, :3, 3], axis=0)))
    if spread < LEAST_SPREAD * side:
        problem = f"the cameras stand within {spread:.3g} of each other, but the {{}} is {side:.3g} large"
        return f"{problem}, {side / spread:.0f} times more"
    similarity = Similarity.of_box(box)
    corners = similarity.to_unit(np.array(np.meshgrid(*box.T)).reshape(3, -1).T)
    spans = []
    for lens, pose in zip(cameras.intrinsics, into_unit_cube(invert_pose(cameras.poses), similarity), strict=True):
        pixels, _ = project(corners, lens, pose)
        if np.isfinite(pixels).all():  # a box that reaches behind a camera is not small
            spans.append(float(np.ptp(pixels, axis=0).max()))
    if len(spans) == len(cameras.poses) and np.median(spans) < SMALLEST_BOX:
        return f"the {{}}, {side:.3g} large, spans only {np.median(spans):.1f} px in the images"
    return None
