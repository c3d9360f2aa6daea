"""nerfstudio's `transforms.json`, which instant-ngp's resembles: OpenGL axes, lenses with distortion, masks, points.

Intrinsics (fl_x, fl_y, cx, cy, w, h, k1 ... p2, camera_model) stand on top or in each frame; the centre of the first
pixel is (0.5, 0.5), as in COLMAP. `applied_transform` and `applied_scale` say how the poses came from another frame;
poses, points (`ply_file_path`), box and everything exported are in the frame of the file as it is.
"""

import posixpath
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.readers.companions import companion, edge_paths, mask_paths
from taichi_edges.readers.frames import Frames, read_json
from taichi_edges.readers.photogrammetry import Lens
from taichi_edges.readers.points import read_cloud
from taichi_edges.readers.scene_box import box_of_cameras, scene_box
from taichi_edges.views.cameras import OPENGL_TO_OPENCV
from taichi_edges.views.picture_sizes import picture_size

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

LISTING = "transforms.json"
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4")  # the first four as in COLMAP's OPENCV


def read_nerfstudio(path: Path, config: "SourceConfig") -> Frames:
    """Frames of a nerfstudio or instant-ngp folder, or of a file like its transforms.json.

    config: the scene's `source` section.
    """
    where = path if path.is_file() else path / LISTING
    folder = where.parent
    content = read_json(where, f"nerfstudio's folders hold {LISTING}")
    listed = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not listed:
        raise UserError(f"{where}: has no 'frames'; is this a transforms.json of nerfstudio or instant-ngp?")
    paths = [_file_path(frame, where) for frame in listed]
    inner = _below_their_folder(paths)
    images = [_image(folder, config.images, *names) for names in zip(paths, inner, strict=True)]
    masks, warnings = _masks(folder, config, listed, inner)
    lenses = [_lens({**content, **frame}, image, where) for frame, image in zip(listed, images, strict=True)]
    poses = [frame.get("transform_matrix") for frame in listed]
    points, files = _points(folder, content, where)
    box, doubt = _box(points, poses, lenses, config)
    return Frames(
        where=where,
        names=_view_names(inner),
        edge_paths=edge_paths(folder, config, inner),
        image_paths=images,
        intrinsics=[None] * len(inner),
        camera_to_world=poses,
        opengl=True,
        lenses=lenses,
        mask_paths=masks,
        points=points,
        box=box,
        files=files,
        warnings=(*warnings, *doubt),
    )


def _file_path(frame: Any, where: Path) -> PurePosixPath:
    """The image of a frame, relative to the file's folder or absolute."""
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str) or not PurePosixPath(name).name:
        raise UserError(f"{where}: a frame without file_path; every frame names its image")
    return PurePosixPath(posixpath.normpath(name.replace("\\", "/")))


def _below_their_folder(paths: list[PurePosixPath]) -> list[str]:
    """(V,) the paths below the folder that all of them share, as edge maps and masks are named."""
    shared = posixpath.commonpath([path.parent for path in paths]) if len({p.is_absolute() for p in paths}) == 1 else ""
    return [str(path.relative_to(shared)) if shared else str(path) for path in paths]


def _view_names(inner: list[str]) -> list[str]:
    """Names without suffixes, unless two would be the same."""
    stems = [str(PurePosixPath(name).with_suffix("")) for name in inner]
    return stems if len(set(stems)) == len(stems) else list(inner)


def _image(folder: Path, given: str, path: PurePosixPath, inner: str) -> Path:
    """Where the image of a frame is: what the file says, whatever its suffix, or that name in `source.images`."""
    wanted = folder / given / inner if given else folder / path
    if wanted.is_file():
        return wanted
    return companion(wanted.parent, wanted.name) or companion(wanted.parent, f"{wanted.name}.png") or wanted


def _masks(
    folder: Path, config: "SourceConfig", listed: list[dict[str, Any]], inner: list[str]
) -> tuple[Sequence[Path | str], tuple[str, ...]]:
    """(V,) masks, '' where a view has none, and warnings; those the file names, unless the scene names others."""
    named = [frame.get("mask_path") for frame in listed]
    if config.masks or not any(named):
        return mask_paths(folder, config, inner)
    return [folder / name if isinstance(name, str) and name else "" for name in named], ()


def _lens(values: dict[str, Any], image: Path, where: Path) -> Lens:
    """The Lens of a frame, whose own values go before those of the file."""
    name = values["file_path"]
    width, height = _size(values, image, where, name)
    focal_x = _number(values, "fl_x", where, name) or _focal(values, "camera_angle_x", width, where, name)
    focal_y = _number(values, "fl_y", where, name) or _focal(values, "camera_angle_y", height, where, name)
    focal_x, focal_y = focal_x or focal_y, focal_y or focal_x
    if not focal_x or not focal_y:
        raise UserError(f"{where}: {name} has neither fl_x nor camera_angle_x; add one of them, to the frame or on top")
    centre_x, centre_y = _number(values, "cx", where, name), _number(values, "cy", where, name)
    k1, k2, p1, p2, k3, k4 = (_number(values, key, where, name) or 0.0 for key in DISTORTION)
    pinhole = (
        focal_x,
        focal_y,
        width / 2 if centre_x is None else centre_x,
        height / 2 if centre_y is None else centre_y,
    )
    if _is_fisheye(values, where):
        return Lens("OPENCV_FISHEYE", width, height, (*pinhole, k1, k2, k3, k4))
    if k4:
        problem = f"k4 of {name} is {k4:g}, which COLMAP's perspective lenses do not have"
        raise UserError(f"{where}: {problem}; undistort the images before, or calibrate with k1, k2, k3, p1, p2")
    if k3:
        return Lens("FULL_OPENCV", width, height, (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    if any((k1, k2, p1, p2)):
        return Lens("OPENCV", width, height, (*pinhole, k1, k2, p1, p2))
    return Lens("PINHOLE", width, height, pinhole)


def _is_fisheye(values: dict[str, Any], where: Path) -> bool:
    """instant-ngp says so by a key of its own."""
    model = str(values.get("camera_model") or "OPENCV").upper()
    if model not in (*PERSPECTIVE, *FISHEYE):
        known = f"{', '.join(PERSPECTIVE)} and {FISHEYE[0]}"
        raise UserError(f"{where}: camera_model {model} is not supported; {known} are: undistort the images before")
    return model in FISHEYE or values.get("is_fisheye") is True


def _number(values: dict[str, Any], key: str, where: Path, name: str) -> float | None:
    """The value of a key, None without; UserError where it is no finite number."""
    value = values.get(key)
    if value is None:
        return None
    if type(value) not in (int, float) or not np.isfinite(value):
        raise UserError(f"{where}: {key} of {name} must be a finite number, not {value!r}")
    return float(value)


def _focal(values: dict[str, Any], key: str, side: int, where: Path, name: str) -> float | None:
    """Pixels, from a field of view in radians across `side` pixels; None where the file has none."""
    angle = _number(values, key, where, name)
    if angle is None:
        return None
    if not 0 < angle < np.pi:
        raise UserError(f"{where}: {key} of {name} must be between 0 and pi radians, not {angle:g}")
    return 0.5 * side / np.tan(0.5 * angle)


def _size(values: dict[str, Any], image: Path, where: Path, name: str) -> tuple[int, int]:
    """(width, height) in pixels as the file says, else of the image."""
    width, height = _number(values, "w", where, name), _number(values, "h", where, name)
    if width is None or height is None:
        size = picture_size(image) if image.is_file() else None
        if size is None:
            raise UserError(f"{where}: neither w and h nor the image tell how large {name} is; add w and h")
        return size
    if not all(side > 0 and side == int(side) for side in (width, height)):
        raise UserError(f"{where}: w and h of {name} must be whole numbers of pixels, not {width:g} and {height:g}")
    return int(width), int(height)


def _points(folder: Path, content: dict[str, Any], where: Path) -> tuple[np.ndarray | None, tuple[Path, ...]]:
    """(n, 3) the points of the file's PLY, None without, and the files read."""
    name = content.get("ply_file_path")
    if not isinstance(name, str) or not name:
        return None, ()
    path = folder / name
    if not path.is_file():
        raise UserError(f"{where}: ply_file_path: {path} is not there; copy it, or leave the key out")
    return read_cloud(path, "ply_file_path"), (path,)


def _box(
    points: np.ndarray | None, poses: list[Any], lenses: list[Lens], config: "SourceConfig"
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """(2, 3) corners of the scene, None where nothing tells; and doubts."""
    try:
        camera_to_world = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    except (TypeError, ValueError):
        return None, ()  # a pose is broken, which is said later, by name
    if config.axes != "opencv":
        camera_to_world = camera_to_world @ OPENGL_TO_OPENCV
    if points is not None:
        return scene_box(points, camera_to_world), ()
    box = box_of_cameras(
        camera_to_world, [min(lens.width / lens.params[0], lens.height / lens.params[1]) for lens in lenses]
    )
    if box is None:
        return None, ("no points, and the cameras do not look at one place: nothing tells where the scene is; set box",)
    return box, (
        "no points (ply_file_path) tell how large the scene is: the box is what the cameras look at; or set box",
    )
