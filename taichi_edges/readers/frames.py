"""Frames: what a reader found on disk, before anything is decoded; and how frames become Views, with every check."""

import functools
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError, did_you_mean, name_some
from taichi_edges.progress import Progress
from taichi_edges.readers.photogrammetry import Lens, undistorted
from taichi_edges.readers.scene_checks import (
    LEAVE_OUT,
    CamerasAsRead,
    check_box,
    check_places,
    check_points,
    check_views,
    into_unit_cube,
    views_in_sight,
)
from taichi_edges.views.cameras import OPENGL_TO_OPENCV, Similarity, inside_image, invert_pose, project
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.picture_sizes import picture_size
from taichi_edges.views.pictures import is_whole
from taichi_edges.views.views import Views

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

ORTHONORMAL_TOLERANCE = 1e-3  # largest deviation of R^T R from the identity; files store six digits or more
TURNED_FROM, TURNED_TO = 0.1, 0.3  # off the centre of the image; of that, off the centre of the turned image
TURNED_BY_EXIF = "a program has rotated the file by its EXIF orientation; use the images that the cameras are of"
MOST_SEE = 0.5  # share of the views that must see a box for it to be about right
OFF_CENTRE = 0.25  # of the image's size: a principal point farther from the centre is worth a warning
PER_VIEW = (
    "names",
    "edge_paths",
    "image_paths",
    "intrinsics",
    "camera_to_world",
    "mask_paths",
    "valid_paths",
    "lenses",
)


@dataclass(frozen=True)
class Frames:
    """Views as a layout describes them.

    where: the file that lists them, for messages. names: (V,). edge_paths, image_paths: (V,) paths, an image may be
    missing. intrinsics: (V,) functions (width, height) in pixels -> (3, 3), pixel centres at integers; None where a
    lens tells them, and before structure from motion. camera_to_world: (V, 4, 4) as in the file. Both are checked when
    the views to skip are gone. opengl: are those OpenGL axes? size: (width, height) if the file says so.
    input_to_truth: (4, 4).

    lenses: (V,) photogrammetry.Lens where the layout knows one, else None; its pictures are undistorted before anything
    looks at them. mask_paths: (V,) images that show 128 or more where the picture counts, '' for all of it.
    valid_paths: (V,) images that are 0 where undistortion left nothing, '' where it left no such place. points: (n, 3)
    of structure from motion, input units, None where the layout has none. box: (2, 3) corners of the scene, input
    units, where the layout knows or can tell. files: what the reader read beyond `where`. notes, warnings: what it has
    to say about it.
    """

    where: Path
    names: Sequence[str]
    edge_paths: Sequence[Path | str]
    image_paths: Sequence[Path | str]
    intrinsics: Sequence[Callable[[int, int], np.ndarray] | None]
    camera_to_world: Sequence[Any]
    opengl: bool
    size: tuple[int, int] | None = None
    input_to_truth: np.ndarray = field(default_factory=lambda: np.eye(4))
    lenses: Sequence[Lens | None] = ()
    mask_paths: Sequence[Path | str] = ()
    valid_paths: Sequence[Path | str] = ()
    points: np.ndarray | None = None
    box: np.ndarray | None = None
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for key, nothing in (("lenses", None), ("mask_paths", ""), ("valid_paths", "")):
            if not getattr(self, key):
                object.__setattr__(self, key, [nothing] * len(self.names))

    def intrinsics_of(self, view: int, width: int, height: int) -> np.ndarray:
        """(3, 3) of a view without a lens, whose picture has this size in pixels."""
        of_size = self.intrinsics[view]
        assert of_size is not None, self.names[view]
        return of_size(width, height)


def read_json(path: Path, what: str) -> Any:
    """A JSON file as Python; `what` names it in the message when it is missing or broken."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        near = did_you_mean(path.name, [p.name for p in path.parent.glob("*.json")]) if path.parent.is_dir() else ""
        raise UserError(f"{path}: not found{near}; {what}; check source.path and source.reader") from error
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; {what}; check source.path and source.reader") from error
    except ValueError as error:
        raise UserError(f"{path}: cannot be read as JSON ({error}); download or export it again") from error


def matrix(values: Any, shape: tuple[int, ...], where: Path, key: str) -> np.ndarray:
    """A numeric array of the given shape from JSON values."""
    if values is None:
        raise UserError(f"{where}: {key} is missing; export the cameras again, or name the view in source.skip")
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: {key} is not a matrix of numbers") from error
    if array.shape != shape:
        wanted, found = (" x ".join(map(str, sides)) for sides in (shape, array.shape))
        problem = f"{key} must be a {wanted} matrix of numbers, but its shape is {found or 'a single number'}"
        raise UserError(f"{where}: {problem}; correct the file")
    return array


def build_views(
    frames: Frames,
    edge_maps: np.ndarray,
    edgels: Edgels | None,
    config: "SourceConfig",
    box: ArrayLike,
    progress: Progress,
) -> Views:
    """Check the cameras of frames whose edges are known, and bring the scene box into the unit cube.

    edge_maps: (V, H, W) uint8. edgels: Edgels, or None where they are still to be traced. config: the scene's `source`
    section. box: (2, 3) corners, input units.
    """
    height, width = edge_maps.shape[1:]
    intrinsics = np.stack([frames.intrinsics_of(view, width, height) for view in range(len(frames.names))])
    cameras = _cameras(frames, intrinsics, [(width, height)] * len(intrinsics), config.axes)
    _check_scene(frames, cameras, box, progress)
    similarity = Similarity.of_box(box)
    moved = into_unit_cube(invert_pose(cameras.poses), similarity)
    points = None if frames.points is None or not len(frames.points) else similarity.to_unit(frames.points)
    return Views(
        names=tuple(frames.names),
        edge_maps=edge_maps,
        intrinsics=intrinsics,
        world_to_camera=moved,
        image_paths=tuple(_usable_images(frames, progress)),
        similarity=similarity,
        box=similarity.to_unit(np.asarray(box, dtype=np.float64)),
        input_to_truth=frames.input_to_truth,
        edgels=edgels,
        pixel=None if points is None else scene_pixel(points, intrinsics, moved, (width, height)),
        tolerance_px=config.tolerance_px,
    )


def scene_pixel(
    points: np.ndarray, intrinsics: np.ndarray, world_to_camera: np.ndarray, size: tuple[int, int]
) -> float | None:
    """Size of a pixel at the points in sight, (n, 3) unit cube: median over the views of each view's median; or None.

    A camera may stand in the middle of the scene, and what it sees around it.
    """
    sizes = []
    for lens, pose in zip(intrinsics, world_to_camera, strict=True):
        pixels, depths = project(points, lens, pose)
        inside = inside_image(pixels, *size)
        if inside.any():
            sizes.append(np.median(depths[inside]) / lens[0, 0])
    return float(np.median(sizes)) if sizes else None


def check_before_detection(frames: Frames, config: "SourceConfig", box: ArrayLike) -> None:
    """UserError where cameras, box and points cannot be those of one scene: that shall not wait for the detector.

    The intrinsics are those of lenses, or what the size of the first picture means; all is checked again when the
    pictures are decoded. config: the scene's `source` section. box: (2, 3) corners, input units.
    """
    cameras = _cameras_before_detection(frames, config)
    if cameras is not None:
        _check_scene(frames, cameras, box, Progress())


def frames_in_sight(frames: Frames, config: "SourceConfig", box: ArrayLike, progress: Progress) -> Frames:
    """The frames that see some of a box that nobody has set by hand; a few that do not are named in a warning.

    Where most see nothing, something else is wrong. config, box: as for `check_before_detection`.
    """
    cameras = _cameras_before_detection(frames, config)
    seeing = np.ones(len(frames.names), bool) if cameras is None else views_in_sight(cameras, box)
    if seeing.all() or seeing.mean() < MOST_SEE:
        return frames
    lost = [name for name, sees in zip(frames.names, seeing, strict=True) if not sees]
    progress.warn(f"{len(lost)} of {len(seeing)} views see nothing of the scene box, left out: {name_some(lost)}")
    return subset(frames, np.flatnonzero(seeing))


def _cameras(frames: Frames, intrinsics: np.ndarray, sizes: Sequence[tuple[int, int]], axes: str) -> CamerasAsRead:
    """The CamerasAsRead of frames. sizes: (V, 2) width and height, pixels. axes: `source.axes`."""
    opengl = frames.opengl if axes == "auto" else axes == "opengl"
    poses = camera_poses(frames)
    return CamerasAsRead(intrinsics, poses @ OPENGL_TO_OPENCV if opengl else poses, np.asarray(sizes), opengl)


def _check_scene(frames: Frames, cameras: CamerasAsRead, box: ArrayLike, progress: Progress) -> None:
    check_views(frames)
    check_places(frames, cameras.poses)
    _check_intrinsics(frames, cameras.intrinsics, cameras.sizes, progress)
    check_points(frames, cameras)
    check_box(frames, cameras, np.asarray(box, dtype=np.float64))


def _cameras_before_detection(frames: Frames, config: "SourceConfig") -> CamerasAsRead | None:
    """The CamerasAsRead of frames of which no picture is decoded; None where no picture tells a size."""
    common = _size_of_a_picture(frames)
    intrinsics: list[np.ndarray] = []
    sizes: list[tuple[int, int]] = []
    for view, lens in enumerate(frames.lenses):
        if lens is not None:
            found, size = _undistorted(lens)
        elif common is not None:
            found, size = frames.intrinsics_of(view, *common), common
        else:
            return None
        intrinsics.append(found)
        sizes.append(size)
    return _cameras(frames, np.stack(intrinsics), sizes, config.axes)


@functools.lru_cache(maxsize=256)
def _undistorted(lens: Lens) -> tuple[np.ndarray, tuple[int, int]]:
    """`photogrammetry.undistorted`; many views share a lens."""
    return undistorted(lens)


def _size_of_a_picture(frames: Frames) -> tuple[int, int] | None:
    """(width, height) of the first image or edge map that can be read, pixels; None without any."""
    paths = (path for pair in zip(frames.image_paths, frames.edge_paths, strict=True) for path in pair)
    return next(filter(None, (picture_size(path) for path in paths if is_usable(path))), None)


def camera_poses(frames: Frames) -> np.ndarray:
    """(V, 4, 4) camera-to-world as the file has them; UserError where one is no rigid motion."""
    poses = np.stack([matrix(pose, (4, 4), frames.where, f"the pose of {name}") for name, pose in _each(frames)])
    _check_poses(frames, poses)
    return poses


def _each(frames: Frames) -> Iterable[tuple[str, Any]]:
    return zip(frames.names, frames.camera_to_world, strict=True)


def chosen_frames(frames: Frames, skip: Sequence[str]) -> Frames:
    """The frames without the views to skip; their names must be unique."""
    for name in skip:
        if name not in frames.names:
            raise UserError(f"source.skip: {frames.where} has no view '{name}'{did_you_mean(name, frames.names)}")
    keep = [i for i, name in enumerate(frames.names) if name not in skip]
    if not keep:
        raise UserError(f"{frames.where}: source.skip leaves out all of its {len(frames.names)} views; shorten it")
    frames = subset(frames, keep)
    _check_names(frames)
    check_views(frames)
    return frames


def subset(frames: Frames, keep: Sequence[int] | np.ndarray) -> Frames:
    """Some of the frames, by their indices."""
    chosen: dict[str, Any] = {key: [getattr(frames, key)[i] for i in keep] for key in PER_VIEW if getattr(frames, key)}
    return replace(frames, **chosen)


def _check_names(frames: Frames) -> None:
    twice = {name for name in frames.names if frames.names.count(name) > 1}
    if twice:
        problem = f"listed more than once: {name_some(sorted(twice))}"
        raise UserError(f"{frames.where}: {problem}; every view needs a name of its own")


def _check_poses(frames: Frames, poses: np.ndarray) -> None:
    """Finite, orthonormal, right-handed, and the last row 0 0 0 1."""
    finite = np.isfinite(poses).all(axis=(1, 2))
    refuse_views(frames, ~finite, f"the pose is not finite; export the poses again, {LEAVE_OUT}")
    rotations = poses[:, :3, :3]
    gram = np.swapaxes(rotations, 1, 2) @ rotations
    crooked = np.abs(gram - np.eye(3)).max(axis=(1, 2)) > ORTHONORMAL_TOLERANCE
    squares = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 3  # of the scale, where there is nothing but a scale
    scaled = (np.abs(gram - squares * np.eye(3)) < ORTHONORMAL_TOLERANCE * squares).all(axis=(1, 2))
    cure = "divide the scale out of it" if scaled[crooked].all() else "export the poses again"
    refuse_views(frames, crooked, f"the rotation of the pose is not orthonormal; {cure}, {LEAVE_OUT}")
    problem = "the rotation of the pose is a mirror (determinant -1); export the poses with right-handed axes"
    refuse_views(frames, np.linalg.det(rotations) < 0, f"{problem}, {LEAVE_OUT}")
    last = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1) > ORTHONORMAL_TOLERANCE
    problem = "the last row of the pose is not 0 0 0 1 (is it transposed?)"
    refuse_views(frames, last, f"{problem}; export the poses again, {LEAVE_OUT}")


def refuse_views(frames: Frames, bad: np.ndarray, problem: str) -> None:
    """UserError that names the views marked in the (V,) bool array `bad`."""
    if bad.any():
        names = [name for name, is_bad in zip(frames.names, bad, strict=True) if is_bad]
        raise UserError(f"{frames.where}: {len(names)} of {len(bad)} views ({name_some(names)}): {problem}")


def _check_intrinsics(frames: Frames, intrinsics: np.ndarray, sizes: np.ndarray, progress: Progress) -> None:
    focal = intrinsics[:, [0, 1], [0, 1]]
    bad = ~np.isfinite(intrinsics).all(axis=(1, 2)) | (focal <= 0).any(axis=1)
    refuse_views(frames, bad, f"the focal length is not a positive number; correct the intrinsics, {LEAVE_OUT}")
    lower = np.abs(intrinsics[:, [1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max(axis=1) > 1e-9
    refuse_views(
        frames, lower, f"the intrinsics must read fx 0 cx, 0 fy cy, 0 0 1 row by row; correct them, {LEAVE_OUT}"
    )
    skewed = np.abs(intrinsics[:, 0, 1]) > 1e-6 * focal[:, 0]
    refuse_views(frames, skewed, "the intrinsics have skew, which is not supported; rectify the images")
    _check_centres(frames, intrinsics[:, :2, 2], sizes, progress)


def _check_centres(frames: Frames, centres: np.ndarray, sizes: np.ndarray, progress: Progress) -> None:
    """Principal points, (V, 2) pixels, inside the images of (V, 2) sizes, and near their middle."""
    image = "the {} x {} px image".format(*sizes[0])
    off, off_turned = (np.abs((centres + 0.5) / sides - 0.5).max(axis=1) for sides in (sizes, sizes[:, ::-1]))
    turned = (off > TURNED_FROM) & (off_turned < TURNED_TO * off)
    problem = f"the principal point is in the middle of a picture of {sizes[0][1]} x {sizes[0][0]} px, not of {image}"
    cure = f"turned: {TURNED_BY_EXIF}, or export both again, {LEAVE_OUT}"
    refuse_views(frames, turned & (2 * turned.sum() > len(turned)), f"{problem}, {cure}")
    outside = np.any((centres < 0) | (centres > sizes), axis=1)
    problem = f"the principal point is outside {image} (resized after calibration?)"
    refuse_views(frames, outside, f"{problem}; correct the intrinsics, {LEAVE_OUT}")
    far = off > OFF_CENTRE
    if far.any():
        names = name_some([name for name, is_far in zip(frames.names, far, strict=True) if is_far])
        what = f"the principal point is far from the centre of {image}"
        progress.warn(f"{far.sum()} of {len(far)} views: {what} (resized after calibration?): {names}")


def folders_beside(frames: Frames) -> str:
    """The folders next to the file that lists the frames, in words."""
    return folders_in(frames.where.parent)


def folders_in(folder: Path) -> str:
    """The folders in a folder, in words."""
    names = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    return name_some(names, 8) or "no folders"


def is_usable(path: Path | str) -> bool:
    """Whether there is an image file at `path`, '' for none, and whole."""
    return bool(path) and Path(path).is_file() and is_whole(Path(path))


def _usable_images(frames: Frames, progress: Progress) -> list[str]:
    """Paths of the colour images that are there and whole, '' for the others (named in a warning)."""
    wanted = [Path(path) if path else None for path in frames.image_paths]
    usable = [is_usable(path) for path in frames.image_paths]
    lost = [name for name, path, ok in zip(frames.names, wanted, usable, strict=True) if path is not None and not ok]
    if lost:
        problem = "is missing or truncated; their overlays show the edge map instead"
        progress.warn(f"{len(lost)} of {len(wanted)} views: the colour image {problem}: {name_some(lost)}")
    return [str(path) if ok else "" for path, ok in zip(wanted, usable, strict=True)]
