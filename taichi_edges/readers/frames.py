"""Frames: what a reader found on disk, before anything is decoded; and how frames become Views, with every check."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from taichi_edges.cameras import OPENGL_TO_OPENCV, Similarity, inside_image, invert_pose, project
from taichi_edges.errors import UserError, did_you_mean, name_some
from taichi_edges.views import Views

ORTHONORMAL_TOLERANCE = 1e-3  # largest deviation of R^T R from the identity; files store six digits or more
BOX_GRID = 9  # points along each side of the scene box that are looked for in every view
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
LEAVE_OUT = "or leave such views out with source.skip"
TAIL_BYTES = 64  # some writers pad the file behind its end marker
# What a whole file ends with; a decoder alone may fill the missing rows of a truncated file with grey.
END_MARKERS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}


@dataclass(frozen=True)
class Frames:
    """Views as a layout describes them.

    where: the file that lists them, for messages. names: (V,). edge_paths, image_paths: (V,) paths, an image may be
    missing. intrinsics: (V,) functions (width, height) in pixels -> (3, 3), pixel centres at integers; nobody asks
    that of a view with a lens. camera_to_world: (V, 4, 4) as in the file. Both are checked when the views to skip are
    gone. opengl: are those OpenGL axes? size: (width, height) if the file says so. input_to_truth: (4, 4).

    lenses: (V,) photogrammetry.Lens where the layout knows one, else None; its pictures are undistorted before anything
    looks at them. mask_paths: (V,) images that show 128 or more where the picture counts, '' for all of it.
    valid_paths: (V,) images that are 0 where undistortion left nothing, '' where it left no such place. points: (n, 3)
    of structure from motion, input units, None where the layout has none. box: (2, 3) corners of the scene, input
    units, where the layout knows or can tell. files: what the reader read beyond `where`. notes, warnings: what it has
    to say about it.
    """

    where: Path
    names: list
    edge_paths: list
    image_paths: list
    intrinsics: list
    camera_to_world: list
    opengl: bool
    size: tuple | None = None
    input_to_truth: np.ndarray = field(default_factory=lambda: np.eye(4))
    lenses: list = ()
    mask_paths: list = ()
    valid_paths: list = ()
    points: np.ndarray | None = None
    box: np.ndarray | None = None
    files: tuple = ()
    notes: tuple = ()
    warnings: tuple = ()

    def __post_init__(self):
        for key, nothing in (("lenses", None), ("mask_paths", ""), ("valid_paths", "")):
            if not getattr(self, key):
                object.__setattr__(self, key, [nothing] * len(self.names))


def read_json(path, what):
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


def matrix(values, shape, where, key):
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


def build_views(frames, edge_maps, edgels, config, box, progress):
    """Check the cameras of frames whose edges are known, and bring the scene box into the unit cube.

    edge_maps: (V, H, W) uint8. edgels: Edgels, or None where they are still to be traced. config: the scene's `source`
    section. box: (2, 3) corners, input units.
    """
    opengl = frames.opengl if config.axes == "auto" else config.axes == "opengl"
    poses = camera_poses(frames)
    poses = poses @ OPENGL_TO_OPENCV if opengl else poses
    height, width = edge_maps.shape[1:]
    intrinsics = np.stack([intrinsics_for(width, height) for intrinsics_for in frames.intrinsics])
    _check_intrinsics(frames, intrinsics, width, height, progress)
    _check_box_seen(frames, intrinsics, poses, np.asarray(box, dtype=np.float64), (width, height), opengl)
    world_to_camera = invert_pose(poses)
    similarity = Similarity.of_box(box)
    return Views(
        names=tuple(frames.names),
        edge_maps=edge_maps,
        intrinsics=intrinsics,
        world_to_camera=into_unit_cube(world_to_camera, similarity),
        image_paths=tuple(_usable_images(frames, progress)),
        similarity=similarity,
        box=similarity.to_unit(np.asarray(box, dtype=np.float64)),
        input_to_truth=frames.input_to_truth,
        edgels=edgels,
    )


def camera_poses(frames):
    """(V, 4, 4) camera-to-world as the file has them; UserError where one is no rigid motion."""
    poses = np.stack([matrix(pose, (4, 4), frames.where, f"the pose of {name}") for name, pose in _each(frames)])
    _check_poses(frames, poses)
    return poses


def into_unit_cube(world_to_camera, similarity):
    """The same cameras for a world that went through the similarity: camera units become unit-cube units too."""
    moved = world_to_camera.copy()
    rotations, translations = world_to_camera[:, :, :3], world_to_camera[:, :, 3]
    moved[:, :, 3] = similarity.scale * translations - rotations @ np.asarray(similarity.offset)
    return moved


def _each(frames):
    return zip(frames.names, frames.camera_to_world, strict=True)


def chosen_frames(frames, skip):
    """The frames without the views to skip; their names must be unique."""
    for name in skip:
        if name not in frames.names:
            raise UserError(f"source.skip: {frames.where} has no view '{name}'{did_you_mean(name, frames.names)}")
    keep = [i for i, name in enumerate(frames.names) if name not in skip]
    if not keep:
        raise UserError(f"{frames.where}: source.skip leaves out all of its {len(frames.names)} views; shorten it")
    frames = subset(frames, keep)
    _check_names(frames)
    return frames


def subset(frames, keep):
    """Some of the frames, by their indices."""
    chosen = {key: [getattr(frames, key)[i] for i in keep] for key in PER_VIEW if getattr(frames, key)}
    return replace(frames, **chosen)


def _check_names(frames):
    twice = {name for name in frames.names if frames.names.count(name) > 1}
    if twice:
        problem = f"listed more than once: {name_some(sorted(twice))}"
        raise UserError(f"{frames.where}: {problem}; every view needs a name of its own")


def _check_poses(frames, poses):
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


def refuse_views(frames, bad, problem):
    """UserError that names the views marked in the (V,) bool array `bad`."""
    if bad.any():
        names = [name for name, is_bad in zip(frames.names, bad, strict=True) if is_bad]
        raise UserError(f"{frames.where}: {len(names)} of {len(bad)} views ({name_some(names)}): {problem}")


def _check_intrinsics(frames, intrinsics, width, height, progress):
    focal = intrinsics[:, [0, 1], [0, 1]]
    bad = ~np.isfinite(intrinsics).all(axis=(1, 2)) | (focal <= 0).any(axis=1)
    refuse_views(frames, bad, f"the focal length is not a positive number; correct the intrinsics, {LEAVE_OUT}")
    lower = np.abs(intrinsics[:, [1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max(axis=1) > 1e-9
    refuse_views(
        frames, lower, f"the intrinsics must read fx 0 cx, 0 fy cy, 0 0 1 row by row; correct them, {LEAVE_OUT}"
    )
    skewed = np.abs(intrinsics[:, 0, 1]) > 1e-6 * focal[:, 0]
    refuse_views(frames, skewed, "the intrinsics have skew, which is not supported; rectify the images")
    outside = (intrinsics[:, :2, 2] < 0).any(axis=1) | (intrinsics[:, :2, 2] > [width, height]).any(axis=1)
    problem = f"the principal point is outside the {width} x {height} px image (resized after calibration?)"
    refuse_views(frames, outside, f"{problem}; correct the intrinsics, {LEAVE_OUT}")
    off_centre = np.abs((intrinsics[:, :2, 2] + 0.5) / [width, height] - 0.5).max(axis=1) > OFF_CENTRE
    if off_centre.any():
        names = name_some([name for name, is_off in zip(frames.names, off_centre, strict=True) if is_off])
        what = f"the principal point is far from the centre of the {width} x {height} px image"
        progress.warn(f"{off_centre.sum()} of {len(off_centre)} views: {what} (resized after calibration?): {names}")


def folders_beside(frames):
    """The folders next to the file that lists the frames, in words."""
    return folders_in(frames.where.parent)


def folders_in(folder):
    """The folders in a folder, in words."""
    names = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    return name_some(names, 8) or "no folders"


def is_whole(path):
    """Does the file end as a whole file of its kind ends? Formats without a known end marker pass."""
    marker, size = END_MARKERS.get(path.suffix.lower()), path.stat().st_size
    with open(path, "rb") as file:
        file.seek(max(size - TAIL_BYTES, 0))
        return size > 0 and (marker is None or marker in file.read())


def is_usable(path):
    """Whether there is an image file at `path`, '' for none, and whole."""
    return bool(path) and Path(path).is_file() and is_whole(Path(path))


def _usable_images(frames, progress):
    """Paths of the colour images that are there and whole, '' for the others (named in a warning)."""
    wanted = [Path(path) if path else None for path in frames.image_paths]
    usable = [is_usable(path) for path in frames.image_paths]
    lost = [name for name, path, ok in zip(frames.names, wanted, usable, strict=True) if path is not None and not ok]
    if lost:
        problem = "is missing or truncated; their overlays show the edge map instead"
        progress.warn(f"{len(lost)} of {len(wanted)} views: the colour image {problem}: {name_some(lost)}")
    return [str(path) if ok else "" for path, ok in zip(wanted, usable, strict=True)]


def frames_in_sight(frames, box, axes, progress):
    """The frames that see some of a box that nobody has set by hand; a few that do not are named in a warning.

    box: (2, 3) corners, input units. axes: `source.axes`. Where most see nothing, something else is wrong.
    """
    if frames.size is None:
        return frames
    opengl = frames.opengl if axes == "auto" else axes == "opengl"
    poses = camera_poses(frames) @ (OPENGL_TO_OPENCV if opengl else np.eye(4))
    intrinsics = np.stack([intrinsics_for(*frames.size) for intrinsics_for in frames.intrinsics])
    seeing = _views_that_see(np.asarray(box, dtype=np.float64), intrinsics, invert_pose(poses), frames.size)
    if seeing.all() or seeing.mean() < MOST_SEE:
        return frames
    lost = [name for name, sees in zip(frames.names, seeing, strict=True) if not sees]
    progress.warn(f"{len(lost)} of {len(seeing)} views see nothing of the scene box, left out: {name_some(lost)}")
    return subset(frames, np.flatnonzero(seeing))


def _check_box_seen(frames, intrinsics, poses, box, size, opengl):
    """Every view must have some of the scene box in front of it and inside the image."""
    seeing = _views_that_see(box, intrinsics, invert_pose(poses), size)
    corners = " to ".join("(" + ", ".join(f"{x:g}" for x in corner) + ")" for corner in box)
    if not seeing.any():
        used, other = ("OpenGL", "opencv") if opengl else ("OpenCV", "opengl")
        centre = "(" + ", ".join(f"{x:.3g}" for x in poses[:, :3, 3].mean(axis=0)) + ")"
        flipped = poses @ OPENGL_TO_OPENCV
        inverted = OPENGL_TO_OPENCV @ flipped if opengl else poses  # what the file holds, taken for world-to-camera
        seeing_flipped = _views_that_see(box, intrinsics, invert_pose(flipped), size).sum()
        seeing_inverted = _views_that_see(box, intrinsics, inverted[:, :3], size).sum()
        if seeing_inverted > seeing_flipped:
            cure = "the poses seem to be world-to-camera; this layout has camera-to-world"
        elif seeing_flipped:
            cure = f"the poses were read with {used} axes; set source.axes: {other}"
        else:
            cure = f"correct the box (the cameras are around {centre}) or source.axes, now {used}"
        raise UserError(f"{frames.where}: 0 of {len(seeing)} views see the scene box {corners}: {cure}")
    refuse_views(frames, ~seeing, f"the scene box {corners} is not in sight; correct the box or the pose, {LEAVE_OUT}")


def _views_that_see(box, intrinsics, world_to_camera, size):
    """(V,) bool: which views have at least one point of a grid through the (2, 3) box inside the image.

    In the unit cube, as all that follows: what is too near for a camera does not depend on the units of the input.
    """
    similarity = Similarity.of_box(box)
    axes = [np.linspace(low, high, BOX_GRID) for low, high in zip(*similarity.to_unit(box), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cameras = zip(intrinsics, into_unit_cube(world_to_camera, similarity), strict=True)
    return np.array([inside_image(project(grid, lens, pose)[0], *size).any() for lens, pose in cameras])
